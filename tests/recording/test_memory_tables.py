"""Columns in memory, of whatever library: the values in them, or the error that names column and row."""

from __future__ import annotations

import datetime
from collections.abc import Callable
from decimal import Decimal
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from gz_onboard.errors import InputError
from gz_onboard.recording.tables import table_of, table_signals
from gz_onboard.vehicle import read_vehicle

pd = pytest.importorskip("pandas")
MAPPING = read_vehicle("reference").mapping
SECONDS = np.arange(8) * 0.5
AMPERES = np.arange(14.0, 22.0)
NS = (SECONDS * 1e9).astype("int64")
SINCE_1970 = 1_700_000_000


def ride(**columns: Any) -> dict[str, Any]:
    """A ride as a dict; columns: other cells of `time` and `current`."""
    given = {"time": SECONDS, "current": AMPERES, **columns}
    return {"time [s]": given["time"], "speed [km/h]": np.full(8, 36.0), "pack_current [A]": given["current"]}


def currents(data: object) -> list[tuple[float, float]]:
    """(time from the first [s], current [A]) of each value."""
    made, signals = table_signals(table_of(data), MAPPING)
    those = signals.group == [group.message for group in made.groups].index("pack_current")
    times = (signals.time_ns - signals.time_ns[0])[those] * 1e-9
    return list(zip(times.tolist(), signals.value[those].tolist(), strict=True))


PLAIN = list(zip(SECONDS.tolist(), AMPERES.tolist(), strict=True))
STAMPS = pd.to_datetime(NS + SINCE_1970 * 10**9)


@pytest.mark.parametrize(
    "time",
    [
        [Decimal(str(second)) for second in SECONDS],
        NS.astype("timedelta64[ns]"),
        [datetime.timedelta(seconds=float(second)) for second in SECONDS],
        pd.Series(pd.to_timedelta(NS)),
        pa.array(NS, pa.duration("ns")),
        pa.chunked_array([[Decimal(str(second)) for second in SECONDS]]),
        pa.array(NS).cast(pa.timestamp("ns", "Europe/Berlin")),
        pa.array(SECONDS),
        pd.Series(STAMPS.tz_localize("Europe/Berlin")),
        pd.Series(SECONDS, dtype="Float64"),
    ],
    ids=lambda time: type(time).__name__,
)
def test_times_of_any_type_are_times(time):
    assert currents(ride(time=time)) == PLAIN


@pytest.mark.parametrize(
    "table",
    [
        lambda: pa.table({**ride(), "time [s]": pa.array(NS, pa.duration("ns"))}),
        lambda: pa.table(ride(current=pa.array(AMPERES).dictionary_encode())),
        lambda: pa.table(ride(current=pa.array([Decimal(str(a)) for a in AMPERES]))),
        lambda: pa.record_batch(ride()),
        lambda: pd.DataFrame(ride()).astype(pd.SparseDtype("float64", np.nan)),
        lambda: pd.DataFrame(ride()).set_index("time [s]", drop=False),
        lambda: pd.DataFrame(ride()).set_index("time [s]"),
        lambda: pd.DataFrame(ride()).set_index(pd.Index(STAMPS, name="time")).drop(columns="time [s]"),
        lambda: pd.DataFrame(ride()).convert_dtypes(dtype_backend="pyarrow"),
        lambda: pd.DataFrame(ride(current=pd.Categorical(AMPERES))),
    ],
)
def test_tables_of_any_type_are_the_same_ride(table: Callable[[], object]):
    assert currents(table()) == PLAIN


@pytest.mark.parametrize(
    "current",
    [
        pd.array([None, *AMPERES[1:]], dtype="Float64"),
        [pd.NA, *AMPERES[1:]],
        [pd.NaT, *AMPERES[1:]],
        pa.array([None, *AMPERES[1:]]),
        np.ma.masked_array(AMPERES, [True, *[False] * 7]),
    ],
    ids=lambda current: type(current).__name__,
)
def test_values_may_be_missing(current):
    assert currents(ride(current=current)) == PLAIN[1:]
    if not isinstance(current, pa.Array):
        assert currents(pd.DataFrame(ride(current=current))) == PLAIN[1:]


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        ({"current": ["--", *AMPERES[1:]]}, r"table:1: column 'pack_current' \[A\]: '--' is not a finite number"),
        ({"current": [1j] * 8}, r"table:1: column 'pack_current' \[A\]: 1j is not"),
        ({"current": [*AMPERES[1:], object()]}, r"table:8: column 'pack_current' \[A\]: <object.* is not"),
        ({"current": [10**400] * 8}, r"table:1: column 'pack_current' \[A\]: 10+\.\.\.0+ is not a finite number"),
        ({"current": NS.astype("timedelta64[ns]")}, r"table:1: column 'pack_current' \[A\]: .* is not a finite number"),
        ({"time": [10**400] * 8}, r"table:1: time \[s\]: 10+\.\.\.0+ is neither a number nor a time"),
        ({"time": [object()] * 8}, r"table:1: time \[s\]: <object.* is neither a number nor a time"),
        ({"time": [*STAMPS[:7], pd.NaT]}, r"table:8: time \[s\]: NaT is neither a number nor a time"),
    ],
)
def test_a_cell_that_is_none_is_named_with_column_and_row(columns, said):
    for data in (ride(**columns), pd.DataFrame({k: pd.Series(v, dtype=object) for k, v in ride(**columns).items()})):
        with pytest.raises(InputError, match=said):
            currents(data)


@pytest.mark.parametrize("as_table", [dict, pd.DataFrame, pa.table])
@pytest.mark.parametrize("date", ["12000-01-01T00:00:00", "-044-03-15T00:00:00"])
def test_a_date_of_no_calendar_is_named(as_table, date):
    times = (np.arange(8) + SINCE_1970).astype("M8[s]")
    times[5] = np.datetime64(date)
    data = {"time": times, "pack_current [A]": AMPERES}
    with pytest.raises(InputError, match=rf"table:6: column 'time': {date} is not a plausible time"):
        currents(as_table(data))


@pytest.mark.parametrize(
    "column", [pd.Series(SECONDS), pa.array(SECONDS), pa.chunked_array([SECONDS]), np.zeros((2, 2))]
)
def test_one_column_is_no_table(column):
    with pytest.raises(InputError, match=rf"table: {type(column).__name__} is no table of signals; give a dict"):
        currents(column)


# --- times that are rounded -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("as_table", [dict, pd.DataFrame, pa.table])
def test_times_that_are_rounded_to_minutes_are_refused(as_table):
    seconds = np.arange(3600) + 1.7e9
    data = {"time [s]": seconds.astype(np.float32), "pack_current [A]": np.full(3600, 14.0)}
    said = r"table: time \[s\]: 'pack_current' mostly has several values at one time, then none for 128 s: .*float32"
    with pytest.raises(InputError, match=said):
        currents(as_table(data))


def test_values_that_share_whole_seconds_or_have_a_row_each_are_a_ride():
    assert len(currents(ride(time=np.arange(8) // 4))) == 8
    each = ride(time=np.repeat(np.arange(4) * 2.0, 2), current=[1.0, None] * 4)
    each["speed [km/h]"] = [None, 36.0] * 4
    assert currents(each) == [(0.0, 1.0), (2.0, 1.0), (4.0, 1.0), (6.0, 1.0)]
