# SPDX-License-Identifier: Apache-2.0
"""Sparse range data: what views saw of known surfaces and volumes."""

from __future__ import annotations

import numpy as np
import pytest
from fusion_scenes import ball, block, mesh_depth, range_image, sphere_depth

from rangesim.fusion import VoxelGrid, VoxelState, occupancy, true_occupancy, voxel_states
from rangesim.fusion.seen_volume import seen_surface
from rangesim.rig import Intrinsics, look_at
from rangesim.triangle_mesh import TriangleMesh

CAMERA = Intrinsics.from_fov(200, 200, 30)


def flipped(mesh: TriangleMesh) -> TriangleMesh:
    return TriangleMesh(mesh.vertices, mesh.faces[:, ::-1])


HOLLOW = TriangleMesh.joined([ball(0.04), flipped(ball(0.03))])


def seen_from(mesh: TriangleMesh, *eyes: tuple[float, float, float]):  # type: ignore[no-untyped-def]
    poses = [look_at(eye, (0, 0, 0)) for eye in eyes]
    return [range_image(mesh_depth(mesh, CAMERA, T), T, CAMERA) for T in poses]


# ---- Range views -------------------------------------------------------------------------------------------------


def test_one_view_of_a_sphere_sees_a_cap() -> None:
    """Of a sphere of radius r from a distance d: the fraction (1 - r / d) / 2 of its area (Archimedes)."""
    T = look_at((0.4, 0, 0.0), (0, 0, 0))
    image = range_image(sphere_depth(CAMERA, T, (0, 0, 0), 0.05), T, CAMERA)
    found = seen_surface([image], ball(0.05), 2e-3)
    assert found == pytest.approx((1 - 0.05 / 0.4) / 2, abs=0.04)  # pixels at the rim are coarse


def test_voxels_in_front_are_free_and_voxels_behind_never_seen() -> None:
    (image,) = seen_from(block((0.02, 0.2, 0.2)), (0.3, 0, 0))  # a wall from -0.01 to 0.01, seen from x
    states = voxel_states([image], VoxelGrid((21, 1, 1), 0.004, (-0.042, -0.002, -0.002)))[:, 0, 0]
    x = -0.04 + 0.004 * np.arange(21)
    assert (states[x > 0.0145] == VoxelState.FREE).all()
    assert (states[np.abs(x - 0.01) < 0.003] == VoxelState.SURFACE).all()
    assert (states[x < 0.0055] == VoxelState.NEVER_SEEN).all()


def test_the_inside_of_a_hollow_ball_is_never_seen() -> None:
    eyes = [(0.3, 0, 0), (-0.3, 0, 0), (0, 0.3, 0.01), (0, -0.3, 0.01), (0.01, 0, 0.3), (0.01, 0, -0.3)]
    grid = VoxelGrid.around(HOLLOW.vertices, 2e-3, 4e-3)
    found = occupancy(seen_from(HOLLOW, *eyes), {"ball": HOLLOW}, grid)
    shape = found.shapes["ball"]
    assert shape.surface == pytest.approx(16 / 25, abs=0.01)  # the outer face: 4 pi 0.04^2 of 4 pi (0.04^2 + 0.03^2)
    assert shape.volume_m3 == pytest.approx(4 / 3 * np.pi * (0.04**3 - 0.03**3), rel=0.01)
    cavity = np.linalg.norm(grid.centres(), axis=-1) < 0.027
    assert (found.states[cavity] == VoxelState.NEVER_SEEN).all()
    assert (found.truth[cavity] == -1).all()
    assert shape.volume_free < 0.02
    assert shape.volume_surface + shape.volume_never + shape.volume_free == pytest.approx(1)
    assert sum(found.fraction(state) for state in VoxelState) == pytest.approx(1)


def test_what_a_sensor_looks_through_it_takes_for_free() -> None:
    """A ball of perfect glass before a wall: the views measure the wall."""
    images = seen_from(block((0.01, 0.5, 0.5), (-0.2, 0, 0)), (0.3, 0, 0))
    glass = ball(0.04)
    found = occupancy(images, {"glass": glass}, VoxelGrid.around(glass.vertices, 4e-3)).shapes["glass"]
    assert found.surface == 0
    assert found.volume_free == 1


def test_true_volumes_are_those_of_the_shapes() -> None:
    shapes = {"ball": HOLLOW, "box": block((0.03, 0.02, 0.01), (0.06, 0, 0))}
    grid = VoxelGrid.around(TriangleMesh.joined(list(shapes.values())).vertices, 1e-3, 2e-3)
    truth = true_occupancy(shapes, grid)
    assert (truth == 0).sum() * 1e-9 == pytest.approx(HOLLOW.volume_m3, rel=0.01)
    assert (truth == 1).sum() * 1e-9 == pytest.approx(6e-6, rel=0.01)


def test_closed_meshes_are_told_from_open_ones() -> None:
    assert HOLLOW.is_closed
    assert block((1, 2, 3)).is_closed
    assert not TriangleMesh(ball().vertices, ball().faces[1:]).is_closed


def test_views_decide_by_majority() -> None:
    """A ghost of one view in front of a wall is outvoted by two that look through it."""
    grid, size = VoxelGrid((1, 1, 1), 0.02, (-0.01, -0.01, 0.3)), (200, 200)
    ghost, wall = (range_image(np.full(size, z), None, CAMERA) for z in (0.31, 0.5))
    assert voxel_states([ghost], grid)[0, 0, 0] == VoxelState.SURFACE
    assert voxel_states([ghost, wall], grid)[0, 0, 0] == VoxelState.SURFACE
    assert voxel_states([ghost, wall, wall], grid)[0, 0, 0] == VoxelState.FREE
    nothing = range_image(np.full(size, np.nan), None, CAMERA)
    assert voxel_states([nothing], grid)[0, 0, 0] == VoxelState.NEVER_SEEN


def test_grids_of_any_size_are_looked_at_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    images = seen_from(block((0.02, 0.2, 0.2)), (0.3, 0, 0))
    grid = VoxelGrid((21, 5, 4), 0.004, (-0.042, -0.002, -0.002))
    shapes = {"wall": block((0.02, 0.2, 0.2))}
    whole = voxel_states(images, grid), true_occupancy(shapes, grid)
    monkeypatch.setattr("rangesim.fusion.seen_volume.VOXELS_AT_ONCE", 41)
    monkeypatch.setattr("rangesim.fusion.solids.POINTS_AT_ONCE", 41)
    assert np.array_equal(voxel_states(images, grid), whole[0])
    assert np.array_equal(true_occupancy(shapes, grid), whole[1])


def test_refuses_what_cannot_be_compared() -> None:
    grid = VoxelGrid((4, 4, 4), 0.01)
    (image,) = seen_from(ball(), (0.3, 0, 0))
    for call, message in (
        (lambda: occupancy([], {"b": ball()}, grid), "views and shapes"),
        (lambda: occupancy([image], {}, grid), "views and shapes"),
        (lambda: occupancy([image], {"b": ball()}, grid, tolerance_m=0.0), "positive tolerance_m"),
        (lambda: VoxelGrid((0, 1, 1), 0.1), "shape"),
        (lambda: VoxelGrid((10**6, 10**6, 10**6), 0.1), "voxels"),
        (lambda: VoxelGrid.around(np.full((3, 3), np.nan), 0.1), "finite points"),
    ):
        with pytest.raises(ValueError, match=message):
            call()  # type: ignore[no-untyped-call]
