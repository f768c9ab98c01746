"""Imports point one way, and what runs on the scooter stays light."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import gz_onboard
from gz_onboard.model.effect import BASE_EFFECTS, QUANTITIES

PACKAGE = Path(__file__).parents[1] / "gz_onboard"

# The parts of the package, lowest first. A part imports itself and those in the lines above its own.
LAYERS = [
    ["arrays", "background", "constants", "errors", "events", "notify", "progress", "state"],
    ["arguments", "imports", "options"],
    ["toml", "routes"],
    ["can", "model"],
    ["vehicle"],
    ["priors"],
    ["estimator"],
    ["log_rows"],
    ["pipeline"],
    ["recording"],
    ["reports"],
    ["processes", "export"],
    ["simulation"],
    ["estimation", "validation"],
    ["display"],
    ["calibration"],
    ["discovery"],
    ["vehicle_check"],
    ["daemon"],
    ["api"],
    ["cli", "__init__"],  # the latter has the names of the API, imported when first asked for
    ["__main__"],
]
LEVEL = {part: level for level, parts in enumerate(LAYERS) for part in parts}

OFFLINE = (
    "recording",
    "reports",
    "simulation",
    "estimation",
    "validation",
    "processes",
    "export",
    "calibration",
    "discovery",
    "vehicle_check",
    "api",
)
# Lower, and yet nothing that these need know.
FORBIDDEN = {
    ("estimator", "can"): "events are all that the estimator sees of a bus",
    **{("daemon", part): "the daemon carries no offline tools" for part in OFFLINE},
}

HEAVY = {"numpy", "scipy", "matplotlib", "pandas", "filterpy", "asammdf", "pyarrow", "paho", "foxglove"}
# Imported only on request, or for types: the reference filter behind --filter filterpy, arrays, the MQTT client.
ON_REQUEST = {"estimator/filterpy_reference.py", "arrays.py", "model/series.py", "display/broker.py"}

MODULES = sorted(path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py"))


def part_of(module: Path) -> str:
    return module.parts[0].removesuffix(".py")


def imports(nodes: Iterator[ast.AST] | list[ast.stmt], module: Path) -> Iterator[str]:
    """The absolute names that these nodes import; for ``from a import b`` both ``a`` and ``a.b``."""
    package = ["gz_onboard", *module.parent.parts]
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            origin = ".".join([*base, *([node.module] if node.module else [])])
            yield origin
            yield from (f"{origin}.{alias.name}" for alias in node.names)


def at_import_time(body: list[ast.stmt]) -> Iterator[ast.AST]:
    """The statements that run when the module is imported, thus not those of functions."""
    for node in body:
        yield node
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            yield from at_import_time(node.orelse)
        elif not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            for field in ("body", "orelse", "finalbody"):
                yield from at_import_time(getattr(node, field, []))
            for handler in getattr(node, "handlers", []):
                yield from at_import_time(handler.body)


@pytest.mark.parametrize("module", MODULES, ids=str)
def test_imports_point_one_way(module):
    part = part_of(module)
    assert part in LEVEL, f"gz_onboard/{part} has no place in LAYERS yet"
    tree = ast.parse((PACKAGE / module).read_text(encoding="utf-8"))
    for name in imports(ast.walk(tree), module):
        if not name.startswith("gz_onboard."):
            continue
        other = name.split(".")[1]
        if other == part or other not in LEVEL:  # a name that gz_onboard/__init__.py defines
            continue
        assert LEVEL[other] < LEVEL[part], f"gz_onboard/{module} imports {name}, which is not below it"
        assert (part, other) not in FORBIDDEN, f"gz_onboard/{module} imports {name}: {FORBIDDEN[part, other]}"


@pytest.mark.parametrize(
    "module", [m for m in MODULES if part_of(m) not in OFFLINE and m.as_posix() not in ON_REQUEST], ids=str
)
def test_on_board_modules_import_nothing_heavy(module):
    body = ast.parse((PACKAGE / module).read_text(encoding="utf-8")).body
    heavy = HEAVY.intersection(name.split(".")[0] for name in imports(at_import_time(body), module))
    assert not heavy, f"gz_onboard/{module} imports {', '.join(sorted(heavy))} when it is imported"


def test_the_daemon_starts_light():
    """Without numpy, and on SocketCAN without python-can, which costs 9 MB."""
    code = (
        "import sys; from gz_onboard.daemon import command; from gz_onboard.vehicle import read_vehicle;"
        "from gz_onboard.pipeline import Pipeline; Pipeline(read_vehicle('reference')); print(*sys.modules)"
    )
    loaded = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.split()
    kept_out = HEAVY | {"can", "asyncio", "ssl", "importlib.metadata", "xml.etree", "statistics"}
    assert not kept_out & set(loaded)


def test_the_api_is_loaded_only_when_asked_for():
    code = (
        "import sys, gz_onboard.daemon.command as command, gz_onboard as gz; own = 'gz_onboard.api';"
        "before = own in sys.modules; gz.estimate; print(before, own in sys.modules)"
    )
    run = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert run.stdout.split() == ["False", "True"]


def graph() -> dict[str, set[str]]:
    """Of each module those of the package that it imports, inside functions too."""
    names = {".".join(["gz_onboard", *m.with_suffix("").parts]).removesuffix(".__init__"): m for m in MODULES}
    found = {}
    for name, module in names.items():
        tree = ast.parse((PACKAGE / module).read_text(encoding="utf-8"))
        said = {one for one in imports(ast.walk(tree), module) if one in names}
        packages = {one for one in said if any(other.startswith(f"{one}.") for other in said)}
        found[name] = said - packages - {name}
    return found


def circles(of: dict[str, set[str]]) -> list[list[str]]:
    """What is left once all that import nothing of what is left are taken away, and all that nothing imports."""
    left = dict(of)
    while bare := [name for name in left if not left[name] & left.keys()]:
        left = {name: found for name, found in left.items() if name not in bare}
    while unused := [name for name in left if not any(name in found for found in left.values())]:
        left = {name: found for name, found in left.items() if name not in unused}
    return [sorted(left)] if left else []


def test_no_modules_import_each_other_in_a_circle():
    assert circles(graph()) == []


def test_effects_are_known_by_what_they_declare():
    """No name of an effect outside its file, but for the list of those that a vehicle file gets that lists none."""
    effects = {path.stem for path in (PACKAGE / "model/effects").glob("*.py")} - set(QUANTITIES)
    listed = {PACKAGE / "model/effect.py": set(BASE_EFFECTS)}
    for module in set(PACKAGE.rglob("*.py")) - set((PACKAGE / "model/effects").glob("*.py")):
        nodes = ast.walk(ast.parse(module.read_text(encoding="utf-8")))
        named = {node.value for node in nodes if isinstance(node, ast.Constant)} & effects
        assert not named - listed.get(module, set()), f"{module.relative_to(PACKAGE)} names {named}"


def test_a_constant_of_nature_stands_once():
    holders = [str(module) for module in MODULES if "9.80665" in (PACKAGE / module).read_text()]
    assert holders == ["constants.py"]


def test_no_part_has_the_name_of_a_function_of_the_api():
    """Importing ``gz_onboard.discover`` would hide the function ``gz_onboard.discover``."""
    assert not {part_of(module) for module in MODULES} & set(gz_onboard.__all__)


def test_a_class_name_has_one_meaning():
    names: dict[str, list[str]] = {}
    for module in MODULES:
        for node in ast.walk(ast.parse((PACKAGE / module).read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                names.setdefault(node.name, []).append(str(module))
    assert {name: where for name, where in names.items() if len(where) > 1} == {}
