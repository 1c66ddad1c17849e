# SPDX-License-Identifier: Apache-2.0
"""A Python file of somebody's, run as a module."""

from __future__ import annotations

import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from zlib import crc32


def run_python_file(path: Path, package: str) -> ModuleType:
    """The module of a Python file, which runs, under a name of its own that tells the package that asked for it.

    Raises
    ------
    BaseException
        What the file raises; it is no module then.
    """
    name = f"_{package}_file_{path.stem}_{crc32(bytes(path)):x}"
    spec = spec_from_file_location(name, path)
    assert spec is not None, path  # a .py file has one
    assert spec.loader is not None, path
    module = module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their own module up
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module
