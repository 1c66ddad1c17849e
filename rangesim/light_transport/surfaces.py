# SPDX-License-Identifier: Apache-2.0
"""Surface interactions in scenes of many shapes, and tables of what is known about each shape.

Mitsuba asks the shape that a ray met for position, normal and frame, by a virtual call. Dr.Jit traces the code of every
shape wherever a kernel makes such a call, and the kernel runs it once for each of the shapes that neighbouring lanes
met. Here all spheres share one branch, and all meshes of one kind another. A branch has the same operations in the same
order as Mitsuba's code, so the results are the same bytes.
"""

from __future__ import annotations

from collections.abc import Hashable
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from rangesim.light_transport.sampling import aligned

MANY = 100
"""Number of shapes from which on branches are shared, because in smaller scenes it would take longer to make their
tables than virtual calls take."""
MAX_FACES = 4096
"""Largest count of faces of a mesh that is copied into a joint mesh, so that copies take little memory; a scene has few
larger meshes."""


def surfaces_of(scene: mi.Scene) -> mi.Scene | Surfaces:
    """The object to intersect rays with: the mitsuba.Scene itself, or its `Surfaces` if many shapes share branches."""
    shapes = scene.shapes()
    if len(shapes) < MANY:
        return scene
    families: dict[Hashable, list[int]] = {}
    for i, shape in enumerate(shapes):
        families.setdefault(_family(shape), []).append(i)
    return Surfaces(scene, list(families.values())) if 2 * len(families) <= len(shapes) else scene


def _family(shape: mi.Shape) -> Hashable:
    """A key that is equal for shapes which can share a branch; else the shape itself."""
    if _is_sphere(shape):
        return "sphere"
    if shape.shape_type() == mi.ShapeType.Mesh.value and shape.face_count() <= MAX_FACES:
        return _kind(shape)
    return shape


class Surfaces:
    """A stand-in for a mitsuba.Scene to intersect rays with, as long as its shapes do not change.

    Parameters
    ----------
    scene : mitsuba.Scene
    families : indices of the scene's shapes, one list for each branch.
    """

    def __init__(self, scene: mi.Scene, families: list[list[int]]) -> None:
        shapes = scene.shapes()
        self.scene = scene
        branch = np.zeros(len(shapes), np.uint32)
        self.branches = []
        for number, members in enumerate(families):
            branch[members] = number
            one = shapes[members[0]]
            family = one if len(members) == 1 else (Spheres if _is_sphere(one) else Meshes)(scene, members)
            self.branches.append(family.compute_surface_interaction)
        self.branch = mi.UInt32(table_of(scene, branch))

    def ray_intersect(
        self, ray: mi.Ray3f, flags: int, coherent: bool, active: mi.Bool | bool = True
    ) -> mi.SurfaceInteraction3f:
        """The surface interaction that `mitsuba.Scene.ray_intersect` returns; it may set more than `flags` asks for."""
        found = self.scene.ray_intersect_preliminary(ray, coherent=coherent, active=active)
        met = found.is_valid() & active
        branch = dr.gather(mi.UInt32, self.branch, number_of(found.shape), met)
        branches = [lambda ray, found, met, of=of: of(ray, found, flags, met) for of in self.branches]
        si = dr.switch(branch, branches, ray, found, met)
        si.t = dr.select(met, si.t, dr.inf)
        met &= si.is_valid()
        si.shape = dr.select(met, found.shape, dr.zeros(mi.ShapePtr))
        si.prim_index, si.time = found.prim_index, ray.time
        si.initialize_sh_frame()
        si.wi = dr.select(met, si.to_local(-ray.d), -ray.d)
        return si


class Spheres:
    """The spheres of a scene, which share a branch."""

    def __init__(self, scene: mi.Scene, members: list[int]) -> None:
        shapes = scene.shapes()
        to_world = [mi.traverse(shapes[i])["to_world"] for i in members]
        table = partial(_table, scene, members)
        self.flipped = mi.Bool(table([shapes[i].has_flipped_normals() for i in members]))
        self.to_world = dr.zeros(mi.AffineTransform4f)
        self.to_world.matrix, self.to_world.inverse_transpose = (
            mi.Matrix4f(np.moveaxis(table([m.numpy()[..., 0] for m in matrices]), 0, -1))
            for matrices in ([t.matrix for t in to_world], [t.inverse_transpose for t in to_world])
        )

    def compute_surface_interaction(
        self, ray: mi.Ray3f, found: mi.PreliminaryIntersection3f, flags: int, met: mi.Bool
    ) -> mi.SurfaceInteraction3f:
        """The surface interaction as `Sphere` of Mitsuba 3.9 computes it for `mitsuba.RayFlags.All`."""
        number = number_of(found.shape)
        to_world = dr.gather(mi.AffineTransform4f, self.to_world, number, met)
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.t, si.p = found.t, ray(found.t)
        normal = dr.normalize(si.p - to_world.translation())
        si.n = dr.select(dr.gather(mi.Bool, self.flipped, number, met), -normal, normal)
        si.sh_frame.n = si.n

        local = mi.Vector3f(to_world.inverse() @ si.p)
        theta, phi = mi.dir_to_sph(local)
        si.uv = mi.Point2f(dr.select(phi < 0, phi + 2 * dr.pi, phi) * dr.inv_two_pi, theta * dr.inv_pi)
        radius = dr.sqrt(dr.square(local.x) + dr.square(local.y))
        inverse = dr.rcp(radius)
        along_meridian = mi.Vector3f(local.z * (local.x * inverse), local.z * (local.y * inverse), -radius)
        along_meridian = dr.select(radius == 0, mi.Vector3f(1, 0, 0), along_meridian)
        si.dp_du = to_world @ mi.Vector3f(-local.y, local.x, 0) * (2 * dr.pi)
        si.dp_dv = to_world @ along_meridian * dr.pi
        return si


