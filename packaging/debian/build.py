"""The Debian package of the daemon and its tools: `make deb` writes it to dist/.

/opt/gz-onboard is a plain virtual environment of Debian's own Python: this tree's wheel, and what it needs at the
versions and hashes of .ci/requirements-board.txt. All else is the files of `FILES`, the scripts beside this file, and
what docs/shell.py makes. dpkg-deb is all of Debian's tools that takes part.
"""

from __future__ import annotations

import argparse
import gzip
import hashlib
import importlib.metadata
import re
import shutil
import subprocess
import sys
import tempfile
from importlib.metadata import Distribution
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
PYTHON = Path("/usr/bin/python3")
PREFIX = "opt/gz-onboard"
DOC = "usr/share/doc/gz-onboard"
PINNED = ROOT / ".ci" / "requirements-board.txt"
HOLDER = re.compile(r"^\W*copyright .*(\d{4}|\(c\) \w)|\d{4}.*\(c\)", re.I)
LEFT_OUT = {".pyi", ".c", ".h", ".a"}
SCRIPTS = ("preinst", "postinst", "prerm", "postrm")
FILES = {
    "systemd/gz-onboard.service": "usr/lib/systemd/system/gz-onboard.service",
    "systemd/gz-onboard-dashboard.service": "usr/lib/systemd/system/gz-onboard-dashboard.service",
    "systemd/gz-onboard-mqtt.service": "usr/lib/systemd/system/gz-onboard-mqtt.service",
    "systemd/gz-onboard.default": "etc/default/gz-onboard",
    "systemd/80-can0.network": "etc/systemd/network/80-can0.network",
    "systemd/gz-onboard-kiosk.service": f"{DOC}/examples/gz-onboard-kiosk.service",
    "systemd/80-vcan0.netdev": f"{DOC}/examples/80-vcan0.netdev",
    "systemd/80-vcan0.network": f"{DOC}/examples/80-vcan0.network",
    "packaging/debian/sysusers.conf": "usr/lib/sysusers.d/gz-onboard.conf",
}
SHELL = {
    "gz-onboard.1": "usr/share/man/man1/gz-onboard.1.gz",
    "gz-onboard.bash": "usr/share/bash-completion/completions/gz-onboard",
    "_gz-onboard": "usr/share/zsh/vendor-completions/_gz-onboard",
}


def main() -> None:
    """Build it, and print where it is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder for the package")
    parser.add_argument("--version", help="instead of the wheel's")
    parser.add_argument("--installed", action="store_true", help="other packages as in this environment: no network")
    args = parser.parse_args()
    if not PYTHON.exists():
        parser.error(f"{PYTHON} is not here: apt-get install python3")
    with tempfile.TemporaryDirectory() as folder:
        stage = Path(folder) / "stage"
        site = make_environment(stage, args.installed)
        version = args.version or of(site)["gz-onboard"].version
        add_files(stage, Path(folder), site)
        add_control(stage, version)
        args.folder.mkdir(parents=True, exist_ok=True)
        package = args.folder.resolve() / f"gz-onboard_{version}_{architecture()}.deb"
        run("dpkg-deb", "--root-owner-group", "-Zzstd", "--build", stage, package)
    print(package)


def run(*command: object) -> str:
    """What `command` prints; ends this program if it fails."""
    words = [str(word) for word in command]
    done = subprocess.run(words, capture_output=True, text=True, check=False, cwd=ROOT)
    if done.returncode:
        sys.exit(f"{done.stdout}{done.stderr}deb: status {done.returncode} of: {' '.join(words)}")
    return done.stdout.strip()


def architecture() -> str:
    """What Debian calls this machine's."""
    return run("dpkg", "--print-architecture")


# --- /opt/gz-onboard ----------------------------------------------------------------------------------------------


