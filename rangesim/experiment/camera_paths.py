# SPDX-License-Identifier: Apache-2.0
"""Camera paths of a scan: turntable, dome, hand-held, or a list of poses. The z axis of the world points up.

A new path is a subclass of `CameraPath` with a `type_name`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np

from rangesim.rig import Array, look_at, pose
from rangesim.settings import limits
from rangesim.settings.bounds import Bounds, Coordinate, Metres, check_fields, whole
from rangesim.settings.config import Named, shown, to_dict
from rangesim.settings.seeds import check_seed

Views = Annotated[int, whole(1, "passes")]
"""Number of views. The limit `passes` (docs/limits.md) holds for it, because each view is a light-transport pass."""
Elevation = Annotated[float, Bounds("degrees above the horizon", -89, 89)]
"""Elevation of a camera, degrees above the horizon. It excludes 90, because there the direction up is not defined."""
Degrees = Annotated[float, Bounds("degrees", -360, 360)]
"""Azimuth, or difference of azimuths, in degrees. A full turn either way is enough, because beyond it the azimuths
repeat."""
GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
"""Difference of azimuth between two views of a dome, radians. With this step the views cover a sphere evenly, because
no small number of steps comes close to a full turn."""
SWINGS = 3
"""Number of sine waves whose sum moves the hand along one direction. More waves make the motion less regular; its
standard deviation stays the same, because the sum is divided by the root of this number."""
MAX_ELEVATION_DEG = 85.0
"""Largest elevation that a path takes from a scene's camera, or that a hand-held path reaches, degrees. A camera that
looks straight down has no direction up, so paths stay at least five degrees away from the vertical."""


class Viewpoint(NamedTuple):
    """Pose of a scene's camera, and its distance to the point that it looks at.

    If a path's own centre, distance or elevation is None, the path takes it from here.

    T_world_camera : (4, 4) float64, maps camera coordinates to world coordinates, metres.
    distance_m : metres along the camera's axis.

    Examples
    --------
    >>> from rangesim.rig import look_at
    >>> viewpoint = Viewpoint(look_at((0, -1, 1), (0, 0, 0)), distance_m=2**0.5)
    >>> viewpoint.centre_m.round(6) + 0.0
    array([0., 0., 0.])
    >>> round(viewpoint.elevation_deg)
    45
    """

    T_world_camera: Array
    distance_m: float

    @property
    def centre_m(self) -> Array:
        """Point that the camera looks at, (3,) float64, metres, world coordinates."""
        return np.asarray(self.T_world_camera[:3, 3] + self.distance_m * self.T_world_camera[:3, 2])

    @property
    def elevation_deg(self) -> float:
        """Elevation of the camera seen from the point that it looks at, degrees above the horizon."""
        return float(np.degrees(np.arcsin(np.clip(-self.T_world_camera[2, 2], -1, 1))))


class CameraPath(Named, ABC):
    """A sequence of poses of a rig's camera, one per view. Subclasses are frozen dataclasses."""

    known: ClassVar[dict[str, type[Any]]] = {}
    type_name: ClassVar[str]
    """Name in configuration files."""

    @abstractmethod
    def poses(self, viewpoint: Viewpoint | None = None) -> Array:
        """T_world_camera of each view, (n, 4, 4) float64, metres.

        Parameters
        ----------
        viewpoint : Viewpoint, gives centre, distance and elevation where the path does not state them.

        Raises
        ------
        ValueError
            The path needs a viewpoint, and none is given.
        """


@dataclass(frozen=True)
class Turntable(CameraPath):
    """Views on a circle about a vertical axis, all looking at its centre.

    This is how a fixed rig sees an object on a turntable.

    Parameters
    ----------
    views : number of views, at equal steps over `sweep_deg`. In a full turn the last view is one step before the first.
    centre_m : (x, y, z) of the point that the views look at, metres, world coordinates.
    distance_m : metres from the camera to that point.
    elevation_deg : degrees of the camera above the horizon.
    start_deg : azimuth of the first view, degrees, counted from x towards y.
    sweep_deg : difference of azimuth between the first and the last view, degrees; 360 for a full turn.

    Where `centre_m`, `distance_m` or `elevation_deg` is None, the value of the scene's camera is taken.

    Examples
    --------
    >>> path = Turntable(views=4, centre_m=(0, 0, 0), distance_m=1, elevation_deg=0)
    >>> path.poses()[:, :3, 3].round(6) + 0.0  # places of the cameras
    array([[ 0., -1.,  0.],
           [ 1.,  0.,  0.],
           [ 0.,  1.,  0.],
           [-1.,  0.,  0.]])
    """

    views: Views = 12
    centre_m: tuple[Coordinate, Coordinate, Coordinate] | None = None
    distance_m: Metres | None = None
    elevation_deg: Elevation | None = None
    start_deg: Degrees = -90.0
    sweep_deg: Degrees = 360.0

    type_name: ClassVar[str] = "turntable"

    def __post_init__(self) -> None:
        check_fields(self)

    def poses(self, viewpoint: Viewpoint | None = None) -> Array:
        centre, distance_m = _place(self.centre_m, self.distance_m, viewpoint)
        elevation = np.radians(_elevation(self.elevation_deg, viewpoint))
        steps = self.views if abs(self.sweep_deg) == 360 else max(1, self.views - 1)
        azimuths = np.radians(self.start_deg + self.sweep_deg * np.arange(self.views) / steps)
        return _looking_in(azimuths, np.full(self.views, elevation), distance_m, centre)


