# SPDX-License-Identifier: Apache-2.0
"""Choice of the Dr.Jit backend that renders, before the first kernel runs.

Dr.Jit loads LLVM when it is imported. Therefore this module chooses the library first and imports Dr.Jit afterwards. A
missing LLVM is no error at this point, because rendering on a GPU does not need it.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from rangesim.environment.llvm import ensure_llvm
from rangesim.errors import EnvironmentProblem

with suppress(EnvironmentProblem):  # `select_variant` raises it again if LLVM is needed
    ensure_llvm()

import drjit as dr
import mitsuba as mi

if threads := os.environ.get("RANGESIM_THREADS"):  # workers of a campaign share the cores
    dr.set_thread_count(int(threads))

VARIANTS = ("llvm_ad_mono", "cuda_ad_mono")
"""Mitsuba variants that rangesim supports: one band of light, on the CPU or on a GPU."""


def select_variant(variant: str | None = None) -> str:
    """Activate a Mitsuba variant, and return its name.

    Parameters
    ----------
    variant : one of `VARIANTS`. None: the active variant if it is one of them, else CUDA if there is a usable GPU, else
        LLVM.

    Raises
    ------
    ValueError
        `variant` is not one of `VARIANTS`, or this build of Mitsuba lacks it.
    EnvironmentProblem
        There is no suitable LLVM library; the message says how to install one.

    Examples
    --------
    >>> select_variant("llvm_ad_mono")
    'llvm_ad_mono'
    """
    if variant is not None and variant not in VARIANTS:
        raise ValueError(f"expected a variant out of {', '.join(VARIANTS)}, got {variant!r}.")
    if variant is None:
        active = mi.variant()
        variant = active if active in VARIANTS else ("cuda_ad_mono" if cuda_available() else "llvm_ad_mono")
    if variant not in mi.variants():
        raise ValueError(f"this build of Mitsuba has no variant {variant}; it has {', '.join(mi.variants())}.")
    if variant.startswith("llvm"):
        ensure_llvm()
    if mi.variant() != variant:
        mi.set_variant(variant)
    mi.set_log_level(mi.LogLevel.Error)
    return variant


@contextmanager
def images_can_be_read() -> Iterator[None]:
    """Let Dr.Jit have two threads while the block runs, if it has only one, as on a machine with a single core.

    With one thread, Mitsuba 3.9 waits forever for an OpenEXR file (its issue 21). The second thread is removed
    afterwards, because two threads that wait in busy loops on one core make a light-transport pass a tenth slower.
    """
    threads = dr.thread_count()
    if threads > 1:
        yield
        return
    dr.set_thread_count(2)
    try:
        yield
    finally:
        dr.sync_thread()
        dr.set_thread_count(threads)


def cuda_available() -> bool:
    """Whether Dr.Jit finds a CUDA device and this build of Mitsuba can use it."""
    return "cuda_ad_mono" in mi.variants() and bool(dr.has_backend(dr.JitBackend.CUDA))