def make_environment(stage: Path, installed: bool) -> Path:
    """Make the virtual environment; its site-packages. installed: copy what this environment has, without an index."""
    prefix = stage / PREFIX
    python = PYTHON.with_name(run(PYTHON, "-c", "import sys; print('python%d.%d' % sys.version_info[:2])"))
    run(python, "-m", "venv", "--without-pip", prefix)
    (site,) = prefix.glob("lib/python3*/site-packages")
    wheels = stage.with_name("wheel")
    run(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", wheels)
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", "--python", prefix / "bin/python"]
    install = [*pip, "install", "--no-compile", "--no-warn-script-location"]
    if installed:
        copy_installed(site, python.name)
    else:
        run(*install, "--require-hashes", "--only-binary", ":all:", "-r", PINNED)
    run(*install, "--no-deps", "--no-index", *wheels.glob("*.whl"))
    settle(stage, python)
    return site


def copy_installed(site: Path, python: str) -> None:
    """Copy the pinned packages from this environment, which has to be of the same Python and the same versions."""
    if f"python{sys.version_info[0]}.{sys.version_info[1]}" != python:
        sys.exit(f"deb: --installed needs an environment of {python}; this is {sys.version.split()[0]}")
    pins = dict(
        re.findall(r"^([\w.-]+)==([^\s;]+) (?!; sys_platform == 'win32')", PINNED.read_text(encoding="utf-8"), re.M)
    )
    for name, version in pins.items():
        found = importlib.metadata.distribution(name)
        if found.version != version:
            sys.exit(f"deb: {name} {found.version} is installed, {version} is pinned")
        for path in found.files or ():
            if ".." not in path.parts and "__pycache__" not in path.parts:
                (site / path).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(str(found.locate_file(path)), site / path)


def settle(stage: Path, python: Path) -> None:
    """Make the environment that of /opt/gz-onboard: no path of this build, nothing for developers, all compiled."""
    prefix = stage / PREFIX
    home = f"home = {python.parent}\ninclude-system-site-packages = false\nversion = {run(python, '-V').split()[1]}\n"
    (prefix / "pyvenv.cfg").write_text(home, encoding="utf-8")
    for file in (prefix / "bin").iterdir():
        if file.name == "gz-onboard":
            file.write_text(
                re.sub("^#!.*", f"#!/{PREFIX}/bin/python", file.read_text(encoding="utf-8")), encoding="utf-8"
            )
        elif not file.name.startswith("python"):
            file.unlink()
    shutil.rmtree(prefix / "include", ignore_errors=True)
    for tests in [path for path in prefix.rglob("tests") if path.is_dir()]:
        shutil.rmtree(tests)
    for file in [path for path in prefix.rglob("*") if path.suffix in LEFT_OUT or path.name == "direct_url.json"]:
        file.unlink()
    # By the content of the sources, never by their times; the service may not write, and root shall not need to.
    run(
        python,
        "-m",
        "compileall",
        "-q",
        "-j",
        "0",
        "--invalidation-mode",
        "unchecked-hash",
        "-s",
        stage,
        "-p",
        "/",
        prefix,
    )


# --- the rest -----------------------------------------------------------------------------------------------------


def add_files(stage: Path, scratch: Path, site: Path) -> None:
    """Units, settings, manual, completions, terms."""
    run(sys.executable, "docs/shell.py", scratch / "shell")
    sources = {ROOT / file: target for file, target in FILES.items()}
    sources |= {scratch / "shell" / file: target for file, target in SHELL.items()}
    sources |= {ROOT / "CHANGELOG.md": f"{DOC}/changelog.gz"}
    for source, target in sources.items():
        put(stage / target, source.read_bytes())
    put(stage / DOC / "copyright", terms(site).encode())
    (stage / "etc/gz-onboard").mkdir()
    (stage / "usr/bin").mkdir()
    (stage / "usr/bin/gz-onboard").symlink_to(f"/{PREFIX}/bin/gz-onboard")


def put(file: Path, content: bytes) -> None:
    """Write `content`, packed if the name says so."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(gzip.compress(content, mtime=0) if file.suffix == ".gz" else content)


def of(site: Path) -> dict[str, Distribution]:
    """The Python packages in `site`, by name."""
    found = importlib.metadata.distributions(path=[str(site)])
    return dict(sorted((one.metadata["Name"].lower(), one) for one in found))


def terms(site: Path) -> str:
    """The machine-readable copyright file: this project's terms, then those of each package that is bundled."""
    text = (ROOT / "LICENSE").read_text(encoding="utf-8")
    parts = [
        "Format: https://www.debian.org/doc/packaging-manuals/copyright-format/1.0/\nUpstream-Name: gz_onboard",
        stanza("*", "MIT", text),
    ]
    where = f"{PREFIX}/{site.relative_to(site.parents[2])}"
    for name, one in of(site).items():
        if name != "gz-onboard":
            tops = sorted({path.parts[0] for path in one.files or ()} - {"..", "__pycache__"})
            parts.append(stanza(" ".join(f"{where}/{top}" for top in tops), stated(one), full_text(name, one)))
    return "\n\n".join(parts) + "\n"


def stanza(files: str, licence: str, text: str) -> str:
    """The paragraph of `files`, with the whole `text` of their terms."""
    holders = dict.fromkeys(line.strip(" *#;/") for line in text.splitlines() if HOLDER.search(line))
    indented = [f" {line.rstrip()}" if line.strip() else " ." for line in text.strip().splitlines()]
    named = "\n ".join(holders) or "see the terms"
    return "\n".join([f"Files: {files}", f"Copyright: {named}", f"License: {licence}", *indented])


def stated(one: Distribution) -> str:
    """The terms in a word, as its metadata have them."""
    told = one.metadata["License-Expression"] or one.metadata["License"]
    classes = [
        text.split(" :: ")[-1] for text in one.metadata.get_all("Classifier") or () if text.startswith("License")
    ]
    return str(told or ", ".join(classes))


def full_text(name: str, one: Distribution) -> str:
    """Return the license texts in the package; missing ones are in the folder licenses."""
    own = [path for path in one.files or () if ".dist-info" in path.parts[0]]
    named = re.compile(r"(?:LICEN[CS]E|COPYING|NOTICE)\S*", re.I)
    files = [path for path in own if named.fullmatch(path.name) or path.parts[1] == "licenses"]
    texts = [Path(str(one.locate_file(path))).read_text(encoding="utf-8") for path in files]
    missing = HERE / "licenses" / f"{name}.txt"
    if not texts and not missing.exists():
        sys.exit(f"deb: {name} brings no text of its terms; put it into {missing.relative_to(ROOT)}")
    return "\n\n".join(texts) if texts else missing.read_text(encoding="utf-8")


def add_control(stage: Path, version: str) -> None:
    """DEBIAN/, the last: sums and size of all that is there."""
    files = sorted(path for path in stage.rglob("*") if path.is_file() and not path.is_symlink())
    sums = [f"{hashlib.md5(path.read_bytes()).hexdigest()}  {path.relative_to(stage)}\n" for path in files]
    for path in [stage, *stage.rglob("*")]:
        if not path.is_symlink():
            path.chmod(0o755 if path.is_dir() or path.parent.name == "bin" else 0o644)
    (python,) = (stage / PREFIX / "lib").glob("python3*")
    values = {
        "VERSION": version,
        "ARCHITECTURE": architecture(),
        "PYTHON": python.name,
        "INSTALLED_SIZE": str(sum(path.stat().st_size for path in files) // 1024),
    }
    debian = stage / "DEBIAN"
    debian.mkdir()
    for name in ("control", "conffiles", *SCRIPTS):
        text = re.sub("@([A-Z_]+)@", lambda key: values[key[1]], (HERE / name).read_text(encoding="utf-8"))
        (debian / name).write_text(text, encoding="utf-8")
        (debian / name).chmod(0o755 if name in SCRIPTS else 0o644)
    (debian / "md5sums").write_text("".join(sums), encoding="utf-8")


if __name__ == "__main__":
    main()
