# SPDX-License-Identifier: Apache-2.0
"""Temporally coded structured light: Gray code, alone or with N-step phase shift; and its decoder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar, Literal

import numpy as np

from rangesim.capture import Capture
from rangesim.decoding.axis_code import AxisCode, AxisFrames
from rangesim.decoding.gray import GrayThresholds, direct_contrast
from rangesim.decoding.phase_shift import PhaseThresholds
from rangesim.decoding.range_image import MIN_MEASURED, RangeImage
from rangesim.decoding.status import Status
from rangesim.decoding.triangulation import ProjectorCoordinates, TriangulationLimits
from rangesim.decoding.working_range import WorkingRange
from rangesim.errors import warn
from rangesim.response import DenseResponse, LightPath, NumpyMath
from rangesim.rig import Rig
from rangesim.sensor import Background, Decoder, Emitter, Sensor, of_type
from rangesim.sensors.coded_frames import CodedFrames, CodeThresholds, FringeFrames, GrayFrames
from rangesim.settings import limits
from rangesim.settings.bounds import Bounds, check_fields, whole

WHITE = -2
"""Index of the frame under constant light at full power: the last but one, as in OpenCV's order."""

BLACK = -1
"""Index of the frame without light of the projector: the last one, as in OpenCV."""

MIN_CONTRAST = 0.02
"""Least difference by which black is brighter than white, as a fraction of full scale, at a pixel that counts as a sign
that the two frames are exchanged. Noise alone makes black a little brighter in half of the dark pixels."""

MAX_ACROSS = 0.25
"""Largest ratio of the baseline across the stripes of an axis to the baseline along them, at which the axis counts as
useless for depth: depth is then at least four times as uncertain as with the other axis."""


