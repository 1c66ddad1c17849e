# SPDX-License-Identifier: Apache-2.0
"""Which Dr.Jit backend renders, chosen and checked before the first kernel.

Dr.Jit loads its LLVM when it is imported, so the library is chosen here, before that. Finding none is no error yet: a
GPU may do without.
"""

from __future__ import annotations

from contextlib import suppress

from rangesim.environment.llvm import ensure_llvm
from rangesim.errors import EnvironmentProblem

with suppress(EnvironmentProblem):  # raised again by `select_variant`, where LLVM is really needed
    ensure_llvm()

import drjit as dr
import mitsuba as mi

VARIANTS = ("llvm_ad_mono", "cuda_ad_mono")
MIN_THREADS = 2
"""Of Dr.Jit, on a single core, too: with one, Mitsuba 3.9 waits for ever for a file of OpenEXR that it reads or writes
(its issue 21)."""


def select_variant(variant: str | None = None) -> str:
    """Name of the Mitsuba variant now active: `variant`, or CUDA where a GPU answers, else LLVM.

    A monochrome variant that is active already is kept unless `variant` asks for another.

    Raises
    ------
    ValueError
        `variant` is not one of `VARIANTS` or this build of Mitsuba lacks it.
    EnvironmentProblem
        No suitable LLVM library; the message names the fix.
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
    if dr.thread_count() < MIN_THREADS:
        dr.set_thread_count(MIN_THREADS)
    mi.set_log_level(mi.LogLevel.Error)
    return variant


def cuda_available() -> bool:
    """Whether Dr.Jit finds a CUDA device and this Mitsuba can use it."""
    return "cuda_ad_mono" in mi.variants() and bool(dr.has_backend(dr.JitBackend.CUDA))
