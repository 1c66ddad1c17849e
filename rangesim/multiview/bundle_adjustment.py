# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment: poses of all images, all points, and the lens if asked for, of least reprojection error.

Minimises sum over observations (i, j) of rho(|x_ij - f(K, k; R_i X_j + t_i)|^2), f the image through the lens with
distortion: the maximum likelihood for Gaussian noise of the pixels with rho(z) = z. Levenberg-Marquardt on the normal
equations, from which the points are eliminated (`schur_complement`; Brown 1958; Triggs, McLauchlan, Hartley,
Fitzgibbon: "Bundle adjustment - a modern synthesis", 2000). `rangesim.calibration.bundle` is the other one: boards
that are known instead of points that are not.

Images fix the scene up to a similarity: 7 degrees of freedom, the gauge. The gauge here is that of the start: the pose
of the first image, or of the one that is held, and its distance from the image farthest from it stay. Two or more
held images leave no freedom.

Degenerate: an image, or a group of images, that shares too few points with the rest; a camera that only rotates (the
points have no depth), or moves so little, or sees so little perspective, that the shape stays open. These are errors,
told by the covariance, and by an F test of the cameras that were found against cameras that only rotate: noise can be
explained by depths, and a covariance at such depths looks well.
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
from rangesim.multiview.schur_complement import LEAST_DAMPING, NormalEquations, Sizes, Step, Term
from rangesim.multiview.tracks import Tracks
from rangesim.rig import Intrinsics, check_rigid
from rangesim.settings.config import shown

LENS_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
Loss = Literal["linear", "huber", "soft_l1", "cauchy"]
MAX_STEPS, ROUGH_STEPS = 1000, 200
"""At the end, and of views to which others are still to come. Some steps are enough unless the views leave a direction
nearly open, a long curved valley."""
CONVERGED = 1e-8
"""Relative decrease of the cost at which it ends: of a million residuals, 1e-8 of the cost is 1 % of the variance of
one."""
MAX_ROTATION_DEVIATION = 0.3
"""Radians; a pose known worse than this is no pose."""
MAX_RELATIVE_DEVIATION = 0.5
"""Standard deviation of a point over its distance from the nearest camera beyond which it has no depth."""
ONE_PLACE = 1e-6
"""Extent of the cameras of a start over the distance of the points below which they stand in one place."""
MIN_IMAGES = 2
MAX_SHAPE_DEVIATION = 0.5
"""Of the points' extent; a shape whose median point is known worse is none."""
SHAPE_SAMPLE = 200
"""Points by which the deviation of the shape is judged."""
TESTED_OBSERVATIONS = 30_000
"""By which cameras that move are told from cameras that only rotate."""
NO_PERSPECTIVE, SMALL_TURN = 0.1, np.radians(20)
"""Depth over distance, and radians about the mean direction, below which a shape may look like one of other depth."""
OTHER_DEPTHS, RELIEF_STEPS = (0.25, 0.5, 2.0, 4.0, 8.0, 16.0), 100
"""Times the depth found, and steps of a descent from there."""
ANOTHER_SHAPE, MAX_CURVED = 0.05, 2.0
"""Of the extent, and times the deviation that the covariance tells, from which on a shape is another one."""
ROTATION_ROUNDS, ROTATION_STEPS = 10, 30
RIGHT = 4.0
"""Standard deviations that a right observation is off at most, beside a robust loss."""


