# SPDX-License-Identifier: Apache-2.0
"""Caustic photons against closed forms: optical length, image sources, projector coordinates, density estimation."""

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
    slab,
    transform,
    wall,
)
from tiers import to_validate

import rangesim
from rangesim import AmcwToF, IdealToF, Intrinsics, Rig, Scene, StructuredLight, transport
from rangesim.environment.backend import select_variant
from rangesim.light_transport import caustics, photon_maps
from rangesim.light_transport.photon_maps import ALPHA, GatheringRadius, Level, radii_of_maps
from rangesim.light_transport.photons import EnergyBudget, Photons, shift_of, stratified_choice, trace_photons
from rangesim.light_transport.traced_scene import TracedScene
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
    """The projector shines through the slab, the camera behind it sees the plane straight: photons alone."""
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
    """The camera looks through the slab, the projector behind it lights the plane evenly: no photons."""
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
        photons=2_000_000,
        glint=False,  # the projector's reflection in the slab, in the middle of the image
        caustic_radius_m=4e-3,
    )
    t, ways = across_of_pixels(CAMERA, 1.0), [SlabPath(PLANE, d, turns=k) for k in range(3)]
    pairs = [(to, back) for to in ways for back in ways]
    light = np.stack([to.irradiance(back.across(t)) * back.transmittance(t) for to, back in pairs])
    length = np.stack([to.length(to.tangent(back.across(t))) + back.length(t) for to, back in pairs])
    check_lengths(signals, limit_m, (light * length)[0].sum(axis=(2, 3)) / light[0].sum(axis=(2, 3)))

    # Each sensor's range is the closed form of its own mean over the bounces
    expected = (light * length).sum(axis=(0, 3, 4)) / light.sum(axis=(0, 3, 4)) / 2
    by_length = rangesim.decode(rangesim.expose(signals, ideal)).range_m
    assert abs((by_length - expected).mean()) < 2e-5
    phasor = (light * np.exp(2j * np.pi * frequency_hz * length / SPEED_OF_LIGHT)).sum(axis=(0, 3, 4))
    from_phase = np.angle(phasor) % (2 * np.pi) * SPEED_OF_LIGHT / (4 * np.pi * frequency_hz)
    by_phase = rangesim.decode(rangesim.expose(signals, amcw)).range_m
    assert abs((by_phase - from_phase).mean()) < 2e-5
    axis = (slice(22, 26), slice(30, 34))
    assert (by_phase[axis] - PLANE).mean() == pytest.approx(0.5 * d, abs=8e-4)  # photon noise is 1.5e-4

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


def check_image_source(scene: Scene, rig: Rig, factor: Any, off_px: float = 0.015) -> None:
    """The caustic is `factor` (of the direction in which light left) times that of the image source."""
    coordinates = ProjectorCoordinates()
    irradiance, uv, direction = image_source(rig)
    options = {"spp": 64, "max_depth": 2, "indirect": "raw"}
    seeds = [transport(scene, rig, [coordinates], seed=s, **options) for s in range(4)]
    caustic = np.mean([s.energy.caustic for s in seeds], axis=0)
    ratio = caustic * np.pi / 0.5 / (irradiance * factor(direction))
    assert ratio.mean() == pytest.approx(1, abs=0.01)
    white, u, v = np.mean([s.channels[coordinates] for s in seeds], axis=0)
    np.testing.assert_allclose(white, caustic, rtol=1e-5)
    blocks = [x.reshape(6, 8, 8, 8).sum(axis=(1, 3)) for x in (white, u - uv[..., 0] * white, v - uv[..., 1] * white)]
    off = np.stack(blocks[1:]) / blocks[0]
    assert np.abs(off.mean(axis=(1, 2))).max() < off_px
    assert np.abs(off).max() < 0.2 + 2 * off_px


def test_light_off_a_flat_mirror_is_that_of_the_image_source() -> None:
    check_image_source(*beside_a_mirror(MIRROR), lambda d: fresnel_conductor(d[..., 0]))


@pytest.mark.validation
def test_light_off_polished_plastic_is_fresnel_s_share_of_the_image_source() -> None:
    check_image_source(*beside_a_mirror(PLASTIC), lambda d: fresnel_dielectric(np.sqrt(1 - d[..., 0] ** 2)))


