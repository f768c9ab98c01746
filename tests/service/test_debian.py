"""The Debian package in the life of a board: installed, changed, upgraded, removed, purged.

The guest's root is the host's, so the packages that it depends on are there.
"""

from __future__ import annotations

import os
import pwd
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.service.support import ROOT, SOC, UNIT, Listener, main_pid, output, show, systemctl, wait_for
from tests.service.test_dashboard import PAGE, active, latest
from tests.service.test_mqtt import BRIDGE

OPT = Path("/opt/gz-onboard")
SETTINGS = Path("/etc/default/gz-onboard")
NETWORK = Path("/etc/systemd/network/80-can0.network")
OWN = ("/var/lib/private", "/var/log/private", "/var/lib", "/var/log")  # the service's folders, and the links to them
UNITS = UNIT, PAGE, BRIDGE
BY_HAND = [OPT, SETTINGS, *(Path("/etc/systemd/system") / name for unit in UNITS for name in (unit, f"{unit}.d"))]
BY_HAND += [Path(folder) / name for folder in OWN for name in ("gz-onboard", "gz-onboard-dashboard")]
WRITTEN = ["/etc", "/etc/default", "/etc/systemd", "/etc/systemd/network", "/etc/systemd/system", "/opt", "/usr/bin"]
WRITTEN += ["/usr/lib/systemd/system", "/usr/lib/sysusers.d", "/usr/share/doc", "/usr/share/man/man1"]
WRITTEN += ["/usr/share/bash-completion/completions", "/usr/share/zsh/vendor-completions", "/var/lib/dpkg/info"]
WRITTEN += ["/var/lib", "/var/lib/private", "/var/log", "/var/log/private", "/run"]
KEPT_BY_OTHERS = re.compile(
    r"/etc/(passwd|group|g?shadow|sub[ug]id)-$|/var/log/dpkg.log$"
)  # what was there before, and when


