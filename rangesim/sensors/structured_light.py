# SPDX-License-Identifier: Apache-2.0
"""Temporally coded structured light: a projector that shows the patterns of a code in turn; and its decoder."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Annotated, ClassVar, Literal

import numpy as np

from rangesim.capture import Capture
from rangesim.codes import (
    AXES,
    AxisCode,
    AxisFrames,
    Code,
    CodeThresholds,
    Contrast,
    GrayPhase,
    GrayThresholds,
)
from rangesim.codes.code import stripes
from rangesim.codes.contrast import direct_contrast
from rangesim.codes.frame_order import in_order
from rangesim.decoding.orientation import changes_along, fringe_doubt, orientation_contradiction
from rangesim.decoding.phase_shift import PhaseThresholds
from rangesim.decoding.pixel_samples import MIN_PIXELS, equal_frames, same_images
from rangesim.decoding.range_image import MIN_MEASURED, RangeImage
from rangesim.decoding.status import Status
from rangesim.decoding.triangulation import ProjectorCoordinates, TriangulationLimits
from rangesim.decoding.working_range import WorkingRange
from rangesim.errors import DoubtWarning, warn
from rangesim.response import DenseResponse
from rangesim.rig import Rig
from rangesim.sensor import Background, Decoder, Emitter, ReceivedLight, Sensor, is_told_by, of_type
from rangesim.settings import limits
from rangesim.settings.bounds import Bounds, check_fields, whole
from rangesim.settings.config import has_defaults, nearest, shown

WHITE = "white"
"""Name of the frame under constant light at full power."""

BLACK = "black"
"""Name of the frame without light of the projector."""

MIN_CONTRAST = 0.02
"""Least difference by which black is brighter than white, as a fraction of full scale, at a pixel that counts as a sign
that the two frames are exchanged. Noise alone makes black a little brighter in half of the dark pixels."""

MAX_BEYOND_FRACTION = 0.02
"""Largest fraction of the codes that may lie beyond the projector. Errors of single pixels put fewer there, and a
projector that is a twentieth larger than stated more."""

MAX_ACROSS = 0.25
"""Largest ratio of the baseline across the stripes of an axis to the baseline along them, at which the axis counts as
useless for depth: depth is then at least four times as uncertain as with the other axis."""


@dataclass(frozen=True)
class StructuredLight(Sensor):
    """A projector that shows a stack of patterns, and a camera that takes one frame of each.

    Frames, unless `order` says otherwise: for each axis those of the code, then white and black, as in OpenCV's order.

    Parameters
    ----------
    projector_width, projector_height : int, pixels of the projector.
    code : a `rangesim.codes.Code`, or the name of one: "gray" decodes to whole projector pixels, "gray-phase" to
        fractions of a pixel; see docs/codes.md for all.
    axes : "columns" suffices to triangulate. Columns and rows give the full correspondence (calibration, checks). The
        axis that is named first is shown first.
    order : entries that say which frames are shown in which order, such as ("white", "black", "*"), see
        `rangesim.codes.frame_order.in_order`; none: all of them.
    projector_gamma : float; a projector shows a pattern of the value p with the power p ** projector_gamma. 1 is
        linear, as codes expect; uncorrected video projectors have about 2.2.

    Examples
    --------
    >>> sensor = StructuredLight(8, 4, code="gray")
    >>> sensor.frame_names()[:4]
    ['columns_bit2', 'columns_bit2_inverse', 'columns_bit1', 'columns_bit1_inverse']
    >>> sensor.patterns()[:, 0].astype(int)[0]  # a row of the coarsest bit
    array([0, 0, 0, 0, 1, 1, 1, 1])
    >>> StructuredLight(8, 4, "gray", order=("white", "black", "*_bit?")).frame_names()  # no inverses
    ['white', 'black', 'columns_bit2', 'columns_bit1', 'columns_bit0']
    """

    projector_width: Annotated[int, whole(2, "projector")] = 1280
    projector_height: Annotated[int, whole(2, "projector")] = 800
    code: Code = field(default_factory=GrayPhase)
    axes: tuple[Literal["columns", "rows"], ...] = ("columns",)
    order: tuple[str, ...] = ()
    projector_gamma: Annotated[float, Bounds("an exponent", 0.1, 10)] = 1.0

    type_name: ClassVar[str] = "structured-light"
    triangulates: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if isinstance(self.code, str):
            if self.code not in Code.known:
                raise ValueError(
                    f"expected code to be one of {', '.join(Code.known)}, got {shown(self.code)}"
                    f"{nearest(self.code, Code.known)}."
                )
            object.__setattr__(self, "code", Code.known[self.code]())
        check_fields(self)
        if not self.axes or len(set(self.axes)) < len(self.axes):
            raise ValueError(f"expected axes to be columns, rows or both, got {self.axes!r}.")
        limits.check("pixels", self.projector_width * self.projector_height, "pixels of a projector")
        for axis in self.axes:
            self.code.check(self.size(axis))
        if self.order:
            for axis in self.axes:
                self.code.check_shown(self.size(axis), self.shown_names(axis))

    def shown_names(self, axis: str) -> list[str]:
        """Names of the frames of an axis that are shown, as the code names them, and white and black if they are."""
        in_view = set(self.frame_names())
        coded = [name for name in self.code.names(self.size(axis)) if f"{axis}_{name}" in in_view]
        return [*coded, *(name for name in (WHITE, BLACK) if name in in_view)]

    def size(self, axis: str) -> int:
        """Projector pixels along `axis`."""
        return self.projector_width if axis == "columns" else self.projector_height

    def _all_names(self) -> list[str]:
        """Names of all frames that the code knows, in its own order."""
        coded = [f"{axis}_{name}" for axis in self.axes for name in self.code.names(self.size(axis))]
        return [*coded, WHITE, BLACK]

    def frame_names(self) -> list[str]:
        return in_order(self._all_names(), self.order)

    def responses(self) -> tuple[DenseResponse, ...]:
        return tuple(response for axis in self.axes for response in self._responses(axis))

    def _responses(self, axis: str) -> tuple[DenseResponse, ...]:
        if self.projector_gamma == 1:
            return self.code.responses(AXES.index(axis), self.size(axis))
        return (stripes(self.code, AXES.index(axis), self.size(axis), self.projector_gamma),)

    def frames(self, channels: Sequence[np.ndarray], white: np.ndarray, ambient: np.ndarray) -> np.ndarray:
        places = {name: i for i, name in enumerate(self.frame_names())}
        result = np.empty((len(places), *white.shape), dtype=np.float32)
        remaining = list(channels)
        for axis in self.axes:
            size, n = self.size(axis), len(self._responses(axis))
            own, remaining = remaining[:n], remaining[n:]
            lit = self.code.frames(size, own, white) if self.projector_gamma == 1 else iter(own[0])
            for name, radiance in zip(self.code.names(size), lit, strict=True):
                if (place := places.get(f"{axis}_{name}")) is not None:
                    np.add(radiance, ambient, out=result[place], casting="same_kind")
        for name, radiance in ((WHITE, white), (BLACK, np.zeros_like(white))):
            if name in places:
                np.add(radiance, ambient, out=result[places[name]], casting="same_kind")
        return result

    def check(self, width: int, height: int) -> None:
        if (width, height) != (self.projector_width, self.projector_height):
            raise ValueError(
                f"expected a rig whose projector has the {self.projector_width} x {self.projector_height} pixels that "
                f"the sensor codes, got {width} x {height}."
            )

    def white_image(self, frames: np.ndarray) -> np.ndarray:
        """(h, w), the white frame; where none was shown, the mean of the frames."""
        names = self.frame_names()
        return np.asarray(frames[names.index(WHITE)]) if WHITE in names else super().white_image(frames)

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
        """One for each code that has defaults, by its name."""
        kinds = {name: kind for name, kind in Code.known.items() if has_defaults(kind)}
        return {name: _with_defaults(cls, kind) for name, kind in kinds.items()}  # type: ignore[arg-type]  # hashable

    @property
    def title(self) -> str:
        return self.code.title or f"Structured light ({self.code.type_name} code)"

    @property
    def details(self) -> str:
        size = f"{self.projector_width} × {self.projector_height}"
        return f"{self.code.details} along {' and '.join(self.axes)}, projector {size}"

    def representative_frames(self, frames: np.ndarray) -> list[int]:
        """White, and two frames of the first axis: a coarse and a fine one."""
        shown, axis = self.frame_names(), self.axes[0]
        wanted = [WHITE, *(f"{axis}_{name}" for name in self.code.representative(self.size(axis)))]
        return [shown.index(name) for name in wanted if name in shown]

    def patterns(self) -> np.ndarray:
        """(k, projector_height, projector_width) float32 in 0..1: the patterns as asked for, before any gamma, at pixel
        centres, in the order in which they are shown."""
        limits.check(
            "bytes",
            4 * self.n_frames * self.projector_width * self.projector_height,
            f"bytes of {self.n_frames} patterns",
        )
        shape, made = (self.projector_height, self.projector_width), self._values()
        return np.stack([np.broadcast_to(made[name], shape) for name in self.frame_names()])

    def _values(self) -> dict[str, np.ndarray]:
        """Pattern of each frame by its name: (1, width), (height, 1) or (1, 1) float32, without its equal pixels."""
        made = {WHITE: np.ones((1, 1), dtype=np.float32), BLACK: np.zeros((1, 1), dtype=np.float32)}
        for axis in self.axes:
            for name, values in zip(self.code.names(self.size(axis)), self.code.patterns(self.size(axis)), strict=True):
                made[f"{axis}_{name}"] = values[None, :] if axis == "columns" else values[:, None]
        return made

    def shows_the_same(self, one: str, other: str) -> bool:
        """Whether two frames, given by their names, have equal patterns."""
        made = self._values()
        return np.array_equal(made[one], made[other])

    def coded_frames(self, frames: np.ndarray, axis: str) -> tuple[list[str], np.ndarray]:
        """Names of the shown frames of an axis in the order of the code, without the axis, and the frames.

        Parameters
        ----------
        frames : (k, h, w), all frames of a capture.
        """
        places = {name: i for i, name in enumerate(self.frame_names())}
        names = [name for name in self.code.names(self.size(axis)) if f"{axis}_{name}" in places]
        at = [places[f"{axis}_{name}"] for name in names]
        is_run = at == list(range(at[0], at[0] + len(at)))  # a slice is a view, and copies nothing
        return names, frames[at[0] : at[-1] + 1] if is_run else frames[at]


@dataclass(frozen=True)
class StructuredLightDecoder(Decoder):
    """Decodes the frames of a code to projector coordinates, and triangulates them.

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

        `DoubtWarning` if frames and code contradict each other as a whole, or if two frames are the same.
        """
        sensor = of_type(capture.sensor, StructuredLight)
        axes, codes = self._codes(capture, sensor)
        found = [sensor.code.contradiction(seen, codes[seen.axis]) for seen in axes]
        contradictions = [text for text in found if text]
        if not contradictions:  # they name the cause better than what follows
            doubt = _orientation(codes) or _beyond_projector(sensor, codes) or _repeated_frames(capture)
            contradictions += [doubt] if doubt else []
        return self._joined(capture, axes, codes, checked(capture, axes[0].contrast, contradictions))

    def pixel_reader(self, sensor: Sensor) -> Callable[[Capture], ProjectorCoordinates] | None:
        """A reader of pixels, see `Decoder.pixel_reader`; None if the code needs neighbours or a gamma is corrected."""
        shown = of_type(sensor, StructuredLight)

        def unchecked(capture: Capture) -> ProjectorCoordinates:
            axes, codes = self._codes(capture, shown)
            return replace(self._joined(capture, axes, codes, []), is_checked=False)

        is_by_pixel = shown.code.is_by_pixel and is_told_by(type(shown.code), "is_by_pixel", "decode")
        return unchecked if is_by_pixel and shown.projector_gamma == 1 else None

    def _codes(self, capture: Capture, sensor: StructuredLight) -> tuple[list[AxisFrames], dict[str, AxisCode]]:
        """The frames of each axis, and their code by the name of the axis."""
        axes, codes = self.axis_frames(capture), {}
        for seen in axes:
            code = sensor.code.decode(seen, self.thresholds)
            outside = (code.coordinate < -0.5) | (code.coordinate > seen.size + 0.5)
            code.status[outside & (code.status == Status.OK)] = Status.CODE_ERROR
            codes[seen.axis] = code
        return axes, codes

    def _joined(
        self, capture: Capture, axes: list[AxisFrames], codes: dict[str, AxisCode], contradictions: list[str]
    ) -> ProjectorCoordinates:
        """The coordinates along all axes as one result, with the contrast as confidence."""
        contrast = axes[0].contrast
        confidence = contrast.values / np.float32(capture.full_scale)
        return joined_axes(capture, codes, contrast, confidence, self.triangulation, contradictions)

    def axis_frames(self, capture: Capture) -> list[AxisFrames]:
        """The frames of each coded axis of a `StructuredLight` capture, in the order of the sensor's axes."""
        sensor = of_type(capture.sensor, StructuredLight)
        contrast = self.contrast(capture, sensor)
        return [
            AxisFrames(capture, axis, sensor.size(axis), *sensor.coded_frames(capture.frames, axis), contrast)
            for axis in sensor.axes
        ]

    def contrast(self, capture: Capture, sensor: StructuredLight) -> Contrast:
        """Contrast of white and black, each as captured, or estimated by the code if it was not shown."""
        shown, frames = sensor.frame_names(), capture.frames
        if WHITE in shown and BLACK in shown:
            return direct_contrast(capture, frames[shown.index(WHITE)], frames[shown.index(BLACK)], self.gray)
        code = sensor.code
        estimates = [code.white_and_black(sensor.size(a), *sensor.coded_frames(frames, a)) for a in sensor.axes]
        white, black = np.max([w for w, _ in estimates], axis=0), np.min([b for _, b in estimates], axis=0)
        if WHITE in shown:
            white = frames[shown.index(WHITE)]
        if BLACK in shown:
            black = frames[shown.index(BLACK)]
        return direct_contrast(capture, white, black, self.gray)._replace(
            has_white=WHITE in shown, has_black=BLACK in shown
        )

    @property
    def thresholds(self) -> CodeThresholds:
        """Thresholds that the decoders of codes take."""
        return CodeThresholds(self.gray, self.phase)

    def least_signal(self, sensor: Sensor, background: Background) -> np.ndarray:
        shown = of_type(sensor, StructuredLight)
        each = [
            shown.code.least_signal(shown.size(axis), shown.shown_names(axis), self.thresholds, background)
            for axis in shown.axes
        ]
        return np.asarray(np.maximum.reduce(each))

    def depth_error_m(self, sensor: Sensor, light: ReceivedLight) -> np.ndarray | None:
        """The standard deviation of the code's place times the change of the depth with it; None for codes along both
        axes, or without a closed form."""
        shown = of_type(sensor, StructuredLight)
        if len(shown.axes) > 1:
            return None
        (name,) = shown.axes
        place_px = shown.code.place_sigma_px(AXES.index(name), shown.size(name), light)
        per_px = light.per_column if name == "columns" else light.per_row
        return None if place_px is None else place_px * np.abs(per_px)

    def likely_cause(self, capture: Capture, image: RangeImage) -> str | None:
        if image.camera is None and (axis := _another_axis(image)):
            other = "rows" if axis == "columns" else "columns"
            along = "height" if axis == "columns" else "width"
            return (
                f"{axis} change along the image's {along}: {other} may have been shown, or the camera was turned by 90 "
                "degrees"
            )
        sensor = of_type(capture.sensor, StructuredLight)
        is_explained = bool(image.doubts) if image.camera is None else not image.doubts  # a calibration tells more
        if not sensor.code.tells_direction and not is_explained:
            size = (sensor.projector_width, sensor.projector_height)
            if doubt := fringe_doubt(image.projector_column, image.projector_row, size):
                return doubt
        if float(image.valid.mean()) >= MIN_MEASURED:
            return None
        if axis := _axis_along_baseline(image, sensor.axes, capture.rig):
            other = "rows" if axis == "columns" else "columns"
            return f"{axis} tell no depth here, because camera and projector stand apart along them: code {other}"
        return None


