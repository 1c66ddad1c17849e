# SPDX-License-Identifier: Apache-2.0
"""Calibration: boards as they are drawn and found, Zhang's conic, bundles at their bound, rigs rendered and real."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiers import to_validate

import rangesim
from rangesim import save_capture
from rangesim.calibration import (
    BoardView,
    Bundle,
    CharucoBoard,
    Checkerboard,
    CircleGrid,
    Observation,
    adjust,
    calibrate_camera,
    calibrate_rig,
    intrinsics_from_homographies,
)
from rangesim.calibration.suspects import find_suspects
from rangesim.results.captures import import_capture
from rangesim.rig import Intrinsics
from rangesim.rig.calibration_files import load_calibration

CAMERA = Intrinsics(640, 480, 700.0, 702.0, 322.0, 238.0, (-0.12, 0.05, 0.001, -0.002, 0.01))
BOARD = Checkerboard(9, 6, 0.025)
BOARDS = [BOARD, CharucoBoard(9, 6, 0.025, 0.018), CircleGrid(9, 6, 0.025, 0.014)]


def lens(device):
    return np.array([device.fx, device.fy, device.cx, device.cy, *device.coefficients])


def pose(turn_deg, middle, board=BOARD):
    """T_camera_board with the middle of the board's points at a place."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", turn_deg, degrees=True).as_matrix()
    T[:3, 3] = np.asarray(middle) - T[:3, :3] @ board.points.mean(axis=0)
    return T


def poses(n, rng, device=CAMERA, tilt=40.0):
    """Boards that the device sees as a whole."""
    found = []
    while len(found) < n:
        T = pose(rng.uniform(-tilt, tilt, 3), rng.uniform([-0.15, -0.1, 0.4], [0.15, 0.1, 0.7]))
        pixels = device.project(BOARD.points @ T[:3, :3].T + T[:3, 3])
        if np.isfinite(pixels).all() and (pixels > 5).all() and (pixels < [635, 475]).all():
            found.append(T)
    return np.stack(found)


def views(T_camera_board, device, noise, rng):
    places = BOARD.points @ np.swapaxes(T_camera_board[:, :3, :3], 1, 2) + T_camera_board[:, None, :3, 3]
    return [BoardView(np.arange(54), p + rng.normal(0, noise, p.shape)) for p in device.project(places)]


# ------------------------------------------------------------------------------------------- boards


@pytest.mark.parametrize("board", BOARDS, ids=lambda b: type(b).__name__)
def test_a_board_is_found_where_it_is_drawn(board):
    n = 64
    image = board.image(n)
    assert image.shape == ((board.rows - 1 + 2 * board.margin) * n, (board.columns - 1 + 2 * board.margin) * n)
    view = board.find(image * 3000.0)
    expected = (board.points[:, :2] / board.spacing_m + board.margin) * n
    assert view.indices.tolist() == list(range(54))
    assert np.abs(view.pixels - expected).max() < 0.06


@pytest.mark.parametrize("board", [BOARDS[0], *to_validate(*BOARDS[1:])], ids=lambda b: type(b).__name__)
def test_a_rendered_board_is_found_where_it_stands(board):
    """Also that it is not mirrored, nor turned by half: the indices are right."""
    T = pose((20, -25, 5), (0, 0, 0.6), board)
    scene = rangesim.load_scene(board.scene(T))
    rig = replace(scene.rig(baseline_m=0.05, width=640, height=480), camera=replace(CAMERA, distortion=()))
    white = rangesim.transport(scene, rig, [rangesim.IdealToF()], spp=32).energy.projector
    view = board.find(white)
    expected = rig.camera.project(board.points @ T[:3, :3].T + T[:3, 3])
    assert len(view.indices) == 54
    assert np.sqrt(((view.pixels - expected[view.indices]) ** 2).mean()) < 0.1


def test_a_part_of_a_charuco_board_is_enough():
    board, n = BOARDS[1], 64
    view = board.find(board.image(n)[:, : 6 * n])  # four columns of corners, and what the fifth would need is cut
    expected = (board.points[view.indices, :2] / board.spacing_m + board.margin) * n
    assert {index % 9 for index in view.indices.tolist()} <= set(range(5))
    assert len(view.indices) >= 18
    assert np.abs(view.pixels - expected).max() < 0.1


