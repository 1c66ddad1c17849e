# SPDX-License-Identifier: Apache-2.0
"""A set of captures of a board by a rig that is known: what a calibration should find, with its truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from rangesim.calibration.boards import Board
from rangesim.capture import Capture
from rangesim.capture.exposure import expose
from rangesim.geometry.correspondences import Array
from rangesim.rig import Intrinsics, Rig
from rangesim.sensor import Sensor

TRIES = 10000
FILLS = (0.45, 0.8)
"""Of the smaller of the two images that a board is wide, from one pose to another."""


@dataclass(frozen=True, eq=False)
class RenderedSet:
    """captures : of the board in each pose, with the true rig. T_camera_board : (k, 4, 4) metres, the true poses."""

    captures: tuple[Capture, ...]
    T_camera_board: Array


def render_set(
    board: Board,
    rig: Rig,
    sensor: Sensor,
    n: int = 12,
    *,
    tilt_deg: float = 35.0,
    margin_px: float = 12.0,
    spp: int = 16,
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> RenderedSet:
    """Captures of a board in random poses that camera and projector see as a whole, with the detector's noise.

    Parameters
    ----------
    rig : its projector is of the sensor's size. It stands still, the boards move.
    sensor : with columns and rows.
    tilt_deg : largest tilt about each of the board's axes.
    margin_px : least distance of its points from the edges of both images.
    progress : called with the number of captures made.

    Raises
    ------
    ValueError
        No pose is seen by both as a whole: they look at different places, or the margin is too wide.
    """
    from rangesim.instrument.transport import transport
    from rangesim.scene import load_scene

    random = np.random.default_rng(seed)
    poses = np.stack([_pose(board, rig, tilt_deg, margin_px, random) for _ in range(n)])
    captures = []
    for k, T in enumerate(poses):
        scene = load_scene(board.scene(rig.T_world_camera @ T, rig.camera.width, rig.camera.height))
        signals = transport(scene, rig, [sensor], spp=spp, seed=seed + k)
        captures.append(expose(signals, sensor, sensor.default_detector, seed=seed + k))
        if progress is not None:
            progress(k + 1)
    return RenderedSet(tuple(captures), poses)


def _pose(board: Board, rig: Rig, tilt_deg: float, margin_px: float, random: np.random.Generator) -> Array:
    """(4, 4) T_camera_board of a board that both devices see."""
    extent = max(board.size_m)
    T_projector_camera = np.linalg.inv(rig.T_camera_projector)
    for _ in range(TRIES):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("xyz", random.uniform(-tilt_deg, tilt_deg, 3), degrees=True).as_matrix()
        depth = extent / random.uniform(*FILLS) * rig.camera.fx / rig.camera.width
        pixel = random.uniform([0.0, 0.0], [rig.camera.width, rig.camera.height])
        T[:3, 3] = depth * rig.camera.directions(pixel) - T[:3, :3] @ board.points.mean(axis=0)
        at_projector = T_projector_camera @ T
        if _is_seen(board, rig.camera, T, margin_px) and _is_seen(board, rig.projector, at_projector, margin_px):
            return T
    raise ValueError(
        f"expected a pose of the board that camera and projector see as a whole, found none in {TRIES}; turn them to "
        "one place, take a smaller margin_px or less tilt."
    )


def _is_seen(board: Board, device: Intrinsics, T: Array, margin_px: float) -> bool:
    pixels = device.project(board.points @ T[:3, :3].T + T[:3, 3])
    inside = (pixels > margin_px) & (pixels < np.array([device.width, device.height]) - margin_px)
    return bool(inside.all())


def default_rig(width: int = 640, height: int = 480, projector_size: tuple[int, int] = (800, 600)) -> Rig:
    """A camera and a projector 10 cm beside it, turned to each other, both with the distortion of cheap lenses."""
    camera = Intrinsics.from_fov(width, height, 50.0)
    projector = Intrinsics.from_fov(*projector_size, 46.0)
    T_camera_projector = np.eye(4)
    T_camera_projector[:3, :3] = Rotation.from_euler("y", -9.0, degrees=True).as_matrix()
    T_camera_projector[:3, 3] = (0.1, 0.002, 0.004)
    return Rig(
        replace(
            camera, cx=camera.cx + 3.0, cy=camera.cy - 2.0, fy=1.002 * camera.fy, distortion=(-0.1, 0.05, 1e-3, -1e-3)
        ),
        replace(projector, cy=projector.cy + 15.0, distortion=(-0.05, 0.02)),
        T_camera_projector=T_camera_projector,
    )