def _exchanged_ends(capture: Capture, contrast: Contrast) -> str | None:
    """A sentence if black is brighter than white at most of the pixels where they differ; None if not."""
    clear = MIN_CONTRAST * capture.full_scale
    inverted = float((contrast.values < -clear).mean())
    if not contrast.is_measured or inverted <= float((contrast.values > clear).mean()):
        return None
    return (
        f"black is brighter than white at {100 * inverted:.0f} % of the pixels: the images of white and black seem to "
        "be exchanged."
    )


def _repeated_frames(capture: Capture) -> str | None:
    """A sentence if two frames of a digital capture are the same image, but their patterns are not; None if not."""
    if not capture.is_digital or capture.frames[0].size < MIN_PIXELS:
        return None
    sensor = of_type(capture.sensor, StructuredLight)
    names = sensor.frame_names()
    pairs = ((names[i], names[j]) for i, j in equal_frames(capture.frames))
    return next((same_images(one, other) for one, other in pairs if not sensor.shows_the_same(one, other)), None)


def _corrections(codes: dict[str, AxisCode]) -> Iterator[str]:
    """Sentences on what was corrected in the codes of all axes."""
    gammas = {axis: f"{code.gamma:.3g}" for axis, code in codes.items() if code.gamma != 1}
    if gammas:
        yield (
            f"the fringes along {' and '.join(gammas)} were corrected for a gamma of "
            f"{' and '.join(dict.fromkeys(gammas.values()))} of projector and camera together."
        )


