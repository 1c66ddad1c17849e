# SPDX-License-Identifier: Apache-2.0
"""Spectra of the renderer in kernels: one channel, unpolarised (`rangesim.environment.backend.VARIANTS`)."""

from __future__ import annotations

from typing import Any

import mitsuba as mi


def mono(spectrum: Any) -> Any:
    """The single channel of a monochrome spectrum."""
    return mi.unpolarized_spectrum(spectrum)[0]
