"""Shared options: ranges and formats of logs."""

from __future__ import annotations

import argparse

import pytest

from gz_onboard.cli import COMMANDS, command_line
from gz_onboard.errors import BAD_INPUT, EXIT_STATUSES, FAILED, INTERRUPTED, OK, InputError
from gz_onboard.options import LOG_SUFFIXES, add_shared, number
from gz_onboard.recording import logs


@pytest.fixture
def parser():
    parser = argparse.ArgumentParser(exit_on_error=False)
    add_shared(parser, "--jobs", "--json", "--output", "--payload")
    return parser


@pytest.mark.parametrize("text", ["-0.1", "300.1", "nan", "inf", "-inf"])
def test_a_number_beyond_its_range_is_refused_with_its_unit(text):
    with pytest.raises(InputError, match=r"^--payload \S+ kg: must be 0 to 300 kg$"):
        number("--payload", 0.0, 300.0, "kg")(text)


def test_the_formats_of_logs_are_those_that_can_be_read():
    assert set(LOG_SUFFIXES) == {name for name in logs._READERS if name.startswith(".")}


def test_an_option_has_one_meaning():
    """The same name, the same type and number of values, in all commands but for what is written."""
    kinds: dict[str, set[tuple[object, ...]]] = {}
    (commands,) = (a for a in command_line(COMMANDS)._actions if isinstance(a, argparse._SubParsersAction))
    for parser in commands.choices.values():
        for action in parser._actions:
            for name in set(action.option_strings) & {
                "--jobs",
                "--json",
                "--quiet",
                "--vehicle",
                "--report",
                "--no-plot",
            }:
                kinds.setdefault(name, set()).add((action.type, action.nargs, action.const, action.metavar))
    assert {name: len(found) for name, found in kinds.items()} == dict.fromkeys(kinds, 1)


def test_the_exit_statuses_stand_in_one_table():
    assert list(EXIT_STATUSES) == [OK, FAILED, BAD_INPUT, INTERRUPTED]
    assert all(text in command_line([]).format_help() for text in EXIT_STATUSES.values())
