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
from typing import Any, NoReturn

from gz_onboard import __version__
from gz_onboard.errors import BAD_INPUT, EXIT_STATUSES, FAILED, INTERRUPTED, InputError, closest, naming, nearest
from gz_onboard.imports import missing_extra

COMMANDS = {
    "run": ("gz_onboard.daemon.command", "estimate the range from a live bus and publish it (the daemon)"),
    "learned": ("gz_onboard.daemon.learned", "show or reset the daemon's knowledge of battery and riders"),
    "route": ("gz_onboard.daemon.control", "give the running daemon a route, or clear it"),
    "dashboard": ("gz_onboard.display.command", "show the daemon's range in a terminal or a browser"),
    "mqtt": ("gz_onboard.display.mqtt", "publish the daemon's range on an MQTT broker, for Home Assistant"),
    "foxglove": ("gz_onboard.display.foxglove", "show the daemon's range live in Foxglove"),
    "replay": ("gz_onboard.recording.replay", "send a recorded log onto a bus, in its own timing"),
    "estimate": (
        "gz_onboard.estimation.command",
        "estimate the range on recorded rides, without a bus, as fast as possible",
    ),
    "simulate": ("gz_onboard.simulation.simulate", "simulate a drive cycle, a route or a recorded ride"),
    "validate": (
        "gz_onboard.validation.command",
        "compare recorded rides with their simulation: within 20 %, components within 10 %",
    ),
    "calibrate": ("gz_onboard.calibration.command", "determine a vehicle's parameters from measurements"),
    "discover": ("gz_onboard.discovery.command", "find the model's errors on rides, name the cause, extend the model"),
    "export": ("gz_onboard.export.command", "convert a log to candump, BLF, ASC, or its contents to Parquet, CSV, ..."),
    "vehicle": ("gz_onboard.vehicle_check.command", "begin a vehicle file, or check it against the vehicle's logs"),
    "report": ("gz_onboard.estimation.report", "show recorded rides as one self-contained HTML page, also for phones"),
}


class _Help(argparse.RawDescriptionHelpFormatter):
    """Help without the options in the usage line, as they are listed below it."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=30)

    def _format_usage(self, usage: str | None, actions: Any, groups: Any, prefix: str | None) -> str:
        # argparse asks for a subcommand's usage without its options.
        arguments = [action for action in actions if not action.option_strings]
        options = (
            [argparse.Action(["[OPTION ...]"], "", nargs=0, required=True)] if len(arguments) < len(actions) else []
        )
        return super()._format_usage(usage, options + arguments, [], prefix)


class _Parser(argparse.ArgumentParser):
    """An argument parser whose errors name the nearest right option or command."""

    def __init__(self, *args: Any, **others: Any) -> None:
        super().__init__(*args, **{"formatter_class": _Help, **others})

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Report unknown arguments of a command with the usage of that command."""
        known, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return known, unknown

    def error(self, message: str) -> NoReturn:
        if message.startswith("the following arguments are required: ") and self._subparsers:
            self.print_help(sys.stderr)  # lists the commands
            self.exit(BAD_INPUT, f"\n{self.prog}: error: {message}\n")
        wrong, _, choices = message.partition("invalid choice: ")[2].partition(" (choose from ")
        if wrong:
            message += nearest(wrong.strip("'"), re.findall(r"[^\s',)]+", choices))
        elif message.startswith("unrecognized arguments: "):
            wrong = next((word for word in message.split()[2:] if word.startswith("-")), "")
            bare = {option.lstrip("-"): option for action in self._actions for option in action.option_strings}
            near = closest(wrong.partition("=")[0].lstrip("-"), bare)  # the dashes that all have make none alike
            if near:
                message += f" (did you mean {bare[near]!r}?)"
            elif not wrong and any(not action.option_strings for action in self._actions):
                message += "; files go before the options"
        super().error(message)


def command_line(called: Collection[str]) -> argparse.ArgumentParser:
    """Return the parser, with the arguments of the commands `called` only: the others would cost their import."""
    statuses = "\n".join(f"  {status:<4} {text}" for status, text in EXIT_STATUSES.items())
    parser = _Parser(
        prog="gz-onboard",
        description="Range of an electric scooter from its CAN bus, and the errors of its model.",
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
    """Run the command line `argv` and return the exit status, see `EXIT_STATUSES`."""
    # The matrices are small, and large work runs in several processes: threads would only compete.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    if isinstance(sys.stdout, io.TextIOWrapper):  # file names that are not UTF-8, or a terminal without ±
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
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:  # the reader of our output went away
        sys.stderr.close()
        return FAILED
    except (InputError, ModuleNotFoundError, OSError) as error:  # an OSError that is left is mostly a full disk
        message = missing_extra(error) if isinstance(error, ModuleNotFoundError) else str(error)
        if not message:
            raise
        print(f"gz-onboard {called}: {message}", file=sys.stderr)
        _drop_output()
        return FAILED if isinstance(error, OSError) else BAD_INPUT


def _drop_output() -> None:
    """Drop output that cannot be written; the interpreter would try again at exit and return status 120."""
    if sys.stdout is None:
        return
    try:
        sys.stdout.flush()
    except OSError:
        with suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    sys.exit(main())
