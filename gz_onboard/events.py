"""Data that the packages exchange: frames, windows and estimates.

Frames are plain tuples, because hundreds of them pass each second: building a tuple costs a fifth of building a
dataclass.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag
from typing import NamedTuple, TypeAlias

Frame: TypeAlias = tuple[int, int, bytes, int]
"""(time [ns since the epoch], identifier, data, channel).

The identifier has the flags of Linux' ``struct can_frame``: EFF_FLAG for 29-bit identifiers, RTR_FLAG,
ERR_FLAG. The channel is the index of the configured channel; TRANSMITTED is added to frames we sent."""

EFF_FLAG = 0x8000_0000
RTR_FLAG = 0x4000_0000
ERR_FLAG = 0x2000_0000
TRANSMITTED = 0x80
MOST_STANDARD, MOST_EXTENDED = 0x7FF, 0x1FFF_FFFF  # identifiers of 11 and of 29 bits


def hexadecimal(identifier: int) -> str:
    """`identifier` in its width on the bus, such as ``0x100`` of 11 bits and ``0x00000100`` of 29."""
    return f"{identifier & ~EFF_FLAG:#0{10 if identifier & EFF_FLAG else 5}x}"


class RoleWindow(NamedTuple):
    """Samples of one role in one window, in SI units."""

    time: float  # s, of the last sample
    value: float  # of the last sample
    samples: int
    mean: float
    mean_square: float | None = None  # only of `SQUARED` roles


class MessageWindow(NamedTuple):
    """Frames of one message in one window; the entry of a role without a valid sample is None.

    group: index into ``Codec.groups``, which names the roles.
    """

    group: int
    time: float  # s, of the last frame, on the codec's monotonic timeline
    frames: int
    roles: tuple[RoleWindow | None, ...]


WINDOW = 0.5  # s between two steps of the estimator
SQUARED = frozenset({"accel_z"})
"""Roles whose variation within a window matters: the road shakes the vertical accelerometer."""


@dataclass(frozen=True)
class Group:
    """One mapped message and the roles of its signals, in order."""

    message: str
    roles: tuple[str, ...]
    period: float | None  # s


STALE_PERIODS = 10
"""A signal is stale after this many of its periods."""

# The role of a signal, and its unit: SI, but temperatures in degrees Celsius and positions in degrees.
ROLES: dict[str, str] = {
    "pack_voltage": "V",
    "pack_current": "A",  # positive when discharging
    "inverter_voltage": "V",
    "inverter_current": "A",  # DC side, positive when driving
    "auxiliary_current": "A",  # at pack voltage, positive when consuming
    "heater_power": "W",  # electric, out of the pack, not part of the auxiliary current
    "air_conditioner_power": "W",  # likewise
    "lowest_cell_voltage": "V",  # of the group of cells in series that has the lowest
    "cell_temperature": "degC",
    "ambient_temperature": "degC",
    "motor_temperature": "degC",
    "inverter_temperature": "degC",
    "motor_speed": "rad/s",  # positive forward
    "motor_torque": "N·m",  # positive when driving
    "motor_current": "A",  # RMS, positive when driving
    "wheel_speed_front": "rad/s",
    "wheel_speed_rear": "rad/s",
    "vehicle_speed": "m/s",
    "odometer": "m",
    "accel_x": "m/s^2",  # specific force, forward
    "accel_y": "m/s^2",  # left
    "accel_z": "m/s^2",  # up: +9.81 at rest
    "rate_x": "rad/s",  # positive leaning right
    "rate_y": "rad/s",  # positive nose down
    "rate_z": "rad/s",  # positive turning left
    "gps_speed": "m/s",
    "gps_course": "rad",  # clockwise from north
    "gps_altitude": "m",
    "gps_fix": "1",  # 0 none, 1 dead reckoning, 2 2D, 3 3D
    "latitude": "deg",
    "longitude": "deg",
    "bms_state_of_charge": "1",
    "charge_plug": "1",
    "key": "1",  # 0: off
    "contactor": "1",  # of the pack, 0: open
    "rider": "1",  # a number for each rider, such as that of the key
    "throttle": "1",
    "brake_switch": "1",
}

# Measured by instruments on a test bench and for validation; the estimator needs none on board.
INSTRUMENTS: dict[str, str] = {
    "brake_pressure_front": "Pa",
    "brake_pressure_rear": "Pa",
    "suspension_front": "m",
    "suspension_rear": "m",
    "roller_speed": "m/s",  # of a chassis dynamometer
    "roller_force": "N",  # positive against the vehicle
    "highest_cell_voltage": "V",
    "coldest_cell_temperature": "degC",
    "hottest_cell_temperature": "degC",
    "bms_temperature": "degC",
    "vehicle_id": "1",  # a number for each of several vehicles with one file, as from a serial number
    **{f"pack_temperature_{i}": "degC" for i in range(1, 7)},
}

# Roles whose sensors are checked against each other: no two may share a signal.
VOLTAGES = ("pack_voltage", "inverter_voltage")
CURRENTS = ("pack_current", "inverter_current", "auxiliary_current")
LOADS = ("heater_power", "air_conditioner_power")  # not part of the auxiliary current
SPEEDS = ("motor_speed", "wheel_speed_rear", "wheel_speed_front", "vehicle_speed", "gps_speed")

# Limits of any road vehicle, by unit: many DBC files give none.
PLAUSIBLE: dict[str, tuple[float, float]] = {
    "V": (0.0, 1500.0),
    "A": (-5000.0, 5000.0),
    "degC": (-80.0, 400.0),
    "rad/s": (-10_000.0, 10_000.0),
    "N·m": (-20_000.0, 20_000.0),
    "W": (-1e6, 1e6),
    "m": (-1000.0, 1e10),
    "m/s": (-150.0, 150.0),
    "m/s^2": (-2000.0, 2000.0),
    "rad": (-10.0, 10.0),
    "deg": (-360.0, 360.0),
    "1": (-10.0, 1000.0),
}

# Likewise of a role whose unit allows more: 65 is a state of charge in percent whose unit the DBC does not tell, no
# cell has 6 V, and nothing reverses at 36 km/h.
_FASTEST_BACK = -7.0  # m/s
PLAUSIBLE_OF: dict[str, tuple[float, float]] = {
    "bms_state_of_charge": (-0.1, 1.1),
    "lowest_cell_voltage": (0.0, 6.0),
    "vehicle_speed": (_FASTEST_BACK, PLAUSIBLE["m/s"][1]),
    "gps_speed": (_FASTEST_BACK, PLAUSIBLE["m/s"][1]),
}


class State(IntEnum):
    """How far the published range can be trusted."""

    STARTING = 0  # no estimate yet
    VALID = 1
    DEGRADED = 2  # an input is missing or doubtful: the interval is wider, `Reason` says why
    INVALID = 3  # no number is published


class Activity(IntEnum):
    """State of motion; consumption is learned while riding only."""

    UNKNOWN = 0  # neither speed nor charge plug
    RIDING = 1
    STANDING = 2  # a short stop, as at a traffic light
    CHARGING = 3
    PARKED = 4  # a longer one, or the key is off or the contactor open
    ASLEEP = 5  # nothing comes from the bus since it stood
    JOINED = 6  # riding, and so since before the first message: no rest has shown the state of charge yet


class RouteState(IntEnum):
    """Whether the vehicle is on the route that it was given."""

    NONE = 0  # none was given
    ON = 1
    OFF = 2  # not on it, or not yet known to be, or beyond its end


class Reason(IntFlag):
    """Reasons for a wider interval or a missing number. The bits of RANGE_Status in dbc/range.dbc have these names."""

    NO_PACK_VOLTAGE = 1 << 0  # replaced by the inverter's voltage, if there is one
    NO_PACK_CURRENT = 1 << 1  # replaced by the inverter's current and the auxiliary load, or the model
    NO_INVERTER_CURRENT = 1 << 2  # nothing to check the pack current with
    NO_CELL_TEMPERATURE = 1 << 3  # replaced by the last known, later by the ambient's
    NO_SPEED = 1 << 4
    NO_IMU = 1 << 5  # no lean; grade from altitude only
    NO_GPS = 1 << 6
    NO_AMBIENT_TEMPERATURE = 1 << 7
    CURRENT_MISMATCH = 1 << 8  # the two current sensors disagree
    VOLTAGE_MISMATCH = 1 << 9  # the cell model does not follow the voltage
    PRIOR_RIDING = 1 << 10  # too little ridden: the consumption expected is mostly the prior
    SOC_UNCERTAIN = 1 << 11  # its standard deviation is above 5 %
    FRAMES_DROPPED = 1 << 12  # frames were dropped by a check within the last second
    FRAMES_LOST = 1 << 13  # the kernel or the bus lost frames within the last second
    BUS_DOWN = 1 << 14
    LOG_FAILED = 1 << 15  # the log cannot be written
    SENSOR_DISTRUSTED = 1 << 16  # a sensor contradicts the others and is left out; RANGE_Sensors says which
    SIGNALS_SLOW = 1 << 17  # pack current or voltage comes too slowly to be integrated
    SOC_RESTARTED = 1 << 18  # the state of charge was contradicted for long and started again from the voltage
    SAVE_FAILED = 1 << 19  # the state cannot be saved for the next start


KEEPING = Reason.LOG_FAILED | Reason.SAVE_FAILED
"""Reasons about the log and the saved state: the range is as certain as before."""
NO_PACK = Reason.NO_PACK_VOLTAGE | Reason.NO_PACK_CURRENT
OF_RIDING = Reason.NO_SPEED | Reason.NO_IMU | Reason.NO_GPS | Reason.NO_INVERTER_CURRENT
"""Sensors that sleep on many vehicles while they are charged, and are not missed then."""
NO_SENSOR = NO_PACK | OF_RIDING | Reason.NO_CELL_TEMPERATURE | Reason.NO_AMBIENT_TEMPERATURE
"""Reasons that name a sensor without data."""


TOLD = 50.0  # m: RANGE_Why counts tenths of a kilometre


class Cause(IntEnum):
    """Why a range is not another. RANGE_Why in dbc/range.dbc has these numbers and names."""

    NONE = 0
    TEMPERATURE = 1  # of cells and air
    SPEED = 2
    STOPS = 3  # accelerating, braking, standing
    WIND = 4  # that the model knows of
    CLIMB = 5  # of roads like those ridden; of a route, ahead on it
    TURNING = 6
    AUXILIARIES = 7  # measured, beyond the value of the vehicle file
    PAYLOAD = 8  # as entered, against that of the vehicle file
    AGE = 9  # capacity and resistance of the cells against new ones
    CHARGE = 10  # state of charge; of a change, beyond the distance ridden
    RIDING = 11  # expected of the next kilometres, beyond the last ones
    UNEXPLAINED = 12  # measured over modelled consumption, as learned: soft tyres, wind, clothes, a dragging brake


@dataclass(frozen=True, slots=True)
class Explanation:
    """A range against another, split among causes; the causes add up to the difference."""

    time: float  # s, of the range that is explained
    reference: float  # m: the vehicle's rated range; of a change, the range before
    range: float  # m; of a change, with the distance ridden since
    causes: Mapping[Cause, float]  # m, by cause
    forgotten: tuple[str, ...] = ()  # roles found faulty since: everything learned from them was forgotten

    def largest(self) -> list[tuple[Cause, float]]:
        """The causes worth showing, the largest first, without the charge, which is shown elsewhere."""
        told = [each for each in self.causes.items() if each[0] is not Cause.CHARGE and abs(each[1]) >= TOLD]
        return sorted(told, key=lambda each: -abs(each[1]))


_WORDS = {"imu": "IMU", "gps": "GPS", "soc": "SOC", "bms": "BMS", "accel": "acceleration", "rate": "rate of rotation"}
_PHRASES = {"prior_riding": "less than 3 km ridden"}


def words(name: str) -> str:
    """The name of a reason, a role or an effect in words, such as ``no IMU``, ``GPS altitude``, ``acceleration x``."""
    return _PHRASES.get(name.lower()) or " ".join(_WORDS.get(word, word) for word in name.lower().split("_"))


_CAUSE_WORDS = {
    "climb": "hills",
    "turning": "bends",
    "auxiliaries": "auxiliary load",
    "age": "age of the battery",
    "riding": "riding to come",
}


def cause_words(name: str) -> str:
    """The name of a cause as people read it, such as ``hills``."""
    return _CAUSE_WORDS.get(name.lower(), words(name))


@dataclass(slots=True)
class Estimate:
    """Estimates at one time; an unknown quantity is None, and never published as a number."""

    time: float  # s, on the codec's timeline
    state: State = State.STARTING
    reasons: Reason = field(default=Reason(0))
    activity: Activity = Activity.UNKNOWN
    distrusted: tuple[str, ...] = ()  # roles whose sensors contradict the others and are left out
    soc: float | None = None  # 0..1
    soc_sd: float | None = None
    v1: float | None = None  # V, of a cell
    innovation: float | None = None  # V, of a cell: measured less predicted
    innovation_rms: float | None = None  # V, of a cell, over the last 10 s or so
    pack_voltage: float | None = None  # V
    pack_current: float | None = None  # A
    current_modelled: bool = False  # no sensor showed it
    cell_temperature: float | None = None  # degC
    speed: float | None = None  # m/s
    acceleration: float | None = None  # m/s²
    grade: float | None = None  # sine of the road's angle
    lean: float | None = None  # rad, positive to the right
    yaw_rate: float | None = None  # rad/s, positive to the left
    heading: float | None = None  # rad, clockwise from north
    distance: float = 0.0  # m, since the start
    range: float | None = None  # m
    range_p10: float | None = None  # m
    range_p90: float | None = None  # m
    energy_left: float | None = None  # J
    energy_left_sd: float | None = None  # J
    consumption_recent: float | None = None  # J/m, measured
    consumption_expected: float | None = None  # J/m
    consumption_expected_sd: float | None = None  # J/m
    charge_power: float | None = None  # W into the pack, while it is charged
    time_to_full: float | None = None  # s, likewise
    range_full: float | None = None  # m, likewise: when it is full
    consumption_factor: float | None = None  # learned: measured over modelled
    consumption_factor_sd: float | None = None
    why: Explanation | None = None  # the range against the rated one, at most a minute or so old
    route_state: RouteState = RouteState.NONE
    route_along: float | None = None  # m from the start of the route
    route_left: float | None = None  # m to its end
    route_energy: float | None = None  # J, needed to its end
    route_energy_sd: float | None = None  # J
    arrival_soc: float | None = None  # 0..1, at the end of the route; 0 if the battery ends before
    arrival_soc_p10: float | None = None
    arrival_soc_p90: float | None = None
    battery_ends_after: float | None = None  # m from here; None if not on the route
    battery_ends_latitude: float | None = None  # deg
    battery_ends_longitude: float | None = None  # deg