@dataclass(frozen=True)
class StructuredLight(Sensor):
    """A projector that shows a stack of patterns, and a camera that takes one frame of each.

    Frames, in OpenCV's order: for each axis the Gray bits, most significant first, each followed by its inverse;
    then, with `code="gray-phase"`, the `steps` fringe patterns of that axis; at the end white and black.

    Parameters
    ----------
    projector_width, projector_height : int, pixels of the projector.
    code : "gray" decodes to whole projector pixels, "gray-phase" [2]_ to fractions of a pixel. Phase shift in N steps
        finds the place within a period, Gray code finds the period. The Gray bits go to half a period or finer, so that
        a bit error at a stripe edge cannot become a period error.
    axes : "columns" suffices to triangulate. Columns and rows give the full correspondence (calibration, checks).
    period_px : float, period of the fringes in projector pixels.
    steps : int >= 3, number of phase shifts.

    References
    ----------
    - OpenCV, structured_light module, GrayCodePattern.
    - Sansoni, Carocci, Rodella: "Three-dimensional vision based on a combination of gray-code and
      phase-shift light projection", Applied Optics 38 (1999).

    Examples
    --------
    >>> sensor = StructuredLight(8, 4, code="gray")
    >>> sensor.frame_names()[:4]
    ['columns_bit2', 'columns_bit2_inverse', 'columns_bit1', 'columns_bit1_inverse']
    >>> sensor.patterns()[:, 0].astype(int)[0]  # a row of the coarsest bit
    array([0, 0, 0, 0, 1, 1, 1, 1])
    """

    projector_width: Annotated[int, whole(2, "projector")] = 1280
    projector_height: Annotated[int, whole(2, "projector")] = 800
    code: Literal["gray", "gray-phase"] = "gray-phase"
    axes: tuple[Literal["columns", "rows"], ...] = ("columns",)
    period_px: Annotated[float, Bounds("projector pixels", 2, 1e6)] = 16.0
    steps: Annotated[int, whole(3, "steps")] = 4

    type_name: ClassVar[str] = "structured-light"
    triangulates: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_fields(self)
        if not self.axes or list(self.axes) != sorted(set(self.axes)):
            raise ValueError(f"expected axes to be columns, rows or both in that order, got {self.axes!r}.")
        limits.check("pixels", self.projector_width * self.projector_height, "pixels of a projector")

    def size(self, axis: str) -> int:
        """Projector pixels along `axis`."""
        return self.projector_width if axis == "columns" else self.projector_height

    def layout(self) -> tuple[CodedFrames, ...]:
        """The runs of coded frames before white and black, in order.

        A subclass may return runs of other kinds; these decide on the frames, their names and their decoding.
        """
        runs: list[CodedFrames] = []
        start = 0
        for axis in self.axes:
            bits = int(np.ceil(np.log2(self.size(axis))))
            shift = 0 if self.code == "gray" else max(0, min(bits - 1, int(np.floor(np.log2(self.period_px / 2)))))
            runs.append(GrayFrames(axis, self.size(axis), start, bits, shift))
            start = runs[-1].span.stop
            if self.code == "gray-phase":
                runs.append(FringeFrames(axis, self.size(axis), start, self.period_px, self.steps))
                start = runs[-1].span.stop
        return tuple(runs)

    def responses(self) -> tuple[DenseResponse, ...]:
        return tuple(run.response for run in self.layout())

    def frames(self, channels: Sequence[np.ndarray], white: np.ndarray, ambient: np.ndarray) -> np.ndarray:
        result = np.empty((self.n_frames, *white.shape), dtype=np.float32)
        for run, values in zip(self.layout(), channels, strict=True):
            run.frames(values, white, ambient, result[run.span])
        np.add(white, ambient, out=result[WHITE], casting="same_kind")
        np.add(np.zeros_like(white), ambient, out=result[BLACK], casting="same_kind")
        return result

    def check(self, width: int, height: int) -> None:
        if (width, height) != (self.projector_width, self.projector_height):
            raise ValueError(
                f"expected a rig whose projector has the {self.projector_width} x {self.projector_height} pixels that "
                f"the sensor codes, got {width} x {height}."
            )

    def frame_names(self) -> list[str]:
        return [*(name for run in self.layout() for name in run.names()), "white", "black"]

    def white_image(self, frames: np.ndarray) -> np.ndarray:
        """(h, w), the white frame."""
        return np.asarray(frames[WHITE])

    def for_projector(self, width: int, height: int, axes: Sequence[str] | None = None) -> StructuredLight:
        coded = self.axes if axes is None else tuple(axes)
        return replace(self, projector_width=width, projector_height=height, axes=coded)  # type: ignore[arg-type]

    @property
    def default_emitter(self) -> Emitter:
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
        """White, a frame of middle fineness, and a fringe or the finest frame."""
        runs = self.layout()
        is_coarse = [all(before.axis != run.axis for before in runs[:i]) for i, run in enumerate(runs)]
        coarse = [i for run, first in zip(runs, is_coarse, strict=True) if first for i in run.distinct]
        fine = [run.start for run, first in zip(runs, is_coarse, strict=True) if not first]
        return [len(frames) + WHITE, coarse[len(coarse) // 2], *(fine[:1] or coarse[-1:])]

    def patterns(self) -> np.ndarray:
        """(k, projector_height, projector_width) float32 in 0..1: the patterns as shown, at pixel centres."""
        size = 4 * self.n_frames * self.projector_width * self.projector_height
        limits.check("bytes", size, f"bytes of {self.n_frames} patterns")
        x, y = np.meshgrid(np.arange(self.projector_width) + 0.5, np.arange(self.projector_height) + 0.5)
        path = LightPath(x, y, 0 * x, True)
        weights = [np.stack(r.weights(path, NumpyMath())) for r in self.responses()]  # type: ignore[arg-type]
        return self.frames(weights, np.ones_like(x), np.zeros_like(x))


@dataclass(frozen=True)
class StructuredLightDecoder(Decoder):
    """Decodes Gray code, with or without phase shift, to projector coordinates, and triangulates them.

    Without a rig, only the projector coordinates are decoded: z is NaN everywhere, `status` is that of the code.

    Parameters
    ----------
    gray : GrayThresholds. phase : PhaseThresholds. triangulation : TriangulationLimits.
    working_range : WorkingRange, outside which readings are refused; None: all that triangulate are kept.

    Examples
    --------
    >>> sensor = StructuredLight(64, 48, axes=("columns", "rows"))
    >>> seen = StructuredLightDecoder().coordinates(Capture(sensor.patterns(), sensor))  # a camera that sees them flat
    >>> round(float(seen.column[7, 20]), 3), round(float(seen.row[7, 20]), 3)
    (20.5, 7.5)
    """

    gray: GrayThresholds = field(default_factory=GrayThresholds)
    phase: PhaseThresholds = field(default_factory=PhaseThresholds)
    triangulation: TriangulationLimits = field(default_factory=TriangulationLimits)
    working_range: WorkingRange | None = None

    type_name: ClassVar[str] = "structured-light"
    reads: ClassVar[type[Sensor]] = StructuredLight

    def __post_init__(self) -> None:
        check_fields(self)

    def coordinates(self, capture: Capture) -> ProjectorCoordinates:
        """Projector coordinates of a `StructuredLight` capture.

        `RangesimWarning` if frames and code contradict each other as a whole.
        """
        sensor = of_type(capture.sensor, StructuredLight)
        contrast = direct_contrast(capture, capture.frames[WHITE], capture.frames[BLACK], self.gray)
        codes: dict[str, AxisCode] = {}
        contradictions: dict[str, str | None] = {}
        for run in sensor.layout():
            axis, coarse = run.axis, codes.get(run.axis)
            seen = AxisFrames(capture, axis, run.names(), capture.frames[run.span], contrast)
            codes[axis] = run.decode(seen, coarse, self._thresholds)
            contradictions[axis] = contradictions.get(axis) or run.contradiction(seen, coarse, codes[axis])
        for contradiction in filter(None, contradictions.values()):
            warn(contradiction)
        for axis, code in codes.items():
            outside = (code.coordinate < -0.5) | (code.coordinate > sensor.size(axis) + 0.5)
            code.status[outside & (code.status == Status.OK)] = Status.CODE_ERROR
        coordinate = {axis: code.coordinate for axis, code in codes.items()}
        sigma_px = {axis: code.sigma_px for axis, code in codes.items()}
        return ProjectorCoordinates(
            column=coordinate.get("columns"),
            row=coordinate.get("rows"),
            column_sigma_px=sigma_px.get("columns"),
            row_sigma_px=sigma_px.get("rows"),
            status=_first_failure([code.status for code in codes.values()]),
            confidence=contrast.values / np.float32(capture.full_scale),
            intensity=contrast.white.astype(np.float32) - np.float32(capture.black_level),
            limits=self.triangulation,
            is_doubted=any(contradictions.values()),
        )

    @property
    def _thresholds(self) -> CodeThresholds:
        return CodeThresholds(self.gray, self.phase)

    def least_signal(self, sensor: Sensor, background: Background) -> np.ndarray:
        runs = of_type(sensor, StructuredLight).layout()
        return np.asarray(np.maximum.reduce([run.least_signal(self._thresholds, background) for run in runs]))

    def likely_cause(self, capture: Capture, image: RangeImage) -> str | None:
        if _rows_come_first(image):
            return "columns change along the image's height and rows along its width: rows may have been shown first"
        if float(image.valid.mean()) >= MIN_MEASURED:
            return None
        contrast = capture.frames[WHITE].astype(np.float32) - capture.frames[BLACK].astype(np.float32)
        clear = MIN_CONTRAST * capture.full_scale
        inverted = float((contrast < -clear).mean())
        if inverted > float((contrast > clear).mean()):
            return (
                f"black is brighter than white at {100 * inverted:.0f} % of the pixels: the last two images are white, "
                "then black"
            )
        if axis := _axis_along_baseline(image, of_type(capture.sensor, StructuredLight).axes, capture.rig):
            other = "rows" if axis == "columns" else "columns"
            return f"{axis} tell no depth here, because camera and projector stand apart along them: code {other}"
        return None


def _first_failure(statuses: list[np.ndarray]) -> np.ndarray:
    """(h, w) uint8, per pixel the first status that is not OK."""
    result = statuses[0].copy()
    for status in statuses[1:]:
        result = np.where(result == Status.OK, status, result)
    return result


def _axis_along_baseline(image: RangeImage, axes: Sequence[str], rig: Rig | None) -> str | None:
    """The only coded axis, if the baseline runs along its stripes and most decoded pixels are out of range for this
    reason."""
    if rig is None or len(axes) != 1:
        return None
    decoded = np.isin(image.status, [Status.OK, Status.OUT_OF_RANGE])
    if 2 * np.count_nonzero(image.status == Status.OUT_OF_RANGE) <= np.count_nonzero(decoded):
        return None
    x, y = np.abs(rig.T_camera_projector[:3, :3].T @ rig.T_camera_projector[:3, 3])[:2]
    across, along = (x, y) if axes[0] == "columns" else (y, x)
    return axes[0] if across < MAX_ACROSS * along else None


def _rows_come_first(image: RangeImage) -> bool:
    """Whether columns change down the image and rows across it, each twice as much as the other way."""
    if image.projector_column is None or image.projector_row is None:
        return False
    column, row = (_changes(c) for c in (image.projector_column, image.projector_row))
    return column[1] > 2 * column[0] and row[0] > 2 * row[1]


def _changes(coordinate: np.ndarray) -> tuple[float, float]:
    """Mean size of the change to the next pixel across and down; 0 where no neighbours were decoded."""
    steps = (np.abs(np.diff(coordinate, axis=axis)) for axis in (1, 0))
    known = (s[np.isfinite(s)] for s in steps)
    across, down = (float(k.mean()) if k.size else 0.0 for k in known)
    return across, down
