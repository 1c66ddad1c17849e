# SPDX-License-Identifier: Apache-2.0
"""Writing of a rig or a camera as YAML or XML files of OpenCV (`cv2.FileStorage`).

The conventions are those of OpenCV's stereo calibration. `rangesim.rig.calibration_files` reads these files and others.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pcgraph.plumbing.plain_files import sealed, unsealed, write_file
from rangesim.errors import FileFormatError
from rangesim.geometry.camera_matrix import calibration_matrix
from rangesim.rig import Intrinsics, Rig
from rangesim.rig.calibration_files import SEAL

SUFFIXES = (".yml", ".yaml", ".xml")
"""Ends of the names of files that OpenCV writes as YAML or XML."""


def save_opencv(rig: Rig, path: str | Path) -> None:
    """Write a rig for OpenCV, with pixel centres at integers, and R and T of X_projector = R X_camera + T in metres.

    The keys are camera_width, camera_height, camera_matrix (3, 3) and camera_distortion (1, 5) with k1, k2, p1, p2, k3;
    the same for the projector; R (3, 3) and T (3, 1); and the essential matrix E (3, 3) and the fundamental matrix F
    (3, 3) with x_projector^T F x_camera = 0.

    Raises
    ------
    ValueError
        The name does not end in .yml, .yaml or .xml.
    FileFormatError
        The file cannot be written.
    """
    T_projector_camera = np.linalg.inv(rig.T_camera_projector)
    R, t = T_projector_camera[:3, :3], T_projector_camera[:3, 3:]
    x, y, z = t[:, 0]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ R
    to_camera, to_projector = (np.linalg.inv(_opencv_matrix(device)) for device in (rig.pinhole, rig.image_projector))
    fundamental = to_projector.T @ essential @ to_camera
    matrices = {"R": R, "T": t, "E": essential, "F": fundamental}
    _write(path, {**_entries("camera", rig.pinhole), **_entries("projector", rig.image_projector), **matrices})


def save_opencv_camera(camera: Intrinsics, path: str | Path) -> None:
    """Write a camera for OpenCV, with the same keys and errors as the camera of a rig; see `save_opencv`."""
    _write(path, _entries("camera", camera))


def _entries(name: str, device: Intrinsics) -> dict[str, Any]:
    """The entries of a file for the device `name`, "camera" or "projector"."""
    return {
        f"{name}_width": device.width,
        f"{name}_height": device.height,
        f"{name}_matrix": _opencv_matrix(device),
        f"{name}_distortion": np.array([device.coefficients]),
    }


def _write(path: str | Path, entries: dict[str, Any]) -> None:
    """Write numbers and matrices to a file of OpenCV, with a seal by which `rangesim calibrate` recognises it."""
    import cv2

    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"expected a file name that ends in {', '.join(SUFFIXES)}, got {path.name!r}.")
    storage = cv2.FileStorage(path.suffix.lower(), cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for name, value in entries.items():
        storage.write(name, np.ascontiguousarray(value) if isinstance(value, np.ndarray) else value)
    storage.writeComment(unsealed(SEAL))
    content = sealed(storage.releaseAndGetString().encode(), SEAL, at_end=True)
    write_file(path, content, FileFormatError, make_parents=True)


def _opencv_matrix(device: Intrinsics) -> np.ndarray:
    """(3, 3) float64, the matrix K of a device with pixel centres at integers."""
    K = calibration_matrix(device)
    K[:2, 2] -= 0.5
    return K
