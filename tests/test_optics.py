# SPDX-License-Identifier: Apache-2.0
"""Lenses when rendering: distortion, defocus and vignetting against closed forms, OpenCV and Mitsuba's `thinlens`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import binary_erosion, map_coordinates
from tiers import to_validate

import rangesim
from rangesim import Detector, IdealToF, Intrinsics, Lens, Rig, StructuredLight, decode, expose, look_at, transport
from rangesim.environment.backend import select_variant
from rangesim.response import FirstReturn, Fringes, GrayBits, Images, LightPath, NumpyMath
from rangesim.rig import CAMERA_LENS, translation

SCENES = Path(__file__).resolve().parent.parent / "scenes"
BARREL = (-0.25, 0.08, 1e-3, -2e-3, 0.01)
PINCUSHION = (0.12, -0.03, -1e-3, 1e-3)
FOLDED = (-0.9,)
"""r (1 - 0.9 r^2) turns round at r = 0.61: the corners of a wide image have no ray."""


@pytest.fixture(scope="module")
def plane() -> rangesim.Scene:
    return rangesim.load_scene(SCENES / "plane.xml")


@pytest.fixture(scope="module")
def matte() -> rangesim.Scene:
    return rangesim.load_scene(SCENES / "matte.xml")


def before_plane(scene: rangesim.Scene, width: int = 64, height: int = 48, **changes: Any) -> Rig:
    """Camera and projector at one place, 1 m before the plane, which is parallel to both."""
    projector = changes.pop("projector", Intrinsics.from_fov(1280, 800, 70))
    camera = changes.pop("camera", scene.camera.resized(width, height))
    return Rig(camera, projector, scene.T_world_camera, **changes)


def distorted(intrinsics: Intrinsics, distortion: tuple[float, ...]) -> Intrinsics:
    return dataclasses.replace(intrinsics, distortion=distortion)


def world_points(rig: Rig, z: np.ndarray) -> np.ndarray:
    """(h, w, 3) points in the camera's frame at depth z behind the pixel centres."""
    return rig.camera.directions(rig.camera.pixel_centres()) * z[..., None]


def projector_frame(rig: Rig, points: np.ndarray) -> np.ndarray:
    return (points - rig.T_camera_projector[:3, 3]) @ rig.T_camera_projector[:3, :3]


def under_a_sky() -> rangesim.Scene:
    """A chequered wall 1 m before a camera at (0, 0, 0.5) that looks along +y, a ball before it, and an even sky."""
    import mitsuba as mi

    select_variant()
    T = mi.ScalarTransform4f
    chequers = {"type": "checkerboard", "to_uv": T().scale([20, 20, 1]), "color0": 0.1, "color1": 0.8}
    return rangesim.load_scene(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 50.0,
                "to_world": T().look_at([0, 0, 0.5], [0, 1, 0.5], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": 80, "height": 60},
            },
            "wall": {
                "type": "rectangle",
                "to_world": T().translate([0, 1, 0.5]).rotate([1, 0, 0], 90).scale(1.5),
                "bsdf": {"type": "diffuse", "reflectance": chequers},
            },
            "ball": {
                "type": "sphere",
                "center": [0.1, 0.55, 0.45],
                "radius": 0.1,
                "bsdf": {"type": "diffuse", "reflectance": 0.6},
            },
            "sky": {"type": "constant"},
        }
    )


