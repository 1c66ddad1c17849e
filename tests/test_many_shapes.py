# SPDX-License-Identifier: Apache-2.0
"""Scenes of many objects: what is known of each is looked up in tables, not asked of one after another."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from many_shapes import balls
from synthetic import counted_return

from rangesim import Scene, load_scene, transport
from rangesim.light_transport.camera_rays import Device
from rangesim.light_transport.delta_surfaces import meets_delta
from rangesim.light_transport.surfaces import Surfaces, surfaces_of

MANY = 3000


@pytest.fixture(scope="module")
def crowd() -> Scene:
    return load_scene(balls(MANY))


def seconds(call: Any) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


@pytest.mark.validation
def test_what_meets_a_delta_surface_is_found_without_asking_each_shape(crowd: Scene) -> None:
    """In a part of the time that one virtual call of all shapes takes."""
    import drjit as dr
    import mitsuba as mi

    camera = Device.camera(crowd.rig(width=32, height=24))
    rays = camera.centre_rays(0, camera.pixels)

    def ask_each_shape() -> None:
        dr.eval(crowd.mitsuba.ray_intersect(mi.Ray3f(rays.origin, rays.direction)).p)

    def look_up() -> None:
        meets_delta(crowd.mitsuba, camera.pixels, camera.centre_rays)

    look_up(), ask_each_shape()  # compiles
    looked_up, asked = (min(seconds(call) for _ in range(3)) for call in (look_up, ask_each_shape))
    assert looked_up < 0.5 * asked


@pytest.mark.parametrize("materials", ["one", "glass"])
def test_loops_are_traced_once(materials: str) -> None:
    """Each time costs a virtual call for each shape: 10 000 of them take a second."""
    counted, traces = counted_return()
    scene = load_scene(balls(20, materials))
    rig = scene.rig(width=16, height=12)
    transport(scene, rig, [counted], spp=1, glint=False)
    assert (
        len(traces) == {"one": 1, "glass": 2}[materials]
    )  # at the vertices of paths, and where caustics are looked up


def test_the_pixels_before_glass_are_those_of_the_shapes_that_are_glass() -> None:
    scene = load_scene(balls(300, "glass"))
    rig = scene.rig(width=64, height=48)
    camera = Device.camera(rig)
    meets, exists = meets_delta(scene.mitsuba, camera.pixels, camera.centre_rays)
    truth = transport(scene, rig, [], spp=1, caustics=False, glint=False).truth
    glass = [scene.instances[i].material == "transparent" if i >= 0 else False for i in truth.instance.ravel()]
    assert exists.all()
    assert 0.005 < np.mean(glass) < 0.5
    np.testing.assert_array_equal(meets, glass)


PYRAMID = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 2 3 4\n"


def mixed(folder: Path) -> dict[str, Any]:
    """Spheres and meshes of all kinds, turned, mirrored, some with flipped normals, and shapes that are neither."""
    scene = balls(2)
    import mitsuba as mi

    (folder / "pyramid.obj").write_text(PYRAMID)
    to_world, rng = mi.ScalarTransform4f(), np.random.default_rng(0)
    kinds: list[dict[str, Any]] = [
        {"type": "sphere"},
        {"type": "sphere", "flip_normals": True},
        {"type": "cube"},
        {"type": "cube", "face_normals": True},
        {"type": "cube", "flip_normals": True},
        {"type": "obj", "filename": str(folder / "pyramid.obj")},
    ]
    scene["disk"] = {"type": "disk", "to_world": to_world.translate([0.3, 0, 2]).scale([0.2, 0.2, 0.2])}
    scene["tube"] = {"type": "cylinder", "p0": [-0.3, -1, 2], "p1": [-0.3, 1, 2], "radius": 0.1}
    for i in range(180):
        place = to_world.translate(rng.uniform((-0.9, -0.7, 1.4), (0.9, 0.7, 2.4)).tolist())
        place = place.rotate(rng.normal(size=3).tolist(), float(rng.uniform(0, 360)))
        size = [-0.05 if i % 4 == 0 else 0.05, 0.05, 0.05]
        scene[f"shape_{i}"] = {**kinds[i % len(kinds)], "to_world": place.scale(size)}
    return scene


@pytest.mark.validation
def test_surfaces_are_those_of_mitsuba_to_the_last_bit(tmp_path: Path) -> None:
    scene = load_scene(mixed(tmp_path))
    import drjit as dr
    import mitsuba as mi

    surfaces = surfaces_of(scene.mitsuba)
    assert isinstance(surfaces, Surfaces)
    assert len(surfaces.branches) == 8  # five of those kinds, wall, disk, cylinder
    rays = Device.camera(scene.rig(width=320, height=240)).centre_rays(0, 320 * 240)
    ray, active = mi.Ray3f(rays.origin, rays.direction), dr.arange(mi.UInt32, 320 * 240) % 7 != 0
    theirs, ours = (
        of.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active) for of in (scene.mitsuba, surfaces)
    )
    met = theirs.is_valid().numpy()
    assert 0.3 < met.mean() < 0.9
    for name in ("t", "p", "n", "uv", "dp_du", "dp_dv", "dn_du", "wi"):
        np.testing.assert_array_equal(getattr(ours, name).numpy(), getattr(theirs, name).numpy(), name)
    for name in ("s", "t", "n"):
        np.testing.assert_array_equal(getattr(ours.sh_frame, name).numpy(), getattr(theirs.sh_frame, name).numpy())
    np.testing.assert_array_equal(ours.prim_index.numpy()[met], theirs.prim_index.numpy()[met])
    np.testing.assert_array_equal(*(dr.reinterpret_array(mi.UInt32, si.shape).numpy() for si in (ours, theirs)))


def test_few_shapes_are_left_to_mitsuba() -> None:
    scene = load_scene(balls(20)).mitsuba
    assert surfaces_of(scene) is scene
