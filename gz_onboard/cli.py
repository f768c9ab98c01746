"""The one command, ``gz-onboard``; each subcommand is a module, imported only when it is called."""

from __future__ import annotations

import argparse
import importlib
import io
import os
import re
import sys
from collections.abc import Collection, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

from gz_onboard import __version__
from gz_onboard.errors import (
    BAD_INPUT,
    EXIT_STATUSES,
    FAILED,
    INTERRUPTED,
    InputError,
    closest,
    lacking_extra,
    naming,
    nearest,
)
from gz_onboard.options import LOG_SUFFIXES

COMMANDS = {
    "run": ("gz_onboard.daemon.command", "estimate the range from a live bus and publish it (the daemon)"),
    "learned": ("gz_onboard.daemon.learned", "show what the daemon has learned of battery and riding, or forget it"),
    "route": ("gz_onboard.daemon.route", "give the running daemon the route that is to be ridden, or take it away"),
    "dashboard": ("gz_onboard.dashboard.command", "show the range that the daemon sends, in a terminal or a browser"),
    "mqtt": ("gz_onboard.bridges.mqtt", "publish the daemon's range on an MQTT broker, for Home Assistant"),
    "foxglove": ("gz_onboard.bridges.foxglove", "show the range that the daemon sends live in Foxglove"),
    "replay": ("gz_onboard.recording.replay", "send a recorded log onto a bus, in its own timing"),
    "estimate": ("gz_onboard.lab.estimate", "estimate the range on recorded rides, without a bus, as fast as possible"),
    "simulate": ("gz_onboard.simulation.simulate", "simulate a drive cycle, a route or a recorded ride"),
    "validate": (
        "gz_onboard.lab.validate",
        "compare recorded rides with their simulation: within 20 %, components within 10 %",
    ),
    "calibrate": ("gz_onboard.lab.calibrate.command", "determine a vehicle's parameters from measurements"),
    "discover": (
        "gz_onboard.lab.discover.command",
        "find what the model gets wrong on rides, name the cause, extend the model",
    ),
    "export": ("gz_onboard.lab.export", "convert a log to candump, BLF, ASC, or what it holds to Parquet, CSV, ..."),
    "vehicle": ("gz_onboard.lab.vehicle.command", "begin a vehicle file, or check whether it fits the vehicle's logs"),
    "report": ("gz_onboard.lab.report", "show recorded rides as one self-contained HTML page, also for phones"),
    "history": ("gz_onboard.lab.history.command", "store rides in a file, and show their totals"),
    "plot": ("gz_onboard.lab.plot", "draw an overview of an estimated ride"),
}


