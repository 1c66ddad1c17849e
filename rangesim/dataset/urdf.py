# SPDX-License-Identifier: Apache-2.0
"""Models from URDF files: the visual meshes and primitives of all links, with all joints at zero."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from rangesim.dataset.random_primitives import SIDES, SPHERE_SUBDIVISIONS, box_mesh
from rangesim.errors import FileFormatError
from rangesim.files.text_files import check_xml, read_text
from rangesim.triangle_mesh import TriangleMesh


def read_urdf(path: Path, unit_m: float) -> tuple[TriangleMesh, list[Path]]:
    """The mesh of a URDF file in the coordinates of its root link, metres, and the mesh files that it names.

    unit_m : metres per unit of the whole file; 1 by the standard.

    Raises
    ------
    FileFormatError
        The file is missing or no URDF, a mesh is missing, or it has no visual geometry.
    """
    check_xml(path)
    root = ElementTree.fromstring(read_text(path))
    if root.tag != "robot":
        raise FileFormatError(f"expected a URDF file with the element robot in {path}, got {root.tag}.")
    try:
        places = _places_of_links(root, path)
        meshes, files = list[TriangleMesh](), list[Path]()
        for link in root.findall("link"):
            for visual in link.findall("visual"):
                vertices, faces = _geometry(visual, path, files)
                T = places[link.get("name", "")] @ _origin(visual)
                meshes.append(TriangleMesh(unit_m * (vertices @ T[:3, :3].T + T[:3, 3]), faces))
    except (KeyError, ValueError, IndexError) as error:
        raise FileFormatError(f"expected a URDF file in {path}, but it cannot be read: {error}.") from error
    if not meshes:
        raise FileFormatError(f"expected a link with a visual geometry in {path}, found none.")
    return TriangleMesh.joined(meshes), files


def _places_of_links(root: ElementTree.Element, path: Path) -> dict[str, np.ndarray]:
    """T_root_link (4, 4) of each link, with all joints at zero."""
    joints = {}
    for joint in root.findall("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is not None and child is not None:
            joints[child.attrib["link"]] = (parent.attrib["link"], _origin(joint))
    places = {}
    for link in (element.attrib["name"] for element in root.findall("link")):
        T, at = np.eye(4), link
        for _ in range(len(joints) + 1):
            if at not in joints:
                break
            at, step = joints[at]
            T = step @ T
        else:
            raise FileFormatError(f"expected joints of {path} that form a tree, got a ring at the link {link}.")
        places[link] = T
    return places


def _origin(element: ElementTree.Element) -> np.ndarray:
    """(4, 4) transform of the element `origin`: rotation by roll, pitch and yaw about fixed axes, then translation."""
    from scipy.spatial.transform import Rotation

    T = np.eye(4)
    origin = element.find("origin")
    if origin is not None:
        T[:3, :3] = Rotation.from_euler("xyz", _numbers(origin.get("rpy", "0 0 0"), 3)).as_matrix()
        T[:3, 3] = _numbers(origin.get("xyz", "0 0 0"), 3)
    return T


def _geometry(visual: ElementTree.Element, path: Path, files: list[Path]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a visual; the file of a mesh is added to `files`."""
    shape = visual.find("geometry/*")
    if shape is None:
        raise ValueError("a visual has no geometry")
    if shape.tag == "mesh":
        from rangesim.scene.mesh import read_mesh

        files.append(_mesh_file(shape.attrib["filename"], path))
        vertices, faces = read_mesh(files[-1])
        return vertices * _numbers(shape.get("scale", "1 1 1"), 3), faces
    if shape.tag == "box":
        half = _numbers(shape.attrib["size"], 3) / 2
        made = box_mesh(-half, half)
        return made.vertices, made.faces
    import trimesh

    radius = float(shape.attrib["radius"])
    if shape.tag == "sphere":
        body = trimesh.creation.icosphere(SPHERE_SUBDIVISIONS, radius)
    elif shape.tag == "cylinder":
        body = trimesh.creation.cylinder(radius, float(shape.attrib["length"]), SIDES)
    else:
        raise ValueError(f"expected a mesh, box, cylinder or sphere, got {shape.tag}")
    return np.asarray(body.vertices), np.asarray(body.faces)


def _mesh_file(name: str, path: Path) -> Path:
    """The file of a mesh: beside the URDF file, or, of package://PACKAGE/NAME, in the nearest folder above it."""
    name = name.removeprefix("file://")
    if not name.startswith("package://"):
        return path.parent / name
    inside = Path(name.removeprefix("package://"))
    for folder in path.resolve().parents:
        for candidate in (folder / inside, folder.joinpath(*inside.parts[1:])):
            if candidate.is_file():
                return candidate
    raise FileFormatError(f"{path} names {name}, but no folder above it has this file.")


def _numbers(text: str, count: int) -> np.ndarray:
    values = np.array([float(word) for word in text.split()])
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"expected {count} numbers, got {text!r}")
    return values
