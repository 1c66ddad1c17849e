# SPDX-License-Identifier: Apache-2.0
"""Rigs in calibration files: OpenCV's K, D, R and T in XML, YAML or JSON, by any usual names, and a JSON of our own.

The two conventions differ. OpenCV has pixel centres at integer coordinates; here they lie at integer + 0.5, so
principal points move by 0.5 pixels. The stereo calibration of OpenCV maps camera coordinates to projector coordinates,
X_projector = R X_camera + T, often in millimetres; `T_camera_projector` is the inverse, in metres.

OpenCV prescribes no names. `CAMERA`, `PROJECTOR`, `ROTATION` and `TRANSLATION` list those of OpenCV's samples, ROS,
procam-calibration, slstudio, `rangesim calibrate` and common scripts.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcgraph.plumbing.plain_files import sealed, unsealed, write_file
from rangesim.errors import FileFormatError
from rangesim.files.storage_files import SUFFIXES, read_storage
from rangesim.rig import Intrinsics, Rig
from rangesim.settings.bounds import Bounds, check_number, whole
from rangesim.settings.config import shown, to_dict

SEAL = "rangesim-calibration"
"""Mark of a file that `rangesim calibrate` wrote and may replace; see `pcgraph.plumbing.plain_files.sealed`."""
MAX_NUMBER = 1e9
"""Largest absolute value of a number in a file, whatever its unit (pixels, millimetres, coefficients): far above any
real one, so that only broken files are refused."""
LEAST_MM = 10.0
"""Least length of T that is taken as millimetres if nothing states the unit. A rig's baseline is 10 mm to 10 m, so a
longer T cannot be metres, and a shorter one cannot be millimetres."""
UNITS_M = {"m": 1.0, "metre": 1.0, "meter": 1.0, "cm": 1e-2, "mm": 1e-3, "millimetre": 1e-3, "millimeter": 1e-3,
           "inch": 0.0254}  # fmt: skip
"""Metres of the units that a file may name under `unit`."""
CENTIMETRES = (1.0, 50.0)
"""Range of lengths of T that may be centimetres as well, if nothing states the unit: a baseline of 1 cm to half a
metre."""
MAX_OFF_CENTRE = 0.24
"""Largest distance of a principal point from the centre of the image, as a fraction of its size, that needs no word.
In a calibration at half the size it is 0.25; the largest in a real calibration that serves was 0.22. Projectors have
more along their height, because they shine upward or downward."""
ROTATION_TOLERANCE = 2e-3
"""Largest difference of a singular value of R from 1. A rotation written with three decimals is off by at most 1.5e-3;
it is replaced by the nearest rotation."""
MAX_SKEW = 1e-6
"""Largest skew of a K, as a fraction of its focal length, that counts as rounding: a thousandth of a pixel at most."""
COEFFICIENT_COUNTS = (0, 2, 4, 5, 8, 12, 14)
"""Numbers of coefficients of distortion that OpenCV knows, and 2 for k1 and k2 alone."""


class DeviceNames(NamedTuple):
    """Names under which files keep the parts of a device. Names of three letters or less are told by their case.

    matrix : K. distortion : its coefficients. width, height : pixels. size : (width, height). shape : (height, width).
    """

    matrix: tuple[str, ...]
    distortion: tuple[str, ...]
    width: tuple[str, ...]
    height: tuple[str, ...]
    size: tuple[str, ...]
    shape: tuple[str, ...]


def _names(words: Sequence[str], number: int, letter: str) -> DeviceNames:
    """Names of a device that is called by one of `words`, is the first or second of two, or has an index letter."""
    return DeviceNames(
        (
            *(f"K{number}", f"M{number}", f"K{letter}", f"cameraMatrix{number}", f"mtx{number}", f"intrinsics{number}"),
            *(form.format(w) for w in words for form in ("{}_matrix", "{}_int", "{}_K", "K_{}", "{}_mtx", "mtx_{}")),
            *(form.format(w) for w in words for form in ("{}_intrinsics", "{}_intrinsic", "{}_intrinsic_matrix")),
            *(form.format(w) for w in words for form in ("{}_camera_matrix", "{}.matrix", "intrinsics_{}")),
        ),
        (
            *(f"D{number}", f"k{letter}", f"distCoeffs{number}", f"dist{number}", f"distortion{number}"),
            *(form.format(w) for w in words for form in ("{}_distortion", "{}_dist", "{}_D", "{}_kc", "D_{}")),
            *(form.format(w) for w in words for form in ("{}_dist_coeffs", "{}_distortion_coefficients", "{}_coeffs")),
            *(form.format(w) for w in words for form in ("{}_distortion_coeffs", "dist_{}", "dist_coeffs_{}")),
            *(f"distortion_{w}" for w in words),
        ),
        tuple(f"{word}_width" for word in words),
        tuple(f"{word}_height" for word in words),
        tuple(f"{word}_{size}" for word in words for size in ("size", "resolution", "image_size")),
        tuple(f"{word}_shape" for word in words),
    )


def _and(names: DeviceNames, **more: tuple[str, ...]) -> DeviceNames:
    return names._replace(**{part: (*getattr(names, part), *others) for part, others in more.items()})


CAMERA = _and(
    _names(("camera", "cam", "camera1", "cam1"), 1, "c"),
    matrix=("mtx", "intrinsic_matrix", "K"),
    distortion=("dist_coeffs", "distortion_coefficients", "distortion", "dist", "D"),
    width=("image_width", "frame_width", "img_width", "width"),
    height=("image_height", "frame_height", "img_height", "height"),
    size=("image_size", "img_size", "frame_size", "resolution"),
    shape=("img_shape", "image_shape"),
)
"""Names of the parts of the camera; those that name no device are the camera's."""
PROJECTOR = _and(
    _names(("projector", "proj", "prj", "camera2", "cam2"), 2, "p"),
    width=("screen_res_x", "disp_width", "display_width", "screen_width"),
    height=("screen_res_y", "disp_height", "display_height", "screen_height"),
)
"""Names of the parts of the projector, which is the second device of a stereo calibration."""
PROCAM_ROTATION = "roration"
"""Name of R in files of kamino410/procam-calibration, which spells it so. They are in millimetres."""
ROTATION = (
    "R",
    "Rp",
    PROCAM_ROTATION,
    "rotation",
    "rotation_matrix",
    "rotation_vector",
    "rvec",
    "R_stereo",
    "stereo_R",
)
"""Names of R, a matrix or a rotation vector."""
TRANSLATION = ("T", "Tp", "t", "translation", "translation_vector", "tvec", "stereo_T")
"""Names of T."""


