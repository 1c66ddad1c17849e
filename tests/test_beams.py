# SPDX-License-Identifier: Apache-2.0
"""Beams: radiance against closed forms, no multipath in a corner, and beams that tile a field equal a projector."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from scipy.special import erf
from tiers import to_validate

from rangesim import AmcwToF, DirectToF, IdealToF, Scene, decode, expose, load_scene, transport
from rangesim.rig import Beam, Intrinsics, Lens, RayTable, Rig

TILES = 8
"""Beams along each side of the field that they tile."""
FIELD = 0.16
"""Radians, field of the receiver that sees everything the beams light."""


def wall(to_world: Any, reflectance: float = 0.6) -> dict[str, Any]:
    diffuse = {"type": "diffuse", "reflectance": {"type": "spectrum", "value": reflectance}}
    return {"type": "rectangle", "to_world": to_world, "b": {"type": "twosided", "b": diffuse}}


def glass(index: float) -> dict[str, Any]:
    return {"type": "dielectric", "int_ior": index}


def corner_with(**things: Any) -> Scene:
    """A wall 2 m ahead and one beside it, with something in front; the camera looks along x."""
    T = mi.ScalarTransform4f
    return load_scene(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 20.0, "to_world": T().look_at([0, 0, 0], [1, 0, 0], [0, 0, 1])},
            "ahead": wall(T().translate([2, 0, 0]).rotate([0, 1, 0], -90).scale(3)),
            "beside": wall(T().translate([2, 0.15, 0]).rotate([1, 0, 0], 90).scale(1.5)),
            **things,
        }
    )


@pytest.fixture(scope="module", autouse=True)
def _variant() -> None:
    load_scene("corner")  # sets the variant of Mitsuba


def obstacle(name: str) -> dict[str, Any]:
    T = mi.ScalarTransform4f
    slab = T().translate([1, 0, 0]).rotate([0, 0, 1], 20).scale([0.01, 0.5, 0.5])
    return {
        "nothing": {},
        "slab": {"slab": {"type": "cube", "to_world": slab, "b": {"type": "dielectric"}}},
        "lens": {
            "lens": {
                "type": "sphere",
                "center": [0.52, 0, 0],
                "radius": 0.5,
                "b": {"type": "dielectric", "int_ior": 1.05},
            }
        },
        "ball": {
            "ball": {
                "type": "sphere",
                "center": [1.3, 0, 0],
                "radius": 0.5,
                "b": {"type": "dielectric", "int_ior": 1.3},
            }
        },
        "mirror": {
            "mirror": {
                "type": "rectangle",
                "to_world": T().translate([1, 0, 0]).rotate([0, 0, 1], 45).rotate([0, 1, 0], -90).scale(0.5),
                "b": {"type": "twosided", "b": {"type": "conductor", "material": "Ag"}},
            },
            "left": wall(T().translate([1, -2, 0]).rotate([1, 0, 0], -90).scale(3)),
            "right": wall(T().translate([1, 2, 0]).rotate([1, 0, 0], 90).scale(3)),
        },
    }[name]


@pytest.mark.parametrize(
    ("name", "tolerance"),
    [
        ("nothing", 0.004),
        *to_validate(("slab", 0.015), ("lens", 0.008), ("ball", 0.015), ("mirror", 0.008)),
    ],
)
def test_beams_that_tile_a_field_equal_the_light_of_a_projector(name: str, tolerance: float) -> None:
    """Every beam is seen by a receiver of the whole field; together they bring what a projector of all brings.

    Behind glass and mirrors the projector's light comes as caustics, so another algorithm agrees. A slab loses
    1 %: light that comes to the wall by one way and leaves it by another.
    """
    scene = corner_with(**obstacle(name))
    projector = Intrinsics.from_fov(256, 256, 6.0)
    pose = scene.rig().T_world_camera
    f = 64 / FIELD
    options: dict[str, Any] = {"max_depth": 6, "glint": False}
    full = Rig(Intrinsics(64, 64, f, f, 32, 32), projector, pose, projector_power_w=TILES**2)
    wanted = transport(scene, full, [IdealToF()], spp=64, indirect="raw", **options)
    receivers = RayTable(np.broadcast_to([0.0, 0.0, 1.0], (TILES, TILES, 3)), field_rad=(FIELD, FIELD))
    side = 2 * np.tan(np.radians(3)) / TILES
    axes = Intrinsics.from_fov(TILES, TILES, 6.0).pixel_rays().directions
    beams = Rig(receivers, Beam((side, side), "box", directions=axes), pose)
    found = transport(scene, beams, [IdealToF()], spp=1 << 13, **options)
    # The mean over the pixels is the mean radiance over the field
    assert found.energy.projector.sum() == pytest.approx(wanted.energy.projector.mean(), rel=tolerance)
    if name == "nothing":
        assert found.energy.multipath.sum() == pytest.approx(wanted.energy.multipath.mean(), rel=0.02)


@pytest.mark.parametrize("profile", ["gaussian", "box"])
def test_radiance_of_a_wall_is_that_of_the_closed_form(profile: Any) -> None:
    """A perpendicular wall at distance d: mean of rho / pi P p(a, b) / d^2 over the receiver's box."""
    T = mi.ScalarTransform4f
    scene = load_scene(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 20.0, "to_world": T().look_at([0, 0, 0], [1, 0, 0], [0, 0, 1])},
            "wall": wall(T().translate([11.7, 0, 0]).rotate([0, 1, 0], -90).scale(30), 0.4),
        }
    )
    ray = RayTable(np.array([[[0.0, 0.0, 1.0]]]), field_rad=(3.2e-3, 2e-3))
    beam = Beam((3e-3, 1e-3), profile)
    rig = Rig(ray, beam, scene.rig().T_world_camera, projector_power_w=0.7)
    direct = transport(scene, rig, [IdealToF()], spp=4096, max_depth=2, glint=False).energy.direct
    inside = 1.0
    for field, width in zip(ray.field_rad, beam.divergence_rad, strict=True):
        part = erf(np.sqrt(2) * field / width) if profile == "gaussian" else min(1.0, width / field)
        inside *= part * (1.0 if profile == "gaussian" else max(1.0, field / width))
    density = inside / (ray.field_rad[0] * ray.field_rad[1])
    assert direct[0, 0] == pytest.approx(0.4 / np.pi * 0.7 * density / 11.7**2, rel=5e-3)


