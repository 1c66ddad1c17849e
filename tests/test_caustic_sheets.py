# SPDX-License-Identifier: Apache-2.0
"""Triangles of light: places, lengths and projector coordinates against closed forms; sides, walls, folds and seeds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from delta_scenes import (
    GLASS,
    MIRROR,
    SlabPath,
    matte,
    rig_of,
    scene_of,
    sheets_of,
    thrown_w,
    transform,
    wall,
)

from rangesim import Intrinsics, Lens, Rig, Scene, transport
from rangesim.light_transport import caustic_sheets
from rangesim.light_transport.caustic_sheets import Sheets

CAMERA = Intrinsics.from_fov(64, 48, 40)
PROJECTOR = Intrinsics.from_fov(320, 240, 40)
NEAR, FAR, PLANE = 0.4, 0.45, 1.0
"""Depths of the slab's faces and of the plane behind it, metres."""


def slab() -> dict[str, Any]:
    """Glass that is turned, so that no ray of the grid runs along the seam of a face's two triangles."""
    place = transform().translate([0, 0, (NEAR + FAR) / 2]).rotate([0, 0, 1], 20).scale([5, 5, (FAR - NEAR) / 2])
    return {"type": "cube", "to_world": place, "bsdf": GLASS}


def light_of(scene: Scene, rig: Rig, seed: int = 0) -> Sheets:
    found = sheets_of(scene, rig, seed)
    assert found is not None
    return found


def number_of_grid(sheets: Sheets) -> int:
    """Number of triangles of the grid, which come before those of photons."""
    return int((np.cumsum(sheets.flux) <= sheets.in_triangles * sheets.flux.sum() * (1 + 1e-9)).sum())


# ---- Places, lengths, coordinates -------------------------------------------------------------------


def test_light_behind_a_slab_lands_where_snell_s_law_puts_it() -> None:
    """Place, optical length and direction of light that is reflected 0, 2, 4 times inside: corners of the grid's
    triangles, and middles of photons."""
    sheets = light_of(scene_of(slab=slab(), wall=wall(PLANE, matte())), rig_of(CAMERA, PROJECTOR))
    n = number_of_grid(sheets)
    of_grid, of_photons = np.unique(sheets.triangles[:n])[:, None], np.unique(sheets.triangles[n:]).reshape(-1, 4)
    ways, turns = [SlabPath(PLANE, FAR - NEAR, turns=k) for k in range(4)], set()
    for vertices in (of_grid, of_photons):
        u, v, length, x, y, cosine, dz = (
            column[vertices].mean(axis=1, dtype=float)
            for column in (
                sheets.u,
                sheets.v,
                sheets.length,
                *sheets.position[:, :2].T,
                sheets.cosine,
                sheets.slowness[:, 2],
            )
        )
        tangent = np.linalg.norm(PROJECTOR.normalise(np.column_stack([u, v])), axis=1)
        lengths = np.stack([way.length(tangent) for way in ways], axis=1)
        taken = np.abs(lengths - length[:, None]).argmin(axis=1)
        turns |= set(taken)
        of_way = np.arange(len(taken)), taken
        np.testing.assert_allclose(length, lengths[of_way], atol=1e-5)
        np.testing.assert_allclose(
            np.hypot(x, y), np.stack([way.across(tangent) for way in ways], 1)[of_way], atol=1e-5
        )
        np.testing.assert_allclose(dz, 1 / np.hypot(1, tangent), atol=1e-5)
        np.testing.assert_allclose(np.abs(cosine), dz, atol=1e-6)
    assert turns >= {0, 1}


def test_light_behind_a_thin_pane_has_the_coordinates_that_it_has_without() -> None:
    """To 0.02 projector pixels at every place of every triangle, not at its corners alone."""
    pane = wall(0.3, {**GLASS, "type": "thindielectric"})
    sheets = light_of(scene_of(pane=pane, wall=wall(PLANE, matte())), rig_of(CAMERA, PROJECTOR))
    weights = np.random.default_rng(0).dirichlet([1, 1, 1], len(sheets.flux))[..., None]
    corners = np.concatenate([sheets.position, sheets.u[:, None], sheets.v[:, None]], axis=1)[sheets.triangles]
    inside = (weights * corners).sum(axis=1)
    assert np.abs(PROJECTOR.project(inside[:, :3]) - inside[:, 3:]).max() < 0.02