@pytest.mark.parametrize("beside_px", [4, 6, 8])
def test_a_corner_at_the_edge_of_the_light_is_left_out_and_no_other_moves(beside_px):
    """The edge in its window would draw it away by pixels: it ruined two of ten rendered calibrations."""
    cv2 = pytest.importorskip("cv2")
    n, turn = 26, cv2.getRotationMatrix2D((160, 120), 25.0, 0.9)
    large = cv2.resize(BOARD.image(4 * n), None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    image = cv2.warpAffine(large, turn, (420, 380), borderValue=0.0)
    image = 20 + 200 * image + np.random.default_rng(0).normal(0, 1, image.shape)
    corners = (BOARD.points[:, :2] / BOARD.spacing_m + BOARD.margin) * n - 0.5  # OpenCV's, centres at integers
    expected = corners @ turn[:, :2].T + turn[:, 2] + 0.5
    whole = BOARD.find(image)
    assert len(whole.indices) == 54
    assert np.abs(whole.pixels - expected).max() < 0.1
    right = int(expected[:, 0].argmax())
    image[:, int(expected[right, 0]) + beside_px :] = 20
    view = BOARD.find(image)
    assert right not in view.indices
    assert len(view.indices) >= 52
    assert np.abs(view.pixels - expected[view.indices]).max() < 0.15


def test_an_image_without_the_board_says_so():
    with pytest.raises(ValueError, match="Checkerboard of 9 x 6 points in the image, found none"):
        BOARD.find(np.random.default_rng(0).random((200, 300)))
    with pytest.raises(ValueError, match="grey image"):
        BOARD.find(np.zeros((20, 30, 3)))
    with pytest.raises(ValueError, match="finite"):
        BOARD.find(np.full((200, 300), np.nan))


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Checkerboard(1, 6, 0.02), "columns"),
        (lambda: Checkerboard(9, 6, -0.02), "square_m"),
        (lambda: CharucoBoard(9, 6, 0.02, 0.03), "marker_m below square_m"),
        (lambda: CharucoBoard(9, 6, 0.02, 0.01, "DICT_NONE"), "one of OpenCV's"),
        (lambda: CharucoBoard(30, 30, 0.02, 0.01, "DICT_5X5_50"), "dictionary of 480 markers"),
        (lambda: CircleGrid(9, 6, 0.02, 0.03), "diameter_m below distance_m"),
    ],
)
def test_boards_that_cannot_be(make, says):
    with pytest.raises(ValueError, match=says):
        make()


# ------------------------------------------------------------------------------------------- Zhang


def test_three_homographies_give_the_camera():
    """K, skew included, from H = K [r1 r2 t], each of another scale."""
    K = np.array([[800.0, 3.0, 310.0], [0, 790.0, 250.0], [0, 0, 1.0]])
    H = [
        s * K @ pose(turn, (0, 0, 0.5))[:3][:, [0, 1, 3]]
        for s, turn in ((2, (30, 0, 0)), (-5, (0, 30, 10)), (1, (-20, 20, 0)))
    ]
    assert np.allclose(intrinsics_from_homographies(H, has_skew=True), K, rtol=1e-7)
    with pytest.raises(ValueError, match=r"at least 3 views of the plane, got 2: .* the 5 degrees of freedom"):
        intrinsics_from_homographies(H[:2], has_skew=True)


@pytest.mark.parametrize("turns", [((30, 0, 0), (0, 30, 10)), ((20, -10, 5), (-15, 25, 80))])
def test_two_homographies_give_a_camera_without_skew(turns):
    K = np.array([[800.0, 0.0, 310.0], [0, 790.0, 250.0], [0, 0, 1.0]])
    H = [s * K @ pose(turn, (0, 0, 0.5))[:3][:, [0, 1, 3]] for s, turn in zip((2, -5), turns, strict=True)]
    found = intrinsics_from_homographies(H)
    assert np.allclose(found, K, rtol=1e-7)
    assert found[0, 1] == 0


@pytest.mark.filterwarnings("ignore:.*in a corner of its image")
@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize("coefficients", [0, 2])
@pytest.mark.validation
def test_few_views_give_the_camera_to_its_deviations(count, coefficients):
    pinhole = replace(CAMERA, distortion=())
    errors = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        T = poses(count, rng, pinhole, tilt=35.0)
        found = calibrate_camera(BOARD, views(T, pinhole, 0.1, rng), 640, 480, coefficients=coefficients)
        errors.append((lens(found.camera) - lens(pinhole))[:4] / found.deviations[:4])
    assert 0.7 < np.sqrt(np.mean(np.square(errors))) < 1.3
    assert np.abs(errors).max() < 4.5


@pytest.mark.filterwarnings("ignore:.*in a corner of its image")
@pytest.mark.parametrize(("seed", "tilt"), [(3, 10.0), (6, 10.0), (27, 15.0), (35, 10.0), (28, 15.0), (35, 15.0)])
def test_three_views_that_would_start_with_a_skew_give_the_camera(seed, tilt):
    """With a free skew, or with noise in the principal point, their conic is none of a camera; OpenCV solves them."""
    rng = np.random.default_rng(seed)
    seen = views(poses(3, rng, tilt=tilt), CAMERA, 0.1, rng)
    found = calibrate_camera(BOARD, seen, 640, 480, coefficients=5)
    assert np.abs((lens(found.camera) - lens(CAMERA))[:4] / found.deviations[:4]).max() < 4
    assert 0.09 < found.noise_px < 0.11


def test_fewer_than_two_views_do_not():
    rng = np.random.default_rng(0)
    two = views(poses(2, rng), CAMERA, 0.1, rng)
    with pytest.raises(ValueError, match="4 degrees of freedom of the absolute conic"):
        calibrate_camera(BOARD, two[:1], 640, 480)
    with pytest.raises(ValueError, match="view 0: expected indices of the board's 15 points, got 0 to 53"):
        calibrate_camera(Checkerboard(5, 3, 0.025), [*two, two[0]], 640, 480)
    with pytest.raises(ValueError, match="at least 2 views of the plane, got 1"):
        intrinsics_from_homographies(np.eye(3))


