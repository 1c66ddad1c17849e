# SPDX-License-Identifier: Apache-2.0
"""Light of lamps without extent (sun, point, spot) through glass and off mirrors, against closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from delta_scenes import (
    DOWN,
    GLASS,
    MIRROR,
    SlabPath,
    fresnel_conductor,
    fresnel_dielectric,
    matte,
    rig_of,
    scene_of,
    slab,
    transform,
    wall,
)
from plain_mitsuba import plain_scene, render, z_score
from scipy.ndimage import binary_erosion

from rangesim import Intrinsics, Rig, Scene, transport
from rangesim.light_transport.caustic_sheets import Sheets
from rangesim.light_transport.lamps import lamp_sheets
from rangesim.light_transport.traced_scene import TracedScene
from rangesim.scene.materials import MATERIAL_CLASSES

CAMERA = Intrinsics.from_fov(32, 24, 10)
PLANE, ALBEDO, IRRADIANCE, INTENSITY = 1.0, 0.5, 2.0, 3.0
SIGMA = 1.5
"""Extinction of a medium, 1/m."""
HOLES: dict[str, Any] = {"type": "mask", "opacity": 0.25, "bsdf": matte()}
THIN = {**GLASS, "type": "thindielectric"}


def sun(x: float = 0.0, y: float = 0.0, z: float = 1.0) -> dict[str, Any]:
    return {"type": "directional", "direction": [x, y, z], "irradiance": IRRADIANCE}


def bulb(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> dict[str, Any]:
    return {"type": "point", "position": [x, y, z], "intensity": INTENSITY}


def ball(radius: float = 0.1, x: float = 0.0, y: float = 0.0, z: float = 0.6) -> dict[str, Any]:
    return {"type": "sphere", "center": [x, y, z], "radius": radius, "bsdf": GLASS}


def box() -> dict[str, Any]:
    return {"type": "cube", "to_world": transform().scale(1.2), "bsdf": matte()}


def fog(near: float, far: float) -> dict[str, Any]:
    """A medium that scatters half of the light that it takes away."""
    medium = {"type": "homogeneous", "sigma_t": SIGMA, "albedo": 0.5}
    return {**slab(near, far, bsdf={"type": "null"}), "interior": medium}


def behind(z: float) -> Rig:
    """A rig on the axis that looks along it."""
    return rig_of(CAMERA, CAMERA, (0.0, 0.0, z), camera_at=(0.0, 0.0, z))


def ambient(scene: Scene, rig: Rig | None = None, **options: Any) -> np.ndarray:
    rig = behind(0.0) if rig is None else rig
    settings = {"spp": 16, "max_depth": 2, "glint": False, "indirect": "raw", **options}
    return np.asarray(transport(scene, rig, [], **settings).energy.ambient)


def light_of(scene: Scene, seed: int = 0) -> Sheets | None:
    rig, zero = behind(0.0), np.zeros(3)
    return lamp_sheets(TracedScene.of(scene.mitsuba, scene.in_renderer(rig)), 5e-3, zero, zero, seed)


def thrown_w(scene: Scene, seeds: int = 1) -> float:
    found = [light_of(scene, seed) for seed in range(seeds)]
    return float(np.mean([0.0 if one is None else one.flux.sum() for one in found]))


# ---- Irradiance in every pixel -----------------------------------------------------------------------


def test_the_sun_through_a_thin_pane_is_direct_light_less_what_the_pane_reflects() -> None:
    """The camera stands behind the pane."""
    direction = np.array([0.2, 0.3, 1.0]) / np.linalg.norm([0.2, 0.3, 1.0])
    scene = scene_of(pane=wall(-0.3, THIN, 2.0), wall=wall(PLANE, matte()), sun=sun(*direction))
    r = fresnel_dielectric(np.hypot(*direction[:2]))
    expected = IRRADIANCE * direction[2] * ALBEDO / np.pi * (1 - r) / (1 + r)
    np.testing.assert_allclose(ambient(scene), expected, rtol=1e-3)


def test_the_sun_off_a_flat_mirror() -> None:
    """Both the sun and its image light the wall."""
    place = transform().translate([0.3, 0, 0.5]).rotate([0, 1, 0], -90).scale(0.45)
    mirror = {"type": "rectangle", "to_world": place, "bsdf": MIRROR}
    scene = scene_of(mirror=mirror, wall=wall(PLANE, matte()), sun=sun(0.6, 0.0, 0.8))
    expected = IRRADIANCE * 0.8 * ALBEDO / np.pi * (1 + fresnel_conductor(0.6))
    np.testing.assert_allclose(ambient(scene), expected, rtol=1e-3)


def test_a_point_lamp_through_a_slab() -> None:
    """Photons bring what is reflected inside the slab, 0.0014 of the light, to some pixels."""
    near, far, camera_at = 0.4, 0.45, 0.6
    glass = slab(near, far, 0.35)  # as wide as a face of the cube around the lamp
    seen = ambient(scene_of(slab=glass, wall=wall(PLANE, matte()), lamp=bulb()), behind(camera_at))
    across = np.linalg.norm(CAMERA.normalise(CAMERA.pixel_centres()), axis=-1) * (PLANE - camera_at)
    way = SlabPath(PLANE, far - near)
    light = way.irradiance(across) / np.sqrt(1 + way.tangent(across) ** 2) ** 3  # a projector has 1 / cos^3
    ratio = seen / (INTENSITY * light * ALBEDO / np.pi)
    assert np.median(ratio) == pytest.approx(1.0, abs=5e-4)
    assert (np.abs(ratio - 1) < 1e-3).mean() > 0.9


# ---- Flux --------------------------------------------------------------------------------------------


def test_the_sun_on_a_glass_ball_over_a_floor() -> None:
    """What the ball reflects and refracts towards the floor, by Fresnel's equations for each distance from its axis."""
    radius, height, half_size = 0.1, 0.4, 5.0
    scene = scene_of(ball=ball(radius, z=PLANE - height), floor=wall(PLANE, matte(), half_size), sun=sun())
    sine = np.sqrt((np.arange(200_000) + 0.5) / 200_000)  # equal areas
    outside, inside = np.arcsin(sine), np.arcsin(sine / 1.5)
    r = fresnel_dielectric(sine)
    parts = [(r, np.pi - 2 * outside)]
    parts += [((1 - r) ** 2 * r**k, 2 * (outside - inside) + k * (np.pi - 2 * inside)) for k in range(8)]
    landed = sum((part * (np.cos(turn) > height / half_size)).mean() for part, turn in parts)
    assert thrown_w(scene, seeds=2) == pytest.approx(IRRADIANCE * np.pi * radius**2 * landed, rel=3e-3)


