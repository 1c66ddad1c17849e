# SPDX-License-Identifier: Apache-2.0
"""Where samples lie, and how indirect light is shared: noise of the renderer that must not pass for the sensor's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rangesim import AmcwToF, DirectToF, Lens, Signals, StructuredLight, decode, expose, load_scene, transport
from rangesim.environment.backend import select_variant
from rangesim.light_transport.indirect_filter import FIRST_CHAIN, Guides, LightFilter, level_weights, mixed_pixels

SCENES = Path(__file__).resolve().parent.parent / "scenes"


def places(samples: int, pixels: int = 50) -> tuple[np.ndarray, np.ndarray]:
    """(samples, 2, pixels) places in the pixel and on the lens."""
    select_variant()
    import mitsuba as mi

    from rangesim.light_transport.sampling import in_pairs

    shift = np.random.default_rng(3).random((4, pixels)).astype(np.float32)
    both = [
        in_pairs(mi.Point2f(shift[:2]), mi.Point2f(shift[2:]), mi.UInt32(i), mi.UInt32(samples)) for i in range(samples)
    ]
    in_pixel, on_lens = (np.stack([np.broadcast_to(pair[k].numpy(), (2, pixels)) for pair in both]) for k in (0, 1))
    return in_pixel, on_lens


# ---- Samples in pairs -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("samples", [1, 2, 3, 16, 17, 64])
def test_samples_of_a_pixel_have_their_centroid_at_its_centre(samples: int) -> None:
    for place in places(samples):
        np.testing.assert_allclose(place.mean(axis=0), 0.5, atol=1e-6)
        assert place.min() >= 0
        assert place.max() <= 1


@pytest.mark.validation
def test_samples_fill_the_pixel_and_the_lens() -> None:
    """The variance of a uniform distribution, 1/12, along each axis and no correlation between any two of the four."""
    in_pixel, on_lens = places(256, pixels=8)
    moments = np.stack([np.cov(np.concatenate([in_pixel[..., i].T, on_lens[..., i].T])) for i in range(8)])
    np.testing.assert_allclose(moments.mean(axis=0), np.eye(4) / 12, atol=0.008)


@pytest.mark.parametrize("spp", [1, 3, 4, 16])
def test_a_plane_is_read_without_sampling_noise(spp: int) -> None:
    """Phase is linear in place: the robust sigma of depth was 0.93 mm at 16 samples; the detector alone gives 0.16."""
    scene = load_scene(SCENES / "plane.xml")
    sensor = StructuredLight()
    signals = transport(scene, scene.rig(width=320, height=240), [sensor], spp=spp)
    image = decode(expose(signals, sensor))
    error = (image.z - signals.truth.z)[image.valid]
    assert 1.4826 * np.median(np.abs(error - np.median(error))) < 0.005e-3


def test_defocus_blurs_a_plane_without_sampling_noise() -> None:
    """The lens is sampled in pairs too: what lies out of focus is as exact as what lies in it."""
    scene = load_scene(SCENES / "plane.xml")
    sensor = StructuredLight()
    sharp = scene.rig(width=160, height=120)
    soft = replace(sharp, camera_lens=Lens(3e-3, focus_m=0.5))
    image = decode(expose(transport(scene, soft, [sensor], spp=16), sensor))
    error = (image.z - transport(scene, sharp, [], spp=1).truth.z)[10:-10, 10:-10]
    assert 1.4826 * np.nanmedian(np.abs(error - np.nanmedian(error))) < 0.02e-3


# ---- Choices at glass -----------------------------------------------------------------------------------------------


def test_a_number_that_has_decided_is_uniform_again() -> None:
    select_variant()
    import mitsuba as mi

    from rangesim.light_transport.sampling import used_up

    number = (np.arange(10_000) + 0.5) / 10_000
    for low, high in ((0.0, 0.04), (0.04, 1.0), (0.3, 0.55)):
        some = number[(number >= low) & (number < high)]
        again = np.sort(used_up(mi.Float(some), mi.Float(high - low)).numpy())
        np.testing.assert_allclose(again, (np.arange(len(some)) + 0.5) / len(some), atol=1 / len(some))


def test_reflection_and_refraction_are_chosen_evenly_over_the_samples() -> None:
    """A pane passes about 92 %; chosen at random, the passed light would scatter like a binomial distribution."""
    select_variant()
    import mitsuba as mi

    move = mi.ScalarTransform4f().translate
    scene = load_scene(
        {
            "type": "scene",
            "wall": {"type": "rectangle", "bsdf": {"type": "diffuse"}},
            "pane": {
                "type": "cube",
                "to_world": move([0, 0, 0.95]).scale([0.012, 0.012, 0.001]),
                "bsdf": {"type": "dielectric"},
            },
            "camera": {
                "type": "perspective",
                "fov": 50,
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 1], [0, 0, 0], [0, 1, 0]),
            },
        }
    )
    rig = scene.rig(width=64, height=48, baseline_m=0.2)  # the projector lights the wall beside the pane
    first, second = (
        transport(scene, rig, [], spp=64, seed=seed, caustics=False, max_depth=2).energy.specular[18:30, 24:40]
        for seed in range(2)
    )
    scatter = np.std(first - second) / np.sqrt(2) / np.mean(first)
    assert scatter < 0.45 * np.sqrt(0.08 / 0.92 / 64)


# ---- Shared indirect light ------------------------------------------------------------------------------------------


def plane_guides(h: int = 40, w: int = 50, **changes: Any) -> Guides:
    y, x = np.mgrid[:h, :w].astype(np.float32)
    position = np.stack([x / 500, y / 500, np.ones_like(x)], -1)
    normal = np.broadcast_to(np.float32([0, 0, -1]), (h, w, 3)).copy()
    reflectance, cosine = np.full((h, w), 0.5, np.float32), np.zeros((h, w), np.float32)
    guides = Guides(np.zeros((h, w), np.int32), position, normal, reflectance, position, cosine)
    return guides._replace(**changes)


def two_instances() -> np.ndarray:
    instance = np.zeros((40, 50), np.int32)
    instance[:, 20:] = 1
    instance[15:25, 30:33] = 2
    return instance


def smoothed(light: np.ndarray, guides: Guides) -> np.ndarray:
    after = np.array(light, np.float32)
    LightFilter(guides).apply(after)
    return after


def test_light_that_is_linear_in_place_stays_as_it_is_but_for_one_sided_windows() -> None:
    guides = plane_guides()
    y, x = np.mgrid[:40, :50].astype(np.float32)
    after = smoothed(np.stack([1 + 0.03 * x - 0.02 * y, np.ones_like(x)]), guides)
    np.testing.assert_allclose(after[0, 4:-4, 4:-4], (1 + 0.03 * x - 0.02 * y)[4:-4, 4:-4], rtol=1e-5)
    np.testing.assert_allclose(after[0], 1 + 0.03 * x - 0.02 * y, atol=0.04)  # a plain mean would be off by 0.2
    np.testing.assert_allclose(after[1], 1, rtol=1e-5)


def test_noise_falls_as_the_root_of_the_pixels_of_the_window() -> None:
    noise = np.random.default_rng(5).normal(size=(6, 40, 50)).astype(np.float32)
    after = smoothed(noise, plane_guides())
    assert after[:, 4:-4, 4:-4].std() == pytest.approx(1 / 9, rel=0.1)
    assert after.std() < 1 / 5


def test_weights_add_up_to_one_and_stay_within_an_instance() -> None:
    guides = plane_guides(instance=two_instances())
    for step in (1, 3):
        weights = level_weights(guides, mixed_pixels(guides), step)
        np.testing.assert_allclose(weights.sum(axis=1), 1, rtol=1e-5)
    for number in range(3):
        light = np.where(guides.instance == number, 1.0, 1e6).astype(np.float32)[None]
        after = smoothed(light, guides)
        np.testing.assert_allclose(after[0][guides.instance == number], 1, rtol=1e-5)


def test_pixels_of_their_own_other_normals_and_other_planes_share_nothing() -> None:
    guides = plane_guides()
    alone = np.full((40, 50), -1, np.int32)
    tilted = guides.normal.copy()
    tilted[:, 20:] = [0.8, 0, -0.6]
    behind = guides.position.copy()
    behind[:, 20:, 2] += 0.5
    light = np.ones((1, 40, 50), np.float32)
    light[:, :, 20:] = 5
    apart = guides._replace(position=behind, first=behind)
    for changed in (guides._replace(instance=alone), guides._replace(normal=tilted), apart):
        after = smoothed(light, changed)
        np.testing.assert_allclose(after, light, rtol=1e-5)
    assert not np.allclose(smoothed(light, guides), light)


def test_glossy_pixels_share_light_while_their_normals_are_alike() -> None:
    angle = np.radians(np.arange(50, dtype=np.float32) / 5)  # a cylinder that turns by 0.2 degrees a pixel
    normal = np.broadcast_to(np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], -1), (40, 50, 3))
    noise = np.random.default_rng(1).normal(1, 0.1, (1, 40, 50)).astype(np.float32)
    left = []
    for degrees in (0.1, 0.5, 90):
        cosine = np.full((40, 50), np.cos(np.radians(degrees)), np.float32)
        left.append(smoothed(noise, plane_guides(normal=normal, cosine=cosine)).std() / noise.std())
    assert left[0] > 2 * left[2]  # 9 pixels of a column, or all 81
    assert left[0] > 1.2 * left[1] > 1.2 * 1.2 * left[2]


def test_behind_mirrors_and_glass_light_is_shared_along_one_chain_and_not_over_long_ways() -> None:
    chains = FIRST_CHAIN + two_instances()
    light = np.where(chains == FIRST_CHAIN, 1.0, 1e6).astype(np.float32)[None]
    after = smoothed(light, plane_guides(instance=chains))
    np.testing.assert_allclose(after, light, rtol=1e-5)
    guides = plane_guides(instance=np.full((40, 50), FIRST_CHAIN, np.int32))
    noise = np.random.default_rng(1).normal(1, 0.1, (1, 40, 50)).astype(np.float32)
    assert smoothed(noise, guides).std() < 0.2 * noise.std()
    far = guides.position * np.float32([100, 100, 1])  # neighbours see points that are 0.2 m apart at 1 to 10 m
    np.testing.assert_array_equal(smoothed(noise, guides._replace(position=far))[:, :3, :3], noise[:, :3, :3])


def test_what_is_seen_in_mirrors_through_glass_and_on_gloss_has_less_noise_and_hardly_another_mean() -> None:
    """A test of the whole pass: the medians of the errors of multipath, by material class."""
    scene = load_scene(SCENES / "tabletop.xml")
    rig = scene.rig(width=160, height=120)

    def multipath(**options: Any) -> np.ndarray:
        signals = transport(scene, rig, [], caustics=False, glint=False, sampling_error=False, **options)
        classes.update(signals.truth.classes())
        return signals.energy.multipath

    classes: dict[str, np.ndarray] = {}
    raw, filtered = (multipath(spp=16, indirect=name) for name in ("raw", "filtered"))
    reference = multipath(spp=256, seed=1, indirect="raw")
    mean = np.mean([filtered, *(multipath(spp=16, seed=seed) for seed in (2, 3, 4))], axis=0)  # one errs by 2.6 %
    for name, most in {"glossy": 0.65, "mirror": 0.85, "transparent": 0.5}.items():
        seen = classes[name] & (reference > 0)
        before, after = (np.median(np.abs(light - reference)[seen]) for light in (raw, filtered))
        assert after < most * before, name
        assert mean[seen].mean() == pytest.approx(reference[seen].mean(), rel=0.05), name


def test_textures_are_not_blurred() -> None:
    """What is smooth is the light that arrives: radiance over reflectance."""
    reflectance = np.random.default_rng(2).uniform(0.05, 0.9, (40, 50)).astype(np.float32)
    after = smoothed(reflectance[None], plane_guides(reflectance=reflectance))
    np.testing.assert_allclose(after[0], reflectance, rtol=1e-5)


@pytest.mark.validation
def test_the_edges_of_a_texture_do_not_shine_into_their_surroundings() -> None:
    """A pixel on the edge has the mean reflectance of its samples, not that at its centre."""
    select_variant()
    import mitsuba as mi

    to_world = mi.ScalarTransform4f()
    squares = {"type": "checkerboard", "color0": 0.02, "color1": 0.9, "to_uv": to_world.scale(8)}
    eye = to_world.look_at([0, 0, -1.5], [0.3, 0.2, 1], [0, 1, 0])
    room = {"type": "cube", "to_world": to_world.scale([1, 1, 2]), "flip_normals": True}
    scene = load_scene(
        {
            "type": "scene",
            "room": room | {"bsdf": {"type": "diffuse", "reflectance": squares}},
            "sensor": {"type": "perspective", "fov": 50.0, "to_world": eye},
        }
    )
    rig = scene.rig(width=64, height=48)
    raw = transport(scene, rig, [], spp=2048, seed=5, indirect="raw").energy.multipath
    filtered = np.mean([transport(scene, rig, [], spp=16, seed=s).energy.multipath for s in range(16)], axis=0)
    assert np.sqrt(np.mean((filtered - raw) ** 2)) < 0.2 * raw.mean()


def test_a_pixel_whose_samples_miss_the_textured_surface_shares_no_light() -> None:
    """A few samples may all miss a bar that is narrower than a pixel, though the centre of the pixel meets it."""
    reflectance = np.full((40, 50), 0.5, np.float32)
    reflectance[20, 25] = 0
    guides = plane_guides(reflectance=np.full((40, 50), 0.5, np.float32)).with_reflectance(reflectance)
    light = np.ones((1, 40, 50), np.float32)
    light[0, 20, 25] = 7
    after = smoothed(light, guides)
    np.testing.assert_allclose(np.delete(after.ravel(), 20 * 50 + 25), 1, rtol=1e-5)
    assert after[0, 20, 25] == 7


def traced(**settings: Any) -> Signals:
    """The scene `matte`, seen by two kinds of sensors."""
    scene, sensors = load_scene(SCENES / "matte.xml"), [AmcwToF(), DirectToF(bins=64, bin_s=800e-12)]
    return transport(scene, scene.rig(width=160, height=120), sensors, **settings)


@pytest.fixture(scope="module")
def matte() -> dict[str, Signals]:
    return {name: traced(spp=16, indirect=name) for name in ("raw", "filtered")}


@pytest.mark.validation
def test_filtered_light_has_less_noise_and_hardly_another_mean(matte: dict[str, Signals]) -> None:
    raw, filtered = (matte[name].energy.multipath for name in ("raw", "filtered"))
    reference = traced(spp=512, seed=9, indirect="raw").energy.multipath
    seen = reference > 0
    assert np.median(np.abs(filtered - reference)[seen]) < 0.35 * np.median(np.abs(raw - reference)[seen])
    assert filtered.mean(dtype=float) == pytest.approx(reference.mean(dtype=float), rel=0.02)
    np.testing.assert_array_equal(matte["raw"].energy.direct, matte["filtered"].energy.direct)


def test_every_channel_gets_the_same_light(matte: dict[str, Signals]) -> None:
    """Bins add up to the energy split, filtered or not."""
    for signals in matte.values():
        bins = next(values for response, values in signals.channels.items() if response.channels >= 32)
        np.testing.assert_allclose(bins.sum(axis=0), signals.energy.projector, rtol=2e-4, atol=1e-7)


def test_an_unknown_way_with_indirect_light_is_refused() -> None:
    scene = load_scene(SCENES / "plane.xml")
    with pytest.raises(ValueError, match="expected indirect to be one of filtered, raw, got 'smooth'"):
        transport(scene, scene.rig(width=8, height=8), [], spp=1, indirect="smooth")  # type: ignore[arg-type]
