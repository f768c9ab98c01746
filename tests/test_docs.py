"""The documentation matches the repository: links, named files and modules, commands and their options."""

from __future__ import annotations

import importlib
import re
import runpy
import shlex
from pathlib import Path

import pytest

from gz_onboard.cli import command_line

ROOT = Path(__file__).parents[1]
DOCS = sorted(page for page in (ROOT / "docs").rglob("*.md") if page.parent.name not in ("api", "generated"))
PAGES = [
    *DOCS,
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "systemd/README.md")),
    *sorted(ROOT.glob("replay_logs/**/README.md")),
]
TEXT = {page: page.read_text(encoding="utf-8") for page in PAGES}
RESULTS = [page for page in DOCS if page.parent.name == "results"]
MEASURED_BY = re.compile(
    r"`[^`]*?(?:python (?:-m )?([\w./]+)|make ([\w-]+)|gz-onboard (\w+))[^`]*`|python (?:-m )?(benchmarks[./]\w+)"
)
MADE_WITH_THE_SITE = ("docs/api/", "docs/generated/")


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub and the site make them."""
    heads = re.findall(r"^#+ (.*)$", re.sub(r"^```.*?^```$", "", TEXT[page], flags=re.M | re.S), re.M)
    return {re.sub(r"[^\w\- ]", "", re.sub(r"[`*]", "", head).lower()).replace(" ", "-") for head in heads}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", TEXT[page]):
        if target.startswith("http"):
            continue
        path, _, anchor = target.partition("#")
        there = (page.parent / path).resolve() if path else page
        if there.relative_to(ROOT).as_posix().startswith(MADE_WITH_THE_SITE):
            continue
        assert there.exists(), target
        if anchor:
            assert anchor in anchors(there), target


def test_every_page_is_in_the_table_of_contents():
    listed = re.findall(
        r"^([\w/-]+)$",
        "\n".join(re.findall(r"^```\{toctree\}(.*?)^```", TEXT[ROOT / "docs/index.md"], re.M | re.S)),
        re.M,
    )
    written = [page.relative_to(ROOT / "docs").with_suffix("").as_posix() for page in DOCS]
    made = [page for page in listed if f"docs/{page}".startswith(MADE_WITH_THE_SITE)]
    assert sorted(["index", *listed]) == sorted([*written, *made])


@pytest.mark.parametrize(
    "page", [ROOT / "docs/explanation/architecture.md", ROOT / "CONTRIBUTING.md", ROOT / "README.md"], ids=name_of
)
def test_named_files_and_modules_exist(page):
    named = re.findall(r"`([\w./*-]+)`", TEXT[page])
    for name in (name for name in named if "/" in name or name.endswith((".py", ".md", ".dbc", ".txt"))):
        assert any((ROOT / folder / name).exists() for folder in ("", "gz_onboard")), name
    for name in (name for name in named if name.startswith("gz_onboard.")):
        importlib.import_module(name)


@pytest.mark.parametrize("page", RESULTS, ids=name_of)
def test_results_name_the_command_that_measures_them(page):
    found = MEASURED_BY.findall("\n".join(TEXT[page].splitlines()[:20]))
    assert found, "which command made this?"
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for script, target, command, indented in found:
        for path in filter(None, (script, indented)):
            stem = path.removesuffix(".py").replace(".", "/")
            assert (ROOT / stem).exists() or (ROOT / f"{stem}.py").exists(), path
        assert not target or re.search(rf"^{target}:", makefile, re.M), target
        assert not command or command_line([command]), command


def commands() -> list[str]:
    """Lines of code blocks that begin with gz-onboard, without the words in a second column."""
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


def test_reference_pages_are_made_from_the_code(tmp_path):
    runpy.run_path(str(ROOT / "docs" / "reference.py"))["write_pages"](tmp_path)
    pages = {file.stem: file.read_text(encoding="utf-8") for file in tmp_path.iterdir()}
    assert "\n## discover\n" in pages["commands"]
    assert "| `energy_wh` |" in pages["commands"]
    assert "| `drag_area` (required) | m² |" in pages["vehicle"]
    assert "| `RANGE_RemainingP10` |" in pages["range-frames"]


def test_marks_name_the_script_that_made_the_rest():
    for page, text in TEXT.items():
        for maker in re.findall(r"<!-- made by (.+) from here on -->", text):
            command = maker.removeprefix("gz-onboard ")
            assert (ROOT / maker).is_file() if command == maker else command_line([command]), f"{page.name}: {maker}"