@dataclass(frozen=True, eq=False)
class BundleAdjustment:
    """Cameras and points.

    camera : Intrinsics. T_camera_world : (n_images, 4, 4) maps world coordinates to each camera's, in the units of the
    start. points : (n_points, 3) world; NaN of those that were unknown or that fewer than two images see.
    used : (m,) bool, the observations that took part. residuals_px : (m, 2) projected less seen; NaN of others.
    noise_px : standard deviation of a coordinate, as given or from the residuals. covariance : (n_images, 6, 6) of
    (rotation vector, rad, translation) both applied after T_camera_world, in the gauge (see the module): 0 of what is
    held. lens_deviations : (9,) standard deviations of fx, fy, cx, cy, k1, k2, p1, p2, k3; 0 of what is held.
    shape_deviation : standard deviation of a point, the median, over the points' extent (their median distance from
    the middle), after the best similarity; what cameras and points leave open together. NaN if the noise is unknown.
    steps : that were taken. has_converged : whether no step lowered the cost any more.
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
        """Root mean square of the distances between projected and seen pixels."""
        return float(np.sqrt((self.residuals_px[self.used] ** 2).sum(axis=1).mean()))


class Views(NamedTuple):
    """camera : of all images. T : (n_images, 4, 4) T_camera_world. X : (n_points, 3) world."""

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
    """The cameras and points of least reprojection error, from a start downwards.

    Parameters
    ----------
    tracks : of which all images are adjusted.
    camera : the lens of all images.
    T_camera_world : (n_images, 4, 4) to start with. points : (n_points, 3) to start with, world, in front of the
        cameras that see them; NaN where unknown: these, and points in fewer than two images, are left out.
    free : names of the lens's parameters that are adjusted, of fx, fy, cx, cy, k1, k2, p1, p2, k3.
    held : images whose poses stay.
    loss : of the distance d between projected and seen pixel, as SciPy's `least_squares`: "linear" d^2, "huber",
        "soft_l1", "cauchy", which let wrong observations pull less beyond `loss_scale_px`.
    noise_px : standard deviation of a coordinate; None: from the residuals (of a robust loss, from their median).

    Raises
    ------
    ValueError
        Fewer than two images; poses or points of other shapes; an image without points; images in groups that share no
        points; poses that are not rigid; points behind the cameras; fewer equations than unknowns; cameras or a shape
        that the tracks do not determine; or cameras that explain the tracks no better than one that only rotates.

    Warns
    -----
    RangesimWarning
        The descent did not end in `max_steps`: covariance and deviations do not hold.
    """
    found = adjusted_views(
        tracks, camera, T_camera_world, points, free, held, loss, loss_scale_px, noise_px, max_steps, is_last=True
    )
    _refuse_open_shape(found)
    _refuse_rotation_alone(tracks, found, free, held, loss)
    _refuse_other_relief(tracks, found, free, held, loss, loss_scale_px)
    if not found.has_converged:
        warn(
            f"expected a descent that ends, got one that still goes down after {found.steps} steps: the answer is not "
            "the best, and its deviations do not hold; raise max_steps, or add views from other sides, since some "
            "direction is nearly open."
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
    """As `bundle_adjust`, of views to which others are still to come: a shape that is open yet is no error.

    How far it is open is told where they are the last.
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

    found = descend(look, move, state, max_steps=max_steps, converged=CONVERGED, least_damping=LEAST_DAMPING)
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
            "these points to NaN, or mend the start."
        )
    centres = -np.einsum("nji,nj->ni", T[:, :3, :3], T[:, :3, 3])
    depth = float(np.median(np.linalg.norm(in_cameras(state, some), axis=1)))
    if not np.linalg.norm(centres - centres.mean(axis=0), axis=1).max() > ONE_PLACE * depth:
        raise ValueError(
            f"expected cameras in different places, got {tracks.n_images} in one: a camera that only rotates sees no "
            "depth; add views from other places."
        )
    sizes = Sizes(len(free), tracks.n_images, POSE, tracks.n_points, 3)
    if _freedom(some, sizes, held) < 0:
        raise ValueError(
            f"expected at least as many equations as unknowns, got {2 * len(some)} and "
            f"{2 * len(some) - _freedom(some, sizes, held)} of {tracks.n_images} images and "
            f"{len(np.unique(some.point))} points; add observations."
        )
    return sizes, some, state


def check_connected(tracks: Tracks) -> None:
    """Raise ValueError unless all images see points, and chains of shared points link them all."""
    empty = np.flatnonzero(tracks.points_per_image == 0)
    if len(empty):
        raise ValueError(
            f"expected points in every image that another one sees too, got none in image {empty[0]}"
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
            f"{_some(first)} and {_some(np.flatnonzero(groups != groups[0]))}; add images between them, or solve each "
            "group alone."
        )


def _some(numbers: np.ndarray) -> str:
    return ", ".join(str(n) for n in numbers[:4]) + (", ..." if len(numbers) > 4 else "")


def _freedom(some: Tracks, sizes: Sizes, held: Sequence[int]) -> int:
    """Equations less unknowns, the gauge taken out."""
    gauge = {0: 7, 1: 1}.get(len(set(held)), 0)
    cameras = POSE * (sizes.images - len(set(held)))
    return 2 * len(some) - (sizes.shared + cameras + 3 * len(np.unique(some.point)) - gauge)