def _orientation(codes: dict[str, AxisCode]) -> str | None:
    """A sentence if the codes of both axes are those of a mirrored image; None if not."""
    if len(codes) < 2:
        return None
    ok = _first_failure([code.status for code in codes.values()]) == Status.OK
    column, row = (np.where(ok, codes[axis].coordinate, np.float32(np.nan)) for axis in AXES)
    return orientation_contradiction(column, row, None)


def _beyond_projector(sensor: StructuredLight, codes: dict[str, AxisCode]) -> str | None:
    """A sentence if many pixels have a code beyond the last pixel of the projector; None if not."""
    for axis, code in codes.items():
        size, is_error = sensor.size(axis), code.status == Status.CODE_ERROR
        beyond = is_error & (code.coordinate > size + max(0.5, code.cell_px / 2))  # the last cell may stand out
        n, read = np.count_nonzero(beyond), np.count_nonzero(is_error | (code.status == Status.OK))
        if read >= MIN_PIXELS and n > MAX_BEYOND_FRACTION * read:
            furthest = float(np.percentile(code.coordinate[beyond], 99))
            return (
                f"{100 * n / read:.0f} % of the codes along {axis} lie beyond the projector's {size} pixels, up to "
                f"{furthest:.0f}: check the size of the projector, the order of the frames and their code."
            )
    return None


