"""Convert the units of signals in DBC files to the SI units of the roles."""

from __future__ import annotations

from math import pi

from gz_onboard.constants import GRAVITY, KELVIN
from gz_onboard.events import INSTRUMENTS, ROLES

UNITS = {**ROLES, **INSTRUMENTS}  # of all roles

# (unit in a DBC, SI unit) -> factor, offset
_CONVERSIONS: dict[tuple[str, str], tuple[float, float]] = {
    ("mV", "V"): (1e-3, 0.0),
    ("mA", "A"): (1e-3, 0.0),
    ("kW", "W"): (1e3, 0.0),
    ("K", "degC"): (1.0, -KELVIN),
    ("degF", "degC"): (5 / 9, -160 / 9),
    ("rpm", "rad/s"): (2 * pi / 60, 0.0),
    ("rev/s", "rad/s"): (2 * pi, 0.0),
    ("deg/s", "rad/s"): (pi / 180, 0.0),
    ("deg", "rad"): (pi / 180, 0.0),
    ("km/h", "m/s"): (1 / 3.6, 0.0),
    ("mph", "m/s"): (0.44704, 0.0),
    ("km", "m"): (1e3, 0.0),
    ("mm", "m"): (1e-3, 0.0),
    ("mi", "m"): (1609.344, 0.0),
    ("ft", "m"): (0.3048, 0.0),
    ("bar", "Pa"): (1e5, 0.0),
    ("kPa", "Pa"): (1e3, 0.0),
    ("g", "m/s^2"): (GRAVITY, 0.0),
    ("%", "1"): (0.01, 0.0),
}

# Spellings seen in DBC files -> ours
_ALIASES = (
    "r/min=rpm 1/min=rpm RPM=rpm r/s=rev/s rps=rev/s °/s=deg/s dps=deg/s °=deg degree=deg degrees=deg °C=degC "
    "C=degC ºC=degC Celsius=degC °F=degF F=degF ºF=degF Fahrenheit=degF mile=mi miles=mi feet=ft Nm=N·m "
    "N.m=N·m N*m=N·m kph=km/h kmh=km/h m/s2=m/s^2 m/s²=m/s^2 meters=m Volt=V Volts=V Amp=A Amps=A Watts=W Percent=% "
    "km/hr=km/h mi/h=mph Km=km KM=km"
)
_SPACED = {"": "1", "-": "1", "deg C": "degC", "deg F": "degF"}
_SPELLINGS = _SPACED | dict(alias.split("=") for alias in _ALIASES.split())
_KNOWN = {*UNITS.values(), *(unit for unit, _ in _CONVERSIONS), *_SPELLINGS}
_LOWER = {unit.lower(): unit for unit in sorted(_KNOWN) if len(unit) > 2}  # of shorter ones the case tells mV from MV


def known_units(role: str) -> list[str]:
    """The units from which `role` can be read."""
    return [UNITS[role], *(unit for unit, si in _CONVERSIONS if si == UNITS[role])]


def to_si(unit: str, role: str) -> tuple[float, float] | None:
    """(factor, offset) from `unit` to the SI unit of `role`; None if it cannot be one of the role's units."""
    unit = unit if unit in _KNOWN else _LOWER.get(unit.lower(), unit)
    unit = _SPELLINGS.get(unit, unit)
    if unit == UNITS[role]:
        return 1.0, 0.0
    return _CONVERSIONS.get((unit, UNITS[role]))
