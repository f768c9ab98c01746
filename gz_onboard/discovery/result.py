"""What a discovery found, as plain data: the types of the JSON that ``discover --json`` writes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from gz_onboard.constants import WH_PER_KM
from gz_onboard.errors import brief
from gz_onboard.reports.results import OPTIONAL

VERSION = 2  # of the keys: 1 had energy_per_way for consumption
VERDICTS = {
    "cause": "Fault identified",
    "none": "No fault found that these rides could show",
    "ambiguous": "Fault found, but these rides cannot tell which of several causes it is",
    "unknown": "Fault found that is none of the candidates",
    "inconclusive": "The model misses rides held out by more than healthy rides, and no cause explains it",
}
METRICS = {
    "power": ("power, rms", 1.0, "W"),
    "consumption": ("consumption", 1 / WH_PER_KM, "Wh/km"),
    "range": ("range", 100.0, "%"),
    "voltage": ("voltage of a cell", 1e3, "mV"),
}
"""Of the gain: label, factor and unit."""
RIDE_TO_RIDE = "ride"  # the quantity of what differs from ride to ride
CONSTANT = "constant"  # the quantity of what is the same everywhere
Interval = tuple[float, float]
NO_INTERVAL = "one ride: no interval"


@dataclass(frozen=True)
class ParameterEstimate:
    """A parameter's value once accepted, with its 95 % interval."""

    value: float
    ci95: Interval
    unit: str = "1"


@dataclass(frozen=True)
class FoundCause:
    """A cause that was named. value: of its first parameter once accepted; change: over the healthy one's.

    evidence: chi-squared of one degree of freedom that leaving it out costs. varies: from ride to ride, by itself or as
    rides held out show; it promises nothing for the next ride, and no model is extended with it. parameters: all of
    them, the first first.
    """

    name: str
    parameter: str
    value: float
    unit: str
    ci95: Interval
    change: float
    energy_share: float
    evidence: float
    varies: bool = False
    parameters: dict[str, ParameterEstimate] = field(default_factory=dict)

    def __post_init__(self) -> None:
        first = {self.parameter: ParameterEstimate(self.value, self.ci95, self.unit)}
        object.__setattr__(self, "parameters", first | self.others)

    @property
    def others(self) -> dict[str, ParameterEstimate]:
        """Its parameters but the first."""
        return {name: found for name, found in self.parameters.items() if name != self.parameter}


@dataclass(frozen=True)
class Unknown:
    """What has no name: a curve that a `channel` leaves over a `quantity`, over the rides (`RIDE_TO_RIDE`), or a
    `CONSTANT`, of one row.

    straight: it is in proportion. curve: rows (at [unit], value [the channel's unit], sd). denies: causes that it
    shows to be none. share: of the energy.
    """

    channel: str
    quantity: str
    straight: bool
    unit: str
    score: float
    chi2: float
    curve: tuple[tuple[float, float, float], ...]
    denies: tuple[str, ...] = ()
    share: float = 0.0


@dataclass(frozen=True)
class Impossible:
    """A candidate whose evidence asks for a `value` of its first parameter beyond its `bounds`, so that it is no cause.

    energy_share: that it would take.
    """

    name: str
    parameter: str
    value: float
    unit: str
    bounds: Interval
    score: float
    energy_share: float


@dataclass(frozen=True)
class Refitted:
    """A parameter that no cause is named after, before the rides and in the fit to them. energy_share: of its change.

    stated: not a parameter that the vehicle file could state and does not.
    """

    parameter: str
    known: float
    value: float
    unit: str
    energy_share: float
    stated: bool


@dataclass(frozen=True)
class Strain:
    """What explains the rides without a cause and yet cannot be. energy_share: of all that was refitted together;
    refitted: what took most of it, empty where it is plausible.
    """

    energy_share: float
    refitted: tuple[Refitted, ...]
    impossible: tuple[Impossible, ...]


@dataclass(frozen=True)
class Score:
    """Of a candidate beside the causes named."""

    name: str
    score: float


@dataclass(frozen=True)
class ResidualSize:
    """Of a channel's residual, in its unit. autocorrelation: of neighbouring blocks; shares: of energy and range."""

    mean: float
    rms: float
    autocorrelation: float
    blocks: int
    energy_share: float
    range_share: float


@dataclass(frozen=True)
class Errors:
    """On rides held out: before, with the present parameters refitted, after; ci95: of control less after.

    ci95: None for one ride, which says nothing of the spread of rides.
    """

    before: float
    control: float
    after: float
    ci95: Interval | None


