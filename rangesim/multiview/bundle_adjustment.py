# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment: the poses of all images, all points and optionally the lens, with the least reprojection error.

It minimises the sum over observations (i, j) of rho(|x_ij - f(K, k; R_i X_j + t_i)|^2), where f projects through the
lens with its distortion. With rho(z) = z this is the maximum likelihood for Gaussian noise of the pixels. The method is
Levenberg-Marquardt on the normal equations, from which the points are eliminated (`schur_complement`; Brown 1958;
Triggs, McLauchlan, Hartley, Fitzgibbon: "Bundle adjustment - a modern synthesis", 2000). `rangesim.calibration.bundle`
is a different adjustment: there the points lie on boards and are known.

Images determine the scene up to a similarity of 7 degrees of freedom, the gauge. The start fixes the gauge: the pose of
the first image, or of the held image, stays as in the start. Its distance to the camera farthest from it stays too. Two
or more held images leave no freedom.

Some inputs do not determine the result: an image or a group of images that shares too few points with the others; a
camera that only rotates, so that the points have no depth; a camera that moves so little, or sees so little
perspective, that the shape stays open. These inputs raise an error. The covariance shows most of these inputs, but not
all: a descent can fit depths to noise, and at such depths the covariance looks good. So an F test also compares the
cameras found with cameras that only rotate.

Used by: `multi_view_triangulation`, `incremental_reconstruction`, `sliding_window` and `factorisation` (its checks) of
`rangesim.multiview`; no other module of rangesim.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from rangesim.errors import warn
from rangesim.geometry.consensus import chi2_limit, rounding_of, simpler_model_suffices
from rangesim.geometry.correspondences import Array, check_noise, checked_array
from rangesim.geometry.least_squares import descend
from rangesim.geometry.registration import nearest_similarity
from rangesim.geometry.reprojection import POSE, by_lens, moved_lens, moved_pose, reproject, with_all_coefficients
from rangesim.multiview.schur_complement import NormalEquations, Sizes, Step, Term
from rangesim.multiview.tracks import Tracks
from rangesim.rig import Intrinsics, check_rigid
from rangesim.robust_scale import sigma_from_median
from rangesim.settings.config import shown

LENS_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
"""Names of the parameters of a lens, in the order of `Intrinsics` and of OpenCV's distortion."""
Loss = Literal["linear", "huber", "soft_l1", "cauchy"]
MAX_STEPS = 1000
"""Largest number of steps of a final adjustment. The 100 views of docs/multiview.md need four. Hundreds are needed
where the views leave a direction nearly open, because the descent then follows a long curved valley."""
ROUGH_STEPS = 200
"""Largest number of steps while more views are still to come, a count. Such a result need not be at the minimum,
because the next views change it anyway."""
CONVERGED = 1e-8
"""A descent ends when a step decreases the cost by less than this fraction. For a million residuals, 1e-8 of the cost
is 1 % of the variance of one residual, so that the parameters are then within about 0.1 standard deviations of the
minimum."""
MIN_DAMPING = 1e-10
"""Smallest ratio of the damping of Levenberg-Marquardt to the diagonal of the normal equations. It must not be 0,
because the residuals leave parameters open, such as the gauge. Larger values slow the descent near the minimum."""
MAX_ROTATION_DEVIATION = 0.3
"""Largest standard deviation of a rotation, radians. Beyond about 17 degrees the covariance, which is linear in the
rotation, means little, and the pose counts as undetermined."""
MAX_RELATIVE_DEVIATION = 0.5
"""Largest standard deviation of a point over its distance from the nearest camera, a ratio. If it is half of the
distance or more, two standard deviations reach the camera, and the point has no depth."""
ONE_PLACE = 1e-6
"""Smallest extent of the start's cameras over the median distance of the points, a ratio. Below it, the cameras count
as being in one place. It only has to exceed rounding, because what noise leaves open is found after the descent."""
MIN_IMAGES = 2
"""Smallest number of images, and of images that see a point, a count: two, because one image gives no depth."""
MAX_SHAPE_DEVIATION = 0.5
"""Largest ratio of the median point's standard deviation to the extent of the points. A shape that is known less well
is refused, because its errors would be as large as half of the shape."""
SHAPE_SAMPLE = 200
"""Approximate number of points whose joint covariance gives the deviation of the shape. The covariance matrix has three
rows for each point; twice the points take eight times the time."""
TESTED_OBSERVATIONS = 30_000
"""Approximate number of observations in the F test against cameras that only rotate. It is limited so that the test
takes little time; fewer observations make the test weaker for cameras that hardly move."""
ROTATION_ROUNDS = 10
"""Number of rounds, each of which finds the mean directions and then the rotations. They give the start of a descent.
Measured with 3 scenes of 12 images, rotations off by 0.02 rad: without a round the descent takes 3 steps, after 1 to 30
rounds it takes 2, and ends at the same minimum."""
ROTATION_STEPS = 30
"""Largest number of steps of the descent of cameras that only rotate, a count. Measured as for `ROTATION_ROUNDS`: 2 or
3 steps are enough. It ends when a step lowers the cost by less than 1e-4 of it."""
MAX_INLIER_DEVIATIONS = 4.0
"""Largest error of a correct observation under a robust loss, in standard deviations of the noise. Gaussian noise
exceeds four of them in one coordinate of 16 000."""


