# SPDX-License-Identifier: Apache-2.0
"""The projector's lens as the camera sees it: its image in a mirror, by solid angle; its length; what it does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from delta_scenes import (
    GLASS,
    MIRROR,
    ProjectorCoordinates,
    fresnel_conductor,
    fresnel_dielectric,
    matte,
    rig_of,
    scene_of,
    slab,
    wall,
)

import rangesim
from rangesim import Detector, Intrinsics, Rig, Signals, Status, StructuredLight, transport
from rangesim.response import DenseResponse, LightPath

CAMERA = Intrinsics.from_fov(64, 48, 40)
PROJECTOR = Intrinsics.from_fov(160, 120, 50)
BASELINE = 0.1


@dataclass(frozen=True)
class Lengths(DenseResponse):
    """Radiance, and radiance times path length."""

    channels: int = 2  # type: ignore[misc]

    def weights(self, path: LightPath, m: Any) -> list[Any]:
        return [1.0, path.path_length_m]


def intensity(rig: Rig, tangent: float) -> float:
    """W/sr of the projector's pinhole at that tangent of the angle to its axis: E / cos^3."""
    return float(rig.projector_irradiance * (1 + tangent**2) ** 1.5)


def seen(signals: Signals) -> float:
    """Radiance times solid angle, summed over the image: the irradiance of a surface that faces the light, W/m2."""
    camera = signals.rig.camera
    rays = camera.directions(camera.pixel_centres())
    return float((signals.energy.glint * np.linalg.norm(rays, axis=-1) ** -3).sum()) / (camera.fx * camera.fy)


def lengths(signals: Signals) -> np.ndarray:
    """Path lengths of the pixels with glint alone."""
    radiance, moment = signals.channels[Lengths()]
    some = signals.energy.glint > 0
    return np.asarray(moment[some] / radiance[some])


def check(signals: Signals, irradiance: float, length_m: float, rel: float = 0.04) -> None:
    assert seen(signals) == pytest.approx(irradiance, rel=rel)
    some = signals.energy.glint > 0
    for response in SENSORS:
        np.testing.assert_allclose(signals.energy.glint[some], signals.channels[response][0][some], rtol=1e-5)
    np.testing.assert_allclose(lengths(signals), length_m, atol=2e-4)


SENSORS = [Lengths(), ProjectorCoordinates()]


# ---- Closed forms -----------------------------------------------------------------------------------


@pytest.mark.parametrize("offset", [0.0, 0.0037, 0.0071])
def test_in_a_flat_mirror_the_lens_is_its_mirror_image(offset: float) -> None:
    """A lens of intensity I at the unfolded distance d casts R I / d^2, wherever among the pixels its image lies."""
    depth, b = 1.0, BASELINE + offset
    scene, rig = scene_of(mirror=wall(depth, MIRROR)), rig_of(CAMERA, PROJECTOR, (b, 0.0, 0.0))
    signals = transport(scene, rig, SENSORS, spp=64)
    d, tangent = np.hypot(2 * depth, b), b / (2 * depth)
    reflected = fresnel_conductor(2 * depth / d)
    check(signals, reflected * intensity(rig, tangent) / d**2, d)
    white, u, v = (c.sum() for c in signals.channels[ProjectorCoordinates()])
    # Light to the middle between the two leaves the projector to the left of its axis
    assert u / white == pytest.approx(PROJECTOR.cx - PROJECTOR.fx * tangent, abs=0.3)
    assert v / white == pytest.approx(PROJECTOR.cy, abs=0.3)
    assert 1 <= (signals.energy.glint > 0).sum() <= 4


def test_a_pixel_that_the_lens_fills_has_the_radiance_of_the_lens() -> None:
    """Intensity over projected area: E / (pi a^2 cos^4), of the part that the mirror reflects."""
    depth, camera = 0.2, Intrinsics.from_fov(64, 48, 2)
    rig = rig_of(camera, PROJECTOR, (0.02, 0.0, 0.0), camera_looks_at=(0.01, 0.0, depth))
    signals = transport(scene_of(mirror=wall(depth, MIRROR)), rig, SENSORS, spp=64)
    cosine = 2 * depth / np.hypot(2 * depth, 0.02)
    expected = fresnel_conductor(cosine) * rig.projector_irradiance / (np.pi * 2e-3**2) / cosine**4
    assert signals.energy.glint[24, 32] == pytest.approx(expected, rel=5e-3)
    # The disc, seen from 0.4 m
    radius_px = 2e-3 / (2 * depth) * camera.fx
    assert (signals.energy.glint > 0).sum() == pytest.approx(np.pi * radius_px**2, rel=0.15)


def test_in_a_convex_ball_the_lens_is_demagnified() -> None:
    """Off a ball of radius r the image is (d1 + d2 + 2 d1 d2 / r)^2 away: a tiny, bright spot."""
    distance, radius, b = 0.8, 0.06, 0.02
    ball = {"type": "sphere", "center": [b / 2, 0.0, distance + radius], "radius": radius, "bsdf": MIRROR}
    scene, rig = scene_of(ball=ball), rig_of(CAMERA, PROJECTOR, (b, 0.0, 0.0))
    leg = np.hypot(distance, b / 2)
    expected = fresnel_conductor(distance / leg) * intensity(rig, b / 2 / distance)
    expected /= (2 * leg + 2 * leg**2 / radius) ** 2
    seeds = [transport(scene, rig, SENSORS, spp=64, seed=s) for s in range(6)]
    for signals in seeds:
        np.testing.assert_allclose(lengths(signals), 2 * leg, atol=1e-3)
    assert np.mean([seen(s) for s in seeds]) == pytest.approx(expected, rel=0.04)


