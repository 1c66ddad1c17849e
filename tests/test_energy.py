# SPDX-License-Identifier: Apache-2.0
"""Light through glass and off mirrors is neither lost nor made: balances, white furnaces, closed boxes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from delta_scenes import (
    GLASS,
    MIRROR,
    SlabPath,
    fresnel_conductor,
    fresnel_dielectric,
    matte,
    rig_of,
    scene_of,
    slab,
    thrown_w,
    transform,
    wall,
)
from tiers import to_validate

from rangesim import Intrinsics, Rig, look_at, transport
from rangesim.response import FirstReturn

POWER_W = 2.0
PROJECTOR = Intrinsics.from_fov(160, 120, 40)
CAMERA = Intrinsics.from_fov(64, 48, 40)


def mean_over_the_field(function: Any) -> float:
    """Mean over the projector's pixels, all equally bright, of a function of the tangent to the axis."""
    rays = PROJECTOR.normalise(PROJECTOR.pixel_centres())
    return float(function(np.linalg.norm(rays, axis=-1)).mean())


def passed_by_a_pane(t: Any) -> Any:
    """Transmittance of both faces, with all reflections between them; of the tangent to the axis."""
    r = fresnel_dielectric(t / np.hypot(1, t))
    return (1 - r) / (1 + r)


# ---- Balance of the light beyond glass and mirrors --------------------------------------------------


def test_a_mirror_throws_its_reflectance_of_the_light() -> None:
    """It covers the half x > 0 of the field, and throws light back to a wall behind the projector."""
    behind = {"type": "rectangle", "to_world": transform().translate([0, 0, -1]).scale(20), "bsdf": matte()}
    rig = rig_of(CAMERA, PROJECTOR, projector_power_w=POWER_W)
    parts = {"mirror": wall(1.0, MIRROR, 5.0, x=5.0), "wall": wall(2.0, matte())}
    reflected = mean_over_the_field(lambda t: fresnel_conductor(1 / np.hypot(1, t)))
    assert thrown_w(scene_of(behind=behind, **parts), rig) == pytest.approx(POWER_W / 2 * reflected, rel=3e-3)
    # Without the wall behind, all of it escapes
    assert thrown_w(scene_of(**parts), rig) == 0


@pytest.mark.parametrize("kind", ["dielectric", "thindielectric"])
def test_a_slab_passes_one_minus_r_over_one_plus_r(kind: str) -> None:
    pane = slab(0.3, 0.35) if kind == "dielectric" else wall(0.3, {**GLASS, "type": "thindielectric"})
    scene = scene_of(pane=pane, wall=wall(1.0, matte()))
    expected = POWER_W * mean_over_the_field(passed_by_a_pane)
    thrown = thrown_w(scene, rig_of(CAMERA, PROJECTOR, projector_power_w=POWER_W), seeds=8)
    assert thrown == pytest.approx(expected, rel=4e-3)


def test_polished_plastic_throws_what_its_coat_reflects() -> None:
    plastic = {
        "type": "plastic",
        "int_ior": 1.5,
        "ext_ior": 1.0,
        "diffuse_reflectance": {"type": "spectrum", "value": 0.6},
    }
    behind = {"type": "rectangle", "to_world": transform().translate([0, 0, -1]).scale(20), "bsdf": matte()}
    scene = scene_of(wall=wall(1.0, plastic), behind=behind)
    thrown = thrown_w(scene, rig_of(CAMERA, PROJECTOR, projector_power_w=POWER_W))
    mirrored = mean_over_the_field(lambda t: fresnel_dielectric(t / np.hypot(1, t)))
    assert thrown == pytest.approx(POWER_W * mirrored, rel=3e-3)


def test_in_a_closed_box_all_light_that_meets_glass_lands() -> None:
    box = {"type": "cube", "to_world": transform().scale(2.0), "bsdf": matte()}
    ball = {"type": "sphere", "center": [0.0, 0.0, 1.0], "radius": 0.2, "bsdf": GLASS}
    rig = rig_of(CAMERA, PROJECTOR, projector_power_w=POWER_W)
    radius_px = PROJECTOR.fx * 0.2 / np.sqrt(1 - 0.2**2)  # the ball's half angle has the sine 0.2
    meets = np.pi * radius_px**2 / (160 * 120)
    assert thrown_w(scene_of(box=box, ball=ball), rig, seeds=8) == pytest.approx(POWER_W * meets, rel=4e-3)


# ---- Closed boxes and white furnaces ----------------------------------------------------------------


@pytest.mark.validation
def test_what_a_plane_receives_behind_a_slab_is_what_the_slab_passes() -> None:
    """The camera stands behind the slab and sees all of the lit part of the plane."""
    scene = scene_of(slab=slab(0.2, 0.25), wall=wall(1.0, matte(0.5)))
    camera = Intrinsics.from_fov(96, 72, 80)
    rig = rig_of(camera, PROJECTOR, camera_at=(0.0, 0.0, 0.5), projector_power_w=POWER_W)
    seeds = [transport(scene, rig, [], spp=64, max_depth=2, seed=s).energy for s in range(4)]
    area_of_pixel = (0.5 / camera.fx) ** 2
    irradiance = np.mean([e.caustic for e in seeds], axis=0) * np.pi / 0.5
    received = irradiance.sum(dtype=float) * area_of_pixel
    assert received == pytest.approx(POWER_W * mean_over_the_field(passed_by_a_pane), rel=0.01)
    assert not seeds[0].direct.any()
    # ...and where it lands is given by Snell's law
    points = rig.camera.normalise(rig.camera.pixel_centres()) * 0.5
    across = np.linalg.norm(points, axis=-1)
    expected = sum(SlabPath(1.0, 0.05, turns=k).irradiance(across) for k in range(3)) * rig.projector_irradiance
    well_inside = (np.abs(points) < [0.30, 0.22]).all(axis=-1)
    assert (irradiance / expected)[well_inside].mean() == pytest.approx(1.0, abs=0.01)


