"""Sensors checked against each other: the faulty one is found, and no other."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import cos, sin

import pytest

from gz_onboard.constants import GRAVITY
from gz_onboard.estimator.plausibility.electrical import CellError, PackSensors
from gz_onboard.estimator.plausibility.motion import GradeCheck, SpeedCheck
from gz_onboard.estimator.plausibility.residual import CONFIG, NO_SENSOR, LimitCheck, ResponseGain
from gz_onboard.events import ROLES
from gz_onboard.vehicle import read_vehicle
from tests.events import ShownSignals, faulty

RADIUS, GEAR, CAPACITY = 0.25, 0.5, 30.0  # m; wheel speed over motor speed; Ah
STEP = 0.1  # s
HONEST: Mapping[str, float] = {  # what each sensor says at 1 m/s
    "motor_speed": 1 / (RADIUS * GEAR),
    "wheel_speed_rear": 1 / RADIUS,
    "wheel_speed_front": 1 / RADIUS,
    "vehicle_speed": 1.0,
    "gps_speed": 1.0,
}
FOUR = ("motor_speed", "wheel_speed_rear", "wheel_speed_front", "gps_speed")
Fault = Callable[[float, float], float | None]
Each = Callable[[float, ShownSignals, SpeedCheck], None]


def town(t: float) -> float:
    """The true speed [m/s]: stops and goes."""
    return max(0.0, 7.0 + 6.0 * sin(t / 9.0))


def ridden(
    seconds: float,
    roles: tuple[str, ...],
    faults: Mapping[str, Fault],
    truth: Callable[[float], float] = town,
    before: tuple[SpeedCheck, ShownSignals] | None = None,
    begin: float = 0.0,
    each: Each = lambda t, signals, speeds: None,
    dt: float = STEP,
) -> tuple[SpeedCheck, ShownSignals]:
    """`seconds` of riding; a fault makes of (time [s], true value) what is reported, None being nothing; each: step."""
    if before:
        speeds, signals = before
    else:
        signals = ShownSignals(*ROLES)
        speeds = SpeedCheck(signals, RADIUS, GEAR, CAPACITY)
    for step in range(round(seconds / dt)):
        t = begin + step * dt
        shown = {role: truth(t) * HONEST[role] * (1 + 1e-4 * sin(7.3 * t)) for role in roles}
        signals.show(t, {role: faults[role](t, v) if role in faults else v for role, v in shown.items()})
        speeds.step(t, dt, gap=False)
        each(t, signals, speeds)
    return speeds, signals


FAULTS: dict[str, Fault] = {
    "stuck": lambda t, v: HONEST["motor_speed"] * 8,
    "zero": lambda t, v: 0.0,
    "doubled": lambda t, v: 2 * v,
    "halved": lambda t, v: v / 2,
    "backwards": lambda t, v: -v,
    "drifting": lambda t, v: v + 0.4 * t,
    "jumping": lambda t, v: v + (60.0 if t % 2 < 1 else 0.0),
    "full scale": lambda t, v: 500.0,
}


WINDOWS = pytest.mark.parametrize("dt", [STEP, 0.5])  # s: checks count seconds, not steps


@WINDOWS
@pytest.mark.parametrize("name", FAULTS)
@pytest.mark.parametrize("wrong_role", FOUR)
def test_one_of_four_that_is_wrong_is_named_and_left_out(wrong_role: str, name: str, dt: float):
    speeds, signals = ridden(60.0, FOUR, {wrong_role: FAULTS[name]}, dt=dt)
    assert faulty(speeds.sensors) == {wrong_role}
    assert not signals[wrong_role].trusted
    assert all(signals[role].trusted for role in FOUR if role != wrong_role)
    assert not speeds.disputed


@pytest.mark.parametrize("roles", [FOUR, FOUR[:3], ("motor_speed", "gps_speed"), ("motor_speed", "vehicle_speed")])
def test_no_sensor_is_faulty_that_errs_by_a_few_percent_or_is_late(roles: tuple[str, ...]):
    late: Fault = lambda t, v: town(t - 0.6) * 1.03 + 0.1 * sin(3 * t)  # noqa: E731
    speeds, _ = ridden(600.0, roles, {"motor_speed": lambda t, v: 1.05 * v, "gps_speed": late})
    assert faulty(speeds.sensors) == set()


@pytest.mark.parametrize("role", ["motor_speed", "wheel_speed_rear", "wheel_speed_front"])
def test_slip_and_a_locked_wheel_for_two_seconds_are_no_faults(role: str):
    faults: tuple[Fault, Fault] = (lambda t, v: 0.0 if t % 30 < 2 else v), (lambda t, v: 2 * v if t % 30 < 2 else v)
    for fault in faults:
        speeds, signals = ridden(120.0, FOUR, {role: fault})
        assert faulty(speeds.sensors) == set()
        assert signals[role].trusted


def test_a_roller_bench_and_a_spinning_wheel_are_no_faults():
    """Motor and rear wheel agree, front wheel and GPS stand: none of them can be shown to be faulty."""
    still: Fault = lambda t, v: 0.0  # noqa: E731
    for roles in (FOUR, FOUR[:3], (*FOUR, "vehicle_speed")):
        speeds, signals = ridden(300.0, roles, {"wheel_speed_front": still, "gps_speed": still})
        assert faulty(speeds.sensors) == set()
        assert signals.motor_speed.trusted


def test_of_two_that_disagree_the_stuck_one_is_faulty():
    for wrong_role in ("motor_speed", "gps_speed"):
        speeds, _ = ridden(60.0, ("motor_speed", "gps_speed"), {wrong_role: lambda t, v: 40.0})
        assert faulty(speeds.sensors) == {wrong_role}


def test_of_two_that_disagree_and_move_neither_is_believed():
    roles = ("motor_speed", "gps_speed")
    speeds, signals = ridden(60.0, roles, {"motor_speed": lambda t, v: 1.6 * v})
    assert faulty(speeds.sensors) == set(roles)
    assert speeds.disputed
    assert signals.motor_speed.mean is None
    assert signals.motor_speed.reported is not None


def test_forgiven_only_after_a_minute_of_agreement_about_something():
    before = ridden(60.0, FOUR, {"motor_speed": FAULTS["doubled"]})
    speeds, stands = before[0], lambda t: 0.0
    ridden(3 * CONFIG.recovered_after_s, FOUR, {}, stands, before, 60.0)
    assert faulty(speeds.sensors) == {"motor_speed"}, "standing, all agree that they stand"
    steady = lambda t: 9.0  # noqa: E731
    ridden(0.9 * CONFIG.recovered_after_s, FOUR, {}, steady, before, 300.0)
    assert faulty(speeds.sensors) == {"motor_speed"}
    ridden(0.2 * CONFIG.recovered_after_s, FOUR, {}, steady, before, 400.0)
    assert faulty(speeds.sensors) == set()


def test_a_gps_without_a_fix_does_not_count():
    signals = ShownSignals(*ROLES)
    speeds = SpeedCheck(signals, RADIUS, GEAR, CAPACITY)
    for step in range(300):
        t = step * STEP
        signals.show(t, {"motor_speed": 10 * HONEST["motor_speed"], "gps_speed": 0.0, "gps_fix": 0.0})
        speeds.step(t, STEP, gap=False)
    assert faulty(speeds.sensors) == set()


# --- a single speed and the odometer ------------------------------------------------------------------------------

Odometer = Callable[[float, float], float | None]


def named(odometer: Odometer, wheel: Callable[[float, float], float], seconds: float = 2400.0) -> set[str]:
    """Who is named. odometer: what it says of (time [s], distance [m]); None: nothing. wheel: of (time, speed)."""
    signals = ShownSignals(*ROLES)
    speeds = SpeedCheck(signals, RADIUS, GEAR, CAPACITY)
    distance, found = 0.0, set[str]()
    for i in range(round(seconds / STEP)):
        t = i * STEP
        distance += town(t) * STEP
        signals.show(t, {"wheel_speed_rear": wheel(t, town(t)) / RADIUS})
        told = odometer(t, distance)
        if i % 10 == 0 and told is not None:
            signals.odometer.value, signals.odometer.time = told, t
        speeds.step(t, STEP if i else 0.0, gap=False)
        found |= faulty(speeds.sensors)
    return found


def counting(step: float) -> Odometer:
    return lambda t, x: 1e6 + step * (x // step)


HEALTHY: dict[str, Odometer] = {
    "absent": lambda t, x: None,
    "zero": lambda t, x: 0.0,
    "constant": lambda t, x: 12_345_000.0,
    "metres": counting(1.0),
    "100 m": counting(100.0),
    "kilometres": counting(1000.0),
    "4 % more": lambda t, x: 100 * (1.04 * x // 100),
    "wraps": lambda t, x: 100 * (x // 100) % 3200,
    "reset": lambda t, x: 100 * ((x if t < 900 else x - 6000) // 100),
    "set forward": lambda t, x: 100 * ((x if t < 900 else x + 900) // 100),
    "set far forward": lambda t, x: 100 * ((x if t < 900 else x + 5e6) // 100),
    "silent for a while": lambda t, x: None if 600 < t < 800 else 100 * (x // 100),
    "stalls": lambda t, x: 100 * (min(x, 4000.0 + max(x - 9000, 0)) // 100),
    "kilometres as metres": lambda t, x: x // 100 / 10,
    "100 m as kilometres": lambda t, x: 10 * (x // 1),
}


@pytest.mark.parametrize("name", HEALTHY)
def test_no_odometer_accuses_a_speed_that_is_right(name):
    assert named(HEALTHY[name], lambda t, v: v) == set()


WRONG: dict[str, tuple[Callable[[float, float], float], set[str]]] = {
    "zero": (lambda t, v: 0.0 if t > 600 else v, set()),
    "stuck": (lambda t, v: 9.0 if t > 600 else v, set()),
    "doubled": (lambda t, v: 2 * v, {"odometer"}),
    "halved": (lambda t, v: v / 2, {"odometer"}),
}


@pytest.mark.parametrize("step", [1.0, 100.0])
@pytest.mark.parametrize("name", WRONG)
def test_a_lone_speed_that_contradicts_the_odometer_is_named(name, step):
    """Where both count and differ by a factor, nothing says which is right: both are named."""
    wheel, besides = WRONG[name]
    assert named(counting(step), wheel) == {"wheel_speed_rear"} | besides


# --- currents -----------------------------------------------------------------------------------------------------


def sag_of_a_cell() -> ResponseGain:
    return ResponseGain(CONFIG.sag_mean_s, CONFIG.settled_s, CONFIG.sag_least_v2s)


def test_a_current_that_moves_the_voltage_explains_it():
    right, stuck = sag_of_a_cell(), sag_of_a_cell()
    for step in range(3000):
        current = 40.0 * (1 + sin(step * STEP))
        right.update(STEP, 0.002 * current, 0.0014 * current)  # a cold cell, of which the file says too much
        stuck.update(STEP, 0.002 * current if step < 2000 else 0.08, 0.002 * current)
        if step == 1999:
            assert right.explained
            assert stuck.explained
    assert right.explained
    assert not stuck.explained


VEHICLE = read_vehicle("reference", 75.0)


def pack_sensors(
    roles: tuple[str, ...], error: CellError, road_power: Callable[[], float]
) -> tuple[PackSensors, ShownSignals]:
    signals = ShownSignals(*roles)
    return PackSensors(signals, VEHICLE.pack, VEHICLE.parameters, error, road_power), signals


REST_VOLTAGE, RESISTANCE, LOAD = 52.0, 0.066, 1.0  # V, ohm, A: of the pack, and of what is always on
ELECTRICAL = ("pack_current", "inverter_current", "auxiliary_current", "pack_voltage", "inverter_voltage")


def driven(
    dt: float, faults: Mapping[str, Fault], seconds: float = 120.0, resistance: float = RESISTANCE
) -> PackSensors:
    """Riding with full throttle and none; the faults begin after a minute. resistance: what the cell model believes."""
    series, rms, power = VEHICLE.pack.cells_series, 0.0, 0.0

    def error(volts: float, current: float, sensor: str) -> float:
        return (volts - REST_VOLTAGE + resistance * current) / series

    def road_power() -> float:
        return power

    check, signals = pack_sensors(ELECTRICAL, error, road_power)
    for step in range(round(seconds / dt)):
        t = step * dt
        inverter = 20.0 * (1 + sin(t)) if t % 40 < 30 else 0.0
        true = {"pack_current": inverter + LOAD, "inverter_current": inverter, "auxiliary_current": LOAD}
        voltage = REST_VOLTAGE - RESISTANCE * true["pack_current"]
        cable = VEHICLE.parameters["cable_resistance"] * true["pack_current"]
        true |= {"pack_voltage": voltage, "inverter_voltage": voltage - cable}
        signals.show(t, true | {role: fault(t, true[role]) for role, fault in faults.items() if t >= 60.0})
        power = voltage * true["pack_current"]
        reading = check.read(t, dt, 10.0 if inverter else 0.0, rms)
        used = signals.pack_current.value if reading.current is None else reading.current
        check.sag.update(dt, RESISTANCE * used / series, -voltage / series)
        rms += (abs(error(voltage, used, "")) - rms) * dt / 10.0
    return check


@WINDOWS
@pytest.mark.parametrize("resistance", [0.7 * RESISTANCE, RESISTANCE, 1.5 * RESISTANCE])
def test_healthy_electrical_sensors_are_believed_whatever_the_age_of_the_pack(dt: float, resistance: float):
    assert faulty(driven(dt, {}, 300.0, resistance).sensors) == NO_SENSOR


CURRENT_LIES: dict[str, Fault] = {
    "zero": lambda t, v: 0.0,
    "doubled": lambda t, v: 2 * v,
    "reversed": lambda t, v: -v,
    "5 A off": lambda t, v: v + 5.0,
}
VOLTAGE_LIES: dict[str, Fault] = {"zero": lambda t, v: 0.0, "low": lambda t, v: v - 3.0, "high": lambda t, v: v + 3.0}
ELECTRICAL_FAULTS: dict[str, tuple[str, Fault]] = {
    f"{role} {name}": (role, fault)
    for roles, lies in ((ELECTRICAL[:2], CURRENT_LIES), (ELECTRICAL[3:], VOLTAGE_LIES))
    for role in roles
    for name, fault in lies.items()
} | {"auxiliary_current 20 A off": ("auxiliary_current", lambda t, v: v + 20.0)}


@WINDOWS
@pytest.mark.parametrize("name", ELECTRICAL_FAULTS)
def test_a_wrong_electrical_sensor_is_named_and_no_other(name: str, dt: float):
    role, fault = ELECTRICAL_FAULTS[name]
    assert faulty(driven(dt, {role: fault}).sensors) == {role}


@WINDOWS
@pytest.mark.parametrize("name", ["zero", "doubled", "reversed"])
def test_currents_that_agree_on_a_lie_are_both_left_out(name: str, dt: float):
    both = dict.fromkeys(ELECTRICAL[:2], CURRENT_LIES[name])
    assert faulty(driven(dt, both).sensors) == set(both)


@pytest.mark.parametrize("roles", [("pack_current",), ("pack_current", "inverter_current")])
def test_a_current_that_cells_and_road_contradict_is_left_out(roles: tuple[str, ...]):
    """Only sensors that the vehicle has are named."""
    error: CellError = lambda voltage, current, sensor: -0.004 * (100.0 - current)  # noqa: E731
    check, signals = pack_sensors((*roles, "pack_voltage"), error, lambda: 5000.0)
    for step in range(600):
        t = step * STEP
        values = {"pack_current": -20.0, "inverter_current": -20.5, "pack_voltage": 50.0}
        signals.show(t, {role: values[role] for role in (*roles, "pack_voltage")})
        reading = check.read(t, STEP, 10.0, 0.1)
    assert reading.current is None
    assert faulty(check.sensors) == set(roles)


# --- grade --------------------------------------------------------------------------------------------------------

MASS, FORCE, WIND, MOUNTED = 200.0, 100.0, 25.0, 0.02  # kg; N that the level takes; N that nobody knows of; rad
GRADES = ("accel_x", "gps_altitude")


class Grades:
    """Limits and grades checked as the estimator does, for the speeds of `ridden` or for a motor speed that is set."""

    def __init__(self, signals: ShownSignals, speeds: SpeedCheck) -> None:
        self.signals, self.limits, self.speeds = signals, LimitCheck(signals), speeds
        self.check = GradeCheck(signals, speeds, self.limits.altitude, MASS, lambda v, a: v * (FORCE + MASS * a))
        speeds.roles, speeds.on_road = ("motor_speed",), True

    def step(self, t: float, dt: float, speed: float | None, work: float | None = None) -> None:
        self.limits.step(t, dt, speed)
        self.check.compare(t, dt, gap=False, power=work)

    @property
    def faulty(self) -> set[str]:
        return {sensor.role for sensor in (self.check.accelerometer, self.limits.altitude) if sensor.faulty}


def grade_check() -> Grades:
    signals = ShownSignals(*ROLES)
    return Grades(signals, SpeedCheck(signals, RADIUS, GEAR, CAPACITY))


def hills(
    seconds: float,
    faults: Mapping[str, Fault],
    roles: tuple[str, ...] = GRADES,
    power: bool = True,
    on_road: bool = True,
    begin: float = 300.0,
    dt: float = STEP,
) -> Grades:
    """Riding over hills of 4 %, stopping now and then; the faults begin at `begin` [s]."""
    grades = grade_check()
    signals, speeds = grades.signals, grades.speeds
    distance, before, height = 0.0, town(0.0), 200.0
    for step in range(round(seconds / dt)):
        t = step * dt
        speed = town(t)
        grade = 0.04 * cos(distance / 120.0)
        acceleration = (speed - before) / dt
        before = speed
        distance += speed * dt
        height += grade * speed * dt
        honest = {
            "accel_x": acceleration + GRAVITY * (grade + MOUNTED) + 0.1 * sin(77 * t),
            "gps_altitude": height + sin(t / 60),
        }
        shown = {role: faults[role](t - begin, v) if role in faults and t >= begin else v for role, v in honest.items()}
        signals.show(t, {role: shown[role] for role in roles})
        work = speed * (FORCE + WIND + MASS * (GRAVITY * grade + acceleration)) if power else None
        speeds.median, speeds.on_road, signals.motor_speed.time = speed, on_road, t
        grades.step(t, dt, speed, work)
    return grades


@WINDOWS
def test_hills_wind_and_a_tilted_accelerometer_are_no_faults(dt: float):
    for roles in (GRADES, GRADES[:1], GRADES[1:]):
        assert hills(1500.0, {}, roles, dt=dt).faulty == NO_SENSOR
        assert hills(1500.0, {}, roles, power=False, dt=dt).faulty == NO_SENSOR


@pytest.mark.parametrize("mounted", [-0.04, 0.02, 0.04])
def test_the_mounting_of_the_accelerometer_is_learned(monkeypatch: pytest.MonkeyPatch, mounted: float):
    monkeypatch.setattr("tests.estimator.test_plausibility.MOUNTED", mounted)
    grades = hills(1500.0, {})
    assert grades.faulty == NO_SENSOR
    assert grades.check.offset == pytest.approx(-mounted, abs=0.008)


GRADE_FAULTS: dict[str, tuple[str, Fault]] = {
    "climbs for ever": ("gps_altitude", lambda t, v: v + 1.0 * t),
    "climbs slowly": ("gps_altitude", lambda t, v: v + 0.3 * t),
    "sinks for ever": ("gps_altitude", lambda t, v: v - 1.0 * t),
    "is noise": ("gps_altitude", lambda t, v: v + 40 * sin(11 * t)),
    "full scale altitude": ("gps_altitude", lambda t, v: 6000.0),
    "+2 m/s²": ("accel_x", lambda t, v: v + 2.0),
    "-1 m/s²": ("accel_x", lambda t, v: v - 1.0),
    "doubled": ("accel_x", lambda t, v: 2 * v),
    "turned round": ("accel_x", lambda t, v: -v),
    "stuck": ("accel_x", lambda t, v: 0.3),
    "full scale": ("accel_x", lambda t, v: 60.0),
}


@WINDOWS
@pytest.mark.parametrize("name", GRADE_FAULTS)
def test_a_wrong_sensor_of_the_grade_is_named_by_the_energy(name: str, dt: float):
    role, fault = GRADE_FAULTS[name]
    assert hills(800.0, {role: fault}, dt=dt).faulty == {role}


def test_without_the_energy_neither_is_believed():
    role, fault = GRADE_FAULTS["climbs for ever"]
    assert hills(800.0, {role: fault}, power=False).faulty == set(GRADES)


def test_an_accelerometer_that_jumps_is_named_without_the_energy():
    """Its jump is no response to the acceleration of the wheels; the altitude is not named for what that explains."""
    role, fault = GRADE_FAULTS["+2 m/s²"]
    assert hills(800.0, {role: fault}, power=False).faulty == {role}


def test_a_single_witness_of_the_grade_is_held_against_the_energy():
    for name in ("climbs for ever", "sinks for ever", "+2 m/s²"):
        role, fault = GRADE_FAULTS[name]
        assert hills(800.0, {role: fault}, (role,)).faulty == {role}


def test_a_speed_that_comes_every_two_seconds_accuses_no_accelerometer():
    """Between two of its messages the held speed shows no acceleration, and the accelerometer does."""
    grades = grade_check()
    signals, speeds = grades.signals, grades.speeds
    for step in range(1200):
        t = step * STEP
        acceleration = (town(t) - town(t - STEP)) / STEP
        signals.show(t, {"accel_x": acceleration + 0.1 * sin(77 * t)})
        if step % 20 == 0:
            speeds.median, signals.motor_speed.time = town(t), t
        grades.step(t, STEP, speeds.median)
    assert not grades.faulty