@dataclass(frozen=True)
class ReliefTest:
    """The thresholds of the search for a shape of another depth that explains the same images."""

    max_relief: float = 0.1
    """Largest median depth of the shape over its distance from the cameras, a ratio. A deeper shape shows its depth by
    perspective and is not tested."""
    max_turn_rad: float = float(np.radians(20))
    """Largest angle between a camera's direction and the mean direction, radians. If a camera turns more, the turns
    tell the depth, and the shape is not tested."""
    factors: tuple[float, ...] = (0.25, 0.5, 2.0, 4.0, 8.0, 16.0)
    """Factors on the depth from which a new descent starts. The valley of equal images is curved, so that one start
    alone does not reach its far end."""
    steps: int = 100
    """Largest number of steps of each new descent."""
    min_difference: float = 0.05
    """Ratio of the median distance of the points of two shapes to their extent. Below it they count as the same shape,
    however small the stated deviation is."""
    max_deviations: float = 2.0
    """Largest median distance of the points of two shapes as a multiple of the stated deviation, above which the stated
    deviation is wrong."""


RELIEF = ReliefTest()


@dataclass(frozen=True, eq=False)
class BundleAdjustment:
    """The cameras and points that `bundle_adjust` found, with their covariance.

    camera : Intrinsics of all images.
    T_camera_world : (n_images, 4, 4), maps world coordinates to those of each camera, in the unit of the start.
    points : (n_points, 3) float64, world, in the unit of the start; NaN for a point that was unknown in the start or
        that fewer than two images see.
    used : (m,) bool, whether an observation took part.
    residuals_px : (m, 2) float64, projected pixel minus seen pixel; NaN for an observation that took no part.
    noise_px : standard deviation of a pixel's coordinate: the given one, or one estimated from the residuals.
    covariance : (n_images, 6, 6) float64, covariance of a rotation vector (radians) and a translation, both applied
        after T_camera_world, in the gauge that the module describes; 0 for a held image.
    lens_deviations : (9,) float64, standard deviations of fx, fy, cx, cy (pixels), k1, k2, p1, p2, k3; 0 for a
        parameter that is not free.
    shape_deviation : standard deviation of the median point after the best similarity, over the extent of the points
        (their median distance from the middle), a ratio. It includes the errors of the cameras. NaN if the noise is
        unknown.
    steps : number of steps taken.
    has_converged : whether the descent ended because no step lowered the cost any more.

    Examples
    --------
    See `bundle_adjust`.
    """

    camera: Intrinsics
    T_camera_world: Array
    points: Array
    used: np.ndarray
    residuals_px: Array
    noise_px: float
    covariance: Array
    lens_deviations: Array
    shape_deviation: float
    steps: int
    has_converged: bool

    @property
    def rms_px(self) -> float:
        """Root mean square distance between projected and seen pixels, over the observations that took part."""
        return float(np.sqrt((self.residuals_px[self.used] ** 2).sum(axis=1).mean()))


class Views(NamedTuple):
    """The state of a descent.

    camera : Intrinsics of all images. T : (n_images, 4, 4), T_camera_world. X : (n_points, 3), world.
    """

    camera: Intrinsics
    T: Array
    X: Array


