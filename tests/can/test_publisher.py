from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
from cantools.database.can import Database
from hypothesis import assume, given
from hypothesis import strategies as st

from gz_onboard.can.dbc import find_dbc, load_database
from gz_onboard.can.layout import crc8_sae_j1850
from gz_onboard.can.publisher import SIGMA, SOC, Counts, Publisher, reason_signal
from gz_onboard.errors import InputError
from gz_onboard.events import EFF_FLAG, Activity, Cause, Estimate, Reason, State

DATABASES = {name: load_database([find_dbc(name)]) for name in ("range.dbc", "range_large.dbc")}
DATABASE = DATABASES["range.dbc"]

# signal: (field of the estimate, SI units in one unit of the signal)
QUANTITIES = {
    "RANGE_Remaining": ("range", 1000.0),
    "RANGE_RemainingP10": ("range_p10", 1000.0),
    "RANGE_RemainingP90": ("range_p90", 1000.0),
    "RANGE_EnergyLeft": ("energy_left", 3600.0),
    "RANGE_ConsumptionRecent": ("consumption_recent", 3.6),
    "RANGE_ConsumptionExpected": ("consumption_expected", 3.6),
    SOC: ("soc", 0.01),
    SIGMA: ("soc_sd", 0.01),
    "RANGE_ArrivalStateOfCharge": ("arrival_soc", 0.01),
    "RANGE_ArrivalStateOfChargeP10": ("arrival_soc_p10", 0.01),
    "RANGE_RouteLeft": ("route_left", 1000.0),
    "RANGE_BatteryEndsAfter": ("battery_ends_after", 1000.0),
}


@cache
def database_of(file: Path) -> Database:
    return load_database([file])


def sent(publisher: Publisher, estimate: Estimate, counts: Counts = Counts()) -> dict[str, float | None]:  # noqa: B008
    """The signals of all frames as a receiver has them who knows the DBC only: None for the code not available."""
    values: dict[str, float | None] = {}
    database = database_of(publisher.file)
    for _, identifier, data, _ in publisher.range(estimate, counts, 0) + publisher.status(estimate, 0):
        message = database.get_message_by_frame_id(identifier & 0x1FFFFFFF)
        assert message.is_extended_frame == bool(identifier & EFF_FLAG)
        raw = message.decode_simple(data, decode_choices=False, scaling=False)
        scaled = message.decode_simple(data, decode_choices=False)
        for signal in message.signals:
            n = signal.length
            absent = n >= 8 and raw[signal.name] == (-(2 ** (n - 1)) if signal.is_signed else 2**n - 1)
            value = float(scaled[signal.name])  # type: ignore[arg-type]
            values[signal.name] = None if absent and not signal.name.endswith("CRC") else value
    return values


def signal_of(name: str, file: str = "range.dbc"):
    return next(s for m in DATABASES[file].messages for s in m.signals if s.name == name)


def sayable(name: str, value: float | None, file: str) -> bool:
    """Whether the signal can say `value` [in its unit], to half its resolution."""
    signal = signal_of(name, file)
    if value is None or not math.isfinite(value):
        return False
    slack = 0.5 * signal.scale
    return bool(signal.minimum - slack <= value <= signal.maximum + slack)


def on_the_edge(name: str, value: float | None, file: str) -> bool:
    """Whether `value` is between the last that can be said and the first that cannot, to the last digit."""
    signal = signal_of(name, file)
    ends = signal.minimum - 0.5 * signal.scale, signal.maximum + 0.5 * signal.scale
    return value is not None and any(math.isclose(value, end, rel_tol=1e-9) for end in ends)


numbers = st.one_of(st.none(), st.floats(-1e7, 1e7), st.floats(0, 2000), st.floats())
KNOWN = (State.VALID, State.DEGRADED)


@cache
def publisher_of(file: str) -> Publisher:
    return Publisher(find_dbc(file))