def test_a_beam_in_a_corner_has_no_multipath() -> None:
    corner = load_scene("corner")
    flood = corner.rig(baseline_m=0.001, width=40, height=30)
    sensor = AmcwToF((20e6, 80e6, 100e6), contrast=1.0)
    table = RayTable.of(flood.camera, field_rad=(3e-3, 3e-3))
    beam = Rig(table, Beam((3e-3, 3e-3)), flood.T_world_camera)
    errors = []
    for rig, spp in ((flood, 64), (beam, 64)):
        signals = transport(corner, rig, [sensor], spp=spp, max_depth=6, glint=False, indirect="raw")
        image = decode(expose(signals, sensor, None))
        errors.append((image.range_m - signals.truth.range_m)[15, [5, 10, 15, 18]])
    assert (errors[0] > 0.02).all()  # a lamp that lights everything: centimetres
    assert np.abs(errors[1]).max() <= 1e-4  # 0.01 cm


def test_an_edge_splits_a_beam_by_its_profile() -> None:
    """Sweep an edge through a Gaussian beam: the fraction of the near return is that of the beam in front of it."""
    T = mi.ScalarTransform4f
    scene = load_scene(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 20.0, "to_world": T().look_at([0, 0, 0], [1, 0, 0], [0, 0, 1])},
            "far": wall(T().translate([12, 0, 0]).rotate([0, 1, 0], -90).scale(30)),
            "near": wall(T().translate([10, 5, 0]).rotate([0, 1, 0], -90).scale([5, 5, 1])),  # y > 0, left of the axis
        }
    )
    steps = np.linspace(-1.2e-3, 1.2e-3, 13)  # radians to the right of the edge
    directions = np.stack([np.tan(steps), 0 * steps, np.ones_like(steps)], axis=-1)[None]
    width = 2e-3
    table = RayTable(directions, field_rad=(6e-3, 6e-3))
    rig = Rig(table, Beam((width, width)), scene.rig().T_world_camera)
    sensor = DirectToF(bins=200, bin_s=1e-9, pulse_fwhm_s=0.0)
    signals = transport(scene, rig, [sensor], spp=1 << 14, max_depth=2, glint=False)
    histogram = signals.channels[sensor.responses()[0]][:, 0]
    split = round(2 * 11 / 299792458.0 / 1e-9)
    near, far = histogram[:split].sum(axis=0), histogram[split:].sum(axis=0)
    covered = (1 + erf(-steps * 2 * np.sqrt(2) / width)) / 2  # of the beam's power
    # A surface returns rho / pi P / d^2 of what reaches it
    fraction = (near * 10**2) / (near * 10**2 + far * 12**2)
    np.testing.assert_allclose(fraction, covered, atol=0.01)
    middle = np.abs(steps) < 0.7e-3
    np.testing.assert_allclose(fraction[middle], covered[middle], rtol=0.05)


