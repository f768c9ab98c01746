"""Write a manual page and completions for bash and zsh from the command line's parser.

make man    # build/shell/gz-onboard.1, build/shell/gz-onboard.bash, build/shell/_gz-onboard
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import shtab

from gz_onboard import __version__
from gz_onboard.calibration.procedures import PROCEDURES
from gz_onboard.cli import COMMANDS, command_line
from gz_onboard.simulation import cycles
from gz_onboard.vehicle import OWN

ABOUT = "the remaining range of an electric scooter, estimated from its CAN bus"

OR_FILE = {  # names in place of which a file may be given, by the function that completes them
    "_gz_onboard_vehicles": tuple(sorted(file.stem for file in OWN.glob("*.toml"))),
    "_gz_onboard_procedures": ("all", *PROCEDURES),
    "_gz_onboard_cycles": cycles.NAMES,
}


def actions_of(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """Yield all arguments of a parser and its commands."""
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from actions_of(command)


def completion(shell: str) -> str:
    """Return the completion script for ``bash`` or ``zsh``; arguments that take a file complete file names."""
    parser = command_line(COMMANDS)
    for action in actions_of(parser):
        if action.type is Path or "TOML" in str(action.metavar) or action.metavar in ("FILE|-", "WHAT", "LOG"):
            action.complete = shtab.FILE  # type: ignore[attr-defined]
        if function := named_by(action):
            action.complete = {"bash": function, "zsh": function}  # type: ignore[attr-defined]
    return shtab.complete(parser, shell, preamble={"bash": preamble(BASH), "zsh": preamble(ZSH)})


BASH = """{name}() {{
  compgen -W "{names}" -- "$1"
  compgen -f -- "$1"
}}"""
ZSH = """{name}() {{
  _alternative 'names:name:({names})' 'files:file:_files'
}}"""


def named_by(action: argparse.Action) -> str:
    """Return the function of `OR_FILE` that completes an argument, or an empty string."""
    if "NAME|TOML" in str(action.metavar):
        return "_gz_onboard_vehicles"
    if action.metavar != "WHAT":
        return ""
    return "_gz_onboard_procedures" if "procedure" in (action.help or "") else "_gz_onboard_cycles"


def preamble(function: str) -> str:
    """Return the functions of `OR_FILE` for a shell."""
    return "\n".join(function.format(name=name, names=" ".join(names)) for name, names in OR_FILE.items())


def manual() -> str:
    """Return the manual page as troff."""
    os.environ["COLUMNS"] = "80"  # which argparse breaks its lines at
    parser = command_line(COMMANDS)
    lines = [f'.TH GZ\\-ONBOARD 1 "" "gz\\-onboard {__version__}" ""']
    lines += [".SH NAME", f"gz\\-onboard \\- {plain(ABOUT)}", ".SH SYNOPSIS", ".B gz\\-onboard", "COMMAND [OPTION ...]"]
    lines += [".SH COMMANDS"]
    (commands,) = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    for name, command in commands.choices.items():
        lines += [f".SS {name}", plain(command.description or ""), ".PP", *literal(command.format_usage())]
        formatter = command._get_formatter()
        for action in command._actions:
            if action.help and action.dest != "help":
                lines += [".TP", f".B {plain(formatter._format_action_invocation(action))}"]
                lines += [plain(formatter._expand_help(action))]
        lines += literal(command.epilog) if command.epilog else []
    title, _, statuses = (parser.epilog or "").partition(":\n")
    return "\n".join([*lines, f".SH {title.upper()}", *literal(statuses)])


def plain(text: str) -> str:
    """Return a paragraph with troff's markup characters escaped."""
    return escaped(" ".join(text.split()))


def escaped(line: str) -> str:
    """Return a line with troff's markup characters and request dots escaped."""
    line = line.replace("\\", "\\e").replace("-", "\\-")
    return f"\\&{line}" if line.startswith((".", "'")) else line


def literal(text: str) -> list[str]:
    """Return lines in a block without filling."""
    return [".PP", ".nf", *map(escaped, text.strip("\n").splitlines()), ".fi"]


def main() -> None:
    """Write all files to the folder on the command line."""
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    files = {"gz-onboard.1": manual(), "gz-onboard.bash": completion("bash"), "_gz-onboard": completion("zsh")}
    for name, text in files.items():
        (folder / name).write_text(text.rstrip() + "\n", encoding="utf-8")
        print(folder / name)


if __name__ == "__main__":
    main()
