# SPDX-License-Identifier: Apache-2.0
"""Rendered captures of a board by a known rig: the input of a calibration, with the truth that it should find."""

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
"""Largest number of random poses that are tried until both devices see the whole board. With `default_rig` and a board
of 9 x 6 corners they see about one in four, and a try takes about a millisecond, so the search ends after 10
seconds."""

FILLS = (0.45, 0.8)
"""Smallest and largest width of the board over the poses, as a fraction of the width of the camera's image. A narrower
board says less about the lenses; a wider one leaves no room for tilts and for the edges of the image."""


@dataclass(frozen=True, eq=False)
class RenderedSet:
    """Captures of a board in several poses, with the true poses.

    Parameters
    ----------
    captures : k Captures, with the true rig.
    T_camera_board : (k, 4, 4) float64, maps coordinates of the board to the camera's, metres.
    """

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
    rig : Rig, with a projector of the size that the sensor codes. It stands still, and the board moves.
    sensor : Sensor that codes columns and rows of the projector, with its default detector.
    n : int, number of poses.
    tilt_deg : float, degrees, largest tilt about each of the board's axes.
    margin_px : float, pixels, least distance of the board's points from the edges of both images.
    spp : int, number of light paths per pixel. seed : int, of poses, light paths and noise.
    progress : function that is called with the number of captures made; None: no function is called.

    Raises
    ------
    ValueError
        Camera and projector see the whole board in no pose: they look at different places, or the margin is too wide.

    Examples
    --------
    >>> from rangesim import StructuredLight
    >>> from rangesim.calibration import Checkerboard
    >>> sensor = StructuredLight(800, 600, axes=("columns", "rows"))
    >>> rendered = render_set(Checkerboard(9, 6, 0.025), default_rig(), sensor)  # doctest: +SKIP
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
    """(4, 4) float64, T_camera_board, metres, of a random pose in which both devices see the whole board."""
    extent = max(board.size_m)
    T_projector_camera = np.linalg.inv(rig.T_camera_projector)
    for _ in range(TRIES):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("xyz", random.uniform(-tilt_deg, tilt_deg, 3), degrees=True).as_matrix()
        depth = extent / random.uniform(*FILLS) * rig.pinhole.fx / rig.camera.width
        pixel = random.uniform([0.0, 0.0], [rig.camera.width, rig.camera.height])
        T[:3, 3] = depth * rig.pinhole.directions(pixel) - T[:3, :3] @ board.points.mean(axis=0)
        at_projector = T_projector_camera @ T
        if _is_seen(board, rig.pinhole, T, margin_px) and _is_seen(board, rig.image_projector, at_projector, margin_px):
            return T
    raise ValueError(
        f"expected a pose of the board that camera and projector see as a whole, found none in {TRIES}; turn both to "
        "one place, take a smaller margin_px or less tilt."
    )


def _is_seen(board: Board, device: Intrinsics, T: Array, margin_px: float) -> bool:
    """Whether all points of the board are in the device's image, at least the margin away from its edges."""
    pixels = device.project(board.points @ T[:3, :3].T + T[:3, 3])
    inside = (pixels > margin_px) & (pixels < np.array([device.width, device.height]) - margin_px)
    return bool(inside.all())


def default_rig(width: int = 640, height: int = 480, projector_size: tuple[int, int] = (800, 600)) -> Rig:
    """A camera and a projector 10 cm beside it, turned to each other, both with the distortion of cheap lenses.

    Examples
    --------
    >>> round(default_rig().baseline_m, 3)
    0.1
    """
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
