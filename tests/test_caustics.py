# SPDX-License-Identifier: Apache-2.0
"""Caustics against closed forms: optical length, image sources, projector coordinates, sharpness."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from delta_scenes import (
    GLASS,
    MIRROR,
    ProjectorCoordinates,
    SlabPath,
    fresnel_conductor,
    fresnel_dielectric,
    matte,
    rig_of,
    scene_of,
    sheets_of,
    slab,
    thrown_w,
    transform,
    wall,
)
from tiers import to_validate

import rangesim
from rangesim import AmcwToF, IdealToF, Intrinsics, Lens, Rig, Scene, StructuredLight, transport
from rangesim.response import SPEED_OF_LIGHT, DenseResponse, Fringes, Images, LightPath, TransientHistogram

SCENES = Path(__file__).resolve().parent.parent / "scenes"
CAMERA = Intrinsics.from_fov(64, 48, 20)
PROJECTOR = Intrinsics.from_fov(160, 120, 26)
NEAR, FAR, PLANE = 0.4, 0.45, 1.0
"""Depths of the slab's faces and of the plane behind it, metres."""


# ---- Optical length through a slab ------------------------------------------------------------------


@dataclass(frozen=True)
class ShortPaths(DenseResponse):
    """Radiance, and radiance times length, of paths below a length: light that did not bounce inside the slab."""

    limit_m: float
    channels: int = 2  # type: ignore[misc]

    def weights(self, path: LightPath, m: Any) -> list[Any]:
        short = m.select(path.path_length_m < self.limit_m, 1.0, 0.0)
        return [short, short * path.path_length_m]


def across_of_pixels(camera: Intrinsics, reach: float) -> np.ndarray:
    """(h, w, 8, 8) metres from the axis at which parts of the pixels see the depth `reach`, straight."""
    offsets = (np.arange(8) + 0.5) / 8 - 0.5
    pixels = camera.pixel_centres()[..., None, None, :] + np.stack(np.meshgrid(offsets, offsets), axis=-1)
    return np.linalg.norm(camera.normalise(pixels), axis=-1) * reach


def check_lengths(signals: rangesim.Signals, limit_m: float, expected: np.ndarray) -> None:
    """The issue's law: exact to 1e-5 m; a pixel alone has the noise of where its light lands within it."""
    radiance, moment = signals.channels[ShortPaths(limit_m)]
    lengths = moment / radiance
    assert abs((lengths - expected).mean()) < 1e-5
    assert np.abs((lengths - expected).mean(axis=0)).max() < 1e-4
    assert np.abs(lengths - expected).max() < 1e-3


def test_the_length_of_light_through_a_slab_is_that_of_snell_s_law() -> None:
    """The projector shines through the slab, the camera behind it sees the plane straight: caustics alone."""
    camera_at, limit_m = 0.6, 1.5
    scene = scene_of(slab=slab(NEAR, FAR), wall=wall(PLANE, matte()))
    rig = rig_of(CAMERA, Intrinsics.from_fov(160, 120, 12), camera_at=(0.0, 0.0, camera_at))
    signals = transport(scene, rig, [ShortPaths(limit_m)], spp=64, max_depth=2)
    across = across_of_pixels(CAMERA, PLANE - camera_at)
    path = SlabPath(PLANE, FAR - NEAR)
    light, optical = path.irradiance(across), path.length(path.tangent(across)) + np.hypot(across, PLANE - camera_at)
    check_lengths(signals, limit_m, (light * optical).sum(axis=(2, 3)) / light.sum(axis=(2, 3)))
    np.testing.assert_array_equal(signals.energy.caustic, signals.energy.projector)


def test_the_length_of_sight_through_a_slab_is_that_of_snell_s_law() -> None:
    """The camera looks through the slab, the projector behind it lights the plane evenly: no caustics."""
    lamp_at, limit_m = 0.6, 1.53
    scene = scene_of(slab=slab(NEAR, FAR), wall=wall(PLANE, matte()))
    rig = rig_of(CAMERA, Intrinsics.from_fov(160, 120, 60), (0.0, 0.0, lamp_at))
    signals = transport(scene, rig, [ShortPaths(limit_m)], spp=64, max_depth=4)
    t, path = across_of_pixels(CAMERA, 1.0), SlabPath(PLANE, FAR - NEAR)
    across, light = path.across(t), path.transmittance(t)
    optical = path.length(t) + np.hypot(across, PLANE - lamp_at)
    check_lengths(signals, limit_m, (light * optical).sum(axis=(2, 3)) / light.sum(axis=(2, 3)))
    assert signals.energy.specular.min() > 0
    assert not signals.energy.direct.any()


