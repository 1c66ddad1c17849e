# SPDX-License-Identifier: Apache-2.0
"""Responses: the weights with which sensors count light paths. `rangesim.response.response` has the interface."""

from rangesim.response.correlation import Correlation
from rangesim.response.path_lengths import SPEED_OF_LIGHT, FirstReturn, LengthSplit, Phasor, TransientHistogram
from rangesim.response.patterns import Dots, Fringes, GrayBits, Images, Stripes
from rangesim.response.pulse import Pulse
from rangesim.response.response import (
    CAUSTIC,
    DIRECT,
    GLINT,
    KINDS,
    MULTIPATH,
    SPECULAR,
    DenseResponse,
    LightPath,
    Math,
    NumpyMath,
    Response,
    SparseResponse,
)

__all__ = [
    "CAUSTIC",
    "DIRECT",
    "GLINT",
    "KINDS",
    "MULTIPATH",
    "SPECULAR",
    "SPEED_OF_LIGHT",
    "Correlation",
    "DenseResponse",
    "Dots",
    "FirstReturn",
    "Fringes",
    "GrayBits",
    "Images",
    "LengthSplit",
    "LightPath",
    "Math",
    "NumpyMath",
    "Phasor",
    "Pulse",
    "Response",
    "SparseResponse",
    "Stripes",
    "TransientHistogram",
]