def _refuse_undetermined(covariance: Array, T: Array, sizes: Sizes, is_free: np.ndarray, noise: float) -> None:
    """Raise ValueError where poses are known worse than to `MAX_ROTATION_DEVIATION`, or than the cameras' extent."""
    of_images = np.diag(covariance)[sizes.shared :].reshape(-1, POSE)
    centres = -np.einsum("nji,nj->ni", T[:, :3, :3], T[:, :3, 3])
    extent = np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
    with np.errstate(invalid="ignore"):
        turn, move = (np.sqrt(of_images[:, part].sum(axis=1)) for part in (slice(3), slice(3, 6)))
    bad = np.flatnonzero(is_free & ~((turn <= MAX_ROTATION_DEVIATION) & (move <= extent)))
    if len(bad):
        raise ValueError(
            f"expected tracks that determine the cameras, got some that leave {len(bad)} of {len(T)} poses open at a "
            f"noise of {noise:.3g} px, such as that of image {bad[0]}: too few points, points on a line, or a camera "
            "that only rotates; add points or views from other places."
        )


def _refuse_no_depth(equations: NormalEquations, some: Tracks, T: Array, X: Array, noise: float) -> None:
    """Raise ValueError where most points are known worse, given the cameras, than to half their distance."""
    deviation = noise * np.sqrt(np.trace(equations.covariance_of_points(), axis1=1, axis2=2))
    centres = -np.einsum("nji,nj->ni", T[:, :3, :3], T[:, :3, 3])
    distance = np.full(len(X), np.inf)
    np.minimum.at(distance, some.point, np.linalg.norm(X[some.point] - centres[some.image], axis=1))
    known = np.unique(some.point)
    with np.errstate(invalid="ignore"):
        relative = float(np.median(deviation[known] / distance[known]))
    if relative > MAX_RELATIVE_DEVIATION:
        raise ValueError(
            f"expected images with parallax, got some whose points are known to {relative:.0%} of their distance at a "
            f"noise of {noise:.3g} px: the camera only rotates, or moves too little; add views from other places."
        )


def _refuse_open_shape(found: BundleAdjustment) -> None:
    if found.shape_deviation > MAX_SHAPE_DEVIATION:
        raise ValueError(
            f"expected views that determine the shape, got some that leave its points open by "
            f"{found.shape_deviation:.0%} of their extent at a noise of {found.noise_px:.3g} px: views from nearly one "
            "direction, or too narrow a lens; add views from other sides."
        )


def _refuse_rotation_alone(
    tracks: Tracks, found: BundleAdjustment, free: Sequence[str], held: Sequence[int], loss: str
) -> None:
    """Raise ValueError where a camera that only rotates explains the tracks to their noise as the cameras found do.

    The F test of nested models on some of the points: a rotation for each image and a direction for each point.
    """
    if len(set(held)) > 1:
        return  # a baseline that was given is no question
    chosen = found.used.copy()
    if loss != "linear":
        chosen &= (np.abs(np.nan_to_num(found.residuals_px, nan=np.inf)) <= RIGHT * found.noise_px).all(axis=1)
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
            f"expected images with parallax, got some that a camera which only rotates explains within "
            f"{np.sqrt(simple / turning):.3g} px, no worse than the poses found: depths would be fitted to the noise; "
            "add views from other places."
        )


