# SPDX-License-Identifier: Apache-2.0
"""Decoder of all codes of structured light: zero-mean normalised cross-correlation (ZNCC) with the patterns."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from rangesim.capture import Capture
from rangesim.codes import Code, CodeThresholds, GrayThresholds
from rangesim.codes.zncc_matching import CorrelatedCode, check_columns, correlation_contradiction, decode_by_correlation
from rangesim.decoding.phase_shift import PhaseThresholds
from rangesim.decoding.range_image import RangeImage
from rangesim.decoding.triangulation import ProjectorCoordinates, TriangulationLimits
from rangesim.decoding.working_range import WorkingRange
from rangesim.sensor import Background, Decoder, Sensor, of_type
from rangesim.sensors.structured_light import StructuredLight, StructuredLightDecoder, checked, joined_axes
from rangesim.settings.bounds import check_fields


@dataclass(frozen=True)
class ZnccDecoder(Decoder):
    """Decodes the frames of any code by correlation with its patterns, and triangulates them.

    It needs no knowledge of the code but its patterns, and uses all frames for each reading. Where a code has a decoder
    of its own, that is faster and names more faults. The confidence is the correlation with the best place minus that
    with the best one that is no neighbour of it, 0 to 1.

    Parameters
    ----------
    gray : GrayThresholds, those of the contrast and of the bits. triangulation : TriangulationLimits.
    working_range : WorkingRange, outside which readings are refused; None: all that triangulate are kept.

    References
    ----------
    Mirdehghan, Chen, Kutulakos: "Optimal structured light a la carte", CVPR (2018).

    Examples
    --------
    >>> sensor = StructuredLight(64, 48)
    >>> seen = ZnccDecoder().coordinates(Capture(sensor.patterns(), sensor))  # a camera that sees the patterns flat
    >>> round(float(seen.column[7, 20]), 3)
    20.5
    """

    gray: GrayThresholds = field(default_factory=GrayThresholds)
    triangulation: TriangulationLimits = field(default_factory=TriangulationLimits)
    working_range: WorkingRange | None = None

    type_name: ClassVar[str] = "zncc"
    reads: ClassVar[type[Sensor]] = StructuredLight

    def __post_init__(self) -> None:
        check_fields(self)

    def check(self, sensor: Sensor) -> None:
        """Raise ValueError if the sensor has no patterns, or patterns that do not tell all its pixels apart."""
        super().check(sensor)
        shown = of_type(sensor, StructuredLight)
        names = set(shown.frame_names())
        for axis in shown.axes:
            patterns = _shown_patterns(shown, axis)
            check_columns(patterns, has_white_and_black={"white", "black"} <= names)

    def coordinates(self, capture: Capture) -> ProjectorCoordinates:
        """Projector coordinates of a `StructuredLight` capture.

        `DoubtWarning` if no column of the patterns explains most of the pixels.

        Raises
        ------
        ValueError
            The patterns do not tell all pixels of the projector from each other.
        """
        sensor = of_type(capture.sensor, StructuredLight)
        found: dict[str, CorrelatedCode] = {}
        contradictions: list[str] = []
        axes = self._by_code.axis_frames(capture)
        for seen in axes:
            patterns = _shown_patterns(sensor, seen.axis)
            found[seen.axis] = decode_by_correlation(seen, patterns, self.gray)
            if contradiction := correlation_contradiction(seen, patterns):
                contradictions.append(contradiction)
        codes = {axis: one.code for axis, one in found.items()}
        confidence = np.minimum.reduce([one.distance for one in found.values()])
        contrast = axes[0].contrast
        doubts = checked(capture, contrast, contradictions)
        return joined_axes(capture, codes, contrast, confidence, self.triangulation, doubts)

    @property
    def _by_code(self) -> StructuredLightDecoder:
        """The decoder that knows the codes, with the same thresholds."""
        return StructuredLightDecoder(self.gray, triangulation=self.triangulation)

    def least_signal(self, sensor: Sensor, background: Background) -> np.ndarray:
        """Least light by which white and black are told from each other, whatever the code."""
        shown = of_type(sensor, StructuredLight)
        axis, thresholds = shown.axes[0], CodeThresholds(self.gray, PhaseThresholds())
        return Code.least_signal(shown.code, shown.size(axis), shown.shown_names(axis), thresholds, background)

    def likely_cause(self, capture: Capture, image: RangeImage) -> str | None:
        return self._by_code.likely_cause(capture, image)


def _shown_patterns(sensor: StructuredLight, axis: str) -> np.ndarray:
    """(n, size) float32, the patterns of an axis that were shown, as the projector's gamma shows them."""
    size, shown = sensor.size(axis), set(sensor.frame_names())
    kept = [f"{axis}_{name}" in shown for name in sensor.code.names(size)]
    return np.asarray(sensor.code.patterns(size)[kept] ** np.float32(sensor.projector_gamma))