@lru_cache(maxsize=256)  # each look-up of a sensor by name asks for all presets
def _with_defaults(cls: type[StructuredLight], kind: type[Code]) -> StructuredLight:
    """A sensor of that class whose code is of that kind, all with default settings."""
    return cls(code=kind())


def checked(capture: Capture, contrast: Contrast, contradictions: list[str]) -> list[str]:
    """The contradictions of a capture; if there is none, whether its black frame is brighter than white.

    It issues a `DoubtWarning` of each.
    """
    if not contradictions and (exchanged := _exchanged_ends(capture, contrast)):  # a wrong order has other signs, too
        contradictions = [exchanged]
    for contradiction in contradictions:
        warn(contradiction, DoubtWarning)
    return contradictions


def joined_axes(
    capture: Capture,
    codes: dict[str, AxisCode],
    contrast: Contrast,
    confidence: np.ndarray,
    triangulation: TriangulationLimits,
    contradictions: list[str],
) -> ProjectorCoordinates:
    """The coordinates along all axes as one result.

    Parameters
    ----------
    codes : AxisCode by the name of its axis. contrast : Contrast of the capture. confidence : (h, w) float32.
    contradictions : those of `checked`.
    """
    coordinate = {axis: code.coordinate for axis, code in codes.items()}
    sigma_px = {axis: code.sigma_px for axis, code in codes.items()}
    return ProjectorCoordinates(
        column=coordinate.get("columns"),
        row=coordinate.get("rows"),
        column_sigma_px=sigma_px.get("columns"),
        row_sigma_px=sigma_px.get("rows"),
        status=_first_failure([codes[axis].status for axis in AXES if axis in codes]),
        confidence=confidence,
        intensity=contrast.white.astype(np.float32) - np.float32(capture.black_level),
        limits=triangulation,
        doubts=tuple(contradictions),
        notes=tuple(_corrections(codes)),
    )


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


def _another_axis(image: RangeImage) -> str | None:
    """The only coded axis, if it changes along the image as the other axis does for an upright camera; else None."""
    column, row = image.projector_column, image.projector_row
    if column is not None and row is None and changes_along(column) == "height":
        return "columns"
    return "rows" if row is not None and column is None and changes_along(row) == "width" else None
