# SPDX-License-Identifier: Apache-2.0
"""Where a scan's views are taken from: turntable, dome, hand-held, or a list of poses. The world's z is up."""

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
Elevation = Annotated[float, Bounds("degrees above the horizon", -89, 89)]
Degrees = Annotated[float, Bounds("degrees", -360, 360)]
GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
SWINGS = 3
"""Sine waves that a hand's unrest is made of, in each direction."""


class Viewpoint(NamedTuple):
    """Where the camera of a scene stands, which a path takes what it is not told from.

    T_world_camera : (4, 4). distance_m : along its axis, to what it looks at.
    """

    T_world_camera: Array
    distance_m: float

    @property
    def centre_m(self) -> Array:
        """(3,) metres, world, what the camera looks at."""
        return np.asarray(self.T_world_camera[:3, 3] + self.distance_m * self.T_world_camera[:3, 2])

    @property
    def elevation_deg(self) -> float:
        """Degrees of the camera above what it looks at."""
        return float(np.degrees(np.arcsin(np.clip(-self.T_world_camera[2, 2], -1, 1))))


class CameraPath(Named, ABC):
    """Poses of a rig's camera, one for each view. Subclasses are frozen dataclasses."""

    known: ClassVar[dict[str, type[Any]]] = {}
    type_name: ClassVar[str]
    """Name in configuration files."""

    @abstractmethod
    def poses(self, viewpoint: Viewpoint | None = None) -> Array:
        """(n, 4, 4) float64, T_world_camera of each view, metres.

        viewpoint : gives centre, distance and elevation where the path names none; ValueError if there is none either.
        """


@dataclass(frozen=True)
class Turntable(CameraPath):
    """Views on a circle about a vertical axis, all looking at one point: as of a thing that turns before the rig.

    Parameters
    ----------
    views : number of them, evenly over `sweep_deg`; of a full turn the last is one step before the first.
    centre_m : (x, y, z) metres, world, what they look at. distance_m : metres from there. elevation_deg : degrees above
        the horizon. None: as the scene's camera.
    start_deg : azimuth of the first view, degrees from x to y.
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

    Heights are in equal steps, each view the golden angle further on: a Fibonacci lattice (Gonzalez: "Measurement of
    areas on a sphere using Fibonacci and latitude-longitude lattices", 2010).

    Parameters
    ----------
    views : number of them. centre_m, distance_m : as of `Turntable`.
    lowest_deg, highest_deg : degrees above the horizon between which they lie.
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
    """Views along a walk around a thing, up and down once, with the unrest of a hand.

    Position, aim and roll swing about the walk by random sums of three sine waves each; neighbouring views are near
    each other. The same seed gives the same walk.

    Parameters
    ----------
    views : number of them, over `sweep_deg` of azimuth. centre_m, distance_m, elevation_deg : as of `Turntable`.
    rise_deg : degrees that the elevation goes up and down. start_deg : azimuth of the first view.
    shake_m, shake_deg : standard deviation of place along each axis, and of aim and roll.
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
        elevations = np.radians(np.clip(elevation + self.rise_deg * np.sin(2 * np.pi * s), -85, 85))
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
    """Views from given poses.

    matrices : (n, 4, 4) float64, T_world_camera of each, rigid, metres, OpenCV's axes.
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
    if viewpoint is None and (centre_m is None or distance_m is None):
        raise ValueError("expected a path with centre_m and distance_m, as no scene's camera gives them.")
    centre = viewpoint.centre_m if centre_m is None else np.asarray(centre_m)  # type: ignore[union-attr]
    return centre, viewpoint.distance_m if distance_m is None else distance_m  # type: ignore[union-attr]


def _elevation(elevation_deg: float | None, viewpoint: Viewpoint | None) -> float:
    if elevation_deg is not None:
        return elevation_deg
    if viewpoint is None:
        raise ValueError("expected a path with elevation_deg, as no scene's camera gives it.")
    return float(np.clip(viewpoint.elevation_deg, -85, 85))


def _looking_in(azimuths: Array, elevations: Array, distance_m: float, centre: Array) -> Array:
    """(n, 4, 4) poses on a sphere, radians, that look at its centre."""
    across = np.cos(elevations)
    away = np.stack([across * np.cos(azimuths), across * np.sin(azimuths), np.sin(elevations)], axis=-1)
    return np.stack([look_at(centre + distance_m * d, centre) for d in away])
