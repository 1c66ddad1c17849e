# SPDX-License-Identifier: Apache-2.0
"""What limits a light path: surfaces that scatter it by `max_depth`, delta interactions by a limit of their own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from delta_scenes import GLASS, fresnel_dielectric, matte, rig_of, scene_of, sheets_of, slab, thrown_w, transform, wall
from scipy.spatial import ConvexHull
from tiers import to_validate

from rangesim import Intrinsics, Rig, Scene, load_scene, transport
from rangesim.environment.backend import select_variant
from rangesim.errors import TruncationWarning
from rangesim.light_transport import caustic_sheets, loop, specular_tree

CAMERA = Intrinsics.from_fov(64, 48, 12)
PROJECTOR = Intrinsics.from_fov(160, 120, 26)
SCENES = Path(__file__).resolve().parent.parent / "scenes"
THIN = {**GLASS, "type": "thindielectric"}


def panes(n: int, kind: str) -> dict[str, dict[str, Any]]:
    """Panes one behind the other, so close that light reflected between them goes on as if it were not."""
    z = 0.3 + 0.003 * np.arange(n)
    return {f"pane_{i}": slab(a, a + 0.001) if kind == "thick" else wall(a, THIN) for i, a in enumerate(z)}


# ---- Delta interactions do not count ----------------------------------------------------------------


@pytest.mark.parametrize(("n", "kind"), [(2, "thin"), *to_validate((2, "thick"), (6, "thin"), (6, "thick"))])
def test_panes_weaken_light_and_do_not_use_up_the_depth(n: int, kind: str) -> None:
    """n panes pass (1 - R) / (1 + (2 n - 1) R) (Stokes 1862), once for the projector and once for the camera."""
    rig = rig_of(CAMERA, PROJECTOR, (0.05, 0.0, 0.0))
    options = {"spp": 64, "max_depth": 2, "glint": False}
    plain, covered = (
        transport(scene_of(wall=wall(1.0, matte()), **glass), rig, [], **options).energy.projector.mean(dtype=float)
        for glass in ({}, panes(n, kind))
    )
    r = fresnel_dielectric(0.0)
    passed = ((1 - r) / (1 + (2 * n - 1) * r)) ** 2  # two panes: 0.735
    assert covered / plain == pytest.approx(passed, rel=0.02)


def hollow_ball() -> Scene:
    """Seen from the origin, with four faces before the wall."""
    outside = {"type": "sphere", "center": [0.0, 0.0, 0.5], "radius": 0.2, "bsdf": GLASS}
    inside = {**outside, "radius": 0.18, "flip_normals": True}
    return scene_of(outside=outside, inside=inside, wall=wall(1.0, matte()))


@pytest.mark.validation
def test_what_is_seen_through_a_hollow_ball_is_that_of_a_deep_path_tracer() -> None:
    """The lamp between the ball and the wall lights the wall straight, so that plain Mitsuba finds it."""
    import mitsuba as mi
    from plain_mitsuba import plain_scene, render, z_score

    scene, rig = hollow_ball(), rig_of(CAMERA, Intrinsics.from_fov(64, 64, 90), (0.0, 0.0, 0.75))
    deep = mi.load_dict({"type": "path", "max_depth": 200, "rr_depth": 200})
    reference = render(plain_scene(scene, rig, {"type": "hdrfilm", "pixel_format": "luminance"}), deep, 1024, seed=1)
    energy = transport(scene, rig, [], spp=1024, caustics=False, glint=False).energy
    assert energy.projector.mean() == pytest.approx(reference.mean(), rel=3e-3)
    assert abs(z_score(energy.projector, reference)) < 5
    straight = transport(scene_of(wall=wall(1.0, matte())), rig, [], spp=16).energy.projector.mean()
    assert energy.projector.mean() / straight > 0.8


@pytest.mark.validation
def test_light_off_coats_and_through_holes_counts_the_scattering_surface_alone() -> None:
    """At max_depth 2 a coat shows the lit wall, and so do six holes one behind the other."""
    coat: dict[str, Any] = {"type": "plastic", "int_ior": 1.5, "ext_ior": 1.0}
    coat["diffuse_reflectance"] = {"type": "spectrum", "value": 0.0}
    place = transform().translate([0.0, 0.0, 0.5]).rotate([0, 1, 0], 180 - 45).scale(0.2)
    tilted = {"type": "rectangle", "to_world": place, "bsdf": coat}
    side = transform().translate([1.0, 0.0, 0.5]).rotate([0, 1, 0], -90).scale(2)
    beside = {"type": "rectangle", "to_world": side, "bsdf": matte()}
    lamp = {"at": (0.3, 0.0, 0.5), "looks_at": (1.0, 0.0, 0.5)}
    rig = rig_of(CAMERA, Intrinsics.from_fov(64, 64, 90), **lamp)
    seen, deep = (
        transport(scene_of(tilted=tilted, wall=beside), rig, [], spp=64, max_depth=n, caustics=False).energy.projector
        for n in (2, 7)
    )
    # Where the sight line leaves the coat at 45 degrees
    mirrored = fresnel_dielectric(np.sqrt(0.5)) * 0.5 / np.pi * rig.projector_irradiance / 0.7**2
    assert seen[20:28, 28:36].mean() == pytest.approx(mirrored, rel=0.02)
    assert deep.mean() == pytest.approx(seen.mean(), rel=0.01)

    hole = {"type": "mask", "opacity": 0.0, "b": matte()}
    holes = {f"hole_{i}": wall(0.2 + 0.1 * i, hole, 0.3) for i in range(6)}
    rig = rig_of(CAMERA, Intrinsics.from_fov(64, 64, 90), (0.0, 0.0, 0.75))
    plain, through = (
        transport(
            scene_of(wall=wall(1.0, matte()), **parts), rig, [], spp=16, max_depth=2, caustics=False
        ).energy.direct
        for parts in ({}, holes)
    )
    np.testing.assert_allclose(through, plain, rtol=1e-4)


# ---- The limit of a chain ---------------------------------------------------------------------------


def gem(folder: Path, bsdf: dict[str, Any]) -> dict[str, Any]:
    """A brilliant 0.3 m wide at 1 m, its table towards the origin: 8 + 16 + 1 corners, flat faces."""

    def ring(radius: float, z: float, n: int) -> np.ndarray:
        turn = 2 * np.pi * np.arange(n) / n
        return np.column_stack([radius * np.cos(turn), radius * np.sin(turn), np.full(n, z)])

    import mitsuba as mi

    select_variant()
    hull = ConvexHull(np.vstack([ring(0.55, -0.32, 8), ring(1, 0, 16), [[0, 0, 0.86]]]))
    faces = hull.simplices.copy()
    a, b, c = (hull.points[faces[:, i]] for i in range(3))
    inwards = (np.cross(b - a, c - a) * hull.equations[:, :3]).sum(axis=1) < 0
    faces[inwards] = faces[inwards, ::-1]
    mesh = mi.Mesh("gem", len(hull.points), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float((0.15 * hull.points + [0, 0, 1]).ravel().astype(np.float32))
    parameters["faces"] = mi.UInt32(faces.ravel().astype(np.uint32))
    parameters.update()
    mesh.write_ply(str(folder / "gem.ply"))
    return {"type": "ply", "filename": str(folder / "gem.ply"), "face_normals": True, "bsdf": bsdf}


def test_what_enters_a_diamond_comes_out(tmp_path: Path) -> None:
    """Total reflection keeps light in a faceted body of n = 2.4 for long; lossless, it gives all of it back."""
    diamond = {"type": "dielectric", "int_ior": 2.4, "ext_ior": 1.0}
    box = {"type": "cube", "to_world": transform().scale(2.5), "bsdf": matte()}
    scene, rig = scene_of(gem=gem(tmp_path, diamond), box=box), rig_of(CAMERA, PROJECTOR, projector_power_w=2.0)
    seen = np.array([[0.15 * np.cos(turn), 0.15 * np.sin(turn), 1.0] for turn in 2 * np.pi * np.arange(16) / 16])
    u, v = (PROJECTOR.project(seen) - PROJECTOR.project(seen).mean(axis=0)).T
    meets = 0.5 * abs(u @ np.roll(v, -1) - v @ np.roll(u, -1)) / (160 * 120)  # its girdle is its outline
    found = [sheets_of(scene, rig, seed) for seed in range(4)]
    thrown, cut = np.mean([(one.flux.sum(), one.cut * one.flux.sum()) for one in found if one], axis=0)
    assert thrown + cut == pytest.approx(2.0 * meets, rel=0.02)
    assert cut < 3e-3 * thrown  # after 16 surfaces 5.8 %, after 64 0.9 %


@pytest.mark.parametrize("fewest", [3e-2, 0.3])
def test_light_between_mirrors_is_the_same_however_early_parts_are_left_to_chance(
    fewest: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two facing mirrors, and the light leaves the gap after a dozen reflections with R^k of it."""
    metal = {"type": "conductor", "material": "none", "specular_reflectance": {"type": "spectrum", "value": 0.8}}
    left, right = (
        {
            "type": "rectangle",
            "to_world": transform().translate([x, 0, 1]).rotate([0, 1, 0], turn).scale(1),
            "bsdf": metal,
        }
        for x, turn in ((-0.06, 90), (0.06, -90))
    )
    scene = scene_of(left=left, right=right, wall=wall(2.5, matte()))
    projector = Intrinsics.from_fov(64, 16, 70)
    monkeypatch.setattr(caustic_sheets, "FEWEST", fewest)
    monkeypatch.setattr(caustic_sheets, "FEWEST_OF_PHOTONS", 10 * fewest)
    # Unfolded, a ray of the tangent t crosses the gap |2 t z / w| times, from the middle on
    columns = (np.arange(64 * 64) + 0.5) / 64
    t = np.abs(columns - projector.cx) / projector.fx
    reflections = np.floor((t * 2.0 - 0.06) / 0.12) + 1
    kept = np.where(t * 2.0 > 0.06, 0.8**reflections, 0.0).mean()
    assert thrown_w(scene, rig_of(CAMERA, projector, projector_power_w=2.0), seeds=4) == pytest.approx(
        2 * kept, rel=0.02
    )


