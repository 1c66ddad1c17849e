# SPDX-License-Identifier: Apache-2.0
"""Rigs in calibration files: the OpenCV XML of procam-calibration, and a JSON format of our own.

The two conventions differ. OpenCV has pixel centres at integer coordinates; here they lie at integer + 0.5, so
principal points move by 0.5 pixels. The stereo calibration of OpenCV maps camera coordinates to projector coordinates,
X_projector = R X_camera + T, usually in millimetres; `T_camera_projector` is the inverse, in metres.
"""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pcgraph.plumbing.plain_files import sealed, unsealed, write_file
from rangesim.errors import FileFormatError
from rangesim.files.text_files import check_xml, read_json
from rangesim.rig import Intrinsics, Rig
from rangesim.settings.bounds import Bounds, check_number, whole
from rangesim.settings.config import shown, to_dict

SEAL = "rangesim-calibration"
"""Mark of a file that `rangesim calibrate` wrote and may replace; see `pcgraph.plumbing.plain_files.sealed`."""
MAX_NUMBER = 1e9
"""Largest absolute value of a number in an XML file, whatever its unit (pixels, millimetres, coefficients): far above
any real one, so that only broken files are refused."""
_MATRIX_SIZES = {
    "img_shape": 2,
    "cam_int": 9,
    "cam_dist": 5,
    "proj_int": 9,
    "proj_dist": 5,
    "roration": 9,  # procam-calibration spells it so
    "translation": 3,
}
"""Number of values in each matrix of the XML file, by its name there."""


def load_calibration(
    path: str | Path,
    projector_size: tuple[int, int] | None = None,
    code_step: int = 1,
    unit_m: float = 1e-3,
) -> Rig:
    """The rig that a calibration file holds.

    Parameters
    ----------
    path : a `.json` file that `save_calibration` wrote, or an `.xml` file (OpenCV FileStorage) of
        kamino410/procam-calibration.
    projector_size : (width, height) of the coded area, in cells of `code_step` pixels. Required for XML files, which do
        not hold it.
    code_step : int, projector pixels per cell of the Gray code during the calibration (`graycode_step` of
        procam-calibration). The projector of the rig has these cells as its pixels.
    unit_m : float, metres per unit of length in an XML file, which is the unit of its chessboard squares; default
        millimetres.

    Raises
    ------
    FileFormatError
        The file is missing, broken, or does not hold a calibration.
    ValueError
        `code_step` or `unit_m` is not positive, or `projector_size` is missing for an XML file.
    """
    path = Path(path)
    if not path.is_file():
        raise FileFormatError(f"{path} does not exist; expected a calibration file (.xml or .json).")
    if path.suffix.lower() != ".xml":
        return _load_json(path)
    check_number("code_step", code_step, whole(1, "projector"))
    check_number("unit_m", unit_m, Bounds("metres per unit", 1e-9, 1e6))
    if projector_size is None:
        raise ValueError(f"expected projector_size (width, height) in pixels: {path} does not hold it.")
    if not isinstance(projector_size, Sequence) or len(projector_size) != 2:
        raise ValueError(f"expected projector_size (width, height) in pixels, got {shown(projector_size)}.")
    for name, size in zip(("projector width", "projector height"), projector_size, strict=True):
        check_number(name, size, whole(1, "projector"))
    values = _read_opencv(path)
    try:
        return _rig(values, projector_size, code_step, unit_m)
    except ValueError as error:
        raise FileFormatError(f"{path}: {error}") from error


def save_calibration(rig: Rig, path: str | Path) -> None:
    """Write a rig as JSON; `load_calibration` reads it back equal.

    The key "seal" holds the SHA-256 of the file. If you correct the file by hand, the hash no longer matches, and no
    command overwrites the file any more.

    Examples
    --------
    >>> import tempfile
    >>> rig = Rig(Intrinsics.from_fov(640, 480, 50.0), Intrinsics.from_fov(1280, 800, 60.0))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     save_calibration(rig, f"{folder}/rig.json")
    ...     load_calibration(f"{folder}/rig.json") == rig
    True
    """
    text = json.dumps({**to_dict(rig), "seal": unsealed(SEAL)}, indent=1) + "\n"
    write_file(Path(path), sealed(text.encode(), SEAL, at_end=True), FileFormatError, make_parents=True)


def _load_json(path: Path) -> Rig:
    try:
        settings = read_json(path)
        if isinstance(settings, dict):
            settings.pop("seal", None)
        return Rig.from_dict(settings)
    except ValueError as error:
        raise FileFormatError(f"{path}: {error}") from error


def _read_opencv(path: Path) -> dict[str, np.ndarray]:
    check_xml(path)
    root = ET.parse(path).getroot()
    values = {}
    for name, size in _MATRIX_SIZES.items():
        text = root.findtext(f"{name}/data")
        if text is None:
            raise FileFormatError(f"{path}: expected a matrix {name!r} as procam-calibration writes it, found none.")
        try:
            values[name] = np.array(text.split(), dtype=np.float64)
        except ValueError as error:
            raise FileFormatError(f"{path}: matrix {name!r} does not hold numbers.") from error
        if not (np.abs(values[name]) < MAX_NUMBER).all():
            raise FileFormatError(
                f"{path}: expected numbers below {MAX_NUMBER:g} in {name!r}, got {shown(values[name].tolist())}."
            )
        if values[name].size != size:
            raise FileFormatError(f"{path}: expected {size} numbers in {name!r}, got {values[name].size}.")
    return values


def _rig(values: dict[str, np.ndarray], projector_size: tuple[int, int], code_step: int, unit_m: float) -> Rig:
    if (values["img_shape"] % 1 != 0).any():
        raise ValueError(f"expected img_shape to hold whole numbers, got {values['img_shape'].tolist()}.")
    height, width = (int(n) for n in values["img_shape"])
    projector_from_camera = np.eye(4)
    projector_from_camera[:3, :3] = _nearest_rotation(values["roration"].reshape(3, 3))
    projector_from_camera[:3, 3] = values["translation"] * unit_m
    in_cells = values["proj_int"] / np.array([code_step] * 6 + [1] * 3)
    return Rig(
        camera=_intrinsics(width, height, values["cam_int"], values["cam_dist"]),
        projector=_intrinsics(*projector_size, in_cells, values["proj_dist"]),
        T_camera_projector=np.linalg.inv(projector_from_camera),
    )


def _intrinsics(width: int, height: int, matrix: np.ndarray, distortion: np.ndarray) -> Intrinsics:
    fx, _, cx, _, fy, cy = (float(v) for v in matrix[:6])
    return Intrinsics(width, height, fx, fy, cx + 0.5, cy + 0.5, tuple(float(v) for v in distortion))


def _nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    u, scales, vt = np.linalg.svd(matrix)
    if not np.allclose(scales, 1, atol=0.01):
        raise ValueError(f"expected 'roration' to hold a rotation matrix, got {matrix.tolist()}.")
    return np.asarray(u @ vt)
