# SPDX-License-Identifier: Apache-2.0
"""Translucent objects against closed forms of radiative transfer and against Mitsuba's own volumetric integrator.

A deep slab of matched index is a half space: its radiance has Chandrasekhar's closed form (Radiative Transfer, 1950).
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from delta_scenes import thrown_w
from plain_mitsuba import plain_scene, render, show, z_score
from tiers import to_validate

import rangesim
from rangesim import AmcwToF, transport
from rangesim.environment.backend import select_variant
from rangesim.errors import FileFormatError
from rangesim.response import SPEED_OF_LIGHT, Fringes, Images, Phasor
from rangesim.rig import translation

ROOT = Path(__file__).resolve().parent.parent
TOP_M = 0.02
"""Height of the slab's upper face; the camera is 0.5 m above z = 0."""
UP = [0.1, 1, 0]
"""Oblique, so that no row of pixel centres runs along the seam of a face's two triangles, where rays slip through."""
MILK_G = 0.8
LARGE = 100.0


@pytest.fixture(scope="module", autouse=True)
def variant() -> None:
    """Mitsuba's types have no names before."""
    select_variant()


def medium(sigma_t: float, albedo: float, g: float = 0.0) -> dict[str, Any]:
    phase = {"type": "hg", "g": g} if g else {"type": "isotropic"}
    return {"type": "homogeneous", "sigma_t": float(sigma_t), "albedo": float(albedo), "phase": phase}


def scene_of(shape: dict[str, Any], inside: dict[str, Any], size: tuple[int, int] = (24, 18), **more: Any) -> Any:
    """A translucent shape under a camera that looks straight down from z = 0.5 m."""
    import mitsuba as mi

    view = mi.ScalarTransform4f().look_at([0, 0, 0.5 * more.pop("scale", 1.0)], [0, 0, 0], UP)
    film = {"type": "hdrfilm", "width": size[0], "height": size[1]}
    body = {**shape, "bsdf": {"type": "null"}, "interior": inside}
    camera = {"type": "perspective", "fov": more.pop("fov", 6.0), "to_world": view, "film": film}
    return rangesim.load_scene({"type": "scene", "camera": camera, "body": body, **more})


def slab(scale: float = 1.0, depth_m: float = 0.04) -> dict[str, Any]:
    import mitsuba as mi

    half = depth_m / 2
    T = mi.ScalarTransform4f()
    return {
        "type": "cube",
        "to_world": T.translate([0, 0, scale * (TOP_M - half)]) @ T.scale([0.3 * scale, 0.3 * scale, half * scale]),
    }


def ball(scale: float = 1.0) -> dict[str, Any]:
    return {"type": "sphere", "radius": 0.05 * scale}


def floor(scale: float = 1.0) -> dict[str, Any]:
    import mitsuba as mi

    T = mi.ScalarTransform4f()
    return {"type": "rectangle", "to_world": T.translate([0, 0, -0.06 * scale]) @ T.scale(0.5 * scale)}


