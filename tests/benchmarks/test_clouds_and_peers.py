# SPDX-License-Identifier: Apache-2.0
"""What the benchmarks of pcgraph stand on: simulated rooms and streets, and what pcgraph is compared with.

Tests import from `benchmarks` in this folder only.
"""

from __future__ import annotations

import shutil
import subprocess

import numpy as np
import pytest
import room
import scanned_elsewhere
from baselines import felzenszwalb, normal_graph, plane_and_clusters
from meshed_rooms import meshed
from peers import PclSetting, run_lin, run_pcl
from scanned_scenes import Scene, ball, box, rod, scan, sphere_of_rays
from scanned_streets import CAR, GROUND, SENSOR_M, street, sweep
from scenes.tables import two_boxes_on_a_plane
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scores import completed, mean_overlap
from tiers import to_validate

import pcgraph
from pcgraph.metrics import weighted_overlap

PLAIN = PclSetting(0.01, 0.06, color=0.0, spatial=0.4, normal=1.0, camera=False)


def test_rooms_have_exactly_the_points_asked_for_and_are_as_dense_when_there_are_more(monkeypatch):
    monkeypatch.setattr(room, "CELLS", 2)  # of furniture: a fourth of what takes most of the points
    monkeypatch.setattr(room, "SIDE_M", 2.5)
    monkeypatch.setattr(room, "SPACING_M", 0.016)
    widths = []
    for n in (1, 12_500, 125_000):
        points, colors = room.rooms(n)
        assert points.shape == colors.shape == (n, 3)
        assert np.isfinite(points).all()
        assert all(np.array_equal(a, b) for a, b in zip(room.rooms(n), (points, colors), strict=True))
        widths.append(points[:, 0].max())
        if n > 1:
            distance = cKDTree(points).query(points[:: n // 4000], k=2)[0][:, 1]
            assert 0.6 * room.SPACING_M < np.median(distance) < room.SPACING_M
    assert widths[-1] > room.SIDE_M > widths[-2]  # a second room


@pytest.mark.parametrize(
    ("solid", "distance"),
    [(ball((3, 0, 0), (1, 1, 1)), 2.0), (box((2, -1, -1), (4, 1, 1)), 2.0), (rod((3, 0, -1), (3, 0, 1), 0.5), 2.5)],
)
def test_a_solid_is_where_it_was_put(solid, distance):
    scene = Scene()
    scene.add(scene.thing("solid"), solid)
    found = scan(scene, np.zeros((1, 3)), [np.eye(3)], 0.0, np.random.default_rng(0))
    assert len(found.points) == 1  # the rays along y and z miss it
    np.testing.assert_allclose(found.points, [[distance, 0.0, 0.0]], atol=0.02)


def test_a_meshed_room_lies_on_its_walls_and_says_which():
    scene = Scene()
    for wall in (box((-1.6, -1.6, -1.0), (-1.5, 1.6, 1.0)), box((-1.6, 1.5, -1.0), (1.6, 1.6, 1.0))):
        scene.add(scene.thing("wall"), wall)
    fine, coarse = (meshed(scene, np.zeros((2, 3)), 0, 0.06, faces) for faces in (None, 100))
    for found in (fine, coarse):
        walls = [found.points[found.things == thing] for thing in (0, 1)]
        assert np.abs(np.median(walls[0][:, 0]) + 1.5) < 0.01
        assert np.abs(np.median(walls[1][:, 1]) - 1.5) < 0.01
        assert np.mean(found.things < 0) < 0.05
    assert len(coarse.points) < 0.5 * len(fine.points)


def test_a_sweep_lies_on_the_ground_and_is_the_same_for_the_same_seed():
    made = street(3, half_length=40.0)
    found, again = sweep(made, 0), sweep(street(3, half_length=40.0), 0)
    np.testing.assert_array_equal(found.points, again.points)
    place = made.on_ground(0.0, -1.75) + np.array([0.0, 0.0, SENSOR_M])
    ground = found.points[found.things == made.scene.numbers(GROUND)[0]] + place
    ground = ground[np.linalg.norm(ground - place, axis=1) < 15.0]
    below = made.height(ground[:, 0], ground[:, 1]) - ground[:, 2]
    assert np.median(np.abs(below)) < 0.02
    rays = sphere_of_rays(np.array([0.0, 90.0]), np.array([0.0, -24.9]))
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0)


def test_felzenszwalb_parts_two_planes_at_a_right_angle():
    s, t = (c.ravel() for c in np.meshgrid(np.linspace(0.0, 1.0, 40), np.linspace(0.0, 1.0, 40)))
    points = np.concatenate((np.stack((s, t, 0 * s), axis=1), np.stack((s, 0 * s, t), axis=1)[t > 0]))
    labels = felzenszwalb(normal_graph(points), 0.5)
    away = points[:, 1:].max(axis=1) > 0.1
    assert len(np.unique(labels[away & (points[:, 2] == 0)])) == len(np.unique(labels[away & (points[:, 1] == 0)])) == 1
    assert labels[0] == labels.min() == 0
    assert len(np.unique(labels[away])) == 2


def test_clusters_stand_on_the_plane():
    rng = np.random.default_rng(0)
    plane = rng.uniform((-2, -2, 0), (2, 2, 0), (4000, 3))
    blobs = [rng.uniform(-0.1, 0.1, (200, 3)) + np.array([x, 0.0, 0.5]) for x in (-1.0, 1.0)]
    labels = plane_and_clusters(np.concatenate((plane, *blobs, [[0.0, 0.0, 3.0]])), 0.05, 0.2, 3)
    assert (labels[:4000] == 0).all()
    assert sorted({*labels[4000:4200]} | {*labels[4200:4400]}) == [1, 2]
    assert labels[-1] == -1


def _corner(concave: bool) -> np.ndarray:
    """Two square walls that meet at a right angle, (64, 64, 3) metres, seen from the origin, one point not finite."""
    s = np.linspace(-0.2, 0.2, 64)
    x, y = np.meshgrid(s, s)
    points = np.stack([x, y, 1.0 - np.abs(x) if concave else 1.0 + np.abs(x)], axis=-1).astype(np.float32)
    points[0, 0] = np.nan
    return points


@pytest.mark.parametrize(
    ("kind", "least"), [("turntable", 0.98), ("stereo_table", 0.98), *to_validate(("plant", 0.89))]
)
def test_kinds_that_were_held_back_are_segmented_with_nothing_given(kind, least):
    found = getattr(scanned_elsewhere, kind)()
    assert weighted_overlap(pcgraph.segment(found.points).labels, found.things) > least


def test_a_stereo_camera_measures_disparities_in_eighths_of_a_pixel():
    z = scanned_elsewhere.stereo_table().points[:, 2]
    eighths = 8.0 * 525.0 * 0.12 / z
    np.testing.assert_allclose(eighths, np.rint(eighths), atol=1e-2)
    assert len(np.unique(np.rint(eighths))) > 100


def test_a_walk_that_drifts_doubles_its_walls():
    found = scanned_elsewhere.drifting_walk()
    _, first, visits = np.unique(found.origins, axis=0, return_index=True, return_inverse=True)
    later = np.isin(visits, visits[np.sort(first)[4:]])
    x, y, z = found.points.T
    wall = (x > 8.9) & (np.abs(y - 2.0) < 1.7) & (np.abs(z - 1.7) < 0.7)
    before, after = found.points[wall & ~later], found.points[wall & later]
    assert before[:, 0].mean() == pytest.approx(9.0, abs=0.001)
    turn = np.radians(0.3)  # about the origin: what lies on x = 9 comes to x cos - y sin + 1.5 cm
    true = (9.0 + 0.015 * np.cos(turn) + 0.01 * np.sin(turn) - np.sin(turn) * after[:, 1]) / np.cos(turn)
    assert (after[:, 0] - true).mean() == pytest.approx(0.0, abs=0.001)


def _pcl_is_here() -> bool:
    if any(shutil.which(tool) is None for tool in ("cmake", "pkg-config", "c++")):
        return False
    return subprocess.run(["pkg-config", "--exists", "pcl_segmentation"], check=False).returncode == 0


@pytest.mark.validation
@pytest.mark.skipif(not _pcl_is_here(), reason="PCL (libpcl-dev) is not here")
@pytest.mark.parametrize(("concave", "segments"), [(True, 2), (False, 1)])
def test_lccp_of_pcl_parts_walls_only_at_a_concave_edge(concave, segments):
    points = _corner(concave)
    colors = np.full(points.shape, 128, np.uint8)
    found = run_pcl(points, colors, PLAIN, repeats=2)
    assert found.supervoxels[0, 0] == found.segments[0, 0] == -1
    assert (found.supervoxels.ravel()[1:] >= 0).all()
    inner = np.abs(points[..., 0]) > 0.05  # PCL's supervoxels may straddle the edge
    assert len(np.unique(found.segments[inner & (found.segments > 0)])) == segments
    assert len(found.vccs_s) == len(found.lccp_s) == 2
    assert (found.vccs_s > 0.0).all()


def test_lin_gives_as_many_supervoxels_as_cubes_are_occupied():
    pytest.importorskip("py4dgeo")
    points = two_boxes_on_a_plane()[0].astype(np.float32)
    labels, seconds = run_lin(points.reshape(1, -1, 3), 0.1)
    cubes = np.unique(np.floor((points - points.min(axis=0)) / 0.1), axis=0)
    assert seconds > 0.0
    assert labels.min() == 0
    assert len(np.unique(labels)) == pytest.approx(len(cubes), rel=0.1)  # they count cubes of voxels' means


@pytest.mark.filterwarnings("ignore:expected far fewer objects")  # of so few supervoxels
@pytest.mark.parametrize("seed", [6, 7])
def test_a_sweep_keeps_its_things_when_it_is_thinned_to_one_point_per_cell(seed):
    """Its far rings do not touch at any size: voxels as large as cars would not join them, but all else."""
    made = street(seed, half_length=60.0)
    found = sweep(made, 0)
    kept = np.unique(np.floor(found.points / 0.2), axis=0, return_index=True)[1]
    result = pcgraph.segment(found.points[kept])
    assert result.voxel_size < 1.0
    assert weighted_overlap(result.labels, found.things[kept]) > 0.6


def test_voxels_of_a_sweep_thinned_to_the_mean_of_each_cell_are_smaller():
    """Points that lie evenly tell smaller things apart: at voxels of 27 cm people and poles are lost, at 22 found.

    Another draw of voxels changes the overlap by 0.03 (standard deviation), and the rounding of sines is enough to draw
    again: what counts is the mean. The turns change the draw; a shift would not, because voxels follow the cloud.
    """
    found = sweep(street(6, half_length=60.0), 0)
    group = np.unique(np.floor(found.points / 0.1), axis=0, return_inverse=True)[1]
    first = np.unique(group, return_index=True)[1]
    means = np.stack([np.bincount(group, x) / np.bincount(group) for x in found.points.T], axis=1)
    truth = found.things[first]
    things = np.flatnonzero(np.bincount(truth) >= 20)[2:]  # without nothing and the ground
    results = [pcgraph.segment(Rotation.from_euler("z", turn).apply(means)) for turn in (0.0, 0.3, 0.7)]
    assert all(result.voxel_size < 0.24 for result in results)
    assert np.mean([mean_overlap(completed(result.labels), truth, things) for result in results]) > 0.77


@pytest.mark.parametrize("seed", [3, 5])
def test_cars_in_a_few_sweeps_of_few_beams_are_objects(seed):
    """Voxels grew until three quarters of them touched five others, to a metre, though each step joined few more."""
    rng, made = np.random.default_rng(seed), street(seed, half_length=60.0)
    places = np.array([made.on_ground(x, -1.75) + np.array((0.0, 0.0, 2.0)) for x in (-15.0, 0.0, 15.0)])
    rays = [
        sphere_of_rays(np.arange(0.0, 360.0, 0.2) + turn, np.linspace(-15.0, 15.0, 16)) for turn in rng.uniform(size=3)
    ]
    seen = scan(made.scene, places, rays, 0.02, rng, reach=80.0)
    found = pcgraph.segment(seen.points)
    cars = [car for car in made.scene.numbers(CAR) if np.count_nonzero(seen.things == car) >= 50]
    assert found.surface.grid.size < 0.4
    assert mean_overlap(found.labels, seen.things, np.array(cars)) > 0.65