# ---- Distortion ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("distortion", [(), BARREL, PINCUSHION, FOLDED])
def test_rays_of_the_renderer_are_those_of_the_intrinsics(distortion: tuple[float, ...]) -> None:
    select_variant()
    import drjit as dr
    import mitsuba as mi

    from rangesim.light_transport.camera_rays import Device

    lens = distorted(Intrinsics.from_fov(320, 240, 75), distortion)
    pixels = lens.pixel_centres().reshape(-1, 2)
    device = Device(lens, np.eye(4), CAMERA_LENS)
    ray = device.centre_ray(mi.Point2f(pixels.T))
    exists = np.ones(len(pixels), bool) if ray.exists is None else ray.exists.numpy()
    expected = lens.directions(pixels)
    known = np.isfinite(expected).all(axis=-1)
    assert np.isfinite(np.array(ray.direction)).all()
    assert (exists & ~known).sum() == 0
    assert (known & ~exists).sum() <= 0.002 * len(pixels)  # single precision at the fold
    assert known.all() == (distortion != FOLDED)
    direction = np.array(ray.direction).T
    lost = (direction[:, :2] / direction[:, 2:] - expected[:, :2])[exists] * lens.fx
    radius = np.linalg.norm(expected[exists][:, :2], axis=-1)
    away = radius < 0.97 * np.sqrt(lens.fold_radius2)
    assert np.abs(lost[away]).max() < 1e-3
    back, _ = device.project(mi.Point3f(ray.direction * 1.7))
    assert np.abs(np.array(back).T - pixels)[exists].max() < 1e-2
    dr.sync_thread()


@pytest.mark.validation
def test_a_distorted_camera_sees_the_undistorted_image_at_opencv_s_places(matte: rangesim.Scene) -> None:
    rig = matte.rig(width=96, height=72)
    sharp = transport(matte, rig, [], spp=256)
    bent_rig = dataclasses.replace(rig, camera=distorted(rig.camera, PINCUSHION))
    bent = transport(matte, bent_rig, [], spp=256)
    xy = rig.camera.project(bent_rig.camera.directions(rig.camera.pixel_centres())) - 0.5
    at = np.moveaxis(xy[..., ::-1], -1, 0)
    expected = map_coordinates(sharp.energy.direct, at, order=1, cval=0)
    lit = (expected > 0) & (sharp.energy.direct > 0)
    assert lit.mean() > 0.7
    error = np.median(np.abs(bent.energy.direct[lit] / expected[lit] - 1))
    unmapped = np.median(np.abs(bent.energy.direct[lit] / sharp.energy.direct[lit] - 1))
    assert error < 0.005
    assert unmapped > 4 * error  # the test can tell


def test_ground_truth_and_decoding_agree_through_two_distorted_lenses(plane: rangesim.Scene) -> None:
    """The camera is 1 m before the plane: its depth is 1 m wherever the pixel looks."""
    rig = plane.rig(baseline_m=0.2, width=64, height=48, projector_size=(320, 200))
    rig = dataclasses.replace(rig, camera=distorted(rig.camera, BARREL), projector=distorted(rig.projector, PINCUSHION))
    sensor = StructuredLight(320, 200, axes=("columns", "rows"))
    signals = transport(plane, rig, [sensor], spp=1024)
    truth = signals.truth
    np.testing.assert_allclose(truth.z, 1, atol=1e-5)
    uv = rig.projector.project(projector_frame(rig, world_points(rig, truth.z.astype(float))))
    assert np.abs(truth.projector_uv - uv).max() < 1e-2
    image = decode(expose(signals, sensor))
    inner = binary_erosion(truth.projector_visible, iterations=2)  # whole pixels lit
    assert inner.mean() > 0.8
    assert image.valid[inner].all()
    assert np.abs(image.z - 1)[inner].max() < 5e-4  # as without distortion: a pixel sees the mean over its area
    assert abs((image.z - 1)[inner].mean()) < 2e-4


