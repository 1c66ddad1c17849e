# SPDX-License-Identifier: Apache-2.0
"""Rigid motion over time: pose tracks, and the objects that follow them."""

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
"""Velocity in m/s, or rotation rate in rad/s; the bounds exclude numbers that were given in a wrong unit."""


class Track(Named, ABC):
    """Rigid motion: a world transform T(t) that is applied to an object as it stands in the scene file.

    The identity means that the object is at rest. A point x of the object (world) is at T(t) x at time t.
    Subclasses are frozen dataclasses.
    """

    known: ClassVar[dict[str, type[Any]]] = {}
    type_name: ClassVar[str]
    """Name in configuration files."""

    @abstractmethod
    def at(self, time_s: float) -> Array:
        """World transform at a time in seconds: (4, 4) float64, rigid, metres."""

    def poses_at(self, times_s: ArrayLike) -> Array:
        """World transforms at times (n,) in seconds: (n, 4, 4) float64, rigid, metres."""
        return np.array([self.at(float(time_s)) for time_s in np.asarray(times_s)]).reshape(-1, 4, 4)


@dataclass(frozen=True, eq=False)
class PoseTrack(Track):
    """Motion that is given by poses at some times.

    Between two times, translation is interpolated linearly and rotation by slerp. Before the first time and after the
    last, the object stands still.

    Parameters
    ----------
    times_s : (n,) float64, seconds, increasing.
    poses : (n, 4, 4) float64, rigid world transforms T(t), metres; the identity is the place in the scene file.

    Raises
    ------
    ValueError
        Shapes that do not fit, times that do not increase, or a pose that is not rigid.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.motion import PoseTrack
    >>> there = np.eye(4)
    >>> there[0, 3] = 0.2
    >>> track = PoseTrack(times_s=[0.0, 1.0], poses=[np.eye(4), there])
    >>> track.at(0.25)[:3, 3].tolist()
    [0.05, 0.0, 0.0]

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
        return np.asarray(self.poses_at([time_s])[0])

    def poses_at(self, times_s: ArrayLike) -> Array:
        from scipy.spatial.transform import Rotation, Slerp

        times = np.clip(np.asarray(times_s, dtype=np.float64), self.times_s[0], self.times_s[-1])
        result = np.tile(np.eye(4), (len(times), 1, 1))
        for i in range(3):
            result[:, i, 3] = np.interp(times, self.times_s, self.poses[:, i, 3])
        rotations = Rotation.from_matrix(self.poses[:, :3, :3])
        one = len(self.times_s) == 1
        result[:, :3, :3] = rotations.as_matrix() if one else Slerp(self.times_s, rotations)(times).as_matrix()
        return result


@dataclass(frozen=True)
class ConstantTwist(Track):
    """Motion of constant velocity and rotation rate, without end; at time 0 the object is where the scene file has it.

    Parameters
    ----------
    velocity_m_s : (vx, vy, vz), metres per second, world.
    rotation_rad_s : (wx, wy, wz), rotation vector per second, radians per second, world.
    centre_m : (x, y, z), metres, world, a point on the axis of rotation at time 0; it moves with the velocity.

    Raises
    ------
    ValueError
        A number out of its range.

    Examples
    --------
    >>> from rangesim.motion import ConstantTwist
    >>> ConstantTwist(velocity_m_s=(0.3, 0.0, 0.0)).at(2.0)[:3, 3].tolist()
    [0.6, 0.0, 0.0]
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
        return np.asarray(self.poses_at([time_s])[0])

    def poses_at(self, times_s: ArrayLike) -> Array:
        from scipy.spatial.transform import Rotation

        times = np.asarray(times_s, dtype=np.float64)
        result = np.tile(np.eye(4), (len(times), 1, 1))
        result[:, :3, :3] = Rotation.from_rotvec(np.multiply.outer(times, self.rotation_rad_s)).as_matrix()
        centre = np.asarray(self.centre_m)
        result[:, :3, 3] = centre - result[:, :3, :3] @ centre + np.multiply.outer(times, self.velocity_m_s)
        return result


