# SPDX-License-Identifier: Apache-2.0
"""Numba's cache of compiled functions, with seals: what is damaged is removed and compiled anew.

Numba unpickles whatever its files hold and hands machine code on to LLVM, which ends the process if it is none. Each
file here ends with a checksum of the rest, which numba passes over, and is looked at before it is read.

The first kernel of this package that a process has to compile writes one line to the log `pcgraph`.
"""

from __future__ import annotations

import gc
import hashlib
import io
import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from numba import config, njit
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.compiler import Compiler
from numba.core.runtime import rtsys

_PACKAGE = __name__.partition(".")[0]
_MARK = b"pcgraph kernel "
_DIGEST_BYTES = 32
"""Bytes of a SHA-256 digest. Source: FIPS 180-4."""


def cached_njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """A decorator of compiled functions that are kept on disk, as `numba.njit(cache=True, **options)` is."""

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = njit(pipeline_class=_Compiler, **options)(function)
        if not config.DISABLE_JIT:
            dispatcher._cache = _Cache(function)
        return dispatcher

    return decorate


def is_sound(path: str | Path) -> bool:
    """Whether a file of the cache is as it was written; OSError if it cannot be read."""
    content = Path(path).read_bytes()
    return content.endswith(_seal(content[: -len(_MARK) - _DIGEST_BYTES]))


def _seal(content: bytes) -> bytes:
    return _MARK + hashlib.sha256(content).digest()


class _Compiler(Compiler):  # type: ignore[misc]
    """Numba's compiler without collecting cyclic garbage, which takes an eighth of its time for its many objects."""

    def compile_extra(self, func: Callable[..., Any]) -> Any:
        enabled = gc.isenabled()
        gc.disable()
        try:
            return super().compile_extra(func)
        finally:
            if enabled:
                gc.enable()


class _CacheFile(IndexDataCacheFile):  # type: ignore[misc]
    """The files of one function: an index, and one with machine code for each signature."""

    def _load_index(self) -> Any:
        return super()._load_index() if self._keep_if_sound(self._index_path) else {}

    def _load_data(self, name: str) -> Any:
        path = self._data_path(name)
        if not self._keep_if_sound(path):
            raise FileNotFoundError(path)  # by which numba knows that it has to compile
        return super()._load_data(name)

    def _keep_if_sound(self, path: str) -> bool:
        """Whether there is such a file, and sound; one that is not is removed."""
        try:
            if is_sound(path):
                return True
        except FileNotFoundError:
            return False
        with suppress(OSError):  # another process was faster; where it must not be removed, it is passed over
            os.unlink(path)
        return False

    @contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[io.BytesIO]:
        content = io.BytesIO()
        yield content
        with super()._open_for_write(filepath) as file:
            file.write(content.getvalue() + _seal(content.getvalue()))


class _Cache(FunctionCache):  # type: ignore[misc]
    """Numba's cache of one function; empty where it names classes that are no more, as after an update.

    What was compiled is kept by function and line, and read before it is asked whether the file has changed since.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        of = self._impl
        self._cache_file = _CacheFile(self.cache_path, of.filename_base, of.locator.get_source_stamp())

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The function that was compiled for a signature; None if it must be compiled.

        Numba would prepare here for compiling, which takes longer than loading fifty kernels does, and its compiler
        does so itself. What is loaded needs the runtime only.
        """
        rtsys.initialize(target_context)
        try:
            with self._guard_against_spurious_io_errors():
                compiled = self._load_overload(sig, target_context)
        except (AttributeError, ImportError):
            self._forget()
            compiled = None
        if compiled is None and self._py_func.__module__.partition(".")[0] == _PACKAGE:
            _say_once()
        return compiled

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except (AttributeError, ImportError):
            self._forget()
            super().save_overload(sig, data)

    def _forget(self) -> None:
        with self._guard_against_spurious_io_errors():
            self.flush()


_said = False


def _say_once() -> None:
    """Write to the log that kernels are compiled, so that whoever waits knows what for."""
    global _said
    if not _said:
        _said = True
        logging.getLogger(_PACKAGE).warning(
            "pcgraph: compiling kernels that this installation has not used before, which takes up to half a minute; "
            "`pcgraph compile` compiles all of them ahead."
        )