def geometry(rig: rangesim.Rig, truth: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Irradiance across the beam at the first surface, cosines of light and view there, cosine of the turn."""
    eye, lamp = rig.T_world_camera[:3, 3], (rig.T_world_camera @ rig.T_camera_projector)[:3, 3]
    axis = (rig.T_world_camera @ rig.T_camera_projector)[:3, 2]
    rays = rig.camera.directions(rig.camera.pixel_centres()) @ rig.T_world_camera[:3, :3].T
    points = eye + rays / np.linalg.norm(rays, axis=-1, keepdims=True) * truth.range_m[..., None].astype(float)
    to_eye, to_lamp = (x - points for x in (eye, lamp))
    to_eye, to_lamp = (x / np.linalg.norm(x, axis=-1, keepdims=True) for x in (to_eye, to_lamp))
    z = (points - lamp) @ axis
    irradiance = rig.projector_irradiance / (z**2 * -(to_lamp @ axis))
    return irradiance, to_lamp[..., 2], to_eye[..., 2], -np.sum(to_eye * to_lamp, axis=-1)


def hg(cosine: np.ndarray, g: float) -> np.ndarray:
    return np.asarray((1 - g**2) / (4 * np.pi * (1 + g**2 - 2 * g * cosine) ** 1.5))


@cache
def _h_nodes(albedo: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Chandrasekhar's H on Gauss nodes in 0..1, by iteration of 1/H = sqrt(1-a) + a/2 int x H(x) / (x + mu) dx."""
    x, w = np.polynomial.legendre.leggauss(64)
    x, w, h = (x + 1) / 2, w / 2, np.ones(64)
    for _ in range(2000):
        h = 1 / (np.sqrt(1 - albedo) + albedo / 2 * ((w * x * h) / (x + x[:, None])).sum(axis=1))
    return x, w, h


def half_space(albedo: float, cos_light: np.ndarray, cos_view: np.ndarray) -> np.ndarray:
    """Radiance of an isotropic half space per irradiance across the beam: a mu0 H(mu0) H(mu) / (4 pi (mu0 + mu))."""
    x, w, h = _h_nodes(albedo)

    def H(mu: np.ndarray) -> np.ndarray:
        return 1 / (np.sqrt(1 - albedo) + albedo / 2 * ((w * x * h) / (x + mu[..., None])).sum(axis=-1))

    return albedo * cos_light / (4 * np.pi * (cos_light + cos_view)) * H(cos_light) * H(cos_view)


# ---- Closed forms -----------------------------------------------------------------------------------


@pytest.mark.parametrize("g", [0.8, *to_validate(0.0, -0.3)])
def test_light_scattered_once_has_chandrasekhar_s_closed_form(g: float) -> None:
    """L = albedo p(theta) E mu0 / (mu0 + mu) (1 - exp(-sigma_t d (1/mu0 + 1/mu))) for a slab of depth d."""
    for sigma_t, depth_m, spp in ((3000.0, 0.04, 1024), (250.0, 0.004, 2048)):
        scene = scene_of(slab(depth_m=depth_m), medium(sigma_t, 0.7, g))
        rig = scene.rig(baseline_m=0.25)
        signals = transport(scene, rig, [], spp=spp, caustics=False)
        irradiance, light, view, turn = geometry(rig, signals.truth)
        expected = 0.7 * hg(turn, g) * irradiance * light / (light + view)
        expected *= 1 - np.exp(-sigma_t * depth_m * (1 / light + 1 / view))
        assert signals.energy.direct.mean() == pytest.approx(expected.mean(), rel=6e-3)
        np.testing.assert_allclose(signals.energy.direct, expected, rtol=0.12)


@pytest.mark.parametrize("albedo", [0.9, *to_validate(0.5, 0.99)])
def test_a_dense_medium_reflects_as_the_h_functions_say(albedo: float) -> None:
    scene = scene_of(slab(), medium(8000.0, albedo))
    rig = scene.rig(baseline_m=0.25)
    signals = transport(scene, rig, [], spp=512, caustics=False)
    irradiance, light, view, _ = geometry(rig, signals.truth)
    expected = irradiance * half_space(albedo, light, view)
    assert signals.energy.projector.mean() == pytest.approx(expected.mean(), rel=0.01)
    assert not signals.energy.specular.any()
    assert not signals.energy.caustic.any()


def mean_delay_m(sigma_t: float, albedo: float) -> tuple[float, float]:
    """Measured and expected optical length beyond that of the boundary; phases far below one turn add up as lengths.

    Absorption weighs a path of length l inside by exp(-sigma_a l), so the mean of l is -d ln L / d sigma_a.
    """
    scene = scene_of(slab(), medium(sigma_t, albedo))
    rig = scene.rig(baseline_m=0.05)
    slow = Phasor(10e6)
    signals = transport(scene, rig, [slow], spp=512, caustics=False)
    eye, lamp = rig.T_world_camera[:3, 3], (rig.T_world_camera @ rig.T_camera_projector)[:3, 3]
    rays = rig.camera.directions(rig.camera.pixel_centres()) @ rig.T_world_camera[:3, :3].T
    points = eye + rays / np.linalg.norm(rays, axis=-1, keepdims=True) * signals.truth.range_m[..., None]
    to_boundary = signals.truth.range_m + np.linalg.norm(points - lamp, axis=-1)
    c, s = signals.channels[slow].astype(float)
    turn = 2 * np.pi * slow.modulation_hz / SPEED_OF_LIGHT
    cos, sin = np.cos(turn * to_boundary), np.sin(turn * to_boundary)
    measured = np.arctan2((s * cos - c * sin).sum(), (c * cos + s * sin).sum()) / turn
    _, light, view, _ = geometry(rig, signals.truth)
    step = 1e-4 * albedo * (1 - albedo)
    logs = [np.log(half_space(a, light, view)).mean() for a in (albedo - step, albedo + step)]
    return float(measured), float(albedo / sigma_t * (logs[1] - logs[0]) / (2 * step))


@pytest.mark.validation
def test_translucent_objects_read_too_long_and_halving_the_density_doubles_it() -> None:
    found = {sigma_t: mean_delay_m(sigma_t, 0.9) for sigma_t in (4000.0, 2000.0)}
    for measured, expected in found.values():
        assert expected > 0
        assert measured == pytest.approx(expected, rel=0.02)
    assert found[2000.0][0] / found[4000.0][0] == pytest.approx(2, rel=0.03)


def test_the_decoded_range_is_behind_the_boundary() -> None:
    scene = scene_of(slab(), medium(1000.0, 0.998))
    rig = scene.rig(baseline_m=0.02)
    sensor = AmcwToF()
    signals = transport(scene, rig, [sensor], spp=64, caustics=False)
    capture = rangesim.expose(signals, sensor, rangesim.Detector.ideal())
    image = rangesim.decode(capture)
    bias = np.nanmedian(image.range_m - signals.truth.range_m)
    assert 0.002 < bias < 0.05
    assert (signals.energy.multipath > signals.energy.direct).all()


@pytest.mark.validation
def test_stripes_finer_than_the_mean_free_path_lose_their_contrast() -> None:
    scene = scene_of(slab(), medium(1000.0, 0.99))
    rig = scene.rig(baseline_m=0.1, projector_size=(640, 400))
    pixel_m = 0.49 / rig.projector.fx  # projector pixel on the slab, about
    stripes = [Fringes(0, period_m / pixel_m) for period_m in (0.001, 0.004, 0.016)]
    signals = transport(scene, rig, stripes, spp=256, caustics=False)
    contrasts = [np.median(np.hypot(*signals.channels[s]) / signals.energy.projector) for s in stripes]
    assert contrasts[0] < contrasts[1] < contrasts[2]
    assert contrasts[0] < 0.5 < contrasts[2]


# ---- Against Mitsuba's own volumetric integrator ----------------------------------------------------


@pytest.mark.validation
@pytest.mark.parametrize(
    ("shape", "inside", "white", "spp"),
    [
        (ball, (10.0, 0.9, 0.0), True, 100),
        (ball, (100.0, 0.99, MILK_G), False, 256),
        (ball, (1000.0, 0.95, 0.0), False, 100),
        (slab, (200.0, 0.95, -0.3), True, 100),
        (slab, (100.0, 0.9, MILK_G), False, 256),
    ],
)
def test_white_and_stripes_agree_with_volpath(
    shape: Any, inside: tuple[float, float, float], white: bool, spp: int
) -> None:
    """In a large scene, because Mitsuba's integrator starts rays 0.1 mm off each surface: too much of a free path of
    1 mm. Ours measures from the surface itself, and gives the same in any units. White is half stripes: it is looked at
    by itself for one body of each shape."""
    import mitsuba as mi

    sigma_t, albedo, g = inside
    body = medium(sigma_t / LARGE, albedo, g)
    scene = scene_of(shape(LARGE), body, size=(48, 36), fov=20.0, scale=LARGE, floor=floor(LARGE))
    rig = scene.rig(baseline_m=0.1 * LARGE, projector_size=(160, 100))
    stripes = np.zeros((1, 100, 160), np.float32)
    stripes[0, :, np.arange(160) // 10 % 2 == 0] = 1
    response = Images(stripes)
    signals = transport(scene, rig, [response], spp=spp, max_depth=1000, rr_depth=50, caustics=False, seed=3)
    plain = plain_scene(scene, rig, {"type": "hdrfilm", "pixel_format": "luminance"})
    volpath = mi.load_dict({"type": "volpath", "max_depth": 10_000, "rr_depth": 20})
    compared = [(signals.channels[response][0], stripes[0])]
    if white:
        compared.append((signals.energy.projector, np.ones_like(stripes[0])))
    for own, pattern in compared:
        show(plain, pattern)
        reference = render(plain, volpath, spp=spp, seed=11)
        assert abs(z_score(own, reference)) < 5
        assert own.mean() == pytest.approx(reference.mean(), rel=0.015)


@pytest.mark.validation
def test_sun_and_lamps_reach_a_medium_as_in_volpath() -> None:
    import mitsuba as mi

    T = mi.ScalarTransform4f()
    sun = {"type": "directional", "direction": [0.3, 0.2, -1], "irradiance": 2.0}
    panel = {"type": "rectangle", "to_world": T.translate([0.1, 0, 0.6]) @ T.rotate([1, 0, 0], 180) @ T.scale(0.1)}
    panel["emitter"] = {"type": "area", "radiance": 3.0}
    sky = {"type": "constant", "radiance": 0.2}
    for lights, spp in (({"sun": sun}, 64), ({"panel": panel}, 256), ({"sun": sun, "sky": sky}, 64)):
        scene = scene_of(ball(), medium(100.0, 0.9, 0.5), size=(48, 36), fov=20.0, floor=floor(), **lights)
        rig = scene.rig(baseline_m=0.1)
        signals = transport(scene, rig, [], spp=spp, max_depth=1000, rr_depth=50, caustics=False, glint=False, seed=3)
        camera = {
            "type": "perspective",
            "fov": 20.0,
            "near_clip": 1e-5,
            "to_world": mi.ScalarTransform4f(mi.ScalarTransform4f().look_at([0, 0, 0.5], [0, 0, 0], UP).matrix),
        }
        film = {"type": "hdrfilm", "pixel_format": "luminance", "width": 48, "height": 36, "rfilter": {"type": "box"}}
        plain = mi.load_dict(
            {
                "type": "scene",
                "camera": {**camera, "film": film},
                "floor": floor(),
                **lights,
                "body": {**ball(), "bsdf": {"type": "null"}, "interior": medium(100.0, 0.9, 0.5)},
            }
        )
        volpath = mi.load_dict({"type": "volpath", "max_depth": 10_000, "rr_depth": 20})
        reference = render(plain, volpath, spp=spp, seed=11)
        assert abs(z_score(signals.energy.ambient, reference)) < 5
        assert signals.energy.ambient.mean() == pytest.approx(reference.mean(), rel=0.015)


# ---- What is promised -------------------------------------------------------------------------------


def test_the_first_surface_of_a_translucent_object_is_its_boundary() -> None:
    scene = scene_of(slab(), medium(100.0, 0.9))
    truth = transport(scene, scene.rig(baseline_m=0.1), [], spp=1, caustics=False).truth
    np.testing.assert_allclose(truth.z, 0.5 - TOP_M, atol=1e-5)
    assert [i.material for i in scene.instances] == ["translucent"]
    assert truth.projector_visible.all()


def test_a_stay_inside_a_medium_counts_as_one_surface() -> None:
    """Depth 2 is one surface, or one stay with all its events; nothing is left to deeper paths on a lone body."""
    scene = scene_of(slab(), medium(4000.0, 0.99))
    rig = scene.rig(baseline_m=0.1)
    shallow, deep = (transport(scene, rig, [], spp=64, max_depth=n, caustics=False) for n in (2, 30))
    assert shallow.energy.multipath.mean() > 5 * shallow.energy.direct.mean()
    same = shallow.energy.projector == deep.energy.projector
    assert same.mean() > 0.99  # on a GPU 2 of 432 pixels differ: it rounds otherwise in a kernel for another depth


def test_the_same_seed_gives_the_same_bytes_in_tiles() -> None:
    scene = scene_of(ball(), medium(100.0, 0.99, MILK_G), floor=floor())
    rig = scene.rig(baseline_m=0.1)
    images = [transport(scene, rig, [], spp=8, seed=5, memory_bytes=b).energy.projector for b in (1 << 30, 1 << 16)]
    assert images[0].tobytes() == images[1].tobytes()


def test_caustics_that_cross_a_medium_are_weakened_by_it() -> None:
    """A pane, an absorber, a wall: exp(-sigma_t d) of the light arrives."""
    import mitsuba as mi

    T = mi.ScalarTransform4f()
    wall = {"type": "rectangle", "to_world": T.translate([0, 0, -0.1]) @ T.scale(0.5)}
    pane = {
        "type": "rectangle",
        "to_world": T.translate([0, 0, 0.2]) @ T.scale(0.5),
        "bsdf": {"type": "thindielectric"},
    }
    landed = []
    for sigma_t in (1e-6, 50.0):
        scene = scene_of(slab(depth_m=0.02), medium(sigma_t, 0.0), wall=wall, pane=pane)
        landed.append(thrown_w(scene, scene.rig(baseline_m=0.01)))
    assert landed[1] / landed[0] == pytest.approx(np.exp(-1.0), rel=0.01)


def test_a_medium_alone_has_no_caustics() -> None:
    """Its boundary is crossed by shadow rays, so nothing is left to caustics: the same bytes with them and without."""
    scene = scene_of(ball(), medium(30.0, 0.9), floor=floor())
    rig = scene.rig(baseline_m=0.1)
    with_caustics, without = (transport(scene, rig, [], spp=8, caustics=on) for on in (True, False))
    assert with_caustics.energy.projector.tobytes() == without.energy.projector.tobytes()
    assert not with_caustics.energy.glint.any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"bsdf": {"type": "dielectric"}}, "matched index"),
        ({"interior": {"type": "heterogeneous", "albedo": 0.5}}, "only homogeneous"),
        ({"interior": {"type": "homogeneous", "sigma_t": 0.0}}, "positive sigma_t"),
        ({"interior": {"type": "homogeneous", "phase": {"type": "rayleigh"}}}, "only isotropic and hg"),
        ({"exterior": {"type": "homogeneous"}}, "exterior medium"),
    ],
)
def test_media_that_are_not_traced_are_refused(change: dict[str, Any], message: str) -> None:
    import mitsuba as mi

    if change.get("interior", {}).get("type") == "heterogeneous":
        grid = mi.VolumeGrid(np.ones((2, 2, 2, 1), np.float32))
        change["interior"]["sigma_t"] = {"type": "gridvolume", "grid": grid}
    shape = {**ball(), "bsdf": {"type": "null"}, "interior": medium(10.0, 0.5), **change}
    with pytest.raises(FileFormatError, match=message):
        rangesim.load_scene({"type": "scene", "camera": {"type": "perspective", "fov": 20.0}, "body": shape})