def test_pixels_without_a_ray_get_neither_light_nor_truth(plane: rangesim.Scene) -> None:
    rig = before_plane(plane, camera=distorted(Intrinsics.from_fov(64, 48, 75), FOLDED))
    signals = transport(under_a_sky(), rig, [StructuredLight(), FirstReturn()], spp=16)
    corners = rig.camera.pixel_centres()[..., None, None, :] + np.array([[[0.5, 0.5]], [[-0.5, -0.5]]])
    lost = np.isnan(rig.camera.directions(corners)).any(axis=(2, 3, 4))
    none = np.isnan(rig.camera.directions(rig.camera.pixel_centres())).any(axis=-1) & lost
    dark = none & (np.abs(rig.camera.pixel_centres() - [32, 24]) > [25, 18]).all(axis=-1)
    assert dark.sum() > 100
    assert np.isnan(signals.truth.z[none]).all()
    assert (signals.truth.instance[none] == -1).all()
    for values in (signals.energy.direct, signals.energy.ambient, *signals.channels[FirstReturn()]):
        assert np.isfinite(values).all()
        assert not values[dark].any()
        assert values[20:28, 28:36].all()


def test_the_projector_lights_nothing_beyond_its_fold(plane: rangesim.Scene) -> None:
    """What lies beyond the fold would fall on pixels a second time."""
    camera = Intrinsics.from_fov(96, 72, 100)
    rig = before_plane(plane, camera=camera, projector=distorted(Intrinsics.from_fov(1280, 800, 100), FOLDED))
    signals = transport(plane, rig, [], spp=4)
    radius = np.linalg.norm(camera.normalise(camera.pixel_centres()), axis=-1)
    on_plane = np.isfinite(signals.truth.z)
    beyond = radius > np.sqrt(rig.projector.fold_radius2) + 0.03
    assert (beyond & on_plane).sum() > 500
    assert not signals.energy.direct[beyond].any()
    assert not signals.truth.projector_visible[beyond].any()
    assert np.isnan(signals.truth.projector_uv[beyond]).all()
    assert signals.energy.direct[radius < 0.3].all()


@pytest.mark.parametrize("distortion", [BARREL, PINCUSHION])
def test_every_projector_pixel_keeps_its_power_through_distortion(
    plane: rangesim.Scene, distortion: tuple[float, ...]
) -> None:
    """Radiance on the plane is rho / pi E times the density of pixels; over the plane it sums up to the power."""
    projector = distorted(Intrinsics.from_fov(1280, 800, 60), distortion)
    rig = before_plane(plane, projector=projector, camera=Intrinsics.from_fov(160, 120, 95), projector_power_w=2.0)
    signals = transport(plane, rig, [], spp=64)
    radiance = signals.energy.direct.astype(float)
    x = rig.camera.normalise(rig.camera.pixel_centres())
    step = 1e-4
    d = [
        projector.project(np.concatenate([x + offset, np.ones_like(x[..., :1])], axis=-1))
        / [projector.fx, projector.fy]
        for offset in ([step, 0], [-step, 0], [0, step], [0, -step])
    ]
    along_x, along_y = (d[0] - d[1]) / (2 * step), (d[2] - d[3]) / (2 * step)
    density = along_x[..., 0] * along_y[..., 1] - along_x[..., 1] * along_y[..., 0]
    inside = signals.truth.projector_visible
    inner = inside & np.roll(inside, 1, 0) & np.roll(inside, -1, 0) & np.roll(inside, 1, 1) & np.roll(inside, -1, 1)
    expected = 0.5 / np.pi * rig.projector_irradiance * density
    np.testing.assert_allclose(radiance[inner], expected[inner], rtol=2e-3)
    assert density[inner].std() > 0.03
    area = 1 / (rig.camera.fx * rig.camera.fy)  # of a pixel on the plane at 1 m
    assert radiance.sum() * area * np.pi / 0.5 == pytest.approx(2.0, rel=2e-3)


# ---- Camera out of focus -------------------------------------------------------------------------------


