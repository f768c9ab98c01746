"""The view model: the range frames on the bus, checked and aged, as one picture for everything that shows them.

A picture is a JSON object. Terminal, page, MQTT and Foxglove show nothing else; docs/how-to/dashboard.md lists its
keys. A number that is stale, not available or never came is None. Units are in the names, as in the range frames.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from enum import IntEnum
from typing import TYPE_CHECKING, Any

from gz_onboard.can.layout import MessageSignals, crc8_sae_j1850, raw_range
from gz_onboard.can.publisher import KNOWN, Publisher, reason_signal, sensor_signal
from gz_onboard.display.vehicle_frames import VehicleFrames
from gz_onboard.events import (
    NO_PACK,
    NO_SENSOR,
    OF_RIDING,
    ROLES,
    STALE_PERIODS,
    Activity,
    Cause,
    Frame,
    Reason,
    RouteState,
    State,
)

if TYPE_CHECKING:
    from cantools.database.can import Message

Picture = dict[str, Any]

VERSION = 1  # of the keys of a picture
TREND_STEP, TREND_STEPS = 10.0, 60  # s between the ranges of the last ten minutes, and their number
NEARLY_EMPTY, NO_LONGER_EMPTY = 15.0, 17.0  # %: state of charge at which the alert begins, and ends
CELL_HYSTERESIS = 2.0  # K: an alert about a cell ends this far within the limit
NO_NEWS = "age_s", "counts", "vehicle_counts"
"""Keys whose change alone makes no new picture."""
ALERTS = (
    "bus_down",
    "silent",
    "partly_silent",
    "waiting",
    "range_invalid",
    "cell_too_hot",
    "destination_unreachable",
    "battery_nearly_empty",
    "cell_too_cold",
    "destination_uncertain",
    "sensor_lost",
)
"""For the rider, the most urgent first."""
_REASONS = [(int(reason), str(reason.name).lower(), reason_signal(reason)) for reason in Reason]
_SENSORS = [(role, sensor_signal(role)) for role in ROLES]


class ReceivedMessage:
    """The last good frame of one message, and counts of its frames."""

    def __init__(self, definition: Message) -> None:
        name = definition.name
        # The DBC file says it in milliseconds, or not at all.
        self.period = (definition.cycle_time or (100 if name == "RANGE_Status" else 1000)) / 1000  # s
        self.time = -math.inf  # s, of the last good frame
        self.values: dict[str, float | None] = {}  # of the last good frame, in the units of the DBC file
        self.received = self.lost = self.bad = 0  # lost: by the counter; bad: failed a check
        self._signals = MessageSignals(definition)
        self._counter_name = f"{name}Counter"
        self._counts = raw_range(definition.get_signal_by_name(self._counter_name), not_available=True)[1] + 1
        self._counter = 0.0

    def is_stale(self, now: float) -> bool:
        """Whether its values are too old to show at `now` [s]."""
        return now - self.time > STALE_PERIODS * self.period

    def take(self, data: bytes, now: float) -> None:
        """Take a frame that came at `now`; one that fails a check is counted and not used."""
        values = self._signals.values(data)
        if values is None or crc8_sae_j1850(data[:-1]) != data[-1]:
            self.bad += 1
            return
        counter = values[self._counter_name] or 0.0
        if not self.is_stale(now):
            step = int(counter - self._counter) % int(self._counts)
            if step == 0:  # a repeated frame: the sender may hang
                self.bad += 1
                return
            self.lost += step - 1
        self._counter, self.time, self.received = counter, now, self.received + 1
        self.values = {name: None if value is None else round(float(value), 3) for name, value in values.items()}


class View:
    """The range frames of one vehicle as last received, and what was seen since it began to listen.

    publisher: sends them, by default by ``range.dbc``; vehicle: reads the vehicle's own frames. No clock: times
    [s, monotonic] come with the frames.
    """

    def __init__(self, publisher: Publisher | None = None, vehicle: VehicleFrames | None = None) -> None:
        publisher = publisher or Publisher()
        self.file = publisher.file.name
        self.comments = {s.name: s.comment or "" for m in publisher.messages.values() for s in m.signals}
        self.messages = {name: ReceivedMessage(message) for name, message in publisher.messages.items()}
        self._by_identifier = {i: self.messages[message.name] for i, message in publisher.sent.items()}
        self._vehicle = vehicle
        self.has_positions = vehicle is not None and vehicle.has_positions
        others = vehicle.identifiers if vehicle else []
        self.identifiers = None if others is None else [*self._by_identifier, *others]  # None: any may be of use
        self._seen_sensors = 0  # by their reasons, the sensors that have worked since the daemon started
        self._ranges: dict[int, float | None] = {}  # km, by the number of the step of `TREND_STEP`
        self._alerts: list[str] = []  # of the last picture

    def take(self, frame: Frame, now: float) -> None:
        """Take a frame that came at `now`."""
        if message := self._by_identifier.get(frame[1]):
            message.take(frame[2], now)
        elif self._vehicle:
            self._vehicle.take(frame, now)

    def picture(self, now: float, channel: str, interface: str, bus_up: bool) -> Picture:
        """Return the picture at `now`; channel, interface, bus_up: the bus that it is of, and whether that is up."""
        stale = [name for name, message in self.messages.items() if message.is_stale(now)]
        fresh = [message.values for name, message in self.messages.items() if name not in stale]
        values = {signal: value for found in fresh for signal, value in found.items()}

        def number(name: str) -> float | None:
            return values.get(f"RANGE_{name}")

        state = self._state(values)
        activity = None if state is State.STARTING else _member(Activity, number("Activity")) or None
        reasons = sum(bit for bit, _, signal in _REASONS if values.get(signal))
        if number("StatusState") == State.STARTING:
            self._seen_sensors = 0
        if "RANGE_Status" not in stale:
            # Sensors of the ride are not reported while the vehicle is charged, and may be missing then.
            self._seen_sensors |= ~(reasons | (int(OF_RIDING) if activity is Activity.CHARGING else 0))
        lost, no_pack = int(reasons & NO_SENSOR & self._seen_sensors), int(reasons & NO_PACK)
        # Without a pack it is switched off, unless a ride is under way or a pack that was there has gone.
        off = activity is Activity.ASLEEP or (activity is None and not no_pack & self._seen_sensors)
        waiting = bool(no_pack) and off and state in (State.STARTING, State.INVALID)
        distrusted = [role for role, signal in _SENSORS if values.get(signal)]
        charge = {
            "power_w": number("ChargePower"),
            "time_to_full_min": number("TimeToFull"),
            "range_full_km": number("RemainingFull"),
        }
        route = {
            "on_route": number("RouteState") == RouteState.ON,
            "left_km": number("RouteLeft"),
            "arrival_soc_percent": number("ArrivalStateOfCharge"),
            "arrival_soc_p10_percent": number("ArrivalStateOfChargeP10"),
            "battery_ends_after_km": number("BatteryEndsAfter"),
        }
        causes = [(_member(Cause, number(f"WhyCause{i}")), number(f"WhyDistance{i}")) for i in (1, 2)]
        age = now - max(message.time for message in self.messages.values())
        shown: Picture = {
            "version": VERSION,
            "channel": channel,
            "interface": interface,
            "file": self.file,
            "bus_up": bus_up,
            "heard": math.isfinite(age),
            # The range's own state lives ten times as long as the status; once that is gone it says too much.
            "state": None if state is None or "RANGE_Status" in stale else state.name.lower(),
            "activity": None if activity is None else activity.name.lower(),
            "range": {"km": number("Remaining"), "p10_km": number("RemainingP10"), "p90_km": number("RemainingP90")},
            "range_10min_km": self._trend(number("Remaining"), now),
            "battery": {
                "soc_percent": number("StateOfCharge"),
                "soc_sigma_percent": number("StateOfChargeSigma"),
                "energy_left_wh": number("EnergyLeft"),
            },
            **dict.fromkeys(("cells", "speed_km_h", "odometer_km", "ridden_today_km")),
            **(self._vehicle.values(now, distrusted) if self._vehicle else {}),
            "consumption": {
                # Nobody knows how old the last kilometre is while there is no estimate.
                "recent_wh_per_km": None if state is State.INVALID else number("ConsumptionRecent"),
                "expected_wh_per_km": number("ConsumptionExpected"),
            },
            "charge": charge if any(value is not None for value in charge.values()) else None,
            "route": route if number("RouteState") in (RouteState.ON, RouteState.OFF) else None,
            "rated_km": number("WhyRated"),
            "causes": [{"cause": cause.name.lower(), "km": km} for cause, km in causes if cause and km],
            "reasons": [name for bit, name, _ in _REASONS if bit & reasons],
            "lost": [name for bit, name, _ in _REASONS if bit & lost],
            "distrusted": distrusted,
            "stale": stale,
            "age_s": round(age, 3) if math.isfinite(age) else None,
            "counts": {
                name: sum(getattr(message, name) for message in self.messages.values())
                for name in ("received", "lost", "bad")
            },
            "vehicle_counts": {
                name: number(f"Count{name.capitalize()}") for name in ("dropped", "implausible", "lost", "unknown")
            },
        }
        shown["alerts"] = self._alerts = self._alerts_of(shown, waiting)
        return shown

    def _state(self, values: Mapping[str, float | None]) -> State | None:
        """The state of the estimate; None if no frame says it.

        The status comes ten times as often as the range, and may be ahead of it: until the range follows, the state is
        that of the last range, or starting.
        """
        status: State | None = _member(State, values.get("RANGE_StatusState"))
        estimate: State | None = _member(State, values.get("RANGE_EstimateState"))
        if status in KNOWN and values.get("RANGE_Remaining") is None:
            return estimate if self.messages["RANGE_Estimate"].received else State.STARTING
        return estimate if status is None else status

    def _trend(self, km: float | None, now: float) -> list[float | None]:
        """Ranges [km], one each `TREND_STEP` of the last ten minutes, the oldest first; empty if there is none now."""
        step = int(now // TREND_STEP)
        self._ranges = {i: self._ranges.get(i) for i in range(step - TREND_STEPS + 1, step)} | {step: km}
        return [] if km is None else list(self._ranges.values())

    def _alerts_of(self, shown: Picture, waiting: bool) -> list[str]:
        """Those of `ALERTS` that hold."""
        soc, route, cells, before = shown["battery"]["soc_percent"], shown["route"], shown["cells"], self._alerts
        empty_at = NO_LONGER_EMPTY if "battery_nearly_empty" in before else NEARLY_EMPTY
        silent = len(shown["stale"]) == len(self.messages)
        too_hot = too_cold = unreachable = uncertain = False
        if self._vehicle and cells:
            charging = shown["activity"] == "charging"
            low, high = self._vehicle.charging_limits if charging else self._vehicle.riding_limits
            too_cold = cells["coldest_degc"] < low + CELL_HYSTERESIS * ("cell_too_cold" in before)
            too_hot = cells["hottest_degc"] > high - CELL_HYSTERESIS * ("cell_too_hot" in before)
        if route and route["on_route"]:
            unreachable = route["battery_ends_after_km"] is not None or route["arrival_soc_percent"] == 0
            uncertain = not unreachable and route["arrival_soc_p10_percent"] == 0
        holds = {
            "bus_down": not shown["bus_up"],
            "silent": silent,
            # Not for a message that never came: the first frames may have only just begun.
            "partly_silent": not silent and any(self.messages[name].received for name in shown["stale"]),
            "waiting": waiting,
            "range_invalid": shown["state"] == "invalid" and not waiting,
            "cell_too_hot": too_hot,
            "destination_unreachable": unreachable,
            "battery_nearly_empty": shown["activity"] != "charging" and soc is not None and soc <= empty_at,
            "cell_too_cold": too_cold,
            "destination_uncertain": uncertain,
            "sensor_lost": "sensor_distrusted" in shown["reasons"] or (bool(shown["lost"]) and not waiting),
        }
        return [alert for alert in ALERTS if holds[alert]]


def _member(kind: type[IntEnum], value: float | None) -> Any:
    """The member with this value; None for a value that no member has."""
    return kind(int(value)) if value is not None and value in tuple(kind) else None


def encoded(values: Mapping[str, object]) -> bytes:
    """Encode as one line of JSON."""
    return json.dumps(values, separators=(",", ":"), allow_nan=False).encode()


def value_at(picture: Picture, path: str) -> Any:
    """The value at `path`, such as ``route.left_km``; None if the part is not there."""
    part, _, key = path.partition(".")
    return (picture[part] or {}).get(key) if key else picture[part]