# ---- Triangles and photons --------------------------------------------------------------------------


def ball_in_a_box() -> Scene:
    ball = {"type": "sphere", "center": [0.0, 0.0, 0.6], "radius": 0.1, "bsdf": GLASS}
    return scene_of(ball=ball, box={"type": "cube", "to_world": transform().scale(1.2), "bsdf": matte()})


def test_the_same_seed_gives_the_same_bytes_and_another_one_other_photons_alone() -> None:
    scene, rig = ball_in_a_box(), rig_of(CAMERA, PROJECTOR)
    one, same, other = (light_of(scene, rig, seed) for seed in (1, 1, 2))
    for a, b in zip(one, same, strict=True):
        np.testing.assert_array_equal(a, b)
    n = number_of_grid(one)
    assert 0.5 < one.in_triangles < 1
    for a, b in (
        (one.flux, other.flux),
        (one.key, other.key),
        (one.position[one.triangles], other.position[other.triangles]),
    ):
        np.testing.assert_array_equal(a[:n], b[:n])
        assert a[n:].tobytes() != b[n:].tobytes()


def test_light_is_the_same_however_much_of_it_triangles_carry(monkeypatch: pytest.MonkeyPatch) -> None:
    """A chain through a cell belongs to triangles or to photons: none is counted twice, and none is left out."""
    scene, rig = ball_in_a_box(), rig_of(CAMERA, PROJECTOR)
    fractions, thrown = [], []
    for block_px in (4.0, 64.0):
        monkeypatch.setattr(caustic_sheets, "BLOCK_PX", block_px)
        fractions.append(light_of(scene, rig).in_triangles)
        thrown.append(thrown_w(scene, rig, seeds=8))
    assert fractions[0] > 0.9
    assert fractions[1] < 0.85
    assert thrown[1] == pytest.approx(thrown[0], rel=0.02)


def test_photons_do_not_hang_over_the_edges_of_a_receiver() -> None:
    """Their light would be lost there. The grid's triangles lie on the receiver, because their corners do."""
    half = 0.03
    plate = {"type": "cube", "to_world": transform().translate([0.02, 0.01, 1.3]).scale(half), "bsdf": matte()}
    ball = {"type": "sphere", "center": [0.0, 0.0, 0.6], "radius": 0.1, "bsdf": GLASS}
    sheets = light_of(scene_of(plate=plate, ball=ball), rig_of(CAMERA, Intrinsics.from_fov(80, 60, 40)))
    n = number_of_grid(sheets)
    assert sheets.flux[n:].sum() > 0.05 * sheets.flux.sum()
    corners = sheets.position[sheets.triangles[n:]] - [0.02, 0.01, 1.3]
    hangs = (np.abs(corners) > 1.001 * half).any(axis=2).any(axis=1)
    assert sheets.flux[n:][hangs].sum() < 0.1 * sheets.flux[n:].sum()


def test_the_order_of_the_shapes_changes_no_light() -> None:
    """Light through a pane and light off it land on two walls, whose numbers in the scene differ in all ways."""
    rig, small = rig_of(CAMERA, Intrinsics.from_fov(80, 60, 40)), wall(5.0, matte(), 0.01)
    pane = wall(0.3, {**GLASS, "type": "thindielectric"}, 1.0)
    behind = {**wall(-1.0, matte()), "to_world": transform().translate([0, 0, -1]).scale([5, 5, 1])}
    for between in range(8):
        others = {f"{number}": small for number in range(between)}
        scene = scene_of(pane=pane, wall=wall(1.0, matte()), **others, behind=behind)
        assert thrown_w(scene, rig) == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize("at_m", [0.2, 0.8], ids=["before the pane", "behind it"])
def test_thin_things_between_points_of_the_grid_take_their_light(at_m: float) -> None:
    """A wire of two projector pixels takes two columns of the light, wherever it stands; points are four apart."""
    rig, pixel_m = rig_of(CAMERA, PROJECTOR), at_m / PROJECTOR.fx
    pane = wall(0.3, {**GLASS, "type": "thindielectric"}, 1.0)
    half, passed = 0.5 * 2 * pixel_m, []
    for shift in range(4):
        place = transform().translate([(10.3 + shift) * pixel_m, 0, at_m]).scale([half, 1, -1])
        scene = scene_of(pane=pane, wall=wall(PLANE, matte()), wire={**wall(0, matte()), "to_world": place})
        sheets = light_of(scene, rig)
        on_wall = sheets.flux[np.isclose(sheets.position[sheets.triangles[:, 0], 2], PLANE)]
        passed.append(on_wall.sum())
    whole = light_of(scene_of(pane=pane, wall=wall(PLANE, matte())), rig).flux.sum()
    taken = 1 - np.array(passed) / whole
    assert np.abs(taken / (2 / PROJECTOR.width) - 1).max() < 0.1