def test_offset_emitters_measure_the_triangle() -> None:
    """An emitter 5 cm beside its ray: the path is longer than twice the range, and the decoder takes that off."""
    scene = corner_with()
    table = RayTable.of(Intrinsics.from_fov(5, 5, 4.0), field_rad=(1e-3, 1e-3))
    rig = Rig(table, Beam((0.2, 0.2), offset_m=(0.05, 0.02)), scene.rig().T_world_camera)
    sensor = IdealToF()
    signals = transport(scene, rig, [sensor], spp=16, max_depth=2)
    image = decode(expose(signals, sensor, None))
    assert image.valid.all()
    np.testing.assert_allclose(image.range_m, signals.truth.range_m, atol=2e-4)


def test_beams_have_the_same_bytes_twice_and_no_samples_of_others() -> None:
    scene = corner_with(**obstacle("slab"))
    table = RayTable.of(Intrinsics.from_fov(6, 5, 4.0), field_rad=(1e-3, 1e-3))
    rig = Rig(table, Beam(), scene.rig().T_world_camera)
    sensor = DirectToF(bins=64, bin_s=1e-9, pulse_fwhm_s=2e-9)
    one, other = (transport(scene, rig, [sensor], spp=8, seed=3) for _ in range(2))
    for response, values in one.channels.items():
        np.testing.assert_array_equal(values, other.channels[response])
    assert one.energy.caustic.sum() == 0
    assert one.energy.specular.sum() > 0  # the wall behind the slab


def test_a_mirror_sends_a_beam_back_into_its_own_eye() -> None:
    """A mirror at distance d shows the emitter, a disc of radius a, at 2 d: its radiance is P p / (pi a^2)."""
    T = mi.ScalarTransform4f
    silver = {"type": "twosided", "b": {"type": "conductor", "material": "none"}}
    scene = load_scene(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 20.0, "to_world": T().look_at([0, 0, 0], [1, 0, 0], [0, 0, 1])},
            "mirror": {
                "type": "rectangle",
                "to_world": T().translate([2, 0, 0]).rotate([0, 1, 0], -90).scale(0.5),
                "b": silver,
            },
        }
    )
    field, a, d = 4e-3, 3e-3, 2.0
    table = RayTable(np.array([[[0.0, 0.0, 1.0], [0.05, 0.0, 1.0]]]), field_rad=(field, field))
    rig = Rig(
        table, Beam((8e-3, 8e-3), "box"), scene.rig().T_world_camera, projector_lens=Lens(a), projector_power_w=0.5
    )
    sensor = DirectToF(bins=64, bin_s=1e-9, pulse_fwhm_s=0.0)
    signals = transport(scene, rig, [sensor], spp=1 << 14)
    seen = np.pi * (a / (2 * d)) ** 2 / field**2  # fraction of the receiver's field that sees the disc
    expected = seen * 0.5 / 8e-3**2 / (np.pi * a**2)
    assert signals.energy.glint[0, 0] == pytest.approx(expected, rel=0.02)
    assert signals.energy.glint[0, 1] == 0  # the oblique beam goes elsewhere
    histogram = signals.channels[sensor.responses()[0]][:, 0, 0]
    assert np.flatnonzero(histogram).tolist() == [int(2 * d / 299792458.0 / 1e-9)]
    assert transport(scene, rig, [sensor], spp=16, glint=False).energy.glint.sum() == 0


def test_the_floor_of_a_pool_is_as_bright_as_the_closed_form() -> None:
    """Light that ends inside glass or water: a beam through a plane at 1 m, of index n, to a floor 1 m below it.

    The refracted beam spreads over (1 + 1 / n)^2 m2/sr; the radiance falls by n^2 on the way out.
    """
    T, n, power, width = mi.ScalarTransform4f, 1.33, 0.7, 4e-3
    scene = load_scene(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 20.0, "to_world": T().look_at([0, 0, 0], [1, 0, 0], [0, 0, 1])},
            "water": {
                "type": "rectangle",
                "to_world": T().translate([1, 0, 0]).rotate([0, 1, 0], -90).scale(3),
                "b": glass(n),
            },
            "floor": wall(T().translate([2, 0, 0]).rotate([0, 1, 0], -90).scale(3)),
        }
    )
    ray = RayTable(np.array([[[0.0, 0.0, 1.0]]]), field_rad=(1e-3, 1e-3))
    rig = Rig(ray, Beam((width, width), "box"), scene.rig().T_world_camera, projector_power_w=power)
    energy = transport(scene, rig, [IdealToF()], spp=1 << 14, max_depth=2, glint=False).energy
    passed = 1 - ((n - 1) / (n + 1)) ** 2
    irradiance = passed * power / width**2 / (1 + 1 / n) ** 2
    assert energy.specular[0, 0] == pytest.approx(0.6 / np.pi * irradiance * passed / n**2, rel=5e-3)