def test_paths_through_a_lens_meet_in_focus_and_are_equally_long_there() -> None:
    select_variant()
    import mitsuba as mi

    from rangesim.light_transport.camera_rays import Device

    device = Device(Intrinsics.from_fov(320, 240, 60), np.eye(4), Lens(0.02, focus_m=0.8))
    rng = np.random.default_rng(0)
    pixel, lens = mi.Point2f(rng.uniform([0, 0], [320, 240], (999, 2)).T), mi.Point2f(rng.random((2, 999)))
    ray = device.sample_ray(pixel, lens)
    origin, direction, path_offset = (np.array(x, dtype=float).T for x in (ray.origin, ray.direction, ray.path_offset))
    t = (0.8 - origin[:, 2]) / direction[:, 2]
    focus = origin + t[:, None] * direction
    chief = np.array(device.centre_ray(pixel).direction, dtype=float).T
    np.testing.assert_allclose(focus, chief / chief[:, 2:] * 0.8, atol=1e-6)
    np.testing.assert_allclose(path_offset + t, np.linalg.norm(focus, axis=-1), atol=1e-6)
    radius2 = np.sum(origin[:, :2] ** 2, axis=-1)
    assert radius2.max() <= 0.02**2 * (1 + 1e-5)
    assert radius2.mean() == pytest.approx(0.02**2 / 2, rel=0.05)  # uniform over the disc


def test_defocus_leaves_the_path_length_of_a_plane_in_focus(plane: rangesim.Scene) -> None:
    camera = Intrinsics.from_fov(32, 24, 30)
    length = []
    for focus in (None, 1.0):
        rig = before_plane(plane, camera=camera, camera_lens=Lens(0.02, focus))
        radiance, moment = transport(plane, rig, [FirstReturn()], spp=1024).channels[FirstReturn()]
        length.append(moment / radiance)
    assert abs((length[1] - length[0]).mean()) < 1e-5


@pytest.mark.parametrize(("z", "focus"), [(1.0, 0.6), *to_validate((0.5, 1.0), (0.8, 100.0))])
def test_the_blur_circle_has_the_diameter_of_the_thin_lens(z: float, focus: float) -> None:
    """A small square spreads to the variance s^2/12 of itself, 1/12 of the pixels and c^2/16 of the disc."""
    import mitsuba as mi

    select_variant()
    T = mi.ScalarTransform4f
    side, aperture = 0.01 * z, 0.03
    square = {
        "type": "rectangle",
        "to_world": T().translate([0.003, -0.002, z]).rotate([1, 0, 0], 180).scale(side / 2),
        "bsdf": {"type": "diffuse"},
    }
    sensor = {"type": "perspective", "fov": 30.0, "film": {"type": "hdrfilm", "width": 40, "height": 40}}
    scene = rangesim.load_scene({"type": "scene", "sensor": sensor, "square": square})
    camera = Intrinsics(40, 40, 180, 180, 20, 20)
    rig = Rig(camera, Intrinsics.from_fov(400, 400, 60), camera_lens=Lens(aperture, focus))
    image = transport(scene, rig, [], spp=8192).energy.direct.astype(float)
    image /= image.sum()
    c = 2 * aperture * camera.fx * abs(1 / z - 1 / focus)
    for axis in (0, 1):
        profile = image.sum(axis=1 - axis)
        x = np.arange(40) + 0.5
        variance = profile @ x**2 - (profile @ x) ** 2
        expected = (side / z * camera.fx) ** 2 / 12 + 1 / 12 + c**2 / 16
        assert variance == pytest.approx(expected, rel=0.02)
    half = 0.5 * np.sort(image.ravel())[-10:].mean()  # the outline of a disc that a small square smears
    assert np.count_nonzero(image > half) == pytest.approx(np.pi / 4 * c**2, rel=0.1)