@pytest.mark.parametrize("path", sorted((ROOT / "scenes" / "materials" / "media").glob("*.xml")), ids=lambda p: p.stem)
def test_the_media_of_the_catalogue_load_and_are_translucent(tmp_path: Path, path: Path) -> None:
    file = tmp_path / "scene.xml"
    file.write_text(
        f'<scene version="3.0.0"><sensor type="perspective"/><include filename="materials/media/{path.name}"/>'
        f'<shape type="sphere"><bsdf type="null"/><ref id="{path.stem}" name="interior"/></shape></scene>'
    )
    assert [i.material for i in rangesim.load_scene(file).instances] == ["translucent"]


def test_a_medium_that_fills_nothing_is_refused(tmp_path: Path) -> None:
    scene = tmp_path / "wax.xml"
    scene.write_text(
        '<scene version="3.0.0"><include filename="materials/media/wax.xml"/><sensor type="perspective"/>'
        '<shape type="sphere" id="candle"><bsdf type="null"/><ref id="wax"/></shape></scene>'
    )
    with pytest.raises(FileFormatError, match="shape 'candle' refers to a medium without saying where"):
        rangesim.load_scene(scene)


def fog(shape: str, x: float, absorbs: bool) -> Any:
    """A body of fog or of glass that absorbs, 0.2 m around (x, 0, 0), and a floor below it."""
    import mitsuba as mi

    place = mi.ScalarTransform4f().translate([x, 0, 0]).scale(0.2)
    bsdf = {"type": "dielectric", "int_ior": 1.0001} if absorbs else {"type": "null"}
    body = {"type": shape, "to_world": place, "bsdf": bsdf, "interior": medium(1.5, 0.0 if absorbs else 0.5)}
    down = mi.ScalarTransform4f().translate([0, 0, -1]).scale(3)
    floor = {"type": "rectangle", "to_world": down, "bsdf": {"type": "diffuse"}}
    camera = {"type": "perspective", "fov": 30.0}
    return rangesim.load_scene({"type": "scene", "camera": camera, "fog": body, "floor": floor})