@pytest.mark.validation
def test_light_and_sight_through_a_slab_and_what_time_of_flight_makes_of_it() -> None:
    """A slab before the plane lets it appear (n - 1) d too far: camera and projector both look through it.

    Both may bounce in the slab, R^2 of them twice.
    """
    limit_m, frequency_hz, d = 2.15, 100e6, FAR - NEAR
    ideal, amcw, bins = IdealToF(), AmcwToF((frequency_hz,), waveform="sine"), TransientHistogram(2.0, 0.03, 40)
    scene = scene_of(slab=slab(NEAR, FAR), wall=wall(PLANE, matte()))
    signals = transport(
        scene,
        rig_of(CAMERA, PROJECTOR),
        [ideal, amcw, bins, ShortPaths(limit_m)],
        spp=64,
        max_depth=2,
        glint=False,  # the projector's reflection in the slab, in the middle of the image
    )
    t, ways = across_of_pixels(CAMERA, 1.0), [SlabPath(PLANE, d, turns=k) for k in range(3)]
    pairs = [(to, back) for to in ways for back in ways]
    light = np.stack([to.irradiance(back.across(t)) * back.transmittance(t) for to, back in pairs])
    length = np.stack([to.length(to.tangent(back.across(t))) + back.length(t) for to, back in pairs])
    check_lengths(signals, limit_m, (light * length)[0].sum(axis=(2, 3)) / light[0].sum(axis=(2, 3)))

    # Each sensor's range is the closed form of its own mean over the bounces
    expected = (light * length).sum(axis=(0, 3, 4)) / light.sum(axis=(0, 3, 4)) / 2
    by_length = rangesim.decode(rangesim.expose(signals, ideal)).range_m
    assert abs((by_length - expected).mean()) < 1e-4  # photons draw what is reflected to and fro inside
    phasor = (light * np.exp(2j * np.pi * frequency_hz * length / SPEED_OF_LIGHT)).sum(axis=(0, 3, 4))
    from_phase = np.angle(phasor) % (2 * np.pi) * SPEED_OF_LIGHT / (4 * np.pi * frequency_hz)
    by_phase = rangesim.decode(rangesim.expose(signals, amcw)).range_m
    assert abs((by_phase - from_phase).mean()) < 1e-4
    axis = (slice(22, 26), slice(30, 34))
    assert (by_phase[axis] - PLANE).mean() == pytest.approx(0.5 * d, abs=8e-4)

    # A histogram tells the bounces apart: 2 n d later
    histogram = signals.channels[bins].sum(axis=(1, 2))  # 2.05 to 2.1 m, and 2.2 to 2.25 m
    assert histogram[1:4].sum() == pytest.approx(histogram.sum(), rel=0.01)
    assert histogram[6:9].sum() / histogram[1:4].sum() == pytest.approx(2 * fresnel_dielectric(0.0) ** 2, rel=0.2)
    np.testing.assert_allclose(signals.channels[bins].sum(axis=0), signals.energy.projector, rtol=1e-5)


# ---- Image sources ----------------------------------------------------------------------------------

MIRROR_X = 0.3
NARROW = Intrinsics.from_fov(160, 120, 20)
PLASTIC = {"type": "plastic", "int_ior": 1.5, "ext_ior": 1.0, "diffuse_reflectance": {"type": "spectrum", "value": 0.6}}


def beside_a_mirror(bsdf: dict[str, Any], **parts: dict[str, Any]) -> tuple[Scene, Rig]:
    """The projector shines on a mirror to its right alone, which sends the light to the plane z = 1."""
    place = transform().translate([MIRROR_X, 0, 0.5]).rotate([0, 1, 0], -90).scale(0.45)
    scene = scene_of(mirror={"type": "rectangle", "to_world": place, "bsdf": bsdf}, wall=wall(PLANE, matte()), **parts)
    rig = rig_of(
        Intrinsics.from_fov(64, 48, 12), NARROW, (0.0, 0.0, 0.0), (0.3, 0.0, 0.5), (-0.3, 0.0, 0.2), (-0.02, 0.0, 1.0)
    )
    return scene, rig


def points_on_the_plane(rig: Rig) -> np.ndarray:
    """(h, w, 3) where the rays through pixel centres meet z = PLANE, world."""
    rays = rig.camera.directions(rig.camera.pixel_centres()) @ rig.T_world_camera[:3, :3].T
    origin = rig.T_world_camera[:3, 3]
    return np.asarray(origin + rays * ((PLANE - origin[2]) / rays[..., 2])[..., None])


