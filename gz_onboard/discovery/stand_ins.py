"""What stands in for a motor's speed and current that a ride did not measure."""

from __future__ import annotations

from dataclasses import replace

from gz_onboard.errors import InputError
from gz_onboard.offline.samples import Samples
from gz_onboard.offline.sensors import road_speed, speed_role
from gz_onboard.vehicle import Vehicle

USUAL_DELAYS = {"gps_speed": 0.4, "gps_course": 0.4, "gps_altitude": 0.4, "pack_voltage": 0.1, "pack_current": 0.1}
"""By how much later than the inverter's a value is sent [s], where no message states its `delay`; what is left of it
is fitted (see `channels`); by `delays` of a vehicle."""
PACK = ("pack_voltage", "pack_current")


def delays(vehicle: Vehicle) -> dict[str, float]:
    """By role how old a value is when it comes [s]: as its message states, or as usual; none of what is not there."""
    stated = vehicle.mapping
    return USUAL_DELAYS | {s.role: stated.delays[s.message] for s in stated.sources if s.message in stated.delays}


def stand_ins(samples: Samples, vehicle: Vehicle) -> tuple[Samples, tuple[str, ...]]:
    """(`samples` with what can be taken for a motor's speed and current that were not measured, which that is).

    Another speed is the motor's by the radius of the file: if the tyre's is another, the vehicle errs as it shows. What
    stands in is in no channel by itself. Raises InputError for a ride without any speed, or without any measure of what
    drives it.
    """
    p, columns, words = vehicle.parameters, dict(samples.columns), []
    if "motor_speed" not in columns:
        role, factor = speed_role(f"ride {samples.name}", columns, p)
        times, values = columns.pop(role)
        factor /= road_speed(1.0, p)
        columns["motor_speed"] = times - delays(vehicle).get(role, 0.0), values * factor
        words.append(f"motor_speed: {role} stands in, by wheel radius and gear ratio of the vehicle file")
    if "motor_current" not in columns and "motor_torque" in columns:
        times, values = columns["motor_torque"]
        columns["motor_current"] = times, values / p["torque_constant"]
        words.append("motor_current: motor_torque stands in, over the torque constant of the vehicle file")
    if "motor_current" not in columns and not set(PACK) <= columns.keys():
        raise InputError(
            f"ride {samples.name}: has no motor_current, no motor_torque and not both of {' and '.join(PACK)}: what "
            "drives it is not known, and nothing can be compared"
        )
    return replace(samples, columns=columns), tuple(words)