# ---- What is left out -------------------------------------------------------------------------------


def closed_room(lamp_fov: float = 45.0, lamp_at: tuple[float, float, float] = (0.1, 0.0, 0.0)) -> tuple[Scene, Rig]:
    """3 x 2.4 x 4 m, all of albedo 0.8."""
    box = {"type": "cube", "to_world": transform().translate([0, 0, 1.0]).scale([1.5, 1.2, 2.0]), "bsdf": matte(0.8)}
    lamp = Intrinsics.from_fov(160, 120, lamp_fov)
    return scene_of(box=box), rig_of(Intrinsics.from_fov(64, 48, 40), lamp, lamp_at)


def test_what_a_closed_room_loses_is_estimated_and_warned_about() -> None:
    """A deep pass is the reference. The camera sees what the lamp lights, all of it or next to nothing of it."""
    for lamp in ((45.0, (0.1, 0.0, 0.0)), (90.0, (0.8, 0.2, -0.3))):
        scene, rig = closed_room(*lamp)
        deep = transport(scene, rig, [], spp=32, max_depth=100, rr_depth=20)
        assert deep.truncation is not None
        assert deep.truncation.total < 1e-6
        for max_depth in (4, 5, 8):
            with pytest.warns(TruncationWarning, match=f"a max_depth of {max_depth} ends") as warned:
                signals = transport(scene, rig, [], spp=32, max_depth=max_depth)
            lost = 1 - signals.energy.projector.sum(dtype=float) / deep.energy.projector.sum(dtype=float)
            assert signals.truncation is not None
            assert signals.truncation.depth == pytest.approx(lost, rel=1 / 3)  # at 5: 13 % and 34 %
            assert [w.filename for w in warned] == [__file__]
            assert signals.truncation.chains == signals.truncation.caustics == 0