def image_source(rig: Rig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Irradiance of the plane by the projector's mirror image (a perfect mirror's), the (u, v) there, and the
    direction (world) in which the light left the projector."""
    mirrored = points_on_the_plane(rig) * [-1, 1, 1] + [2 * MIRROR_X, 0, 0]
    local = mirrored @ rig.T_world_projector[:3, :3]  # the projector stands in the origin
    irradiance = rig.projector_irradiance * mirrored[..., 2] / local[..., 2] ** 3
    return irradiance, rig.projector.project(local), mirrored / np.linalg.norm(mirrored, axis=-1, keepdims=True)


def over_image_source(scene: Scene, rig: Rig, factor: Any) -> tuple[np.ndarray, np.ndarray]:
    """The caustic over `factor` (of the direction in which light left) times that of the image source, (h, w), and how
    far its projector coordinates are off, (2, h, w)."""
    coordinates = ProjectorCoordinates()
    irradiance, uv, direction = image_source(rig)
    signals = transport(scene, rig, [coordinates], spp=64, max_depth=2, indirect="raw")
    white, u, v = signals.channels[coordinates]
    np.testing.assert_allclose(white, signals.energy.caustic, rtol=1e-5)
    ratio = white * np.pi / 0.5 / (irradiance * factor(direction))
    return ratio, np.stack([u / white, v / white]) - np.moveaxis(uv, -1, 0)


def test_light_off_a_flat_mirror_is_that_of_the_image_source() -> None:
    """In every pixel, in brightness and in the projector's coordinates."""
    ratio, off_px = over_image_source(*beside_a_mirror(MIRROR), lambda d: fresnel_conductor(d[..., 0]))
    assert np.abs(ratio - 1).max() < 1e-3
    assert np.abs(off_px).max() < 0.02


def check_pixels(ratio: np.ndarray, off_px: np.ndarray) -> None:
    """Where few triangles cover a point, nothing is drawn by lot, however faint they are.

    One sample in eight looks for them. Some pixels lie across the line where triangles become faint, so there it
    matters where in the pixel the eight samples are.
    """
    assert np.quantile(np.abs(ratio - 1), 0.95) < 4e-3
    assert ratio.mean() == pytest.approx(1.0, abs=2e-3)
    assert np.median(np.abs(off_px)) < 0.05
    assert np.abs(off_px.mean(axis=(1, 2))).max() < 0.005


@pytest.mark.validation
def test_light_off_polished_plastic_is_fresnel_s_share_of_the_image_source() -> None:
    check_pixels(
        *over_image_source(*beside_a_mirror(PLASTIC), lambda d: fresnel_dielectric(np.sqrt(1 - d[..., 0] ** 2)))
    )


def test_a_faint_reflection_of_the_pattern_is_as_sharp_as_a_bright_one() -> None:
    """Neighbouring pixels share crowds of faint triangles alone."""
    contrast = [
        fringe_contrast(*beside_a_mirror(bsdf), spp=32, max_depth=2, inner=np.s_[8:-8, 8:-8], period_px=6.0)
        for bsdf in (MIRROR, PLASTIC)
    ]
    assert contrast[1] == pytest.approx(contrast[0], rel=0.02)


@pytest.mark.validation
def test_light_through_a_pane_and_off_plastic_lands_and_goes_on() -> None:
    """On the plastic light that came through glass both lands and goes on; fractions of either must add up."""
    pane = wall(0.1, {**GLASS, "type": "thindielectric"}, 0.19)
    scene, rig = beside_a_mirror(PLASTIC, pane=pane)
    check_pixels(
        *over_image_source(
            scene,
            rig,
            lambda d: fresnel_dielectric(np.sqrt(1 - d[..., 0] ** 2)) * pane_transmittance(np.sqrt(1 - d[..., 2] ** 2)),
        )
    )


def pane_transmittance(sine: np.ndarray) -> np.ndarray:
    r = fresnel_dielectric(sine)
    return np.asarray((1 - r) / (1 + r))


# ---- Panes and holes --------------------------------------------------------------------------------


def before_the_projector(**parts: dict[str, Any]) -> rangesim.Signals:
    """A plane lit through what is put before the projector; the camera sees it straight."""
    rig = rig_of(CAMERA, PROJECTOR, (0.3, 0.0, 0.0), (0.0, 0.0, 1.0))
    scene = scene_of(wall=wall(PLANE, matte()), **parts)
    return transport(scene, rig, [ProjectorCoordinates()], spp=64, max_depth=2)


