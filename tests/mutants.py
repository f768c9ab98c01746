"""``make mutants``: which wrong lines do the tests not notice?

Changes one place at a time (a comparison, a sign, a number, a condition, a returned value) in decoder, battery filter,
plausibility, saved state and forecast, and runs the fast tests of that part until one fails. A change that no test
notices survives. Survivors listed with a reason in tests/mutants.toml do not count.

    python -m tests.mutants [--places 300] [--seed 1] [--jobs 2] [--part battery]
"""

from __future__ import annotations

import argparse
import ast
import compileall
import os
import py_compile
import random
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

ROOT = Path(__file__).parents[1]
REASONS = Path(__file__).with_suffix(".toml")
LEAST_KILLED = 0.95
LONGEST_S = 300  # of CPU: a change that makes a loop endless is noticed
GOLDEN = "tests/replay/test_golden.py"
PARTS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "decoder": (
        ("can/codec.py", "can/layout.py", "recording/decode.py"),
        (
            "tests/can/test_codec.py",
            "tests/recording/test_windows.py",
            "tests/recording/test_decode.py",
            GOLDEN,
            "tests/faults/test_time.py",
            "tests/display/test_vehicle_frames.py",
        ),
    ),
    "battery": (
        ("estimator/battery_filter.py", "estimator/battery_pack.py", "estimator/battery_priors.py", "model/battery.py"),
        (
            "tests/estimator/test_battery_filter.py",
            "tests/model/test_battery.py",
            "tests/estimator/test_parts.py",
            "tests/estimator/test_start_riding.py",
            GOLDEN,
            "tests/estimator/test_life.py",
        ),
    ),
    "plausibility": (
        (
            "estimator/plausibility/electrical.py",
            "estimator/plausibility/motion.py",
            "estimator/plausibility/residual.py",
        ),
        (
            "tests/estimator/test_plausibility.py",
            "tests/estimator/test_silence.py",
            "tests/estimator/test_temperatures.py",
            GOLDEN,
        ),
    ),
    "state": (
        ("state.py", "estimator/saved_state.py"),
        (
            "tests/test_state.py",
            "tests/estimator/test_life.py::test_a_snapshot_that_does_not_fit_is_refused",
            "tests/test_daemon.py",
        ),
    ),
    "forecast": (
        ("estimator/forecast.py", "estimator/consumption.py"),
        ("tests/estimator/test_forecast.py", "tests/estimator/test_consumption.py", GOLDEN),
    ),
}
"""By part: the files that are changed, and the tests that have to notice, fastest first."""

COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.GtE,
    ast.GtE: ast.Lt,
    ast.Gt: ast.LtE,
    ast.LtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}


@dataclass(frozen=True)
class Mutant:
    """One changed place. path: below gz_onboard."""

    part: str
    path: str
    line: int
    change: str
    text: str  # of the changed file

    @property
    def name(self) -> str:
        """How it is listed, without the line, which moves."""
        return f"{self.path}: {self.change}"


def mutants(part: str, path: str) -> Iterator[Mutant]:
    """Each change of a file below gz_onboard."""
    source = (ROOT / "gz_onboard" / path).read_text(encoding="utf-8")
    tree = ast.parse(source)
    for function in ast.walk(tree):
        if not isinstance(function, ast.FunctionDef):
            continue
        for statement in function.body:
            for node in _code(statement):
                for old, new in _changes(node):
                    change = f"{function.name}: {ast.unparse(old)} -> {ast.unparse(new)}"
                    yield Mutant(
                        part, path, getattr(node, "lineno", function.lineno), change, _replaced(source, old, new)
                    )


def _code(statement: ast.stmt) -> Iterator[ast.AST]:
    """The nodes of a statement that run: no annotations, messages of errors, nested functions."""
    pending: list[ast.AST] = [statement]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.Raise | ast.FunctionDef | ast.Assert | ast.JoinedStr):
            continue
        yield node
        skipped = ("annotation", "returns") if isinstance(node, ast.AnnAssign) else ()
        for field, value in ast.iter_fields(node):
            if field not in skipped:
                pending += [
                    child for child in (value if isinstance(value, list) else [value]) if isinstance(child, ast.AST)
                ]


def _changes(node: ast.AST) -> Iterator[tuple[ast.expr, ast.expr]]:
    """(an expression of the node, what takes its place)."""
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        yield node, ast.Compare(node.left, [COMPARISONS[type(node.ops[0])]()], node.comparators)
    elif isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
        yield node, ast.BinOp(node.left, OPERATORS[type(node.op)](), node.right)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub) and not isinstance(node.operand, ast.Constant):
        yield node, node.operand
    elif isinstance(node, ast.BoolOp):
        yield node, ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values)
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool):
        yield node, ast.Constant(2 * node.value if node.value else 1)
    elif isinstance(node, ast.If | ast.IfExp):
        yield node.test, ast.UnaryOp(ast.Not(), node.test)
    elif isinstance(node, ast.Return) and node.value and not isinstance(node.value, ast.Constant):
        yield node.value, ast.Constant(None)


