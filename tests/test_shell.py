"""The manual page and the completions, made of the command line; bash itself completes."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from gz_onboard.cli import COMMANDS
from tests.support import LOGS, ROOT

pytest.importorskip("shtab", reason="`make setup` installs it")

# What bash does at the tabulator key: it calls the function with the words, and takes COMPREPLY.
COMPLETE = """
. "$1"; shift
COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMP_LINE="$*"; COMP_POINT=${#COMP_LINE}
function=$(complete -p gz-onboard | sed 's/.*-F \\([^ ]*\\).*/\\1/')
"$function" gz-onboard "${COMP_WORDS[COMP_CWORD]}" "${COMP_WORDS[COMP_CWORD-1]}"
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shell")
    subprocess.run([sys.executable, "docs/shell.py", folder], cwd=ROOT, check=True, capture_output=True)
    return folder


def completions(made: Path, *words: str) -> set[str]:
    command = ["bash", "-c", COMPLETE, "bash", str(made / "gz-onboard.bash"), "gz-onboard", *words]
    run = subprocess.run(command, cwd=LOGS, check=True, capture_output=True, text=True)
    return set(run.stdout.split())


def test_bash_completes_commands_options_choices_and_files(made):
    assert completions(made, "") >= set(COMMANDS)
    assert completions(made, "dis") == {"discover"}
    assert completions(made, "estimate", "--j") == {"--json", "--jobs"}
    assert completions(made, "run", "--filter", "") == {"scalar", "filterpy"}
    assert completions(made, "estimate", "./coast") == {"./coastdown.blf"}
    assert completions(made, "run", "--vehicle", "./ri") == {"./rides.json"}
    assert completions(made, "run", "--vehicle", "ref") == {"reference"}
    assert completions(made, "vehicle", "new", "--kind", "s") == {"scooter"}
    assert completions(made, "vehicle", "new", "--cells", "l") == {"lfp"}
    assert completions(made, "calibrate", "coastd") == {"coastdown", "coastdown.blf"}
    assert completions(made, "simulate", "ud") == {"udds"}


def test_zsh_has_every_command_and_option(made):
    text = (made / "_gz-onboard").read_text(encoding="utf-8")
    assert text.startswith("#compdef gz-onboard\n")
    assert all(f"\n    {name}:'" in text for name in COMMANDS)
    assert "--until-empty" in text
    if shutil.which("zsh"):
        subprocess.run(["zsh", "-n", made / "_gz-onboard"], check=True)


def test_the_manual_has_every_command_and_what_its_status_means(made):
    text = (made / "gz-onboard.1").read_text(encoding="utf-8")
    assert all(f"\n.SS {name}\n" in text for name in COMMANDS)
    assert text.splitlines()[2].startswith("gz\\-onboard \\- ")
    assert ".B \\-\\-payload KG\nmass of rider and luggage" in text
    assert ".SH EXIT STATUS\n" in text
    assert "%(" not in text
    assert "%%" not in text
    if not shutil.which("groff"):
        pytest.skip("no groff, which says whether it is a manual page")
    command = ["groff", "-man", "-Tutf8", "-ww", "-Kutf8", "-z", made / "gz-onboard.1"]
    run = subprocess.run(command, check=True, capture_output=True, text=True)
    assert [line for line in run.stderr.splitlines() if "can't break line" not in line and "adjust" not in line] == []