def integrating_sphere(*parts: dict[str, Any], albedo: float) -> float:
    """Flux that the wall of a closed diffuse sphere receives, as six cameras in its middle see it."""
    radius = 2.0
    sphere = {"type": "sphere", "radius": radius, "bsdf": matte(albedo)}
    scene = scene_of(sphere=sphere, **{f"part_{i}": part for i, part in enumerate(parts)})
    camera = Intrinsics.from_fov(48, 48, 90)
    rays = camera.directions(camera.pixel_centres())
    solid_angle = np.linalg.norm(rays, axis=-1) ** -3 / (camera.fx * camera.fy)
    received, seen = 0.0, 0.0
    T_world_projector = look_at((0.9, -1.2, 0.0), (0.9, 0.0, 0.0), DOWN_Z)
    for ahead, up in ((x, u) for x, u in FACES):
        T_world_camera = look_at((0, 0, 0), ahead, up)
        rig = Rig(camera, Intrinsics.from_fov(64, 64, 30), T_world_camera,
                  np.linalg.inv(T_world_camera) @ T_world_projector, projector_power_w=POWER_W)  # fmt: skip
        signals = transport(scene, rig, [], spp=32, max_depth=40, rr_depth=40, glint=False)
        wall_seen = signals.truth.instance == 0
        radiance = signals.energy.projector
        received += float((radiance * solid_angle)[wall_seen].sum()) * np.pi / albedo * radius**2
        seen += float(solid_angle[wall_seen].sum())
    indirect = POWER_W * albedo / (1 - albedo) / (4 * np.pi)  # per solid angle, uniform
    return received + indirect * (4 * np.pi - seen)


FACES = [((1, 0, 0), (0, 0, 1)), ((-1, 0, 0), (0, 0, 1)), ((0, 1, 0), (0, 0, 1)), ((0, -1, 0), (0, 0, 1)),
         ((0, 0, 1), (0, 1, 0)), ((0, 0, -1), (0, 1, 0))]  # fmt: skip
DOWN_Z = (0.0, 0.0, 1.0)


@pytest.mark.parametrize("inside", ["nothing", *to_validate("glass ball", "cut-out")])
def test_an_integrating_sphere_keeps_its_flux_with_lossless_glass_inside(inside: str) -> None:
    """The wall receives Phi (1 + rho + rho^2 + ...), whatever lossless delta surfaces the light meets on its way."""
    at = [0.9, 0.0, 0.0]  # the beam goes through it to a wall that the cameras see
    parts = {
        "nothing": [],
        "glass ball": [{"type": "sphere", "center": at, "radius": 0.3, "bsdf": GLASS}],
        "cut-out": [
            {"type": "sphere", "center": at, "radius": 0.3, "bsdf": {"type": "mask", "opacity": 0.0, "b": matte()}}
        ],
    }[inside]
    received = integrating_sphere(*parts, albedo=0.5)
    assert received == pytest.approx(POWER_W / (1 - 0.5), rel=0.01)


def test_a_white_furnace_hides_lossless_glass() -> None:
    """Under light of the same radiance from everywhere, glass and thin panes look as bright as what surrounds them."""
    scene = scene_of(
        sky={"type": "constant", "radiance": {"type": "spectrum", "value": 1.0}},
        ball={"type": "sphere", "center": [0.0, 0.0, 1.0], "radius": 0.2, "bsdf": GLASS},
        slab=slab(1.5, 1.6, 0.3),
        pane=wall(0.5, {**GLASS, "type": "thindielectric"}, 0.1),
    )
    rig = rig_of(CAMERA, PROJECTOR)
    few = transport(scene, rig, [], spp=6, max_depth=60, rr_depth=60).energy.ambient
    np.testing.assert_allclose(few, 1.0, atol=2e-3)  # no strata: chances alone decide, and each path counts once
    ambient = transport(scene, rig, [], spp=64, max_depth=60, rr_depth=60).energy.ambient
    assert abs(ambient.mean() - 1) < 2e-4
    np.testing.assert_allclose(ambient, 1.0, atol=0.05)  # at rims, strata cover different parts of a pixel


@pytest.mark.validation
@pytest.mark.parametrize("thickness_m", [1e-2, 1e-4, 5e-5])
def test_thin_glass_keeps_both_faces(thickness_m: float) -> None:
    """A foil passes as much as a pane, and delays the light by (n - 1) d."""
    response = FirstReturn()
    scenes = (scene_of(wall=wall(1.0, matte(0.5))), scene_of(wall=wall(1.0, matte(0.5)), foil=foil(thickness_m)))
    rig = rig_of(CAMERA, Intrinsics.from_fov(640, 480, 40))
    plain, covered = (transport(s, rig, [response], spp=32, seed=1) for s in scenes)
    fraction = covered.energy.caustic.sum() / plain.energy.direct.sum()
    # 0.925 for each way; the wall is lit as from a place that is nearer by the third of the thickness
    assert fraction == pytest.approx(0.925**2 / (1 - thickness_m / 3) ** 2, rel=5e-3)
    lit = (plain.channels[response][0] > 0) & (covered.channels[response][0] > 0)
    lengths = (c.channels[response][1][lit] / c.channels[response][0][lit] for c in (plain, covered))
    before, after = lengths
    assert np.median(after - before) == pytest.approx(2 * 0.5 * thickness_m, rel=0.05, abs=2e-5)


def foil(thickness_m: float) -> dict[str, Any]:
    return slab(0.5, 0.5 + thickness_m, 0.4)
