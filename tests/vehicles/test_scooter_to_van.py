"""From a kick scooter to a van: a DBC and a TOML of what the owner knows, driven by a physics of its own.

What the owner does not know (losses of the motor and the inverter, noises, heat) is left out of the TOML: it follows
from what he knows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from math import log, pi
from pathlib import Path

import pytest
from cantools.database.can import Database

from gz_onboard.constants import DECILE
from gz_onboard.estimator.forecast import Forecaster
from gz_onboard.events import WINDOW, Estimate, Frame, Reason, State
from gz_onboard.pipeline import Pipeline
from gz_onboard.vehicle import Vehicle, read_vehicle
from tests.support import ROOT

STEP = 0.1  # s
GRAVITY, AIR = 9.81, 1.2  # m/s², kg/m³
Points = tuple[tuple[float, float], ...]
OCV: Points = ((0.0, 3.0), (0.1, 3.45), (0.2, 3.55), (0.5, 3.7), (0.8, 3.96), (1.0, 4.18))  # V over SOC

DBC = """VERSION ""
NS_ :
BS_:
BU_: CAR
BO_ 256 Battery: 8 CAR
 SG_ Voltage : 0|16@1+ (0.02,0) [0|1000] "V" CAR
 SG_ Current : 16|16@1- (0.05,0) [-1600|1600] "A" CAR
 SG_ Cells : 32|8@1+ (1,-40) [-40|100] "degC" CAR
 SG_ Outside : 40|8@1+ (1,-40) [-40|60] "degC" CAR
