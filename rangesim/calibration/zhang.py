# SPDX-License-Identifier: Apache-2.0
"""A camera calibrated by views of a plane: homographies, the image of the absolute conic, then everything at once.

Z. Zhang: "A flexible new technique for camera calibration", PAMI 2000. Each view of a plane maps the plane's circular
points to two points of the image of the absolute conic, omega = K^-T K^-1: two linear equations for its 4 degrees of
freedom without skew, so two views determine it; 5 with skew, so three do. Where they do not (boards that are parallel
to each other, or all straight in front), that is an error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from rangesim.calibration.boards import Board, BoardView
from rangesim.calibration.bundle import Bundle, Observation, adjust
from rangesim.calibration.suspects import Suspect, suspects_told
from rangesim.errors import warn
from rangesim.geometry.camera_pose import fit_camera_pose
from rangesim.geometry.correspondences import Array, checked_array, unit_norm
from rangesim.geometry.homography import fit_homography
from rangesim.geometry.least_squares import Minimum
from rangesim.geometry.reprojection import LENS, POSE, by_lens
from rangesim.rig import Intrinsics

MIN_VIEWS = 2
"""Least number of views for a camera without skew; with skew it is one more (Zhang 2000, section 3.1)."""
DETERMINED = 1e-4
"""The second smallest singular value of the equations of the conic, relative to the largest, below which their views
are parallel to each other, to what noise allows to tell."""
MIN_APART_DEG = 1.0
"""Largest angle between two boards below which all count as parallel. Parallel ones are found within 0.1 degrees, ones
turned at random by up to 5 degrees 4.8 degrees apart or more (measured, noise of 0.05 px)."""
FEW_VIEWS = 5
"""Number of views up to which more than one start is tried: with 3 views at 10 degrees, 1 of 40
ended in a side minimum."""
SAME_MINIMUM = 0.999
"""Ratio of sums of squares of two minima from which on they are one."""
MAX_DEVIATION = 0.1
"""Standard deviation of a focal length, relative, above which the views do not determine it."""
MAX_CORNER_PX = 5.0
"""Standard deviation of where a ray meets a corner of the image, above which the lens counts as unknown there."""
AGAIN = 2
"""Adjustments after the first, for boards whose points look as if they were elsewhere."""
BORDER_POINTS = 9
"""Along each side of an image, whose rays must exist."""


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """A camera, how well it is known, and where the boards were.

    camera : Intrinsics, with five coefficients of distortion. deviations : (9,) standard deviations of fx, fy, cx, cy
    in pixels and of k1, k2, p1, p2, k3; 0 for those held. T_camera_board : (k, 4, 4) maps the board's coordinates to
    the camera's, metres. residuals : k arrays (m, 2), pixels, projected less seen. noise_px : standard deviation of a
    coordinate, from the residuals. rms_px : root mean square of the reprojection errors, over points. suspects : points
    whose error is beyond all noise, the worst first; they weigh on the result.
    """

    camera: Intrinsics
    deviations: Array
    T_camera_board: Array
    residuals: tuple[Array, ...]
    noise_px: float
    rms_px: float
    suspects: tuple[Suspect, ...] = ()


def intrinsics_from_homographies(homographies: ArrayLike, *, has_skew: bool = False) -> Array:
    """(3, 3) K of a camera from homographies (k, 3, 3) that map a plane's coordinates to pixels (Zhang 2000, 3.1).

    With columns h1, h2 of each: h1^T omega h2 = 0 and h1^T omega h1 = h2^T omega h2, linear in the six entries of the
    symmetric omega, up to scale; then omega = K^-T K^-1 by Cholesky. K33 = 1.

    Parameters
    ----------
    has_skew : whether K12 is free, which takes a third view. False: it is 0, and so is omega12; of a camera that has
        skew all the rest is then wrong.

    Raises
    ------
    ValueError
        Fewer than two homographies, three with skew; views that are parallel to each other; or homographies
        of no camera (omega is not positive definite).
    """
    H = checked_array("homographies", homographies, 3, 3)
    freedom, least = (5, MIN_VIEWS + 1) if has_skew else (4, MIN_VIEWS)
    if H.ndim != 3 or len(H) < least:
        n = len(H) if H.ndim == 3 else 1
        raise ValueError(
            f"expected at least {least} views of the plane, got {n}: each gives two equations for the {freedom} "
            "degrees of freedom of the absolute conic's image."
        )
    # pixels about their middle and of size 1, planes of size 1: the equations are then of one size
    corners = H[:, :2, 2] / H[:, 2:, 2]
    middle = corners.mean(axis=0)
    size = max(float(np.abs(corners - middle).max()), 1e-3 * float(np.abs(middle).max()), 1.0)
    to_unit = np.array([[1 / size, 0, -middle[0] / size], [0, 1 / size, -middle[1] / size], [0, 0, 1.0]])
    unit = unit_norm(to_unit @ H)
    scale = np.linalg.norm(unit[:, :, :2], axis=(1, 2), keepdims=True)
    first, second = ((unit[:, :, :2] / scale)[:, :, k] for k in (0, 1))
    rows = np.concatenate([_conic_row(first, second), _conic_row(first, first) - _conic_row(second, second)])
    if not has_skew:
        rows = np.delete(rows, 1, axis=1)
    _, values, axes = np.linalg.svd(rows)
    if not values[freedom - 1] > DETERMINED * values[0]:
        raise ValueError(
            f"expected views of the plane under different tilts, got {len(H)} that are nearly parallel to each other: "
            "they do not determine the camera; tilt the board."
        )
    a, b, c, d, e, f = axes[5] if has_skew else np.insert(axes[4], 1, 0.0)
    omega = np.array([[a, b, d], [b, c, e], [d, e, f]])
    omega = omega if omega[0, 0] > 0 else -omega
    if np.linalg.eigvalsh(omega)[0] <= 0:
        raise _NoCamera(
            "expected homographies of one camera, got some whose absolute conic is not one (not positive definite): "
            "wrong points, much distortion, or views that differ too little."
        )
    K = np.linalg.inv(np.linalg.cholesky(omega).T)
    K = np.linalg.inv(to_unit) @ (K / K[2, 2])
    return np.asarray(K / K[2, 2])


class _NoCamera(ValueError):
    """The equations of the conic have a solution, which no camera has."""


def _starting_intrinsics(homographies: ArrayLike, width: int, height: int) -> list[Intrinsics]:
    """Cameras that the bundle adjustment starts from: that of the homographies, unless noise or distortion leaves none.

    With few views also the one with the principal point in the middle of the image, as noise moves that of the
    homographies far away.
    """
    H = np.asarray(homographies, dtype=np.float64)
    matrices, none = [], None
    try:
        matrices.append(intrinsics_from_homographies(H))
    except _NoCamera as error:
        none = error
    if none is not None or len(H) <= FEW_VIEWS:
        to_middle = np.array([[1.0, 0, -width / 2], [0, 1.0, -height / 2], [0, 0, 1.0]])
        centred = to_middle @ H
        centred = centred / np.linalg.norm(centred[:, :, :2], axis=(1, 2), keepdims=True)
        first, second = centred[:, :, 0], centred[:, :, 1]
        rows = np.concatenate([_conic_row(first, second), _conic_row(first, first) - _conic_row(second, second)])
        # omega = diag(1 / fx^2, 1 / fy^2, 1)
        inverse_squares = np.linalg.lstsq(rows[:, [0, 2]], -rows[:, 5], rcond=None)[0]
        if (inverse_squares > 0).all():
            fx, fy = 1 / np.sqrt(inverse_squares)
            matrices.append(np.array([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1.0]]))
    if none is not None and not matrices:
        raise none
    return [Intrinsics(width, height, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])) for K in matrices]


def calibrate_camera(
    board: Board,
    views: Sequence[BoardView],
    width: int,
    height: int,
    *,
    coefficients: int = 5,
    names: Sequence[str] | None = None,
) -> CameraCalibration:
    """A camera from views of a board: `intrinsics_from_homographies`, then all parameters by `bundle.adjust`.

    Parameters
    ----------
    views : of `board.find`, two or more, under different tilts, ten to twenty all over the image for a good one.
    width, height : of the images, pixels.
    coefficients : of distortion that are free, of k1, k2, p1, p2, k3 in this order; 0 for a pinhole.
    names : of the views, for messages; None: their numbers.

    Warns of points that do not fit (`suspects`), of distortion that too few coefficients leave out, and of a lens that
    is unknown in a corner of the image, or folds there.

    Raises
    ------
    ValueError
        Fewer than two views, one view twice, points outside the image, or views that do not determine the camera.
    """
    names = [f"view {k}" for k in range(len(views))] if names is None else [str(name) for name in names]
    if len(names) != len(views):
        raise ValueError(f"expected a name for each of the {len(views)} views, got {len(names)}.")
    found, observations, noise, deviations = _calibrated(board, views, width, height, coefficients, names)
    suspects = suspects_told(found, observations, views, coefficients, names)
    residuals = tuple(found.state.project(seen) - seen.pixels for seen in observations)
    everywhere = np.concatenate(residuals)
    lens = np.zeros(LENS)
    lens[: 4 + coefficients] = deviations[: 4 + coefficients]
    return CameraCalibration(
        found.state.devices[0],
        lens,
        found.state.T_first_board,
        residuals,
        noise,
        float(np.sqrt((everywhere**2).sum(axis=1).mean())),
        suspects,
    )


def first_camera(
    board: Board, views: Sequence[BoardView], width: int, height: int, coefficients: int, names: Sequence[str]
) -> tuple[Intrinsics, Array, float]:
    """Camera, poses (k, 4, 4) of the boards and noise of a coordinate, to start a bundle of several devices from."""
    found, _, noise, _ = _calibrated(board, views, width, height, coefficients, names, says=False)
    return found.state.devices[0], found.state.T_first_board, noise


def _calibrated(
    board: Board,
    views: Sequence[BoardView],
    width: int,
    height: int,
    coefficients: int,
    names: Sequence[str],
    says: bool = True,
) -> tuple[Minimum[Bundle], list[Observation], float, Array]:
    """The bundle of one camera, what it rests on, its noise and deviations."""
    check_views(board, views, coefficients, names)
    homographies = []
    for k, view in enumerate(views):
        try:
            plane = fit_homography(board.points[view.indices, :2], view.pixels, noisy="second")
        except ValueError as error:
            raise ValueError(f"{names[k]}: {error}") from error
        if not ((view.pixels >= 0) & (view.pixels <= [width, height])).all():
            raise ValueError(
                f"{names[k]}: expected points in an image of {width} x {height} pixels, got some outside; is it of "
                "another size?"
            )
        homographies.append(plane.matrix)
    starts = _starting_intrinsics(homographies, width, height)
    observations = [Observation(0, k, board.points[view.indices], view.pixels) for k, view in enumerate(views)]
    adjusted = []
    for start in starts:
        bundle = Bundle((start,), np.eye(4), board_poses(start, observations))
        adjusted.append(adjust_as_seen(board, bundle, observations, views, coefficients))
    found, observations = adjusted[0]
    for other in adjusted[1:]:
        if other[0].cost < SAME_MINIMUM * found.cost:
            found, observations = other
    _refuse_parallel(found.state.T_first_board)
    noise, deviations = judged(found, observations, says)
    return found, observations, noise, deviations


def _refuse_parallel(T_camera_board: Array) -> None:
    """Raise ValueError if all boards are parallel, whose views give the same two equations, up to distortion."""
    normals = T_camera_board[:, :3, 2]
    apart = np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1.0, 1.0)))
    if apart < MIN_APART_DEG:
        raise ValueError(
            f"expected views of the plane under different tilts, got {len(normals)} whose boards are within "
            f"{apart:.2g} degrees of parallel: they do not determine the camera; tilt the board."
        )


def adjust_as_seen(
    board: Board, start: Bundle, observations: Sequence[Observation], views: Sequence[BoardView], coefficients: int
) -> tuple[Minimum[Bundle], list[Observation]]:
    """`bundle.adjust`; and again with the places that the camera takes for the board's points, once it is known.

    A second device is told what the first one sees, so it sees the same places.

    Parameters
    ----------
    views : the points of each observation.
    """
    found, taken = adjust(start, observations, coefficients), list(observations)
    for _ in range(AGAIN):
        camera = found.state.devices[0]
        seen = [board.seen_points(camera, T) for T in found.state.T_first_board]
        if all(np.array_equal(points, board.points) for points in seen):
            break
        shift = [np.nan_to_num(points - board.points) for points in seen]
        taken = [
            replace(o, points=o.points + shift[o.view][view.indices])
            for o, view in zip(observations, views, strict=True)
        ]
        found = adjust(found.state, taken, coefficients)
    return found, taken


def check_views(board: Board, views: Sequence[BoardView], coefficients: int, names: Sequence[str]) -> None:
    """Raise ValueError unless there are enough views of this board, and a number of coefficients from 0 to 5."""
    if len(views) < MIN_VIEWS:
        raise ValueError(
            f"expected at least {MIN_VIEWS} views of the board, got {len(views)}: each gives two equations for the 4 "
            "degrees of freedom of the absolute conic's image."
        )
    n_points = board.columns * board.rows
    for k, view in enumerate(views):
        if len(view.indices) and not 0 <= view.indices.min() <= view.indices.max() < n_points:
            raise ValueError(
                f"{names[k]}: expected indices of the board's {n_points} points, got {view.indices.min()} to "
                f"{view.indices.max()}; is it a view of another board?"
            )
        for other in range(k):
            if np.array_equal(views[other].pixels, view.pixels) and np.array_equal(views[other].indices, view.indices):
                raise ValueError(f"{names[k]}: expected another pose of the board, got {names[other]} once more.")
    if coefficients not in range(6):
        raise ValueError(f"expected 0 to 5 coefficients of distortion, got {coefficients!r}.")


def board_poses(camera: Intrinsics, observations: Sequence[Observation]) -> Array:
    """(k, 4, 4) poses of the boards of a camera that is roughly known."""
    return np.stack([fit_camera_pose(seen.points, seen.pixels, camera).T_camera_object for seen in observations])


def judged(found: Minimum[Bundle], observations: Sequence[Observation], says: bool = True) -> tuple[float, Array]:
    """Noise of a coordinate, pixels, and standard deviations of the parameters.

    says : warns of lenses that are unknown in a corner of their image.

    Raises
    ------
    ValueError
        There are fewer observations than parameters, or they leave a focal length open.
    """
    parameters = found.jacobian.shape[1]
    if len(found.residuals) <= parameters:
        raise ValueError(
            f"expected more coordinates than the {parameters} parameters, got {len(found.residuals)}; add views or "
            "points, or free fewer coefficients."
        )
    noise = found.noise(parameters)
    covariance = found.covariance(max(noise, 1e-12))
    deviations = np.sqrt(np.diag(covariance))
    n_devices, n_views = len(found.state.devices), len(found.state.T_first_board)
    lens = (parameters - POSE * (n_views + n_devices - 1)) // n_devices
    for k, device in enumerate(found.state.devices):
        relative = float((deviations[k * lens : k * lens + 2] / [device.fx, device.fy]).max())
        if not relative <= MAX_DEVIATION:
            raise ValueError(
                "expected views that determine the focal length, got some that leave it open (standard deviation "
                f"{100 * relative:.3g} %): tilt the board more, in different directions."
            )
        part = slice(k * lens, (k + 1) * lens)
        _check_corners(device, covariance[part, part], NAMES[k] if n_devices > 1 else "lens", says)
    return noise, deviations


NAMES = ("camera", "projector")


def _check_corners(device: Intrinsics, covariance: Array, name: str, says: bool) -> None:
    """Warn if a lens folds within its image, or is unknown in a corner of it."""
    s = np.linspace(0, 1, BORDER_POINTS)
    zero, one = np.zeros_like(s), np.ones_like(s)
    sides = [np.stack(side, axis=-1) for side in ((s, zero), (s, one), (zero, s), (one, s))]
    rays = device.directions(np.concatenate(sides) * [device.width, device.height])
    if not np.isfinite(rays).all():
        if says:
            warn(
                f"the distortion found of the {name} folds within its image, which has no rays there: it is unknown "
                "where no board was; show boards up to the corners of the image, or free fewer coefficients."
            )
        return
    corners = device.directions(np.array([[0, 0], [1, 0], [0, 1], [1, 1.0]]) * [device.width, device.height])
    J = by_lens(device, corners)[:, :, : len(covariance)]
    off = float(np.sqrt(np.linalg.eigvalsh(J @ covariance @ np.swapaxes(J, 1, 2))[:, -1].max()))
    if says and off > MAX_CORNER_PX:
        warn(
            f"the {name} is known to {off:.3g} px only in a corner of its image: show boards there, or free fewer "
            "coefficients."
        )


def _conic_row(a: Array, b: Array) -> Array:
    """(k, 6) coefficients of a^T omega b in the entries 11, 12, 22, 13, 23, 33 of omega."""
    return np.stack(
        [
            a[:, 0] * b[:, 0],
            a[:, 0] * b[:, 1] + a[:, 1] * b[:, 0],
            a[:, 1] * b[:, 1],
            a[:, 0] * b[:, 2] + a[:, 2] * b[:, 0],
            a[:, 1] * b[:, 2] + a[:, 2] * b[:, 1],
            a[:, 2] * b[:, 2],
        ],
        axis=-1,
    )