def bundle_adjust(
    tracks: Tracks,
    camera: Intrinsics,
    T_camera_world: ArrayLike,
    points: ArrayLike,
    *,
    free: Sequence[str] = (),
    held: Sequence[int] = (),
    loss: Loss = "linear",
    loss_scale_px: float = 1.0,
    noise_px: float | None = None,
    max_steps: int = MAX_STEPS,
) -> BundleAdjustment:
    """The cameras and points with the least reprojection error, found by a descent from a start.

    Parameters
    ----------
    tracks : observations in all images that are adjusted.
    camera : the lens of all images. For parameters that `free` names, it gives the values that the descent starts from.
    T_camera_world : (n_images, 4, 4), poses to start from; they map world coordinates to those of each camera.
    points : (n_points, 3), world, points to start from, in front of the cameras that see them. A point that is NaN, or
        that fewer than two images see, is left out.
    free : names of the parameters of the lens that are adjusted, out of fx, fy, cx, cy, k1, k2, p1, p2, k3.
    held : numbers of the images whose poses stay.
    loss : the loss of the distance d between projected and seen pixel, with the names of SciPy's `least_squares`:
        "linear" is d^2; "huber", "soft_l1" and "cauchy" are robust: they grow more slowly beyond `loss_scale_px`, so
        wrong observations have less influence.
    loss_scale_px : distance at which a robust loss begins to grow more slowly than d^2, pixels.
    noise_px : standard deviation of a pixel's coordinate. None estimates it from the residuals; with a robust loss,
        from their median.
    max_steps : largest number of steps.

    Raises
    ------
    ValueError
        There are fewer than two images, poses or points have other shapes, an image sees no points, groups of images
        share no points, a pose is not rigid, points lie behind cameras that see them, or there are fewer equations than
        unknowns. Or the tracks do not determine the cameras or the shape, or a camera that only rotates explains them
        as well.

    Warns
    -----
    RangesimWarning
        The descent did not end within `max_steps`, so that covariance and deviations are not valid.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.multiview import Tracks
    >>> from rangesim.rig import Intrinsics
    >>> camera = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0)
    >>> random = np.random.default_rng(0)
    >>> world = random.uniform([-2, -1, 4], [3, 1, 7], (40, 3))
    >>> T = np.tile(np.eye(4), (4, 1, 1))
    >>> T[:, 0, 3] = [0.0, -0.5, -1.0, -1.5]  # four cameras at x = 0 to 1.5 m, which look along z
    >>> pixels = np.stack([camera.project(world + pose[:3, 3]) for pose in T])
    >>> tracks = Tracks.from_dense(pixels + random.normal(0, 0.5, pixels.shape))
    >>> start = world + random.normal(0, 0.1, world.shape)
    >>> found = bundle_adjust(tracks, camera, T, start)
    >>> found.has_converged, round(found.noise_px, 1)
    (True, 0.5)
    >>> bool(np.abs(found.points - world).max() < 0.2)  # metres; noise of 0.5 px leaves some cm
    True
    """
    found = adjusted_views(
        tracks, camera, T_camera_world, points, free, held, loss, loss_scale_px, noise_px, max_steps, is_last=True
    )
    _refuse_open_shape(found)
    _refuse_rotation_alone(tracks, found, free, held, loss)
    _refuse_other_relief(tracks, found, free, held, loss, loss_scale_px)
    if not found.has_converged:
        warn(
            f"expected a descent that ends, got one that still lowers the cost after {found.steps} steps: the result "
            "is not at the minimum, and its deviations are not valid; raise max_steps, or add views from other sides, "
            "because the views hardly determine some of the unknowns."
        )
    return found


def adjusted_views(
    tracks: Tracks,
    camera: Intrinsics,
    T_camera_world: ArrayLike,
    points: ArrayLike,
    free: Sequence[str] = (),
    held: Sequence[int] = (),
    loss: Loss = "linear",
    loss_scale_px: float = 1.0,
    noise_px: float | None = None,
    max_steps: int = ROUGH_STEPS,
    is_last: bool = False,
) -> BundleAdjustment:
    """The result of `bundle_adjust` while more views are still to come. A shape that is still open is then no error.

    is_last : whether no more views follow; only then `shape_deviation` is computed, else it is NaN.
    """
    sizes, some, state = _checked(tracks, camera, T_camera_world, points, free, held, loss, loss_scale_px, noise_px)
    columns = [LENS_NAMES.index(name) for name in free]
    is_free = np.ones(tracks.n_images, dtype=bool)
    is_free[list(held)] = False

    def look(state: Views) -> NormalEquations:
        return normal_equations(state, some, sizes, columns, is_free, loss, loss_scale_px)

    def move(state: Views, step: Step) -> Views:
        lens = np.zeros(len(LENS_NAMES))
        lens[columns] = step.shared
        moved = moved_lens(state.camera, lens) if columns else state.camera
        return Views(moved, moved_pose(state.T, step.images), state.X + step.points)

    found = descend(look, move, state, max_steps=max_steps, converged=CONVERGED, least_damping=MIN_DAMPING)
    T, X, gauge = _in_gauge(state.T, found.state.T, found.state.X, list(held), len(columns))
    equations = look(Views(found.state.camera, T, X))
    residuals = reprojection_errors(Views(found.state.camera, T, X), some)
    noise = noise_px if noise_px is not None else _noise(residuals, loss, _freedom(some, sizes, held))
    covariance = equations.covariance(gauge) * max(noise, 1e-300) ** 2
    _refuse_undetermined(covariance, T, sizes, is_free, noise)
    _refuse_no_depth(equations, some, T, X, noise)
    blocks = covariance[len(columns) :, len(columns) :].reshape(tracks.n_images, POSE, tracks.n_images, POSE)
    of_images = np.stack([blocks[i, :, i] for i in range(tracks.n_images)])
    of_images[~is_free] = 0
    lens = np.zeros(len(LENS_NAMES))
    lens[columns] = np.sqrt(np.diag(covariance)[: len(columns)])
    used = np.isin(tracks.point, some.point)
    known = np.full((tracks.n_points, 3), np.nan)
    known[np.unique(some.point)] = X[np.unique(some.point)]
    everywhere = np.full((len(tracks), 2), np.nan)
    everywhere[used] = residuals
    shape = float("nan")
    if is_last:
        shape = _shape_deviation(Views(found.state.camera, T, X), some, sizes, columns, is_free, covariance, noise)
    return BundleAdjustment(
        found.state.camera,
        T,
        known,
        used,
        everywhere,
        float(noise),
        of_images,
        lens,
        noise * shape,
        found.steps,
        found.has_converged,
    )


