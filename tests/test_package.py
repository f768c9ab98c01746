"""The package as it is built and installed: on a board without the lab's packages, and said clearly what lacks them."""

from __future__ import annotations

import re
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from importlib.metadata import Distribution, distribution
from pathlib import Path

import pytest
from packaging.metadata import Metadata
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.support import LOGS, ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
INSTALL = r"pip install 'gz-onboard\[lab\]'"
HEAVY = {"scipy", "matplotlib", "pyarrow", "filterpy", "pandas", "asammdf", "paho", "foxglove"}


def run(*command: object, cwd: Path | None = None, status: int = 0) -> subprocess.CompletedProcess[str]:
    """Without this checkout on any path; `python -c` has the working directory on its own."""
    environment = {"PATH": "/usr/bin:/bin", "LANG": "C.UTF-8"}
    words = [str(word) for word in command]
    done = subprocess.run(
        words, cwd=cwd or "/", env=environment, capture_output=True, text=True, check=False, timeout=900
    )
    assert done.returncode == status, done.stdout + done.stderr
    return done


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> tuple[Path, Path]:
    """(wheel, sdist), as `python -m build` makes them: the wheel out of the sdist."""
    out = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", out, ROOT)
    (wheel,), (sdist,) = out.glob("*.whl"), out.glob("*.tar.gz")
    return wheel, sdist


def written_metadata(package: Path) -> bytes:
    """The metadata as they stand in a wheel or an sdist."""
    if package.suffix == ".whl":
        with zipfile.ZipFile(package) as file:
            (name,) = (name for name in file.namelist() if name.endswith(".dist-info/METADATA"))
            return file.read(name)
    with tarfile.open(package) as archive:
        found = archive.extractfile(f"{package.name.removesuffix('.tar.gz')}/PKG-INFO")
        assert found
        return found.read()


def metadata(package: Path) -> Metadata:
    return Metadata.from_email(written_metadata(package), validate=True)


# --- what is built ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [0, 1], ids=["wheel", "sdist"])
def test_the_metadata_is_what_an_index_takes(built, kind):
    """What `twine check --strict` looks at, and more: rendering Markdown cannot fail."""
    told = metadata(built[kind])
    assert told.description_content_type == "text/markdown"
    assert told.description
    assert told.description.startswith("# gz_onboard")
    assert told.license_expression == "MIT"
    assert set(told.provides_extra or ()) == set(PROJECT["optional-dependencies"])
    from trove_classifiers import classifiers

    assert set(told.classifiers or ()) <= classifiers


def test_the_wheel_has_the_package_and_its_data_and_nothing_else(built):
    with zipfile.ZipFile(built[0]) as file:
        names = {name for name in file.namelist() if ".dist-info/" not in name}
    assert {"gz_onboard/py.typed", "gz_onboard/vehicles/reference.toml", "gz_onboard/dbc/vehicle.dbc"} <= names
    assert {name.split("/")[0] for name in names} == {"gz_onboard"}
    there = {path.relative_to(ROOT) for path in (ROOT / "gz_onboard").rglob("*") if path.is_file()}
    own = {path.as_posix() for path in there if "__pycache__" not in path.parts}
    assert {name for name in names if not name.startswith("gz_onboard/dbc/")} == own


def test_the_board_needs_nothing_of_the_lab():
    needed = {canonicalize_name(Requirement(text).name) for text in PROJECT["dependencies"]}
    assert not needed & HEAVY
    lab = {canonicalize_name(Requirement(text).name) for text in PROJECT["optional-dependencies"]["lab"]}
    assert not needed & lab
    assert {"scipy", "matplotlib", "pyarrow"} <= lab


def test_the_lock_is_made_of_every_extra():
    setup = (ROOT / ".ci/setup").read_text(encoding="utf-8")
    (lock,) = re.findall(r"compile \.ci/requirements\.txt (.*) pyproject\.toml -", setup)
    assert set(re.findall(r"--extra (\w+)", lock)) == set(PROJECT["optional-dependencies"]) - {"docs"}


# --- installed on a board -----------------------------------------------------------------------------------------


def closure(needed: list[Requirement]) -> dict[str, Distribution]:
    """What has to be installed for `needed`, and for that in turn."""
    found: dict[str, Distribution] = {}
    todo = [one for one in needed if not one.marker or one.marker.evaluate({"extra": ""})]
    while todo:
        name = canonicalize_name(todo.pop().name)
        if name not in found:
            found[name] = distribution(name)
            more = map(Requirement, found[name].requires or [])
            todo += [one for one in more if not one.marker or one.marker.evaluate({"extra": ""})]
    return found