@pytest.mark.parametrize("turn", [(0, 0, 0), (25, -10, 0)])
def test_views_that_are_parallel_do_not(turn):
    rng = np.random.default_rng(1)
    T = np.stack([pose(turn, (0.02 * k - 0.04, 0.01 * k, 0.5 + 0.03 * k)) for k in range(5)])
    with pytest.raises(ValueError, match=r"tilt the board|not positive definite"):
        calibrate_camera(BOARD, views(T, CAMERA, 0.05, rng), 640, 480)


@pytest.mark.validation
@pytest.mark.filterwarnings("ignore:.*in a corner of its image")
def test_a_camera_is_found_to_the_bound_and_as_opencv_finds_it():
    cv2 = pytest.importorskip("cv2")
    rng = np.random.default_rng(2)
    errors = []
    for _ in range(8):
        T = poses(7, rng)
        seen = views(T, CAMERA, 0.1, rng)
        found = calibrate_camera(BOARD, seen, 640, 480)
        assert 0.09 < found.noise_px < 0.11
        errors.append((lens(found.camera) - lens(CAMERA)) / found.deviations)
    assert np.abs(found.T_camera_board - T).max() < 5e-3
    assert 0.7 < np.sqrt(np.mean(np.square(errors))) < 1.25  # as the covariance says, which is the bound
    points = [BOARD.points.astype(np.float32)] * len(seen)
    rms, K, D, *_ = cv2.calibrateCamera(
        points, [(v.pixels - 0.5).astype(np.float32) for v in seen], (640, 480), None, None
    )
    assert np.isclose(found.rms_px, rms, rtol=1e-4)
    assert np.allclose([K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5], lens(found.camera)[:4], atol=0.02)
    assert np.allclose(D.ravel(), found.camera.distortion, atol=2e-3)


def test_coefficients_are_free_as_told():
    rng = np.random.default_rng(3)
    pinhole = replace(CAMERA, distortion=())
    found = calibrate_camera(BOARD, views(poses(6, rng), pinhole, 0.1, rng), 640, 480, coefficients=0)
    assert found.camera.distortion == (0.0,) * 5
    assert (found.deviations[4:] == 0).all()
    assert np.abs(lens(found.camera) - lens(pinhole))[:4].max() < 4
    with pytest.raises(ValueError, match="0 to 5 coefficients"):
        calibrate_camera(BOARD, views(poses(3, rng), pinhole, 0.1, rng), 640, 480, coefficients=6)


def test_the_middles_of_discs_do_not_bend_the_camera():
    """Centroids of the images of discs, without noise: taken for images of the middles they would."""
    board = CircleGrid(9, 6, 0.025, 0.016)
    rng = np.random.default_rng(8)
    T = poses(10, rng)
    angle = np.arange(4000) * (2 * np.pi / 4000)
    edge = 0.5 * board.diameter_m * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    seen = []
    for P in T:
        x = CAMERA.project((board.points[:, None] + edge) @ P[:3, :3].T + P[:3, 3])
        y = np.roll(x, -1, axis=1)
        area = x[..., 0] * y[..., 1] - x[..., 1] * y[..., 0]
        middles = ((x + y) * area[..., None]).sum(axis=1) / (3 * area.sum(axis=1))[:, None]
        seen.append(BoardView(np.arange(54), middles))
    found = calibrate_camera(board, seen, 640, 480)
    assert np.abs(lens(found.camera) - lens(CAMERA))[:4].max() < 1e-3
    assert np.abs(found.T_camera_board - T).max() < 1e-6
    bent = calibrate_camera(Checkerboard(9, 6, 0.025), seen, 640, 480)
    assert np.abs(lens(bent.camera) - lens(CAMERA))[:4].max() > 0.15


def spoilt(seed, change):
    """Views of which one is changed."""
    rng = np.random.default_rng(seed)
    seen = views(poses(10, rng), CAMERA, 0.1, rng)
    seen[2] = change(seen[2])
    return seen


def moved(view, point, off):
    pixels = view.pixels.copy()
    pixels[point] += off
    return BoardView(view.indices, pixels)


@pytest.mark.filterwarnings("ignore:.*in a corner of its image")
@pytest.mark.parametrize(
    ("distortion", "count", "coefficients"),
    [
        (CAMERA.distortion, 10, 0),
        (CAMERA.distortion, 4, 0),
        ((-0.3, 0.1), 10, 0),
        ((-0.05,), 10, 0),
        ((-0.3, 0.4), 10, 1),
    ],
)
@pytest.mark.parametrize("seed", [0, 1])
def test_distortion_that_is_left_out_is_told(distortion, count, coefficients, seed):
    """The camera was off by up to 29 px at a stated 2.8, without a word or with 'leave that view out'."""
    rng = np.random.default_rng(seed)
    camera = replace(CAMERA, distortion=distortion)
    seen = views(poses(count, rng, camera), camera, 0.1, rng)
    with pytest.warns(rangesim.errors.RangesimWarning, match=rf"distortion that {coefficients} free") as told:
        found = calibrate_camera(BOARD, seen, 640, 480, coefficients=coefficients)
    full = calibrate_camera(BOARD, seen, 640, 480, coefficients=5)
    assert not any("than noise can explain" in str(warning.message) for warning in told)
    assert found.suspects == full.suspects == ()
    text = next(str(w.message) for w in told if "distortion that" in str(w.message))
    name, shift = re.search(r"move (\w+) of the camera by ([-+.\d]+) px", text).groups()
    k = ["fx", "fy", "cx", "cy"].index(name)
    assert float(shift) == pytest.approx((lens(full.camera) - lens(found.camera))[k], abs=0.06)
    assert abs(float(shift)) > 2 * found.deviations[k]


