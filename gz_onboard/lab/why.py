"""Why the range is what it is, as results and pictures tell it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from gz_onboard.errors import InputError
from gz_onboard.events import TOLD, Cause, Explanation, cause_words
from gz_onboard.log_rows import WHY_TOPIC
from gz_onboard.recording.logs import read_samples
from gz_onboard.recording.readers.contents import LogDamage
from gz_onboard.reports.style import BLUE, GREEN, INK, MUTED, RED, headline, new_figure, rule, save

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Why:
    """A range against another, split among causes (docs/explanation/causes.md)."""

    time_s: Annotated[float, "since the first frame"]
    reference_km: Annotated[float, "the rated range; of a change, the range before"]
    range_km: Annotated[float, "the range then; of a change, with the distance ridden since"]
    causes_km: Annotated[dict[str, float], "what each cause makes of the difference, to which they add up"]
    forgotten: Annotated[list[str], "roles of sensors found faulty between, what they taught being forgotten"] = field(
        default_factory=list
    )


def why_of(e: Explanation) -> Why:
    """An explanation in km."""
    causes = {cause.name.lower(): size * 1e-3 for cause, size in e.causes.items()}
    return Why(e.time, e.reference * 1e-3, e.range * 1e-3, causes, list(e.forgotten))


def plot_why(log: Path, picture: Path) -> list[LogDamage]:
    """Draw the last split of the range in one of our logs into `picture`; gives what could not be read.

    Raises InputError, OSError.
    """
    damages: list[LogDamage] = []
    names = {cause.name.lower(): 0.0 for cause in Cause if cause}  # logs of older versions lack the latest
    last = None
    for topic, _, values in read_samples(log, on_damage=damages.append):
        every = dict.fromkeys(("time", "reference", "range")) | names | values
        numbers = [every[name] for name in ("time", "reference", "range", *names)] if topic == WHY_TOPIC else [None]
        if all(isinstance(x, int | float) and isfinite(x) for x in numbers):
            time, reference, range_, *causes = (float(x) for x in numbers if x is not None)
            known = dict(zip((cause for cause in Cause if cause), causes, strict=True))
            last = Explanation(time, reference, range_, known)
    if last is None:
        raise InputError(
            f"{log}: does not say why the range is what it is; `gz-onboard estimate` makes a log that does"
        )
    save(draw_why(last, log.name), picture)
    return damages


def draw_why(why: Explanation, title: str) -> Figure:
    """The rated range, what each cause makes of it, and the range, one below the other."""
    shown = [(Cause.CHARGE, why.causes[Cause.CHARGE]), *why.largest()]
    rows = len(shown) + 2
    figure = new_figure(8, 1.1 + 0.32 * rows)
    axis = figure.add_axes((0.2, 0.45 / figure.get_figheight(), 0.74, 1 - 1.05 / figure.get_figheight()))
    rule(axis)
    number = partial(axis.annotate, xytext=(4, 0), textcoords="offset points", va="center", fontsize=8)
    reached = furthest = why.reference
    labels = ["rated range"]
    axis.barh(0, reached * 1e-3, color=MUTED)
    for i, (cause, size) in enumerate(shown, 1):
        axis.barh(i, size * 1e-3, left=reached * 1e-3, color=GREEN if size > 0 else RED)
        right = max(reached, reached + size)
        furthest = max(furthest, right)
        number(f"{size * 1e-3:+.1f}", (right * 1e-3, i))
        reached += size
        labels.append(cause_words(cause.name))
    rest = why.range - reached
    axis.barh(rows - 1, why.range * 1e-3, color=BLUE)
    labels.append("range")
    for i, size in ((0, why.reference), (rows - 1, why.range)):
        number(f"{size * 1e-3:.1f} km", (size * 1e-3, i))
    axis.set_yticks(range(rows), labels, fontsize=9, color=INK)
    axis.invert_yaxis()
    axis.set_xlim(0, 1.15 * furthest * 1e-3)  # room for the numbers
    axis.set_xlabel("km" + (f"; causes below {TOLD:.0f} m are not shown" if abs(rest) > 1 else ""), fontsize=8.5)
    headline(figure, 0.02, 1 - 0.3 / figure.get_figheight(), f"Why · {title} · at {why.time / 60:.0f} min", 11)
    return figure
