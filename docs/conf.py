"""The documentation site: `make docs` builds it into build/docs, without network; a warning fails the build."""

from __future__ import annotations

import ast
import builtins
import importlib
import pkgutil
import re
import shutil
import sys
from pathlib import Path

from docutils import nodes
from sphinx.addnodes import desc_annotation, pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "gz_onboard"
API = Path(__file__).parent / "api"
sys.path[:0] = [str(ROOT), str(ROOT / "docs")]

project = "gz_onboard"
author = "The gz_onboard authors"
extensions = ["myst_parser", "sphinx.ext.autodoc"]
html_theme = "furo"
html_title = "gz_onboard"
html_copy_source = False
html_show_copyright = False

myst_heading_anchors = 4  # a link to a heading that is not there is a warning
nitpicky = True  # so is a type in a signature that is nowhere; see `exists`
autodoc_default_options = {"members": True, "member-order": "bysource", "ignore-module-all": True}
autodoc_typehints = "signature"
LONGEST_VALUE = 120  # characters of a constant that are shown
ALIASES = {  # what signatures spell out, and how the code says it
    "~numpy.ndarray[tuple[~typing.Any, ...], ~numpy.dtype[~numpy.float64]]": f"~{PACKAGE}.arrays.Array",
    "~numpy.ndarray[tuple[~typing.Any, ...], ~numpy.dtype[~numpy.bool]]": f"~{PACKAGE}.arrays.Mask",
    "tuple[int, int, bytes, int]": f"~{PACKAGE}.events.Frame",
    "tuple[float, int, tuple[float | None, ...]]": f"~{PACKAGE}.events.Event",
}


def write_api_pages() -> None:
    """Write a page for each package with all its modules."""
    shutil.rmtree(API, ignore_errors=True)
    API.mkdir()
    pages = []
    for init in sorted((ROOT / PACKAGE).rglob("__init__.py")):
        name = ".".join(init.parent.relative_to(ROOT).parts)
        modules = sorted(path.stem for path in init.parent.glob("*.py") if not path.stem.startswith("__"))
        lines = [name, "=" * len(name), "", f".. automodule:: {name}", ""]
        for module in (f"{name}.{stem}" for stem in modules):
            title = module.removeprefix(f"{PACKAGE}.")
            lines += [title, "-" * len(title), "", f".. automodule:: {module}", ""]
        (API / f"{name}.rst").write_text("\n".join(lines), encoding="utf-8")
        pages.append(name)
    title = "API reference"
    lines = [title, "=" * len(title), "", "Out of the docstrings, a page for each package.", "", ".. toctree::", ""]
    (API / "index.rst").write_text("\n".join([*lines, *(f"   {page}" for page in pages), ""]), encoding="utf-8")


def import_types() -> None:
    """Import the names of TYPE_CHECKING blocks, so that every annotation resolves."""
    package = importlib.import_module(PACKAGE)
    names = [info.name for info in pkgutil.walk_packages(package.__path__, f"{PACKAGE}.")]
    for module in [importlib.import_module(name) for name in names if not name.endswith("__main__")]:
        for node in ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8")).body:
            if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
                exec(compile(ast.Module(node.body, []), str(module.__file__), "exec"), module.__dict__)


def exists(
    app: Sphinx, environment: BuildEnvironment, node: pending_xref, shown: nodes.TextElement
) -> nodes.TextElement | None:
    """Return text without a link for an existing name without an entry, such as one of another package."""
    module, _, name = str(node["reftarget"]).partition("[")[0].rpartition(".")
    places = [sys.modules.get(module or str(node.get("py:module"))), builtins]
    outside = module and not module.startswith(PACKAGE)
    return shown if outside or any(hasattr(place, name) for place in places) else None


def hide_long_values(app: Sphinx, page: nodes.document) -> None:
    """Remove long values of constants from a page."""
    for node in list(page.findall(desc_annotation)):
        if len(node.astext()) > LONGEST_VALUE and " = " in node.astext()[:10]:
            node.parent.remove(node)


def as_rst(lines: list[str]) -> list[str]:
    """Return a docstring as reStructuredText: paragraphs, lists with "- ", `code`; indented lines become literal."""
    result: list[str] = []
    item = literal = False
    for line in lines:
        indent = len(line) - len(line.lstrip())
        begins = line.startswith("- ")
        if not line.strip():
            item = False
        elif indent and not item:
            if not literal:
                result += ["", "::", ""]
            literal = True
        else:
            if literal or (begins and not item):
                result.append("")
            literal, item = False, item or begins
        if literal:
            result.append(f"    {line}".rstrip())
        else:
            result.append(inline(line if begins or not item else f"  {line.lstrip()}"))
    return [*result, ""]


def inline(line: str) -> str:
    """Escape everything but code, so that equations and first words are not taken for markup."""
    parts = re.split(r"(``[^`]+``|`[^`]+`)", re.sub(r"::$", ":", line.rstrip()))
    code = [f"``{part.strip('`')}``" for part in parts[1::2]]
    text = [re.sub(r"([*_|\\])", r"\\\1", part) for part in parts[::2]]
    if re.match(r"\w+[.)] |[^\w\s\\-]|-(?! )", text[0]):
        text[0] = "\\" + text[0]
    return "".join(a + b for a, b in zip(text, [*(f"{c}\\ " for c in code), ""], strict=True))


def setup(app: Sphinx) -> None:
    """Connect the handlers; Sphinx calls this."""
    import_types()
    write_api_pages()
    importlib.import_module("reference").write_pages(ROOT / "docs" / "generated")

    def document(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
        lines[:] = as_rst(lines)

    def shorten(
        app: Sphinx, what: str, name: str, obj: object, options: object, signature: str | None, returned: str | None
    ) -> tuple[str | None, str | None]:
        for long, short in ALIASES.items():
            signature, returned = (text and text.replace(long, short) for text in (signature, returned))
        return signature, returned

    app.connect("autodoc-process-docstring", document)
    app.connect("autodoc-process-signature", shorten)
    app.connect("missing-reference", exists)
    app.connect("doctree-read", hide_long_values)
