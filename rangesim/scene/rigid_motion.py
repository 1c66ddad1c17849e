# SPDX-License-Identifier: Apache-2.0
"""A scene with some of its shapes moved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np

from rangesim.scene.scene import Scene


class MovingScene:
    """A scene whose shapes can be moved to other poses.

    The original scene is never changed: a copy, loaded from the same source, is moved. Moving shapes of the original
    and putting them back would not restore it, because Mitsuba rounds differently when a `to_world` changes than when
    the shape is made; the same seed would then give other bytes.

    Parameters
    ----------
    scene : Scene, as `load_scene` returns it.
    names : names of the shapes that will move.

    Raises
    ------
    ValueError
        A shape is of a kind that cannot be moved (curves).
    """

    def __init__(self, scene: Scene, names: tuple[str, ...]) -> None:
        self.scene = scene
        self.names = names
        self._moved: Scene | None = None
        self._parameters: Any = None
        self._rest: dict[str, np.ndarray] = {}
        parameters = mi.traverse(scene.mitsuba)
        for name in names:
            if not ({f"{name}.to_world", f"{name}.vertex_positions"} & set(parameters.keys())):
                (shape,) = (s for s in scene.mitsuba.shapes() if s.id() == name)
                raise ValueError(f"expected a mesh or a shape with a to_world, but {name!r} is a {shape.class_name()}.")

    def at(self, transforms: Mapping[str, np.ndarray]) -> Scene:
        """The scene with some shapes moved.

        The next call moves the same copy again, so finish your work with the returned scene before the next call.

        Parameters
        ----------
        transforms : rigid world transforms (4, 4), metres, by name of shape; each applies to the shape as it stands in
            the scene file. Other shapes stay where they are. If all transforms are the identity, the original scene is
            returned.

        Raises
        ------
        ValueError
            The scene cannot be loaded again.
        """
        if all(np.array_equal(T, np.eye(4)) for T in transforms.values()):
            return self.scene
        moved = self._moved or self._load()
        normals = {}
        for name in self.names:
            T = self.scene.motion_in_renderer(np.asarray(transforms.get(name, np.eye(4))))
            if f"{name}.to_world" in self._rest:
                pose = np.float32(T @ self._rest[f"{name}.to_world"])
                self._parameters[f"{name}.to_world"] = mi.AffineTransform4f(pose)
                continue
            points = self._rest[f"{name}.vertex_positions"] @ T[:3, :3].T + T[:3, 3]
            self._parameters[f"{name}.vertex_positions"] = mi.Float(np.float32(points).ravel())
            normals[f"{name}.vertex_normals"] = self._rest[f"{name}.vertex_normals"] @ T[:3, :3].T
        self._parameters.update()
        # Mitsuba has just computed new normals from the vertices, so those of the file are put back
        for key, directions in normals.items():
            if directions.size:
                self._parameters[key] = mi.Float(np.float32(directions).ravel())
        self._parameters.update()
        return moved

    def _load(self) -> Scene:
        if self.scene.reload is None:
            raise ValueError("expected a scene that load_scene has made: to move its shapes, it is loaded again.")
        self._moved = replace(self.scene, mitsuba=self.scene.reload())
        self._parameters = mi.traverse(self._moved.mitsuba)
        for name in self.names:
            if f"{name}.to_world" in self._parameters:
                matrix = np.array(self._parameters[f"{name}.to_world"].matrix, dtype=np.float64)
                self._rest[f"{name}.to_world"] = matrix.reshape(4, 4)
                continue
            for key in (f"{name}.vertex_positions", f"{name}.vertex_normals"):
                self._rest[key] = np.array(self._parameters[key], dtype=np.float64).reshape(-1, 3)
        return self._moved