def test_all_light_of_a_point_lamp_that_meets_a_ball_lands_in_a_closed_box() -> None:
    solid_angle = 2 * np.pi * (1 - np.sqrt(1 - (0.1 / 0.6) ** 2))
    assert thrown_w(scene_of(ball=ball(), box=box(), lamp=bulb())) == pytest.approx(INTENSITY * solid_angle, rel=3e-3)


def test_all_light_of_a_point_lamp_leaves_the_glass_around_it() -> None:
    """It shines through all faces of the cube around it."""
    scene = scene_of(ball=ball(0.1), box=box(), lamp=bulb(0.01, 0.02, 0.58))
    assert thrown_w(scene) == pytest.approx(4 * np.pi * INTENSITY, rel=2e-3)


def test_a_spot_through_a_prism() -> None:
    """Flux and place of the light that is refracted by both faces, against rays by Snell's law."""
    cutoff, width, turn = np.radians([12.0, 6.0, 15.0])
    at = transform().translate([0, 0, 0.4]).rotate([0, 1, 0], float(np.degrees(turn))).scale([2, 2, 1])
    faces = {
        "front": {"type": "rectangle", "to_world": transform().translate([0, 0, 0.3]).scale([2, 2, -1]), "bsdf": GLASS},
        "back": {"type": "rectangle", "to_world": at, "bsdf": GLASS},
    }
    lamp = {
        "type": "spot",
        "to_world": transform().look_at([0, 0, 0], [0, 0, 1], list(DOWN)),
        "cutoff_angle": float(np.degrees(cutoff)),
        "beam_width": float(np.degrees(width)),
        "intensity": INTENSITY,
    }
    sheets = light_of(scene_of(**faces, wall=wall(PLANE, matte()), lamp=lamp))
    assert sheets is not None
    _, which = np.unique(sheets.key, return_inverse=True)
    flux = np.bincount(which, sheets.flux)
    main = which == flux.argmax()
    x = sheets.position[sheets.triangles[main], 0].mean(axis=1, dtype=float)

    t = (np.arange(401) + 0.5) / 401 * 2 - 1
    tx, ty = np.meshgrid(t * np.tan(cutoff), t * np.tan(cutoff))
    d = np.stack([tx, ty, np.ones_like(tx)], axis=-1)
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    light = INTENSITY * np.clip((cutoff - np.arccos(d[..., 2])) / (cutoff - width), 0, 1) * d[..., 2] ** 3
    point, n = 0.3 * d / d[..., 2:], 1.5
    light *= 1 - fresnel_dielectric(np.hypot(d[..., 0], d[..., 1]))
    d = d / n
    d[..., 2] = np.sqrt(1 - d[..., 0] ** 2 - d[..., 1] ** 2)
    normal = np.array([np.sin(turn), 0, np.cos(turn)])
    point = point + d * ((np.array([0, 0, 0.4]) - point) @ normal / (d @ normal))[..., None]
    across = n * (d - (d @ normal)[..., None] * normal)
    sine = np.linalg.norm(across, axis=-1)
    light *= 1 - fresnel_dielectric(sine)
    d = across + np.sqrt(1 - sine**2)[..., None] * normal
    x_by_hand = point[..., 0] + d[..., 0] * (PLANE - point[..., 2]) / d[..., 2]
    assert flux.max() == pytest.approx(light.mean() * (2 * np.tan(cutoff)) ** 2, rel=3e-3)
    assert np.average(x, weights=sheets.flux[main]) == pytest.approx(np.average(x_by_hand, weights=light), abs=3e-4)


