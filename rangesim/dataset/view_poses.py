# SPDX-License-Identifier: Apache-2.0
"""Poses of the camera: on a shell around the objects, or along the path of a robot."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np

from rangesim.experiment.camera_paths import CameraPath
from rangesim.rig import look_at
from rangesim.settings.bounds import Bounds, check_fields
from rangesim.settings.config import Named
from rangesim.settings.draws import Draw, Of, check_draws, drawn

DISTANCE = Bounds("a distance in metres", 1e-3, 1e3)
"""Bounds of the distance from the camera to what it looks at, metres."""
ELEVATION = Bounds("degrees above the horizon", -89, 90)
"""Bounds of the camera's elevation, degrees; from 90 it looks straight down."""
ANGLE = Bounds("degrees", -360, 360)
"""Bounds of azimuth and roll, degrees: a full turn either way."""
OFFSET = Bounds("an offset in metres", -100, 100)
"""Bounds of the offset of the aim, metres."""


class View(Named, ABC):
    """Base of the ways in which a camera's pose is drawn. Subclasses are frozen dataclasses."""

    known: ClassVar[dict[str, type[Any]]] = {}

    @abstractmethod
    def pose(self, centre_m: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, dict[str, Any]]:
        """A random pose of the camera.

        Parameters
        ----------
        centre_m : (3,) float64, middle of the objects, metres, world.

        Returns
        -------
        T_world_camera : (4, 4) float64, metres. values : all that was drawn.
        """


@dataclass(frozen=True)
class Shell(View):
    """Cameras on a shell around the middle of the objects, which look at it.

    distance_m : from camera to aim, metres. elevation_deg : above the horizon. azimuth_deg : from x towards y.
    roll_deg : turn about the direction of view. offset_m : of the aim along x, y and z, each drawn for itself.

    Examples
    --------
    >>> view = Shell(distance_m=2, elevation_deg=90, roll_deg=0, offset_m=0)
    >>> view.pose(np.zeros(3), np.random.default_rng(0))[0][:3, 3].round(6) + 0.0
    array([0., 0., 2.])
    """

    distance_m: Annotated[Draw, Of(float, DISTANCE)] = Draw.of({"uniform": [0.6, 1.0]})
    elevation_deg: Annotated[Draw, Of(float, ELEVATION)] = Draw.of({"uniform": [40.0, 85.0]})
    azimuth_deg: Annotated[Draw, Of(float, ANGLE)] = Draw.of({"uniform": [0.0, 360.0]})
    roll_deg: Annotated[Draw, Of(float, ANGLE)] = Draw.of({"normal": [0.0, 5.0]})
    offset_m: Annotated[Draw, Of(float, OFFSET)] = Draw.of({"normal": [0.0, 0.02]})

    type_name: ClassVar[str] = "shell"

    def __post_init__(self) -> None:
        check_draws(self)

    def pose(self, centre_m: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, dict[str, Any]]:
        values = drawn(self, random)
        offset = [values["offset_m"], *(self.offset_m.value(random, Of(float, OFFSET)) for _ in range(2))]
        elevation, azimuth, roll = (np.radians(values[f"{name}_deg"]) for name in ("elevation", "azimuth", "roll"))
        away = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        # of a camera on the shell, the direction to higher elevations is upwards in the image
        up = np.array([-np.sin(elevation) * np.cos(azimuth), -np.sin(elevation) * np.sin(azimuth), np.cos(elevation)])
        aim = centre_m + offset
        T = look_at(aim + values["distance_m"] * away, aim, up)
        turn = np.eye(4)
        turn[:2, :2] = [[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]]
        return T @ turn, {**values, "offset_m": offset}


@dataclass(frozen=True)
class Path(View):
    """Poses of a robot, as a list or along a path: each scene has one of them, each as likely.

    path : CameraPath; centre, distance and elevation must be stated where it has them.
    """

    path: CameraPath

    type_name: ClassVar[str] = "path"

    def __post_init__(self) -> None:
        check_fields(self)
        self.path.poses()  # a path that leaves its place open is refused

    def pose(self, centre_m: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, dict[str, Any]]:
        poses = self.path.poses()
        number = int(random.integers(len(poses)))
        return poses[number], {"pose": number}