@pytest.fixture(scope="module")
def board(built: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bin folder of a virtual environment with the wheel and what it needs without any extra, and nothing more."""
    root = tmp_path_factory.mktemp("board")
    venv.create(root, with_pip=False)
    (site,) = root.glob("lib/python3*/site-packages")
    (wheel, _) = built
    for one in closure([Requirement(str(text)) for text in metadata(wheel).requires_dist or []]).values():
        for top in {path.parts[0] for path in one.files or ()} - {"..", "__pycache__"}:
            if not (site / top).exists():
                (site / top).symlink_to(str(one.locate_file(top)))
    pip = [sys.executable, "-m", "pip", "--python", str(root / "bin/python"), "--disable-pip-version-check"]
    run(*pip, "install", "--no-deps", "--no-index", "--quiet", wheel)
    return root / "bin"


def test_nothing_that_is_needed_is_missing(board):
    told = run(sys.executable, "-m", "pip", "--python", board / "python", "--disable-pip-version-check", "check").stdout
    assert told.strip() == "No broken requirements found."


def test_the_board_has_nothing_of_the_lab(board):
    code = (
        "import importlib.util as u, sys;"
        f"print([n for n in {sorted(HEAVY)} if u.find_spec(n)], u.find_spec('gz_onboard').origin)"
    )
    told = run(board / "python", "-c", code).stdout
    assert told.startswith("[] ")
    assert str(board.parent) in told


@pytest.mark.parametrize(
    "command", [[], ["run"], ["dashboard"], ["mqtt"], ["foxglove"], ["replay"], ["learned"], ["route"], ["export"]]
)
def test_the_boards_commands_have_their_help(board, command):
    assert run(board / "gz-onboard", *command, "--help").stdout.startswith("usage: gz-onboard")


RIDE = """
import os, signal, socket, sys, threading, time
from pathlib import Path
from gz_onboard import cli
from gz_onboard.recording.logs import read_samples

log, folder = sys.argv[1:]
bus = ["--interface", "virtual", "--channel", "board"]

def estimated():
    with_range = 0
    for file in Path(folder).glob("*.mcap"):
        with_range += sum(t == "/estimate" and v["range"] is not None for t, _, v in read_samples(file))
    return with_range

ready = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
ready.bind(folder + "/ready")
ready.settimeout(300)
os.environ["NOTIFY_SOCKET"] = folder + "/ready"

def ride():
    try:
        while b"READY=1" not in ready.recv(4096):
            pass
        cli.main(["replay", log, *bus, "--speed", "2", "--to", "20", "--quiet"])
        for _ in range(500):
            if estimated():
                break
            time.sleep(0.2)
    finally:
        os.kill(os.getpid(), signal.SIGTERM)

threading.Thread(target=ride, daemon=True).start()
status = cli.main(["run", *bus, "--log-dir", folder, "--state-dir", folder])
print(status, estimated() > 0, sorted(set(sys.modules) & set(%r)))
"""


def test_the_daemon_runs_on_the_board(board, tmp_path):
    """A recorded ride on an in-process bus: ranges are in its log."""
    told = run(board / "python", "-c", RIDE % sorted(HEAVY), LOGS / "coastdown.blf", tmp_path).stdout
    assert told.splitlines()[-1] == "0 True []"
    (log,) = tmp_path.glob("*.mcap")
    assert run(board / "gz-onboard", "export", log, tmp_path / "estimates.csv", "--estimates").stdout
    assert "range[m]" in (tmp_path / "estimates.csv").read_text().splitlines()[0]
    assert run(board / "gz-onboard", "export", log, tmp_path / "signals.jsonl").stdout


@pytest.mark.parametrize("command", ["estimate", "simulate", "validate", "calibrate", "discover", "report"])
def test_a_command_of_the_lab_says_what_to_install(board, tmp_path, command):
    arguments: dict[str, list[object]] = {
        "simulate": ["ece15"],
        "calibrate": ["motor", LOGS / "calibration/motor_dyno.csv.gz"],
    }
    given = arguments.get(command, [LOGS / "coastdown.blf"])
    told = run(board / "gz-onboard", command, *given, cwd=tmp_path, status=2)
    (line,) = told.stderr.splitlines()
    said = rf"gz-onboard {command}: needs (scipy|matplotlib|pyarrow|tomlkit), which is not installed: {INSTALL}"
    assert re.fullmatch(said, line)
    assert told.stdout == ""
    assert not list(tmp_path.iterdir())
