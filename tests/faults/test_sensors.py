"""Sensors that are missing: told, counted into the interval, stood in for by others, and back again."""

from __future__ import annotations

import pytest

from gz_onboard.events import Reason, State
from tests.faults.support import (
    BEGIN,
    END,
    RIDE,
    USUAL,
    Spoil,
    absent,
    both,
    check_all,
    numbers,
    of,
    spoilt,
    unspoilt,
    without,
)
from tests.support import changed, check_frames, check_sound, reasons_in, ridden, spread

SPEEDS = both(
    absent("INV_Motion", "INV_MotorSpeed"), without("HBM_Wheels"), absent("GPS_Motion", "GPS_Speed", "GPS_Course")
)
CURRENTS = both(absent("BMS_Pack", "BMS_PackCurrent"), absent("INV_Power", "INV_DcCurrent"))
VOLTAGES = both(absent("BMS_Pack", "BMS_PackVoltage"), absent("INV_Power", "INV_DcVoltage"))
# What is lost, the reason that is given, after how long [s], what widens, and by how much SOC and range may differ:
# over the first kilometre the range shown follows each forecast closely, and what is not learned meanwhile shows.
LOSSES: dict[str, tuple[Spoil, Reason, float, str, float, float]] = {
    "imu": (without("IMU_Acceleration", "IMU_AngularRate"), Reason.NO_IMU, 0.3, "range", 0.0005, 0.04),
    "gps": (without("GPS_Position", "GPS_Motion"), Reason.NO_GPS, 2.3, "range", 0.0005, 0.03),
    "cells": (without("BMS_Cells"), Reason.NO_CELL_TEMPERATURE, 10.3, "range", 0.001, 0.01),
    "ambient": (without("TC_Ambient"), Reason.NO_AMBIENT_TEMPERATURE, 10.3, "range", 0.0005, 0.03),
    "pack current": (absent("BMS_Pack", "BMS_PackCurrent"), Reason.NO_PACK_CURRENT, 1.3, "both", 0.001, 0.03),
    "inverter current": (absent("INV_Power", "INV_DcCurrent"), Reason.NO_INVERTER_CURRENT, 1.3, "soc", 0.0005, 0.03),
    "currents": (CURRENTS, Reason.NO_PACK_CURRENT | Reason.NO_INVERTER_CURRENT, 1.3, "both", 0.006, 0.06),
    "pack voltage": (absent("BMS_Pack", "BMS_PackVoltage"), Reason.NO_PACK_VOLTAGE, 1.3, "both", 0.001, 0.03),
    "voltages": (VOLTAGES, Reason.NO_PACK_VOLTAGE, 1.3, "both", 0.002, 0.06),
    "pack": (without("BMS_Pack"), Reason.NO_PACK_VOLTAGE | Reason.NO_PACK_CURRENT, 1.3, "both", 0.001, 0.03),
    "speeds": (SPEEDS, Reason.NO_SPEED, 2.3, "range", 0.0005, 0.06),
}


@pytest.mark.parametrize("name", LOSSES)
def test_a_lost_sensor_is_told_widens_the_interval_and_comes_back(name: str):
    spoil, reason, delay, widens, soc, range_ = LOSSES[name]
    run = ridden(spoilt(spoil))
    check_all(run, soc, range_)
    healthy = unspoilt()
    before, lost, after = run.between(5.0, BEGIN), run.between(BEGIN + delay, END), run.between(END + 2.3, RIDE)
    assert not reasons_in(before) & reason
    assert all(e.reasons & reason == reason and e.state is State.DEGRADED for e in lost)
    # With a current from the model alone the cell's voltage may not be what is expected: it is told, too.
    others = reasons_in(lost) & ~reason & ~USUAL & ~(Reason.VOLTAGE_MISMATCH if name == "currents" else Reason(0))
    assert not others, f"{others} is given too"
    assert not reasons_in(after) & reason
    assert {e.state for e in after} == {State.VALID}
    a, b = run.at(END), healthy.at(END)
    if widens in ("soc", "both"):
        assert numbers(a)[1] > numbers(b)[1], "the SOC is said to be as certain as before"
    if widens in ("range", "both"):
        assert spread(a) > spread(b) * 1.001, "the range is said to be as certain as before"
        # The sensor is back, and with it the certainty, but for what could not be learned meanwhile.
        as_before = max(spread(healthy.at(BEGIN)), spread(healthy.at(RIDE)))
        assert spread(run.at(RIDE)) < as_before + 0.01


@pytest.mark.parametrize(
    ("spoil", "tolerance"),
    [
        (absent("INV_Motion", "INV_MotorSpeed"), 0.6),
        (both(absent("INV_Motion", "INV_MotorSpeed"), absent("HBM_Wheels", "HBM_WheelSpeedRear")), 0.6),
        (both(without("INV_Motion"), without("HBM_Wheels")), 1.5),
    ],
    ids=["rear wheel", "front wheel", "gps"],
)
def test_another_speed_stands_in_for_the_motors(spoil: Spoil, tolerance: float):
    run = ridden(spoilt(spoil))
    check_all(run, 0.0005, 0.03)
    for a, b in zip(run.between(BEGIN + 0.3, END), unspoilt().between(BEGIN + 0.3, END), strict=True):
        assert a.speed is not None
        assert b.speed is not None
        assert abs(a.speed - b.speed) < tolerance
        assert not a.reasons & Reason.NO_SPEED
    assert run.at(RIDE).distance == pytest.approx(unspoilt().at(RIDE).distance, rel=0.01)


def test_a_sensor_that_lies_goes_onto_the_bus_by_name():
    run = ridden(spoilt(of("INV_Motion", lambda frame: changed(frame, INV_MotorSpeed=6000))))
    check_sound(run)
    sent = check_frames(run.sent)
    assert sent["RANGE_Sensors"][-1]["RANGE_BadMotorSpeed"] == 1
    assert sum(value for name, value in sent["RANGE_Sensors"][-1].items() if "Bad" in name) == 1
    assert sent["RANGE_Status"][-1]["RANGE_SensorDistrusted"] == 1