# ------------------------------------------------------------------------------------------- checks


def _checked(
    tracks: Tracks,
    camera: Intrinsics,
    T_camera_world: ArrayLike,
    points: ArrayLike,
    free: Sequence[str],
    held: Sequence[int],
    loss: str,
    loss_scale_px: float,
    noise_px: float | None,
) -> tuple[Sizes, Tracks, Views]:
    """The sizes, the observations that take part and the start; ValueError for arguments that cannot be adjusted."""
    if tracks.n_images < MIN_IMAGES:
        raise ValueError(
            f"expected at least {MIN_IMAGES} images for a bundle adjustment, got {tracks.n_images}: one image has no "
            "depth."
        )
    T = checked_array("T_camera_world", T_camera_world, 4, 4)
    if T.shape != (tracks.n_images, 4, 4):
        raise ValueError(f"expected T_camera_world of shape ({tracks.n_images}, 4, 4), got {T.shape}.")
    check_rigid(T, "T_camera_world")
    X = np.array(points, dtype=np.float64)
    if X.shape != (tracks.n_points, 3) or np.isinf(X).any():
        raise ValueError(f"expected points as ({tracks.n_points}, 3) finite numbers or NaN, got shape {X.shape}.")
    unknown = [name for name in free if name not in LENS_NAMES]
    if unknown or len(set(free)) != len(free):
        raise ValueError(f"expected free as different names of {', '.join(LENS_NAMES)}, got {shown(list(free))}.")
    if any(not isinstance(i, (int, np.integer)) or not 0 <= i < tracks.n_images for i in held):
        raise ValueError(f"expected held as images from 0 to {tracks.n_images - 1}, got {shown(list(held))}.")
    if loss not in LOSSES:
        raise ValueError(f"expected a loss out of {', '.join(LOSSES)}, got {shown(loss)}.")
    if not (np.isfinite(loss_scale_px) and loss_scale_px > 0):
        raise ValueError(f"expected loss_scale_px to be positive, got {loss_scale_px!r}.")
    check_noise(noise_px)
    known = np.isfinite(X).all(axis=1) & (tracks.images_per_point >= MIN_IMAGES)
    some = tracks.keep(known[tracks.point])
    check_connected(some)
    state = Views(with_all_coefficients(camera), T, np.where(known[:, None], X, 0.0))
    hidden = np.flatnonzero(~np.isfinite(reprojection_errors(state, some)).all(axis=1))
    if len(hidden):
        i = hidden[0]
        raise ValueError(
            f"expected points in front of the cameras that see them, got {len(hidden)} of {len(some)} observations "
            f"behind them or beyond the fold of the lens, such as point {some.point[i]} in image {some.image[i]}; set "
            "these points to NaN, or correct the start."
        )
    centres = -np.einsum("nji,nj->ni", T[:, :3, :3], T[:, :3, 3])
    depth = float(np.median(np.linalg.norm(in_cameras(state, some), axis=1)))
    if not np.linalg.norm(centres - centres.mean(axis=0), axis=1).max() > ONE_PLACE * depth:
        raise ValueError(
            f"expected cameras in different places, got {tracks.n_images} in one place: a camera that only rotates "
            "sees no depth; add views from other places."
        )
    sizes = Sizes(len(free), tracks.n_images, POSE, tracks.n_points, 3)
    if _freedom(some, sizes, held) < 0:
        raise ValueError(
            f"expected at least as many equations as unknowns, got {2 * len(some)} equations for "
            f"{2 * len(some) - _freedom(some, sizes, held)} unknowns of {tracks.n_images} images and "
            f"{len(np.unique(some.point))} points; add observations."
        )
    return sizes, some, state


def check_connected(tracks: Tracks) -> None:
    """Raise ValueError unless every image sees points, and shared points link all images into one group."""
    empty = np.flatnonzero(tracks.points_per_image == 0)
    if len(empty):
        raise ValueError(
            f"expected every image to see points that another image sees too, got none in image {empty[0]}"
            f"{f' and {len(empty) - 1} more' if len(empty) > 1 else ''}; leave it out (Tracks.of_images) or add points."
        )
    links = coo_array(
        (np.ones(len(tracks)), (tracks.image, tracks.n_images + tracks.point)),
        shape=(tracks.n_images + tracks.n_points,) * 2,
    )
    groups = connected_components(links, directed=False)[1][: tracks.n_images]
    if len(np.unique(groups)) > 1:
        first = np.flatnonzero(groups == groups[0])
        raise ValueError(
            f"expected images that overlap, got {len(np.unique(groups))} groups that share no point, such as images "
            f"{_listed(first)} and {_listed(np.flatnonzero(groups != groups[0]))}; add images between them, or solve "
            "each group alone."
        )


