# SPDX-License-Identifier: Apache-2.0
"""Light that is absorbed inside glass: Beer-Lambert along specular chains, against closed forms and `volpath`."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from delta_scenes import (
    GLASS,
    SlabPath,
    fresnel_dielectric,
    matte,
    rig_of,
    scene_of,
    sheets_of,
    thrown_w,
    transform,
    wall,
)
from plain_mitsuba import plain_scene, render, z_score
from synthetic import counted_return
from tiers import to_validate

from rangesim import Intrinsics, load_scene, transport
from rangesim.errors import FileFormatError
from rangesim.light_transport import surfaces
from rangesim.light_transport.absorption import absorbers_of
from rangesim.response import FirstReturn
from rangesim.scene.rigid_motion import MovingScene

CAMERA = Intrinsics.from_fov(64, 48, 60)
PROJECTOR = Intrinsics.from_fov(160, 120, 60)
NEAR, FAR = 0.3, 0.35
D = FAR - NEAR
"""Thickness of the slab, metres."""
SIGMA_A = 12.0
"""1/m; a pass at normal incidence leaves exp(-0.6) = 0.55."""
SKY = {"type": "constant", "radiance": {"type": "spectrum", "value": 1.0}}
ROUGH = {"type": "roughdielectric", "alpha": 0.15, "int_ior": 1.5, "ext_ior": 1.0}


def absorbing(sigma_a: float, albedo: float = 0.0) -> dict[str, Any]:
    return {"type": "homogeneous", "sigma_t": float(sigma_a), "albedo": float(albedo)}


def filled(shape: dict[str, Any], sigma_a: float = SIGMA_A) -> dict[str, Any]:
    """The shape, of glass that absorbs."""
    return {**shape, "interior": absorbing(sigma_a)}


def slab(near: float = NEAR, far: float = FAR, half_size: float = 5.0, bsdf: dict[str, Any] = GLASS) -> dict[str, Any]:
    """Glass between two depths, turned so that no row of pixels runs along the seam of a face's two triangles."""
    half = [half_size, half_size, (far - near) / 2]
    place = transform().translate([0, 0, (near + far) / 2]).rotate([0, 0, 1], 20).scale(half)
    return {"type": "cube", "to_world": place, "bsdf": bsdf}


def ball(radius: float = 0.2, z: float = 1.0, bsdf: dict[str, Any] = GLASS, x: float = 0.0) -> dict[str, Any]:
    return {"type": "sphere", "center": [x, 0.0, z], "radius": radius, "bsdf": bsdf}


def lamp(z: float = 2.0, radiance: float = 1.0, half_size: float = 5.0) -> dict[str, Any]:
    """A panel that shines towards the origin."""
    emitter = {"type": "area", "radiance": {"type": "spectrum", "value": radiance}}
    return {**wall(z, matte(0.0), half_size), "emitter": emitter}


def tangents(camera: Intrinsics) -> np.ndarray:
    """(h, w, 8, 8) tangents to the axis of rays all over each pixel."""
    offsets = (np.arange(8) + 0.5) / 8 - 0.5
    pixels = camera.pixel_centres()[..., None, None, :] + np.stack(np.meshgrid(offsets, offsets), axis=-1)
    return np.asarray(np.linalg.norm(camera.normalise(pixels), axis=-1))