@pytest.fixture(scope="module")
def package(guest: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package of this tree: that of $GZ_ONBOARD_DEB, or built here."""
    if "GZ_ONBOARD_DEB" in os.environ:
        return Path(os.environ["GZ_ONBOARD_DEB"])
    build = [sys.executable, "packaging/debian/build.py", str(tmp_path_factory.mktemp("deb")), "--installed"]
    done = subprocess.run(build, cwd=ROOT, check=False, capture_output=True, text=True)
    if "needs an environment of" in done.stderr:
        pytest.skip(done.stderr.strip())
    assert done.returncode == 0, done.stderr
    return Path(done.stdout.splitlines()[-1])


@pytest.fixture
def board(guest: None, tmp_path: Path) -> Iterator[None]:
    """Without what the other tests install by hand, and their state; it is put back afterwards."""
    output("systemctl", "stop", *UNITS, check=False)  # those that are there
    for number, path in enumerate(BY_HAND):
        if os.path.lexists(path):
            shutil.move(path, tmp_path / str(number))
    for lock in "lock", "lock-frontend", "triggers/Lock":  # what only the host's root may open
        if not os.access(Path("/var/lib/dpkg") / lock, os.W_OK):
            (Path("/var/lib/dpkg") / lock).unlink(missing_ok=True)
    Path("/etc/systemd/system/multi-user.target.wants").mkdir(exist_ok=True)  # as every Debian has
    Path("/usr/sbin/policy-rc.d").unlink(missing_ok=True)  # on the host it may forbid to start services
    systemctl("daemon-reload")
    yield
    output("dpkg", "--purge", "gz-onboard", check=False)
    for number, path in enumerate(BY_HAND):
        if os.path.lexists(tmp_path / str(number)):
            shutil.move(tmp_path / str(number), path)
    systemctl("daemon-reload")


def dpkg(*arguments: str | Path) -> str:
    return output("dpkg", "--no-triggers", "--force-unsafe-io", "--force-confold", *map(str, arguments))


def files() -> set[str]:
    """What is in the folders that the package, its scripts and its services write to."""
    found = {str(path) for folder in map(Path, WRITTEN) if folder.is_dir() for path in folder.iterdir()}
    return {name for name in found if not KEPT_BY_OTHERS.search(name)}


def users() -> set[str]:
    return {user.pw_name for user in pwd.getpwall()} | set(Path("/etc/group").read_text().splitlines())


def next_version(package: Path, folder: Path) -> Path:
    """The same with a higher version, and with settings that it ships otherwise."""
    tree = folder / "tree"
    output("dpkg-deb", "--raw-extract", str(package), str(tree))
    control = tree / "DEBIAN" / "control"
    control.write_text(re.sub("^Version: .*", "Version: 9.0", control.read_text(), flags=re.M))
    settings = tree / "etc" / "default" / "gz-onboard"
    settings.write_text("# Of version 9.\n" + settings.read_text())
    made = folder / "next.deb"
    output("dpkg-deb", "-Zzstd", "-z1", "--build", str(tree), str(made))
    shutil.rmtree(tree)
    return made


def saved() -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in Path("/var/lib/gz-onboard").iterdir()}


def test_from_installation_to_purge(package, board, listener, ride, tmp_path):
    check_refusal()
    before, before_users = files(), users()
    dpkg("--install", package)
    assert pwd.getpwnam("gz-onboard").pw_uid < 1000
    assert systemctl("is-enabled", UNIT) == "enabled"
    for other in UNITS[1:]:
        assert output("systemctl", "is-enabled", other, check=False) == "disabled"
    assert output("systemd-analyze", "verify", *UNITS) == ""
    check_contents()
    check_settings_and_start(listener)
    check_upgrade(next_version(package, tmp_path), listener)

    dpkg("--remove", "gz-onboard")
    assert output("systemctl", "is-active", UNIT, check=False) == "inactive"
    assert not OPT.exists()
    assert 'OPTIONS="--channel vcan0"' in SETTINGS.read_text()
    assert NETWORK.exists()
    assert saved()
    assert list(Path("/var/log/gz-onboard").glob("*.mcap"))

    dpkg("--purge", "gz-onboard")
    assert files() == before
    assert users() == before_users


def check_refusal() -> None:
    """Beside an installation by hand."""
    OPT.mkdir()
    (OPT / "pyvenv.cfg").touch()
    told = output(str(ROOT / "packaging/debian/preinst"), "install", check=False)
    assert "was installed by hand" in told
    shutil.rmtree(OPT)


def check_contents() -> None:
    """All is what was packed; settings are marked as such; the terms of all that is bundled are there."""
    assert output("dpkg", "--verify", "gz-onboard") == ""
    listed = [Path(line) for line in output("dpkg", "-L", "gz-onboard").splitlines()]
    marked = Path("/var/lib/dpkg/info/gz-onboard.conffiles").read_text().split()
    assert {str(path) for path in listed if path.parts[1:2] == ("etc",) and path.is_file()} == set(marked)
    bundled = {path.name for path in listed if path.suffix == ".dist-info"}
    assert {"python_can", "mcap", "numpy", "paho_mqtt"} <= {name.split("-")[0] for name in bundled}
    assert not {"scipy", "matplotlib", "pyarrow", "pip"} & {path.name for path in listed}
    terms = Path("/usr/share/doc/gz-onboard/copyright").read_text()
    for name in bundled - {path for path in bundled if path.startswith("gz_onboard-")}:
        (stanza,) = (part for part in terms.split("\n\n") if re.match(rf"Files: .*/{re.escape(name)}( |$)", part, re.M))
        assert re.search(r"^License: \w.*\n(?: .*\n){5}", stanza, re.M), name
    assert output("/usr/bin/gz-onboard", "--help").startswith("usage: gz-onboard")
    assert list(OPT.rglob("*.pyc"))
    assert ".SH COMMANDS" in output("zcat", "/usr/share/man/man1/gz-onboard.1.gz")


def check_settings_and_start(listener: Listener) -> None:
    """The board's bus is vcan0: one line, and it runs, as the package's user; so does the page."""
    with SETTINGS.open("a") as settings:
        settings.write('OPTIONS="--channel vcan0"\nDASHBOARD="--channel vcan0 --listen 127.0.0.1:8000"\n')
    systemctl("restart", UNIT)
    assert listener.next("RANGE_Remaining", 60)["RANGE_Remaining"] > 0
    assert Path(f"/proc/{main_pid()}").stat().st_uid == pwd.getpwnam("gz-onboard").pw_uid
    mapped = set(re.findall(r" (/\S+)$", Path(f"/proc/{main_pid()}/maps").read_text(), re.M))
    assert {file for file in mapped if not file.startswith(("/opt/gz-onboard/", "/usr/lib/", "/usr/bin/"))} == set()
    assert (Path("/run/gz-onboard/control").group(), Path("/run/gz-onboard").group()) == ("gz-onboard", "gz-onboard")
    systemctl("enable", "--now", PAGE)
    wait_for(lambda: latest()["range"]["km"] is not None, 60, "the range on the page")


def check_upgrade(newer: Path, listener: Listener) -> None:
    """It keeps the settings, what is disabled, what is running, and goes on from the state that was saved."""
    NETWORK.write_text(NETWORK.read_text().replace("500K", "250K"))
    wait_for(lambda: bool(saved()), 60, "a saved state")
    pid = main_pid()
    dpkg("--install", newer)
    assert output("dpkg-query", "-W", "-f", "${Version}", "gz-onboard") == "9.0"
    wait_for(lambda: show("ActiveState") == "active" and main_pid() not in (0, pid), 60, "the new one runs")
    assert active()
    told = ["journalctl", "--no-pager", "-u", UNIT, f"_PID={main_pid()}"]
    wait_for(lambda: "continuing from the state saved" in output(*told), 60, "that it goes on from its state")
    assert "Of version 9" not in SETTINGS.read_text()
    assert "250K" in NETWORK.read_text()
    listener.next(SOC, 60)
    systemctl("disable", "--now", UNIT)
    output("/var/lib/dpkg/info/gz-onboard.postinst", "configure", "9.0")  # what the next upgrade calls
    assert output("systemctl", "is-enabled", UNIT, check=False) == "disabled"
    assert output("systemctl", "is-active", UNIT, check=False) == "inactive"
