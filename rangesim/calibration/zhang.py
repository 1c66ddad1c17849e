# SPDX-License-Identifier: Apache-2.0
"""Calibration of a camera by views of a plane: homographies, the image of the absolute conic, then bundle adjustment.

Z. Zhang: "A flexible new technique for camera calibration", PAMI 2000. A view of a plane maps the two circular points
of the plane to points of the image of the absolute conic, omega = K^-T K^-1. This gives two linear equations. Without
skew, omega has 4 degrees of freedom, so that two views determine it; with skew it has 5 and needs three views. Boards
that are parallel to each other, or all straight in front of the camera, do not determine omega and raise an error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from rangesim.calibration.boards import Board, BoardView
from rangesim.calibration.bundle import Bundle, Observation, adjust
from rangesim.calibration.suspects import DEVICES, Suspect, suspects_told
from rangesim.errors import warn
from rangesim.geometry.camera_pose import fit_camera_pose
from rangesim.geometry.correspondences import Array, checked_array, unit_norm
from rangesim.geometry.homography import fit_homography
from rangesim.geometry.least_squares import Minimum
from rangesim.geometry.reprojection import LENS, POSE, by_lens
from rangesim.rig import Intrinsics

MIN_VIEWS = 2
"""Smallest number of views for a camera without skew, a count: each view gives two equations for 4 unknowns. With skew,
one more view is needed (Zhang 2000, section 3.1)."""
MIN_CONIC_RATIO = 1e-4
"""Smallest ratio of the second smallest singular value of the conic's equations to the largest. Below it, the views
allow a second solution, because the boards are parallel to each other within the noise."""
MIN_APART_DEG = 1.0
"""Smallest value of the largest angle between two boards, degrees; below it all boards count as parallel. Measured with
a noise of 0.05 px: for parallel boards, the largest angle found is within 0.1 degrees; for boards turned at random by
up to 5 degrees, it is 4.8 degrees or more."""
MAX_CENTRED_VIEWS = 5
"""Largest number of views for which a second start, with the principal point in the middle of the image, is tried.
Measured with 3 views tilted by 10 degrees: with one start, 1 of 40 sets ended in a wrong minimum."""
SAME_COST_RATIO = 0.999
"""Ratio of the sums of squares of two minima, above which they count as the same minimum and the first one is taken. It
is not 1, because a descent ends just before its minimum."""
MAX_FOCAL_DEVIATION = 0.1
"""Largest relative standard deviation of a focal length. Above 10 % the views count as not determining it."""
MAX_CORNER_PX = 5.0
"""Largest standard deviation, in pixels, of the pixel of a ray through a corner of the image. Above it, the lens counts
as unknown there, and the result comes with a warning."""
SEEN_POINT_ROUNDS = 2
"""Number of adjustments after the first, a count, for boards whose points are not detected where they are
(`CircleGrid`). Each one uses the positions that the camera of the adjustment before it would detect. Measured with 8
views of 7 x 5 discs without noise: fx is off by 0.28 px without them, by 3e-4 px after one and by 1.5e-5 px after
two."""
BORDER_POINTS = 9
"""Number of points along each side of an image, at which a ray through the lens must exist. More points find shorter
parts without a ray. The corners, which are farthest from the centre, are always among them."""


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """A calibrated camera with its standard deviations, and the poses of the boards.

    camera : Intrinsics, with five coefficients of distortion.
    deviations : (9,) float64, standard deviations of fx, fy, cx, cy (pixels), k1, k2, p1, p2, k3; 0 for a coefficient
        that is not free.
    T_camera_board : (k, 4, 4) float64, maps the board coordinates of each view to those of the camera, metres.
    residuals : k arrays (m, 2) float64, projected minus seen pixel.
    noise_px : standard deviation of a pixel's coordinate, from the residuals.
    rms_px : root mean square of the reprojection errors of all points, pixels.
    suspects : points whose error is larger than noise explains, the worst first. They took part in the result.

    Examples
    --------
    See `calibrate_camera`.
    """

    camera: Intrinsics
    deviations: Array
    T_camera_board: Array
    residuals: tuple[Array, ...]
    noise_px: float
    rms_px: float
    suspects: tuple[Suspect, ...] = ()


def intrinsics_from_homographies(homographies: ArrayLike, *, has_skew: bool = False) -> Array:
    """(3, 3) float64, the matrix K of a camera, from homographies of views of a plane (Zhang 2000, 3.1).

    The columns h1 and h2 of each homography give h1^T omega h2 = 0 and h1^T omega h1 = h2^T omega h2. These equations
    are linear in the six entries of the symmetric omega, which is known up to scale. Cholesky's decomposition of
    omega = K^-T K^-1 then gives K, with K33 = 1.

    Parameters
    ----------
    homographies : (k, 3, 3), map coordinates on the plane to pixels.
    has_skew : whether K12 is free, which needs a third view. If not, K12 and omega12 are 0; for a camera with skew, all
        other entries are then wrong, too.

    Raises
    ------
    ValueError
        There are fewer than two homographies, or three with skew, or the views are parallel to each other, or omega is
        not positive definite, so that no camera has these homographies.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.rig import look_at
    >>> K = np.array([[600, 0, 320], [0, 610, 240], [0, 0, 1.0]])
    >>> places = [(0.3, 0.1, -0.5), (-0.3, 0, -0.5)]  # two cameras, in coordinates of the plane
    >>> T = [np.linalg.inv(look_at(place, (0, 0, 0), (0, -1, 0))) for place in places]
    >>> found = intrinsics_from_homographies([K @ pose[:3, [0, 1, 3]] for pose in T])
    >>> np.allclose(found, K)
    True
    """
    H = checked_array("homographies", homographies, 3, 3)
    freedom, least = (5, MIN_VIEWS + 1) if has_skew else (4, MIN_VIEWS)
    if H.ndim != 3 or len(H) < least:
        n = len(H) if H.ndim == 3 else 1
        raise ValueError(
            f"expected at least {least} views of the plane, got {n}: each gives two equations for the {freedom} "
            "degrees of freedom of the absolute conic's image."
        )
    # Move the pixels to mean 0 and scale pixels and planes to size 1, so that all equations have the same size.
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
    if not values[freedom - 1] > MIN_CONIC_RATIO * values[0]:
        raise ValueError(
            f"expected views of the plane at different tilts, got {len(H)} that are nearly parallel to each other: "
            "they do not determine the camera; tilt the board."
        )
    a, b, c, d, e, f = axes[5] if has_skew else np.insert(axes[4], 1, 0.0)
    omega = np.array([[a, b, d], [b, c, e], [d, e, f]])
    omega = omega if omega[0, 0] > 0 else -omega
    if np.linalg.eigvalsh(omega)[0] <= 0:
        raise _NoCamera(
            "expected homographies of one camera, got homographies of none (the image of the absolute conic is not "
            "positive definite): points are wrong, the distortion is large, or the views differ too little."
        )
    K = np.linalg.inv(np.linalg.cholesky(omega).T)
    K = np.linalg.inv(to_unit) @ (K / K[2, 2])
    return np.asarray(K / K[2, 2])


class _NoCamera(ValueError):
    """Error for equations of the conic whose solution belongs to no camera."""


def _starting_intrinsics(homographies: ArrayLike, width: int, height: int) -> list[Intrinsics]:
    """The cameras from which the bundle adjustment starts.

    The first is the camera of the homographies, unless noise or distortion leaves none. If there is none, or there are
    few views, another one has its principal point in the middle of the image, because with few views noise moves the
    principal point of the homographies far away.
    """
    H = np.asarray(homographies, dtype=np.float64)
    matrices, none = [], None
    try:
        matrices.append(intrinsics_from_homographies(H))
    except _NoCamera as error:
        none = error
    if none is not None or len(H) <= MAX_CENTRED_VIEWS:
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
    """The camera that took views of a board.

    `intrinsics_from_homographies` gives a start, and `bundle.adjust` then adjusts all parameters.

    Parameters
    ----------
    board : the board in all views.
    views : results of `board.find`, two or more at different tilts; for good accuracy ten to twenty, with boards in all
        parts of the image.
    width, height : size of the images, pixels.
    coefficients : number of free coefficients of distortion, in the order k1, k2, p1, p2, k3; 0 for a pinhole.
    names : names of the views, for messages; None takes their numbers.

    Raises
    ------
    ValueError
        There are fewer than two views, a view is given twice, points are outside the image, or the views do not
        determine the camera.

    Warns
    -----
    RangesimWarning
        Points do not fit (`suspects`), too few free coefficients leave out distortion, or the lens is unknown in a
        corner of the image or folds there.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.calibration import BoardView, Checkerboard
    >>> from rangesim.rig import Intrinsics, look_at
    >>> board = Checkerboard(columns=9, rows=6, square_m=0.025)
    >>> true = Intrinsics(640, 480, 600.0, 610.0, 320.0, 240.0)
    >>> places = [(0.3, 0.1, -0.5), (-0.3, 0, -0.5), (0, 0.3, -0.6)]  # three cameras, in board coordinates
    >>> T = [np.linalg.inv(look_at(place, (0.1, 0.06, 0.0), (0, -1, 0))) for place in places]
    >>> noise = np.random.default_rng(0).normal(0, 0.05, (3, 54, 2))
    >>> pixels = [true.project(board.points @ pose[:3, :3].T + pose[:3, 3]) for pose in T] + noise
    >>> found = calibrate_camera(board, [BoardView(np.arange(54), x) for x in pixels], 640, 480, coefficients=0)
    >>> error = np.abs([found.camera.fx - 600, found.camera.fy - 610])
    >>> bool((error < 4 * found.deviations[:2]).all())
    True
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
    """Camera, poses (k, 4, 4) of the boards, and noise in pixels, as the start for a bundle of two devices."""
    found, _, noise, _ = _calibrated(board, views, width, height, coefficients, names, may_warn=False)
    return found.state.devices[0], found.state.T_first_board, noise


