# SPDX-License-Identifier: Apache-2.0
"""A scene whose shapes stand elsewhere than in its file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np

from rangesim.scene.scene import Scene


class MovingScene:
    """Shapes of a scene at other poses.

    The scene itself is never touched: a second one, loaded from the same source, is moved and thrown away.
    Putting shapes back would not do, because Mitsuba derives a shape's data from `to_world` with other roundings
    when it changes than when the shape is made, and the same seed would no longer give the same bytes.

    Parameters
    ----------
    scene : Scene, as `load_scene` returns it.
    names : the shapes that will move.

    Raises
    ------
    ValueError
        A shape of a kind that cannot be moved (curves).
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
                raise ValueError(f"expected a mesh or a shape with a pose, but {name!r} is a {shape.class_name()}.")

    def at(self, transforms: Mapping[str, np.ndarray]) -> Scene:
        """The scene with `transforms` (4, 4), rigid, world, applied to shapes as they stand in the scene file.

        Shapes that are not named stand where the file has them; if all do, this is the scene itself. The next call
        moves the returned scene on.
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
        # Mitsuba has just made new normals of the vertices; those of the file were perhaps smoother
        for key, directions in normals.items():
            if directions.size:
                self._parameters[key] = mi.Float(np.float32(directions).ravel())
        self._parameters.update()
        return moved

    def _load(self) -> Scene:
        if self.scene.reload is None:
            raise ValueError("expected a scene of load_scene, which can be loaded again, to move shapes in.")
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
