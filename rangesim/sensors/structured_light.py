# SPDX-License-Identifier: Apache-2.0
"""Temporally coded structured light: Gray code, alone or with N-step phase shift; and its decoder."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal, NamedTuple

import numpy as np

from rangesim.capture import Capture
from rangesim.decoding.contradictions import (
    binary_contradiction,
    fringe_contradiction,
    level_contradiction,
    order_contradiction,
    pair_contradiction,
)
from rangesim.decoding.gray import GrayCode, GrayThresholds, decode_gray, direct_contrast
from rangesim.decoding.phase_shift import PhaseThresholds, refine_by_phase
from rangesim.decoding.range_image import RangeImage
from rangesim.decoding.status import Status
from rangesim.decoding.triangulate import TriangulationLimits, range_image_from_coordinates
from rangesim.errors import warn
from rangesim.response import DenseResponse, Fringes, GrayBits, LightPath, NumpyMath
from rangesim.sensor import Background, Decoder, Emitter, FrameContent, Sensor, least_signal_for, of_type
from rangesim.settings import limits
from rangesim.settings.bounds import Bounds, check_fields, whole

AXES = ("columns", "rows")
WHITE, BLACK = -2, -1
"""Indices of the last two frames."""


class CodedFrames(NamedTuple):
    """A run of frames that code one axis. response : what they are made of. frames : where they stand."""

    axis: str
    response: GrayBits | Fringes
    frames: slice


@dataclass(frozen=True)
class StructuredLight(Sensor):
    """A projector that shows a stack of patterns, and a camera that takes one frame of each.

    Frames, in OpenCV's order [1]_: for each axis the Gray bits, most significant first, each followed by
    its inverse; then, with `code="gray-phase"`, the `steps` fringe patterns of that axis; at the end white
    and black.

    Parameters
    ----------
    projector_width, projector_height : int, pixels of the projector.
    code : "gray" decodes to whole projector pixels; "gray-phase" [2]_ to fractions of a pixel: N-step phase
        shift finds the place within a period, Gray code the period. The Gray bits go to half a period or finer,
        so that a bit error at a stripe edge cannot become a period error.
    axes : "columns" suffices to triangulate; "rows" as well gives full correspondence (calibration, checks).
    period_px : float, period of the fringes in projector pixels.
    steps : int >= 3, number of phase shifts.

    References
    ----------
    .. [1] OpenCV, structured_light module, GrayCodePattern.
    .. [2] Sansoni, Carocci, Rodella: "Three-dimensional vision based on a combination of gray-code and
       phase-shift light projection", Applied Optics 38 (1999).
    """

    projector_width: Annotated[int, whole(2, "projector")] = 1280
    projector_height: Annotated[int, whole(2, "projector")] = 800
    code: Literal["gray", "gray-phase"] = "gray-phase"
    axes: tuple[Literal["columns", "rows"], ...] = ("columns",)
    period_px: Annotated[float, Bounds("projector pixels", 2, 1e6)] = 16.0
    steps: Annotated[int, whole(3, "steps")] = 4

    type_name: ClassVar[str] = "structured-light"

    def __post_init__(self) -> None:
        check_fields(self)
        if not self.axes or list(self.axes) != sorted(set(self.axes)):
            raise ValueError(f"expected axes to be columns, rows or both in that order, got {self.axes!r}.")
        limits.check("pixels", self.projector_width * self.projector_height, "pixels of a projector")

    def size(self, axis: str) -> int:
        """Projector pixels along `axis`."""
        return self.projector_width if axis == "columns" else self.projector_height

    def layout(self) -> tuple[CodedFrames, ...]:
        """The runs of frames before white and black, in order."""
        runs, start = [], 0
        for axis in self.axes:
            gray = self._gray(axis)
            coded: list[tuple[GrayBits | Fringes, int]] = [(gray, 2 * gray.channels)]
            if self.code == "gray-phase":
                coded.append((Fringes(AXES.index(axis), self.period_px), self.steps))
            for response, length in coded:
                runs.append(CodedFrames(axis, response, slice(start, start + length)))
                start += length
        return tuple(runs)

    def _gray(self, axis: str) -> GrayBits:
        """Gray bits shown along `axis`."""
        bits = int(np.ceil(np.log2(self.size(axis))))
        shift = 0 if self.code == "gray" else max(0, min(bits - 1, int(np.floor(np.log2(self.period_px / 2)))))
        return GrayBits(AXES.index(axis), bits, shift)

    def responses(self) -> tuple[DenseResponse, ...]:
        return tuple(run.response for run in self.layout())

    def frames(self, channels: Sequence[np.ndarray], white: np.ndarray, ambient: np.ndarray) -> np.ndarray:
        result = np.empty((self.n_frames, *white.shape), dtype=np.float32)
        for run, values in zip(self.layout(), channels, strict=True):
            lit = result[run.frames]
            if isinstance(run.response, GrayBits):
                for bit, pattern, inverse in zip(values, lit[0::2], lit[1::2], strict=True):
                    np.add(bit, ambient, out=pattern, casting="same_kind")
                    np.add(white - bit, ambient, out=inverse, casting="same_kind")
            else:
                for s, fringe in enumerate(lit):
                    shift = 2 * math.pi * s / self.steps
                    shown = 0.5 * (white + math.cos(shift) * values[0] + math.sin(shift) * values[1])
                    np.add(shown, ambient, out=fringe, casting="same_kind")
        np.add(white, ambient, out=result[WHITE], casting="same_kind")
        np.add(np.zeros_like(white), ambient, out=result[BLACK], casting="same_kind")
        return result

    def check(self, width: int, height: int) -> None:
        if (width, height) != (self.projector_width, self.projector_height):
            raise ValueError(
                f"expected a projector of {self.projector_width} x {self.projector_height} pixels as the sensor codes, "
                f"got a rig whose projector has {width} x {height}."
            )

    def frame_names(self) -> list[str]:
        names: list[str] = []
        for axis, response, _ in self.layout():
            if isinstance(response, GrayBits):
                bits = range(response.shift, response.bits)
                names += [f"{axis}_bit{b}{suffix}" for b in reversed(bits) for suffix in ("", "_inverse")]
            else:
                names += [f"{axis}_phase{s}" for s in range(self.steps)]
        return [*names, "white", "black"]

    @property
    def emitter(self) -> Emitter:
        return Emitter((self.projector_width, self.projector_height))

    @property
    def default_decoder(self) -> StructuredLightDecoder:
        return StructuredLightDecoder()

    @classmethod
    def presets(cls) -> dict[str, Sensor]:
        return {"gray": cls(code="gray"), "gray-phase": cls()}

    @property
    def title(self) -> str:
        return "Structured light" if self.code == "gray-phase" else "Structured light (Gray code)"

    @property
    def details(self) -> str:
        fringes = f" and {self.steps}-step fringes of {self.period_px:g} px" if self.code == "gray-phase" else ""
        size = f"{self.projector_width} × {self.projector_height}"
        return f"Gray code{fringes} along {' and '.join(self.axes)}, projector {size}"

    def representative_frames(self, frames: np.ndarray) -> list[int]:
        """White, a bit of middle fineness, and a fringe or the finest bit."""
        bits = [i for run in self.layout() if isinstance(run.response, GrayBits) for i in _indices(run.frames)[0::2]]
        fringes = [run.frames.start for run in self.layout() if isinstance(run.response, Fringes)]
        return [len(frames) + WHITE, bits[len(bits) // 2], *(fringes[:1] or bits[-1:])]

    def patterns(self) -> np.ndarray:
        """(k, projector_height, projector_width) float32 in 0..1: the patterns as shown, at pixel centres."""
        size = 4 * self.n_frames * self.projector_width * self.projector_height
        limits.check("bytes", size, f"bytes of {self.n_frames} patterns")
        x, y = np.meshgrid(np.arange(self.projector_width) + 0.5, np.arange(self.projector_height) + 0.5)
        path = LightPath(x, y, 0 * x, True)
        weights = [np.stack(r.weights(path, NumpyMath())) for r in self.responses()]  # type: ignore[arg-type]
        return self.frames(weights, np.ones_like(x), np.zeros_like(x))


def _indices(frames: slice) -> range:
    return range(frames.start, frames.stop)


@dataclass(frozen=True)
class StructuredLightDecoder(Decoder):
    """Decodes Gray code, with or without phase shift, to projector coordinates, and triangulates them.

    Without a rig, only the projector coordinates are decoded: z is NaN everywhere, `status` is that of the code.

    Parameters
    ----------
    gray : GrayThresholds. phase : PhaseThresholds. triangulation : TriangulationLimits.
    """

    gray: GrayThresholds = field(default_factory=GrayThresholds)
    phase: PhaseThresholds = field(default_factory=PhaseThresholds)
    triangulation: TriangulationLimits = field(default_factory=TriangulationLimits)

    type_name: ClassVar[str] = "structured-light"
    reads: ClassVar[type[Sensor]] = StructuredLight

    def __post_init__(self) -> None:
        check_fields(self)

    def decode(self, capture: Capture) -> RangeImage:
        """Range image of a `StructuredLight` capture; ValueError also if the rig's projector is not of its size.

        `RangesimWarning` if frames and code contradict each other as a whole.
        """
        sensor = of_type(capture.sensor, StructuredLight)
        if capture.rig is not None:
            sensor.check(capture.rig.projector.width, capture.rig.projector.height)
        contrast = direct_contrast(capture, capture.frames[WHITE], capture.frames[BLACK], self.gray)
        codes: dict[str, GrayCode] = {}
        contradictions: dict[str, str | None] = {}
        for axis, response, frames in sensor.layout():
            if isinstance(response, GrayBits):
                shift, size = response.shift, sensor.size(axis)
                codes[axis] = decode_gray(capture, capture.frames[frames], shift, size, contrast, self.gray)
                names = sensor.frame_names()
                contradictions[axis] = (
                    pair_contradiction(capture, contrast, frames, names, axis)
                    or binary_contradiction(codes[axis], names[frames], axis)
                    or order_contradiction(codes[axis], names[frames], axis)
                )
            else:
                fringes, least_swing = capture.frames[frames], self.gray.relative_bit * contrast.values
                period_px = response.period_px
                gray = codes[axis]
                codes[axis] = refine_by_phase(capture, gray, fringes, period_px, least_swing, self.phase)
                contradictions[axis] = (
                    contradictions[axis]
                    or level_contradiction(capture, gray, codes[axis], frames, sensor.frame_names(), axis)
                    or fringe_contradiction(gray, codes[axis], fringes, contrast.values, period_px, axis)
                )
        for contradiction in filter(None, contradictions.values()):
            warn(contradiction)
        for axis, code in codes.items():
            outside = (code.coordinate < -0.5) | (code.coordinate > sensor.size(axis) + 0.5)
            code.status[outside & (code.status == Status.OK)] = Status.CODE_ERROR
        column, row = (codes[axis].coordinate if axis in codes else None for axis in AXES)
        return range_image_from_coordinates(
            capture,
            column,
            row,
            status=_worst([code.status for code in codes.values()]),
            confidence=contrast.values / np.float32(capture.full_scale),
            intensity=capture.frames[WHITE].astype(np.float32) - np.float32(capture.black_level),
            limits=self.triangulation,
            code_is_doubted=any(contradictions.values()),
        )

    def least_signal(self, sensor: Sensor, background: Background) -> np.ndarray:
        sensor, ambient, noise_variance = (
            of_type(sensor, StructuredLight),
            background.ambient,
            background.noise_variance,
        )
        if noise_variance is None:
            least = background.floor(self.gray.relative_contrast)
        else:  # white - black holds the noise of two frames
            least = least_signal_for(self.gray.contrast_sigmas**2, 1.0, 2 * (ambient + noise_variance))
        if sensor.code == "gray-phase":
            least = np.maximum(least, self.phase.least_signal(sensor.steps, 0.5, FrameContent(), background))
        return least


def _worst(statuses: list[np.ndarray]) -> np.ndarray:
    """The first status that is not OK, per pixel."""
    result = statuses[0].copy()
    for status in statuses[1:]:
        result = np.where(result == Status.OK, status, result)
    return result