def _replaced(source: str, old: ast.expr, new: ast.expr) -> str:
    lines = source.splitlines(keepends=True)
    before = "".join(lines[: old.lineno - 1]) + lines[old.lineno - 1].encode()[: old.col_offset].decode()
    last = (old.end_lineno or old.lineno) - 1
    after = lines[last].encode()[old.end_col_offset or 0 :].decode() + "".join(lines[last + 1 :])
    return f"{before}({ast.unparse(new)}){after}"


def chosen(places: int, seed: int, parts: list[str]) -> list[Mutant]:
    """As many of each part, drawn without replacement."""
    drawn = random.Random(seed)
    found: list[Mutant] = []
    for part in parts:
        every = [mutant for path in PARTS[part][0] for mutant in mutants(part, path)]
        found += drawn.sample(every, min(places // len(parts), len(every)))
    return found


class Checkouts:
    """Copies of package and tests, one for each job, so that a change disturbs no other run."""

    def __init__(self, folder: Path, jobs: int) -> None:
        self.free: SimpleQueue[Path] = SimpleQueue()
        for i in range(jobs):
            copy = folder / str(i)
            shutil.copytree(ROOT / "gz_onboard", copy / "gz_onboard", ignore=shutil.ignore_patterns("__pycache__"))
            shutil.copytree(ROOT / "tests", copy / "tests", ignore=shutil.ignore_patterns("__pycache__"))
            for other in ROOT.iterdir():
                if other.name not in ("gz_onboard", "tests", ".git"):
                    (copy / other.name).symlink_to(other)
            checked = py_compile.PycInvalidationMode.CHECKED_HASH  # times of change are too coarse for quick changes
            compileall.compile_dir(copy / "gz_onboard", quiet=1, invalidation_mode=checked)
            self.free.put(copy)

    def survives(self, mutant: Mutant) -> bool:
        """Whether all tests of its part pass with the change."""
        copy = self.free.get()
        file = copy / "gz_onboard" / mutant.path
        before = file.read_text(encoding="utf-8")
        try:
            file.write_text(mutant.text, encoding="utf-8")
            return passes(copy, PARTS[mutant.part][1])
        finally:
            file.write_text(before, encoding="utf-8")
            self.free.put(copy)


def passes(folder: Path, tests: Iterable[str]) -> bool:
    """Whether the tests pass in a checkout."""
    pytest = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", *tests]
    environment = os.environ | {"PYTHONPATH": str(folder), "CI": "true"}
    limited = ["prlimit", f"--cpu={LONGEST_S}", *pytest]
    return subprocess.run(limited, cwd=folder, env=environment, capture_output=True, check=False).returncode == 0


def main() -> int:
    """Status 0 if at least 95 % are noticed, or have a reason."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--places", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--part", choices=PARTS, action="append")
    arguments = parser.parse_args()
    reasons = tomllib.loads(REASONS.read_text(encoding="utf-8")) if REASONS.exists() else {}
    parts = arguments.part or list(PARTS)
    every = chosen(arguments.places, arguments.seed, parts)
    survivors: list[Mutant] = []
    with tempfile.TemporaryDirectory() as folder:
        checkouts = Checkouts(Path(folder), arguments.jobs)
        for part in parts:
            if not passes(Path(folder, "0"), PARTS[part][1]):
                print(f"the tests of {part} fail without a change")
                return 1
        with ThreadPoolExecutor(arguments.jobs) as pool:
            for n, (mutant, survived) in enumerate(zip(every, pool.map(checkouts.survives, every), strict=True), 1):
                if n % 20 == 0:
                    print(f"{n} of {len(every)}, {len(survivors)} survived", file=sys.stderr, flush=True)
                if survived:
                    survivors.append(mutant)
                    reason = reasons.get(mutant.name)
                    print(f"survived: {mutant.part}, {mutant.path}:{mutant.line}, {mutant.change}", flush=True)
                    if reason:
                        print(f"    known: {reason}")
    unknown = [mutant for mutant in survivors if mutant.name not in reasons]
    killed = 1 - len(unknown) / len(every)
    counts = (
        f"{len(every)} places changed, {len(survivors)} survived, {len(survivors) - len(unknown)} of them with a reason"
    )
    print(f"{counts}: {100 * killed:.1f} % noticed (at least {100 * LEAST_KILLED:.0f} %)")
    return 0 if killed >= LEAST_KILLED else 1


if __name__ == "__main__":
    sys.exit(main())