@dataclass(frozen=True)
class DeviceCalibration:
    """K and distortion of a device in a file, in OpenCV's convention; `size` is (width, height), None: not stated."""

    matrix: np.ndarray
    coefficients: tuple[float, ...]
    size: tuple[int, int] | None

    def intrinsics(self, size: tuple[int, int] | None, name: str) -> Intrinsics:
        """The intrinsics, with `size` where the file states none; ValueError if neither does."""
        width_height = self.size or size
        if width_height is None:
            raise ValueError(f"expected {name}_size (width, height) in pixels, which the file does not hold.")
        (fx, _, cx), (_, fy, cy) = self.matrix[:2].tolist()
        return Intrinsics(*width_height, fx, fy, cx + 0.5, cy + 0.5, self.coefficients)


@dataclass(frozen=True)
class StoredCalibration:
    """Contents of a calibration file. The sizes of the images may be missing; `rig` takes them from elsewhere.

    camera, projector : DeviceCalibration; projector None: the file holds a camera alone.
    T_camera_projector : (4, 4) float64, metres; None likewise. own : the Rig of a JSON file of our own, else None.
    findings : sentences on what the reader assumed.
    """

    camera: DeviceCalibration | None
    projector: DeviceCalibration | None = None
    T_camera_projector: np.ndarray | None = None
    own: Rig | None = None
    findings: tuple[str, ...] = ()

    @property
    def projector_size(self) -> tuple[int, int] | None:
        """(width, height) of the projector in pixels; None: the file does not state it."""
        if self.own is not None:
            return self.own.projector.width, self.own.projector.height
        return None if self.projector is None else self.projector.size

    @property
    def camera_size(self) -> tuple[int, int] | None:
        """(width, height) of the camera's images in pixels; None: the file does not state it."""
        if self.own is not None:
            return self.own.camera.width, self.own.camera.height
        return None if self.camera is None else self.camera.size

    def rig(self, camera_size: tuple[int, int] | None = None, projector_size: tuple[int, int] | None = None) -> Rig:
        """The rig. `camera_size` and `projector_size`, (width, height), serve where the file states none.

        Raises
        ------
        ValueError
            A size is missing, or the file holds a camera alone.
        """
        if self.own is not None:
            return self.own
        assert self.camera is not None
        if self.projector is None or self.T_camera_projector is None:
            raise ValueError("expected the calibration of a camera and a projector, with R and T, got a camera alone.")
        camera = self.camera.intrinsics(camera_size, "camera")
        return Rig(camera, self.projector.intrinsics(projector_size, "projector"), np.eye(4), self.T_camera_projector)

    def rig_of_camera(self, camera_size: tuple[int, int] | None = None) -> Rig:
        """The rig of a camera whose light comes from the camera's own place, as nearly in time of flight."""
        if self.own is not None or self.projector is not None:
            return self.rig(camera_size, camera_size)
        assert self.camera is not None
        camera = self.camera.intrinsics(camera_size, "camera")
        return Rig(camera, camera)


