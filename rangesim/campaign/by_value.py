# SPDX-License-Identifier: Apache-2.0
"""Pickles for other machines: what files of the user define travels in the pickle, not by the name of its module."""

from __future__ import annotations

import sys
import sysconfig
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from hashlib import sha256
from pathlib import Path
from types import ModuleType
from typing import Any

PACKAGES = ("rangesim", "pcgraph")
"""Packages that each worker has installed; `versions.py` checks that they are the same."""
USER_MODULES = tuple(f"{package}.user_modules." for package in PACKAGES)
"""Modules of these packages that are files of the user (FILE.py:NAME)."""


def pickled(thing: Any) -> bytes:
    """Return a pickle of anything, with the definitions of the user's functions and classes in it.

    Raises
    ------
    ValueError
        The thing cannot be pickled.
    """
    import cloudpickle

    with _users_modules_by_value():
        try:
            return bytes(cloudpickle.dumps(thing))
        except Exception as error:  # __reduce__ of any class may raise anything
            raise ValueError(
                f"{thing!r:.80} cannot be sent to worker processes ({type(error).__name__}: {error}); it must not hold "
                "open files, locks, connections or generators."
            ) from error


def source_of(function: Callable[..., Any]) -> dict[str, str]:
    """The name of a function, with the SHA-256 of its file if that is the user's."""
    while isinstance(function, partial):
        function = function.func
    module = sys.modules.get(getattr(function, "__module__", None) or "")
    source = {
        "name": f"{getattr(function, '__module__', '')}.{getattr(function, '__qualname__', type(function).__name__)}"
    }
    file = getattr(module, "__file__", None)
    if module is not None and file and (module.__name__ == "__main__" or _is_users(module.__name__, file)):
        source["sha256"] = sha256(Path(file).read_bytes()).hexdigest()
    return source


@contextmanager
def _users_modules_by_value() -> Iterator[None]:
    """Let cloudpickle take the modules of the user by value while the block runs."""
    import cloudpickle

    registered = []
    for module in users_modules():
        if module.__name__ in sys.modules and module.__name__ not in cloudpickle.list_registry_pickle_by_value():
            cloudpickle.register_pickle_by_value(module)
            registered.append(module)
    try:
        yield
    finally:
        for module in registered:
            cloudpickle.unregister_pickle_by_value(module)


def users_modules() -> list[ModuleType]:
    """The loaded modules that are files of the user: neither installed, nor of Python, nor of this distribution."""
    loaded = list(sys.modules.items())
    return [module for name, module in loaded if _is_users(name, getattr(module, "__file__", None) or "")]


@cache
def _is_users(name: str, file: str) -> bool:
    """Whether the module `name` of a file is the user's; cloudpickle takes what `__main__` defines by value anyway."""
    if not file.endswith(".py") or name in ("__main__", "__mp_main__"):
        return False
    if name.partition(".")[0] in PACKAGES:
        return name.startswith(USER_MODULES)
    paths = sysconfig.get_paths()
    installed = [Path(paths[place]) for place in ("stdlib", "platstdlib", "purelib", "platlib")]
    return not any(place in Path(file).parents for place in installed)