def test_no_light_comes_from_outside_the_image() -> None:
    """Photons are as large as their cells, also at the border of the image; patterns have no pixels beyond it."""
    ball = {"type": "sphere", "center": [0.0, 0.0, 0.5], "radius": 0.1, "bsdf": GLASS}
    rig = rig_of(CAMERA, Intrinsics.from_fov(320, 240, 30), projector_lens=Lens(4e-3, focus_m=0.8))
    sheets = light_of(scene_of(ball=ball, wall=wall(PLANE, matte())), rig)
    for place, size in ((sheets.u, 320), (sheets.v, 240)):
        assert place.min() >= 0
        assert place.max() <= size


# ---- Receivers --------------------------------------------------------------------------------------


def lit_through_a_pane(
    camera_at: tuple[float, float, float], looks_at: tuple[float, float, float], **parts: Any
) -> Any:
    """Caustics that a camera sees; the projector shines through a pane along z."""
    pane = wall(0.3, {**GLASS, "type": "thindielectric"}, 1.0)
    rig = rig_of(CAMERA, PROJECTOR, camera_at=camera_at, camera_looks_at=looks_at)
    energy = transport(scene_of(pane=pane, **parts), rig, [], spp=8, max_depth=2, glint=False, indirect="raw").energy
    np.testing.assert_array_equal(energy.caustic, energy.projector)
    return energy.caustic


def test_no_light_goes_through_a_wall() -> None:
    """The wall is lit on the side of the projector, and what stands right behind it is dark."""
    walls = {"near": wall(1.0, matte()), "far": wall(1.0002, matte())}
    assert lit_through_a_pane((0.3, 0.0, 0.6), (0.0, 0.0, 1.0), **walls).min() > 0
    assert not lit_through_a_pane((0.3, 0.0, 1.4), (0.0, 0.0, 1.0), **walls).any()
    assert not lit_through_a_pane((0.3, 0.0, 1.00015), (0.0, 0.0, 1.0002), **walls).any()


@pytest.mark.parametrize("thickness_m", [5e-2, 5e-4])
def test_a_plate_is_lit_on_one_side_alone(thickness_m: float) -> None:
    place = transform().translate([0, 0, 1 + thickness_m / 2]).scale([5, 5, thickness_m / 2])
    plate = {"type": "cube", "to_world": place, "bsdf": matte()}
    lit = lit_through_a_pane((0.3, 0.0, 0.6), (0.0, 0.0, 1.0), plate=plate)
    assert lit.min() > 0
    assert not lit_through_a_pane((0.3, 0.0, 1.4), (0.0, 0.0, 1.0), plate=plate).any()
    alone = lit_through_a_pane((0.3, 0.0, 0.6), (0.0, 0.0, 1.0), plate=wall(1.0, matte()))
    np.testing.assert_allclose(lit, alone, rtol=2e-3)


def test_layers_of_one_mesh_that_face_the_same_way_do_not_light_each_other(tmp_path: Path) -> None:
    """A camera between two layers that are 0.5 mm apart sees the shadow of the front one."""
    corners = [(-3, -3, 1.0005), (3, -3, 1.0005), (3, 3, 1.0005), (-3, 3, 1.0005),
               (-0.2, -0.2, 1), (0.2, -0.2, 1), (0.2, 0.2, 1), (-0.2, 0.2, 1)]  # fmt: skip
    lines = ["ply", "format ascii 1.0", "element vertex 8", *(f"property float {c}" for c in "xyz"), "element face 4",
             "property list uchar int vertex_indices", "end_header", *(f"{x} {y} {z}" for x, y, z in corners),
             "3 0 2 1", "3 0 3 2", "3 4 6 5", "3 4 7 6"]  # fmt: skip
    (tmp_path / "layers.ply").write_text("\n".join(lines) + "\n")
    layers = {"type": "ply", "filename": str(tmp_path / "layers.ply"), "face_normals": True, "bsdf": matte()}
    lit = lit_through_a_pane((0.3, 0.0, 0.6), (0.0, 0.0, 1.0), layers=layers).mean()
    assert lit_through_a_pane((0.05, 0.02, 1.0002), (0.05, 0.02, 1.0005), layers=layers).mean() < 0.1 * lit


