"""Libraries that are optional, and parts of libraries that cost more to import than they are worth."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

_PACKAGES = {"paho": "paho-mqtt", "foxglove": "foxglove-sdk"}  # whose names differ from those of their modules


def require(module: str, wanted: bool = True) -> None:
    """ModuleNotFoundError if `module`, which an extra installs, is missing: before the work that needs it."""
    from importlib.util import find_spec

    if wanted and find_spec(module) is None:
        raise ModuleNotFoundError(f"no module named {module!r}", name=module)


def missing_extra(error: ModuleNotFoundError) -> str | None:
    """Describe the extra of this package to install for a missing module; None if no extra has it."""
    from importlib.metadata import PackageNotFoundError, requires

    module = (error.name or "").partition(".")[0]
    package = _PACKAGES.get(module, module)
    try:
        needed = requires("gz-onboard") or []
    except PackageNotFoundError:
        return None
    for requirement in needed:
        found = re.fullmatch(r"([\w-]+).*;.*\bextra == ['\"](\w+)['\"].*", requirement)
        if found and found[1].replace("-", "_").lower() == package.replace("-", "_").lower():
            return f"needs {package}, which is not installed: pip install 'gz-onboard[{found[2]}]'"
    return None


class _Hollow(ModuleType):
    """Module in which every name is an exception type: enough to import from, and to call."""

    def __getattr__(self, name: str) -> object:
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (Exception,), {})


@contextmanager
def without(*modules: str) -> Iterator[None]:
    """Import libraries within, with hollow modules in place of those that they import and we never use.

    Modules that are already imported stay as they are. Afterwards the real ones can be imported as always.
    """
    hidden = {name: _Hollow(name) for name in modules if name not in sys.modules}
    sys.modules.update(hidden)
    try:
        yield
    finally:
        for name in hidden:
            del sys.modules[name]