@pytest.mark.validation
def test_a_camera_out_of_focus_agrees_with_mitsuba_s_thinlens() -> None:
    """Under an even sky, as this is about the camera alone."""
    import mitsuba as mi

    from rangesim.scene.camera import MITSUBA_FROM_OPENCV

    scene = under_a_sky()
    base = scene.rig()
    rig = dataclasses.replace(base, camera_lens=Lens(0.04, focus_m=0.7))
    ours = transport(scene, rig, [], spp=512, max_depth=3, rr_depth=99).energy.ambient
    sharp = transport(scene, base, [], spp=64, max_depth=3, rr_depth=99).energy.ambient
    fov = np.degrees(2 * np.arctan(0.5 * rig.camera.width / rig.camera.fx))
    film = {"type": "hdrfilm", "width": 80, "height": 60, "rfilter": {"type": "box"}}
    lens = {"aperture_radius": 0.04, "focus_distance": 0.7, "fov": float(fov), "near_clip": 1e-5, "film": film}
    to_world = mi.ScalarTransform4f(rig.T_world_camera @ MITSUBA_FROM_OPENCV)
    sensor = mi.load_dict({"type": "thinlens", "to_world": to_world, **lens})
    path = mi.load_dict({"type": "path", "max_depth": 3, "rr_depth": 99})
    theirs = [np.array(mi.render(scene.mitsuba, sensor=sensor, integrator=path, spp=256, seed=s)) for s in (1, 2)]
    a, b = (t.squeeze().astype(float) for t in theirs)
    noise = np.abs(a - b).mean() / np.sqrt(2)  # mean absolute deviation of 256 samples
    error = np.abs(ours - (a + b) / 2).mean()
    assert error < 1.2 * noise  # ours and theirs both have 512 samples, so noise is expected
    assert np.abs(sharp - (a + b) / 2).mean() > 4 * noise
    assert ours.mean() == pytest.approx(float((a + b).mean() / 2), rel=2e-3)


# ---- Projector out of focus ----------------------------------------------------------------------------


def test_rays_from_the_projector_s_lens_spread_as_its_blur_says() -> None:
    select_variant()
    import mitsuba as mi

    from rangesim.light_transport.camera_rays import Device

    lens = Intrinsics.from_fov(1280, 800, 60)
    rig = Rig(lens, lens, projector_lens=Lens(4e-3, focus_m=0.9))
    projector = Device.projector(rig)
    rng = np.random.default_rng(1)
    n = 20_000
    ray = projector.sample_ray(mi.Point2f(700.0, 300.0), mi.Point2f(rng.random((2, n))))
    origin, direction = (np.array(x, dtype=float).T for x in (ray.origin, ray.direction))
    for z in (0.5, 0.9, 2.0):
        points = origin + (z / direction[:, 2])[:, None] * direction
        pixels = lens.project(points)
        blur = np.array(projector.blur_px(mi.Float(z))).item()
        np.testing.assert_allclose(pixels.std(axis=0), blur, rtol=0.02, atol=1e-3)
        np.testing.assert_allclose(pixels.mean(axis=0), [700, 300], atol=0.05)
        assert blur == pytest.approx(0.5 * 4e-3 * lens.fx * abs(1 / z - 1 / 0.9), abs=1e-4)


@pytest.mark.parametrize("focus", [0.6, *to_validate(1.0, 3.0)])
def test_fringes_lose_the_contrast_that_the_formula_says(plane: rangesim.Scene, focus: float) -> None:
    rig = before_plane(plane, projector_lens=Lens(4e-3, focus))
    fringes = Fringes(0, 16.0)
    for base, signals in (
        (rig, transport(plane, rig, [fringes], spp=256)),
        (
            None,
            transport(
                plane,
                dataclasses.replace(rig, projector_lens=dataclasses.replace(rig.projector_lens, focus_m=None)),
                [fringes],
                spp=256,
            ),
        ),
    ):
        modulation = np.hypot(*signals.channels[fringes]) / signals.energy.direct
        if base:
            blurred = modulation
    sigma = 0.5 * 4e-3 * rig.projector.fx * abs(1 - 1 / focus)
    expected = np.exp(-2 * np.pi**2 * sigma**2 / 16**2) * np.sinc(1 / 16)
    np.testing.assert_allclose(blurred / modulation, expected, rtol=1e-4)


