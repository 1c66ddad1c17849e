# SPDX-License-Identifier: Apache-2.0
"""A rig as OpenCV's stereo calibration has it, or a camera, in a YAML or XML file that `cv2.FileStorage` reads."""

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
MAX_BYTES = 1_000_000
"""Of a file that is read."""


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
    T_projector_camera = np.linalg.inv(rig.T_camera_projector)
    R, t = T_projector_camera[:3, :3], T_projector_camera[:3, 3:]
    x, y, z = t[:, 0]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ R
    to_camera, to_projector = (np.linalg.inv(_opencv_matrix(device)) for device in (rig.camera, rig.projector))
    fundamental = to_projector.T @ essential @ to_camera
    matrices = {"R": R, "T": t, "E": essential, "F": fundamental}
    _write(path, {**_entries("camera", rig.camera), **_entries("projector", rig.projector), **matrices})


def save_opencv_camera(camera: Intrinsics, path: str | Path) -> None:
    """Write a camera for OpenCV, with the keys that it has in the file of a rig; see `save_opencv`."""
    _write(path, _entries("camera", camera))


def load_opencv(path: str | Path, unit_m: float = 1.0) -> Rig:
    """The rig that `save_opencv` wrote, or whoever else with the same keys; E and F are not looked at.

    `unit_m`, metres, is the unit of length of T: 0.001 where the board was measured in millimetres.

    Raises
    ------
    ValueError
        `unit_m` is not positive.
    FileFormatError
        The file is missing or broken, or lacks a matrix: that of a camera alone is no rig.
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
        raise FileFormatError(f"{path}: expected a file of OpenCV's: {brief(error)}.") from error
    except ValueError as error:
        raise FileFormatError(f"{path}: {error}") from error


def _device(storage: Any, name: str) -> Intrinsics:
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
    node = storage.getNode(name)
    value = node.mat() if _is_matrix(node, shape) else None
    if value is None or value.shape != shape or not np.isfinite(value).all():
        raise ValueError(f"expected a matrix {name!r} of {shape[0]} x {shape[1]} finite numbers.")
    return np.asarray(value, dtype=np.float64)


def _is_matrix(node: Any, shape: tuple[int, int]) -> bool:
    """Whether a node has rows, cols, dt and data of a matrix of this shape.

    OpenCV makes room for what they say and checks little: without cols, or with -1, it writes beyond its memory.
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
    return {
        f"{name}_width": device.width,
        f"{name}_height": device.height,
        f"{name}_matrix": _opencv_matrix(device),
        f"{name}_distortion": np.array([device.coefficients]),
    }


def _write(path: str | Path, entries: dict[str, Any]) -> None:
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
    """(3, 3) K with pixel centres at integers."""
    K = calibration_matrix(device)
    K[:2, 2] -= 0.5
    return K