@pytest.mark.filterwarnings("ignore:.*in a corner of its image")
@pytest.mark.parametrize(("distortion", "coefficients"), [((), 0), ((-0.1,), 1), ((-0.12, 0.05), 2)])
def test_coefficients_that_suffice_are_not_said_to_be_too_few(distortion, coefficients):
    for seed in range(4):
        rng = np.random.default_rng(seed)
        camera = replace(CAMERA, distortion=distortion)
        found = calibrate_camera(
            BOARD, views(poses(8, rng, camera), camera, 0.1, rng), 640, 480, coefficients=coefficients
        )
        assert found.suspects == ()


@pytest.mark.filterwarnings("ignore:.*in a corner of its image")
def test_a_view_that_does_not_fit_is_no_distortion():
    rng = np.random.default_rng(4)
    pinhole = replace(CAMERA, distortion=())
    seen = views(poses(10, rng, pinhole), pinhole, 0.1, rng)
    seen[3] = moved(seen[3], 0, (4.0, 3.0))
    with pytest.warns(rangesim.errors.RangesimWarning, match="point 0 of view 3 is off by"):
        found = calibrate_camera(BOARD, seen, 640, 480, coefficients=0)
    assert (found.suspects[0].view, found.suspects[0].point) == (3, 0)
    assert {s.view for s in found.suspects} == {3}


@pytest.mark.filterwarnings("ignore:.*in a corner of its image")
@pytest.mark.parametrize(
    ("change", "number"),
    [
        (lambda v: moved(v, 17, (1.5, -1.0)), 1),  # a corner drawn away by an edge
        (lambda v: BoardView(v.indices, 0.5 * v.pixels), 20),  # an image of half the size
    ],
)
def test_views_that_do_not_fit_are_warned_about_and_named(change, number):
    with pytest.warns(rangesim.errors.RangesimWarning, match="of view 2 is off by .* more than noise can explain"):
        found = calibrate_camera(BOARD, spoilt(6, change), 640, 480, coefficients=2)
    assert len(found.suspects) >= number or number > 1
    assert found.suspects[0].view == 2
    if number == 1:
        assert [s.point for s in found.suspects] == [17]
        assert 1.3 < found.suspects[0].error_px < 1.9


def test_views_that_cannot_be_are_named():
    with pytest.raises(ValueError, match="view 2: expected points in an image of 640 x 480 pixels, got some outside"):
        calibrate_camera(BOARD, spoilt(6, lambda v: BoardView(v.indices, 2 * v.pixels)), 640, 480)
    with pytest.raises(ValueError, match="view 2: expected second to be finite"):
        calibrate_camera(BOARD, spoilt(6, lambda v: moved(v, 3, np.nan)), 640, 480)
    with pytest.raises(ValueError, match="view 2: expected at least 4 points"):
        calibrate_camera(BOARD, spoilt(6, lambda v: BoardView(v.indices[:3], v.pixels[:3])), 640, 480)
    seen = spoilt(6, lambda v: v)
    with pytest.raises(ValueError, match="view 10: expected another pose of the board, got view 4 once more"):
        calibrate_camera(BOARD, [*seen, seen[4]], 640, 480)


def test_a_lens_is_not_made_up_where_no_board_was():
    """Boards in the middle of the image alone: five coefficients fit them, and fold or miss the corners by far."""
    rng = np.random.default_rng(11)
    device = replace(CAMERA, distortion=(-0.3, 0.1))
    for n in (4, 5, 6, 8):
        T = np.stack([pose(rng.uniform(-30, 30, 3), (0, 0, 0.9)) for _ in range(n)])
        with pytest.warns(rangesim.errors.RangesimWarning, match=r"px only in a corner|folds within its image"):
            calibrate_camera(BOARD, views(T, device, 0.2, rng), 640, 480)


@pytest.mark.filterwarnings("ignore:.*folds within its image")  # the first one does
@pytest.mark.parametrize("k", [(-0.35, 0.15), *to_validate(((-0.45, 0.25, 0.0, 0.0, -0.08),), ((0.3, -0.1),))])
def test_a_lens_of_much_distortion_is_found(k):
    rng = np.random.default_rng(12)
    device = Intrinsics(640, 480, 420.0, 421.0, 322.0, 238.0, k)
    T = []
    while len(T) < 14:
        P = pose(rng.uniform(-35, 35, 3), rng.uniform([-0.25, -0.18, 0.22], [0.25, 0.18, 0.4]))
        pixels = device.project(BOARD.points @ P[:3, :3].T + P[:3, 3])
        if np.isfinite(pixels).all() and (pixels > 2).all() and (pixels < [638, 478]).all():
            T.append(P)
    found = calibrate_camera(BOARD, views(np.stack(T), device, 0.1, rng), 640, 480)
    assert np.abs((lens(found.camera) - lens(device)) / found.deviations).max() < 4
    assert 0.12 < found.rms_px < 0.16