class _Help(argparse.RawDescriptionHelpFormatter):
    """argparse's help, without the options in its first line: they are listed below."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=30)

    def _format_usage(self, usage: str | None, actions: Any, groups: Any, prefix: str | None) -> str:
        # Of a command in a command argparse asks without options: that is how it is called.
        arguments = [action for action in actions if not action.option_strings]
        options = (
            [argparse.Action(["[OPTION ...]"], "", nargs=0, required=True)] if len(arguments) < len(actions) else []
        )
        return super()._format_usage(usage, options + arguments, [], prefix)


class _Parser(argparse.ArgumentParser):
    """argparse that names the nearest right option or command."""

    def __init__(self, *args: Any, **others: Any) -> None:
        super().__init__(*args, **{"formatter_class": _Help, **others})

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """What a command does not know is its own error, with its own usage: argparse leaves it to the whole line's."""
        known, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return known, unknown

    def error(self, message: str) -> NoReturn:
        if message.startswith("the following arguments are required: ") and self._subparsers:
            self.print_help(sys.stderr)  # which commands there are is what is asked
            self.exit(BAD_INPUT, f"\n{self.prog}: error: {message}\n")
        wrong, _, choices = message.partition("invalid choice: ")[2].partition(" (choose from ")
        if wrong:
            message += nearest(wrong.strip("'"), re.findall(r"[^\s',)]+", choices))
        elif message.startswith("unrecognized arguments: "):
            words = message.split()[2:]
            wrong = next((word for word in words if word.startswith("-")), "")
            message += self._meant(wrong.partition("=")[0]) if wrong else self._place_of(words[0])
        super().error(message)

    def _meant(self, wrong: str) -> str:
        """As `nearest`; dashes, which all options have, make none like another."""
        bare = {option.lstrip("-"): option for option in self.known_options()}
        near = closest(wrong.lstrip("-"), bare)
        return f" (did you mean {bare[near]!r}?)" if near else ""

    def _place_of(self, word: str) -> str:
        """Where a file or folder `word` goes on the command line of this command."""
        if any(not action.option_strings for action in self._actions):
            return "; files go before the options"
        named = ((str(action.metavar), action) for action in self._actions if action.help != argparse.SUPPRESS)
        taking = [f"{action.option_strings[0]} {of}" for of, action in named if re.search("FILE|TOML|DIR", of)]
        replayed = Path(word).is_dir() or word.lower().removesuffix(".gz").endswith(LOG_SUFFIXES)
        ride = "; a recorded ride is for estimate, or for replay onto a bus" if replayed else ""
        name = self.prog.partition(" ")[2]
        return f"; {name} takes files and folders behind its options only: {', '.join(taking)}{ride}"

    def known_options(self) -> list[str]:
        """The options of this command and of its subcommands, without their old names."""
        options: list[str] = []
        for action in self._actions:
            options += action.option_strings if action.help != argparse.SUPPRESS else []
            if isinstance(action, argparse._SubParsersAction):
                for parser in action.choices.values():
                    options += parser.known_options()
        return options


def command_line(called: Collection[str]) -> argparse.ArgumentParser:
    """The command line with the arguments of the commands `called`; the others' would only cost their import."""
    statuses = "\n".join(f"  {status:<4} {text}" for status, text in EXIT_STATUSES.items())
    parser = _Parser(
        prog="gz-onboard",
        description="Range of an electric scooter from its CAN bus, and what its model gets wrong.",
        epilog=f"exit status:\n{statuses}",
    )
    parser.add_argument("--version", action="version", version=f"gz-onboard {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=_Parser)
    for name, (module, text) in COMMANDS.items():
        help_ = text.replace("%", "%%")  # argparse expands % in it, and not in the description
        command = commands.add_parser(name, help=help_, description=text, allow_abbrev=False)
        if name in called:
            importlib.import_module(module).add_arguments(command)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line `argv`; gives the exit status: 0, or one of those in `errors`."""
    # Our matrices are small, and large work runs in processes of its own: threads would only get in each other's way.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    if isinstance(sys.stdout, io.TextIOWrapper):  # names of files that are not UTF-8, or a terminal that has no ±
        sys.stdout.reconfigure(errors="replace")
    argv = list(sys.argv[1:] if argv is None else argv)
    called = next((word for word in argv if not word.startswith("-")), "")
    try:
        with naming():
            arguments = command_line([called]).parse_args(argv)
            called = f"{called} {getattr(arguments, 'part', '')}".rstrip()  # as in `vehicle check`
            status: int = importlib.import_module(COMMANDS[arguments.command][0]).run(arguments)
        sys.stdout.flush()  # here, where a full disk is a message
        return status
    except InputError as error:
        print(f"gz-onboard {called}: {error}", file=sys.stderr)
        _let_go()
        return BAD_INPUT
    except ModuleNotFoundError as error:
        if not (missing := lacking_extra(error)):
            raise
        print(f"gz-onboard {called}: {missing}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:  # the reader of our output went away
        sys.stderr.close()
        return FAILED
    except OSError as error:  # what is left is mostly a disk that is full
        print(f"gz-onboard {called}: {error}", file=sys.stderr)
        _let_go()
        return FAILED


def _let_go() -> None:
    """Drop output that cannot be written: at its end the interpreter would try again, and give status 120 for ours."""
    if sys.stdout is None:
        return
    try:
        sys.stdout.flush()
    except OSError:
        with suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    sys.exit(main())