@pytest.mark.validation
def test_the_modulation_that_a_camera_measures_falls_with_depth(plane: rangesim.Scene) -> None:
    """A camera close to the projector and turned away sees the plane at many depths z of the projector."""
    sensor = StructuredLight(320, 200)
    turn = look_at((0.05, 0, 0), (0.9, 0, 1.0), (0, -1, 0))  # 42 degrees: the plane recedes along the projector's x
    rig = before_plane(plane, 96, 72, projector=Intrinsics.from_fov(320, 200, 60), T_camera_projector=turn)
    rig = dataclasses.replace(rig, projector_lens=Lens(0.05, focus_m=0.7))
    sharp = dataclasses.replace(rig, projector_lens=dataclasses.replace(rig.projector_lens, focus_m=None))
    modulation, truth = [], None
    for one in (rig, sharp):
        signals = transport(plane, one, [sensor], spp=256)
        steps = expose(signals, sensor).frames[-6:-2].astype(float)
        lit = binary_erosion(signals.energy.direct > 0)  # whole pixels
        modulation.append(np.hypot(steps[0] - steps[2], steps[1] - steps[3])[lit] / signals.energy.direct[lit])
        truth = signals.truth
    z = projector_frame(rig, world_points(rig, truth.z.astype(float)))[..., 2][lit]
    sigma = 0.5 * 0.05 * rig.projector.fx * np.abs(1 / z - 1 / 0.7)
    expected = np.exp(-2 * np.pi**2 * sigma**2 / 16**2) * np.sinc(1 / 16)
    assert len(z) > 1000
    assert np.ptp(expected) > 0.2
    np.testing.assert_allclose(modulation[0] / modulation[1], expected, atol=3e-3)


@pytest.mark.validation
def test_images_out_of_focus_in_the_renderer_are_those_of_numpy(plane: rangesim.Scene) -> None:
    pattern = (np.random.default_rng(0).random((200, 320)) > 0.8).astype(np.float32)
    images = Images(pattern[None])
    offsets = (np.arange(12) + 0.5) / 12 - 0.5
    for focus in (0.9, 0.35):
        rig = before_plane(plane, projector=Intrinsics.from_fov(320, 200, 70))
        rig = dataclasses.replace(rig, projector_lens=Lens(6e-3, focus))
        signals = transport(plane, rig, [images], spp=1024)
        pixels = rig.camera.pixel_centres()[..., None, None, :] + np.stack(np.meshgrid(offsets, offsets), axis=-1)
        uv = rig.projector.project(rig.camera.directions(pixels))
        blur = 0.5 * 6e-3 * rig.projector.fx * abs(1 - 1 / focus)
        path = LightPath(uv[..., 0], uv[..., 1], 0.0, True, blur_px=np.full(uv.shape[:-1], blur))
        expected = images.weights(path, NumpyMath())[0].mean(axis=(2, 3))
        seen = signals.channels[images][0] / signals.energy.direct
        assert expected.std() > 0.03
        assert np.abs(seen - expected).mean() < 0.05 * expected.std()  # both are sums over the pixel's area