def test_a_thin_pane_dims_the_light_and_does_not_shift_it() -> None:
    """In every pixel: the irradiance of direct light times the transmittance, and the same projector coordinates."""
    free = before_the_projector()
    pane = before_the_projector(pane=wall(0.2, {**GLASS, "type": "thindielectric"}, 0.15, x=0.3))
    points = points_on_the_plane(free.rig) - [0.3, 0.0, 0.0]
    sine = np.linalg.norm(points[..., :2], axis=-1) / np.linalg.norm(points, axis=-1)
    ratio = pane.energy.caustic / free.energy.direct / pane_transmittance(sine)
    assert np.abs(ratio - 1).max() < 1e-3
    assert not pane.energy.direct.any()
    (a, *uv_a), (b, *uv_b) = (s.channels[ProjectorCoordinates()] for s in (free, pane))
    for x, y in zip(uv_a, uv_b, strict=True):
        assert np.abs(x / a - y / b).max() < 0.02


def test_light_that_lands_on_a_coat_stays_there_although_its_reflection_lands_elsewhere() -> None:
    """A plastic wall behind a pane is as bright as in direct light, times the pane's transmittance."""
    rig = rig_of(CAMERA, PROJECTOR, (0.3, 0.0, 0.0), (0.0, 0.0, 1.0))
    behind = {**wall(0, matte()), "to_world": transform().translate([0, 0, -2]).scale([5, 5, 1])}
    parts, options = {"wall": wall(PLANE, PLASTIC), "behind": behind}, {"spp": 16, "max_depth": 2, "glint": False}
    free = transport(scene_of(**parts), rig, [], **options).energy.direct
    pane = wall(0.2, {**GLASS, "type": "thindielectric"}, 0.15, x=0.3)
    dimmed = transport(scene_of(**parts, pane=pane), rig, [], **options).energy.caustic
    off = np.abs(dimmed / free / pane_transmittance(np.array(0.2)) - 1)
    assert np.percentile(off, 95) < 0.01  # some pixels see what the pane throws back, in the coat


def test_light_through_a_pane_right_before_the_projector_counts_once() -> None:
    """A protective window, at 1 mm from the lens for a wall at 5 m."""
    pane, rig = wall(1e-3, {**GLASS, "type": "thindielectric"}, 2e-3), rig_of(CAMERA, PROJECTOR, camera_at=(0.3, 0, 0))
    energy = transport(scene_of(wall=wall(5.0, matte()), pane=pane), rig, [], spp=4, max_depth=2, glint=False).energy
    assert energy.caustic.any()
    assert not energy.direct.any()


@pytest.mark.parametrize(
    ("opacity", "nested"),
    [(0.0, matte()), (0.5, matte()), *to_validate((0.5, PLASTIC), (0.5, MIRROR))],
    ids=lambda part: str(part["type"]) if isinstance(part, dict) else str(part),
)
def test_holes_pass_light_straight_and_without_noise(opacity: float, nested: dict[str, Any]) -> None:
    """Light through a hole is direct light, in every pixel and in its projector coordinates."""
    free = before_the_projector()
    veil = {"type": "mask", "opacity": opacity, "bsdf": nested}
    through = before_the_projector(hole=wall(0.2, veil, 0.15, x=0.3))
    np.testing.assert_allclose(through.energy.direct, (1 - opacity) * free.energy.direct, rtol=1e-5)
    coordinates = [s.channels[ProjectorCoordinates()] for s in (through, free)]
    np.testing.assert_allclose(coordinates[0], (1 - opacity) * coordinates[1], rtol=2e-3)
    assert through.truth.projector_visible.all()


def test_the_light_of_a_perforated_sheet_is_its_pattern() -> None:
    """A checkerboard of holes of two projector pixels, whose open area no grid over the image could tell."""
    cells, half, at = 240, 0.15, 0.2
    pattern = {"type": "checkerboard", "color0": 0.0, "color1": 1.0, "to_uv": transform().scale([cells / 2] * 2 + [1])}
    sheet = {"type": "mask", "opacity": pattern, "bsdf": matte()}
    free, through = before_the_projector(), before_the_projector(sheet=wall(at, sheet, half, x=0.3))
    ratio = through.energy.direct / free.energy.direct
    within = np.random.default_rng(0).uniform(-0.5 / CAMERA.fx, 0.5 / CAMERA.fx, (4096, 1, 1, 2))
    on_sheet = (points_on_the_plane(free.rig)[..., :2] + within - [0.3, 0.0]) * at + half
    is_open = (np.floor(on_sheet * cells / (2 * half)).sum(axis=-1) % 2 == 1).mean(axis=0)
    assert is_open.std() > 0.15
    assert (ratio - is_open).std() < 0.04  # 64 samples a pixel
    assert ratio.mean() == pytest.approx(0.5, abs=3e-3)
    assert not through.energy.caustic.any()