def test_a_cable_behind_a_pane_gets_its_light() -> None:
    """It is two projector pixels wide and round, so its light is photons, which lie on tangent planes."""
    cable = {"type": "cylinder", "p0": [3e-3, -0.3, 1.0], "p1": [3e-3, 0.3, 1.0], "radius": 2e-3, "bsdf": matte()}
    pane = wall(0.3, {**GLASS, "type": "thindielectric"}, 1.0)
    rig = rig_of(Intrinsics.from_fov(16, 320, 0.5), PROJECTOR, (0, 0, 0), None, (0.1, 0, 0.3), (3e-3, 0, 1))
    options: dict[str, Any] = {"spp": 16, "max_depth": 2, "glint": False, "indirect": "raw"}
    free = transport(scene_of(cable=cable), rig, [], **options).energy.direct.sum()
    behind = [
        transport(scene_of(cable=cable, pane=pane), rig, [], seed=seed, **options).energy.caustic.sum()
        for seed in range(3)
    ]
    assert np.mean(behind) / free == pytest.approx(0.923, rel=0.07)  # 0.78 where sides are no tangents


def test_light_that_comes_by_several_ways_adds_up() -> None:
    """Two mirrors throw light onto the same part of a wall, and none onto each other."""
    mirrors = {
        name: {
            "type": "rectangle",
            "to_world": transform().translate([x, 0, 0.6]).rotate([0, 1, 0], turn).scale(0.2),
            "bsdf": MIRROR,
        }
        for name, x, turn in (("left", -0.15, 90), ("right", 0.15, -90))
    }
    rig = rig_of(Intrinsics.from_fov(32, 24, 8), Intrinsics.from_fov(320, 240, 60), camera_at=(0.0, 0.0, 0.2))

    def seen(**parts: Any) -> np.ndarray:
        scene = scene_of(**parts, wall=wall(1.2, matte()))
        return np.asarray(transport(scene, rig, [], spp=16, max_depth=2, glint=False, indirect="raw").energy.caustic)

    left, right, both = seen(left=mirrors["left"]), seen(right=mirrors["right"]), seen(**mirrors)
    assert left.min() > 0
    np.testing.assert_allclose(both, left + right, rtol=2e-3)


def test_a_lens_blurs_the_light_behind_a_pane_and_takes_none_of_it() -> None:
    """Its points have equal means of u, and the variance of u of a disc, a fourth of its squared radius."""
    scene = scene_of(pane=wall(0.3, {**GLASS, "type": "thindielectric"}, 2.0), wall=wall(PLANE, matte()))
    radius_m, focus_m = 4e-3, 0.6
    pinhole = rig_of(Intrinsics.from_fov(32, 24, 20), PROJECTOR)
    rig = rig_of(pinhole.camera, PROJECTOR, projector_lens=Lens(radius_m, focus_m))
    seen = [
        transport(scene, r, [], spp=8, max_depth=2, glint=False, indirect="raw").energy.caustic for r in (pinhole, rig)
    ]
    assert seen[1].mean() == pytest.approx(seen[0].mean(), rel=1e-3)
    assert (np.abs(seen[1] / seen[0] - 1) < 3e-3).mean() > 0.99

    sheets = light_of(scene, rig)
    u, x = sheets.u[sheets.triangles].mean(axis=1), sheets.position[sheets.triangles, 0].mean(axis=1, dtype=float)
    straight = PROJECTOR.cx + PROJECTOR.fx * x / PLANE
    middle = np.abs(x) < 0.1
    off_px = np.average(u[middle] - straight[middle], weights=sheets.flux[middle])
    variance = np.average((u - straight)[middle] ** 2, weights=sheets.flux[middle])
    blur_px = PROJECTOR.fx * radius_m * (1 / focus_m - 1 / PLANE)
    assert abs(off_px) < 0.02 * blur_px
    assert variance == pytest.approx(blur_px**2 / 4, rel=0.02)
