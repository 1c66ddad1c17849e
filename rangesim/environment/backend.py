# SPDX-License-Identifier: Apache-2.0
"""Which Dr.Jit backend renders, chosen and checked before the first kernel.

Dr.Jit loads its LLVM when it is imported, so the library is chosen here, before that. Finding none is no error yet: a
GPU may do without.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress

from rangesim.environment.llvm import ensure_llvm
from rangesim.errors import EnvironmentProblem

with suppress(EnvironmentProblem):  # raised again by `select_variant`, where LLVM is really needed
    ensure_llvm()

import drjit as dr
import mitsuba as mi

VARIANTS = ("llvm_ad_mono", "cuda_ad_mono")


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
    mi.set_log_level(mi.LogLevel.Error)
    return variant


@contextmanager
def images_can_be_read() -> Iterator[None]:
    """A second thread of Dr.Jit where it has but one, as on a single core: with that one, Mitsuba 3.9 waits for ever
    for a file of OpenEXR (its issue 21). Not for longer, as two spin on one core: a pass takes a tenth longer."""
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
    """Whether Dr.Jit finds a CUDA device and this Mitsuba can use it."""
    return "cuda_ad_mono" in mi.variants() and bool(dr.has_backend(dr.JitBackend.CUDA))