@dataclass(frozen=True)
class Dome(CameraPath):
    """Views spread evenly over a zone of a sphere, all looking at its centre.

    The views form a Fibonacci lattice: heights increase in equal steps, azimuths in steps of the golden angle
    (Gonzalez: "Measurement of areas on a sphere using Fibonacci and latitude-longitude lattices", 2010).

    Parameters
    ----------
    views : number of views.
    centre_m, distance_m : as for `Turntable`.
    lowest_deg, highest_deg : the zone's lowest and highest elevation, degrees above the horizon.

    Examples
    --------
    >>> path = Dome(views=100, centre_m=(0, 0, 0), distance_m=2, lowest_deg=0, highest_deg=60)
    >>> heights_m = path.poses()[:, 2, 3]
    >>> bool(heights_m.min() > 0), bool(heights_m.max() < 2 * np.sin(np.radians(60)))
    (True, True)
    """

    views: Views = 24
    centre_m: tuple[Coordinate, Coordinate, Coordinate] | None = None
    distance_m: Metres | None = None
    lowest_deg: Elevation = 10.0
    highest_deg: Elevation = 80.0

    type_name: ClassVar[str] = "dome"

    def __post_init__(self) -> None:
        check_fields(self)
        if not self.lowest_deg < self.highest_deg:
            raise ValueError(
                f"expected lowest_deg below highest_deg, got {self.lowest_deg:g} and {self.highest_deg:g} degrees."
            )

    def poses(self, viewpoint: Viewpoint | None = None) -> Array:
        centre, distance_m = _place(self.centre_m, self.distance_m, viewpoint)
        low, high = np.sin(np.radians([self.lowest_deg, self.highest_deg]))
        k = np.arange(self.views)
        heights = low + (high - low) * (k + 0.5) / self.views
        return _looking_in(GOLDEN_ANGLE * k, np.arcsin(heights), distance_m, centre)


@dataclass(frozen=True)
class HandHeld(CameraPath):
    """Views of a sensor that a person carries around an object, with the small motions of a hand.

    The camera goes around once and its elevation rises and falls once. Position, aim and roll swing about this path:
    each is a random sum of three sine waves. The swing is smooth, so that neighbouring views are near each other.

    Parameters
    ----------
    views : number of views, over `sweep_deg` of azimuth.
    centre_m, distance_m, elevation_deg, start_deg, sweep_deg : as for `Turntable`.
    rise_deg : degrees by which the elevation rises above and falls below `elevation_deg`.
    shake_m : standard deviation of the position along each axis, metres.
    shake_deg : standard deviation of aim and roll, degrees.
    seed : seed of the random motions, 0 to 2^64 - 1. The same seed gives the same poses.

    Examples
    --------
    >>> steady = HandHeld(views=8, centre_m=(0, 0, 0), distance_m=1, elevation_deg=30, shake_m=0, shake_deg=0)
    >>> shaken = HandHeld(views=8, centre_m=(0, 0, 0), distance_m=1, elevation_deg=30)
    >>> moved_m = (shaken.poses() - steady.poses())[:, :3, 3]
    >>> bool(abs(moved_m).max() < 0.05)
    True
    """

    views: Views = 24
    centre_m: tuple[Coordinate, Coordinate, Coordinate] | None = None
    distance_m: Metres | None = None
    elevation_deg: Elevation | None = None
    rise_deg: Annotated[float, Bounds("degrees", -60, 60)] = 15.0
    start_deg: Degrees = -90.0
    sweep_deg: Degrees = 360.0
    shake_m: Annotated[float, Bounds("0 or positive", 1e-9, 1e3, or_zero=True)] = 0.01
    shake_deg: Annotated[float, Bounds("0 or positive", 1e-9, 20, or_zero=True)] = 1.5
    seed: int = 0

    type_name: ClassVar[str] = "hand-held"

    def __post_init__(self) -> None:
        check_fields(self)
        check_seed(self.seed)

    def poses(self, viewpoint: Viewpoint | None = None) -> Array:
        from scipy.spatial.transform import Rotation

        centre, distance_m = _place(self.centre_m, self.distance_m, viewpoint)
        elevation = _elevation(self.elevation_deg, viewpoint)
        s = np.arange(self.views) / max(1, self.views - 1)
        azimuths = np.radians(self.start_deg + self.sweep_deg * s)
        risen = elevation + self.rise_deg * np.sin(2 * np.pi * s)
        elevations = np.radians(np.clip(risen, -MAX_ELEVATION_DEG, MAX_ELEVATION_DEG))
        result = _looking_in(azimuths, elevations, distance_m, centre)
        random = np.random.default_rng(self.seed)
        frequency, phase = random.uniform(1, 4, (2, 3, SWINGS)), random.uniform(0, 2 * np.pi, (2, 3, SWINGS))
        swing = np.sin(2 * np.pi * frequency * s[:, None, None, None] + phase).sum(axis=-1) * np.sqrt(2 / SWINGS)
        result[:, :3, 3] += self.shake_m * swing[:, 0]
        turn = Rotation.from_rotvec(np.radians(self.shake_deg) * swing[:, 1]).as_matrix()
        result[:, :3, :3] = result[:, :3, :3] @ turn
        return result