@pytest.mark.validation
def test_light_through_a_pane_and_off_plastic_lands_and_goes_on() -> None:
    """On the plastic a photon that came through glass both lands and goes on; fractions of either must add up."""
    pane = wall(0.1, {**GLASS, "type": "thindielectric"}, 0.19)
    scene, rig = beside_a_mirror(PLASTIC, pane=pane)
    check_image_source(
        scene,
        rig,
        lambda d: fresnel_dielectric(np.sqrt(1 - d[..., 0] ** 2)) * pane_transmittance(np.sqrt(1 - d[..., 2] ** 2)),
        off_px=0.08,  # faint light is gathered over six times the radius, and there is more of it on one side
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


@pytest.mark.validation
def test_a_thin_pane_dims_the_light_and_does_not_shift_it() -> None:
    free = before_the_projector()
    pane = before_the_projector(pane=wall(0.2, {**GLASS, "type": "thindielectric"}, 0.15, x=0.3))
    points = points_on_the_plane(free.rig) - [0.3, 0.0, 0.0]
    sine = np.linalg.norm(points[..., :2], axis=-1) / np.linalg.norm(points, axis=-1)
    ratio = pane.energy.caustic / free.energy.direct / pane_transmittance(sine)
    assert ratio.mean() == pytest.approx(1, abs=0.01)
    assert not pane.energy.direct.any()
    (a, *uv_a), (b, *uv_b) = (s.channels[ProjectorCoordinates()] for s in (free, pane))
    for x, y in zip(uv_a, uv_b, strict=True):
        assert abs((x / a - y / b).mean()) < 0.01


def test_light_through_a_cut_out_hole_arrives_undimmed_and_counts_as_caustic() -> None:
    free = before_the_projector()
    hole = {"type": "mask", "opacity": 0.0, "bsdf": matte()}
    through = before_the_projector(hole=wall(0.2, hole, 0.15, x=0.3))
    assert (through.energy.projector / free.energy.direct).mean() == pytest.approx(1, abs=0.01)
    np.testing.assert_array_equal(through.energy.caustic, through.energy.projector)


@pytest.mark.parametrize("nested", [matte(), *to_validate(PLASTIC, MIRROR)], ids=lambda bsdf: str(bsdf["type"]))
def test_half_a_hole_passes_half_the_light(nested: dict[str, Any]) -> None:
    free = before_the_projector()
    veil = {"type": "mask", "opacity": 0.5, "bsdf": nested}
    through = before_the_projector(hole=wall(0.2, veil, 0.15, x=0.3))
    assert (through.energy.projector / free.energy.direct).mean() == pytest.approx(0.5, abs=0.01)


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
def test_photons_meet_shading_normals_as_direct_light_does(
    tmp_path: Path, degrees: float, wound_outwards: bool
) -> None:
    """Where light and sight are on one side for both normals, a pane before the projector does no more than dim."""
    square = np.array([[-5, -5, PLANE], [-5, 5, PLANE], [5, 5, PLANE], [5, -5, PLANE]])
    way = [1, 0, 0] if wound_outwards else [-1, 0, 0]
    part = tilted(tmp_path / "wall.obj", square if wound_outwards else square[::-1], way, degrees, matte())
    free, dimmed = ({"wall": part}, {"wall": part, "pane": wall(0.2, {**GLASS, "type": "thindielectric"}, 0.15, x=0.3)})
    rig = rig_of(CAMERA, PROJECTOR, (0.3, 0.0, 0.0), (0.0, 0.0, 1.0))
    direct, caustic = (
        transport(scene_of(**parts), rig, [], spp=64, max_depth=2).energy
        for parts in (free, dimmed)
    )
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


def test_no_photon_lights_a_surface_that_one_of_its_normals_turns_away(tmp_path: Path) -> None:
    """Light from behind the geometric normal, or from behind the shading normal."""
    square = np.array([[-5, -5, PLANE], [-5, 5, PLANE], [5, 5, PLANE], [5, -5, PLANE]])
    part = tilted(tmp_path / "wall.obj", square, [1, 0, 0], 60, matte())
    for at, pane in (((0.8, 0.0, 1.5), wall(1.4, {**GLASS, "type": "thindielectric"}, 0.5, x=0.8)),
                     ((-1.0, 0.0, 0.0), wall(0.2, {**GLASS, "type": "thindielectric"}, 0.4, x=-0.8))):  # fmt: skip
        rig = rig_of(CAMERA, PROJECTOR, at, (0.0, 0.0, 1.0))
        energy = transport(scene_of(wall=part, pane=pane), rig, [], spp=4, max_depth=2, glint=False).energy
        assert not energy.projector.any()


# ---- Density estimation -----------------------------------------------------------------------------


@pytest.mark.parametrize(("photons", "maps", "radius_m"), [(60, 4, 0.3), (300, 4, 0.2), (3000, 16, 0.1)])
@pytest.mark.parametrize("most_looked_at", [16, 10_000])
@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.36, 0.48, 0.8)])
def test_a_gather_is_the_sum_over_all_photons_of_its_map(
    monkeypatch: pytest.MonkeyPatch,
    photons: int,
    maps: int,
    radius_m: float,
    most_looked_at: int,
    normal: tuple[float, float, float],
) -> None:
    """Epanechnikov's kernel over photons on a plane, by brute force; where a gather looks at some of them, its mean."""
    import drjit as dr
    import mitsuba as mi

    select_variant()
    monkeypatch.setattr(photon_maps, "MAX_LOOKED_AT", most_looked_at)
    rng = np.random.default_rng(1)

    def on_the_plane(n: int) -> np.ndarray:
        p = rng.uniform(-1, 1, (n, 3))
        return np.asarray((p - np.outer(p @ normal, normal)).astype(np.float32))

    position, of_map, nothing = on_the_plane(photons), np.arange(photons) % maps, np.zeros(photons, np.float32)
    flux = rng.uniform(0.5, 1.5, photons).astype(np.float32)
    none = EnergyBudget(0, 0, 0, 0, 0, 0)
    columns = position, 0 * position, flux, nothing, nothing, nothing, nothing + 1, of_map
    landed = Photons(*columns, maps, none, per_pixel=1.0)
    there = np.array([0.0, 0.0, 3.0])
    radius = GatheringRadius(0.0, (0.0, 0.0), there, there, fixed_m=radius_m)
    built = photon_maps.PhotonMaps(landed, radius, irradiance=1e-9)  # all brighter than the first level
    points, repeats = on_the_plane(1000), 64
    sample = np.arange(1000) % maps
    many = mi.UInt32(np.tile(sample, repeats).astype(np.uint32))
    uniform = [mi.Float(rng.random(1000 * repeats).astype(np.float32)) for _ in range(2)]
    active = dr.full(mi.Bool, True, 1000 * repeats)
    place = mi.Point3f(np.tile(points, (repeats, 1)).T)
    found = built.gather(0, place, mi.Normal3f(*normal), built.reach(place), many, *uniform, active)
    gathered = found.irradiance.numpy().reshape(repeats, 1000)

    radii = radii_of_maps(radius_m, maps)[sample][:, None]
    square = ((points[:, None].astype(float) - position[None]) ** 2).sum(axis=-1)
    kernel = np.maximum(1 - square / radii**2, 0) * 2 / (np.pi * radii**2) * (of_map[None] == sample[:, None])
    expected = kernel @ flux
    if most_looked_at > photons:
        np.testing.assert_allclose(gathered, np.broadcast_to(expected, gathered.shape), atol=1e-4 * expected.max())
    error = gathered.mean(axis=1).std(ddof=1) / np.sqrt(repeats)
    assert abs(gathered.mean() - expected.mean()) < 5 * error + 1e-4 * expected.mean()