class Poses(NamedTuple):
    """Places of everything that moves, at one time.

    objects : shape name -> (4, 4) float64, world transform T(t) of the object.
    rig : (4, 4) float64, world transform T(t) of camera and emitter.
    """

    objects: dict[str, Array]
    rig: Array

    @property
    def key(self) -> bytes:
        """Bytes that are equal for equal places."""
        return b"".join((T + 0.0).tobytes() for T in (*self.objects.values(), self.rig))  # + 0.0: -0.0 becomes 0.0

    def place(self, rig: Rig) -> Array:
        """T_world_camera of a rig at this time: (4, 4) float64. The rig is given without motion."""
        return np.array(rig.T_world_camera) if np.array_equal(self.rig, np.eye(4)) else self.rig @ rig.T_world_camera


@dataclass(frozen=True)
class Motion:
    """Tracks of all objects that move, and of the rig.

    Parameters
    ----------
    objects : shape name (id in the scene file) -> Track.
    rig : Track of camera and emitter together; None: they stand still. As for objects, it is a world transform that is
        applied to the rig as it stands: T_world_camera(t) = T(t) @ rig.T_world_camera. So moving the rig by T is the
        same as moving all objects by the inverse of T. A recorded camera trajectory (n, 4, 4) becomes a track by
        `PoseTrack(times_s, trajectory @ np.linalg.inv(rig.T_world_camera))`.

    Raises
    ------
    ValueError
        `objects` is no mapping, or a track is no `Track`.

    Examples
    --------
    >>> from rangesim.motion import ConstantTwist, Motion
    >>> motion = Motion({"large_ball": ConstantTwist(velocity_m_s=(0.3, 0.0, 0.0))})
    >>> poses = motion.at(0.1)
    >>> poses.objects["large_ball"][:3, 3].round(3).tolist(), poses.rig[:3, 3].tolist()
    ([0.03, 0.0, 0.0], [0.0, 0.0, 0.0])
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
        """Raise ValueError if an object that moves is not among these shapes."""
        valid = list(names)
        for name in self.objects:
            if name not in valid:
                raise ValueError(
                    f"expected moving objects out of {', '.join(valid)}, got {name!r}{nearest(name, valid)}."
                )

    def at(self, time_s: float) -> Poses:
        """Places of everything that moves, at a time in seconds."""
        rig = np.eye(4) if self.rig is None else self.rig.at(time_s)
        return Poses({name: track.at(time_s) for name, track in self.objects.items()}, rig)


def apply(T: ArrayLike, points: np.ndarray) -> np.ndarray:
    """Points (..., 3) after a rigid transform (4, 4), in the unit of the points."""
    matrix = np.asarray(T)
    return np.asarray(points @ matrix[:3, :3].T + matrix[:3, 3])


# ---- Motion as plain data, as in experiment files --------------------------------------------------------


def motion_from_dict(data: Any, place: str = "motion") -> Motion:
    """Motion from plain data, as experiment files have it.

    The data is a table with the keys `objects`, a track for each shape name, and `rig`, a track. Both may be left out.
    A track is a table with a `type`: "constant-twist" (`ConstantTwist`) or "poses" (`PoseTrack`).

    place : name of the table, for messages.

    Raises
    ------
    ValueError
        Unknown keys or types of track, or values that a track refuses; the message names the place in the data.
    """
    if not isinstance(data, Mapping) or not isinstance(data.get("objects", {}), Mapping):
        raise ValueError(f"{place}: expected a table of settings, got {shown(data)}.")
    check_keys(data, ("objects", "rig"), place)
    read = partial(from_dict, Track)  # type: ignore[type-abstract]
    objects = {name: read(table, f"{place}.objects.{name}") for name, table in data.get("objects", {}).items()}
    rig = data.get("rig")
    return Motion(objects, None if rig is None else read(rig, f"{place}.rig"))