BO_ 257 Drive: 8 CAR
 SG_ Speed : 0|16@1+ (0.01,0) [0|300] "km/h" CAR
 SG_ Motor : 16|16@1- (1,0) [-20000|20000] "rpm" CAR
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 100000;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_ "GenMsgCycleTime" BO_ 256 100;
BA_ "GenMsgCycleTime" BO_ 257 100;
"""

TOML = """schema = 1
name = "{name}"
dbc = ["bus.dbc"]
{tables}
[roles]
pack_voltage = "Voltage"
pack_current = "Current"
cell_temperature = "Cells"
ambient_temperature = "Outside"
vehicle_speed = "Speed"
motor_speed = "Motor"
[parameters]
vehicle_mass = {{ value = {mass}, unit = "kg", sd = 5.0, status = "data sheet", source = "plate" }}
payload_mass = {{ value = {payload}, unit = "kg", sd = 5.0, status = "guess", source = "driver" }}
wheel_radius = {{ value = {radius}, unit = "m", sd = 0.002, status = "data sheet", source = "tyre" }}
gear_ratio = {{ value = {gear}, unit = "1", sd = 0.0, status = "data sheet", source = "gearbox" }}
drag_area = {{ value = {drag}, unit = "m²", sd = 0.05, status = "guess", source = "its like" }}
rolling_resistance_constant = {{ value = 0.011, unit = "1", sd = 0.002, status = "guess", source = "its like" }}
cell_capacity = {{ value = {capacity}, unit = "A·h", sd = {capacity_sd}, status = "data sheet", source = "cell" }}
cell_cutoff_voltage = {{ value = 3.0, unit = "V", sd = 0.05, status = "data sheet", source = "cell" }}
[battery]
cells_series = {series}
cells_parallel = {parallel}
as_new = 0.9
[battery.ocv]
soc = {socs}
value = {volts}
unit = "V"
sd = 0.01
[battery.r0]
soc = [0.0, 1.0]
temperature = [25.0]
value = [[{r0}, {r0}]]
unit = "ohm"
[battery.r1]
soc = [0.0, 1.0]
temperature = [25.0]
value = [[{r1}, {r1}]]
unit = "ohm"
[battery.c1]
soc = [0.0, 1.0]
temperature = [25.0]
value = [[{c1}, {c1}]]
unit = "F"
"""


@dataclass(frozen=True)
class Build:
    """What the owner knows; and how it is driven."""

    name: str
    mass: float  # kg
    payload: float
    radius: float  # m
    gear: float  # wheel over motor speed
    drag: float  # m²
    series: int
    parallel: int
    capacity: float  # A·h of a cell
    auxiliary: float  # W, which the owner does not know
    cruise: float  # m/s
    tables: str = ""

    def energy(self, soc: float) -> float:
        """J that come out slowly from `soc` on."""
        points = [*(p for p in OCV if p[0] < soc), (soc, cell(self).rest(soc))]
        volts = sum((u0 + u1) / 2 * (s1 - s0) for (s0, u0), (s1, u1) in pairwise(points))
        return volts * self.series * self.parallel * self.capacity * 3600


SLOW = "forecast = { unevenness = 1.0, riding = [[0.1, 0, 0], [0.05, 3, 0.9], [0.05, 3, -0.9], [0.8, 5.5, 0]] }"
LARGE = 'range_dbc = "range_large.dbc"'
BUILDS = {
    build.name: build
    for build in (
        Build("kick-scooter", 12.0, 75.0, 0.108, 1.0, 0.55, 7, 1, 4.0, 3.0, 5.5, SLOW),
        Build("moped", 50.0, 80.0, 0.22, 1.0, 0.55, 13, 4, 3.4, 15.0, 11.0),
        Build("motorcycle", 250.0, 80.0, 0.31, 1 / 5.0, 0.6, 28, 1, 100.0, 100.0, 22.0, LARGE),
        Build("car", 1600.0, 80.0, 0.31, 1 / 9.7, 0.65, 96, 1, 150.0, 400.0, 22.0, LARGE),
        Build("van", 3000.0, 500.0, 0.35, 1 / 12.0, 1.9, 192, 1, 170.0, 600.0, 20.0, LARGE),
    )
}


@dataclass(frozen=True)
class Cell:
    """One cell: rest voltage over SOC, R0 and R1 [ohm], and how fast it relaxes [s]."""

    ocv: Points
    r0: float
    r1: float
    relaxation: float

    def rest(self, soc: float) -> float:
        """V."""
        (s0, u0), (s1, u1) = next((a, b) for a, b in pairwise(self.ocv) if soc <= b[0])
        return u0 + (soc - s0) * (u1 - u0) / (s1 - s0)


def cell(build: Build) -> Cell:
    """A drop of 6 % at 1 C, and 20 s."""
    return Cell(OCV, 0.1 / build.capacity, 0.04 / build.capacity, 20.0)


def write(folder: Path, build: Build) -> Path:
    r0, r1, c1 = cell(build).r0, cell(build).r1, cell(build).relaxation / cell(build).r1
    values = vars(build) | {"socs": [s for s, _ in OCV], "volts": [v for _, v in OCV], "r0": r0, "r1": r1, "c1": c1}
    (folder / "bus.dbc").write_text(DBC, encoding="utf-8")
    file = folder / f"{build.name}.toml"
    file.write_text(TOML.format(**values, capacity_sd=0.02 * build.capacity), encoding="utf-8")
    return file


def speeds(build: Build, duration: float) -> Iterator[float]:
    """Start at 0.9 m/s², cruise, brake at 1.1 m/s², stand: 400 m or so each."""
    yield from (0.0 for _ in range(round(20 / STEP)))
    time, v = 20.0, 0.0
    while time < duration:
        for target, rate, hold in ((build.cruise, 0.9, 400.0 / build.cruise), (0.0, -1.1, 8.0)):
            while (target - v) * rate > 0:
                v = min(v + rate * STEP, target) if rate > 0 else max(v + rate * STEP, 0.0)
                time += STEP
                yield v
            for _ in range(round(hold / STEP)):
                time += STEP
                yield v


@dataclass
class Truth:
    """What happened."""

    soc: float
    energy: float = 0.0  # J
    distance: float = 0.0  # m


def encode(database: Database, name: str, **values: float) -> bytes:
    return database.encode_message(name, values, padding=True)


def driven(
    build: Build, truth: Truth, duration: float, cell: Cell, efficiency: float = 0.9
) -> Iterator[tuple[int, float, float, float]]:
    """(time [ns], speed [m/s], voltage, current of the pack) of a drive: road load over an efficiency, an RC cell."""
    mass, v1, before = build.mass + build.payload, 0.0, 0.0
    for i, v in enumerate(speeds(build, duration)):
        mean, a = (v + before) / 2, (v - before) / STEP
        before = v
        force = mass * a + (0.011 * mass * GRAVITY + 0.5 * AIR * build.drag * mean * mean) * (mean > 0)
        wheel = force * mean
        power = build.auxiliary + (wheel / efficiency if wheel > 0 else 0.5 * wheel)
        inside, source = build.series * cell.r0 / build.parallel, build.series * (cell.rest(truth.soc) - v1)
        current = (source - (source * source - 4 * inside * power) ** 0.5) / (2 * inside)
        volts = source - inside * current
        truth.soc -= current / build.parallel * STEP / 3600 / build.capacity
        v1 += STEP / cell.relaxation * (cell.r1 * current / build.parallel - v1)
        truth.energy += volts * current * STEP
        truth.distance += mean * STEP
        yield round(i * STEP * 1e9), v, volts, current


def drive(build: Build, database: Database, truth: Truth, duration: float) -> Iterator[list[Frame]]:
    """The frames of a drive; what they say, they say as the DBC can."""
    for ns, v, volts, current in driven(build, truth, duration, cell(build)):
        battery = encode(database, "Battery", Voltage=volts, Current=current, Cells=25.0, Outside=20.0)
        rpm = v / build.radius / build.gear * 60 / (2 * pi)
        yield [(ns, 256, battery, 0), (ns + 1, 257, encode(database, "Drive", Speed=3.6 * v, Motor=rpm), 0)]


@pytest.fixture
def vehicle(request: pytest.FixtureRequest, tmp_path: Path) -> Vehicle:
    file = write(tmp_path, BUILDS[request.param])
    return read_vehicle(str(file))


@pytest.mark.parametrize(
    ("vehicle", "fast"), [("motorcycle", 33.0), ("car", 36.0), ("van", 33.0)], indirect=["vehicle"]
)
def test_before_anything_is_ridden_the_interval_holds_towns_and_motorways(vehicle, fast):
    """Where the vehicle file has no riding to expect; a motorcycle is not ridden as a scooter is."""
    build, forecaster = BUILDS[vehicle.name], Forecaster(vehicle.model, vehicle.pack, vehicle.riding)
    prior = forecaster.forecast(1.0, 0.01, 25.0, 1.0, 20.0, 0.0)
    mass = build.mass + build.payload
    for speed, stops in (11.0, 1e-3), (fast, 0.0):  # per metre; each costs half of what moved
        force = 0.011 * mass * GRAVITY + (0.5 * AIR * build.drag + 0.25 * mass * stops) * speed * speed
        assert prior.p10 < prior.energy / (force / 0.9 + build.auxiliary / speed) < prior.p90


def test_a_slow_vehicle_is_expected_to_be_ridden_slowly(tmp_path):
    file = tmp_path / "slow.toml"
    text = (ROOT / "tests/vehicles/lfp.toml").read_text(encoding="utf-8")
    file.write_text(text.replace("at = [35.45, 43.35, 53.01, 56.28]", "at = [18.0, 22.0, 25.0, 28.14]"), "utf-8")
    riding, scooter = read_vehicle(str(file)).riding, read_vehicle(str(ROOT / "tests/vehicles/lfp.toml")).riding
    assert riding.speed < 0.6 * scooter.speed


@pytest.mark.parametrize("vehicle", BUILDS, indirect=True)
def test_energy_state_of_charge_and_range(vehicle):
    build = BUILDS[vehicle.name]
    drawn: list[float] = []

    def observe(e: Estimate) -> None:
        drawn.append((e.pack_voltage or 0.0) * (e.pack_current or 0.0) * WINDOW)

    pipeline = Pipeline(vehicle, observer=observe)
    truth = Truth(0.8)
    for frames in drive(build, vehicle.mapping.database, truth, 400.0):
        pipeline.advance(frames, frames[0][0])
    e = pipeline.last
    assert e is not None and e.soc is not None and e.soc_sd is not None and e.energy_left is not None
    assert e.range and e.range_p10 and e.range_p90 and e.consumption_factor and e.consumption_expected
    assert pipeline.counts().dropped == pipeline.counts().implausible == 0
    assert not e.reasons & (Reason.VOLTAGE_MISMATCH | Reason.CURRENT_MISMATCH | Reason.SENSOR_DISTRUSTED)
    assert abs(e.soc - truth.soc) < min(3 * e.soc_sd, 0.03)
    assert sum(drawn) == pytest.approx(truth.energy, rel=0.01)
    consumption = truth.energy / truth.distance
    assert e.consumption_expected == pytest.approx(consumption, rel=0.4)  # half of it is still the prior riding's
    assert 0.6 < e.consumption_factor < 1.6
    slowly, rate = build.energy(truth.soc), 3600 * truth.energy / e.time / build.energy(1.0)
    assert e.energy_left == pytest.approx(slowly, rel=0.05 + 0.2 * rate)  # less what stays in the resistance
    left = e.energy_left / consumption
    sd = log(e.range_p90 / e.range_p10) / 2 / DECILE  # no sensor shows a grade: by then it is known to 13 % or so
    assert abs(log(left / e.range)) < 2 * sd
    assert sd < (0.2 if build.mass < 100 else 0.4)  # which may go on to a motorway, or into a town
    state, *numbers = pipeline.publisher.reported(e)
    assert None not in numbers
    assert state is State.VALID