@dataclass(frozen=True, eq=False)
class PoseList(CameraPath):
    """Views from a list of poses.

    Parameters
    ----------
    matrices : (n, 4, 4) float64, T_world_camera of each view, rigid, metres, OpenCV's axes.

    Raises
    ------
    ValueError
        There is no pose, the array has another shape, or a matrix is not rigid.

    Examples
    --------
    >>> PoseList([np.eye(4), np.eye(4)]).poses().shape
    (2, 4, 4)
    """

    matrices: np.ndarray

    type_name: ClassVar[str] = "poses"

    def __post_init__(self) -> None:
        try:
            matrices: Array = np.array(self.matrices, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            raise ValueError(f"expected poses (n, 4, 4) of numbers, got {shown(self.matrices)}.") from None
        if matrices.ndim != 3 or matrices.shape[1:] != (4, 4) or not len(matrices):
            raise ValueError(f"expected one pose or more, (n, 4, 4), got an array of shape {matrices.shape}.")
        limits.check("passes", len(matrices), "views")
        matrices = np.stack([pose(T, f"pose {i}") for i, T in enumerate(matrices)])
        matrices.setflags(write=False)
        object.__setattr__(self, "matrices", matrices)

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, PoseList) and to_dict(self) == to_dict(other)

    def __hash__(self) -> int:
        return hash(self.matrices.tobytes())

    def poses(self, viewpoint: Viewpoint | None = None) -> Array:
        return np.array(self.matrices)


def _place(
    centre_m: tuple[float, float, float] | None, distance_m: float | None, viewpoint: Viewpoint | None
) -> tuple[Array, float]:
    """Centre (3,) and distance of a path, metres; the viewpoint gives those that are None."""
    if viewpoint is None and (centre_m is None or distance_m is None):
        raise ValueError("expected a path with centre_m and distance_m, or a viewpoint that gives them; got neither.")
    centre = viewpoint.centre_m if centre_m is None else np.asarray(centre_m)  # type: ignore[union-attr]
    return centre, viewpoint.distance_m if distance_m is None else distance_m  # type: ignore[union-attr]


def _elevation(elevation_deg: float | None, viewpoint: Viewpoint | None) -> float:
    """Elevation of a path in degrees; if it is None, that of the viewpoint."""
    if elevation_deg is not None:
        return elevation_deg
    if viewpoint is None:
        raise ValueError("expected a path with elevation_deg, or a viewpoint that gives it; got neither.")
    return float(np.clip(viewpoint.elevation_deg, -MAX_ELEVATION_DEG, MAX_ELEVATION_DEG))


def _looking_in(azimuths: Array, elevations: Array, distance_m: float, centre: Array) -> Array:
    """Poses (n, 4, 4) of cameras on a sphere that look at its centre.

    azimuths, elevations : (n,) radians. distance_m : radius of the sphere, metres. centre : (3,) metres, world.
    """
    across = np.cos(elevations)
    away = np.stack([across * np.cos(azimuths), across * np.sin(azimuths), np.sin(elevations)], axis=-1)
    return np.stack([look_at(centre + distance_m * d, centre) for d in away])