@pytest.mark.parametrize("around_mirror", [True, False])
def test_fog_before_and_behind_a_mirror_weakens_a_beam_and_sends_it_back(around_mirror: bool) -> None:
    """A mirror at 2 m turns the beam onto a wall 1.5 m away. The fog's own return is that of the LiDAR equation,
    sigma_s / (4 pi) P p / d^2 exp(-2 sigma_t d) for isotropic scattering."""
    T, sigma, albedo, width = mi.ScalarTransform4f, 0.3, 0.8, 4e-3

    def fog(*, begin: float, end: float) -> dict[str, Any]:
        """Between two heights above the mirror."""
        middle, half = (begin + end) / 2, (end - begin) / 2
        return {
            "type": "cube",
            "to_world": T().translate([2, 0, middle]).scale([1, 1, half]),
            "b": {"type": "null"},
            "interior": {"type": "homogeneous", "sigma_t": sigma, "albedo": albedo, "phase": {"type": "isotropic"}},
        }

    begin, end = (-1.0, 1.2) if around_mirror else (0.6, 1.2)
    scene = load_scene(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 20.0, "to_world": T().look_at([0, 0, 0], [1, 0, 0], [0, 0, 1])},
            "mirror": {
                "type": "rectangle",
                "to_world": T().translate([2, 0, 0]).rotate([0, 1, 0], -45).scale(0.3),
                "b": {"type": "twosided", "b": {"type": "conductor", "material": "none"}},
            },
            "ceiling": wall(T().translate([2, 0, 1.5]).rotate([1, 0, 0], 180).scale(3)),
            "fog": fog(begin=begin, end=end),
        }
    )
    ray = RayTable(np.array([[[0.0, 0.0, 1.0]]]), field_rad=(1e-3, 1e-3))
    rig = Rig(ray, Beam((width, width), "box"), scene.rig().T_world_camera)
    sensor = DirectToF(bins=256, bin_s=2e-10, pulse_fwhm_s=0.0, laser="single-shot")
    signals = transport(scene, rig, [sensor], spp=1 << 15, max_depth=2, glint=False)
    histogram, bin_m = signals.channels[sensor.responses()[0]][:, 0, 0], 299792458.0 * 2e-10 / 2
    d = (np.arange(256) + 0.5) * bin_m
    before_mirror = 1.0 if around_mirror else 0.0  # metres of fog
    wall_part = histogram[np.abs(d - 3.5) < 0.1].sum()
    through = before_mirror + end - max(begin, 0.0)
    expected = 0.6 / np.pi / width**2 / 3.5**2 * np.exp(-2 * sigma * through)
    assert wall_part == pytest.approx(expected, rel=0.05)
    shown = (d > 2.05 + max(begin, 0.0)) & (d < 1.95 + end)
    crossed = before_mirror + d[shown] - 2 - max(begin, 0.0)
    returned = sigma * albedo / (4 * np.pi) / width**2 / d[shown] ** 2 * np.exp(-2 * sigma * crossed) * bin_m
    assert histogram[shown].sum() == pytest.approx(returned.sum(), rel=0.05)


def test_a_beam_through_rough_glass_brings_the_light_of_a_projector() -> None:
    """The spot lies on the rough face of water or glass and lights the floor behind it: power, not radiance, crosses
    the face, so nothing falls by n^2. A projector with the field of the beam is found by path tracing alone."""
    T, width = mi.ScalarTransform4f, 0.6
    rough = {"type": "roughdielectric", "alpha": 0.6, "int_ior": 1.33}
    scene = load_scene(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 20.0, "to_world": T().look_at([0, 0, 0], [1, 0, 0], [0, 0, 1])},
            "water": {
                "type": "rectangle",
                "to_world": T().translate([1, 0, 0]).rotate([0, 1, 0], -90).scale(5),
                "b": rough,
            },
            "floor": wall(T().translate([1.5, 0, 0]).rotate([0, 1, 0], -90).scale(6), 0.8),
        }
    )
    table = RayTable(np.broadcast_to([0.0, 0.0, 1.0], (8, 8, 3)), field_rad=(0.1, 0.1))
    pose, f = scene.rig().T_world_camera, 64 / width
    emitters = Beam((width, width), "box"), Intrinsics(64, 64, f, f, 32, 32)
    beam, projector = (
        transport(scene, Rig(table, emitter, pose), [IdealToF()], spp=1 << 12, max_depth=8, glint=False).energy
        for emitter in emitters
    )
    assert beam.direct.mean() == pytest.approx(projector.direct.mean(), rel=1e-3)
    assert beam.multipath.mean() == pytest.approx(projector.multipath.mean(), rel=0.06)