@pytest.mark.validation
def test_prefiltered_patterns_are_the_mean_over_the_projector_s_lens(matte: rangesim.Scene) -> None:
    """Brute force: sharp projectors at points all over the lens, shifted so that they agree in the plane in focus.

    The Gaussian stands for a disc; an edge through the two differs by 0.04 at most.
    """
    focus, aperture, n = 0.6, 8e-3, 37
    rig = matte.rig(width=64, height=48, projector_size=(320, 200))
    fringes, gray = Fringes(0, 16.0), GrayBits(0, 6, 8)
    total: dict[Any, Any] = {fringes: 0.0, gray: 0.0}
    for i in range(n):  # Vogel's spiral fills the disc evenly
        radius, angle = aperture * np.sqrt((i + 0.5) / n), i * 2.399963229728653
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        p, pose = rig.projector, np.array(rig.T_camera_projector)
        pose[:3, 3] += pose[:3, :2] @ [x, y]
        seen_from_there = dataclasses.replace(p, cx=p.cx + p.fx * x / focus, cy=p.cy + p.fy * y / focus)
        one = dataclasses.replace(rig, projector=seen_from_there, T_camera_projector=pose)
        signals = transport(matte, one, [fringes, gray], spp=16, max_depth=2, seed=i)
        total = {r: total[r] + signals.channels[r].astype(float) / n for r in total}
    blurred = transport(
        matte, dataclasses.replace(rig, projector_lens=Lens(aperture, focus)), [fringes, gray], spp=n * 16, max_depth=2
    )
    sharp = transport(matte, rig, [fringes, gray], spp=n * 16, max_depth=2)
    white = sharp.energy.direct
    inner = binary_erosion((white > 0) & sharp.truth.projector_visible, iterations=3)
    assert inner.mean() > 0.4
    for response, hold in ((fringes, np.sinc(1 / 16)), (gray, 1.0)):
        error = np.abs(blurred.channels[response] / hold - total[response])[:, inner] / white[inner]
        unfiltered = np.abs(sharp.channels[response] - total[response])[:, inner] / white[inner]
        assert error.mean() < 0.01
        assert unfiltered.mean() > 2.5 * error.mean()


def test_structured_light_decodes_out_of_focus(matte: rangesim.Scene) -> None:
    sensor = StructuredLight(320, 200, axes=("columns", "rows"))
    rig = matte.rig(width=64, height=48, projector_size=(320, 200))
    rig = dataclasses.replace(rig, projector_lens=Lens(8e-3, focus_m=0.5))
    signals = transport(matte, rig, [sensor], spp=256)
    image = decode(expose(signals, sensor))
    lit = signals.truth.projector_visible
    assert image.valid[lit].mean() > 0.95
    assert np.median(np.abs(image.z - signals.truth.z)[image.valid]) < 1e-3


# ---- Vignetting ----------------------------------------------------------------------------------------


def test_the_projector_darkens_towards_its_corners_as_cos_n(plane: rangesim.Scene) -> None:
    rig = before_plane(plane)
    even, dark = (
        transport(plane, dataclasses.replace(rig, projector_lens=Lens(2e-3, vignetting=n)), [], spp=64).energy.direct
        for n in (0.0, 3.0)
    )
    rays = rig.camera.directions(rig.camera.pixel_centres())
    cos = 1 / np.linalg.norm(rays, axis=-1)
    assert cos.min() < 0.9
    np.testing.assert_allclose(dark / even, cos**3, rtol=1e-3)


def test_the_camera_darkens_at_exposure_and_signals_stay_radiance(plane: rangesim.Scene) -> None:
    even = before_plane(plane, projector_power_w=5.0)
    rig = dataclasses.replace(even, camera_lens=Lens(0.75e-3, vignetting=4.0))
    sensor = StructuredLight(640, 400)
    rig, even = (dataclasses.replace(r, projector=Intrinsics.from_fov(640, 400, 70)) for r in (rig, even))
    signals, plain = (transport(plane, r, [sensor, IdealToF()], spp=16) for r in (rig, even))
    np.testing.assert_array_equal(signals.energy.direct, plain.energy.direct)
    cos4 = np.linalg.norm(rig.camera.directions(rig.camera.pixel_centres()), axis=-1) ** -4
    ideal, reference = expose(signals, sensor).frames, expose(plain, sensor).frames
    np.testing.assert_allclose(ideal, reference * cos4, rtol=1e-5)
    detector = Detector.ideal()
    digital, level = (expose(s, sensor, detector, exposure_s=2e-5).frames[-2].astype(float) for s in (signals, plain))
    assert level.max() < detector.max_dn
    ratio = digital[:4].sum(axis=0) / level[:4].sum(axis=0)
    np.testing.assert_allclose(ratio, cos4[:4].mean(axis=0), atol=0.03)
    np.testing.assert_allclose(decode(expose(signals, IdealToF())).z, 1, atol=2e-3)


