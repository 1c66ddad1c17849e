# SPDX-License-Identifier: Apache-2.0
"""Sparse against dense: what range views saw of known volumes, and CT against closed forms and scikit-image."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from fusion_scenes import ball, block, mesh_depth, range_image, sphere_depth

from rangesim.errors import EnvironmentProblem
from rangesim.fusion import (
    VoxelGrid,
    VoxelState,
    filtered_back_projection,
    occupancy,
    path_lengths,
    simulate_ct,
    true_occupancy,
    voxel_states,
)
from rangesim.fusion.seen_volume import is_closed, seen_surface
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
    assert is_closed(HOLLOW)
    assert is_closed(block((1, 2, 3)))
    assert not is_closed(TriangleMesh(ball().vertices, ball().faces[1:]))


# ---- CT ----------------------------------------------------------------------------------------------------------


def test_lines_through_a_sphere_are_as_long_as_its_chords() -> None:
    r, centre = 0.04, (0.006, -0.004, 0.002)
    grid = VoxelGrid((61, 61, 9), 2e-3, (-0.061, -0.061, -0.009))
    angles = np.linspace(0, np.pi, 7, endpoint=False)
    found = path_lengths(ball(r, centre), grid, angles)
    n = found.shape[1]
    s = 2e-3 * (np.arange(n) - n // 2)[None, :, None]
    z = (-0.008 + 2e-3 * np.arange(9))[:, None, None]
    off = s - (centre[0] * np.cos(angles) - centre[1] * np.sin(angles))
    inside = r**2 - off**2 - (z - centre[2]) ** 2
    chord = 2 * np.sqrt(np.maximum(inside, 0))
    smooth = inside > (0.5 * r) ** 2  # two lines across a pixel are not its mean where the chord ends
    assert np.abs(found - chord)[smooth].max() < 1e-4
    assert found[inside < -4e-4].max() == 0


def test_lines_along_faces_and_edges_are_right() -> None:
    grid = VoxelGrid((20, 20, 1), 1e-3, (-0.01, -0.01, -0.0005))
    lengths = path_lengths(block((0.011, 0.005, 0.02)), grid, [0.0, np.pi / 2])[0]
    assert lengths[:, 0].max() == pytest.approx(0.005, abs=1e-7)
    assert lengths[:, 1].max() == pytest.approx(0.011, abs=1e-7)
    assert lengths.sum(axis=0) * 1e-3 == pytest.approx(0.011 * 0.005, rel=0.05)  # the area, from all sides


def ellipses(grid: VoxelGrid) -> tuple[np.ndarray, list[tuple[float, float, float, float, float, float]]]:
    """A phantom of three ellipses (mu, a, b, x, y, turn), voxels averaged over 8 x 8 points."""
    shapes = [
        (40.0, 0.05, 0.035, 0.004, -0.002, 0.3),
        (-20.0, 0.012, 0.02, 0.02, 0.004, -0.4),
        (30.0, 0.01, 0.01, -0.02, -0.01, 0.0),
    ]
    fine = VoxelGrid((8 * grid.shape[0], 8 * grid.shape[1], 1), grid.voxel_m / 8, grid.corner_m)
    x, y = np.moveaxis(fine.centres()[:, :, 0, :2], -1, 0)
    image = np.zeros(x.shape)
    for mu, a, b, cx, cy, turn in shapes:
        u = (x - cx) * np.cos(turn) + (y - cy) * np.sin(turn)
        v = (y - cy) * np.cos(turn) - (x - cx) * np.sin(turn)
        image += mu * ((u / a) ** 2 + (v / b) ** 2 <= 1)
    return image.reshape(grid.shape[0], 8, grid.shape[1], 8).mean(axis=(1, 3)), shapes


def projected(shapes, angles: np.ndarray, n: int, h: float) -> np.ndarray:  # type: ignore[no-untyped-def]
    """(1, n, angles) line integrals of ellipses in closed form (Kak, Slaney, eq. 3.5), averaged over 8 lines a
    pixel."""
    s = h * (np.arange(8 * n) / 8 + 1 / 16 - 0.5 - n // 2)[:, None]
    total = np.zeros((8 * n, len(angles)))
    for mu, a, b, cx, cy, turn in shapes:
        # Our line is x cos - y sin = s: the angle of its normal is minus theta
        phi = -angles - turn
        width2 = (a * np.cos(phi)) ** 2 + (b * np.sin(phi)) ** 2
        off = s - (cx * np.cos(angles) - cy * np.sin(angles))
        total += 2 * mu * a * b * np.sqrt(np.maximum(width2 - off**2, 0)) / width2
    return total.reshape(n, 8, -1).mean(axis=1)[None]


def test_back_projection_of_closed_forms_is_the_phantom_within_one_per_cent_of_scikit_image() -> None:
    from skimage.transform import iradon, radon

    grid = VoxelGrid((129, 129, 1), 1e-3, (-0.0645, -0.0645, 0.0))  # the axis is the centre of voxel 64
    image, shapes = ellipses(grid)
    angles = np.pi * np.arange(200) / 200
    ours = filtered_back_projection(projected(shapes, angles, 187, 1e-3), angles, grid)[:, :, 0]
    # scikit-image turns images [row, column] = [y, x]
    theirs = iradon(radon(image.T, np.degrees(angles), circle=True), np.degrees(angles), circle=True).T
    circle = np.linalg.norm(grid.centres()[:, :, 0, :2], axis=-1) < 0.06
    assert np.sqrt(((ours - theirs)[circle] ** 2).mean()) < 0.01 * image.max()
    inner = circle & (np.abs(image - np.round(image / 10) * 10) < 1e-9)
    assert np.median(np.abs(ours - image)[inner]) < 0.01 * image.max()


def test_a_ct_measures_hollow_insides_and_their_attenuation() -> None:
    grid = VoxelGrid.around(HOLLOW.vertices, 1.5e-3, 6e-3)
    found = simulate_ct({"ball": HOLLOW, "pea": ball(0.01)}, grid, {"pea": 120.0})
    r = np.linalg.norm(grid.centres(), axis=-1)
    layers = np.abs(grid.centres()[..., 2]) < 0.02
    for where, mu in (((r > 0.032) & (r < 0.038), 50.0), ((r > 0.013) & (r < 0.027), 0.0), (r < 0.007, 120.0)):
        assert np.mean(found.attenuation_per_m[where & layers]) == pytest.approx(mu, abs=1.2)


def test_photon_noise_has_its_variance() -> None:
    """var p = exp(p) / N."""
    grid = VoxelGrid((15, 15, 40), 2e-3, (-0.015, -0.015, -0.04))
    box = {"box": block((0.02, 0.02, 0.2))}
    clean = simulate_ct(box, grid, 30.0, angles=1).sinograms
    noisy = simulate_ct(box, grid, 30.0, angles=1, photons=1e4).sinograms
    thick = clean > 0.59
    assert np.std((noisy - clean)[thick]) == pytest.approx(np.sqrt(np.exp(0.6) / 1e4), rel=0.15)


def test_refuses_what_cannot_be_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    grid = VoxelGrid((4, 4, 4), 0.01)
    (image,) = seen_from(ball(), (0.3, 0, 0))
    for call, message in (
        (lambda: occupancy([], {"b": ball()}, grid), "views and shapes"),
        (lambda: occupancy([image], {}, grid), "views and shapes"),
        (lambda: occupancy([image], {"b": ball()}, grid, tolerance_m=0.0), "positive tolerance_m"),
        (lambda: simulate_ct({"b": TriangleMesh(ball().vertices, ball().faces[1:])}, grid), "closed shape"),
        (lambda: simulate_ct({"b": ball()}, grid, {"c": 3.0}), "unknown key 'c'"),
        (lambda: simulate_ct({"b": ball()}, grid, -1.0), "0 or more per metre"),
        (lambda: simulate_ct({"b": ball()}, grid, angles=0), "one angle"),
        (lambda: simulate_ct({"b": ball()}, grid, photons=0.0), "photons"),
        (lambda: VoxelGrid((0, 1, 1), 0.1), "shape"),
        (lambda: VoxelGrid((10**6, 10**6, 10**6), 0.1), "voxels"),
        (lambda: VoxelGrid.around(np.full((3, 3), np.nan), 0.1), "finite points"),
    ):
        with pytest.raises(ValueError, match=message):
            call()  # type: ignore[no-untyped-call]
    monkeypatch.setitem(sys.modules, "skimage.transform", None)
    with pytest.raises(EnvironmentProblem, match=r"rangesim\[ct\]"):
        simulate_ct({"b": ball(0.01)}, grid)
