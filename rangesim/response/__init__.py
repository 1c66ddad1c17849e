# SPDX-License-Identifier: Apache-2.0
"""What a sensor reads of one light path; see `rangesim.response.base`."""

from rangesim.response.base import (
    CAUSTIC,
    DIRECT,
    GLINT,
    KINDS,
    MULTIPATH,
    VIA_DELTA,
    DenseResponse,
    LightPath,
    Math,
    NumpyMath,
    Response,
    SparseResponse,
)
from rangesim.response.lengths import SPEED_OF_LIGHT, FirstReturn, LengthBins, LengthSplit, Phasor
from rangesim.response.patterns import Fringes, GrayBits, Images

__all__ = [
    "CAUSTIC",
    "DIRECT",
    "GLINT",
    "KINDS",
    "MULTIPATH",
    "SPEED_OF_LIGHT",
    "VIA_DELTA",
    "DenseResponse",
    "FirstReturn",
    "Fringes",
    "GrayBits",
    "Images",
    "LengthBins",
    "LengthSplit",
    "LightPath",
    "Math",
    "NumpyMath",
    "Phasor",
    "Response",
    "SparseResponse",
]
