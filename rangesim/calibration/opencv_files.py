# SPDX-License-Identifier: Apache-2.0
"""Writing and reading of a rig or a camera as YAML or XML files of OpenCV (`cv2.FileStorage`).

The keys and conventions are those of OpenCV's stereo calibration.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from pcgraph.plumbing.plain_files import read_file, sealed, unsealed, write_file
from rangesim.errors import FileFormatError
from rangesim.geometry.camera_matrix import calibration_matrix
from rangesim.rig import Intrinsics, Rig, pose
from rangesim.rig.calibration_files import SEAL
from rangesim.settings.bounds import Bounds, check_number
from rangesim.settings.config import brief

SUFFIXES = (".yml", ".yaml", ".xml")
"""Ends of the names of files that OpenCV writes as YAML or XML."""
MAX_BYTES = 1_000_000
"""Largest size of a file that is read, bytes. A calibration needs about 2000; the limit keeps OpenCV's parser away from
files that are something else."""


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


def load_opencv(path: str | Path, unit_m: float = 1.0) -> Rig:
    """The rig in a file that `save_opencv` wrote, or in another file of OpenCV with the same keys.

    E and F are not read.

    Parameters
    ----------
    path : the YAML or XML file.
    unit_m : unit of length of T, metres; 0.001 if the board was measured in millimetres.

    Raises
    ------
    ValueError
        `unit_m` is not positive.
    FileFormatError
        The file is missing or broken, or lacks a matrix, as the file of a camera alone does.
    """
    import cv2

    check_number("unit_m", unit_m, Bounds("metres per unit", 1e-9, 1e6))
    path = Path(path)
    text = read_file(path, FileFormatError)
    if len(text) > MAX_BYTES:
        raise FileFormatError(f"{path}: expected a calibration of at most {MAX_BYTES} bytes, got {len(text)}.")
    try:
        storage = cv2.FileStorage(text.decode(), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        T_projector_camera = np.eye(4)
        T_projector_camera[:3, :3] = _matrix(storage, "R", (3, 3))
        T_projector_camera[:3, 3] = unit_m * _matrix(storage, "T", (3, 1))[:, 0]
        camera, projector = (_device(storage, name) for name in ("camera", "projector"))
        return Rig(camera, projector, T_camera_projector=np.linalg.inv(pose(T_projector_camera, "(R, T)")))
    except (cv2.error, UnicodeDecodeError, SystemError) as error:
        raise FileFormatError(f"{path}: expected a file of OpenCV: {brief(error)}.") from error
    except ValueError as error:
        raise FileFormatError(f"{path}: {error}") from error


def _device(storage: Any, name: str) -> Intrinsics:
    """The lens of the device `name`, "camera" or "projector", in a file; ValueError if an entry is wrong."""
    sizes = [storage.getNode(f"{name}_{side}") for side in ("width", "height")]
    if not all(node.isInt() for node in sizes):
        raise ValueError(f"expected {name}_width and {name}_height as whole numbers.")
    K = _matrix(storage, f"{name}_matrix", (3, 3))
    if K[0, 1] != 0:
        raise ValueError(f"expected {name}_matrix without skew, got {K[0, 1]:g}.")
    coefficients = _matrix(storage, f"{name}_distortion", (1, 5))[0]
    width, height = (int(node.real()) for node in sizes)
    centre = K[0, 2] + 0.5, K[1, 2] + 0.5
    return Intrinsics(width, height, K[0, 0], K[1, 1], *centre, tuple(float(k) for k in coefficients))


def _matrix(storage: Any, name: str, shape: tuple[int, int]) -> np.ndarray:
    """The matrix `name` of a file, float64; ValueError if it is missing, of another shape or not finite."""
    node = storage.getNode(name)
    value = node.mat() if _is_matrix(node, shape) else None
    if value is None or value.shape != shape or not np.isfinite(value).all():
        raise ValueError(f"expected a matrix {name!r} of {shape[0]} x {shape[1]} finite numbers.")
    return np.asarray(value, dtype=np.float64)


def _is_matrix(node: Any, shape: tuple[int, int]) -> bool:
    """Whether a node has the entries rows, cols, dt and data of a matrix of this shape.

    OpenCV itself allocates memory by these entries and checks little: without cols, or with cols -1, it writes beyond
    its memory.
    """
    if not node.isMap():
        return False
    rows, cols, dt, data = (node.getNode(key) for key in ("rows", "cols", "dt", "data"))
    if not (rows.isInt() and cols.isInt() and (int(rows.real()), int(cols.real())) == shape):
        return False
    if not (dt.isString() and re.fullmatch("1?[ucwsifd]", dt.string()) and data.isSeq()):
        return False
    return data.size() == shape[0] * shape[1] and all(
        data.at(k).isInt() or data.at(k).isReal() for k in range(data.size())
    )


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
