"""Libraries that are optional, and parts of libraries that cost more to import than they are worth."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

EXTRAS = {
    "asammdf": ("asammdf", "mf4"),
    "filterpy": ("filterpy", "lab"),
    "foxglove": ("foxglove-sdk", "foxglove"),
    "matplotlib": ("matplotlib", "lab"),
    "msgpack": ("msgpack", "udp"),
    "paho": ("paho-mqtt", "mqtt"),
    "pyarrow": ("pyarrow", "lab"),
    "scipy": ("scipy", "lab"),
    "tomlkit": ("tomlkit", "lab"),
}  # by module: the package that has it, and the extra of ours that installs it


def require(module: str, wanted: bool = True) -> None:
    """ModuleNotFoundError if `module`, which an extra installs, is missing: before the work that needs it."""
    from importlib.util import find_spec

    if wanted and find_spec(module) is None:
        raise ModuleNotFoundError(f"no module named {module!r}", name=module)


def missing_extra(error: ModuleNotFoundError) -> str | None:
    """Describe the extra of this package to install for a missing module; None if no extra has it."""
    found = EXTRAS.get((error.name or "").partition(".")[0])
    return found and f"needs {found[0]}, which is not installed: pip install 'gz-onboard[{found[1]}]'"


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