# ------------------------------------------------------------------------------------------- bundles


def test_a_bundle_of_two_devices_is_found_exactly_from_afar():
    rng = np.random.default_rng(4)
    second = Intrinsics(1280, 800, 1500.0, 1504.0, 632.0, 415.0, (-0.05, 0.02, 0.0, 0.001, 0.0))
    T_second_first = pose((1, 8, -2), (0, 0, 0))
    T_second_first[:3, 3] = (-0.1, 0.003, 0.01)
    true = Bundle((CAMERA, second), T_second_first, poses(8, rng, tilt=30.0))
    seen = [Observation(device, k, BOARD.points, np.zeros((54, 2))) for device in (0, 1) for k in range(8)]
    seen = [replace(one, pixels=true.project(one)) for one in seen]
    off = np.eye(4)
    off[:3, :3] = Rotation.from_rotvec((0.02, -0.03, 0.01)).as_matrix()
    start = Bundle(
        (Intrinsics(640, 480, 650.0, 650.0, 320.0, 240.0), Intrinsics(1280, 800, 1400.0, 1400.0, 640.0, 400.0)),
        off @ T_second_first,
        np.stack([off @ T for T in true.T_first_board]),
    )
    found = adjust(start, seen)
    assert found.cost < 1e-12
    for k in range(2):
        assert np.allclose(lens(found.state.devices[k]), lens(true.devices[k]), rtol=1e-5, atol=1e-5)
    assert np.allclose(found.state.T_second_first, T_second_first, atol=1e-7)


def test_jacobians_are_derivatives():
    rng = np.random.default_rng(5)
    bundle = Bundle((CAMERA, CAMERA), pose((2, 5, 0), (0.05, 0, 0)), poses(1, rng))
    seen = [Observation(device, 0, BOARD.points[:5], rng.random((5, 2)), 0.5) for device in (0, 1)]
    captured = {}

    def spy(residuals, step, start):
        captured.update(residuals=residuals, step=step, start=start)
        return

    from rangesim.calibration import bundle as module

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "minimise", spy)
        adjust(bundle, seen)
    _, jacobian = captured["residuals"](captured["start"])
    for k in range(jacobian.shape[1]):
        moved = np.zeros(jacobian.shape[1])
        moved[k] = 1e-6
        ahead, _ = captured["residuals"](captured["step"](captured["start"], moved))
        behind, _ = captured["residuals"](captured["step"](captured["start"], -moved))
        assert np.allclose((ahead - behind) / 2e-6, jacobian[:, k], rtol=1e-5, atol=1e-3), k


# ------------------------------------------------------------------------------------------- rigs


@pytest.fixture(scope="module")
def rendered():
    """Four captures of a board by a known rig, and that."""
    camera = Intrinsics(480, 360, 520.0, 521.0, 243.0, 178.0, (-0.1, 0.05))
    projector = Intrinsics(512, 384, 640.0, 641.0, 252.0, 200.0, (-0.05, 0.02))
    T_camera_projector = pose((0, -8, 0), (0, 0, 0))
    T_camera_projector[:3, 3] = (0.1, 0.003, 0.005)
    sensor = rangesim.StructuredLight(projector_width=512, projector_height=384, axes=("columns", "rows"))
    captures = []
    for turn in ((25, 0, 5), (-20, 15, 0), (0, -30, -10), (15, 25, 20)):
        scene = rangesim.load_scene(BOARD.scene(pose(turn, (0.01, 0, 0.5))))
        rig = replace(
            scene.rig(baseline_m=0.1, projector_size=(512, 384), width=480, height=360),
            camera=camera,
            projector=projector,
            T_camera_projector=T_camera_projector,
        )
        signals = rangesim.transport(scene, rig, [sensor], spp=16)
        captures.append(rangesim.expose(signals, sensor, sensor.default_detector, seed=len(captures)))
    return captures, rig


@pytest.mark.validation
def test_a_rendered_rig_is_calibrated_to_what_it_says(rendered):
    captures, rig = rendered
    found = calibrate_rig(BOARD, [replace(capture, rig=None) for capture in captures], coefficients=2)
    for device, deviations, true in (
        (found.rig.camera, found.camera_deviations, rig.camera),
        (found.rig.projector, found.projector_deviations, rig.projector),
    ):
        off = lens(device) - lens(true)
        assert np.abs(off[:2] / lens(true)[:2]).max() < 0.005
        assert (np.abs(off[:6]) < 6 * deviations[:6] + [0.1, 0.1, 0.1, 0.1, 1e-3, 1e-3]).all()
    baseline = np.linalg.norm(rig.T_camera_projector[:3, 3])
    assert abs(found.baseline_m - baseline) < min(6 * found.baseline_deviation_m + 1e-5, 0.005 * baseline)
    assert found.camera_rms_px < 0.1
    assert found.projector_rms_px < 0.2
    assert np.abs(found.rig.T_camera_projector[:3, :3] - rig.T_camera_projector[:3, :3]).max() < 5e-3


