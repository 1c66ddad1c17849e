# SPDX-License-Identifier: Apache-2.0
"""The renderer's origin: near the camera, so that single precision suffices wherever the scene stands.

The renderer computes in single precision. At 5000 km from the origin, as in the coordinates of a map, neighbouring
numbers are half a metre apart, and already at 50 m Mitsuba starts rays 4.5 mm off the surface that they leave. A scene
file is parsed in double precision, so a translation there moves the camera near the origin before anything is rounded.
If the camera, or what it sees, is near the origin of the file, the coordinates and so the results stay unchanged.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np

from rangesim.errors import FileFormatError, warn

NEAR_M = 10.0
"""Largest coordinate of a camera, in metres, at which the renderer keeps the origin of the file. Mitsuba starts rays
0.09 mm * (1 + c) off a surface with coordinates up to c metres, which is 1 mm here, and rounds coordinates to 1 um. A
larger value would make both coarser; a smaller one would change the coordinates of more scenes."""
AS_FAR = 2.0
"""Smallest ratio of the camera's distance from the origin to its distance from what it sees, at which what it sees
counts as far from the origin too. At 2, what it sees is at least half as far from the origin as the camera."""
COARSE_M = 1e-4
"""Smallest rounding of vertices or places, in metres, that causes a warning: 0.1 mm, because good sensors can measure
so small a distance."""
PLACED_EMITTERS = ("point", "spot", "projector")
"""Types of emitters that stand at a place in the world."""
CAMERAS = ("perspective", "thinlens")
"""Types of sensors that can be the camera."""
ENDS = {"sphere": ("center",), "cylinder": ("p0", "p1")}
"""Properties, by type of shape, that place the shape in addition to its `to_world`."""


def camera_place(state: Any, sensor: int) -> np.ndarray:
    """(3,) float64, metres, world: the place of one of the sensors of a parsed scene.

    It is 0 if the sensor is a loaded object, whose place is not known here.
    """
    node = camera_node(state, sensor)
    return np.zeros(3) if node is None else _matrix(node.props.get("to_world"))[:3, 3]


def camera_node(state: Any, sensor: int) -> Any:
    """The node of sensor number `sensor` of a parsed scene; None if it does not exist or is a loaded object."""
    children = [value for _, value in state.nodes[0].props.items()]
    sensors = [v for v in children if isinstance(v, mi.Sensor) or _type_of(state, v) == mi.ObjectType.Sensor]
    if not 0 <= sensor < len(sensors) or isinstance(sensors[sensor], mi.Sensor):
        return None
    return state.nodes[sensors[sensor].index()]


def is_far(place: np.ndarray) -> bool:
    """Whether the place (3,) of a camera, metres, is farther from the origin than `NEAR_M`."""
    return bool(np.abs(place).max() > NEAR_M)


def move_to_origin(state: Any, origin_m: np.ndarray, label: str) -> None:
    """Subtract `origin_m` (3,), metres, from the places of all nodes of a parsed scene, in double precision.

    Raises
    ------
    FileFormatError
        An emitter, a sensor or a grid of reflectances is a loaded object, which cannot be moved any more.
    """
    if not origin_m.any():
        return
    for node in state.nodes:
        for _, value in node.props.items():
            is_placed = isinstance(value, mi.Emitter) and not _is_infinite(value)
            if isinstance(value, mi.Sensor) or is_placed or (isinstance(value, mi.BSDF) and _has_grid(value)):
                raise FileFormatError(
                    f"expected emitters, sensors and grids of {label} as dictionaries, because its camera is far from "
                    "the origin, got a loaded object; give its dictionary."
                )
        if "position" in node.props and node.type == mi.ObjectType.Emitter:
            node.props["position"] = mi.ScalarPoint3d(*(np.array(node.props["position"]) - origin_m))
        elif "to_world" in node.props or _is_placed(node):
            _move(node, origin_m)


def warn_of_loaded_camera(sensors: Any, sensor: int, place: np.ndarray, label: str) -> None:
    """Warn if the camera is a loaded object far from the origin.

    place : what `camera_place` returned, 0 for a loaded object.
    """
    if not place.any() and 0 <= sensor < len(sensors):
        loaded_at = np.array(sensors[sensor].world_transform().matrix, np.float64).reshape(4, 4)[:3, 3]
        if is_far(loaded_at):
            warn(
                f"{label}: the camera is a loaded object {np.abs(loaded_at).max():.2g} m from the origin, so single "
                "precision rounds what it sees; give it as a dictionary."
            )


class Rounding(NamedTuple):
    """An upper bound on the error that single precision has made in the place of a node.

    error_m : metres. name : id of the node.
    """

    error_m: float
    name: str


def coarsest_mesh(state: Any, scene: Any) -> Rounding | None:
    """The mesh from a file whose vertices near the renderer's origin have the largest rounding; None without such a
    mesh.

    Mitsuba reads vertices in single precision, whatever precision the file has, and before it applies `to_world`.

    Parameters
    ----------
    state : the parsed scene. scene : the mitsuba.Scene made from it.
    """
    nodes = {node.props.id(): node for node in state.nodes if node.type == mi.ObjectType.Shape}
    found = []
    for shape in scene.shapes() if isinstance(scene, mi.Scene) else ():
        node = nodes.get(shape.id())
        if node is not None and shape.is_mesh() and "filename" in node.props:
            T, box = _matrix(node.props.get("to_world")), shape.bbox()
            nearest = np.clip(0, np.array(box.min), np.array(box.max))
            in_file = np.linalg.pinv(T[:3, :3]) @ (nearest - T[:3, 3])
            found.append(Rounding(rounding_of(in_file) * float(np.linalg.norm(T[:3, :3], 2)), shape.id()))
    return max(found, default=None)


def coarsest_transform(state: Any) -> Rounding | None:
    """The `to_world` of a parsed scene that was made in single precision and has the largest rounding.

    None if no rounding is larger than `COARSE_M`. The scene must not have been moved yet. Rotation and scale show which
    precision was used: it was single if all their numbers fit single precision, and some do not fit half precision.
    """
    found = []
    for node in state.nodes:
        T = _matrix(node.props.get("to_world"))
        if rounding_of(T[:3, 3]) <= COARSE_M:  # true of most nodes, which skip the rest
            continue
        with np.errstate(over="ignore"):
            single, half = (T[:3, :3].astype(kind) for kind in (np.float32, np.float16))
        if np.array_equal(single, T[:3, :3]) and not np.array_equal(half, single):
            found.append(Rounding(rounding_of(T[:3, 3]), node.props.id()))
    return max(found, default=None)


def rounding_of(coordinates: np.ndarray) -> float:
    """Largest rounding error of coordinates in single precision, in the unit of the coordinates."""
    return float(2.0**-24 * np.abs(coordinates).max())


def warn_of_coarse_mesh(mesh: Rounding | None, label: str) -> None:
    """Warn if the vertices of a mesh are rounded by more than `COARSE_M`."""
    if mesh is not None and mesh.error_m > COARSE_M:
        warn(
            f"{label}: the vertices of mesh {mesh.name!r} are so far from the origin of its file that single "
            f"precision rounds them by up to {1e3 * mesh.error_m:.2g} mm; subtract an offset in double precision where "
            "the mesh is made, and state the offset in the shape's to_world."
        )


def warn_of_coarse_transform(transform: Rounding | None, label: str) -> None:
    """Warn if a place is rounded by more than `COARSE_M`."""
    if transform is not None and transform.error_m > COARSE_M:
        warn(
            f"{label}: to_world of {transform.name!r} was made in single precision, which rounds its place by up to "
            f"{1e3 * transform.error_m:.2g} mm; make it with mitsuba.ScalarTransform4d."
        )


def _move(node: Any, origin_m: np.ndarray) -> None:
    """Subtract an origin (3,), metres, from the place of one node.

    Mitsuba rounds the ends of a shape (`ENDS`) before it applies `to_world`. Therefore the first end is moved to zero
    and its place goes into `to_world`.
    """
    T = mi.ScalarTransform4d
    to_world = node.props.get("to_world", T())
    ends = [key for key in ENDS.get(node.props.plugin_name(), ()) if key in node.props]
    if ends:
        first = np.array(node.props[ends[0]])
        to_world = to_world @ T().translate(first)
        for key in ends:
            node.props[key] = mi.ScalarPoint3d(*(np.array(node.props[key]) - first))
    node.props["to_world"] = T().translate(-origin_m) @ to_world


def _is_placed(node: Any) -> bool:
    """Whether a node without `to_world` has a place in the world."""
    if node.type == mi.ObjectType.Shape:
        return True
    kinds = {mi.ObjectType.Emitter: PLACED_EMITTERS, mi.ObjectType.Volume: ("gridvolume",)}
    return node.props.plugin_name() in (*kinds.get(node.type, ()), *CAMERAS)


def _is_infinite(emitter: Any) -> bool:
    return bool(mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite))


def _has_grid(bsdf: Any) -> bool:
    """Whether the values of a loaded BSDF depend on the place in the world (a `gridvolume`)."""
    return any(part.class_name() == "GridVolume" for part in mi.traverse(bsdf).hierarchy)


def _type_of(state: Any, value: Any) -> Any:
    return state.nodes[value.index()].type if isinstance(value, mi.Properties.ResolvedReference) else None


def _matrix(transform: Any) -> np.ndarray:
    """(4, 4) float64, the matrix of a transform; the identity for anything that is no transform."""
    if not isinstance(transform, mi.ScalarTransform4d):
        return np.eye(4)
    return np.array(transform.matrix, dtype=np.float64).reshape(4, 4)
