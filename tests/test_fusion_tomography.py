# SPDX-License-Identifier: Apache-2.0
"""Computed tomography against chords in closed form, Poisson's statistics and scikit-image; solids and their voxels."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import trimesh
from fusion_scenes import ball, block
from scipy.ndimage import binary_erosion
from skimage.transform import iradon, radon

from rangesim.errors import EnvironmentProblem
from rangesim.fusion import (
    Sinogram,
    Solid,
    VoxelGrid,
    attenuation_volume,
    filtered_back_projection,
    inside_voxels,
    sampling_angles,
    with_photon_noise,
    xray_projections,
)
from rangesim.triangle_mesh import TriangleMesh

BLOCK = Solid("block", block((0.06, 0.04, 0.03), (0.004, -0.006, 0.002)), 20.0)
HOLE = Solid("hole", block((0.03, 0.02, 0.02), (0.01, -0.006, 0.002)), 0.0)
CORE = Solid("core", block((0.01, 0.01, 0.01), (0.012, -0.006, 0.002)), 90.0)
GRID = VoxelGrid.around(BLOCK.mesh.vertices, 0.001, 0.002)


def axis(grid):
    """World x, y of the axis of rotation."""
    return np.asarray(grid.corner_m)[:2] + (np.array([grid.shape[0] // 2, grid.shape[1] // 2]) + 0.5) * grid.voxel_m


def test_voxels_are_those_whose_centres_lie_within():
    low, high = BLOCK.mesh.vertices.min(axis=0), BLOCK.mesh.vertices.max(axis=0)
    centres = GRID.centres()
    inside = ((centres > low) & (centres < high)).all(axis=-1)
    assert np.array_equal(inside_voxels(BLOCK.mesh, GRID), inside)
    assert not inside_voxels(BLOCK.mesh, VoxelGrid((3, 3, 3), 0.01, (1.0, 1.0, 1.0))).any()
    within = VoxelGrid((4, 4, 4), 0.001, tuple(BLOCK.mesh.vertices.mean(axis=0)))
    assert inside_voxels(BLOCK.mesh, within).all()


def test_the_volume_of_a_ball_in_voxels_is_its_volume():
    radius = 0.03
    grid = VoxelGrid.around(ball(radius).vertices, 0.001)
    volume = np.count_nonzero(inside_voxels(ball(radius), grid)) * grid.voxel_m**3
    assert volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.005)


def test_the_innermost_solid_counts_in_whatever_order():
    volume = attenuation_volume([CORE, BLOCK, HOLE], GRID)
    assert np.array_equal(volume, attenuation_volume([BLOCK, HOLE, CORE], GRID))
    parts = [np.count_nonzero(inside_voxels(s.mesh, GRID)) for s in (BLOCK, HOLE, CORE)]
    assert [np.count_nonzero(volume == v) for v in (20.0, 90.0)] == [parts[0] - parts[1], parts[2]]


def test_projections_of_a_ball_are_its_chords():
    """p = 2 mu sqrt(r^2 - d^2) at the distance d from its middle."""
    radius, centre, mu = 0.02, np.array([0.005, -0.003, 0.001]), 20.0
    made = trimesh.creation.icosphere(subdivisions=6, radius=radius)
    solid = Solid("ball", TriangleMesh(made.vertices + centre, made.faces), mu)
    grid = VoxelGrid((50, 50, 40), 0.001, (-0.025, -0.025, -0.02))
    found = xray_projections([solid], grid, np.radians([0, 30, 90, 137, 180, 271]))
    n = found.values.shape[1]
    across = np.stack([-np.sin(found.angles), np.cos(found.angles)])
    offset = (np.arange(n) - n // 2) * grid.voxel_m - ((centre[:2] - axis(grid)) @ across)[:, None]
    z = -0.02 + (np.arange(40) + 0.5) * 0.001 - centre[2]
    chord = 2 * np.sqrt(np.maximum(radius**2 - offset[..., None] ** 2 - z**2, 0))
    inner = chord > radius / 2
    assert np.abs(found.values[inner] / (mu * chord[inner]) - 1).max() < 2e-3  # triangles lie within the ball
    assert found.values[chord == 0].max() < 1e-9


def test_the_line_integrals_of_an_angle_add_up_to_the_matter():
    """Sum over the detector times the area of a pixel = integral of mu over the volume, whatever the angle."""
    solids = [BLOCK, HOLE, CORE]
    expected = 20 * (BLOCK.mesh.volume_m3 - HOLE.mesh.volume_m3) + 90 * CORE.mesh.volume_m3
    found = xray_projections(solids, GRID, np.radians([0, 17, 45, 90, 133]))
    totals = found.values.sum(axis=(1, 2)) * GRID.voxel_m**2
    assert totals == pytest.approx(expected, rel=0.03)  # of sharp edges, sampled once per pixel


def test_rays_that_run_along_edges_and_faces_are_measured_all_the_same():
    """At 0 and 90 degrees rays graze faces, and meet the diagonals of the block's sides."""
    cube = Solid("cube", block((0.02, 0.02, 0.02)), 10.0)
    grid = VoxelGrid((21, 21, 21), 0.001, (-0.0105, -0.0105, -0.0105))  # centres at whole millimetres, axis at 0
    found = xray_projections([cube], grid, np.radians([0.0, 90.0, 180.0]))
    middle = found.values[:, abs(np.arange(found.values.shape[1]) - found.values.shape[1] // 2) < 10, 1:-1]
    assert middle == pytest.approx(10 * 0.02, rel=1e-5)


def test_what_was_put_in_comes_out():
    solids = [BLOCK, HOLE, CORE]
    found, truth = filtered_back_projection(xray_projections(solids, GRID)), attenuation_volume(solids, GRID)
    for mu in (0.0, 20.0, 90.0):
        inner = binary_erosion(truth == mu, iterations=2)
        assert found[inner].mean() == pytest.approx(mu, abs=0.01 * 90)
    wrong = np.abs(found - truth) > 10
    assert not wrong[binary_erosion(truth == 20, iterations=2)].any()
    assert wrong.mean() < 0.05  # at edges


def test_a_phantom_comes_out_as_by_scikit_image():
    """The same slice, projected by `radon` and by chords: the axis, the sense of angles and the unit agree."""
    grid = VoxelGrid((64, 50, 3), 0.001, (0.1, -0.3, 2.0))
    at = np.asarray(grid.corner_m) + np.array([0.032, 0.025, 0.0015])
    solids = [
        Solid("outer", block((0.044, 0.03, 0.1), tuple(at + np.array([0.002, 0.001, 0.0]))), 30.0),
        Solid("inner", block((0.012, 0.01, 0.1), tuple(at + np.array([-0.006, 0.004, 0.0]))), 10.0),
    ]
    ours = xray_projections(solids, grid)
    n, (nx, ny, _) = ours.values.shape[1], grid.shape
    fine = VoxelGrid((nx * 4, ny * 4, 1), grid.voxel_m / 4, grid.corner_m)
    slice_ = attenuation_volume(solids, fine)[:, :, 0].reshape(nx, 4, ny, 4).mean(axis=(1, 3))
    padded = np.zeros((n, n))
    left, top = n // 2 - nx // 2, n // 2 - ny // 2
    padded[left : left + nx, top : top + ny] = slice_
    theirs = radon(padded, np.degrees(ours.angles), circle=True).T * grid.voxel_m
    assert np.sqrt(((ours.values[:, :, 1] - theirs) ** 2).mean()) < 0.02 * theirs.max()
    again = iradon(theirs.T, np.degrees(ours.angles), output_size=n, circle=True)[left : left + nx, top : top + ny]
    found = filtered_back_projection(Sinogram(theirs[:, :, None].repeat(3, axis=2), ours.angles, grid))[:, :, 1]
    assert found == pytest.approx(again / grid.voxel_m, abs=1e-9)
    rebuilt = filtered_back_projection(ours)[:, :, 1]
    inner = binary_erosion(slice_ == 30, iterations=3)
    assert rebuilt[inner].mean() == pytest.approx(found[inner].mean(), rel=0.01)
    assert rebuilt[inner].mean() == pytest.approx(30, rel=0.01)


def test_photons_are_counted_as_poisson_has_it():
    """Var p = exp(p) / I0, and the mean stays."""
    grid, p, photons = VoxelGrid((2, 2, 2), 1.0), 2.0, 10_000.0
    noisy = with_photon_noise(Sinogram(np.full((200, 50, 2), p), np.arange(200.0), grid), photons, seed=3)
    assert noisy.values.mean() == pytest.approx(p, abs=1e-3)
    assert noisy.values.var() == pytest.approx(np.exp(p) / photons, rel=0.03)
    again = with_photon_noise(Sinogram(np.full((200, 50, 2), p), np.arange(200.0), grid), photons, seed=3)
    assert np.array_equal(noisy.values, again.values)
    dark = with_photon_noise(Sinogram(np.full((2, 3, 2), 1e3), np.arange(2.0), grid), 100.0)
    assert dark.values == pytest.approx(np.log(200.0))


def test_angles_resolve_as_finely_as_the_detector():
    grid = VoxelGrid((63, 63, 1), 0.001)
    angles = sampling_angles(grid)
    n = xray_projections([Solid("a", block((0.01, 0.01, 0.01)), 1.0)], grid, [0.0, 1.0]).values.shape[1]
    assert np.diff(angles)[0] * n / 2 <= 1.0  # pixels, along the rim
    assert angles[-1] < np.pi


OPEN = TriangleMesh(BLOCK.mesh.vertices, BLOCK.mesh.faces[1:])
BOX = block((0.02, 0.02, 0.02))
ENDS = np.abs(BOX.face_normals[:, 2]) > 0.5
TUBE = TriangleMesh(BOX.vertices, BOX.faces[~ENDS])
BLOCK_AT = (0.004, -0.006, 0.002)
CROSSING = Solid("other", block((0.06, 0.04, 0.03), (0.03, 0, 0)), 1.0)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Solid("", BLOCK.mesh, 1.0), "a name"),
        (lambda: Solid("a", BLOCK.mesh, -1.0), "attenuation"),
        (lambda: Solid("a", BLOCK.mesh, float("nan")), "attenuation"),
        (lambda: Solid("a", OPEN, 1.0), "closed"),
        (lambda: Solid("tube", TUBE, 1.0), "closed"),
        (lambda: Solid("a", TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int)), 1.0), "closed"),
        (lambda: Solid("a", TriangleMesh(BLOCK.mesh.vertices, BLOCK.mesh.faces[:, ::-1]), 1.0), "inside out"),
        (lambda: xray_projections([], GRID), "at least one"),
        (lambda: xray_projections([BLOCK, BLOCK], GRID), "of its own"),
        (lambda: xray_projections([BLOCK, CROSSING], GRID), "crosses"),
        (lambda: xray_projections([BLOCK, Solid("twin", BLOCK.mesh, 1.0)], GRID), "fills"),
        (lambda: xray_projections([BLOCK, Solid("bar", block((0.2, 0.01, 0.01), BLOCK_AT), 1.0)], GRID), "crosses"),
        (lambda: xray_projections([BLOCK], GRID, []), "angles"),
        (lambda: xray_projections([BLOCK], GRID, [0.0, np.inf]), "angles"),
        (lambda: filtered_back_projection(xray_projections([BLOCK], GRID, [0.0])), "two angles"),
        (lambda: filtered_back_projection(xray_projections([BLOCK], GRID, [0.0, 1.0]), "hamm"), "hamming"),
        (lambda: with_photon_noise(xray_projections([BLOCK], GRID, [0.0, 1.0]), 0), "photons"),
    ],
)
def test_what_is_no_tomography_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_without_scikit_image_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "skimage.transform", None)
    with pytest.raises(EnvironmentProblem, match=r"rangesim\[ct\]"):
        filtered_back_projection(xray_projections([BLOCK], GRID, [0.0, 1.0]))