def test_a_picture_in_glass_is_thrown_as_sharply_as_the_projector_s_pixels() -> None:
    """Fields of three pixels; points of the largest cells are four apart."""
    cells, half, at, thin = 174, 0.15, 0.2, {**GLASS, "type": "thindielectric"}
    pattern = {"type": "checkerboard", "color0": 0.2, "color1": 1.0, "to_uv": transform().scale([cells / 2] * 2 + [1])}
    clear, stained = (
        before_the_projector(pane=wall(at, bsdf, half, x=0.3)).energy.caustic
        for bsdf in (thin, {**thin, "specular_transmittance": pattern})
    )
    within = np.random.default_rng(0).uniform(-0.5 / CAMERA.fx, 0.5 / CAMERA.fx, (4096, 1, 1, 2))
    place = (points_on_the_plane(rig_of(CAMERA, PROJECTOR))[..., :2] + within - [0.3, 0.0]) * at + half
    is_bright = (np.floor(place * cells / (2 * half)).sum(axis=-1) % 2 == 1).mean(axis=0)
    ratio = stained / clear
    assert ratio.mean() == pytest.approx(0.6, abs=0.01)
    assert np.corrcoef(ratio.ravel(), is_bright.ravel())[0, 1] > 0.8  # its edges are a pixel wide


def test_light_through_a_hole_and_a_pane_is_that_through_the_pane() -> None:
    pane = wall(0.3, {**GLASS, "type": "thindielectric"}, 0.25, x=0.3)
    hole = wall(0.2, {"type": "mask", "opacity": 0.0, "bsdf": matte()}, 0.15, x=0.3)
    alone, both = before_the_projector(pane=pane), before_the_projector(pane=pane, hole=hole)
    assert (both.energy.caustic / alone.energy.caustic).mean() == pytest.approx(1, abs=0.01)
    assert not both.energy.direct.any()


# ---- Shading normals --------------------------------------------------------------------------------


def mesh(file: Path, vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray, bsdf: dict[str, Any]) -> Any:
    """A mesh with the normals of its own at the vertices."""
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + [f"vn {x} {y} {z}" for x, y, z in normals]
    lines += ["f " + " ".join(f"{i}//{i}" for i in face) for face in faces + 1]
    file.write_text("\n".join(lines) + "\n")
    return {"type": "obj", "filename": str(file), "bsdf": bsdf}


def tilted(file: Path, square: Any, towards: Any, degrees: float, bsdf: dict[str, Any]) -> Any:
    """A square (4, 3) whose vertex normals are its own, tilted towards a direction in it."""
    square, towards = np.asarray(square, dtype=float), np.asarray(towards, dtype=float)
    normal = np.cross(square[1] - square[0], square[2] - square[0])
    tilt = np.cos(np.radians(degrees)) * normal / np.linalg.norm(normal) + np.sin(np.radians(degrees)) * towards
    return mesh(file, square, np.tile(tilt, (4, 1)), np.array([[0, 1, 2], [0, 2, 3]]), bsdf)


@pytest.mark.validation
@pytest.mark.parametrize("wound_outwards", [True, False])
@pytest.mark.parametrize("degrees", [60, 30, -15])
def test_caustics_meet_shading_normals_as_direct_light_does(
    tmp_path: Path, degrees: float, wound_outwards: bool
) -> None:
    """Where light and sight are on one side for both normals, a pane before the projector does no more than dim."""
    square = np.array([[-5, -5, PLANE], [-5, 5, PLANE], [5, 5, PLANE], [5, -5, PLANE]])
    way = [1, 0, 0] if wound_outwards else [-1, 0, 0]
    part = tilted(tmp_path / "wall.obj", square if wound_outwards else square[::-1], way, degrees, matte())
    free, dimmed = ({"wall": part}, {"wall": part, "pane": wall(0.2, {**GLASS, "type": "thindielectric"}, 0.15, x=0.3)})
    rig = rig_of(CAMERA, PROJECTOR, (0.3, 0.0, 0.0), (0.0, 0.0, 1.0))
    direct, caustic = (transport(scene_of(**parts), rig, [], spp=64, max_depth=2).energy for parts in (free, dimmed))
    points = points_on_the_plane(rig) - [0.3, 0.0, 0.0]
    sine = np.linalg.norm(points[..., :2], axis=-1) / np.linalg.norm(points, axis=-1)
    ratio = caustic.caustic / direct.direct / pane_transmittance(sine)
    assert not caustic.direct.any()
    assert ratio.mean() == pytest.approx(1, abs=0.01)
    # Nor does it change how light falls off across the image
    assert np.abs(ratio.reshape(4, 12, 4, 16).mean(axis=(1, 3)) - 1).max() < 0.05


