from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gz_onboard.bus.checksum import crc8_sae_j1850
from gz_onboard.bus.codec import Codec
from gz_onboard.bus.mapping import find_dbc, load_database, read_mapping
from gz_onboard.bus.publisher import Counts, Publisher, reason_signal, sensor_signal
from gz_onboard.events import ROLES, TRANSMITTED, Activity, Estimate, Reason, State
from gz_onboard.toml import Table

DATABASE = load_database([find_dbc("range.dbc")])

# signal: (field of the estimate, SI units in one unit of the signal)
QUANTITIES = {
    "RANGE_Remaining": ("range", 1000.0),
    "RANGE_RemainingP10": ("range_p10", 1000.0),
    "RANGE_RemainingP90": ("range_p90", 1000.0),
    "RANGE_EnergyLeft": ("energy_left", 3600.0),
    "RANGE_ConsumptionRecent": ("consumption_recent", 3.6),
    "RANGE_ConsumptionExpected": ("consumption_expected", 3.6),
    "RANGE_StateOfCharge": ("soc", 0.01),
    "RANGE_StateOfChargeSigma": ("soc_sd", 0.01),
}
COUNTS = {
    "RANGE_CountDropped": "dropped",
    "RANGE_CountImplausible": "implausible",
    "RANGE_CountLost": "lost",
    "RANGE_CountUnknown": "unknown",
}


def sent(publisher: Publisher, estimate: Estimate, counts: Counts = Counts()) -> dict[str, float | None]:  # noqa: B008
    """The signals of all frames as a receiver has them who knows range.dbc only: None for the code not available."""
    values: dict[str, float | None] = {}
    for _, identifier, data, _ in publisher.range(estimate, counts, 0) + publisher.status(estimate, 0):
        message = DATABASE.get_message_by_frame_id(identifier)
        raw = message.decode_simple(data, decode_choices=False, scaling=False)
        scaled = message.decode_simple(data, decode_choices=False)
        for signal in message.signals:
            n = signal.length
            absent = n >= 8 and raw[signal.name] == (-(2 ** (n - 1)) if signal.is_signed else 2**n - 1)
            value = float(scaled[signal.name])  # type: ignore[arg-type]
            values[signal.name] = None if absent and not signal.name.endswith("CRC") else value
    return values


def signal_of(name: str):
    return next(s for m in DATABASE.messages for s in m.signals if s.name == name)


numbers = st.one_of(st.none(), st.floats(-1e7, 1e7), st.floats())


@given(st.fixed_dictionaries({field: numbers for field, _ in QUANTITIES.values()}), st.sampled_from(State))
def test_what_is_sent_is_the_nearest_that_the_signal_can_say(given_values, state):
    got = sent(Publisher(), Estimate(0.0, state, **given_values))
    for name, (field, unit) in QUANTITIES.items():
        signal = signal_of(name)
        value = given_values[field]
        published = state in (State.VALID, State.DEGRADED) or name == "RANGE_ConsumptionRecent"
        if value is None or not math.isfinite(value) or not published or abs(value) > 1e14:
            # not known, and never a number; what is absurd may be either
            assert got[name] is None or (value is not None and math.isfinite(value) and abs(value) > 1e14)
        else:
            want = min(max(value / unit, signal.minimum), signal.maximum)
            assert got[name] == pytest.approx(want, abs=0.5001 * signal.scale), name
    assert got["RANGE_EstimateState"] == got["RANGE_StatusState"] == state


@given(st.fixed_dictionaries({field: st.integers(0, 10**9) for field in COUNTS.values()}))
def test_counts_stay_at_their_greatest(counts):
    got = sent(Publisher(), Estimate(0.0), Counts(**counts))
    for name, field in COUNTS.items():
        assert got[name] == min(counts[field], signal_of(name).maximum)


@given(st.integers(0, 2**16 - 1))
def test_each_reason_has_its_bit(bits):
    got = sent(Publisher(), Estimate(0.0, State.DEGRADED, Reason(bits)))
    for reason in Reason:
        assert got[reason_signal(reason)] == bool(bits & reason)


