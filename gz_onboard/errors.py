"""The one error that a user's input can cause, the help that goes with it, and the exit statuses."""

from __future__ import annotations

import difflib
import errno
import reprlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

OK, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
EXIT_STATUSES = {
    OK: "done",
    FAILED: "the answer is no (validate --gate, vehicle check, dashboard --once), or the system failed: a full disk, "
    "a closed pipe",
    BAD_INPUT: "the command line, a file or a parameter cannot be used, or one of several logs cannot",
    INTERRUPTED: "interrupted by Ctrl-C",
}
"""Meaning of the exit status of a command."""
_NAMES_REFUSED = (errno.ENAMETOOLONG, errno.EACCES)
_DISK_FAILED = (errno.ENOSPC, errno.EDQUOT, errno.EIO)
CLOSE, CLOSE_SHORT = 0.55, 0.5  # difflib's ratio of two names from which one may be meant; of up to three letters
CLOSE_FILE = 0.75  # likewise of files, which have endings in common
LONGEST_NAME = 100  # beyond it no near name is looked for, which takes the square of the length
_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxlist, _SHORT.maxdict = 3, 8, 4
_SHORT.maxstring = _SHORT.maxother = 100


class InputError(Exception):
    """A command line, file or parameter that cannot be used.

    The message names the place (file, line, key), the value with its unit, and the values that would be
    right. The command line prints it without a traceback and exits with status `BAD_INPUT`.
    """


def nearest(name: str, known: Iterable[str], close: float | None = None) -> str:
    """`` (did you mean 'x'?)`` for what `closest` finds, or an empty string."""
    found = closest(name, known, close)
    return f" (did you mean {found!r}?)" if found else ""


def closest(name: str, known: Iterable[str], close: float | None = None) -> str | None:
    """The known name nearest to `name`, if one is near; close: of `CLOSE`."""
    if not 0 < len(name) <= LONGEST_NAME:
        return None
    names = {each.lower(): each for each in known}
    enough = close or (CLOSE if len(name) > 3 else CLOSE_SHORT)
    match = difflib.get_close_matches(name.lower(), names, n=1, cutoff=enough)
    if not match and not close:  # a part of a name, or a name with more about it
        match = [each for each in names if name.lower() in each or each in name.lower()][:1]
    return names[match[0]] if match else None


def near_file(file: Path) -> str:
    """As `nearest`, among the other files in its folder, for a file that is missing."""
    with suppress(OSError):
        return "" if file.exists() else nearest(file.name, (one.name for one in file.parent.iterdir()), CLOSE_FILE)
    return ""


def unreadable(file: Path, error: Exception) -> InputError:
    """Return the error for a `file` that cannot be read, with the reason of the operating system and a hint."""
    if isinstance(error, IsADirectoryError):
        return InputError(f"{file}: is a folder; give the file in it")
    return InputError(f"{file}: cannot be read: {getattr(error, 'strerror', None) or error}{near_file(file)}")


def shown(value: object) -> str:
    """`value` as Python writes it, in a length that fits into a message."""
    try:
        return _SHORT.repr(value)
    except ValueError:  # Python does not write out an integer of thousands of digits
        return "a number of thousands of digits"


def brief(self: object) -> str:
    """As `__repr__` of a dataclass that holds much: each field in the length that fits into a line."""
    values = (f"{name}={shown(getattr(self, name))}" for name in getattr(self, "__dataclass_fields__", ()))
    return f"{type(self).__name__}({', '.join(values)})"


def writable(text: str) -> str:
    """`text` without what no encoding has: the bytes of a file's name that are not UTF-8."""
    return text.encode("utf-8", "replace").decode()


def not_an_input(outputs: Iterable[Path | str | None], inputs: Iterable[Path]) -> None:
    """InputError if an output file is an input, the ``rides.json`` next to one, another output, or a folder.

    By whatever name. outputs: a name may be None, or ``-`` for standard output.
    """
    read = {
        identity: file
        for given in inputs
        for file in (given.parent / "rides.json", given)
        if (identity := _identity(file))
    }
    written: dict[object, Path | str] = {}
    for out in outputs:
        if out is None or str(out) == "-" or Path(out).is_char_device() or Path(out).is_fifo():
            continue
        if Path(out).is_dir():
            raise InputError(f"{out}: is a folder; give the name of a file")
        if (identity := _identity(out)) in read:
            raise InputError(f"{out}: would overwrite the input {read[identity]}; give another name or folder")
        if (other := written.setdefault(identity or Path(out).resolve(), out)) is not out:
            raise InputError(f"{out}: would overwrite {other}, which is written too; give another name")


def _identity(file: Path | str) -> tuple[int, int] | None:
    """What two names of the same file have in common; None if there is none."""
    with suppress(OSError):
        found = Path(file).stat()
        return found.st_dev, found.st_ino
    return None


@contextmanager
def naming() -> Iterator[None]:
    """InputError for a name that the operating system refuses within: one too long, or in a folder that is closed."""
    try:
        yield
    except OSError as error:
        if error.errno not in _NAMES_REFUSED or error.filename is None:
            raise
        raise InputError(f"{error.filename}: {error.strerror}") from error


@contextmanager
def writing(place: object) -> Iterator[None]:
    """Turn an OSError within into an InputError that names the file, or else `place`.

    OSError where the fault is not the name's: a full disk, a broken one.
    """
    try:
        yield
    except OSError as error:
        file = error.filename or place
        folder = Path(str(file)).parent
        gone = error.errno == errno.ENOENT and not folder.exists()
        why = f"there is no folder {folder}; make it" if gone else error.strerror
        message = f"{file}: cannot be written: {why or error}"
        if error.errno in _DISK_FAILED:
            raise OSError(error.errno, message) from error
        raise InputError(message) from error