# ---- Whose light it is -------------------------------------------------------------------------------


def test_small_glass_before_a_large_pane_has_an_image_of_its_own() -> None:
    """A ray belongs to the image of what it meets first, so the ball, which takes no light, changes no flux."""
    parts = {"pane": wall(1.1, THIN, 1.0), "box": box(), "lamp": bulb(0.0, 0.0, 0.3)}
    alone, both = thrown_w(scene_of(**parts)), thrown_w(scene_of(**parts, ball=ball(0.06)))
    assert both == pytest.approx(alone, rel=2e-3)  # the ball has 3 % of it


def test_something_in_the_way_of_the_sun_shades_the_glass() -> None:
    parts = {"pane": wall(-0.3, THIN, 1.0), "wall": wall(PLANE, matte()), "sun": sun()}
    shade = wall(-50.0, matte(), 0.5)
    free, shaded = thrown_w(scene_of(**parts)), thrown_w(scene_of(**parts, shade=shade))
    assert shaded == pytest.approx(0.75 * free, rel=5e-3)


def test_blends_pass_the_light_that_they_do_not_take() -> None:
    sheet = {"type": "blendbsdf", "weight": 0.25, "one": THIN, "two": {"type": "diffuse"}}
    scene = scene_of(sheet=wall(-0.3, sheet, 0.3), wall=wall(PLANE, matte()), sun=sun())
    r = fresnel_dielectric(0.0)
    assert thrown_w(scene) == pytest.approx(0.36 * IRRADIANCE * 0.75 * (1 - r) / (1 + r), rel=0.03)


