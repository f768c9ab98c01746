"""Cases of the blind trial, drawn by seed: what is hidden in a scooter, the rides that show it, and the truth.

Ten successive seeds share one scooter of the fleet: `Case.scooter` is what `commissioning` takes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from gz_onboard.recording.recording import Recording
from tests.plant.machine import Machine, scooter
from tests.plant.ride import STEP, Hidden, Ridden, ride
from tests.plant.roads import KINDS as ROADS
from tests.plant.roads import Plan, Rider, plan
from tests.plant.sensors import measure

CASES_OF_A_SCOOTER = 10
RIDES = 4
KINDS = ("healthy", "one", "two", "look-alike", "unknown")
SHARES = (0.30, 0.40, 0.12, 0.08, 0.10)
LOOK_ALIKES = (
    ("dragging_brake", "rolling_resistance"),
    ("payload_mass", "rolling_resistance"),
    ("drivetrain_drag", "aero_drag_area"),
    ("winding_resistance", "torque_constant_loss"),
    ("winding_resistance", "inverter_loss"),
    ("slow_relaxation", "ocv_hysteresis"),
    ("tyre_warm_up", "rolling_resistance"),
    ("capacity_fade", "current_sensor_gain"),
)

# Of each effect: parameter of the contract, its unit, strengths of the change from weak to strong. A strength is drawn
# log-uniformly between them; where it is a factor, it is the factor less one.
EFFECTS: dict[str, tuple[str, str, float, float]] = {
    "cornering_drag": ("cornering_compliance", "rad", 0.06, 0.40),
    "headwind": ("wind_north, wind_east", "m/s", 2.0, 6.0),
    "rolling_resistance": ("rolling_resistance_constant", "1", 0.10, 0.80),
    "aero_drag_area": ("drag_area", "m²", 0.06, 0.45),
    "payload_mass": ("payload_mass", "kg", 10.0, 60.0),
    "dragging_brake": ("brake_drag_force", "N", 2.0, 20.0),
    "tyre_radius": ("wheel_radius", "m", 0.008, 0.045),
    "tyre_warm_up": ("warm_up_share", "1", 0.25, 1.2),
    "drivetrain_drag": ("drivetrain_drag_torque", "N·m·s/rad", 0.012, 0.10),
    "auxiliary_load": ("auxiliary_power", "W", 12.0, 120.0),
    "winding_resistance": ("motor_copper_resistance", "ohm", 0.006, 0.045),
    "torque_constant_loss": ("torque_constant", "N·m/A", 0.03, 0.22),
    "inverter_loss": ("inverter_loss_linear", "W/A", 0.3, 2.2),
    "regen_loss": ("regeneration_loss_share", "1", 0.3, 1.0),
    "capacity_fade": ("cell_capacity", "A·h", 0.07, 0.40),
    "resistance_growth": ("cell_resistance_factor", "1", 0.18, 1.4),
    "slow_relaxation": ("slow_resistance", "ohm", 0.008, 0.05),
    "ocv_hysteresis": ("hysteresis_voltage", "V", 0.010, 0.05),
    "cooling_blocked": ("cooling_factor", "1", 0.30, 0.85),
    "current_sensor_offset": ("pack_current_offset", "A", 0.2, 2.0),
    "current_sensor_gain": ("pack_current_gain", "1", 0.02, 0.12),
    "voltage_sensor_offset": ("pack_voltage_offset", "V", 0.12, 1.5),
    "speed_scale": ("speed_sensor_scale", "1", 0.008, 0.06),
    "sensor_latency": ("pack_voltage_latency", "s", 0.08, 0.6),
}
UNKNOWN: dict[str, tuple[float, float]] = {
    "resonance": (8.0, 30.0),  # N in a band of speed
    "hot_load": (60.0, 220.0),  # W that switch on with the motor's temperature
    "surge_loss": (2.0, 10.0),  # W per N·m/s of changing torque
    "weak_window": (0.04, 0.20),  # ohm of a cell about one state of charge
    "steering_drag": (200.0, 700.0),  # N per rad of steering
    "left_drag": (8.0, 35.0),  # N, in left bends only
    "late_drag": (8.0, 25.0),  # N, after some minutes
    "rough_drag": (3.0, 14.0),  # N at 10 m/s, more on a rough road
}

# When a hidden effect must be found, in terms of the truth alone: it takes or seems to take this share of energy, or
# its change is at least this in its own channel, which is twice to three times what
# docs/reference/reference-scooter.md says that the healthy scooter's parameter or model is known to.
ENERGY_CLEAR = 0.05
CHANNEL_CLEAR = {
    "torque_constant_loss": 0.05,  # ± 1.3 %, and as much again with temperature
    "auxiliary_load": 10.0,  # W; its own current sensor: 45.3 ± 2.2 W
    "current_sensor_offset": 0.4,  # A; two sensors agree within 0.15
    "current_sensor_gain": 0.03,  # two sensors agree within 0.011
    "voltage_sensor_offset": 0.25,  # V; two sensors agree within 0.06
    "tyre_radius": 0.010,  # of the radius; rides scatter 0.0027
    "speed_scale": 0.010,
    "sensor_latency": 0.10,  # s: one sample
    "resistance_growth": 0.30,  # tables ± 10 %
    "capacity_fade": 0.15,  # SOC over 4 rides of 10 % each
    "slow_relaxation": 0.020,  # ohm: 15 to 20 mV at the mean current of a cell; the model's error is 13 mV
    "ocv_hysteresis": 0.026,  # V: twice the model's error
    "cooling_blocked": 0.5,
}


@dataclass(frozen=True)
class Truth:
    """One hidden effect.

    change: of the contract's parameter over the healthy scooter (kg over what was entered, for the payload); of two
    numbers for the wind. relative: `change` is a share of the healthy value. share: of the energy over the same way
    that it takes, or, for a sensor, seems to take. clear: must be found, by `ENERGY_CLEAR` and `CHANNEL_CLEAR`.
    """

    name: str
    parameter: str
    unit: str
    change: tuple[float, ...]
    relative: bool
    share: float
    clear: bool


@dataclass(frozen=True)
class Case:
    """What the tool is given, `rides` and `scooter`, and what it is not."""

    seed: int
    scooter: int
    kind: str
    truths: tuple[Truth, ...]
    rides: list[Recording]
    accepted: tuple[str, ...] = ()  # of look-alikes: the set that is a right answer too
    twins: list[Recording] = field(default_factory=list)  # the same rides with nothing hidden: what an oracle has left


@dataclass
class _Draft:
    seed: int
    kind: str
    parts: dict[str, dict[str, float]] = field(default_factory=dict)  # by name, the fields of `Hidden` that it sets
    changes: dict[str, tuple[float, ...]] = field(default_factory=dict)
    accepted: tuple[str, ...] = ()

    def hidden(self, without: str = "") -> Hidden:
        """All that is wrong but for the effect `without`."""
        return Hidden(**{k: v for name, part in self.parts.items() if name != without for k, v in part.items()})


RELATIVE = {
    "aero_drag_area",
    "tyre_radius",
    "torque_constant_loss",
    "capacity_fade",
    "current_sensor_gain",
    "rolling_resistance",
}


# Of each effect but the wind: the field of `Hidden` that it changes, and the direction of the change; 0: either.
FIELDS: dict[str, tuple[str, int]] = {
    "cornering_drag": ("cornering", 1),
    "rolling_resistance": ("rolling_factor", 1),
    "aero_drag_area": ("drag_factor", 1),
    "payload_mass": ("luggage", 1),
    "dragging_brake": ("pad_force", 1),
    "tyre_radius": ("radius_factor", 1),
    "tyre_warm_up": ("warm_share", 1),
    "drivetrain_drag": ("wheel_viscous", 1),
    "auxiliary_load": ("auxiliary", 1),
    "winding_resistance": ("copper", 1),
    "torque_constant_loss": ("torque_factor", -1),
    "inverter_loss": ("switching", 1),
    "regen_loss": ("recovery_lost", 1),
    "capacity_fade": ("capacity_factor", -1),
    "resistance_growth": ("resistance_factor", 1),
    "slow_relaxation": ("slow_resistance", 1),
    "ocv_hysteresis": ("hysteresis", 1),
    "cooling_blocked": ("cooling_factor", -1),
    "current_sensor_offset": ("current_offset", 0),
    "current_sensor_gain": ("current_factor", 0),
    "voltage_sensor_offset": ("voltage_offset", 0),
    "speed_scale": ("speed_factor", 0),
    "sensor_latency": ("voltage_late", 1),
}
TIMES = {
    "tyre_warm_up": ("warm_time", 450, 750),
    "slow_relaxation": ("slow_time", 800, 1700),
    "ocv_hysteresis": ("hysteresis_rate", 20, 45),
}


def _strength(rng: np.random.Generator, name: str) -> tuple[dict[str, float], tuple[float, ...]]:
    """The effect `name` of a random strength: what it sets in `Hidden`, and the change of its parameter."""
    _, _, weak, strong = EFFECTS[name]
    x = float(weak * (strong / weak) ** rng.random())
    sign = float(rng.choice([-1.0, 1.0]))
    if name == "headwind":
        angle = rng.uniform(0, 2 * np.pi)
        wind = (x * float(np.cos(angle)), x * float(np.sin(angle)))
        return {"wind_north": wind[0], "wind_east": wind[1]}, wind
    changed, direction = FIELDS[name]
    if name == "tyre_radius":
        x = -x if rng.random() < 0.8 else min(x, 0.02)
    x *= direction or sign
    found = {changed: getattr(Hidden, changed) + x}
    if name in TIMES:
        other, low, high = TIMES[name]
        found[other] = float(rng.uniform(low, high))
    return found, (x,)


def _unknown_strength(rng: np.random.Generator, name: str) -> tuple[dict[str, float], tuple[float, ...]]:
    weak, strong = UNKNOWN[name]
    x = float(weak * (strong / weak) ** rng.random())
    fields = {
        "resonance": {"band_force": x, "band_speed": float(rng.uniform(6.5, 11.0))},
        "hot_load": {"hot_load": x, "hot_at": -1.0},
        "surge_loss": {"surge_loss": x},
        "weak_window": {"window_resistance": x, "window_soc": float(rng.uniform(0.35, 0.6))},
        "steering_drag": {"steer_drag": x},
        "left_drag": {"left_drag": x},
        "rough_drag": {"rough_drag": x},
        "late_drag": {"late_force": x, "late_time": float(rng.uniform(200, 380))},
    }[name]
    return fields, (x,)


def _draft(seed: int, kind: str | None = None, names: tuple[str, ...] | None = None) -> _Draft:
    rng = np.random.default_rng([seed, 5])
    drawn = str(rng.choice(KINDS, p=SHARES))
    kind = kind or drawn
    parts: dict[str, dict[str, float]] = {}
    changes: dict[str, tuple[float, ...]] = {}
    accepted: tuple[str, ...] = ()
    if kind == "unknown":
        name = names[0] if names else str(rng.choice(sorted(UNKNOWN)))
        parts[name], changes[name] = _unknown_strength(rng, name)
        return _Draft(seed, kind, parts, changes)
    if kind == "healthy":
        names = ()
    elif kind == "one":
        names = names or (str(rng.choice(sorted(EFFECTS))),)
    elif kind == "two":
        pair = [str(name) for name in rng.choice(sorted(EFFECTS), 2, replace=False)]
        names = names or tuple(pair)
    else:
        accepted = names or LOOK_ALIKES[int(rng.integers(len(LOOK_ALIKES)))]
        names = (accepted[int(rng.integers(2))],)
    for name in names:
        parts[name], changes[name] = _strength(rng, name)
    return _Draft(seed, kind, parts, changes, accepted)


def _service_plans(draft: _Draft) -> list[Plan]:
    """The rides of a case: various riders, temperatures and roads; of look-alikes all much the same."""
    rng = np.random.default_rng([draft.seed, 6])
    alike = draft.kind == "look-alike"
    kinds = (
        ["mixed"] * RIDES if alike else [*rng.permutation(["city", "suburban", "mixed", "arterial", "oval"])[:RIDES]]
    )
    riders = [str(rng.choice(list("ABCDE")))] * RIDES if alike else [*rng.permutation(list("ABCDE"))[:RIDES]]
    if alike:
        air = rng.uniform(8, 28) + rng.uniform(-2, 2, RIDES)
    else:
        air = rng.permutation(np.linspace(3, 32, RIDES)) + rng.uniform(-4, 4, RIDES)
    charge = rng.permutation(np.linspace(0.30, 0.96, RIDES)) + rng.uniform(-0.06, 0.04, RIDES)
    return [
        plan(
            int(draft.seed * 64 + i),
            str(kinds[i]),
            str(riders[i]),
            float(air[i]),
            float(charge[i]),
            hilly=0.4 if alike else 1.0,
        )
        for i in range(RIDES)
    ]


def _hot(hidden: Hidden, plans: Sequence[Plan]) -> list[Hidden]:
    """A load that switches on some degrees above where the ride began: known only once the ride is drawn."""
    if hidden.hot_load == 0:
        return [hidden] * len(plans)
    return [replace(hidden, hot_at=x.ambient + 9.0) for x in plans]


def _variants(draft: _Draft, truths: bool) -> list[Hidden]:
    """What is ridden of a case: all that is wrong; then all but one for each; last nothing wrong at all."""
    if not truths or not draft.parts:
        return [draft.hidden()]
    fewer = [draft.hidden(without=name) for name in draft.parts]
    return [draft.hidden(), *fewer, *([Hidden()] if len(draft.parts) > 1 else [])]


Run = tuple[Plan, Machine, Hidden]


def _case_runs(draft: _Draft, truths: bool) -> list[Run]:
    machine, plans = scooter(draft.seed // CASES_OF_A_SCOOTER), _service_plans(draft)
    return [
        (own, machine, hidden)
        for variant in _variants(draft, truths)
        for own, hidden in zip(plans, _hot(variant, plans), strict=True)
    ]


def _case(draft: _Draft, ridden: Sequence[Ridden], truths: bool) -> Case:
    with_it, *others = [list(ridden[i : i + RIDES]) for i in range(0, len(ridden), RIDES)]
    found = tuple(_truth(draft, name, with_it, others[i] if truths else with_it) for i, name in enumerate(draft.parts))
    rides = [measure(x, f"ride_{i:03d}") for i, x in enumerate(with_it)]
    twins = [measure(x, f"ride_{i:03d}") for i, x in enumerate(others[-1])] if others else []
    return Case(draft.seed, draft.seed // CASES_OF_A_SCOOTER, draft.kind, found, rides, draft.accepted, twins)


def _ride_all(runs: Sequence[Run]) -> list[Ridden]:
    plans, machines, hiddens = zip(*runs, strict=True)
    return ride(plans, machines, hiddens)


def trial(
    numbers: Sequence[int],
    seeds: Sequence[int],
    kind: str | None = None,
    names: tuple[str, ...] | None = None,
    truths: bool = True,
) -> tuple[dict[int, list[Recording]], list[Case]]:
    """The healthy rides of the scooters `numbers` and the cases of `seeds`, ridden in one batch: that is cheap.

    `kind` and `names` overrule what the seed would draw. Every case is ridden again without each of its effects, for
    the energy that it takes, and without any; not so without `truths`.
    """
    drafts = [_draft(seed, kind, names) for seed in seeds]
    healthy = [_commissioning_runs(number) for number in numbers]
    hidden = [_case_runs(draft, truths) for draft in drafts]
    ridden = iter(_ride_all([run for runs in (*healthy, *hidden) for run in runs]))
    rides = {
        number: [measure(next(ridden), f"commissioning_{i:03d}") for i in range(len(runs))]
        for number, runs in zip(numbers, healthy, strict=True)
    }
    cases = [_case(draft, [next(ridden) for _ in runs], truths) for draft, runs in zip(drafts, hidden, strict=True)]
    return rides, cases


def draw_many(
    seeds: Sequence[int], kind: str | None = None, names: tuple[str, ...] | None = None, truths: bool = True
) -> list[Case]:
    """The cases of `seeds`: see `trial`."""
    return trial((), seeds, kind, names, truths)[1]


def draw(seed: int) -> Case:
    """The case of `seed`."""
    return draw_many([seed])[0]


def windy(seed: int, speed: float) -> list[Recording]:
    """Rides of the healthy scooter of `seed` on windy days [m/s], each with a wind from elsewhere."""
    machine = scooter(seed // CASES_OF_A_SCOOTER)
    plans = _service_plans(_draft(seed, "healthy"))
    from_where = 2 * np.pi * np.arange(len(plans)) / len(plans)
    windy = [
        replace(own, wind_north=speed * float(np.cos(a)), wind_east=speed * float(np.sin(a)))
        for own, a in zip(plans, from_where, strict=True)
    ]
    return [measure(x, f"ride_{i:03d}") for i, x in enumerate(_ride_all([(own, machine, Hidden()) for own in windy]))]


def _seeming_share(name: str, change: float, without: Sequence[Ridden]) -> float | None:
    """Share of the energy per kilometre that a faulty sensor makes up; None for what is no sensor."""
    if name == "current_sensor_gain":
        return change
    if name in ("current_sensor_offset", "voltage_sensor_offset"):
        column = "pack_voltage" if name == "current_sensor_offset" else "pack_current"
        power = np.mean([np.mean(x.columns["pack_voltage"] * x.columns["pack_current"]) for x in without])
        return float(change * np.mean([np.mean(x.columns[column]) for x in without]) / power)
    if name in ("speed_scale", "sensor_latency"):
        return -change if name == "speed_scale" else 0.0
    return None


def _taken_share(with_it: Sequence[Ridden], without: Sequence[Ridden]) -> float:
    """How much more energy the same way takes; pairs of rides end at different places."""
    more = less = 0.0
    for a, b in zip(with_it, without, strict=True):
        end = min(a.columns["distance"][-1], b.columns["distance"][-1]) - 1.0
        energies = []
        for x in (a, b):
            power = x.columns["pack_voltage"].astype(float) * x.columns["pack_current"]
            energies.append(STEP * power[: np.searchsorted(x.columns["distance"], end)].sum())
        more, less = more + energies[0], less + energies[1]
    return float(more / less - 1)


def _truth(draft: _Draft, name: str, with_it: Sequence[Ridden], without: Sequence[Ridden]) -> Truth:
    change = draft.changes[name]
    size = float(np.hypot(*change)) if len(change) == 2 else abs(change[0])
    seeming = _seeming_share(name, change[0], without)
    if seeming is None:
        seeming = _taken_share(with_it, without)
    clear = abs(seeming) >= ENERGY_CLEAR or size >= CHANNEL_CLEAR.get(name, np.inf)
    if name not in EFFECTS:
        return Truth(name, "", "", change, False, seeming, clear)
    parameter, unit, _, _ = EFFECTS[name]
    return Truth(name, parameter, unit, change, name in RELATIVE, seeming, clear)


def _commissioning_runs(number: int) -> list[Run]:
    rng = np.random.default_rng([number, 7])
    kinds = ["city", "suburban", "mixed", "arterial", "oval"] * 2
    air = rng.permutation(np.linspace(1, 33, 10)) + rng.uniform(-1, 1, 10)
    charge = rng.permutation(np.linspace(0.25, 0.99, 10))
    riders = [*rng.permutation(list("ABCDE")), *rng.permutation(list("ABCDE"))]
    seed = 1_000_000_000 + number * 64
    plans = [plan(seed + i, kinds[i], str(riders[i]), float(air[i]), float(charge[i])) for i in range(10)]
    return [(own, scooter(number), Hidden()) for own in plans]


def commissioning_many(numbers: Sequence[int]) -> list[list[Recording]]:
    """The healthy rides of several scooters."""
    return list(trial(numbers, ())[0].values())


def commissioning(number: int) -> list[Recording]:
    """Ten healthy rides of the scooter `number`: all kinds of road, 1 to 33 degC, five riders."""
    return commissioning_many([number])[0]


# --- healthy scooters as strangers ride them -----------------------------------------------------------------------

RIDES_OF_A_SET = 5


def stranger(rng: np.random.Generator) -> Rider:
    """Somebody who did not ride when the scooter was commissioned: lighter or heavier, gentler or harsher than they."""
    return Rider(
        "S",
        float(rng.uniform(48, 118)),  # with luggage, as entered
        acceleration=rng.uniform(0.75, 1.6),
        braking=rng.uniform(0.75, 1.5),
        lateral=rng.uniform(1.9, 4.6),
        keenness=rng.uniform(0.86, 1.08),
        lag=rng.uniform(0.1, 0.35),
        preview=rng.uniform(0.3, 1.2),
    )


def _strange_runs(number: int, seed: int) -> list[Run]:
    """A set of healthy rides that no baseline has seen the like of: five strangers, any road, SOC 0.2 to 1, -5 to
    35 degC. Nothing is balanced: all five may be cold, or nearly empty, or in town.
    """
    rng = np.random.default_rng([seed, 11])
    machine = scooter(number)
    return [
        (
            plan(
                2_000_000_000 + seed * 64 + i,
                str(rng.choice(sorted(ROADS))),
                stranger(rng),
                float(rng.uniform(-5, 35)),
                float(rng.uniform(0.2, 1.0)),
                hilly=float(rng.uniform(0.2, 1.7)),
            ),
            machine,
            Hidden(),
        )
        for i in range(RIDES_OF_A_SET)
    ]


def _first_runs(number: int) -> list[Run]:
    """Eight rides of the new scooter, as the reference scooter was commissioned: four riders, 2 to 32 degC."""
    rng = np.random.default_rng([number, 13])
    kinds = rng.permutation(["mixed", "city", "suburban", "arterial", "mixed", "oval", "suburban", "city"])
    air = rng.permutation(np.linspace(2, 32, 8)) + rng.uniform(-1, 1, 8)
    charge = rng.permutation(np.linspace(0.18, 0.99, 8))
    seed = 3_000_000_000 + number * 64
    return [
        (
            plan(seed + i, str(kinds[i]), str(rng.choice(list("ABCD"))), float(air[i]), float(charge[i])),
            scooter(number),
            Hidden(),
        )
        for i in range(8)
    ]


def healthy(number: int, seeds: Sequence[int]) -> tuple[list[Recording], list[list[Recording]]]:
    """The first eight rides of the scooter `number`, and a later set of rides for each of `seeds`; nothing is wrong."""
    first, later = _first_runs(number), [_strange_runs(number, seed) for seed in seeds]
    ridden = iter(_ride_all([run for runs in (first, *later) for run in runs]))
    rides = [measure(next(ridden), f"commissioning_{i:03d}") for i in range(len(first))]
    return rides, [[measure(next(ridden), f"ride_{i:03d}") for i in range(len(runs))] for runs in later]