def _calibrated(
    board: Board,
    views: Sequence[BoardView],
    width: int,
    height: int,
    coefficients: int,
    names: Sequence[str],
    may_warn: bool = True,
) -> tuple[Minimum[Bundle], list[Observation], float, Array]:
    """The adjusted bundle of one camera, its observations, its noise in pixels, and deviations of its parameters.

    may_warn : whether to warn of a lens that is unknown in a corner of the image.
    """
    check_views(board, views, coefficients, names)
    homographies = []
    for k, view in enumerate(views):
        try:
            plane = fit_homography(board.points[view.indices, :2], view.pixels, noisy="second")
        except ValueError as error:
            raise ValueError(f"{names[k]}: {error}") from error
        if not ((view.pixels >= 0) & (view.pixels <= [width, height])).all():
            raise ValueError(
                f"{names[k]}: expected points in an image of {width} x {height} pixels, got some outside; does the "
                "image have another size?"
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
        if other[0].cost < SAME_COST_RATIO * found.cost:
            found, observations = other
    _refuse_parallel(found.state.T_first_board)
    noise, deviations = judged(found, observations, may_warn)
    return found, observations, noise, deviations


def _refuse_parallel(T_camera_board: Array) -> None:
    """Raise ValueError if all boards are parallel, because their views then give the same two equations."""
    normals = T_camera_board[:, :3, 2]
    apart = np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1.0, 1.0)))
    if apart < MIN_APART_DEG:
        raise ValueError(
            f"expected views of the plane at different tilts, got {len(normals)} whose boards are within "
            f"{apart:.2g} degrees of parallel: they do not determine the camera; tilt the board."
        )