def check_what_is_sent(file: str, given_values: dict[str, float | None], state: State) -> None:
    """Each number to the nearest that its signal can say, or not at all; valid only with a whole range."""
    values = {name: None if (v := given_values[f]) is None else v / unit for name, (f, unit) in QUANTITIES.items()}
    assume(not any(on_the_edge(name, value, file) for name, value in values.items()))
    got = sent(publisher_of(file), Estimate(0.0, state, **given_values))  # type: ignore[arg-type]
    median, p10, p90 = (values[f"RANGE_Remaining{part}"] for part in ("", "P10", "P90"))
    ordered = None not in (median, p10, p90) and 0 <= p10 <= median <= p90  # type: ignore[operator]
    told = state in KNOWN and ordered and sayable("RANGE_Remaining", median, file)
    whole = told and sayable("RANGE_RemainingP90", p90, file)
    expected = state if state not in KNOWN or whole else State.DEGRADED if told else State.INVALID
    assert got["RANGE_EstimateState"] == got["RANGE_StatusState"] == expected
    there = {
        "RANGE_Remaining": told,
        "RANGE_RemainingP10": told,
        "RANGE_RemainingP90": whole,
        "RANGE_EnergyLeft": told,
        "RANGE_ConsumptionExpected": told,
        "RANGE_ConsumptionRecent": True,
        SOC: told and sayable(SIGMA, values[SIGMA], file),
        SIGMA: told and sayable(SOC, values[SOC], file),
        "RANGE_ArrivalStateOfCharge": told,
        "RANGE_ArrivalStateOfChargeP10": told,
        "RANGE_RouteLeft": told,
        "RANGE_BatteryEndsAfter": told,
    }
    for name, value in values.items():
        if there[name] and sayable(name, value, file):
            assert got[name] == pytest.approx(value, abs=0.5001 * signal_of(name, file).scale), name
        else:
            assert got[name] is None, name


@given(st.fixed_dictionaries({f: numbers for f, _ in QUANTITIES.values()}), st.sampled_from(State))
def test_a_number_is_sent_to_the_nearest_or_not_at_all(given_values, state):
    for file in DATABASES:
        check_what_is_sent(file, given_values, state)


@given(
    st.lists(st.floats(0, 1e7), min_size=3, max_size=3),
    st.fixed_dictionaries({f: numbers for f, _ in QUANTITIES.values() if not f.startswith("range")}),
    st.sampled_from(KNOWN),
)
def test_a_range_in_its_order_is_sent_to_the_nearest_or_not_at_all(ranges, others, state):
    for file in DATABASES:
        check_what_is_sent(
            file, dict(zip(("range_p10", "range", "range_p90"), sorted(ranges), strict=True)) | others, state
        )


CAR = Estimate(
    0.0,
    State.VALID,
    soc=0.8,
    soc_sd=0.02,
    range=400e3,
    range_p10=320e3,
    range_p90=500e3,
    energy_left=54_500 * 3600.0,
    consumption_recent=718 * 3.6,
    consumption_expected=136 * 3.6,
)


def test_a_car_by_the_large_file():
    got = sent(Publisher(find_dbc("range_large.dbc")), CAR)
    assert {name: got[name] for name in QUANTITIES} == pytest.approx(
        {
            "RANGE_Remaining": 400,
            "RANGE_RemainingP10": 320,
            "RANGE_RemainingP90": 500,
            "RANGE_EnergyLeft": 54_500,
            "RANGE_ConsumptionRecent": 718,
            "RANGE_ConsumptionExpected": 136,
            SOC: 80,
            SIGMA: 2,
            "RANGE_ArrivalStateOfCharge": None,
            "RANGE_ArrivalStateOfChargeP10": None,
            "RANGE_RouteLeft": None,
            "RANGE_BatteryEndsAfter": None,
        }
    )
    assert got["RANGE_EstimateState"] == State.VALID


@pytest.mark.parametrize(
    ("changes", "state"),
    [
        ({"range_p90": -300e3}, State.INVALID),
        ({"range": -1.0, "range_p10": -2.0}, State.INVALID),
        ({"range_p10": 401e3}, State.INVALID),
        ({"range": math.nan}, State.INVALID),
        ({"range_p10": None}, State.INVALID),
        ({"range": 700e3, "range_p90": 800e3}, State.INVALID),
        ({"range_p90": 700e3}, State.DEGRADED),  # the other two still say something
        ({"range_p90": math.inf}, State.DEGRADED),
    ],
)
def test_never_valid_without_a_range(changes, state):
    got = sent(Publisher(), replace(CAR, **changes))
    assert got["RANGE_EstimateState"] == got["RANGE_StatusState"] == state
    assert got["RANGE_RemainingP90"] is None
    assert (got["RANGE_Remaining"] is None) == (got["RANGE_RemainingP10"] is None) == (state is State.INVALID)


