"""The progress of a command, on a terminal and without one."""

from __future__ import annotations

import io
import sys

import pytest

from gz_onboard.progress import progress_bar


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def use(total, unit="", quiet=False):
    with progress_bar(lambda: total, unit, quiet=quiet) as display:
        display.step("reading a.blf")
        display.update(1)
        display.step("fitting", 1)
        display.print("a line", sys.stdout)


@pytest.mark.parametrize(
    ("total", "unit", "shown"),
    [
        (2, "", ("reading a.blf", "%")),
        (2, "steps", ("fitting", "2.00/2.00")),
        (None, "frames", ("2.00 frames",)),
        (None, "", ("reading a.blf 00:00",)),
    ],
)
def test_a_bar_on_a_terminal(capsys, monkeypatch, total, unit, shown):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    use(total, unit)
    for text in shown:
        assert text in terminal.getvalue()
    assert capsys.readouterr().out == "a line\n"


@pytest.mark.parametrize("quiet", [False, True])
def test_nothing_but_lines_without_a_terminal_or_when_quiet(capsys, monkeypatch, quiet):
    terminal = Terminal() if quiet else io.StringIO()
    monkeypatch.setattr(sys, "stderr", terminal)
    use(2, "steps", quiet)
    assert capsys.readouterr().out == "a line\n"
    assert terminal.getvalue() == ""
