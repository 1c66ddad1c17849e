# SPDX-License-Identifier: Apache-2.0
"""Projector coordinates to ranges, and which of the readings are within the working range."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from rangesim.decoding.coordinates import Coordinates
from rangesim.decoding.orientation import orientation_contradiction
from rangesim.decoding.pixel_samples import MIN_PIXELS
from rangesim.decoding.range_image import RangeImage
from rangesim.decoding.row_bands import bands
from rangesim.decoding.status import Status
from rangesim.errors import DoubtWarning, warn
from rangesim.geometry.camera_projector import triangulate_coordinates
from rangesim.rig import Rig
from rangesim.settings.bounds import Bounds, check_fields

COORDINATE_ERROR_PX = 0.5
"""Error of a projector coordinate, in projector pixels, that the working range must allow for: half a pixel, the
largest error of a sound Gray code, which decodes to whole pixels. Phase shift is finer."""

MAX_BEHIND_FRACTION = 0.2
"""Largest fraction of the decoded pixels whose rays may meet clearly behind a device before the capture is doubted,
because interreflection makes only a few rays do so, but a mirrored image or an inverted calibration most of them."""

MIN_IN_FRONT_FRACTION = 0.8
"""Least fraction of the decoded pixels that must fit the inverse of the calibration's pose, for the pose to count as
inverted. The right pose fits all but stray light."""

MAX_FITTING_FRACTION = 0.7
"""Largest fraction of the decoded pixels that may fit the pose as given, if it is inverted. Of devices that are turned
to each other by 9 degrees, a third to a half fit the inverted pose by chance."""

MAX_OFF_LINE_FRACTION = 0.3
"""Largest fraction of the decoded pixels that may miss their epipolar line. Interreflection and noise move a tenth off
at most; a calibration of another rig, or one that has changed, moves most of them."""

MAX_BESIDE_FRACTION = 0.2
"""Largest fraction of the decoded points that may lie beside the projector's image, where it shines no light. In real
captures, none do; with wrong calibrations of the same captures, 40 to 80 %."""

MAX_BESIDE = 0.05
"""Distance from the projector's image, as a fraction of its size, up to which a point may still lie in it: errors of
the calibration and of the lens model are smaller."""

MAX_TRIED = 5000
"""Largest number of pixels on which a pose is tried. They tell a fraction to 0.7 %."""

MIN_BEHIND_PX = 10.0
"""Least distance, in projector pixels, of a coordinate from the one that would make the rays parallel, at which they
meet clearly behind a device. With less, the point may be far away in front, and noise has moved it behind."""


@dataclass(frozen=True)
class TriangulationLimits:
    """Limits beyond which triangulated pixels are refused.

    Parameters
    ----------
    epipolar_tolerance_px : float, projector pixels; where both axes are coded, pixels whose column and row miss the
        epipolar line by more get `CODE_ERROR`.
    max_relative_error : float, the working range: pixels where half a projector pixel of error would shift the depth by
        a larger fraction get `OUT_OF_RANGE`. With parallel axes z may be at most 2 f b max_relative_error, where f is
        the projector's focal length in pixels and b the baseline. Light planes along the baseline measure nothing.

    Examples
    --------
    >>> TriangulationLimits(max_relative_error=0.01)  # five times as strict as the default
    TriangulationLimits(epipolar_tolerance_px=5.0, max_relative_error=0.01)
    """

    epipolar_tolerance_px: Annotated[float, Bounds("0 or positive", 0, 1e9)] = 5.0
    max_relative_error: Annotated[float, Bounds("0 or positive", 0, 1e9)] = 0.05

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class ProjectorCoordinates(Coordinates):
    """Projector pixel coordinates that the camera's pixels see, with pixel centres at integer + 0.5.

    Parameters
    ----------
    column, row : (h, w) float32, projector pixels; NaN where `status` is not OK; None for an axis that is not coded.
    column_sigma_px, row_sigma_px : (h, w) float32, projector pixels, standard deviations of `column` and `row`; NaN
        where `status` is not OK. None: not known, as for fringes of an unknown detector.
    limits : TriangulationLimits that `range_image` applies.
    doubts : sentences with which the decoder has warned that the capture contradicts its code. If there are any, the
        cause of rays that meet behind a device is known, and `range_image` does not warn of them.
    notes : sentences on what the decoder found in the capture and has corrected.
    is_checked : whether `range_image` looks for contradictions between coordinates and rig.

    Examples
    --------
    >>> import numpy as np
    >>> one = np.ones((1, 2))
    >>> seen = ProjectorCoordinates(
    ...     column=np.array([[10.5, 11.5]]), row=None, status=np.array([[0, 3]]), confidence=one, intensity=one
    ... )
    >>> seen.column
    array([[10.5,  nan]], dtype=float32)
    >>> seen.range_image(None).status  # without a rig, that of the code
    array([[0, 3]], dtype=uint8)
    """

    column: np.ndarray | None
    row: np.ndarray | None
    column_sigma_px: np.ndarray | None = None
    row_sigma_px: np.ndarray | None = None
    limits: TriangulationLimits = field(default_factory=TriangulationLimits)
    doubts: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    is_checked: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("column", "row", "column_sigma_px", "row_sigma_px"):
            self._keep_valid(name, np.float32)

    def range_image(self, rig: Rig | None) -> RangeImage:
        """Range image of these coordinates, triangulated.

        It warns (`DoubtWarning`) if the map from camera to projector pixels contradicts what is known: if the images
        seem to be mirrored or turned, the pose inverted, or if many rays meet behind a device. It does not if there are
        `doubts` already, or if the coordinates are not to be checked (`is_checked`).

        Parameters
        ----------
        rig : Rig that took the capture; None: z is NaN everywhere, and `status` is that of the code.
        """
        column, row, status, decoded = self.column, self.row, self.status.copy(), self.valid
        z = np.full(status.shape, np.nan, dtype=np.float32)
        range_m = z.copy()
        is_silent = bool(self.doubts) or not self.is_checked
        doubt = None if is_silent else orientation_contradiction(column, row, rig)
        if rig is not None:
            behind_px = []
            for rows in bands(len(status)):
                y, x = np.nonzero(decoded[rows])
                directions = rig.pinhole.directions(np.stack([x + 0.5, y + rows.start + 0.5], axis=-1))
                found = triangulate_coordinates(
                    directions,
                    rig,
                    None if column is None else column[rows][y, x],
                    None if row is None else row[rows][y, x],
                )
                behind_px.append(found.behind_px.astype(np.float32))
                outcome = np.zeros(len(directions), dtype=np.uint8)
                usable = found.relative_error * COORDINATE_ERROR_PX <= self.limits.max_relative_error
                outcome[~(np.isfinite(found.z) & usable)] = Status.OUT_OF_RANGE
                outcome[found.epipolar_px > self.limits.epipolar_tolerance_px] = Status.CODE_ERROR
                depth = np.where(outcome == Status.OK, found.z, np.nan)
                status[rows][y, x], z[rows][y, x] = outcome, depth
                range_m[rows][y, x] = depth * np.linalg.norm(directions, axis=-1)
            if not (is_silent or doubt):
                doubt = (
                    self._pose_contradiction(rig)
                    or behind_contradiction(np.concatenate(behind_px))
                    or self._line_contradiction(status)
                )
        if doubt:
            warn(doubt, DoubtWarning)
        image = self._image(rig, z, range_m, status)
        doubts = (*self.doubts, doubt) if doubt else self.doubts
        return replace(image, projector_column=column, projector_row=row, doubts=doubts, notes=self.notes)

    def _line_contradiction(self, status: np.ndarray) -> str | None:
        """A sentence if many decoded pixels miss their epipolar line; None if not.

        Parameters
        ----------
        status : (h, w) uint8, that of the range image.
        """
        n = np.count_nonzero(self.valid)
        off = np.count_nonzero(self.valid & (status == Status.CODE_ERROR))
        if n < MIN_PIXELS or off <= MAX_OFF_LINE_FRACTION * n:
            return None
        if self.limits.epipolar_tolerance_px < COORDINATE_ERROR_PX:
            return None  # sound codes miss it, too
        return (
            f"{100 * off / n:.0f} % of the decoded pixels miss their epipolar line by more than "
            f"{self.limits.epipolar_tolerance_px:g} projector pixels, so the depth of the others is doubtful: check "
            "the calibration, its code step, and that camera and projector have not moved since."
        )

    def _pose_contradiction(self, rig: Rig) -> str | None:
        """A sentence if the decoded pixels do not fit T_camera_projector, and fit its inverse or lie beside the
        projector's image; None if not.

        They fit if their rays meet in front of both devices and within the epipolar tolerance, or, if one axis is
        coded, at points that the projector's image covers.
        """
        y, x = np.nonzero(self.valid)
        few = slice(None, None, 1 + len(y) // MAX_TRIED)
        y, x = y[few], x[few]
        if len(y) < MIN_PIXELS:
            return None
        directions = rig.pinhole.directions(np.stack([x + 0.5, y + 0.5], axis=-1))
        column, row = (None if c is None else c[y, x] for c in (self.column, self.row))
        fractions, beside = [], []
        for pose in (rig.T_camera_projector, np.linalg.inv(rig.T_camera_projector)):
            posed = replace(rig, T_camera_projector=pose)
            found = triangulate_coordinates(directions, posed, column, row)
            is_point = np.isfinite(found.z) & (found.epipolar_px <= self.limits.epipolar_tolerance_px)
            is_lit = _in_projector(posed, directions * found.z[:, None], column is None, row is None)
            fractions.append(float((is_point & is_lit).mean()))
            beside.append(float((is_point & ~is_lit).mean()))
            if fractions[0] > MAX_FITTING_FRACTION and beside[0] <= MAX_BESIDE_FRACTION:
                return None
        before, after = fractions
        if before <= MAX_FITTING_FRACTION and after >= MIN_IN_FRONT_FRACTION:
            return (
                f"{100 * before:.0f} % of the decoded pixels fit T_camera_projector as given, and "
                f"{100 * after:.0f} % its inverse: the calibration's pose seems to be inverted, that of the camera in "
                "the projector's frame."
            )
        if beside[0] <= MAX_BESIDE_FRACTION:
            return None
        return (
            f"{100 * beside[0]:.0f} % of the decoded points lie beside the projector's image, where it shines no "
            "light: check the calibration, that camera and projector are not exchanged in it, and that it was made at "
            "the size of these images."
        )


def _in_projector(rig: Rig, points: np.ndarray, has_no_column: bool, has_no_row: bool) -> np.ndarray:
    """(n,) bool, whether points (n, 3) in camera coordinates lie within the projector's image along an uncoded axis."""
    pose = rig.T_camera_projector
    with np.errstate(invalid="ignore", divide="ignore"):
        places = rig.image_projector.project((points - pose[:3, 3]) @ pose[:3, :3])
    result = np.ones(len(points), dtype=bool)
    for axis, size in ((0, rig.projector.width), (1, rig.projector.height)):
        if (has_no_column, has_no_row)[axis]:
            result &= np.abs(places[:, axis] / size - 0.5) <= 0.5 + MAX_BESIDE
    return result


def behind_contradiction(behind_px: np.ndarray) -> str | None:
    """A sentence if many rays meet behind camera or projector; None if not.

    Parameters
    ----------
    behind_px : (n,) float, projector pixels, as `ProjectorTriangulation` has it.

    Examples
    --------
    >>> import numpy as np
    >>> behind_contradiction(np.zeros(1000)) is None
    True
    >>> behind_contradiction(np.full(1000, 50.0))[:54]
    '100 % of the decoded rays meet behind camera or projec'
    """
    fraction = float((behind_px > MIN_BEHIND_PX).mean()) if len(behind_px) >= MIN_PIXELS else 0.0
    if fraction <= MAX_BEHIND_FRACTION:
        return None
    return (
        f"{100 * fraction:.0f} % of the decoded rays meet behind camera or projector, where nothing is, so the depth "
        "of the others is doubtful: check that no image is mirrored, that T_camera_projector is not inverted, and "
        "that the axes and their order are those that the projector showed."
    )