def test_a_board_that_moved_while_it_was_taken_is_named_and_no_other(rendered):
    """It bends the rig until other captures have errors as well."""
    _, rig = rendered
    rng = np.random.default_rng(7)
    T = poses(9, rng, rig.camera, tilt=35.0)
    T_projector_camera = np.linalg.inv(rig.T_camera_projector)
    between = Bundle((rig.camera, rig.projector), T_projector_camera, T)
    observations = [Observation(d, k, BOARD.points, np.zeros((54, 2))) for d in (0, 1) for k in range(9)]
    noisy = [replace(o, pixels=between.project(o) + rng.normal(0, 0.05, (54, 2))) for o in observations]
    noisy[9 + 4] = replace(noisy[9 + 4], pixels=noisy[9 + 4].pixels + np.array([0.0, 3.0]))
    found = adjust(between, noisy, 2)
    seen = [BoardView(np.arange(54), o.pixels) for o in noisy]
    suspects = find_suspects(found.state, noisy, seen, 1.0, 2)
    assert {s.view for s in suspects} == {4}
    off = [np.linalg.norm(found.state.project(o) - o.pixels, axis=-1).max() for o in noisy]
    assert sorted(off)[-3] > 0.3  # by least squares others have errors too
    clean = [o for o in noisy if o.view != 4]
    renumbered = [replace(o, view=o.view - (o.view > 4)) for o in clean]
    good = adjust(replace(between, T_first_board=np.delete(T, 4, axis=0)), renumbered, 2)
    assert find_suspects(good.state, renumbered, [s for k, s in enumerate(seen) if k % 9 != 4], 1.0, 2) == ()


def test_a_capture_that_does_not_do_is_named(rendered):
    captures, _ = rendered
    with pytest.raises(ValueError, match="at least 2 views"):
        calibrate_rig(BOARD, captures[:1])
    with pytest.raises(ValueError, match="capture 0: expected a Checkerboard of 7 x 5"):
        calibrate_rig(Checkerboard(7, 5, 0.025), captures)
    with pytest.raises(ValueError, match="left: expected a Checkerboard of 7 x 5"):
        calibrate_rig(Checkerboard(7, 5, 0.025), captures, names=["left", "right", "up", "down"])
    with pytest.raises(ValueError, match="capture 4: expected another pose of the board, got capture 1 once more"):
        calibrate_rig(BOARD, [*captures, captures[1]])
    other = replace(captures[1], frames=captures[1].frames[:, :350], rig=None)
    with pytest.raises(ValueError, match=r"capture 1: .* of 480 x 360 pixels, got .* of 480 x 350 pixels"):
        calibrate_rig(BOARD, [captures[0], other, captures[2]])
    columns_only = rangesim.StructuredLight(projector_width=512, projector_height=384)
    frames = captures[0].frames[[*range(len(columns_only.frame_names()) - 2), -2, -1]]
    with pytest.raises(ValueError, match="capture 0: expected columns and rows"):
        calibrate_rig(BOARD, [replace(captures[0], frames=frames, sensor=columns_only, rig=None)] * 3)


@pytest.mark.validation
def test_one_pose_of_a_real_board_allows_a_pose_and_no_more(real_data):
    """One view gives two of the conic's four equations: no calibration; with a known camera, where the board stands."""
    from rangesim.geometry import fit_camera_pose

    folder = real_data / "graycode_board"
    sensor = rangesim.StructuredLight(code="gray", projector_width=1024, projector_height=768, axes=("columns", "rows"))
    capture = import_capture(folder / "capture_0", sensor)
    board = Checkerboard(9, 7, 0.075)
    with pytest.raises(ValueError, match="at least 2 views"):
        calibrate_rig(board, [capture])
    view = board.find(capture.frames[-2])
    rig = load_calibration(folder / "calibration_result.xml", projector_size=(1024, 768))
    found = fit_camera_pose(board.points, view.pixels, rig.camera)
    assert found.noise_px < 0.5
    assert 0.5 < found.T_camera_object[2, 3] < 5.0


# ------------------------------------------------------------------------------------------- files and command line


def once(function):
    """The function, whose first result is given again."""
    results = []

    def given(*arguments, **options):
        results.append(results[0] if results else function(*arguments, **options))
        return results[0]

    return given


def test_the_command_writes_what_calibration_reads_and_opencv_too(rendered, tmp_path, capsys, monkeypatch):
    import cv2

    from rangesim import calibration
    from rangesim.cli import app

    captures, rig = rendered
    for k, capture in enumerate(captures):
        save_capture(capture, tmp_path / f"pose_{k}")
    folders = [str(tmp_path / f"pose_{k}") for k in range(4)]
    options = ["--points", "9x6", "--spacing", "0.025", "--coefficients", "2"]
    monkeypatch.setattr(calibration, "calibrate_rig", once(calibrate_rig))  # two files of one result
    for name in ("rig.json", "rig.yml"):
        app(["calibrate", *folders, *options, "--out", str(tmp_path / name)], standalone_mode=False)
    said = capsys.readouterr().out
    assert "baseline" in said
    assert "pose_3" in said
    found = load_calibration(tmp_path / "rig.json")
    assert abs(found.camera.fx / rig.camera.fx - 1) < 0.005
    file = cv2.FileStorage(str(tmp_path / "rig.yml"), cv2.FILE_STORAGE_READ)
    K, R, T, F = (file.getNode(name).mat() for name in ("projector_matrix", "R", "T", "F"))
    X = np.array([[0.02, -0.03, 0.5], [0.1, 0.05, 0.6]])
    coefficients = file.getNode("projector_distortion").mat()
    seen, _ = cv2.projectPoints(X, cv2.Rodrigues(R)[0], T, K, coefficients)
    by_rig = np.linalg.inv(found.T_camera_projector)
    expected = found.projector.project(X @ by_rig[:3, :3].T + by_rig[:3, 3])
    assert np.allclose(seen.reshape(-1, 2) + 0.5, expected, atol=1e-6)
    pinhole, _ = cv2.projectPoints(X, cv2.Rodrigues(R)[0], T, K, None)
    by_camera, _ = cv2.projectPoints(X, np.zeros(3), np.zeros(3), file.getNode("camera_matrix").mat(), None)
    ends = [np.c_[pixels.reshape(-1, 2), np.ones(2)] for pixels in (pinhole, by_camera)]
    assert np.abs(np.einsum("ni,ij,nj->n", ends[0], F, ends[1])).max() < 1e-9