def in_blocks(image: np.ndarray) -> np.ndarray:
    """Means over blocks of 8 x 8 pixels."""
    h, w = image.shape
    return np.asarray(image.reshape(h // 8, 8, w // 8, 8).mean(axis=(1, 3)))


def of_slab(t: Any, sigma_a: float = SIGMA_A) -> tuple[Any, Any]:
    """Transmittance (1 - R)^2 e / (1 - R^2 e^2) and reflectance of a slab, e = exp(-sigma_a d / cos) inside."""
    sine = t / np.hypot(1, t)
    r, e = fresnel_dielectric(sine), np.exp(-sigma_a * D / np.sqrt(1 - (sine / 1.5) ** 2))
    transmitted = (1 - r) ** 2 * e / (1 - (r * e) ** 2)
    return transmitted, r + r * e * transmitted


# ---- Camera paths -----------------------------------------------------------------------------------


def test_a_lamp_seen_through_a_slab_is_as_bright_as_beer_lambert_and_fresnel_say() -> None:
    """At normal incidence and up to 36 degrees off."""
    scene = scene_of(slab=filled(slab()), lamp=lamp())
    seen = transport(scene, rig_of(CAMERA, PROJECTOR), [], spp=256, caustics=False, glint=False).energy.ambient
    expected, _ = of_slab(tangents(CAMERA))
    np.testing.assert_allclose(in_blocks(seen), in_blocks(expected.mean(axis=(2, 3))), rtol=0.01)
    assert seen.mean() == pytest.approx(expected.mean(), rel=1e-3)
    assert of_slab(0.0)[0] == pytest.approx(0.96**2 * np.exp(-0.6) / (1 - 0.04**2 * np.exp(-1.2)))


def test_the_sky_seen_through_a_slab_and_in_it() -> None:
    scene = scene_of(slab=filled(slab(half_size=20.0)), sky=SKY)
    seen = transport(scene, rig_of(CAMERA, PROJECTOR), [], spp=256, caustics=False, glint=False).energy.ambient
    expected = sum(of_slab(tangents(CAMERA)))
    assert seen.mean() == pytest.approx(expected.mean(), rel=2e-3)


@pytest.mark.validation
def test_what_the_projector_lights_is_seen_through_a_slab_weakened_and_as_far_away() -> None:
    """The projector stands behind the slab and lights the wall straight."""
    images = []
    for sigma_a in (0.0, SIGMA_A):
        scene = scene_of(slab=filled(slab(), sigma_a), wall=wall(1.0, matte()))
        rig = rig_of(CAMERA, Intrinsics.from_fov(160, 120, 120), (0.0, 0.0, 0.5))
        signals = transport(scene, rig, [FirstReturn()], spp=64, caustics=False, max_depth=2)
        weight, moment = signals.channels[FirstReturn()]
        images.append((signals.energy.specular, moment / weight))
    (clear, length), (dim, same_length) = images
    # The light lands where it lands, whatever is absorbed; a pass to and fro inside is R^2 of it
    t = tangents(CAMERA)
    expected = of_slab(t)[0].mean(axis=(2, 3)) / of_slab(t, 0.0)[0].mean(axis=(2, 3))
    np.testing.assert_allclose(in_blocks(dim / clear), in_blocks(expected), rtol=3e-3)
    assert abs((same_length - length).mean()) < 3e-4  # fewer paths that went to and fro


# ---- Light that the projector throws through it ------------------------------------------------------


def tangents_of_the_projector() -> np.ndarray:
    """Tangents to the axis of the rays through the centres of the projector's pixels."""
    return np.asarray(np.linalg.norm(PROJECTOR.normalise(PROJECTOR.pixel_centres()), axis=-1))


def test_light_through_an_absorbing_slab_is_what_it_passes() -> None:
    scene = scene_of(pane=filled(slab()), wall=wall(1.0, matte()))
    passed = of_slab(tangents_of_the_projector())[0].mean()
    assert thrown_w(scene, rig_of(CAMERA, PROJECTOR), seeds=8) == pytest.approx(passed, rel=4e-3)


def test_light_keeps_its_way_and_length_and_loses_by_the_way_inside() -> None:
    """By chains: a triangle without absorption and the one that has the same vertices with it."""
    found = []
    for sigma_a in (0.0, SIGMA_A):
        sheets = sheets_of(scene_of(pane=filled(slab(), sigma_a), wall=wall(1.0, matte())), rig_of(CAMERA, PROJECTOR))
        assert sheets is not None
        corners = sheets.triangles
        names = [tuple(row) for row in np.column_stack([sheets.key, sheets.u[corners], sheets.v[corners]])]
        found.append((sheets, {name: i for i, name in enumerate(names)}))
    (clear, of_clear), (dim, of_dim) = found
    both = sorted(of_clear.keys() & of_dim.keys())
    assert len(both) > 0.7 * len(of_dim)
    a, b = (np.array([of[name] for name in both]) for of in (of_clear, of_dim))
    places = [(one.position[one.triangles[i]], one.length[one.triangles[i]]) for one, i in ((clear, a), (dim, b))]
    np.testing.assert_array_equal(*(position for position, _ in places))
    np.testing.assert_array_equal(*(length for _, length in places))
    cosine = clear.slowness[clear.triangles[a], 2].astype(float)
    inside = np.sqrt(1 - (1 - cosine**2) / 1.5**2)
    passes = (places[0][1] - (1.0 - D) / cosine) / (1.5 * D / inside)
    np.testing.assert_allclose(passes, np.round(passes), atol=1e-3)
    kept = np.exp(-SIGMA_A * D / inside * np.round(passes)).mean(axis=1)
    np.testing.assert_allclose(dim.flux[b] / clear.flux[a], kept, rtol=1e-3)
    assert 1 in np.round(passes)


@pytest.mark.validation
def test_caustics_behind_a_slab_are_as_bright_as_the_light_that_lands() -> None:
    """The camera stands behind the slab; the light passes it once."""
    images = []
    for sigma_a in (0.0, SIGMA_A):
        scene = scene_of(slab=filled(slab(), sigma_a), wall=wall(1.0, matte()))
        rig = rig_of(Intrinsics.from_fov(64, 48, 20), PROJECTOR, camera_at=(0.0, 0.0, 0.6))
        images.append(transport(scene, rig, [], spp=16, max_depth=2).energy.caustic)
    path = SlabPath(1.0, D)
    t = path.tangent(0.4 * np.linalg.norm(rig.camera.normalise(rig.camera.pixel_centres()), axis=-1))
    expected = of_slab(t)[0] / of_slab(t, 0.0)[0]
    assert (images[1] / images[0]).mean() == pytest.approx(expected.mean(), rel=2e-3)


# ---- Glint ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("slabs", [1, *to_validate(2)])
def test_the_lens_seen_through_slabs_is_weakened_by_each(slabs: int) -> None:
    close_up = Intrinsics.from_fov(64, 48, 5)  # so that a good part of a pixel's paths hit the lens
    rig = rig_of(close_up, PROJECTOR, (0.0, 0.0, 1.5), looks_at=(0.0, 0.0, 0.0))
    panes = [slab(near, near + D) for near in (0.3, 0.8)[:slabs]]
    clear, dim = (
        transport(scene_of(**{f"pane_{i}": filled(pane, a) for i, pane in enumerate(panes)}), rig, [], spp=8, seed=2)
        for a in (0.0, SIGMA_A)
    )
    assert dim.energy.glint.sum() / clear.energy.glint.sum() == pytest.approx(np.exp(-slabs * SIGMA_A * D), rel=0.01)


# ---- Against Mitsuba's own volumetric integrator ----------------------------------------------------


def bodies(kind: str) -> dict[str, dict[str, Any]]:
    """Scenes under a large lamp and a faint sky, before a wall."""
    body = {
        "ball": {"ball": filled(ball(), 5.0)},
        "rough ball": {"ball": filled(ball(bsdf=ROUGH), 5.0)},
        # A ball of glass in a tank of water: the ball's surface is where the one ends and the other begins
        "glass in water": {
            "tank": filled(slab(0.7, 1.3, 0.35, {**GLASS, "int_ior": 1.33}), 2.0),
            "ball": {
                **filled(ball(bsdf={**GLASS, "int_ior": 1.5, "ext_ior": 1.33}), 8.0),
                "exterior": absorbing(2.0),
            },
        },
        # Matte, with a lamp beside it, all in water
        "lamp in water": {
            "tank": filled(slab(0.7, 1.3, 0.35, {**GLASS, "int_ior": 1.33}), 2.0),
            "ball": ball(0.1, bsdf=matte(0.7)),
            "bulb": {
                **ball(0.05, x=0.2, bsdf=matte(0.0)),
                "emitter": {"type": "area", "radiance": {"type": "spectrum", "value": 5.0}},
            },
        },
        "milk in glass": {
            "ball": filled(ball(), 5.0),
            "milk": milk(5.0),
        },
        "point lamp, milk and stone in water": {
            "tank": filled(slab(0.7, 1.3, 0.35, {**GLASS, "int_ior": 1.33}), 2.0),
            "milk": milk(2.0),
            "stone": ball(0.08, bsdf=matte(0.7), x=-0.23),
            "point": {"type": "point", "position": [0.0, 0.2, 0.9], "intensity": 0.5},
        },
    }[kind]
    return {**body, "wall": wall(2.0, matte(0.8), 2.0), "lamp": {**lamp(), "to_world": over()}, "sky": SKY}


def milk(around: float) -> dict[str, Any]:
    """A scattering ball in an absorbing medium."""
    return {
        **ball(0.12, bsdf={"type": "null"}),
        "interior": absorbing(20.0, 0.9),
        "exterior": absorbing(around),
    }


def over() -> Any:
    """Where a panel hangs above, facing down (y is up)."""
    return transform().translate([0.0, 2.0, 1.0]).rotate([1, 0, 0], 90).scale(1.0)


@pytest.mark.validation
@pytest.mark.parametrize(
    "kind",
    ["ball", "rough ball", "glass in water", "lamp in water", "milk in glass", "point lamp, milk and stone in water"],
)
def test_bodies_of_absorbing_glass_look_as_in_volpath(kind: str) -> None:
    import mitsuba as mi

    scene = scene_of(**bodies(kind))
    rig = rig_of(Intrinsics.from_fov(48, 36, 30), PROJECTOR)
    depth = {"max_depth": 200, "rr_depth": 100}
    seen = transport(scene, rig, [], spp=512, caustics=False, glint=False, seed=3, **depth).energy.ambient
    points = {name: part for name, part in bodies(kind).items() if part["type"] == "point"}
    plain = plain_scene(scene, rig, {"type": "hdrfilm", "pixel_format": "luminance"}, **points)
    params = mi.traverse(plain)
    params["projector.scale"] = 0.0
    params.update()
    reference = render(plain, mi.load_dict({"type": "volpath", **depth}), spp=512, seed=11)
    assert abs(z_score(seen, reference)) < 5
    assert seen.mean() == pytest.approx(reference.mean(), rel=0.01)


@pytest.mark.validation
def test_indirect_light_through_a_slab_is_that_of_volpath() -> None:
    """The far wall is lit straight, and once more by way of a near wall behind the slab: no caustics, as the near wall
    gets none that would be seen."""
    import mitsuba as mi

    back = {"type": "rectangle", "to_world": transform().translate([0, 0, -0.5]).scale(2.0), "bsdf": matte(0.8)}
    scene = scene_of(slab=filled(slab(0.5, 0.55, 20.0), 20.0), wall=wall(1.0, matte(0.8), 2.0), back=back)
    rig = rig_of(CAMERA, PROJECTOR, (0.0, 0.0, 0.6), camera_at=(0.0, 0.0, 0.6))
    depth = {"max_depth": 40, "rr_depth": 40}
    energy = transport(scene, rig, [], spp=512, caustics=False, glint=False, seed=3, indirect="raw", **depth).energy
    plain = plain_scene(scene, rig, {"type": "hdrfilm", "pixel_format": "luminance"})
    reference = render(plain, mi.load_dict({"type": "volpath", **depth}), spp=512, seed=11)
    assert abs(z_score(energy.projector, reference)) < 5
    assert energy.projector.sum() - energy.direct.sum() == pytest.approx((reference - energy.direct).sum(), rel=0.05)


# ---- What is promised -------------------------------------------------------------------------------


def test_nothing_is_absorbed_outside() -> None:
    """Where glass is black inside, direct light beside it is the same to the byte, and its front mirrors as ever."""
    direct = []
    for sigma_a in (0.0, 1e5):
        scene = scene_of(ball=filled(ball(), sigma_a), wall=wall(2.0, matte()))
        rig = rig_of(CAMERA, PROJECTOR, (0.1, 0.0, 0.0))
        direct.append(transport(scene, rig, [], spp=16, max_depth=2, caustics=False).energy.direct)
    np.testing.assert_array_equal(*direct)
    behind = {"type": "rectangle", "to_world": transform().translate([0, 0, -1]).scale(20), "bsdf": matte()}
    black = scene_of(pane=filled(slab(half_size=20.0), 1e5), wall=wall(1.0, matte()), behind=behind)
    reflected = of_slab(tangents_of_the_projector(), 1e5)[1].mean()
    assert thrown_w(black, rig_of(CAMERA, PROJECTOR)) == pytest.approx(reflected, rel=3e-3)


def test_glass_that_absorbs_nothing_is_the_same_to_the_byte() -> None:
    images = []
    for body in (ball(), filled(ball(), 0.0)):
        scene = scene_of(ball=body, wall=wall(2.0, matte()), sky=SKY)
        assert absorbers_of(scene.mitsuba) is None
        images.append(transport(scene, rig_of(CAMERA, PROJECTOR), [], spp=4, seed=5).energy)
    for name in ("direct", "multipath", "specular", "caustic", "glint", "ambient"):
        assert getattr(images[0], name).tobytes() == getattr(images[1], name).tobytes()


@pytest.mark.validation
def test_holes_inside_the_glass_change_nothing() -> None:
    hole = wall((NEAR + FAR) / 2, {"type": "mask", "opacity": 0.0, "bsdf": matte()})
    scene = scene_of(slab=filled(slab()), lamp=lamp(), hole=hole)
    seen = transport(
        scene, rig_of(CAMERA, PROJECTOR), [], spp=256, caustics=False, glint=False, max_depth=8
    ).energy.ambient
    assert seen.mean() == pytest.approx(of_slab(tangents(CAMERA))[0].mean(), rel=2e-3)


def test_a_body_that_moves_takes_its_medium_along() -> None:
    scene = scene_of(ball=filled(ball(x=0.3)), wall=wall(2.0, matte()), sky=SKY)
    there = scene_of(ball=filled(ball(x=-0.3)), wall=wall(2.0, matte()), sky=SKY)
    T = np.eye(4)
    T[0, 3] = -0.6
    moved = MovingScene(scene, ("ball",)).at({"ball": T})
    images = [transport(s, rig_of(CAMERA, PROJECTOR), [], spp=16, glint=False).energy for s in (moved, there)]
    for name, tolerance in (("ambient", 2e-3), ("specular", 0.03)):
        a, b = (getattr(energy, name) for energy in images)
        assert a.sum() == pytest.approx(b.sum(), rel=tolerance)
    # The scene is symmetric, and so are the chances of photons
    assert thrown_w(moved, rig_of(CAMERA, PROJECTOR)) == pytest.approx(
        thrown_w(there, rig_of(CAMERA, PROJECTOR)), rel=1e-3
    )


def test_the_same_seed_gives_the_same_bytes_in_tiles_and_for_joint_shapes(monkeypatch: pytest.MonkeyPatch) -> None:
    def seen(memory_bytes: int) -> bytes:
        parts = {f"ball_{i}": filled(ball(0.05, x=0.12 * i - 0.3), 5.0 * i) for i in range(6)}
        scene = scene_of(**parts, wall=wall(2.0, matte()), sky=SKY)
        energy = transport(
            scene, rig_of(CAMERA, PROJECTOR), [], spp=4, caustics=False, memory_bytes=memory_bytes
        ).energy
        return energy.ambient.tobytes() + energy.specular.tobytes() + energy.glint.tobytes()

    images = [seen(1 << 30), seen(1 << 19)]
    monkeypatch.setattr(surfaces, "MANY", 2)
    images.append(seen(1 << 30))
    assert len(set(images)) == 1


def test_loops_with_absorbers_are_traced_once() -> None:
    counted, traces = counted_return()
    scene = scene_of(ball=filled(ball()), wall=wall(2.0, matte()))
    transport(scene, rig_of(CAMERA, PROJECTOR), [counted], spp=1, glint=False)
    assert len(traces) == 2  # at the vertices of paths, and where caustics are looked up


def test_absorbing_glass_is_transparent_and_begins_at_its_surface() -> None:
    scene = scene_of(slab=filled(slab()), wall=wall(2.0, matte()))
    assert [i.material for i in scene.instances] == ["transparent", "matte"]
    truth = transport(scene, rig_of(CAMERA, PROJECTOR), [], spp=1, caustics=False).truth
    np.testing.assert_allclose(truth.z, NEAR, atol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"interior": absorbing(5.0, 0.2)}, "that scatters by a SmoothDielectric; only boundaries of matched"),
        ({"exterior": absorbing(5.0, 0.2)}, "a medium that scatters by a"),
        ({"exterior": {"type": "heterogeneous", "albedo": 0.0}}, "surrounded by a HeterogeneousMedium"),
        (
            {"bsdf": {"type": "thindielectric"}},
            "that absorbs by a ThinDielectric; only bodies that refract",
        ),
        ({"bsdf": {"type": "mask", "opacity": 0.5, "bsdf": GLASS}}, "only bodies that refract"),
        ({"bsdf": {"type": "diffuse"}}, "only bodies that refract"),
        ({"bsdf": {"type": "conductor"}}, "only bodies that refract"),
    ],
)
def test_what_cannot_hold_an_absorbing_medium_is_refused(change: dict[str, Any], message: str) -> None:
    import mitsuba as mi

    if change.get("exterior", {}).get("type") == "heterogeneous":
        grid = mi.VolumeGrid(np.ones((2, 2, 2, 1), np.float32))
        change["exterior"]["sigma_t"] = {"type": "gridvolume", "grid": grid}
    with pytest.raises(FileFormatError, match=message):
        load_scene(
            {"type": "scene", "camera": {"type": "perspective", "fov": 20.0}, "body": {**filled(ball()), **change}}
        )


@pytest.mark.parametrize(
    ("medium", "match"),
    [
        ({"sigma_a": 46.6, "albedo": 0.0}, "expected albedo and sigma_t"),
        ({"material": "water"}, "expected albedo and sigma_t"),
        (
            {"sigma_t": {"type": "spectrum", "value": [(400, 46.6), (900, 2.0)]}, "albedo": 0.0},
            "expected sigma_t to be one",
        ),
        ({"sigma_t": {"type": "rgb", "value": [20.0, 2.0, 0.2]}, "albedo": 0.0}, "expected sigma_t to be one"),
        (
            {"sigma_t": {"type": "constvolume", "value": {"type": "rgb", "value": [20.0, 2.0, 0.2]}}},
            "expected sigma_t to be one",
        ),
    ],
)
def test_media_that_the_renderer_would_read_as_others_are_refused(medium: dict[str, Any], match: str) -> None:
    ball = {"type": "sphere", "bsdf": {"type": "dielectric"}, "interior": {"type": "homogeneous", **medium}}
    with pytest.raises(FileFormatError, match=match):
        scene_of(ball=ball)