@pytest.mark.parametrize("in_fog", [False, True])
def test_light_goes_straight_through_holes_without_photons(in_fog: bool) -> None:
    sheet = wall(0.2, HOLES, 2.0)
    parts = {
        "wall": wall(PLANE, matte()),
        "lamp": bulb(),
        "sun": sun(0.1),
        **({"fog": fog(0.3, 0.4)} if in_fog else {}),
    }
    free, beyond = (ambient(scene_of(**parts, **more), behind(0.6), spp=8) for more in ({}, {"sheet": sheet}))
    np.testing.assert_allclose(beyond.mean(), 0.75 * free.mean(), rtol=0.02)  # which lamp a sample takes is drawn
    alone = {name: part for name, part in parts.items() if name != "sun"}
    free, beyond = (ambient(scene_of(**alone, **more), behind(0.6), spp=8) for more in ({}, {"sheet": sheet}))
    np.testing.assert_allclose(beyond, 0.75 * free, rtol=1e-4)


def test_light_through_holes_and_glass_counts_once() -> None:
    """The pane stands before the sheet, and behind it. Light lands on the sheet before it takes its part."""
    r = fresnel_dielectric(0.0)
    through = (1 - r) / (1 + r)
    for z, landed in ((0.1, 1.75 * through), (0.25, 0.75)):
        parts = {"sheet": wall(0.2, HOLES, 2.0), "pane": wall(z, THIN, 0.3)}
        flux = thrown_w(scene_of(**parts, wall=wall(PLANE, matte()), sun=sun()))
        assert flux == pytest.approx(0.36 * IRRADIANCE * landed, rel=0.03)


def test_light_of_lamps_is_traced_where_there_are_lamps_and_glass_and_it_is_wanted() -> None:
    pane, screen = wall(-0.3, THIN, 2.0), wall(PLANE, matte())
    assert light_of(scene_of(pane=pane, wall=screen)) is None
    assert light_of(scene_of(wall=screen, sun=sun())) is None
    assert not ambient(scene_of(pane=pane, wall=screen, sun=sun()), caustics=False).any()


def test_the_same_seed_gives_the_same_bytes_in_tiles() -> None:
    def seen(memory_bytes: int) -> bytes:
        scene = scene_of(ball=ball(), wall=wall(PLANE, matte()), sun=sun(0.1, 0.2), lamp=bulb(0.2, 0.1, 0.1))
        return ambient(scene, memory_bytes=memory_bytes, max_depth=3, spp=4).tobytes()

    assert len({seen(1 << 30), seen(1 << 18)}) == 1


# ---- Media -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("near", [-0.2, 0.2])
def test_glass_in_a_medium_with_the_lamp_inside_and_outside(near: float) -> None:
    far, camera_at = 0.4, 0.6
    parts = {"fog": fog(near, far), "pane": wall(0.3, THIN, 0.35), "wall": wall(PLANE, matte())}
    seen = ambient(scene_of(**parts, lamp=bulb()), behind(camera_at), spp=64)
    t = np.linalg.norm(CAMERA.normalise(CAMERA.pixel_centres()), axis=-1) * (PLANE - camera_at) / PLANE
    r, length = fresnel_dielectric(t / np.sqrt(1 + t**2)), (far - max(near, 0)) * np.sqrt(1 + t**2)
    light = (1 - r) / (1 + r) * np.exp(-SIGMA * length) / np.sqrt(1 + t**2) ** 4
    np.testing.assert_allclose(seen / (INTENSITY * light * ALBEDO / np.pi), 1, rtol=2e-3)