def read_calibration(path: str | Path, code_step: int = 1, unit_m: float | None = None) -> StoredCalibration:
    """The contents of a calibration file (.xml, .yml, .yaml or .json).

    Parameters
    ----------
    path : a JSON file that `save_calibration` wrote; or a file with the results of OpenCV's stereo calibration of
        camera and projector, or of a camera alone.
    code_step : int, projector pixels per cell of the Gray code during a calibration by procam-calibration. The
        projector of the rig has these cells as its pixels.
    unit_m : float, metres per unit of length of T. None: the unit that the file names; metres in files of
        `rangesim calibrate`, millimetres in those of procam-calibration, and else as `LEAST_MM` says.

    Raises
    ------
    FileFormatError
        The file is missing, broken, or does not hold a calibration.
    ValueError
        `code_step` or `unit_m` is not positive, or given for a file that has no use for it.
    """
    path = Path(path)
    check_number("code_step", code_step, whole(1, "projector"))
    if unit_m is not None:
        check_number("unit_m", unit_m, Bounds("metres per unit", 1e-9, 1e6))
    if not path.is_file():
        raise FileFormatError(f"{path} does not exist; expected a calibration file ({', '.join(SUFFIXES)}).")
    data = read_storage(path)
    entries = dict(_entries(data))
    foreign = (CAMERA.matrix, PROJECTOR.matrix, ROTATION, TRANSLATION)
    is_own = path.suffix.lower() == ".json" and not any(_find(entries, aliases) for aliases in foreign)
    if code_step != 1 and PROCAM_ROTATION not in entries:
        raise ValueError("expected --code-step only with --calibration FILE.xml of procam-calibration.")
    if is_own:
        if unit_m is not None:
            raise ValueError(
                f"expected no --unit for {path}, whose lengths are metres; --unit is for files of OpenCV with K, D, R "
                "and T."
            )
        return StoredCalibration(None, own=_own_rig(path, data))
    try:
        return _stored(path, entries, code_step, unit_m)
    except ValueError as error:
        raise FileFormatError(f"{path}: {error}") from error


def load_calibration(
    path: str | Path,
    projector_size: tuple[int, int] | None = None,
    code_step: int = 1,
    unit_m: float | None = None,
    camera_size: tuple[int, int] | None = None,
) -> Rig:
    """The rig that a calibration file holds.

    Parameters
    ----------
    path, code_step, unit_m : as for `read_calibration`.
    projector_size, camera_size : (width, height) in pixels (of a procam-calibration with `code_step`, in cells), for
        files that do not hold them.

    Raises
    ------
    FileFormatError
        The file is missing, broken, or does not hold the calibration of a camera and a projector.
    ValueError
        `code_step` or `unit_m` is not positive, or has no use; or a size is missing or wrong.

    Examples
    --------
    >>> import tempfile
    >>> text = '''{"K1": [[500, 0, 319.5], [0, 500, 239.5], [0, 0, 1]], "D1": [0, 0, 0, 0, 0], "T": [-0.2, 0, 0],
    ... "K2": [[900, 0, 511.5], [0, 900, 383.5], [0, 0, 1]], "D2": [0, 0, 0, 0, 0], "R": [0, 0, 0]}'''
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = Path(f"{folder}/stereo.json").write_text(text)
    ...     rig = load_calibration(f"{folder}/stereo.json", (1024, 768), camera_size=(640, 480))
    >>> rig.camera.cx, rig.baseline_m
    (320.0, 0.2)
    """
    for name, size in (("projector", projector_size), ("camera", camera_size)):
        if size is None:
            continue
        if not isinstance(size, Sequence) or len(size) != 2:
            raise ValueError(f"expected {name}_size (width, height) in pixels, got {shown(size)}.")
        for side, value in zip(("width", "height"), size, strict=True):
            check_number(f"{name} {side}", value, whole(1, "pixels"))
    stored = read_calibration(path, code_step, unit_m)
    try:
        return stored.rig(camera_size, projector_size)
    except ValueError as error:
        if "_size" in str(error):  # of an argument, not of the file
            raise ValueError(f"{path}: {error}") from error
        raise FileFormatError(f"{path}: {error}") from error