def _refuse_other_relief(
    tracks: Tracks, found: BundleAdjustment, free: Sequence[str], held: Sequence[int], loss: Loss, scale_px: float
) -> None:
    """Raise ValueError where a flatter or deeper shape, seen by cameras that turn more or less, explains the tracks.

    Without perspective and under small turns w, images see w times depth alone (the bas-relief ambiguity: Belhumeur,
    Kriegman, Yuille, IJCV 1999). Such a valley is curved, and at a bottom that the noise made the covariance looks
    well. So a descent from shapes of other depth ends where the valley leads, and a rise of the sum of squares by r
    noise^2 must not go that way farther than some times sqrt(r) deviations. Asked of flat scenes from near directions.
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
    if np.median(np.abs(relief)) > NO_PERSPECTIVE * np.median(distance) or (towards @ d).min() < np.cos(SMALL_TURN):
        return
    turns = np.cross(d, towards)
    cost = _loss_of(found.residuals_px[found.used], loss, scale_px)
    extent = float(np.median(np.linalg.norm(X - middle, axis=1)))
    for deeper in OTHER_DEPTHS:
        other = found.points.copy()
        other[known] += (deeper - 1) * relief[:, None] * d
        Q = Rotation.from_rotvec((1 - 1 / deeper) * turns).as_matrix()
        start = T.copy()
        start[:, :3, :3] = T[:, :3, :3] @ Q
        start[:, :3, 3] += np.einsum("nij,nj->ni", T[:, :3, :3], middle - Q @ middle)
        try:
            again = adjusted_views(
                tracks, found.camera, start, other, free, held, loss, scale_px, found.noise_px, RELIEF_STEPS
            )
        except ValueError:  # behind a camera, or open altogether: no other answer
            continue
        if (again.used != found.used).any():
            continue
        rise = (_loss_of(again.residuals_px[again.used], loss, scale_px) - cost) / found.noise_px**2
        similarity = nearest_similarity(again.points[known], X)
        turned = again.points[known] @ similarity[:3, :3].T + similarity[:3, 3]
        apart = float(np.median(np.linalg.norm(turned - X, axis=1))) / extent
        stated = MAX_CURVED * found.shape_deviation * np.sqrt(max(rise, 1.0))
        if rise < chi2_limit(1) and apart > max(ANOTHER_SHAPE, stated):
            raise ValueError(
                f"expected views that determine the shape, got some that another one explains as well, its points "
                f"off by {apart:.0%} of their extent: a flatter shape that turns more looks the same through a "
                "narrow lens; add views from other sides, or from nearer."
            )


def _loss_of(residuals: Array, loss: Loss, scale: float) -> float:
    return float(scale**2 * LOSSES[loss]((residuals**2).sum(axis=1) / scale**2)[0].sum())


def _cost_of_rotations(camera: Intrinsics, T: Array, tracks: Tracks) -> float:
    """Sum of squares in px^2 of the best rotations, about one centre, and directions of points."""
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
    return descend(look, move, first, max_steps=ROTATION_STEPS, converged=1e-4, least_damping=LEAST_DAMPING).here.cost


def _rotations_alone(R: Array, rays: Array, tracks: Tracks) -> Array:
    """Rotations (n, 3, 3) under which rays of the same point are parallel, from R on in turns with the points' mean
    directions (Wahba's problem for each image)."""
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
    """Deviation of the median point after the best similarity, over the points' extent, for a noise of 1 px.

    Of some points X: with the response J = dX / d(lens, poses), cov X = J C J^T + diag(V^-1), less the components along
    translation, rotation and scale of all of them.
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
    J = equations.response_of_points()[known].reshape(-1, sizes.eliminated)
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
    """(m, 3) the observed points in coordinates of the cameras that observe them."""
    R, X = state.T[tracks.image, :3, :3], state.X[tracks.point]
    return np.asarray((R @ X[:, :, None])[:, :, 0] + state.T[tracks.image, :3, 3])


def reprojection_errors(state: Views, tracks: Tracks) -> Array:
    """(m, 2) projected less seen, pixels; NaN behind the camera."""
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
    """The sum of the loss over all observations, with the lens's parameters `columns` and the images `is_free` free;
    infinite with a point behind a camera."""
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
    root = np.sqrt(np.maximum(z, 1.0))
    return np.where(z <= 1, z, 2 * root - 1), 1 / root


def _soft_l1(z: Array) -> tuple[Array, Array]:
    root = np.sqrt(1 + z)
    return 2 * (root - 1), 1 / root


LOSSES = {
    "linear": lambda z: (z, np.ones_like(z)),
    "huber": _huber,
    "soft_l1": _soft_l1,
    "cauchy": lambda z: (np.log1p(z), 1 / (1 + z)),
}
"""rho and its derivative at z = (d / scale)^2."""


def _noise(residuals: Array, loss: str, freedom: int) -> float:
    """Standard deviation of a coordinate: by the sum of squares, or for robust losses by the median of the absolute
    values, each over the degrees of freedom; NaN if there are none."""
    if freedom <= 0:
        return float("nan")
    if loss == "linear":
        return float(np.sqrt((residuals**2).sum() / freedom))
    return float(1.4826 * np.median(np.abs(residuals)) * np.sqrt(residuals.size / freedom))


def _in_gauge(start: Array, T: Array, X: Array, held: list[int], shared: int) -> tuple[Array, Array, Array]:
    """Poses and points moved and scaled into the gauge of the start, and the rows (q, k) that a step in it obeys."""
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