@pytest.mark.validation
def test_a_coarse_smooth_ball_has_no_facets_behind_a_pane(tmp_path: Path) -> None:
    """Each 4 x 4 pixels are as bright as in direct light, on the facets and along their edges."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.2)
    part = mesh(tmp_path / "ball.obj", np.add(ball.vertices, [0, 0, PLANE]), ball.vertices / 0.2, ball.faces, matte())
    pane = wall(0.2, {**GLASS, "type": "thindielectric"}, 0.15, x=0.3)
    rig = rig_of(Intrinsics.from_fov(64, 48, 16), PROJECTOR, (0.3, 0.0, 0.0), (0.0, 0.0, 1.0))
    options: dict[str, Any] = {"spp": 64, "max_depth": 2}
    free = transport(scene_of(ball=part), rig, [], **options).energy.direct
    dimmed = transport(scene_of(ball=part, pane=pane), rig, [], **options).energy.caustic
    blocks = [x.reshape(12, 4, 16, 4).mean(axis=(1, 3)) for x in (free, dimmed)]
    ratio = blocks[1] / blocks[0] / pane_transmittance(np.array(0.1))
    assert ratio.mean() == pytest.approx(1, abs=0.01)
    assert ratio.std() < 0.03  # 0.11 where the geometric cosine is left out


def test_no_caustic_lights_a_surface_that_one_of_its_normals_turns_away(tmp_path: Path) -> None:
    """Light from behind the geometric normal, or from behind the shading normal."""
    square = np.array([[-5, -5, PLANE], [-5, 5, PLANE], [5, 5, PLANE], [5, -5, PLANE]])
    part = tilted(tmp_path / "wall.obj", square, [1, 0, 0], 60, matte())
    for at, pane in (((0.8, 0.0, 1.5), wall(1.4, {**GLASS, "type": "thindielectric"}, 0.5, x=0.8)),
                     ((-1.0, 0.0, 0.0), wall(0.2, {**GLASS, "type": "thindielectric"}, 0.4, x=-0.8))):  # fmt: skip
        rig = rig_of(CAMERA, PROJECTOR, at, (0.0, 0.0, 1.0))
        energy = transport(scene_of(wall=part, pane=pane), rig, [], spp=4, max_depth=2, glint=False).energy
        assert not energy.projector.any()


# ---- Where light lands, and how sharp ----------------------------------------------------------------


def ball_over_a_plane() -> tuple[Scene, Rig]:
    """A camera under a glass ball sees all of the plane that it lights, most of it faintly, and nothing else."""
    ball = {"type": "sphere", "center": [0.0, 0.0, 0.5], "radius": 0.06, "bsdf": GLASS}
    scene = scene_of(ball=ball, wall=wall(0.62, matte(), 3.0))
    rig = rig_of(Intrinsics.from_fov(64, 64, 110), Intrinsics.from_fov(640, 640, 20), camera_at=(0.0, 0.0, 0.57))
    return scene, rig


def test_a_camera_sees_as_much_light_as_lands() -> None:
    """The flux of the plane that the camera sees, a focus and faint light around it."""
    scene, rig = ball_over_a_plane()
    half_m = 27 / 32 * 0.05 * np.tan(np.radians(55))
    sheets = sheets_of(scene, rig)
    assert sheets is not None
    middle = sheets.position[sheets.triangles].mean(axis=1)
    landed = sheets.flux[np.abs(middle[:, :2]).max(axis=1) < half_m].sum()
    caustic = transport(scene, rig, [], spp=16, max_depth=2).energy.caustic[5:-5, 5:-5]
    seen = float(caustic.sum(dtype=float)) * np.pi / 0.5 * (0.05 / rig.camera.fx) ** 2
    assert seen == pytest.approx(landed, rel=5e-3)


def board_behind_a_pane(wall_z: float | None, **parts: dict[str, Any]) -> tuple[Scene, Rig]:
    """A board at 0.6 m that covers a fifth of the image, behind a pane at 0.5 m, and a wall behind."""
    parts["board"] = wall(0.6, matte(), 0.09)
    if wall_z is not None:
        parts["wall"] = wall(wall_z, matte())
    camera = Intrinsics.from_fov(160, 120, 40)
    return scene_of(**parts), rig_of(camera, Intrinsics.from_fov(640, 480, 44), (0.1, 0.0, 0.0), (0.0, 0.0, 0.6))


BOARD = np.s_[32:-32, 52:-52]
"""Inner pixels of the board."""


def fringe_contrast(scene: Scene, rig: Rig, inner: Any = BOARD, period_px: float = 16.0, **options: Any) -> float:
    """Amplitude of fringes over their mean, mean over inner pixels."""
    options = {"spp": 64, "max_depth": 4, "glint": False, **options}
    fringes = Fringes(0, period_px)
    signals = transport(scene, rig, [fringes], **options)
    amplitude = np.hypot(*signals.channels[fringes][..., *inner])
    return float((amplitude / signals.energy.projector[inner]).mean())


@pytest.mark.validation
@pytest.mark.parametrize("wall_z", [0.9, 6.0])
def test_a_far_wall_does_not_blur_near_fringes_behind_a_pane(wall_z: float) -> None:
    pane = wall(0.5, {**GLASS, "type": "thindielectric"}, 0.1)
    free = fringe_contrast(*board_behind_a_pane(None))
    alone = fringe_contrast(*board_behind_a_pane(None, pane=pane))
    behind = fringe_contrast(*board_behind_a_pane(wall_z, pane=pane))
    assert behind == pytest.approx(alone, abs=0.005)
    assert behind == pytest.approx(free, abs=0.01)  # light reflected to and fro between pane and board takes 0.006


@pytest.mark.parametrize("size", [(8, 6), (160, 1)], ids=["flood", "stripes"])
def test_a_coarse_emitter_has_sharp_shadows_behind_a_pane(size: tuple[int, int]) -> None:
    """The pixels of a flood illuminator are only coordinates, and those of a projector of stripes are lines."""
    f = np.array(size) * Intrinsics.from_fov(160, 120, 26).fx / [160, 120]
    projector = Intrinsics(*size, *f, size[0] / 2, size[1] / 2)
    rig = rig_of(Intrinsics.from_fov(64, 48, 20), projector, (0.3, 0.0, 0.0), (0.0, 0.0, 1.0))
    parts = {"wall": wall(PLANE, matte()), "card": wall(0.7, matte(), 0.03, x=0.13)}
    options: dict[str, Any] = {"spp": 16, "max_depth": 2, "glint": False, "indirect": "raw"}
    free = transport(scene_of(**parts), rig, [], **options).energy.direct
    pane = wall(0.2, {**GLASS, "type": "thindielectric"}, 0.15, x=0.3)
    behind = transport(scene_of(**parts, pane=pane), rig, [], **options).energy.caustic
    assert (free < 0.01 * free.max()).mean() > 0.05  # the shadow
    assert (np.abs(behind / pane_transmittance(np.array(0.1)) - free) > 0.05 * free.max()).mean() < 0.03


def test_fringes_in_focus_are_as_sharp_behind_a_pane_as_before_it() -> None:
    """A projector with a lens shows each pixel over its whole width, also behind glass; docs/optics.md."""
    lens, pane, contrast = Lens(1e-5, focus_m=PLANE), wall(0.2, {**GLASS, "type": "thindielectric"}, 0.15, x=0.3), []
    for parts in ({}, {"pane": pane}):
        rig = rig_of(Intrinsics.from_fov(64, 8, 10), PROJECTOR, (0.3, 0.0, 0.0), (0.0, 0.0, 1.0), projector_lens=lens)
        signals = transport(scene_of(wall=wall(PLANE, matte()), **parts), rig, [Fringes(0, 8.0)], spp=64, max_depth=2)
        contrast.append((np.hypot(*signals.channels[Fringes(0, 8.0)]) / signals.energy.projector).mean())
    assert contrast[1] == pytest.approx(contrast[0], rel=3e-3)  # without the width of pixels 1 / sinc(1 / 8) = 1.026


@pytest.mark.parametrize("turned", [False, True], ids=["columns", "rows"])
def test_a_wire_that_passes_between_points_of_the_grid_throws_its_light(turned: bool) -> None:
    """The wire is one projector pixel wide, along columns or rows; a block of the grid is eight pixels."""
    import mitsuba as mi

    projector = Intrinsics.from_fov(1280, 800, 50)
    pixel_m, half_length_m, thrown = 0.7 / projector.fx, 0.07, []
    for shift_px in (0.0, 0.5, 1.0, 1.5):
        place = transform().rotate([0, 0, 1], 90.0 * turned).translate([0.1 + shift_px * pixel_m, 0, 0.7])
        size = mi.ScalarTransform4f().rotate([0, 1, 0], 45).scale([pixel_m / 8**0.5, half_length_m, pixel_m / 8**0.5])
        wire = {"type": "cube", "to_world": place @ size, "bsdf": MIRROR}
        box = {"type": "cube", "to_world": transform().scale(3.0), "bsdf": matte()}
        thrown.append(thrown_w(scene_of(wire=wire, box=box), rig_of(CAMERA, projector), seeds=3))
    met = 2 * half_length_m / pixel_m / (1280 * 800)
    assert np.mean(thrown) == pytest.approx(met * fresnel_conductor(np.sqrt(0.5)), rel=0.15)
    assert min(thrown) > 0.5 * max(thrown)


# ---- Same bytes -------------------------------------------------------------------------------------


def all_sensors() -> list[rangesim.Sensor]:
    return [StructuredLight(axes=("columns",)), AmcwToF((20e6,)), rangesim.DirectToF(bins=32, bin_s=800e-12)]


def test_caustics_leave_all_other_light_as_it_was() -> None:
    scene = rangesim.load_scene(SCENES / "tabletop.xml")
    rig = scene.rig(width=64, height=48)
    on, off = (transport(scene, rig, all_sensors(), spp=8, caustics=n, glint=False) for n in (True, False))
    for name in ("direct", "multipath", "specular", "ambient", "glint"):
        np.testing.assert_array_equal(getattr(on.energy, name), getattr(off.energy, name))
    assert on.energy.caustic.any()
    assert not off.energy.caustic.any()


def test_without_glass_and_mirrors_caustics_and_glint_change_nothing() -> None:
    scene = rangesim.load_scene(SCENES / "matte.xml")
    rig = scene.rig(width=64, height=48)
    on = transport(scene, rig, all_sensors(), spp=4)
    off = transport(scene, rig, all_sensors(), spp=4, caustics=False, glint=False)
    assert not on.energy.caustic.any()
    for response, values in on.channels.items():
        np.testing.assert_array_equal(values, off.channels[response])


def test_tiles_change_no_byte() -> None:
    scene = rangesim.load_scene(SCENES / "tabletop.xml")
    rig = scene.rig(width=64, height=48)
    images = [transport(scene, rig, all_sensors(), spp=4, memory_bytes=memory) for memory in (2 << 30, 999_937)]
    for response, values in images[0].channels.items():
        np.testing.assert_array_equal(values, images[1].channels[response])


def test_threads_change_no_byte() -> None:
    import drjit as dr

    scene = rangesim.load_scene(SCENES / "tabletop.xml")
    rig = scene.rig(width=64, height=48)
    before = dr.thread_count()
    images = []
    for threads in (1, 2):
        dr.set_thread_count(threads)
        images.append(transport(scene, rig, all_sensors(), spp=4))
    dr.set_thread_count(before)
    for response, values in images[0].channels.items():
        np.testing.assert_array_equal(values, images[1].channels[response])


# ---- Responses --------------------------------------------------------------------------------------


def test_every_response_sees_the_caustics() -> None:
    scene = rangesim.load_scene(SCENES / "tabletop.xml")
    rig = scene.rig(width=64, height=48)
    light = StructuredLight(axes=("columns",), code="gray")
    images, bins = Images(np.ones((1, 800, 1280), np.float32)), TransientHistogram(0.0, 0.5, 60)
    signals = transport(scene, rig, [light, images, bins], spp=8)
    white = signals.energy.projector
    assert (signals.energy.caustic > 0.5 * white).any()
    frames = signals.frames(light, ambient_transmission=0.0)
    np.testing.assert_allclose(frames[0:-2:2] + frames[1:-2:2], np.broadcast_to(white, (11, 48, 64)), rtol=1e-4)
    np.testing.assert_allclose(signals.channels[images][0], white, rtol=1e-4)
    np.testing.assert_allclose(signals.channels[bins].sum(axis=0), white, rtol=1e-4)