@pytest.mark.parametrize(
    ("distortion", "vignetting", "focus"), [(BARREL, 4.0, 0.8), *to_validate(((-0.4,), 0.0, None), ((), 6.0, None))]
)
@pytest.mark.validation
def test_caustics_through_a_pane_that_does_nothing_bring_the_light_that_connections_bring(
    plane: rangesim.Scene, distortion: tuple[float, ...], vignetting: float, focus: float | None
) -> None:
    """Caustics are even over the projector's pixels, connections carry the density of pixels: two ways to one image."""
    import mitsuba as mi

    select_variant()
    T = mi.ScalarTransform4f

    def standing(y: float, bsdf: dict[str, Any]) -> dict[str, Any]:
        return {
            "type": "rectangle",
            "to_world": T().translate([0, y, 0.5]).rotate([1, 0, 0], 90).scale(2),
            "bsdf": bsdf,
        }

    film = {"type": "hdrfilm", "width": 64, "height": 48}
    view = T().look_at([0, 0, 0.5], [0, 1, 0.5], [0, 0, 1])
    parts = {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 60.0, "to_world": view, "film": film},
        "wall": standing(1.0, {"type": "diffuse", "reflectance": 0.5}),
    }
    pane = standing(0.6, {"type": "thindielectric", "int_ior": 1.00001, "ext_ior": 1.0})
    clear, behind = rangesim.load_scene(parts), rangesim.load_scene({**parts, "pane": pane})
    projector = distorted(Intrinsics.from_fov(320, 200, 60), distortion)
    rig = Rig(
        clear.camera,
        projector,
        clear.T_world_camera,
        translation(0.4, 0, 0),
        projector_lens=Lens(2e-3, focus, vignetting),
    )
    fringes = Fringes(0, 32.0)
    by_connection, by_caustics = (transport(s, rig, [fringes], spp=64) for s in (clear, behind))
    inner = binary_erosion(by_connection.energy.direct > 0, iterations=2)
    expected, caustic = by_connection.energy.direct[inner], by_caustics.energy.caustic[inner]
    assert not by_caustics.energy.direct.any()
    assert caustic.mean() == pytest.approx(expected.mean(), rel=0.01)
    assert abs(np.polyfit(expected / expected.mean(), caustic / expected - 1, 1)[0]) < 0.05  # as even or uneven
    a, b = (s.channels[fringes][0][inner] for s in (by_connection, by_caustics))
    assert np.corrcoef(a, b)[0, 1] > 0.98
    assert (a @ b) / (a @ a) == pytest.approx(1, abs=0.02)


# ---- Off is off ----------------------------------------------------------------------------------------


def test_a_lens_without_effects_gives_the_same_bytes(matte: rangesim.Scene) -> None:
    sensor = StructuredLight(axes=("columns", "rows"))
    rig = matte.rig(width=32, height=24)
    zero = distorted(rig.camera, (0.0, 0.0)), distorted(rig.projector, (0.0, 0.0, 0.0))
    off = dataclasses.replace(
        rig, camera=zero[0], projector=zero[1], projector_lens=Lens(2e-3, vignetting=0.0), camera_lens=Lens(0.75e-3)
    )
    a, b = (transport(matte, r, [sensor], spp=4) for r in (rig, off))
    for response in sensor.responses():
        assert a.channels[response].tobytes() == b.channels[response].tobytes()
    assert a.truth.projector_uv.tobytes() == b.truth.projector_uv.tobytes()
    assert expose(a, sensor).frames.tobytes() == expose(b, sensor).frames.tobytes()