@pytest.mark.validation
@pytest.mark.parametrize(
    ("x", "radius", "spread"),
    [
        (-0.21, 0.012, 2.0),
        (0.06, 0.012, 2.0),
        (-0.13, 0.03, 1.3),
        (-0.02, 0.03, 1.3),
        (-0.21, 0.09, 1.15),
        (0.17, 0.09, 1.15),
    ],
)
def test_no_seed_misses_a_highlight_on_a_ball(x: float, radius: float, spread: float) -> None:
    """Balls two to eighteen pixels wide, all over the image; the highlight is down to a thousandth of a pixel wide."""
    ball = {"type": "sphere", "center": [x, 0.07, 0.9], "radius": radius, "bsdf": MIRROR}
    scene, rig = scene_of(ball=ball, wall=wall(2.0, matte())), mirror_rig()
    found = [seen(transport(scene, rig, [], spp=64, seed=s)) for s in range(4)]
    assert min(found) > 0
    assert max(found) / min(found) < spread


def test_a_projector_in_view_is_seen_straight() -> None:
    at = (0.05, 0.03, 1.5)
    rig = rig_of(CAMERA, PROJECTOR, at, looks_at=(0.05, 0.03, 0.0))
    signals = transport(scene_of(wall=wall(3.0, matte())), rig, SENSORS, spp=4)
    d, tangent = float(np.linalg.norm(at)), float(np.hypot(at[0], at[1])) / at[2]
    check(signals, intensity(rig, tangent) / d**2, d)


@pytest.mark.validation
def test_through_a_pane_the_lens_is_seen_nearer_and_dimmer() -> None:
    rig = rig_of(CAMERA, PROJECTOR, (0.0, 0.0, 1.5), looks_at=(0.0, 0.0, 0.0))
    scene = scene_of(pane=slab(0.5, 0.55))
    seeds = [transport(scene, rig, [Lengths()], spp=64, seed=s) for s in range(12)]
    r, apparent = fresnel_dielectric(0.0), 1.5 - 0.05 + 0.05 / 1.5
    values = [seen(s) for s in seeds]
    error = np.std(values, ddof=1) / np.sqrt(len(values))
    assert np.mean(values) == pytest.approx((1 - r) ** 2 * intensity(rig, 0.0) / apparent**2, abs=4 * error)
    assert error < 0.05 * np.mean(values)
    assert np.median(np.concatenate([lengths(s) for s in seeds])) == pytest.approx(1.5 + 0.5 * 0.05, abs=1e-3)


# ---- When there is none -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("at", "looks_at"),
    [
        ((0.05, 0.03, 1.5), (0.05, 0.03, 3.0)),  # faces away
        ((0.05, 0.03, 1.5), (1.55, 0.03, 0.5)),  # the camera is outside its image
        ((2.5, 0.0, 1.5), (2.5, 0.0, 0.0)),  # outside the camera's
    ],
)
def test_a_projector_that_does_not_shine_on_the_camera_shows_no_glint(
    at: tuple[float, float, float], looks_at: tuple[float, float, float]
) -> None:
    rig = rig_of(CAMERA, PROJECTOR, at, looks_at=looks_at)
    assert not transport(scene_of(wall=wall(3.0, matte())), rig, [], spp=4).energy.glint.any()


def test_what_stands_before_the_lens_hides_it() -> None:
    rig = rig_of(CAMERA, PROJECTOR, (0.05, 0.03, 1.5), looks_at=(0.05, 0.03, 0.0))
    scene = scene_of(screen=wall(1.0, matte(), 0.1), wall=wall(3.0, matte()))
    assert not transport(scene, rig, [], spp=4).energy.glint.any()


def test_glint_comes_or_goes_and_nothing_else_changes() -> None:
    scene, rig = scene_of(mirror=wall(1.0, MIRROR, 0.2), wall=wall(2.0, matte())), mirror_rig()
    on, off = (transport(scene, rig, SENSORS, spp=4, glint=glint) for glint in (True, False))
    for name in ("direct", "multipath", "specular", "caustic", "ambient"):
        np.testing.assert_array_equal(getattr(on.energy, name), getattr(off.energy, name))
    dark = on.energy.glint == 0
    for response in SENSORS:
        np.testing.assert_array_equal(on.channels[response][:, dark], off.channels[response][:, dark])
    assert not off.energy.glint.any()
    assert not dark.all()


# ---- What it does to a sensor -----------------------------------------------------------------------


def mirror_rig() -> Rig:
    return rig_of(CAMERA, PROJECTOR, (BASELINE, 0.0, 0.0))


def test_glint_saturates_the_detector() -> None:
    scene = scene_of(mirror=wall(1.0, MIRROR, 0.2), wall=wall(2.0, matte()))
    light = StructuredLight(160, 120, axes=("columns",))
    signals = transport(scene, mirror_rig(), [light], spp=16)
    image = rangesim.decode(rangesim.expose(signals, light, Detector()))
    glint = signals.energy.glint > 100 * np.median(signals.energy.direct)
    assert glint.any()
    assert (image.status[glint] == Status.SATURATED).all()


def test_the_same_seed_gives_the_same_glint_whatever_the_threads() -> None:
    import drjit as dr

    ball: dict[str, Any] = {"type": "sphere", "center": [0.0, 0.0, 0.9], "radius": 0.1, "bsdf": GLASS}
    scene, before, found = scene_of(ball=ball, wall=wall(2.0, matte())), dr.thread_count(), []
    for threads in (1, 2):
        dr.set_thread_count(threads)
        found.append(transport(scene, mirror_rig(), SENSORS, spp=64, seed=3).energy.glint)
    dr.set_thread_count(before)
    np.testing.assert_array_equal(*found)
    assert found[0].any()
