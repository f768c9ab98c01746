"""A progress bar on standard error, if that is a terminal."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TextIO

Progress = Callable[[float], None]
"""Called with the work done since the last call, in any unit."""


class Display:
    """The display of progress; without a bar only `print` has an effect."""

    def __init__(self, bar: Any = None) -> None:
        self._bar = bar

    def update(self, work: float) -> None:
        """Add finished work."""
        if self._bar is not None:
            self._bar.update(work)

    def step(self, text: str, work: float = 0.0) -> None:
        """Name the next step, and add finished work."""
        if self._bar is not None:
            self._bar.set_description_str(text)
            self._bar.update(work)

    def print(self, text: str, stream: TextIO) -> None:
        """Print a line that the bar does not overwrite."""
        if self._bar is None:
            print(text, file=stream, flush=True)
        else:
            self._bar.write(text, file=stream)


@contextmanager
def progress_bar(total: Callable[[], float | None], unit: str = "", *, quiet: bool = False) -> Iterator[Display]:
    """Display progress while the context lasts.

    total: all the work in `unit`, or None if it is not known; called for the bar only. Without a `unit` the bar shows
    a percentage, without total and unit the step that runs.
    """
    if quiet or not sys.stderr.isatty():
        yield Display()
        return
    from tqdm import tqdm

    work = total()
    form = "{desc} {elapsed}" if work is None else "{desc}{percentage:3.0f}%|{bar}| {elapsed} < {remaining}"
    with tqdm(
        total=work,
        unit=f" {unit}",
        unit_scale=True,
        bar_format=None if unit else form,
        file=sys.stderr,
        leave=False,
        mininterval=0.2,
    ) as bar:
        yield Display(bar)