def test_a_lamp_in_water_that_absorbs() -> None:
    """Its light comes out of the glass `depth` metres in front of it, straight and by way of the back; on the axis."""
    depth, back, camera_at, n = 0.4, 0.2, 0.6, GLASS["int_ior"]
    tank = {**slab(-back, depth, 0.4), "interior": {"type": "homogeneous", "sigma_t": SIGMA, "albedo": 0.0}}
    seen = ambient(scene_of(tank=tank, wall=wall(PLANE, matte()), lamp=bulb()), behind(camera_at), spp=64)
    r = fresnel_dielectric(0.0)
    light = sum(
        part * np.exp(-SIGMA * way) * (1 - r) / (way + n * (PLANE - depth)) ** 2
        for way, part in ((depth, 1.0), (depth + 2 * back, r))
    )
    np.testing.assert_allclose(seen[11:13, 15:17], INTENSITY * light * ALBEDO / np.pi, rtol=2e-3)


# ---- Against a renderer that is not ours -------------------------------------------------------------


@pytest.mark.validation
@pytest.mark.parametrize("kind", ["sun", "point", "spot"])
def test_light_beyond_a_ball_a_slab_and_a_mirror_is_that_of_mitsuba_s_particle_tracer(kind: str) -> None:
    """Where the camera sees matte surfaces; the tracer has no light elsewhere."""
    import mitsuba as mi

    turned = transform().translate([0, 0, PLANE]).rotate([1, 0, 0], 180).scale(0.4)  # it finds mirrored ones black
    on_edge = transform().translate([0.25, 0, PLANE - 0.1]).rotate([0, 1, 0], -90).scale([0.1, 0.2, 1])
    leaning = transform().translate([-0.2, 0.05, PLANE - 0.2]).rotate([1, 1, 0], 25).scale([0.06, 0.06, 0.015])
    parts = {
        "floor": {"type": "rectangle", "to_world": turned, "bsdf": matte()},
        "ball": ball(0.06, 0.02, 0.0, PLANE - 0.15),
        "slab": {"type": "cube", "to_world": leaning, "bsdf": GLASS},
        "mirror": {"type": "rectangle", "to_world": on_edge, "bsdf": MIRROR},
    }
    to_world = transform().look_at([-0.3, 0.1, 0.2], [0.05, 0, 1], list(DOWN))
    lamps = {
        "sun": sun(0.25, -0.1, 1.0),
        "point": bulb(-0.3, 0.1, 0.2),
        "spot": {"type": "spot", "to_world": to_world, "cutoff_angle": 20.0, "intensity": INTENSITY},
    }
    scene = scene_of(**parts, lamp=lamps[kind])
    camera, at = Intrinsics.from_fov(64, 48, 40), (0.0, 0.5, 0.2)
    rig = rig_of(camera, CAMERA, camera_at=at, camera_looks_at=(0.0, 0.0, PLANE))
    depth = {"max_depth": 40, "rr_depth": 40}
    matte_there = transport(scene, rig, [], spp=1).truth.material == MATERIAL_CLASSES.index("matte")
    seen = ambient(scene, rig, spp=64, **depth)
    own = {} if kind == "sun" else {"lamp": lamps[kind]}  # the scene's infinite emitters are in the plain scene anyway
    plain = plain_scene(scene, rig, {"type": "hdrfilm", "pixel_format": "luminance"}, **own)
    params = mi.traverse(plain)
    params["projector.scale"] = 0.0
    params.update()
    tracer = mi.load_dict({"type": "ptracer", **depth})
    reference = np.mean([render(plain, tracer, 2048, seed) for seed in range(4)], axis=0)
    inside = binary_erosion(matte_there, iterations=2)
    assert abs(z_score(seen[inside], reference[inside])) < 5
    assert seen[inside].mean() == pytest.approx(reference[inside].mean(), rel=3e-3)
    plain_light = ambient(scene, rig, spp=64, caustics=False, **depth)
    bright = inside & (seen > 1.5 * plain_light)
    assert seen[bright].mean() == pytest.approx(reference[bright].mean(), rel=1e-2)