class Meshes:
    """Meshes of a scene that are of one kind, joined to one mesh, which share a branch."""

    def __init__(self, scene: mi.Scene, members: list[int]) -> None:
        shapes = scene.shapes()
        meshes = [shapes[i] for i in members]
        vertices = np.cumsum([0, *(mesh.vertex_count() for mesh in meshes)])
        faces = np.cumsum([0, *(mesh.face_count() for mesh in meshes)])
        self.first_face = mi.UInt32(_table(scene, members, faces[:-1].astype(np.uint32)))
        _, flipped, flat, has_normals, has_texcoords = _kind(meshes[0])
        looks = mi.Properties()
        looks["flip_normals"], looks["face_normals"] = flipped, flat
        self.joint = mi.Mesh("joint", int(vertices[-1]), int(faces[-1]), looks, has_normals, has_texcoords)
        parameters = mi.traverse(self.joint)
        own_faces = (mesh.faces_buffer().numpy() for mesh in meshes)
        parameters["faces"] = mi.UInt32(
            np.concatenate([own + np.uint32(first) for own, first in zip(own_faces, vertices[:-1], strict=True)])
        )
        parameters["vertex_positions"] = _joined([m.vertex_positions_buffer() for m in meshes])
        parameters.update()  # computes normals, so those of the meshes are set later
        if has_normals:
            parameters["vertex_normals"] = _joined([m.vertex_normals_buffer() for m in meshes])
        if has_texcoords:
            parameters["vertex_texcoords"] = _joined([m.vertex_texcoords_buffer() for m in meshes])
        parameters.update()

    def compute_surface_interaction(
        self, ray: mi.Ray3f, found: mi.PreliminaryIntersection3f, flags: int, met: mi.Bool
    ) -> mi.SurfaceInteraction3f:
        """The surface interaction as the joint mesh computes it, in which the faces have other numbers."""
        of_joint = mi.PreliminaryIntersection3f(found)
        of_joint.prim_index += dr.gather(mi.UInt32, self.first_face, number_of(found.shape), met)
        return self.joint.compute_surface_interaction(ray, of_joint, flags, met)


def _is_sphere(shape: mi.Shape) -> bool:
    return bool(shape.shape_type() == mi.ShapeType.Sphere.value)


def _kind(mesh: mi.Mesh) -> tuple[str, bool, bool, bool, bool]:
    """The properties of a mesh that decide how its normals and texture coordinates are computed."""
    return (
        "mesh",
        mesh.has_flipped_normals(),
        mesh.has_face_normals(),
        mesh.has_vertex_normals(),
        mesh.has_vertex_texcoords(),
    )


def _joined(buffers: list[mi.Float]) -> mi.Float:
    """The buffers of several meshes, one after the other."""
    return mi.Float(aligned(np.concatenate([buffer.numpy() for buffer in buffers]), np.float32))


def _table(scene: mi.Scene, members: list[int], values: ArrayLike) -> np.ndarray:
    """Table of `values` (members, ...), one for each of these shapes; 0 for all other shapes. See `table_of`."""
    rows = np.asarray(values)
    of_shapes = np.zeros((len(scene.shapes()), *rows.shape[1:]), rows.dtype)
    of_shapes[members] = rows
    return table_of(scene, of_shapes)


END = 1e-5
"""Fraction of its length by which a ray to an emitter ends early, so that a surface through the emitter does not hide
it. Mitsuba's fraction is 90 times as large: glass 9 mm before an emitter would be passed by, from 10 m."""


def ray_to_emitter(si: mi.SurfaceInteraction3f, emitter: mi.Point3f) -> mi.Ray3f:
    """The ray from a surface to an emitter that is no surface itself, up to `END` before it."""
    ray = si.spawn_ray_to(emitter)
    ray.maxt *= (1 - END) / (1 - mi.math.ShadowEpsilon)
    return ray


# ---- Tables of what is known of each shape ---------------------------------------------------------------
#
# A kernel that asks the shapes themselves makes a virtual call. Dr.Jit then traces the code of every shape of the
# process, which takes about 0.1 ms for each shape: a second for ten thousand shapes. Tables avoid the call.


def number_of(shape: mi.ShapePtr) -> mi.UInt32:
    """(lanes,) UInt32, index of each shape in the tables of `table_of`; 0 where there is no shape."""
    return dr.reinterpret_array(mi.UInt32, shape)


def table_of(scene: mi.Scene, values: ArrayLike) -> np.ndarray:
    """Table of `values` (shapes, ...), one for each shape of the scene in its order, indexed by `number_of`."""
    numbers, rows = number_of(scene.shapes_dr()).numpy(), np.asarray(values)
    table = np.zeros((int(numbers.max()) + 1, *rows.shape[1:]), rows.dtype)
    table[numbers] = rows
    return table
