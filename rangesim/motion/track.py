# SPDX-License-Identifier: Apache-2.0
"""Where things are at a time: pose tracks, and which object follows which."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rangesim.rig import Array, Rig, pose
from rangesim.settings.bounds import Bounds, Coordinate, check_fields
from rangesim.settings.config import Named, check_keys, from_dict, nearest, shown, to_dict

Rate = Annotated[float, Bounds("a rate per second", -1e6, 1e6)]


class Track(Named, ABC):
    """A rigid motion: a world transform T(t), applied to a thing as it stands in the scene file.

    The identity means at rest. A world point x of the thing is at T(t) x at time t. Subclasses are frozen dataclasses.
    """

    known: ClassVar[dict[str, type[Any]]] = {}
    type_name: ClassVar[str]
    """Name in configuration files."""

    @abstractmethod
    def at(self, time_s: float) -> Array:
        """(4, 4) float64, rigid, the world transform at a time in seconds."""


@dataclass(frozen=True, eq=False)
class PoseTrack(Track):
    """A motion given at some times; between them linear in translation and in angle (slerp), constant beyond the ends.

    Parameters
    ----------
    times_s : (n,) float64, seconds, increasing.
    poses : (n, 4, 4) float64, rigid world transforms T(t), metres; the identity is the place in the scene file.

    Raises
    ------
    ValueError
        Shapes that do not fit, times that do not increase, or a pose that is not rigid.

    References
    ----------
    Shoemake: "Animating rotation with quaternion curves", SIGGRAPH (1985).
    """

    times_s: np.ndarray
    poses: np.ndarray

    type_name: ClassVar[str] = "poses"

    def __post_init__(self) -> None:
        try:
            times, poses = np.array(self.times_s, dtype=np.float64), np.array(self.poses, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            raise ValueError(
                f"expected times and poses of numbers, got {shown(self.times_s)} and {shown(self.poses)}."
            ) from None
        if times.ndim != 1 or len(times) == 0 or poses.shape != (len(times), 4, 4):
            raise ValueError(
                f"expected times (n,) and as many poses (n, 4, 4), got shapes {times.shape} and {poses.shape}."
            )
        if not np.isfinite(times).all() or (np.diff(times) <= 0).any():
            raise ValueError(f"expected times that increase, in seconds, got {shown(times.tolist())}.")
        poses = np.stack([pose(p, f"pose {i} of the track") for i, p in enumerate(poses)])
        for name, value in (("times_s", times), ("poses", poses)):
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, PoseTrack) and to_dict(self) == to_dict(other)

    def __hash__(self) -> int:
        return hash((self.times_s.tobytes(), self.poses.tobytes()))

    def at(self, time_s: float) -> Array:
        from scipy.spatial.transform import Rotation, Slerp

        time = float(np.clip(time_s, self.times_s[0], self.times_s[-1]))
        result = np.eye(4)
        result[:3, 3] = [np.interp(time, self.times_s, self.poses[:, i, 3]) for i in range(3)]
        rotations = Rotation.from_matrix(self.poses[:, :3, :3])
        result[:3, :3] = (rotations[0] if len(self.times_s) == 1 else Slerp(self.times_s, rotations)(time)).as_matrix()
        return result


@dataclass(frozen=True)
class ConstantTwist(Track):
    """A motion of constant velocity and rotation rate, without end; at its place in the scene file at time 0.

    Parameters
    ----------
    velocity_m_s : (vx, vy, vz), metres per second, world.
    rotation_rad_s : (wx, wy, wz), radians per second about these world axes (a rotation vector per second).
    centre_m : (x, y, z), metres, world, a point of the axis of rotation at time 0; it moves with the velocity.
    """

    velocity_m_s: tuple[Rate, Rate, Rate] = (0.0, 0.0, 0.0)
    rotation_rad_s: tuple[Rate, Rate, Rate] = (0.0, 0.0, 0.0)
    centre_m: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.0)

    type_name: ClassVar[str] = "constant-twist"

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("velocity_m_s", "rotation_rad_s", "centre_m"):
            object.__setattr__(self, name, tuple(map(float, getattr(self, name))))

    def at(self, time_s: float) -> Array:
        from scipy.spatial.transform import Rotation

        result = np.eye(4)
        result[:3, :3] = Rotation.from_rotvec(np.multiply(self.rotation_rad_s, time_s)).as_matrix()
        centre = np.asarray(self.centre_m)
        result[:3, 3] = centre - result[:3, :3] @ centre + np.multiply(self.velocity_m_s, time_s)
        return result


class Poses(NamedTuple):
    """Where everything that moves is at one time.

    objects : shape name -> (4, 4) world transform. rig : (4, 4) world transform of camera and projector.
    """

    objects: dict[str, Array]
    rig: Array

    @property
    def key(self) -> bytes:
        """Equal for equal placements."""
        return b"".join((T + 0.0).tobytes() for T in (*self.objects.values(), self.rig))  # + 0.0: -0.0 becomes 0.0

    def place(self, rig: Rig) -> Array:
        """(4, 4) T_world_camera of a rig that moves."""
        return np.array(rig.T_world_camera) if np.array_equal(self.rig, np.eye(4)) else self.rig @ rig.T_world_camera


@dataclass(frozen=True)
class Motion:
    """What moves, and how.

    Parameters
    ----------
    objects : shape name (id in the scene file) -> Track.
    rig : Track of camera and projector together, or None: they stand. Like that of an object it is a world
        transform of the rig as it stands: T_world_camera(t) = T(t) @ rig.T_world_camera. Hence moving the rig by T is
        the same as moving all objects by the inverse of T. A recorded camera trajectory (n, 4, 4) becomes a track as
        `PoseTrack(times_s, trajectory @ np.linalg.inv(rig.T_world_camera))`.
    """

    objects: Mapping[str, Track] = field(default_factory=dict)
    rig: Track | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.objects, Mapping):
            raise ValueError(f"expected objects to map shape names to tracks, got {shown(self.objects)}.")
        for what, track in (*self.objects.items(), *((("rig", self.rig),) if self.rig is not None else ())):
            if not isinstance(track, Track):
                raise ValueError(f"expected a PoseTrack or a ConstantTwist for {what!r}, got {shown(track)}.")

    def check(self, names: Iterable[str]) -> None:
        """Raise ValueError if an object that moves is none of these shapes."""
        valid = list(names)
        for name in self.objects:
            if name not in valid:
                raise ValueError(
                    f"expected moving objects out of {', '.join(valid)}, got {name!r}{nearest(name, valid)}."
                )

    def at(self, time_s: float) -> Poses:
        """Where everything that moves is at a time in seconds."""
        rig = np.eye(4) if self.rig is None else self.rig.at(time_s)
        return Poses({name: track.at(time_s) for name, track in self.objects.items()}, rig)


def apply(T: ArrayLike, points: np.ndarray) -> np.ndarray:
    """Points (..., 3) under a rigid transform (4, 4)."""
    matrix = np.asarray(T)
    return np.asarray(points @ matrix[:3, :3].T + matrix[:3, 3])


# ---- Motion as plain data, as in experiment files --------------------------------------------------------


def motion_from_dict(data: Any, place: str = "motion") -> Motion:
    """The motion of a table `objects`, a track for each shape name, and a track `rig`; both may be left out.

    A track is a table with a `type`: "constant-twist" (`ConstantTwist`) or "poses" (`PoseTrack`).

    Raises
    ------
    ValueError
        Unknown keys or kinds of track, or values that a track refuses; the message names the place.
    """
    if not isinstance(data, Mapping) or not isinstance(data.get("objects", {}), Mapping):
        raise ValueError(f"{place}: expected a table of settings, got {shown(data)}.")
    check_keys(data, ("objects", "rig"), place)
    read = partial(from_dict, Track)  # type: ignore[type-abstract]
    objects = {name: read(table, f"{place}.objects.{name}") for name, table in data.get("objects", {}).items()}
    rig = data.get("rig")
    return Motion(objects, None if rig is None else read(rig, f"{place}.rig"))