def _listed(numbers: np.ndarray) -> str:
    """The first four numbers as text."""
    return ", ".join(str(n) for n in numbers[:4]) + (", ..." if len(numbers) > 4 else "")


def _freedom(some: Tracks, sizes: Sizes, held: Sequence[int]) -> int:
    """Degrees of freedom of the residuals: number of equations minus number of unknowns, the gauge not counted."""
    gauge = {0: 7, 1: 1}.get(len(set(held)), 0)
    cameras = POSE * (sizes.images - len(set(held)))
    return 2 * len(some) - (sizes.shared + cameras + 3 * len(np.unique(some.point)) - gauge)


def _refuse_undetermined(covariance: Array, T: Array, sizes: Sizes, is_free: np.ndarray, noise: float) -> None:
    """Raise ValueError if the deviation of a pose is too large.

    The limit of a rotation is `MAX_ROTATION_DEVIATION`, that of a translation the extent of all cameras.
    """
    of_images = np.diag(covariance)[sizes.shared :].reshape(-1, POSE)
    centres = -np.einsum("nji,nj->ni", T[:, :3, :3], T[:, :3, 3])
    extent = np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
    with np.errstate(invalid="ignore"):
        turn, move = (np.sqrt(of_images[:, part].sum(axis=1)) for part in (slice(3), slice(3, 6)))
    bad = np.flatnonzero(is_free & ~((turn <= MAX_ROTATION_DEVIATION) & (move <= extent)))
    if len(bad):
        raise ValueError(
            f"expected tracks that determine the cameras, got tracks that leave {len(bad)} of {len(T)} poses open at a "
            f"noise of {noise:.3g} px, such as the pose of image {bad[0]}: there are too few points, the points lie on "
            "a line, or the camera only rotates; add points or views from other places."
        )


def _refuse_no_depth(equations: NormalEquations, some: Tracks, T: Array, X: Array, noise: float) -> None:
    """Raise ValueError if, with exact cameras, the median point has a deviation above `MAX_RELATIVE_DEVIATION`."""
    deviation = noise * np.sqrt(np.trace(equations.covariance_of_points(), axis1=1, axis2=2))
    centres = -np.einsum("nji,nj->ni", T[:, :3, :3], T[:, :3, 3])
    distance = np.full(len(X), np.inf)
    np.minimum.at(distance, some.point, np.linalg.norm(X[some.point] - centres[some.image], axis=1))
    known = np.unique(some.point)
    with np.errstate(invalid="ignore"):
        relative = float(np.median(deviation[known] / distance[known]))
    if relative > MAX_RELATIVE_DEVIATION:
        raise ValueError(
            f"expected images with parallax, got points with a standard deviation of {relative:.0%} of their distance "
            f"at a noise of {noise:.3g} px: the camera only rotates, or moves too little; add views from other places."
        )


def _refuse_open_shape(found: BundleAdjustment) -> None:
    """Raise ValueError if the shape has a deviation above `MAX_SHAPE_DEVIATION`."""
    if found.shape_deviation > MAX_SHAPE_DEVIATION:
        raise ValueError(
            f"expected views that determine the shape, got points with a standard deviation of "
            f"{found.shape_deviation:.0%} of their extent at a noise of {found.noise_px:.3g} px: the views come from "
            "nearly one direction, or the lens is too narrow; add views from other sides."
        )


def _refuse_rotation_alone(
    tracks: Tracks, found: BundleAdjustment, free: Sequence[str], held: Sequence[int], loss: str
) -> None:
    """Raise ValueError if a camera that only rotates explains the tracks as well as the cameras found.

    It is the F test of nested models, on some of the points. The simpler model has a rotation for each image and a
    direction for each point.
    """
    if len(set(held)) > 1:
        return  # two held poses state the baseline, so that it needs no test
    chosen = found.used.copy()
    if loss != "linear":
        chosen &= (np.abs(np.nan_to_num(found.residuals_px, nan=np.inf)) <= MAX_INLIER_DEVIATIONS * found.noise_px).all(
            axis=1
        )
    stride = max(1, int(np.ceil(chosen.sum() / TESTED_OBSERVATIONS)))
    chosen &= np.cumsum(np.diff(tracks.point, prepend=-1) != 0) % stride == 0
    some = tracks.keep(chosen)
    some = some.keep(some.images_per_point[some.point] >= MIN_IMAGES)
    points, images = len(np.unique(some.point)), len(np.unique(some.image))
    residuals = reprojection_errors(Views(found.camera, found.T_camera_world, np.nan_to_num(found.points)), some)
    cost = float((residuals**2).sum())
    freedom = 2 * len(some) - (len(free) + POSE * images + 3 * points - 7)
    turning = 2 * len(some) - (len(free) + 3 * images + 2 * points - 3)
    if freedom <= 0:
        return
    simple = _cost_of_rotations(found.camera, found.T_camera_world, some)
    if simpler_model_suffices((simple, turning), (cost, freedom), None, rounding_of(some.pixels)):
        raise ValueError(
            f"expected images with parallax, got images that a camera which only rotates explains within "
            f"{np.sqrt(simple / turning):.3g} px, as well as the poses found: depths would be fitted to the noise; "
            "add views from other places."
        )