@dataclass(frozen=True)
class Gain:
    """Errors on rides held out of the fit, by metric. apart: these rides had no part in the choice either.

    voltage: of a cell [V]; power: rms [W]; consumption: [J/m]; range: [1].
    """

    holdout: tuple[str, ...] = ()
    note: Annotated[str | None, OPTIONAL] = None
    apart: Annotated[bool | None, OPTIONAL] = None
    voltage: Annotated[Errors | None, OPTIONAL] = None
    power: Annotated[Errors | None, OPTIONAL] = None
    consumption: Annotated[Errors | None, OPTIONAL] = None
    range: Annotated[Errors | None, OPTIONAL] = None

    @property
    def errors(self) -> dict[str, Errors]:
        """Those that were measured, in the order of `METRICS`."""
        return {name: found for name in METRICS if (found := getattr(self, name)) is not None}


@dataclass(frozen=True)
class Isolability:
    """What could be told apart at all. signatures: of each candidate the channels that depend on it (Krysander & Frisk
    2008). same_signature: those that only the form of what they do separates, no matter how much is measured.
    look_alikes: pairs that these rides can hardly separate, by the cosine of what they do once nuisances are out.
    """

    signatures: dict[str, list[str]]
    same_signature: list[list[str]]
    look_alikes: list[tuple[str, str, float]]


@dataclass(frozen=True)
class Split:
    """How unequal a cause is between the halves of a quantity. ratio: half the difference over the mean."""

    cause: str
    quantity: str
    ratio: float
    chi2: float


@dataclass(frozen=True)
class Limit:
    """The smallest change of a cause that these rides would show, half the time, were it alone.

    change: of its first parameter [unit]; energy_share: as a magnitude, 0 for one that takes none. Both None if it is
    not identifiable from the rides. needs: what shows it, each a set of roles.
    """

    parameter: str
    unit: str
    change: float | None
    energy_share: float | None
    needs: tuple[str, ...] = ()


@dataclass
class Report:
    """What was found."""

    version: int = field(default=VERSION, init=False)
    verdict: Annotated[str, "cause, none, ambiguous, unknown or inconclusive"]
    causes: Annotated[
        list[FoundCause],
        "name, parameter, value, unit, ci95, change (over the healthy value), energy_share, evidence (chi-squared of "
        "one degree of freedom), varies (from ride to ride: no model is extended with it), parameters (all of them: "
        "value, ci95, unit)",
    ]
    ambiguous: Annotated[list[list[str]], "sets of names that these rides cannot tell apart, the likeliest first"]
    unknown: Annotated[
        Unknown | None,
        "what has no name: channel, quantity, unit, straight (in proportion), share of the energy, curve [[at, value, "
        "sd], ...], denies (causes that it shows to be none); or null",
    ]
    ranking: Annotated[list[Score], "name, score of every candidate beside the causes named"]
    residuals: Annotated[
        dict[str, ResidualSize], "per channel: mean, rms, autocorrelation, blocks, energy_share, range_share"
    ]
    gain: Annotated[
        Gain,
        "on rides held out: holdout, and per metric before, control (present parameters refitted), after, ci95 (of "
        "control less after, over rides); apart: whether these rides had no part in the choice either",
    ]
    extended_model: Annotated[str | None, "the vehicle file written, or null"] = field(default=None, init=False)
    advice: Annotated[list[str], "what to ride next"]
    notes: Annotated[list[str], "what could not be used, and what was left out"]
    isolability: Annotated[
        Isolability,
        "signatures: channels of each candidate; same_signature: groups that differ in form alone; look_alikes: pairs "
        "and the cosine of what they do to the residuals",
    ]
    threshold: Annotated[float, "score that one in twenty such searches of healthy rides exceeds"]
    constancy: Annotated[
        list[Split],
        "whether a cause acts alike everywhere: cause, quantity, ratio (half the difference of the halves of the "
        "quantity over the mean), chi2",
    ] = field(default_factory=list)
    strain: Annotated[
        Strain | None,
        "what explains the rides without a cause and cannot be: energy_share of all that was refitted, refitted (the "
        "parameters that took most), impossible (candidates at values beyond their bounds); or null",
    ] = None
    limits: Annotated[
        dict[str, Limit],
        "per candidate: parameter, change, unit, energy_share: the least that would be found half the time; needs: the "
        "roles that show it, any set of them",
    ] = field(default_factory=dict)

    __repr__ = brief
