# SPDX-License-Identifier: Apache-2.0
"""Scenes of many objects: what is known of each is looked up in tables, not asked of one after another."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
from many_shapes import balls

from rangesim import Scene, load_scene, transport
from rangesim.light_transport.device import Device
from rangesim.light_transport.photons import meets_delta
from rangesim.response import FirstReturn

MANY = 3000


@pytest.fixture(scope="module")
def crowd() -> Scene:
    return load_scene(balls(MANY))


def seconds(call: Any) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def test_what_meets_a_delta_surface_is_found_without_asking_each_shape(crowd: Scene) -> None:
    """In a part of the time that one virtual call of all shapes takes."""
    import drjit as dr
    import mitsuba as mi

    camera = Device.camera(crowd.rig(width=32, height=24))
    rays = camera.centre_rays(0, camera.pixels)

    def ask_each_shape() -> None:
        dr.eval(crowd.mitsuba.ray_intersect(mi.Ray3f(rays.origin, rays.direction)).p)

    meets_delta(crowd.mitsuba, camera), ask_each_shape()  # compiles
    looked_up, asked = (
        min(seconds(call) for _ in range(3)) for call in (lambda: meets_delta(crowd.mitsuba, camera), ask_each_shape)
    )
    assert looked_up < 0.5 * asked


@pytest.mark.parametrize("materials", ["one", "glass"])
def test_loops_are_traced_once(materials: str) -> None:
    """Each time costs a virtual call for each shape: 10 000 of them take a second."""
    traced = 0

    class Counted(FirstReturn):
        def weights(self, path: Any, m: Any) -> list[Any]:
            nonlocal traced
            traced += 1
            return super().weights(path, m)

    scene = load_scene(balls(20, materials))
    rig = scene.rig(width=16, height=12)
    transport(scene, rig, [Counted()], spp=1, photons=20_000, glint=False)
    assert traced == {"one": 1, "glass": 2}[materials]  # at the vertices of paths, and where photons are gathered


def test_the_pixels_before_glass_are_those_of_the_shapes_that_are_glass() -> None:
    scene = load_scene(balls(300, "glass"))
    rig = scene.rig(width=64, height=48)
    meets, exists = meets_delta(scene.mitsuba, Device.camera(rig))
    truth = transport(scene, rig, [], spp=1, photons=0, glint=False).truth
    glass = [scene.instances[i].material == "transparent" if i >= 0 else False for i in truth.instance.ravel()]
    assert exists.all()
    assert 0.005 < np.mean(glass) < 0.5
    np.testing.assert_array_equal(meets, glass)