def _refuse_other_relief(
    tracks: Tracks, found: BundleAdjustment, free: Sequence[str], held: Sequence[int], loss: Loss, scale_px: float
) -> None:
    """Raise ValueError if a flatter or deeper shape, seen by cameras that turn more or less, explains the tracks, too.

    Without perspective and under small turns w, the images only show the product of w and depth (the bas-relief
    ambiguity: Belhumeur, Kriegman, Yuille, IJCV 1999). The sum of squares then has a long curved valley. Noise makes
    minima in it, and at such a minimum the covariance looks good although the valley goes on. So new descents start
    from shapes of other depth. Where a descent ends with a sum of squares that is larger by r noise^2, its points may
    lie at most `max_deviations` times sqrt(r) stated deviations away. Only flat scenes that are seen from nearly one
    direction are tested.
    """
    known = np.isfinite(found.points).all(axis=1)
    if len(set(held)) > 1 or known.sum() < 2 or not found.noise_px > 0:
        return
    X, T = found.points[known], found.T_camera_world
    middle = np.median(X, axis=0)
    towards = middle - -np.einsum("nji,nj->ni", T[:, :3, :3], T[:, :3, 3])
    distance = np.linalg.norm(towards, axis=1)
    towards /= np.maximum(distance, 1e-300)[:, None]
    d = towards.mean(axis=0) / np.linalg.norm(towards.mean(axis=0))
    relief = (X - middle) @ d
    is_deep = np.median(np.abs(relief)) > RELIEF.max_relief * np.median(distance)
    if is_deep or (towards @ d).min() < np.cos(RELIEF.max_turn_rad):
        return
    turns = np.cross(d, towards)
    cost = _loss_of(found.residuals_px[found.used], loss, scale_px)
    extent = float(np.median(np.linalg.norm(X - middle, axis=1)))
    for deeper in RELIEF.factors:
        other = found.points.copy()
        other[known] += (deeper - 1) * relief[:, None] * d
        Q = Rotation.from_rotvec((1 - 1 / deeper) * turns).as_matrix()
        start = T.copy()
        start[:, :3, :3] = T[:, :3, :3] @ Q
        start[:, :3, 3] += np.einsum("nij,nj->ni", T[:, :3, :3], middle - Q @ middle)
        try:
            again = adjusted_views(
                tracks, found.camera, start, other, free, held, loss, scale_px, found.noise_px, RELIEF.steps
            )
        except ValueError:  # this start has points behind a camera, or ends undetermined: it is no other solution
            continue
        if (again.used != found.used).any():
            continue
        rise = (_loss_of(again.residuals_px[again.used], loss, scale_px) - cost) / found.noise_px**2
        similarity = nearest_similarity(again.points[known], X)
        turned = again.points[known] @ similarity[:3, :3].T + similarity[:3, 3]
        apart = float(np.median(np.linalg.norm(turned - X, axis=1))) / extent
        stated = RELIEF.max_deviations * found.shape_deviation * np.sqrt(max(rise, 1.0))
        if rise < chi2_limit(1) and apart > max(RELIEF.min_difference, stated):
            raise ValueError(
                f"expected views that determine the shape, got views that another shape explains as well, with points "
                f"off by {apart:.0%} of their extent: a flatter shape that turns more looks the same through a "
                "narrow lens; add views from other sides, or from nearer."
            )


def _loss_of(residuals: Array, loss: Loss, scale: float) -> float:
    """Sum of the loss over residuals (m, 2), px^2."""
    return float(scale**2 * LOSSES[loss]((residuals**2).sum(axis=1) / scale**2)[0].sum())