def adjust_as_seen(
    board: Board, start: Bundle, observations: Sequence[Observation], views: Sequence[BoardView], coefficients: int
) -> tuple[Minimum[Bundle], list[Observation]]:
    """The result of `bundle.adjust`, repeated with the positions that the camera detects as the points of the board.

    These positions (`Board.seen_points`) depend on the camera, so they are known only after a first adjustment. The
    pixels of a second device come from the points that the first one detects, so it has the same positions.

    Parameters
    ----------
    views : the view of each observation.
    """
    found, taken = adjust(start, observations, coefficients), list(observations)
    for _ in range(SEEN_POINT_ROUNDS):
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
    """Raise ValueError unless there are enough different views of this board, and 0 to 5 coefficients."""
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
    """(k, 4, 4) float64, poses of the boards in coordinates of a camera that is roughly known, metres."""
    return np.stack([fit_camera_pose(seen.points, seen.pixels, camera).T_camera_object for seen in observations])


def judged(found: Minimum[Bundle], observations: Sequence[Observation], may_warn: bool = True) -> tuple[float, Array]:
    """The noise of a bundle, and standard deviations of its parameters.

    The noise is the standard deviation of a coordinate, in the unit of the residuals: pixels over `noise_px`.

    may_warn : whether to warn of a lens that is unknown in a corner of its image.

    Raises
    ------
    ValueError
        There are not more coordinates than parameters, or the coordinates do not determine a focal length.
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
        if not relative <= MAX_FOCAL_DEVIATION:
            raise ValueError(
                "expected views that determine the focal length, got some that leave it open (standard deviation "
                f"{100 * relative:.3g} %): tilt the board more, in different directions."
            )
        part = slice(k * lens, (k + 1) * lens)
        _check_corners(device, covariance[part, part], DEVICES[k] if n_devices > 1 else "lens", may_warn)
    return noise, deviations


def _check_corners(device: Intrinsics, covariance: Array, name: str, may_warn: bool) -> None:
    """Warn if a lens folds within its image, or is unknown in a corner of it.

    covariance : covariance of the parameters of the lens. name : name of the device. may_warn : whether to warn at all.
    """
    s = np.linspace(0, 1, BORDER_POINTS)
    zero, one = np.zeros_like(s), np.ones_like(s)
    sides = [np.stack(side, axis=-1) for side in ((s, zero), (s, one), (zero, s), (one, s))]
    rays = device.directions(np.concatenate(sides) * [device.width, device.height])
    if not np.isfinite(rays).all():
        if may_warn:
            warn(
                f"the distortion found for the {name} folds within its image, so that some pixels have no ray: the "
                "lens is unknown where no board was; show boards up to the corners of the image, or free fewer "
                "coefficients."
            )
        return
    corners = device.directions(np.array([[0, 0], [1, 0], [0, 1], [1, 1.0]]) * [device.width, device.height])
    J = by_lens(device, corners)[:, :, : len(covariance)]
    off = float(np.sqrt(np.linalg.eigvalsh(J @ covariance @ np.swapaxes(J, 1, 2))[:, -1].max()))
    if may_warn and off > MAX_CORNER_PX:
        warn(
            f"the {name} is known to {off:.3g} px only in a corner of its image: show boards there, or free fewer "
            "coefficients."
        )


def _conic_row(a: Array, b: Array) -> Array:
    """(k, 6) float64, coefficients of the entries 11, 12, 22, 13, 23, 33 of omega in a^T omega b, for a, b (k, 3)."""
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
