"""Signals that are none: not available, beyond their physical range, no number."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from gz_onboard.can.codec import NOT_AVAILABLE
from gz_onboard.events import Reason
from gz_onboard.vehicle import Vehicle, read_vehicle
from tests.faults.support import BEGIN, END, absent, check_all, ride, spoilt
from tests.support import ROOT, S, identifier, reference, ridden

MESSAGES = sorted({source.message for source in reference().mapping.sources})


@pytest.mark.parametrize("message", MESSAGES)
def test_not_available_is_never_a_number(message: str):
    """All the signals of a message that have a code for it, at once."""
    definition = reference().mapping.database.get_message_by_name(message)
    mapped = [s.signal for s in reference().mapping.sources if s.message == message]
    signals = [name for name in mapped if definition.get_signal_by_name(name).length >= 8]
    run = ridden(spoilt(absent(message, *signals)))
    check_all(run, soc=0.004, range_=0.04)
    sent = sum(f[1] == identifier(message) and BEGIN * S <= f[0] - ride()[0][0] < END * S for f in ride())
    assert all(run.faults.get((f"{message}.{signal}", NOT_AVAILABLE), 0) >= sent > 0 for signal in signals)
    assert run.pipeline.counts().dropped == 0  # the frames themselves are good


FLOATS = """VERSION "1"
NS_ :
BS_:
BU_: A
BO_ 528 FLOAT_Pack: 8 A
 SG_ FLOAT_Voltage : 0|32@1- (1,0) [0|100] "V" A
 SG_ FLOAT_Current : 32|32@1- (1,0) [-300|300] "A" A
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_ "GenMsgCycleTime" BO_ 528 100;
SIG_VALTYPE_ 528 FLOAT_Voltage : 1;
SIG_VALTYPE_ 528 FLOAT_Current : 1;
"""


@pytest.fixture(scope="module")
def float_vehicle(tmp_path_factory: pytest.TempPathFactory) -> Vehicle:
    """The reference scooter, but its pack's voltage and current are floating-point numbers."""
    folder: Path = tmp_path_factory.mktemp("floats")
    (folder / "floats.dbc").write_text(FLOATS)
    text = (ROOT / "gz_onboard" / "vehicles" / "reference.toml").read_text(encoding="utf-8")
    text = text.replace('"hbm.dbc"]', '"hbm.dbc", "floats.dbc"]')
    text = text.replace('pack_voltage = "BMS_PackVoltage"', 'pack_voltage = "FLOAT_Voltage"')
    text = text.replace('pack_current = "BMS_PackCurrent"', 'pack_current = "FLOAT_Current"')
    (folder / "floats.toml").write_text(text, encoding="utf-8")
    return read_vehicle(str(folder / "floats.toml"))


NAN, INFINITE = float("nan"), float("inf")


@pytest.mark.parametrize("value", [NAN, -NAN, INFINITE, -INFINITE, 3e38, -1e6])
@pytest.mark.parametrize("role", ["voltage", "current"])
def test_a_floating_point_signal_that_is_no_number(float_vehicle: Vehicle, value: float, role: str):
    first, pack = ride()[0][0], identifier("BMS_Pack")
    frames = []
    for frame in ride():
        time_ns, can_id, data, channel = frame
        if can_id == pack:
            volts, amperes = (x / 100 for x in struct.unpack("<Hh", data[:4]))
            if BEGIN * S <= time_ns - first < END * S:
                volts, amperes = (value, amperes) if role == "voltage" else (volts, value)
            frames.append((time_ns, 528, struct.pack("<ff", volts, amperes), channel))
        else:
            frames.append(frame)
    run = ridden(frames, float_vehicle)
    check_all(run, soc=0.003, range_=0.03)
    missing = Reason.NO_PACK_VOLTAGE if role == "voltage" else Reason.NO_PACK_CURRENT
    assert all(e.reasons & missing for e in run.between(BEGIN + 1.5, END))
    name = f"FLOAT_Pack.FLOAT_{role.capitalize()}"
    assert sum(n for (what, _), n in run.faults.items() if what == name) == pytest.approx(10 * (END - BEGIN), abs=2)
