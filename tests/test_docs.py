"""The documentation is true to the repository: links, names of files and modules, commands and their options."""

from __future__ import annotations

import importlib
import re
import runpy
import shlex
from pathlib import Path

import pytest

from gz_onboard.cli import command_line

ROOT = Path(__file__).parents[1]
DOCS = sorted((ROOT / "docs").glob("*.md"))
PAGES = [
    *DOCS,
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "systemd/README.md")),
    *sorted(ROOT.glob("replay_logs/**/README.md")),
]
TEXT = {page: page.read_text(encoding="utf-8") for page in PAGES}
GUIDE = {
    "index",
    "quick-start",
    "commands",
    "python",
    "another-vehicle",
    "vehicle-file",
    "own-effect",
    "range-frames",
    "why",
    "road-ahead",
    "dashboard",
    "home-assistant",
    "report",
    "history",
    "log-format",
    "service",
    "limits",
}
METHOD = {"architecture", "simulation", "cycles", "discovery", "forecast", "turning"}
MEASURED_BY = re.compile(
    r"`[^`]*?(?:python (?:-m )?([\w./]+)|make (\w+)|gz-onboard (\w+))[^`]*`|python (benchmarks/\w+\.py)"
)


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def anchors(page: Path) -> set[str]:
    """Those of its headings, as GitHub and the site make them."""
    heads = re.findall(r"^#+ (.*)$", re.sub(r"^```.*?^```$", "", TEXT[page], flags=re.M | re.S), re.M)
    return {re.sub(r"[^\w\- ]", "", re.sub(r"[`*]", "", head).lower()).replace(" ", "-") for head in heads}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", TEXT[page]):
        if target.startswith("http"):
            continue
        path, _, anchor = target.partition("#")
        there = (page.parent / path).resolve() if path else page
        assert there.exists() or path == "api/index.rst", target  # the latter is made with the site
        if anchor:
            assert anchor in anchors(there), target


def test_what_a_page_includes_is_also_linked_for_who_reads_it_where_nothing_is_included():
    included = [(page, file) for page in DOCS for file in re.findall(r"^```\{include\} (\S+)", TEXT[page], re.M)]
    assert included
    for page, file in included:
        assert re.search(rf"^% .*\]\({re.escape(file)}[#)]", TEXT[page], re.M), name_of(page)


def test_every_page_is_on_the_front_page():
    listed = re.findall(
        r"^([\w-]+)$",
        "\n".join(re.findall(r"^```\{toctree\}(.*?)^```", TEXT[ROOT / "docs/index.md"], re.M | re.S)),
        re.M,
    )
    assert sorted(listed) == sorted(page.stem for page in DOCS if page.stem != "index")


@pytest.mark.parametrize("page", [ROOT / "docs/architecture.md", ROOT / "CONTRIBUTING.md"], ids=name_of)
def test_what_it_names_exists(page):
    named = re.findall(r"`([\w./*-]+)`", TEXT[page])
    files = [name for name in named if "/" in name or name.endswith((".py", ".md", ".dbc", ".txt"))]
    assert len(files) > 10
    for name in files:
        assert any((ROOT / folder / name).exists() for folder in ("", "gz_onboard")), name
    for name in (name for name in named if name.startswith("gz_onboard.")):
        importlib.import_module(name)


@pytest.mark.parametrize("page", [page for page in DOCS if page.stem not in GUIDE | METHOD], ids=name_of)
def test_results_name_the_command_that_measures_them(page):
    """In their first lines; and it is there."""
    found = MEASURED_BY.findall("\n".join(TEXT[page].splitlines()[:20]))
    assert found, "which command made this?"
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for script, target, command, indented in found:
        for path in filter(None, (script, indented)):
            assert (ROOT / (path if path.endswith(".py") else path.replace(".", "/"))).exists() or (
                ROOT / f"{path.replace('.', '/')}.py"
            ).exists(), path
        assert not target or re.search(rf"^{target}:", makefile, re.M), target
        assert not command or command_line([command]), command


def commands() -> list[str]:
    """Lines in blocks of code that begin with gz-onboard; columns of words beside them cut off."""
    found = []
    for page, text in TEXT.items():
        for line in re.findall(
            r"^ *(?:\$ |    )(gz-onboard (?!.*--help|\w+:).*)$|^(gz-onboard (?!.*--help|\w+:).*)$", text, re.M
        ):
            found.append(f"{page.name}: " + re.split(r"  +| [|#>]| & ", "".join(line))[0])
    return found


def test_commands_are_found():
    assert len(commands()) > 40


@pytest.mark.parametrize("line", commands())
def test_commands_have_the_options_that_they_are_shown_with(line):
    arguments = shlex.split(line.partition(": gz-onboard ")[2].replace("...", ""))
    command_line(arguments[:1]).parse_args(arguments)


def test_the_reference_of_commands_is_as_the_code_has_it():
    made = runpy.run_path(str(ROOT / "docs" / "reference.py"))["page"]()
    assert made == TEXT[ROOT / "docs" / "commands.md"]
    assert "| `energy_wh` |" in made


def test_marks_name_what_makes_the_rest():
    for page, text in TEXT.items():
        for maker in re.findall(r"<!-- made by (.+) from here on -->", text):
            command = maker.removeprefix("gz-onboard ")
            assert (ROOT / maker).is_file() if command == maker else command_line([command]), f"{page.name}: {maker}"