def test_a_rig_for_opencv_is_read_back_and_decodes(rendered, tmp_path):
    from rangesim.calibration.opencv_files import save_opencv
    from rangesim.cli import app
    from rangesim.results.range_images import load_range_image
    from rangesim.rig.calibration_files import load_calibration

    captures, rig = rendered
    for name in ("rig.yml", "rig.xml"):
        save_opencv(rig, tmp_path / name)
        back = load_calibration(tmp_path / name)
        for one, other in ((back.camera, rig.camera), (back.projector, rig.projector)):
            assert (one.width, one.height) == (other.width, other.height)
            assert np.allclose(lens(one), lens(other), rtol=1e-12)
        assert np.allclose(back.T_camera_projector, rig.T_camera_projector, atol=1e-12)
    save_capture(captures[0], tmp_path / "capture")
    depths = []
    for name in ("rig.yml", "rig.xml"):
        arguments = ["--calibration", str(tmp_path / name), "--out", str(tmp_path / name.replace(".", "_"))]
        app(["decode", str(tmp_path / "capture"), *arguments], standalone_mode=False)
        depths.append(load_range_image(tmp_path / name.replace(".", "_") / "range.npz").z)
    expected = rangesim.decode(captures[0]).z
    for z in depths:
        assert np.allclose(z, expected, atol=1e-5, equal_nan=True)


@pytest.mark.validation
def test_a_calibration_for_opencv_may_be_in_any_unit(rendered, tmp_path):
    from rangesim.calibration.opencv_files import save_opencv
    from rangesim.cli import app
    from rangesim.results.range_images import load_range_image
    from rangesim.rig.calibration_files import load_calibration, save_calibration

    captures, rig = rendered
    save_capture(captures[0], tmp_path / "capture")
    expected = rangesim.decode(captures[0]).z
    for k, (suffix, unit) in enumerate(((".yml", 1e-3), (".xml", 0.0254), (".yaml", 1.0))):
        place = tmp_path / f"rig{k}{suffix}"
        T = np.array(rig.T_camera_projector)
        T[:3, 3] /= unit
        save_opencv(replace(rig, T_camera_projector=T), place)
        assert np.allclose(load_calibration(place, unit_m=unit).T_camera_projector, rig.T_camera_projector, atol=1e-12)
        assert np.allclose(load_calibration(place).T_camera_projector[:3, 3], T[:3, 3], rtol=1e-12)
        arguments = ["decode", str(tmp_path / "capture"), "--calibration", str(place)]
        app([*arguments, "--unit", str(unit), "--out", str(tmp_path / str(k))], standalone_mode=False)
        z = load_range_image(tmp_path / str(k) / "range.npz").z
        assert np.allclose(z, expected, atol=1e-5, equal_nan=True)
        with pytest.raises(ValueError, match=r"--code-step only with --calibration FILE\.xml of procam"):
            app([*arguments, "--code-step", "2", "--out", str(tmp_path / "no")], standalone_mode=False)
    with pytest.raises(ValueError, match="unit_m"):
        load_calibration(place, unit_m=0.0)
    save_calibration(rig, tmp_path / "rig.json")
    arguments = ["decode", str(tmp_path / "capture"), "--calibration", str(tmp_path / "rig.json")]
    with pytest.raises(ValueError, match="whose lengths are metres"):
        app([*arguments, "--unit", "0.001", "--out", str(tmp_path / "no")], standalone_mode=False)