@pytest.mark.parametrize("name", ["plane", "matte", "corner", *to_validate("tabletop", "glassware")])
def test_little_is_left_out_at_the_default_depth_and_no_warning_given(name: str) -> None:
    scene = load_scene(SCENES / f"{name}.xml")
    rig = scene.rig(width=64, height=48)
    whole, tiles = (transport(scene, rig, [], spp=4, memory_bytes=n).truncation for n in (2 << 30, 1 << 19))
    assert whole is not None
    assert 0 <= whole.total < 0.01
    assert whole == tiles


def test_direct_light_alone_is_asked_for() -> None:
    truncation = transport(*closed_room(), [], spp=1, max_depth=2).truncation
    assert truncation is not None
    assert np.isnan(truncation.depth)
    assert truncation.total == 0


def test_what_cut_chains_lose_is_estimated(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hollow ball covers part of an evenly lit wall; after three faces nothing is seen through it any more."""
    wide = Intrinsics.from_fov(64, 48, 60)
    scene, rig = hollow_ball(), rig_of(wide, Intrinsics.from_fov(64, 64, 120), (0.0, 0.0, 0.75))
    options = {"spp": 32, "max_depth": 4, "caustics": False}
    all_of_it = transport(scene, rig, [], **options).energy.projector.sum(dtype=float)
    monkeypatch.setattr(loop, "MAX_CHAIN", 3)
    with pytest.warns(TruncationWarning, match="more than 128 surfaces of glass"):
        signals = transport(scene, rig, [], **options)
    assert signals.truncation is not None
    lost = 1 - signals.energy.projector.sum(dtype=float) / all_of_it
    assert signals.truncation.chains == pytest.approx(lost, rel=1 / 3)


@pytest.mark.validation
def test_what_cut_caustics_lose_is_estimated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    box = {"type": "cube", "to_world": transform().scale(2.5), "bsdf": matte()}
    scene = scene_of(gem=gem(tmp_path, {"type": "dielectric", "int_ior": 2.4, "ext_ior": 1.0}), box=box)
    rig = rig_of(Intrinsics.from_fov(64, 64, 130), PROJECTOR, camera_at=(0.0, 0.0, -2.4))
    options = {"spp": 32, "glint": False, "max_depth": 9}
    whole = transport(scene, rig, [], **options)
    monkeypatch.setattr(specular_tree, "MAX_CHAIN", 8)
    with pytest.warns(TruncationWarning, match="more than 128 surfaces of glass"):
        signals = transport(scene, rig, [], **options)
    lost = 1 - signals.energy.projector.sum(dtype=float) / whole.energy.projector.sum(dtype=float)
    assert signals.truncation is not None
    assert signals.truncation.caustics == pytest.approx(lost, rel=1 / 3)