def test_reasons_and_sensors_stand_in_the_dbc_in_their_order():
    message = DATABASE.get_message_by_name("RANGE_Status")
    starts = [message.get_signal_by_name(reason_signal(reason)).start for reason in Reason]
    assert starts == sorted(set(starts))
    sensors = [s.name for s in DATABASE.get_message_by_name("RANGE_Sensors").signals if s.length == 1]
    assert sensors == [name for role in ROLES if (name := sensor_signal(role)) in sensors]


def test_a_distrusted_sensor_is_sent_by_name():
    estimate = Estimate(0.0, State.DEGRADED, Reason.SENSOR_DISTRUSTED, distrusted=("motor_speed", "gps_altitude"))
    publisher = Publisher()
    frames = publisher.range(estimate, Counts(), 0) + publisher.status(estimate, 0)
    decoded: dict[str, Any] = {}
    for _, identifier, data, _ in frames:
        decoded.update(DATABASE.get_message_by_frame_id(identifier).decode_simple(data, decode_choices=False))
    assert {name for name, value in decoded.items() if name.startswith("RANGE_Bad") and value} == {
        "RANGE_BadMotorSpeed", "RANGE_BadGpsAltitude",
    }  # fmt: skip
    assert decoded["RANGE_SensorDistrusted"] == 1


def test_states_are_named_in_the_dbc_as_in_the_code():
    for name in ("RANGE_EstimateState", "RANGE_StatusState"):
        choices = {int(value): str(text).upper() for value, text in signal_of(name).choices.items()}
        assert choices == {state.value: state.name for state in State}
    choices = {int(value): str(text).upper() for value, text in signal_of("RANGE_Activity").choices.items()}
    assert choices == {activity.value: activity.name for activity in Activity}


def test_counters_and_checksums_as_a_receiver_checks_them():
    publisher = Publisher()
    estimate = Estimate(0.0, State.VALID, soc=0.5, range=20e3)
    counters: dict[int, list[int]] = {}
    for i in range(40):
        frames = publisher.range(estimate, Counts(), i) + publisher.status(estimate, i, channel=1)
        assert [f[3] for f in frames] == [TRANSMITTED] * 4 + [1 | TRANSMITTED]
        for time_ns, identifier, data, _ in frames:
            assert time_ns == i
            assert len(data) == 8
            assert crc8_sae_j1850(data[:7]) == data[7]
            counters.setdefault(identifier, []).append(data[6] >> 4)
    assert set(counters) == {m.frame_id for m in DATABASE.messages}
    assert all(seen == [i % 15 for i in range(40)] for seen in counters.values())


def test_our_own_codec_takes_what_we_send(tmp_path: Path):
    """The same rules on both sides: what goes out could come in."""
    messages = {name: re.sub("RANGE_", "", name) for name in ("RANGE_Estimate", "RANGE_Energy", "RANGE_Status")}
    protection = "".join(
        f'[bus.messages.{m}]\ncrc = "RANGE_{p}CRC"\ncounter = "RANGE_{p}Counter"\n' for m, p in messages.items()
    )
    roles = 'odometer = "RANGE_Remaining"\nbms_state_of_charge = "RANGE_StateOfCharge"\n'
    (tmp_path / "v.toml").write_text(f'dbc = ["range.dbc"]\n{protection}[roles]\n{roles}')
    codec = Codec(read_mapping(Table.read(tmp_path / "v.toml")))
    publisher = Publisher()
    frames = []
    for i in range(100):
        estimate = Estimate(0.0, State.VALID, soc=i / 100, range=300.0 * i)
        frames += publisher.status(estimate, i * 100_000_000)
        if i % 10 == 0:
            frames += publisher.range(estimate, Counts(), i * 100_000_000)
    events = codec.decode(frames)
    assert not codec.faults and not codec.lost and not codec.unknown
    by_role: dict[str, list[float | None]] = {}
    for _, group, values in events:
        by_role.setdefault(codec.groups[group].roles[0], []).append(values[0])
    assert by_role["bms_state_of_charge"] == pytest.approx([i / 100 for i in range(100)])
    assert by_role["odometer"] == pytest.approx([300.0 * i for i in range(0, 100, 10)])