def test_a_gather_whose_radius_grows_with_distance_is_the_sum_over_all_photons(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Radii of some twenty classes on one plane; a point has the radius of its own place."""
    import drjit as dr
    import mitsuba as mi

    select_variant()
    monkeypatch.setattr(photon_maps, "MAX_LOOKED_AT", 10_000)
    rng, n, maps = np.random.default_rng(2), 40_000, 4

    def on_the_plane(k: int) -> np.ndarray:
        return np.column_stack([rng.uniform(-2, 2, (k, 2)), np.zeros(k)]).astype(np.float32)

    position, of_map, nothing = on_the_plane(n), np.arange(n) % maps, np.zeros(n, np.float32)
    flux = rng.uniform(0.5, 1.5, n).astype(np.float32)
    none = EnergyBudget(0, 0, 0, 0, 0, 0)
    columns = position, 0 * position, flux, nothing, nothing, nothing, nothing + 1, of_map
    landed = Photons(*columns, maps, none, per_pixel=1.0)
    radius = GatheringRadius(0.05, (0.02, 0.07), np.array([-1.0, 0.0, 0.05]), np.array([1.0, 0.0, 0.05]))
    built = photon_maps.PhotonMaps(landed, radius, irradiance=1e-9)
    points, sample = on_the_plane(500), np.arange(500) % maps
    place, many = mi.Point3f(points.T), mi.UInt32(sample.astype(np.uint32))
    active, half = dr.full(mi.Bool, True, 500), dr.full(mi.Float, 0.5, 500)
    reach = built.reach(place)
    found = built.gather(0, place, mi.Normal3f(0, 0, 1), reach, many, half, half, active)

    radii = radius.at(points) * radii_of_maps(1.0, maps)[sample]
    np.testing.assert_allclose(reach.radius.numpy(), radius.at(points), rtol=1e-5)
    square = ((points[:, None].astype(float) - position[None]) ** 2).sum(axis=-1)
    kernel = np.maximum(1 - square / radii[:, None] ** 2, 0) * 2 / (np.pi * radii[:, None] ** 2)
    expected = (kernel * (of_map[None] == sample[:, None])) @ flux
    np.testing.assert_allclose(found.irradiance.numpy(), expected, atol=1e-3 * expected.max())
    near = built.near(0, place, reach, many, active).numpy()
    assert near[expected > 0].all()


def ball_over_a_plane() -> tuple[Scene, Rig]:
    """A camera under a glass ball sees all of the plane that it lights, most of it faintly, and nothing else."""
    ball = {"type": "sphere", "center": [0.0, 0.0, 0.5], "radius": 0.06, "bsdf": GLASS}
    scene = scene_of(ball=ball, wall=wall(0.62, matte(), 3.0))
    rig = rig_of(Intrinsics.from_fov(64, 64, 110), Intrinsics.from_fov(160, 160, 20), camera_at=(0.0, 0.0, 0.57))
    return scene, rig


def received_w(energy: rangesim.EnergySplit, rig: Rig) -> float:
    """Flux of the caustic on the plane that the camera of `ball_over_a_plane` sees."""
    return float(energy.caustic.sum(dtype=float)) * np.pi / 0.5 * (0.05 / rig.camera.fx) ** 2


def test_radii_follow_the_law_of_progressive_photon_mapping() -> None:
    radii = radii_of_maps(0.01, 64)
    assert radii[0] == 0.01
    i = np.arange(1, 64)
    np.testing.assert_allclose(radii[1:] ** 2, radii[:-1] ** 2 * (i + ALPHA) / (i + 1))


@pytest.mark.parametrize(("photons", "radius_m"), [(50_000, 1e-3), *to_validate((400_000, 1e-3), (400_000, 3e-3))])
def test_flux_depends_on_neither_radius_nor_number_of_photons(photons: int, radius_m: float) -> None:
    scene, rig = ball_over_a_plane()
    landed = trace_photons(TracedScene.of(scene.mitsuba, rig), 1.0, 400_000, 16, 3, 2 << 30)
    seen = np.abs(landed.position[:, :2]).max(axis=1) < 0.05 * np.tan(np.radians(55)) - 0.01
    rays = rig.camera.normalise(rig.camera.pixel_centres()) * 0.05
    expected = landed.flux[seen].sum(dtype=float) / 16
    options = {"spp": 64, "max_depth": 2, "photons": photons, "caustic_radius_m": radius_m}
    caustic = np.mean([transport(scene, rig, [], seed=s, **options).energy.caustic for s in range(4)], axis=0)
    inside = np.abs(rays).max(axis=-1) < 0.05 * np.tan(np.radians(55)) - 0.01
    received = float(caustic[inside].sum(dtype=float)) * np.pi / 0.5 * (0.05 / rig.camera.fx) ** 2
    assert received == pytest.approx(expected, rel=0.01)


@pytest.mark.validation
def test_levels_change_the_noise_and_not_the_mean(monkeypatch: pytest.MonkeyPatch) -> None:

    scene, rig = ball_over_a_plane()

    def render(seed: int) -> np.ndarray:
        energy = transport(scene, rig, [], spp=32, max_depth=2, seed=seed).energy
        return energy.caustic.reshape(4, 16, 4, 16).mean(axis=(1, 3))

    with_levels = np.stack([render(s) for s in range(6)])
    for module in (photon_maps, caustics):
        monkeypatch.setattr(module, "LEVELS", (Level(np.inf, 1.0, 1.0),))
    without = np.stack([render(s) for s in range(6)])
    # Faint light around the bright spot is blurred more; mirrored parts of the image alike
    ratio = with_levels.mean(axis=0) / without.mean(axis=0)
    assert np.abs(ratio - 1).max() < 0.15
    assert np.abs(ratio[1:3, 1:3] - 1).max() < 0.02
    assert np.abs(ratio - ratio[:, ::-1]).max() < 0.06
    assert with_levels.mean() == pytest.approx(without.mean(), rel=0.005)


def board_behind_a_pane(wall_z: float | None, **parts: dict[str, Any]) -> tuple[Scene, Rig]:
    """A board at 0.6 m that covers a fifth of the image, behind a pane at 0.5 m, and a wall behind."""
    parts["board"] = wall(0.6, matte(), 0.09)
    if wall_z is not None:
        parts["wall"] = wall(wall_z, matte())
    camera = Intrinsics.from_fov(160, 120, 40)
    return scene_of(**parts), rig_of(camera, Intrinsics.from_fov(640, 480, 44), (0.1, 0.0, 0.0), (0.0, 0.0, 0.6))


def fringe_contrast(scene: Scene, rig: Rig, **options: Any) -> float:
    """Of fringes of 16 projector pixels: amplitude over mean, mean over the board's inner pixels."""
    options = {"spp": 64, "max_depth": 4, "glint": False, **options}
    signals = transport(scene, rig, [Fringes(0, 16.0)], **options)
    board = (..., slice(32, -32), slice(52, -52))
    amplitude = np.hypot(*signals.channels[Fringes(0, 16.0)][board])
    return float((amplitude / signals.energy.projector[board]).mean())


@pytest.mark.validation
@pytest.mark.parametrize("wall_z", [0.9, 6.0])
def test_a_far_wall_does_not_blur_near_fringes_behind_a_pane(wall_z: float) -> None:
    pane = wall(0.5, {**GLASS, "type": "thindielectric"}, 0.1)
    free = fringe_contrast(*board_behind_a_pane(None))
    alone = fringe_contrast(*board_behind_a_pane(None, pane=pane))
    behind = fringe_contrast(*board_behind_a_pane(wall_z, pane=pane))
    assert behind == pytest.approx(alone, abs=0.005)
    assert behind == pytest.approx(free, abs=0.05)


@pytest.mark.validation
def test_more_photons_make_less_noise() -> None:
    scene, rig = beside_a_mirror(MIRROR)
    noise = []
    for photons in (20_000, 320_000):
        images = [
            transport(
                scene, rig, [], spp=16, max_depth=2, photons=photons, seed=s
            ).energy.caustic
            for s in range(3)
        ]
        noise.append(np.std(images, axis=0, ddof=1).mean() / np.mean(images))
    assert noise[0] / noise[1] > 2.5  # 4 by Poisson; strata and the pixels' own sampling change it a little


# ---- Through which pixels photons are sent ----------------------------------------------------------


def test_every_seed_sends_photons_through_other_pixels_with_the_chance_of_each() -> None:
    """Systematic sampling: a photon of a map in every stratum, so a pixel's chance per map is its fraction, at most
    1."""
    select_variant()
    fraction = np.random.default_rng(1).choice([1.0, 0.02], 400)
    per_map, maps, seeds = 60, 3, range(2000)
    number, cumulative = np.arange(per_map * maps), np.cumsum(fraction)
    shifts = np.array([shift_of(seed) for seed in seeds])
    chosen = np.stack([stratified_choice(cumulative, number, per_map, shift) for shift in shifts])
    expected = per_map * fraction / fraction.sum()
    per_seed = [np.bincount(one, minlength=400) for one in chosen.reshape(-1, per_map)]
    found = np.mean(per_seed, axis=0)
    tolerance = 5 * np.sqrt(expected * (1 - expected) / len(seeds))  # as if maps were no help
    assert np.all(np.abs(found - expected) < tolerance)
    assert found.min() > 0
    assert (
        len(np.unique(np.sort(chosen), axis=0)) > 500
    )  # 180 photons shift over 400 pixels: each pixel changes it once
    assert np.all(np.diff(chosen[:, :per_map]) >= 0)  # and each seed is spread along the curve


def test_all_64_bits_of_a_seed_shift_the_photons_evenly() -> None:
    """Kolmogorov and Smirnov's distance to the uniform distribution, over low and over high halves."""
    select_variant()
    for step in (0, 32):
        shifts = np.sort([shift_of((k << step) + 3) for k in range(1000)])
        assert len(np.unique(shifts)) == len(shifts)
        assert np.abs(shifts - (np.arange(1000) + 0.5) / 1000).max() < 1.95 / np.sqrt(1000)  # p = 0.001


def test_photons_of_many_seeds_light_every_pixel_that_sees_glass() -> None:
    """One in eight pixels is lit by a seed; were it the same ones each time, seeds would average nothing out."""
    scene = scene_of(slab=slab(NEAR, FAR), wall=wall(PLANE, matte()))
    traced = TracedScene.of(scene.mitsuba, rig_of(CAMERA, Intrinsics.from_fov(32, 24, 12)))
    lit = []
    for seed in range(64):
        landed = trace_photons(traced, 1.0, 96, 2, seed, 1 << 30)
        lit.append(np.bincount(landed.v.astype(int) * 32 + landed.u.astype(int), minlength=32 * 24) > 0)
    assert max(map(np.sum, lit)) <= 96
    assert np.any(lit, axis=0).mean() > 0.99


@pytest.mark.parametrize("turned", [False, True], ids=["columns", "rows"])
def test_a_wire_that_passes_between_the_centres_of_cells_gets_its_photons(turned: bool) -> None:
    """A cell of the pre-pass is 2 x 2 projector pixels here, and the wire one pixel wide, along columns or rows.

    With rays through the centres of the cells, no photon at all met it at two of these four places.
    """
    import mitsuba as mi

    projector = Intrinsics.from_fov(1280, 800, 50)
    pixel_m, half_length_m = 0.7 / projector.fx, 0.07
    for shift_px in (0.0, 0.5, 1.0, 1.5):
        place = transform().rotate([0, 0, 1], 90.0 * turned).translate([0.1 + shift_px * pixel_m, 0, 0.7])
        size = mi.ScalarTransform4f().rotate([0, 1, 0], 45).scale([pixel_m / 8**0.5, half_length_m, pixel_m / 8**0.5])
        wire = {"type": "cube", "to_world": place @ size, "bsdf": MIRROR}
        scene, maps = scene_of(wire=wire, wall=wall(PLANE, matte())), 4
        traced = TracedScene.of(scene.mitsuba, rig_of(CAMERA, projector))
        energy = trace_photons(traced, 1.0, 40_000, maps, 1, 1 << 30).energy
        met = 1 - energy.direct / energy.emitted
        assert met == pytest.approx(2 * half_length_m / pixel_m / (1280 * 800), rel=0.3)


# ---- Same bytes -------------------------------------------------------------------------------------


def all_sensors() -> list[rangesim.Sensor]:
    return [StructuredLight(axes=("columns",)), AmcwToF((20e6,)), rangesim.DirectToF(bins=32, bin_s=800e-12)]


def test_caustics_leave_all_other_light_as_it_was() -> None:
    scene = rangesim.load_scene(SCENES / "tabletop.xml")
    rig = scene.rig(width=64, height=48)
    on, off = (transport(scene, rig, all_sensors(), spp=8, photons=n, glint=False) for n in (50_000, 0))
    for name in ("direct", "multipath", "specular", "ambient", "glint"):
        np.testing.assert_array_equal(getattr(on.energy, name), getattr(off.energy, name))
    assert on.energy.caustic.any()
    assert not off.energy.caustic.any()


def test_without_glass_and_mirrors_photons_and_glint_change_nothing() -> None:
    scene = rangesim.load_scene(SCENES / "matte.xml")
    rig = scene.rig(width=64, height=48)
    on = transport(scene, rig, all_sensors(), spp=4)
    off = transport(scene, rig, all_sensors(), spp=4, caustics=False, glint=False)
    assert not on.energy.caustic.any()
    for response, values in on.channels.items():
        np.testing.assert_array_equal(values, off.channels[response])


def test_chunks_of_photons_and_tiles_change_no_byte() -> None:
    scene = rangesim.load_scene(SCENES / "tabletop.xml")
    rig = scene.rig(width=64, height=48)
    large, small = (
        trace_photons(TracedScene.of(scene.mitsuba, rig), 1.0, 100_001, 7, 5, memory) for memory in (2 << 30, 999_937)
    )
    for name in ("position", "direction", "flux", "u", "v", "length_m", "map"):
        np.testing.assert_array_equal(getattr(large, name), getattr(small, name))
    images = [
        transport(scene, rig, all_sensors(), spp=4, memory_bytes=memory)
        for memory in (2 << 30, 999_937)
    ]
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