def test_broken_files_of_opencv_are_refused(rendered, tmp_path):
    from rangesim.calibration.opencv_files import save_opencv, save_opencv_camera
    from rangesim.errors import FileFormatError
    from rangesim.rig.calibration_files import load_calibration

    _, rig = rendered
    place = tmp_path / "rig.yml"
    with pytest.raises(FileFormatError, match="does not exist"):
        load_calibration(place)
    save_opencv_camera(rig.camera, place)
    with pytest.raises(FileFormatError, match="a camera alone"):
        load_calibration(place)
    save_opencv(rig, place)
    text = place.read_text()
    for wrong in (
        "",
        "%YAML:1.0\n---\nR: [",
        "not yaml at all",
        text[: len(text) // 2],
        text.replace("rows: 3", "rows: 2"),
    ):
        place.write_text(wrong)
        with pytest.raises(FileFormatError):
            load_calibration(place)
    place.write_bytes(bytes(range(256)))
    with pytest.raises(FileFormatError):
        load_calibration(place)


@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
def test_a_matrix_of_another_size_than_stated_is_refused(rendered, tmp_path, suffix):
    import cv2

    from rangesim.errors import FileFormatError
    from rangesim.rig.calibration_files import load_calibration

    rig = rendered[1]
    K = [[rig.camera.fx, 0, rig.camera.cx - 0.5], [0, rig.camera.fy, rig.camera.cy - 0.5], [0, 0, 1]]
    right = {"rows": 3, "cols": 3, "dt": "d", "data": [float(x) for row in K for x in row]}

    def written(matrix):
        storage = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
        for name in ("camera", "projector"):
            storage.write(f"{name}_width", 640)
            storage.write(f"{name}_height", 480)
            storage.write(f"{name}_distortion", np.zeros((1, 5)))
        storage.write("R", np.eye(3))
        storage.write("T", np.array([[-0.1], [0], [0]]))
        storage.write("projector_matrix", np.array(K))
        storage.startWriteStruct("camera_matrix", cv2.FILE_NODE_MAP, "opencv-matrix")
        for key, value in matrix.items():
            if key == "data":
                storage.startWriteStruct("data", cv2.FILE_NODE_SEQ + cv2.FILE_NODE_FLOW)
                for number in value:
                    storage.write("", number)
                storage.endWriteStruct()
            else:
                storage.write(key, value)
        storage.endWriteStruct()
        place = tmp_path / f"rig{suffix}"
        place.write_text(storage.releaseAndGetString())
        return place

    found = load_calibration(written(right)).camera
    assert np.allclose([found.fx, found.fy, found.cx], [rig.camera.fx, rig.camera.fy, rig.camera.cx], rtol=1e-12)
    for key, values in {
        "rows": (None, -1, 0, 2, 2**30),
        "cols": (None, -1, 0, 4, 2**30),
        "data": (None, [], [1.0] * 8, [1.0] * 10, ["x"] * 9),
    }.items():
        for value in values:
            wrong = {k: v for k, v in {**right, key: value}.items() if v is not None}
            with pytest.raises(FileFormatError, match=r"camera_matrix|camera's matrix"):
                load_calibration(written(wrong))


def test_the_command_calibrates_a_camera_from_photographs(rendered, tmp_path, capsys):
    import cv2

    from rangesim.cli import app

    captures, rig = rendered
    for k, capture in enumerate(captures):
        frame = capture.frames[-2].astype(float)
        cv2.imwrite(str(tmp_path / f"photo_{k}.png"), np.clip(255 * frame / np.quantile(frame, 0.999), 0, 255))
    photos = [str(tmp_path / f"photo_{k}.png") for k in range(4)]
    options = ["--points", "9x6", "--spacing", "0.025", "--coefficients", "2"]
    app(["calibrate", *photos, *options, "--out", str(tmp_path / "camera.yml")], standalone_mode=False)
    assert "photo_3.png" in capsys.readouterr().out
    file = cv2.FileStorage(str(tmp_path / "camera.yml"), cv2.FILE_STORAGE_READ)
    K = file.getNode("camera_matrix").mat()
    assert abs(K[0, 0] / rig.camera.fx - 1) < 0.01
    assert abs(K[0, 2] + 0.5 - rig.camera.cx) < 5
    for more, says in (
        (["--out", str(tmp_path / "camera.json")], "for a camera alone"),
        (["--out", str(tmp_path / "c.yml"), "--projector", "512x384"], "folders of images with --projector"),
    ):
        with pytest.raises(ValueError, match=says):
            app(["calibrate", *photos, *options, *more], standalone_mode=False)
    cv2.imwrite(photos[2], np.zeros((100, 120), np.uint8))
    with pytest.raises(ValueError, match=r"photo_2.png: expected the size of .*photo_0.png, 480 x 360, got 120 x 100"):
        app(["calibrate", *photos, *options, "--out", str(tmp_path / "c.yml")], standalone_mode=False)
    cv2.imwrite(photos[2], np.full((360, 480), 100, np.uint8))
    with pytest.raises(ValueError, match=r"photo_2.png: expected a Checkerboard .* found none"):
        app(["calibrate", *photos, *options, "--out", str(tmp_path / "c.yml")], standalone_mode=False)
    assert not (tmp_path / "c.yml").exists()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (["--points", "9"], "COLUMNSxROWS"),
        (["--board", "charco"], "did you mean 'charuco'"),
        (["--board", "circles"], "--marker METRES"),
        (["--marker", "0.02"], "a checkerboard has none"),
        (["--spacing", "25"], "--spacing in metres"),
        (["--out", "rig.txt"], "end in .json"),
    ],
)
def test_what_the_command_refuses(change, says, tmp_path):
    from rangesim.cli import app

    arguments = [
        "calibrate",
        str(tmp_path),
        "--points",
        "9x6",
        "--spacing",
        "0.025",
        "--out",
        str(tmp_path / "rig.json"),
    ]
    with pytest.raises(ValueError, match=says):
        app([*arguments, *change], standalone_mode=False)
    assert not (tmp_path / "rig.json").exists()
