# SPDX-License-Identifier: Apache-2.0
"""Spectra in kernels. Mitsuba's variants here are monochrome (`rangesim.environment.backend.VARIANTS`)."""

from __future__ import annotations

import mitsuba as mi


def mono(spectrum: mi.Spectrum) -> mi.Float:
    """The single channel of an unpolarised, monochrome spectrum."""
    return mi.unpolarized_spectrum(spectrum)[0]