def _cost_of_rotations(camera: Intrinsics, T: Array, tracks: Tracks) -> float:
    """Sum of squared errors, px^2, of the best cameras that only rotate about one centre, and directions of points."""
    rays = np.concatenate([camera.normalise(tracks.pixels), np.ones((len(tracks), 1))], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    R = _rotations_alone(T[:, :3, :3], rays, tracks)
    X = np.zeros((tracks.n_points, 3))
    np.add.at(X, tracks.point, np.einsum("mji,mj->mi", R[tracks.image], rays))
    size = np.linalg.norm(X, axis=1, keepdims=True)
    start = np.tile(np.eye(4), (len(T), 1, 1))
    start[:, :3, :3] = R
    sizes = Sizes(0, tracks.n_images, 3, tracks.n_points, 3)
    everyone = np.ones(tracks.n_images, dtype=bool)

    def look(state: Views) -> NormalEquations:
        found = normal_equations(state, tracks, sizes, [], everyone, "linear", 1.0)
        found.terms = [term._replace(by_images=term.by_images[..., :3]) for term in found.terms]
        return found

    def move(state: Views, step: Step) -> Views:
        turns = np.concatenate([step.images, np.zeros((len(step.images), 3))], axis=1)
        X = state.X + step.points
        return Views(state.camera, moved_pose(state.T, turns), X / np.linalg.norm(X, axis=1, keepdims=True))

    X = np.where(size > 0, X / np.where(size > 0, size, 1.0), [0.0, 0.0, 1.0])
    first = Views(with_all_coefficients(camera), start, X)
    if not np.isfinite(look(first).cost):
        return float("inf")  # a point behind a camera, or beyond the fold of its lens
    return descend(look, move, first, max_steps=ROTATION_STEPS, converged=1e-4, least_damping=MIN_DAMPING).here.cost


def _rotations_alone(R: Array, rays: Array, tracks: Tracks) -> Array:
    """Rotations (n, 3, 3) that make the rays of each point parallel, as far as possible.

    From the start R, each round takes the mean direction of each point's rays, and then the rotation of each image that
    fits its rays to these directions (Wahba's problem).
    """
    for _ in range(ROTATION_ROUNDS):
        X = np.zeros((tracks.n_points, 3))
        np.add.at(X, tracks.point, np.einsum("mji,mj->mi", R[tracks.image], rays))
        X /= np.maximum(np.linalg.norm(X, axis=1, keepdims=True), 1e-300)
        B = np.zeros((len(R), 3, 3))
        np.add.at(B, tracks.image, rays[:, :, None] * X[tracks.point][:, None, :])
        u, _, vt = np.linalg.svd(B)
        u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
        R = u @ vt
    return R


def _shape_deviation(
    state: Views,
    some: Tracks,
    sizes: Sizes,
    columns: list[int],
    is_free: np.ndarray,
    covariance: Array,
    noise: float,
) -> float:
    """Standard deviation of the median point after the best similarity, over the points' extent, for a noise of 1 px.

    It uses about `SHAPE_SAMPLE` points. With C the covariance of lens and poses, J = dX / d(lens, poses) the
    response of the points, and V^-1 their covariance if the cameras are exact, cov X = J C J^T + diag(V^-1). The
    components along translation, rotation and scale of all points are then removed.
    """
    numbers = np.unique(some.point)
    chosen = numbers[:: max(1, len(numbers) // SHAPE_SAMPLE)]
    place = np.full(some.n_points, -1)
    place[chosen] = np.arange(len(chosen))
    mine = place[some.point] >= 0
    part = Tracks(some.image[mine], place[some.point[mine]], some.pixels[mine], some.n_images, len(chosen))
    X = state.X[chosen]
    of_part = replace(sizes, points=len(chosen))
    equations = normal_equations(state._replace(X=X), part, of_part, columns, is_free, "linear", 1.0)
    alone = equations.covariance_of_points()
    extent = float(np.median(np.linalg.norm(X - np.median(X, axis=0), axis=1)))
    known = np.isfinite(alone).all(axis=(1, 2))
    if not (extent > 0 and known.any() and noise > 0):
        return float("nan")
    J = equations.response_of_points()[known].reshape(-1, sizes.reduced)
    joint = J @ (covariance / noise**2) @ J.T + block_diag(*alone[known])
    Y = (X[known] - np.median(X[known], axis=0)) / extent
    along = np.zeros((len(Y), 3, 7))
    along[:, :, :3] = np.eye(3)
    for k, axis in enumerate(np.eye(3)):
        along[:, :, 3 + k] = np.cross(axis, Y)
    along[:, :, 6] = Y
    basis = np.linalg.qr(along.reshape(-1, 7))[0]
    rest = np.eye(len(basis)) - basis @ basis.T
    variance = np.einsum("ij,jk,ik->i", rest, joint, rest, optimize=True).reshape(-1, 3).sum(axis=1)
    return float(np.sqrt(np.median(np.maximum(variance, 0))) / extent)


# ------------------------------------------------------------------------------------------- the sum of squares


def in_cameras(state: Views, tracks: Tracks) -> Array:
    """(m, 3) float64, the point of each observation in the coordinates of its camera."""
    R, X = state.T[tracks.image, :3, :3], state.X[tracks.point]
    return np.asarray((R @ X[:, :, None])[:, :, 0] + state.T[tracks.image, :3, 3])


def reprojection_errors(state: Views, tracks: Tracks) -> Array:
    """(m, 2) float64, projected minus seen pixel of each observation; NaN for a point behind its camera."""
    return state.camera.project(in_cameras(state, tracks)) - tracks.pixels


def normal_equations(
    state: Views,
    tracks: Tracks,
    sizes: Sizes,
    columns: list[int],
    is_free: np.ndarray,
    loss: str,
    scale: float,
) -> NormalEquations:
    """The normal equations of the sum of the loss; their cost is infinite if a point is behind a camera that sees it.

    columns : indices in `LENS_NAMES` of the free parameters of the lens. is_free : (n_images,) bool, whether the pose
    of an image is free. scale : of a robust loss, pixels.
    """
    seen = in_cameras(state, tracks)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        pixels, by_seen, appears = reproject(state.camera, seen)
    if not appears.all():
        return NormalEquations(np.inf, sizes, [])
    values = pixels - tracks.pixels
    by_image = np.empty((len(tracks), 2, 1, POSE))
    x, y, z = (seen[:, None, k] for k in range(3))
    u, v, w = (by_seen[:, :, k] for k in range(3))
    by_image[:, :, 0, 0], by_image[:, :, 0, 1], by_image[:, :, 0, 2] = y * w - z * v, z * u - x * w, x * v - y * u
    by_image[:, :, 0, 3:] = by_seen
    by_point = by_seen @ state.T[tracks.image, :3, :3]
    by_shared = by_lens(state.camera, seen)[:, :, columns] if columns else np.empty((len(tracks), 2, 0))
    cost = float((values**2).sum())
    if not is_free.all():
        by_image[~is_free[tracks.image]] = 0
    if loss != "linear":
        square = (values**2).sum(axis=1) / scale**2
        rho, slope = LOSSES[loss](square)
        cost = float(scale**2 * rho.sum())
        weight = np.sqrt(slope)[:, None]
        values, by_point = values * weight, by_point * weight[:, :, None]
        by_image, by_shared = by_image * weight[:, :, None, None], by_shared * weight[:, :, None]
    term = Term(values, tracks.point, tracks.image[:, None], by_image, by_point, by_shared)
    return NormalEquations(cost, sizes, [term])


def _huber(z: Array) -> tuple[Array, Array]:
    """Huber's rho and its derivative."""
    root = np.sqrt(np.maximum(z, 1.0))
    return np.where(z <= 1, z, 2 * root - 1), 1 / root


def _soft_l1(z: Array) -> tuple[Array, Array]:
    """The rho of "soft_l1", a smooth absolute value, and its derivative."""
    root = np.sqrt(1 + z)
    return 2 * (root - 1), 1 / root


LOSSES = {
    "linear": lambda z: (z, np.ones_like(z)),
    "huber": _huber,
    "soft_l1": _soft_l1,
    "cauchy": lambda z: (np.log1p(z), 1 / (1 + z)),
}
"""Functions that return rho and its derivative at z = (d / scale)^2, by the name of the loss. They are those of SciPy's
`least_squares`."""


def _noise(residuals: Array, loss: str, freedom: int) -> float:
    """Standard deviation of a pixel's coordinate, from residuals (m, 2); NaN if there are no degrees of freedom.

    The function computes it from the sum of squares, or with a robust loss from the median of the absolute values. It
    corrects both for the degrees of freedom.
    """
    if freedom <= 0:
        return float("nan")
    if loss == "linear":
        return float(np.sqrt((residuals**2).sum() / freedom))
    return float(sigma_from_median(residuals) * np.sqrt(residuals.size / freedom))


def _in_gauge(start: Array, T: Array, X: Array, held: list[int], shared: int) -> tuple[Array, Array, Array]:
    """Poses and points, moved and scaled into the gauge of the start, and the rows (q, k) of the gauge's conditions.

    A step s of lens and poses, (k,), stays in the gauge where rows @ s = 0.
    """
    centres = -np.einsum("nji,nj->ni", start[:, :3, :3], start[:, :3, 3])
    if len({*held}) > 1:
        return T, X, np.zeros((0, shared + POSE * len(T)))
    first = held[0] if held else 0
    far = int(np.argmax(np.linalg.norm(centres - centres[first], axis=1)))
    R, t = T[:, :3, :3] @ T[first, :3, :3].T, T[:, :3, 3].copy()
    t -= R @ T[first, :3, 3]
    now = -np.einsum("nji,nj->ni", R, t)
    was = np.linalg.norm(centres[far] - centres[first])
    scale = was / np.linalg.norm(now[far]) if was > 0 else 1.0
    moved = np.tile(np.eye(4), (len(T), 1, 1))
    moved[:, :3, :3], moved[:, :3, 3] = R, scale * t
    moved = moved @ start[first]
    in_first = scale * (X @ T[first, :3, :3].T + T[first, :3, 3])
    points = (in_first - start[first, :3, 3]) @ start[first, :3, :3]
    gauge = np.zeros((7, shared + POSE * len(T)))
    gauge[:6, shared + POSE * first : shared + POSE * (first + 1)] = np.eye(6)
    between = centres[far] - centres[first]
    size = np.linalg.norm(between)
    last = shared + POSE * far + 3
    gauge[6, last : last + 3] = -(moved[far, :3, :3] @ between) / (size if size > 0 else 1.0)
    return moved, points, gauge