# --- another DBC file -------------------------------------------------------------------------------------------------


def test_the_large_file_differs_in_scale_and_identifier_only():
    for small, large in zip(*(database.messages for database in DATABASES.values()), strict=True):
        assert (small.name, small.comment, small.cycle_time) == (large.name, large.comment, large.cycle_time)
        assert large.frame_id == small.frame_id + 0x10  # who has the wrong file sees nothing, not a wrong number
        for ours, theirs in zip(small.signals, large.signals, strict=True):
            ratio = theirs.scale / ours.scale
            same = [(s.name, s.start, s.length, s.is_signed, s.unit, s.comment, s.choices) for s in (ours, theirs)]
            assert same[0] == same[1]
            assert ratio == pytest.approx({"Wh": 100, "Wh/km": 10, "km": 10}.get(ours.unit, 1))
            assert theirs.maximum == pytest.approx(ratio * ours.maximum)


TEXT = find_dbc("range.dbc").read_text(encoding="utf-8")


# As owners write them.
OWNERS = {
    "29 bits": TEXT.replace("1536", str(0x18FF6000 | 1 << 31)).replace("1537", str(0x18FF6100 | 1 << 31)),
    "other limits": TEXT.replace("[0|14]", "[0|15]").replace("[0|655.34]", "[0|0]").replace("[0|25.4]", "[0|20]"),
    "an offset": TEXT.replace("(0.1,0) [0|25.4]", "(0.2,-10) [0|40]"),
    "more in it": TEXT.replace("\nBO_ 1537", '\nBO_ 7 Brake: 2 DASH\n SG_ P : 0|8@1+ (1,0) [0|0] "" RANGE\n\nBO_ 1537'),
}
SCOOTER = replace(
    CAR,
    soc_sd=0.12,
    range=40e3,
    range_p10=32e3,
    range_p90=50e3,
    energy_left=1200 * 3600.0,
    consumption_recent=31 * 3.6,
    consumption_expected=30 * 3.6,
)


