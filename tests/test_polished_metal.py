# SPDX-License-Identifier: Apache-2.0
"""Light that narrow lobes of metal and glass throw on a wall: limits, energy, noise, and who owns a path."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from delta_scenes import MIRROR, matte, rig_of, scene_of, sheets_of, transform, wall

from rangesim import Intrinsics, Rig, Scene, transport
from rangesim.environment.backend import select_variant
from rangesim.light_transport.camera_rays import Device
from rangesim.light_transport.caustic_sheets import Sheets
from rangesim.light_transport.specular_tree import LOBE_POINTS
from rangesim.scene.materials import is_near_specular

CAMERA, PROJECTOR = Intrinsics.from_fov(32, 32, 60), Intrinsics.from_fov(192, 192, 60)
WALL_Z = 1.0
RAYS = 1 << 20


def rough(alpha: float, **more: Any) -> dict[str, Any]:
    """Metal on both sides with the refractive index of `MIRROR`."""
    metal = {**MIRROR, "type": "roughconductor", "distribution": "ggx", **({"alpha": alpha} if alpha else {}), **more}
    return {"type": "twosided", "bsdf": metal}


def plate(bsdf: dict[str, Any]) -> dict[str, Any]:
    """A plate of 0.2 m on edge, which stands on the wall and is lit from the left."""
    place = transform().translate([0.28, 0, 0.85]).rotate([0, 1, 0], -90).scale([0.1, 0.1, 1])
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf}


def beside_wall(bsdf: dict[str, Any], **more: dict[str, Any]) -> Scene:
    return scene_of(wall=wall(WALL_Z, matte(), 1.0), plate=plate(bsdf), **more)


def rig() -> Rig:
    return rig_of(CAMERA, PROJECTOR, at=(-0.1, 0.0, 0.0))


def on_wall(sheets: Sheets, edges: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Flux of triangles, in watts, by the part of the wall in which their middle lies."""
    x, y, _ = sheets.position[sheets.triangles].mean(axis=1).T
    return np.histogram2d(x, y, edges, weights=sheets.flux)[0]


def brute_force(scene: Scene, rig: Rig, edges: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """The same by a forward trace of the light that meets the plate and then the wall."""
    device, rng = Device.projector(scene.in_renderer(rig)), mi.PCG32(RAYS)
    place = mi.Point2f(rng.next_float32(), rng.next_float32()) * device.size
    first = device.centre_ray(place)
    ray, power, active = mi.Ray3f(first.origin, first.direction), dr.ones(mi.Float, RAYS), dr.full(mi.Bool, True, RAYS)
    landed, position = dr.zeros(mi.Bool, RAYS), dr.zeros(mi.Point3f, RAYS)
    for bounce in range(2):
        si = scene.mitsuba.ray_intersect(ray, active)
        active &= si.is_valid()
        lands = active & mi.has_flag(si.bsdf(ray).flags(), mi.BSDFFlags.DiffuseReflection)
        landed |= lands & (bounce > 0)
        position = dr.select(lands, si.p, position)
        active &= ~lands
        xi = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
        bs, weight = si.bsdf(ray).sample(mi.BSDFContext(mi.TransportMode.Importance), si, *xi, active)
        power *= dr.select(active, weight[0], 1)
        ray = si.spawn_ray(si.to_world(bs.wo))
    x, y, _ = position.numpy()
    watts = np.where(landed.numpy(), power.numpy(), 0) * rig.projector_power_w / RAYS
    return np.histogram2d(x, y, edges, weights=watts)[0]


def test_metal_becomes_a_mirror_as_its_roughness_vanishes() -> None:
    """Each point of the lobe then throws the same light as the mirror, on the same places."""
    mirror, metal = (sheets_of(beside_wall(bsdf), rig()) for bsdf in (MIRROR, rough(1e-4)))
    assert mirror is not None
    assert metal is not None
    assert metal.flux.sum() == pytest.approx(mirror.flux.sum(), rel=2e-3)
    assert set(np.unique(metal.lobe)) == set(range(1, LOBE_POINTS + 1))
    centres = [np.average(s.position[s.triangles].mean(axis=1), axis=0, weights=s.flux) for s in (mirror, metal)]
    np.testing.assert_allclose(*centres, atol=1e-3)
    lengths = [np.average(s.length[s.triangles].mean(axis=1), weights=s.flux) for s in (mirror, metal)]
    assert lengths[0] == pytest.approx(lengths[1], abs=1e-3)


@pytest.mark.parametrize(
    "bsdf",
    [
        rough(0, distribution="beckmann", alpha_u=0.03, alpha_v=0.1),
        {"type": "roughdielectric", "distribution": "ggx", "alpha": 0.05, "int_ior": 1.5, "ext_ior": 1.0},
    ],
    ids=["metal", "glass"],
)
def test_lobes_throw_as_much_light_on_each_part_of_the_wall_as_a_forward_trace(bsdf: dict[str, Any]) -> None:
    scene, edges = beside_wall(bsdf), (np.array([-1, 0.15, 0.2, 1]), np.array([-1, 0, 1]))
    expected = brute_force(scene, rig(), edges)
    seeds = [on_wall(sheets, edges) for seed in range(5) if (sheets := sheets_of(scene, rig(), seed)) is not None]
    assert np.sum(seeds) / 5 == pytest.approx(expected.sum(), rel=0.01)
    np.testing.assert_allclose(np.mean(seeds, axis=0), expected, atol=0.01 * expected.sum())


def test_each_path_belongs_to_one_strategy() -> None:
    """All light is the same whether caustics carry what two plates of metal throw, or paths find it."""
    other = {**plate(rough(0.1)), "to_world": transform().translate([-0.3, 0, 0.8]).rotate([0, 1, 0], 80).scale(0.15)}
    scene, few = beside_wall(rough(0.1), other=other), rig_of(Intrinsics.from_fov(8, 8, 60), PROJECTOR, at=(-0.1, 0, 0))
    on, off = (
        transport(scene, few, [], spp=spp, max_depth=9, indirect="raw", caustics=caustics, glint=False).energy
        for spp, caustics in ((2048, True), (32768, False))
    )
    thrown = float(on.caustic.mean())
    assert off.caustic.max() == 0
    assert float(on.multipath.mean()) + thrown == pytest.approx(float(off.multipath.mean()), abs=0.1 * thrown)
    np.testing.assert_allclose(on.direct, off.direct, atol=0.01 * on.direct.max())


def test_the_light_of_lobes_on_a_wall_has_little_noise_at_the_default_samples() -> None:
    scene = beside_wall(rough(0.02))
    images = np.array(
        [(e := transport(scene, rig(), [], seed=seed, glint=False).energy).caustic + e.direct for seed in range(4)]
    )
    mean = images.mean(axis=0)
    lit = mean > 1.1 * np.median(mean)
    assert lit.sum() > 10
    noise = images.std(axis=0, ddof=1)[lit] / mean[lit]
    assert np.median(noise) < 0.03
    assert noise.max() < 0.12


def test_only_metal_and_glass_of_a_small_roughness_are_followed() -> None:
    select_variant()
    glass, plastic = ({"type": kind, "alpha": 0.05} for kind in ("roughdielectric", "roughplastic"))
    blend = {"type": "blendbsdf", "weight": 0.5, "a": rough(0.05), "b": matte()}
    for bsdf, expected in ((rough(0.1), True), (rough(0.2), False), (glass, True), (plastic, False), (blend, False),
                           (MIRROR, False), (matte(), False)):  # fmt: skip
        assert is_near_specular(mi.load_dict(bsdf)) == expected