def save_calibration(rig: Rig, path: str | Path) -> None:
    """Write a rig as JSON; `load_calibration` reads it back equal.

    The key "seal" holds the SHA-256 of the file. If you correct the file by hand, the seal no longer matches, and no
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


def _own_rig(path: Path, settings: dict[str, Any]) -> Rig:
    """The rig in the data of a file that `save_calibration` wrote."""
    try:
        return Rig.from_dict({key: value for key, value in settings.items() if key != "seal"})
    except ValueError as error:
        raise FileFormatError(f"{path}: {error}") from error


def principal_point_doubts(rig: Rig) -> tuple[str, ...]:
    """Sentences on principal points that lie far from the centre of their image; none if there is nothing to say.

    Examples
    --------
    >>> device = Intrinsics(640, 480, 500.0, 500.0, 160.0, 120.0)  # calibrated with images of 320 x 240
    >>> principal_point_doubts(Rig(device, Intrinsics(1024, 768, 900.0, 900.0, 512.0, 700.0)))[0][:56]
    "the camera's principal point, 160, 120, lies far from th"
    """
    camera, projector = rig.pinhole, rig.projector
    doubts = []
    if not (_is_central(camera.cx, camera.width) and _is_central(camera.cy, camera.height)):
        is_exchanged = isinstance(projector, Intrinsics) and (
            _is_central(projector.cx, camera.width)
            and _is_central(projector.cy, camera.height)
            and _is_central(camera.cx, projector.width)
        )
        doubts.append(
            f"the camera's {_far_from_centre(camera)}, "
            + (
                "but that of the projector near it: camera and projector seem to be exchanged in the calibration."
                if is_exchanged
                else "as if it was calibrated with images of another size."
            )
        )
    elif isinstance(projector, Intrinsics) and not _is_central(projector.cx, projector.width):
        doubts.append(f"the projector's {_far_from_centre(projector)}, as if it was calibrated at another resolution.")
    return tuple(doubts)


def _is_central(place: float, size: int) -> bool:
    return abs(place / size - 0.5) < MAX_OFF_CENTRE


def _far_from_centre(device: Intrinsics) -> str:
    return (
        f"principal point, {device.cx:.0f}, {device.cy:.0f}, lies far from the centre of its {device.width} x "
        f"{device.height} pixels"
    )


# ---- Files of OpenCV and others --------------------------------------------------------------------------------------


def _stored(path: Path, entries: dict[str, Any], code_step: int, unit_m: float | None) -> StoredCalibration:
    """The calibration of camera and projector, or of a camera alone, in the entries of a file."""
    findings: list[str] = []
    of_projector = {_find(entries, aliases) for aliases in PROJECTOR}
    others = {name: value for name, value in entries.items() if name not in of_projector}
    camera = _device(others, CAMERA, "camera", 1, findings)
    if camera is None:
        raise ValueError(
            f"expected the camera's matrix under a usual name, such as K1, camera_matrix or cam_int, got "
            f"{shown(sorted(entries))}."
        )
    projector = _device(entries, PROJECTOR, "projector", code_step, findings)
    rotation, translation = _find(entries, ROTATION), _find(entries, TRANSLATION)
    if projector is None and (rotation is None or translation is None):
        return StoredCalibration(camera, findings=tuple(f"{path}: {text}" for text in findings))
    if projector is None:
        raise ValueError(
            "expected the projector's matrix under a usual name, such as K2, projector_matrix or proj_int, found none."
        )
    for found, names, wanted in (
        (rotation, ROTATION, "a rotation from camera to projector"),
        (translation, TRANSLATION, "a translation from camera to projector"),
    ):
        if found is None:
            raise ValueError(f"expected a matrix {names[0]!r}, {wanted}, found none.")
    assert rotation is not None
    assert translation is not None
    T_projector_camera = np.eye(4)
    T_projector_camera[:3, :3] = _rotation(rotation, entries[rotation])
    offset = _numbers(translation, entries[translation], (3,))
    T_projector_camera[:3, 3] = offset * _unit_m(entries, rotation, offset, unit_m, findings)
    sentences = tuple(f"{path}: {text}" for text in findings)
    return StoredCalibration(camera, projector, np.linalg.inv(T_projector_camera), findings=sentences)


def _unit_m(
    entries: dict[str, Any], rotation: str, offset: np.ndarray, given_m: float | None, findings: list[str]
) -> float:
    """Metres per unit of T: as given, as the file names it, as its writer has it, or by the length of T."""
    if given_m is not None:
        return given_m
    named = _find(entries, ("unit", "units", "unit_of_length"))
    if named is not None:
        text = str(entries[named]).lower()
        unit = UNITS_M.get(text, UNITS_M.get(text.removesuffix("s")))
        if unit is None:
            raise ValueError(f"expected {named!r} to be one of {', '.join(UNITS_M)}, got {shown(entries[named])}.")
        return unit
    if {"camera_matrix", "projector_matrix", "camera_width"} <= set(entries):
        return 1.0  # `rangesim calibrate`
    length = float(np.linalg.norm(offset))
    is_millimetres = rotation == PROCAM_ROTATION or length >= LEAST_MM
    unit, name = (1e-3, "millimetres") if is_millimetres else (1.0, "metres")
    in_cm = ", such as 0.01 for centimetres" if CENTIMETRES[0] <= length < CENTIMETRES[1] else ""
    findings.append(
        f"T is taken as {name}, so the baseline is {length * unit:.4g} m; --unit states another unit{in_cm}."
    )
    return unit


def _device(
    entries: dict[str, Any], names: DeviceNames, word: str, code_step: int, findings: list[str]
) -> DeviceCalibration | None:
    """The device of these names; None if the file has no matrix of it."""
    found = _find(entries, names.matrix)
    if found is None:
        return None
    matrix = _numbers(found, entries[found], (3, 3))
    matrix[:2] /= code_step
    _check_matrix(found, matrix)
    coefficients: tuple[float, ...] = ()
    distortion = _find(entries, names.distortion)
    if distortion is None:
        findings.append(f"the {word} has no coefficients of distortion, so it counts as a pinhole.")
    else:
        coefficients = _coefficients(distortion, _numbers(distortion, entries[distortion], None))
    return DeviceCalibration(matrix, coefficients, _size(entries, names))


def _check_matrix(name: str, K: np.ndarray) -> None:
    """Raise ValueError if a matrix is no K of a camera without skew."""
    if K[2, 0] or K[2, 1]:
        is_turned = not K[0, 2] and not K[1, 2]
        raise ValueError(
            f"expected {name!r} with the last row 0 0 1, got {K[2].tolist()}"
            f"{'; it seems to be transposed' if is_turned else ''}."
        )
    if K[1, 0] or abs(K[2, 2] - 1) > 1e-9:
        raise ValueError(f"expected {name!r} as an upper triangle that ends in 1, got {K.tolist()}.")
    if abs(K[0, 1]) > MAX_SKEW * abs(K[0, 0]):
        raise ValueError(f"expected {name!r} without skew, got {K[0, 1]:g}.")


def _coefficients(name: str, values: np.ndarray) -> tuple[float, ...]:
    """Up to five coefficients of distortion; further ones must be 0, because the lens model does not have them."""
    if len(values) not in COEFFICIENT_COUNTS:
        counts = " or ".join(map(str, COEFFICIENT_COUNTS))
        raise ValueError(f"expected {counts} coefficients of OpenCV in {name!r}, got {len(values)}.")
    if np.any(values[5:]):
        raise ValueError(
            f"expected {name!r} with the coefficients k1, k2, p1, p2, k3 alone, got {values.tolist()}; calibrate again "
            "without the rational, thin-prism or tilted model."
        )
    return tuple(float(value) for value in values[:5])


def _rotation(name: str, value: Any) -> np.ndarray:
    """(3, 3) rotation of a matrix, replaced by the nearest rotation, or of a rotation vector in radians."""
    numbers = _numbers(name, value, None)
    if numbers.size == 3:
        angle = float(np.linalg.norm(numbers))
        if angle > 4 * math.pi:
            raise ValueError(f"expected {name!r} as a rotation vector in radians, got {numbers.tolist()}.")
        x, y, z = numbers / angle if angle else numbers
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return np.asarray(np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross)
    matrix = _numbers(name, value, (3, 3))
    u, scales, vt = np.linalg.svd(matrix)
    if not np.allclose(scales, 1, atol=ROTATION_TOLERANCE, rtol=0):
        raise ValueError(f"expected {name!r} to hold a rotation matrix, got {matrix.tolist()}.")
    if np.linalg.det(matrix) < 0:
        raise ValueError(f"expected {name!r} to hold a rotation, got a reflection: its determinant is -1.")
    return np.asarray(u @ vt)


def _size(entries: dict[str, Any], names: DeviceNames) -> tuple[int, int] | None:
    """(width, height) of a device; None if the file does not state it."""
    ways: tuple[tuple[tuple[str, ...], int], ...] = ((names.size, 1), (names.shape, -1))
    for aliases, step in ways:
        if (found := _find(entries, aliases)) is not None:
            width, height = (_whole(found, n) for n in _numbers(found, entries[found], (2,))[::step])
            return width, height
    width_name, height_name = _find(entries, names.width), _find(entries, names.height)
    if width_name is None or height_name is None:
        return None
    sides = ((name, _numbers(name, entries[name], (1,))[0]) for name in (width_name, height_name))
    width, height = (_whole(name, number) for name, number in sides)
    return width, height


def _whole(name: str, number: float) -> int:
    if number % 1 != 0 or number < 1:
        raise ValueError(f"expected {name} to hold whole numbers of at least 1, the size in pixels, got {number:g}.")
    return int(number)


def _numbers(name: str, value: Any, shape: tuple[int, ...] | None) -> np.ndarray:
    """The numbers of an entry, float64, of that shape; None: any number of them, in a row.

    An entry is a list, nested or not, a text of numbers, or a matrix of OpenCV.
    """
    stated: tuple[int, ...] | None = None
    data = value
    if isinstance(value, Mapping):
        data = value["data"]
        if "rows" in value or "cols" in value:
            try:
                stated = int(str(value.get("rows"))), int(str(value.get("cols")))
            except ValueError:
                raise ValueError(f"expected {name!r} with rows and cols as whole numbers.") from None
    numbers = list(_flat(name, data))
    array = np.array(numbers, dtype=np.float64)
    if not (np.abs(array) < MAX_NUMBER).all():
        raise ValueError(f"expected numbers below {MAX_NUMBER:g} in {name!r}, got {shown(numbers)}.")
    if stated is not None and (min(stated) < 0 or math.prod(stated) != array.size):
        raise ValueError(f"expected {stated[0]} x {stated[1]} numbers in {name!r}, got {array.size}.")
    if shape is None:
        return array
    if array.size != math.prod(shape) or (stated is not None and len(shape) == 2 and stated != shape):
        wanted = " x ".join(map(str, shape))
        raise ValueError(f"expected {name!r} to hold {wanted} numbers, got {array.size}.")
    return array.reshape(shape)


def _flat(name: str, data: Any) -> Iterable[float]:
    """The numbers of nested lists or of a text, in a row."""
    if isinstance(data, str):
        data = data.split()
    if isinstance(data, (list, tuple)):
        for item in data:
            yield from _flat(name, item) if isinstance(item, (list, tuple)) else (_number(name, item),)
    else:
        yield _number(name, data)


def _number(name: str, item: Any) -> float:
    try:
        if isinstance(item, bool) or not isinstance(item, (int, float, str)):
            raise ValueError
        return float(item)
    except (ValueError, OverflowError):
        raise ValueError(f"matrix {name!r} does not hold numbers, but {shown(item)}.") from None


def _entries(data: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, Any]]:
    """Every entry of nested tables with its dotted name; a matrix of OpenCV is one entry."""
    for key, value in data.items():
        if isinstance(value, Mapping) and "data" not in value:
            yield from _entries(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _find(entries: Mapping[str, Any], aliases: Iterable[str]) -> str | None:
    """Name of the first entry that has one of the names; None if there is none.

    Tables around an entry may have any name. Long names are compared without case and punctuation.
    """
    exact: dict[str, str] = {}
    squashed: dict[str, str] = {}
    for name in entries:
        for part in (name, name.rpartition(".")[2]):
            exact.setdefault(part, name)
            squashed.setdefault(_squashed(part), name)
    for alias in aliases:  # those that name no device come last
        if alias in exact:
            return exact[alias]
        if len(alias) > 3 and _squashed(alias) in squashed:
            return squashed[_squashed(alias)]
    return None


def _squashed(name: str) -> str:
    return "".join(letter for letter in name.lower() if letter.isalnum())