def rig_above(x: float, baseline_m: float) -> rangesim.Rig:
    """A camera at (x, 0, 0) that looks down, and a projector beside it."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[0, 3] = x
    lens = rangesim.Intrinsics.from_fov(8, 6, 30)
    return rangesim.Rig(lens, lens, T_camera_projector=translation(baseline_m, 0, 0), T_world_camera=T)


@pytest.mark.parametrize("shape", ["sphere", "cube"])
@pytest.mark.parametrize("absorbs", [False, True])
@pytest.mark.parametrize(
    ("x", "baseline_m", "inside"), [(0.0, 0.5, "camera"), (0.5, -0.5, "projector"), (0.17, 0.0, "camera")]
)
def test_a_device_inside_a_medium_is_refused(
    shape: str, absorbs: bool, x: float, baseline_m: float, inside: str
) -> None:
    """Its light would be weakened one way alone: exp(-0.3) for exp(-0.6), 0.2 m of fog there and back."""
    scene, rig = fog(shape, 0.0, absorbs), rig_above(x, baseline_m)
    with pytest.raises(ValueError, match=f"the {inside} to stand in air, but it is inside the medium of shape 'fog'"):
        transport(scene, rig, [], spp=1, caustics=False)


@pytest.mark.parametrize("shape", ["sphere", "cube"])
@pytest.mark.parametrize("absorbs", [False, True])
@pytest.mark.parametrize("x", [0.23, -0.23, 1.0])
def test_a_device_beside_a_medium_is_not(shape: str, absorbs: bool, x: float) -> None:
    scene = fog(shape, 0.0, absorbs)
    assert transport(scene, rig_above(x, 0.0), [], spp=1, caustics=False).energy.direct.any()
