# SPDX-License-Identifier: Apache-2.0
"""A rig as OpenCV's stereo calibration has it, in a YAML or XML file that `cv2.FileStorage` reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pcgraph.plain_files import write_file
from rangesim.errors import FileFormatError
from rangesim.geometry.camera_matrix import calibration_matrix
from rangesim.rig import Intrinsics, Rig

SUFFIXES = (".yml", ".yaml", ".xml")


def save_opencv(rig: Rig, path: str | Path) -> None:
    """Write a rig for OpenCV: pixel centres at integers, X_projector = R X_camera + T, metres.

    Keys: camera_width, camera_height, camera_matrix (3, 3), camera_distortion (1, 5) of k1, k2, p1, p2, k3; the same of
    the projector; R (3, 3), T (3, 1); and E, F of camera and projector, x_p^T F x_c = 0.

    Raises
    ------
    ValueError
        The name does not end in .yml, .yaml or .xml.
    FileFormatError
        The file cannot be written.
    """
    import cv2

    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"expected a file name that ends in {', '.join(SUFFIXES)}, got {path.name!r}.")
    T_projector_camera = np.linalg.inv(rig.T_camera_projector)
    R, t = T_projector_camera[:3, :3], T_projector_camera[:3, 3:]
    x, y, z = t[:, 0]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ R
    matrices = {}
    storage = cv2.FileStorage(path.suffix.lower(), cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for name, device in (("camera", rig.camera), ("projector", rig.projector)):
        matrices[name] = _opencv_matrix(device)
        storage.write(f"{name}_width", device.width)
        storage.write(f"{name}_height", device.height)
        storage.write(f"{name}_matrix", matrices[name])
        storage.write(f"{name}_distortion", np.array([device.coefficients]))
    fundamental = np.linalg.inv(matrices["projector"]).T @ essential @ np.linalg.inv(matrices["camera"])
    for name, value in (("R", R), ("T", t), ("E", essential), ("F", fundamental)):
        storage.write(name, np.ascontiguousarray(value))
    write_file(path, storage.releaseAndGetString().encode(), FileFormatError, make_parents=True)


def _opencv_matrix(device: Intrinsics) -> np.ndarray:
    """(3, 3) K with pixel centres at integers."""
    K = calibration_matrix(device)
    K[:2, 2] -= 0.5
    return K