@pytest.mark.parametrize("text", OWNERS.values(), ids=OWNERS)
def test_an_owners_file(text, tmp_path):
    assert text != TEXT
    (tmp_path / "mine.dbc").write_text(text)
    publisher = Publisher(tmp_path / "mine.dbc")
    names = [s.name for m in DATABASE.messages for s in m.signals if not s.name.endswith(("CRC", "Counter"))]
    highest = 16 if "[0|15]" in text else 15
    for i in range(40):
        got, plain = sent(publisher, SCOOTER), sent(Publisher(), SCOOTER)
        assert {name: got[name] for name in names} == pytest.approx({name: plain[name] for name in names}, abs=0.1)
        assert got["RANGE_EnergyCounter"] == i % (15 if "[0|14]" in text else highest)
    for _, _, data, _ in publisher.range(SCOOTER, Counts(), 0) + publisher.status(SCOOTER, 0):
        assert crc8_sae_j1850(data[:7]) == data[7]


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("RANGE_EnergyLeft ", "RANGE_EnergyRemaining ", "message RANGE_Energy: has no signal RANGE_EnergyLeft"),
        ("RANGE_RemainingP90 ", "RANGE_RemainingP95 ", "did you mean 'RANGE_RemainingP95'"),
        ("BO_ 1540 RANGE_Sensors:", "BO_ 1540 RANGE_Sensor:", "has no message RANGE_Sensors, .*mean 'RANGE_Sensor'"),
        ("RANGE_Diagnosis: 8", "RANGE_Diagnosis: 12", "message RANGE_Diagnosis: must have 8 bytes.*has 12"),
        (
            "RANGE_EnergyCRC : 56|8",
            "RANGE_EnergyCRC : 56|7",
            r"signal RANGE_EnergyCRC is 56\|7@1\+ \"\", must be 56\|8@1\+ \"\"",
        ),
        ("EnergyLeft : 0|16@1+", "EnergyLeft : 7|16@0+", r"RANGE_EnergyLeft is 7\|16@0\+ \"Wh\", must be 0\|16@1\+"),
        ("EnergyLeft : 0|16", "EnergyLeft : 0|7", r"RANGE_EnergyLeft is 0\|7@1\+ \"Wh\", must be 0\|16"),
        (
            '(0.1,0) [0|6553.4] "Wh"',
            '(0.1,0) [0|6553.4] "kWh"',
            r"EnergyLeft is 0\|16@1\+ \"kWh\", must be 0\|16@1\+ \"Wh\"",
        ),
        ('(0.1,0) [0|6553.4] "Wh"', '(0.1,9) [9|6553.4] "Wh"', "RANGE_EnergyLeft must be able to say 0 Wh"),
        ('(0.01,0) [0|100] "%"', '(0.01,0) [0|99] "%"', "RANGE_StateOfCharge must be able to say 100 %"),
        ("RANGE_Activity : 44|4", "RANGE_Activity : 44|1", r"RANGE_Activity is 44\|1@1\+ .*must be 44\|4"),
        ("RANGE_Activity : 44|4@1+ (1,0)", "RANGE_Activity : 44|4@1+ (2,0)", "RANGE_Activity must hold .*scale 1"),
        ("44|4@1+ (1,0) [0|15]", "44|4@1+ (1,0) [0|3]", "RANGE_Activity must hold the whole numbers from 0 to 6"),
        ("RANGE_StatusCounter : 52|4", "RANGE_StatusCounter : 52|1", r"RANGE_StatusCounter is 52\|1.*must be 52\|4"),
        ("RANGE_EnergyLeft : 0|16", "RANGE_EnergyLeft m1 : 0|16", r"RANGE_EnergyLeft is multiplexed 0\|16"),
        ("RANGE_EnergyLeft : 0|16", "RANGE_EnergyLeft : 0|20", "mine.dbc.*RANGE_EnergyLeft"),  # overlaps the next
        ("BO_ 1540", "BO_ 1539", "identifier 0x603"),
        (
            " SG_ RANGE_EnergyCounter",
            ' SG_ Mine : 48|4@1- (1,0) [0|0] "" DASH\n SG_ RANGE_EnergyCounter',
            "signal Mine",
        ),
    ],
)
def test_a_file_that_cannot_be_sent_is_refused(old, new, told, tmp_path):
    assert old in TEXT
    text = TEXT.replace(old, new)
    if " m1 " in new:
        text = text.replace("RANGE_ConsumptionExpected :", "RANGE_ConsumptionExpected M :")
    (tmp_path / "mine.dbc").write_text(text)
    with pytest.raises(InputError, match=told) as caught:
        Publisher(tmp_path / "mine.dbc")
    assert str(caught.value).startswith(str(tmp_path / "mine.dbc"))


# --- counts, reasons, states, checks ----------------------------------------------------------------------------------


@given(st.integers(0, 2**16 - 1))
def test_each_reason_has_its_bit(bits):
    got = sent(Publisher(), Estimate(0.0, State.DEGRADED, Reason(bits)))
    for reason in Reason:
        assert got[reason_signal(reason)] == bool(bits & reason)


def test_a_distrusted_sensor_is_sent_by_name():
    estimate = Estimate(0.0, State.DEGRADED, Reason.SENSOR_DISTRUSTED, distrusted=("motor_speed", "gps_altitude"))
    got = sent(Publisher(), estimate)
    bad = {name for name, value in got.items() if name.startswith("RANGE_Bad") and value}
    assert bad == {"RANGE_BadMotorSpeed", "RANGE_BadGpsAltitude"}
    assert got["RANGE_SensorDistrusted"] == 1


def test_states_are_named_in_the_dbc_as_in_the_code():
    for name in ("RANGE_EstimateState", "RANGE_StatusState"):
        choices = {int(value): str(text).upper() for value, text in signal_of(name).choices.items()}
        assert choices == {state.value: state.name for state in State}
    choices = {int(value): str(text).upper() for value, text in signal_of("RANGE_Activity").choices.items()}
    assert choices == {activity.value: activity.name for activity in Activity}
    for name in ("RANGE_WhyCause1", "RANGE_WhyCause2"):
        choices = {int(value): str(text).upper() for value, text in signal_of(name).choices.items()}
        assert choices == {cause.value: cause.name for cause in Cause}
