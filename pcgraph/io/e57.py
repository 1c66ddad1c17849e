# SPDX-License-Identifier: Apache-2.0
"""E57 files (ASTM E2807) of terrestrial laser scanners.

The library libE57Format, which pye57 contains, reads and writes them: the extra ``e57``.
"""

from __future__ import annotations

import hashlib
import re
import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import ceil, log2
from pathlib import Path
from types import ModuleType
from typing import Any
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from pcgraph.cloud import Cloud
from pcgraph.errors import CloudReadError, CloudWriteError, PcgraphError, library_reason
from pcgraph.io.flat_columns import NORMALS, Arrays, described, flatten, unflatten
from pcgraph.io.format import CloudFile, Format

_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_INVALID = "cartesianInvalidState"
_COLORS = ("colorRed", "colorGreen", "colorBlue")
_KEPT = (
    *("intensity", "isIntensityInvalid", "isColorInvalid", "rowIndex", "columnIndex", "returnIndex", "returnCount"),
    *("timeStamp", "isTimeStampInvalid", *_SPHERICAL),
)
"""Fields of the standard that become columns of the same names."""
_TAKEN = (*_CARTESIAN, *_COLORS, *_KEPT, _INVALID, "sphericalInvalidState")
_OWN = "pcgraph"
"""Prefix of our extension, for columns that the standard has no field for."""
_EXTENSIONS = {
    _OWN: "https://pypi.org/project/rangesim/pcgraph",
    "nor": "http://www.libe57.org/E57_NOR_surface_normals.txt",
}
"""Extensions of the standard by prefix: ours, and the common one for normals."""
_NORMAL_FIELDS = ("nor:normalX", "nor:normalY", "nor:normalZ")
_DESCRIPTION = f"{_OWN}:columns"
_SCAN = "scan"
_BUFFERS = {"i1": np.int8, "u1": np.uint8, "i2": np.int16, "u2": np.uint16, "f4": np.float32, "f8": np.float64}
"""Types of arrays that the library fills. All other whole numbers go through `numpy.longlong`: pye57 refuses int32, and
mistakes NumPy's int64, which is a C long, for 32 bits."""
_INTEGERS = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8")
_MAX_INTEGER = (1 << 63) - 1
"""Largest whole number of a field: integers of the standard have 64 bits with a sign (ASTM E2807)."""
_MAX_SCANS = 1 << 16
"""Largest count of scans in a file, because the column ``scan`` is uint16."""
_PAGE_BYTES = 1024
"""Bytes of a page, from the standard, which has no other size. The last 4 are its checksum."""
_HEADER = struct.Struct("<8sIIQQQQ")
"""Header: signature, version (two numbers), length of the file, offset and length of the XML, size of a page."""


# ---- Reading -------------------------------------------------------------------------------------------------------


def read_e57(file: CloudFile) -> Cloud:
    """Cloud of all scans of an E57 file, in the file's frame: each scan's pose is applied to its points and normals.

    Coordinates may be Cartesian or spherical. Points that the file marks as invalid are left out. Fields are columns
    with the standard's names: ``intensity`` as stored, ``rowIndex``, ``columnIndex``, ``timeStamp`` in seconds from the
    scan's start, and so on. Fields of extensions lose their prefix. Scaled integers are float64. Texts and images are
    not read. The viewpoint is the translation of the pose.

    Several scans have one viewpoint for each point, and a column ``scan`` (uint16) with the number of the scan, from 0.
    A field that only some scans have is NaN in the others, or 0 if it holds whole numbers.

    Raises
    ------
    CloudReadError
        The file is damaged or shorter than its header says, has no scan, or pye57 is missing.
    """
    _check_xml(file.content)
    library = _library(CloudReadError, "reading")
    with _named(file) as path:
        try:
            image = library.ImageFile(str(path), "r")
            try:
                nodes = list(image.root()["data3D"])
                if not 0 < len(nodes) <= _MAX_SCANS:
                    raise CloudReadError(f"expected an E57 file with 1 to {_MAX_SCANS} scans, got {len(nodes)}")
                _check_counts(library, nodes, len(file.content))
                scans = [_scan(library, image, node) for node in nodes]
            finally:
                image.close()
        except CloudReadError:
            raise
        except MemoryError:
            raise CloudReadError("the points do not fit into memory: split the file, or thin out its points") from None
        except Exception as error:  # noqa: BLE001 - E57Exception, and what nodes of unexpected types cause
            raise CloudReadError(f"the E57 file is damaged: {library_reason(error)}") from None
    return _joined(scans)


@dataclass(frozen=True, eq=False)
class _Scan:
    points: NDArray[np.floating]
    colors: NDArray[np.uint8] | None
    fields: Arrays
    description: dict[str, Any] | None
    viewpoint: NDArray[np.float64] | None


def _check_xml(content: bytes) -> None:
    """Raise CloudReadError if there is no header, or if the XML defines entities, which could fill the memory."""
    if len(content) < _HEADER.size or not content.startswith(b"ASTM-E57"):
        raise CloudReadError("expected an E57 header that begins with 'ASTM-E57', but found none")
    _, _, _, length, start, _, page = _HEADER.unpack_from(content)
    if length != len(content):
        raise CloudReadError(f"the E57 header promises {length} bytes, but the file has {len(content)}")
    if page != _PAGE_BYTES or start >= length:
        raise CloudReadError(f"expected pages of {_PAGE_BYTES} bytes and XML in the file, got {page}, XML at {start}")
    pages = range(start - start % page, len(content), page)
    text = b"".join(content[max(first, start) : first + page - 4] for first in pages)  # without checksums
    if b"<!DOCTYPE" in text:
        raise CloudReadError("expected the XML of an E57 file without a DOCTYPE")


def _check_counts(library: ModuleType, nodes: list[Any], n_bytes: int) -> None:
    """Raise CloudReadError if the scans promise more points than the file can hold, before memory is allocated."""
    count = n_bits = 0
    for node in nodes:
        here = int(node["points"].childCount())
        count += here
        n_bits += here * max(1, sum(_bits(library, element) for element in _elements(library, node).values()))
        if here < 0 or n_bits > 8 * n_bytes:
            raise CloudReadError(f"the E57 file promises {count} points, but it is only {n_bytes} bytes long")


def _elements(library: ModuleType, node: Any) -> dict[str, Any]:
    """The fields of a scan's points that are numbers."""
    prototype = library.StructureNode(node["points"].prototype())
    names = [prototype.get(i).elementName() for i in range(prototype.childCount())]
    return {name: prototype[name] for name in names if not isinstance(prototype[name], library.StringNode)}


def _scan(library: ModuleType, image: Any, node: Any) -> _Scan:
    elements = _elements(library, node)
    fields = _read_fields(library, image, node["points"], elements)
    system = next((s for s in (_CARTESIAN, _SPHERICAL) if all(name in fields for name in s)), None)
    if system is None:
        raise CloudReadError(f"expected the fields {', '.join(_CARTESIAN)} in an E57 scan, got {', '.join(fields)}")
    invalid = fields.pop(_INVALID if system is _CARTESIAN else "sphericalInvalidState", None)
    if invalid is not None and invalid.any():
        fields = {name: values[invalid == 0] for name, values in fields.items()}
    points = _floats(fields, system)
    colors = _colors(library, node, elements, fields)
    rotation, place = _pose(node)
    if all(name in fields for name in _NORMAL_FIELDS):
        normals = _floats(fields, _NORMAL_FIELDS)
        fields |= dict(zip(NORMALS, _moved(normals, rotation, None).T, strict=True))
    fields = {_column_name(name, fields): values for name, values in fields.items()}
    points = _moved(points if system is _CARTESIAN else _cartesian(points), rotation, place)
    is_own = _OWN in (image.extensionsPrefix(i) for i in range(image.extensionsCount()))
    text = node[_DESCRIPTION].value().encode() if is_own and node.isDefined(_DESCRIPTION) else None
    return _Scan(points, colors, fields, described(text), place)


def _read_fields(library: ModuleType, image: Any, stored: Any, elements: dict[str, Any]) -> Arrays:
    """Arrays (n,) of the fields of a scan, in the smallest types that hold the limits of each field."""
    count = int(stored.childCount())
    types = {name: _type(library, element) for name, element in elements.items()}
    arrays: Arrays = {name: np.zeros(count, _BUFFERS.get(kind, np.longlong)) for name, kind in types.items()}
    buffers = library.VectorSourceDestBuffer()
    for name, values in arrays.items():
        buffers.append(library.SourceDestBuffer(image, name, values, count, True, True))
    if count:
        reader = stored.reader(buffers)
        found = reader.read()
        reader.close()
        if found != count:
            raise CloudReadError(f"the E57 file promises {count} points, but {found} follow")
    return {name: values.astype(types[name], copy=False) for name, values in arrays.items()}


def _type(library: ModuleType, element: Any) -> str:
    """Type of a field's array; for whole numbers the smallest that holds the limits of the field."""
    if isinstance(element, library.IntegerNode):
        low, high = element.minimum(), element.maximum()
        return next(kind for kind in _INTEGERS if np.iinfo(kind).min <= low and high <= np.iinfo(kind).max)
    if isinstance(element, library.FloatNode) and element.precision() == library.E57_SINGLE:
        return "f4"
    return "f8"


def _bits(library: ModuleType, element: Any) -> int:
    """Number of bits of each value of a field in the file."""
    if isinstance(element, library.FloatNode):
        return 32 if element.precision() == library.E57_SINGLE else 64
    return ceil(log2(max(1, element.maximum() - element.minimum() + 1)))


def _floats(fields: Arrays, names: tuple[str, ...]) -> NDArray[np.floating]:
    """Some fields as one array (n, c), removed from `fields`."""
    values = np.stack([fields.pop(name) for name in names], axis=1)
    return values.astype(np.result_type(values, np.float32), copy=False)


def _colors(library: ModuleType, node: Any, elements: dict[str, Any], fields: Arrays) -> NDArray[np.uint8] | None:
    """Colours, removed from `fields`. White is the limit that the scan states, else the field's limit, for floats 1."""
    if not all(name in fields for name in _COLORS):
        return None
    channels = []
    for name in _COLORS:
        limit = elements[name].maximum() if isinstance(elements[name], library.IntegerNode) else 1.0
        if node.isDefined("colorLimits") and node["colorLimits"].isDefined(f"{name}Maximum"):
            limit = node["colorLimits"][f"{name}Maximum"].value()
        values = fields.pop(name)
        if values.dtype != np.uint8 or limit != 255:
            with np.errstate(over="ignore", invalid="ignore"):
                shades = np.nan_to_num(values.astype(np.float64) * (255.0 / limit if limit > 0 else 1.0))
            values = np.clip(np.rint(shades), 0, 255).astype(np.uint8)
        channels.append(values)
    return np.stack(channels, axis=1)


def _column_name(name: str, fields: Arrays) -> str:
    """The name of a field without the prefix of its extension, if no other field has it."""
    short = name.rpartition(":")[2]
    return short if name.startswith(f"{_OWN}:") or sum(n.rpartition(":")[2] == short for n in fields) == 1 else name


def _pose(node: Any) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]:
    """Rotation (3, 3) and place (3,) of the scanner in the file's frame; None for a missing pose or no rotation.

    The rotation is a unit quaternion q = w + xi + yj + zk, so that p' = q p q* + place.
    """
    pose = node["pose"] if node.isDefined("pose") else None
    if pose is None:
        return None, None
    rotation, place = None, np.zeros(3)
    if pose.isDefined("translation"):
        place = np.array([pose["translation"][axis].value() for axis in "xyz"], np.float64)
    if pose.isDefined("rotation"):
        quaternion = np.array([pose["rotation"][part].value() for part in "wxyz"], np.float64)
        length = float(np.linalg.norm(quaternion))
        if not (0.5 < length < 2.0):
            raise CloudReadError(
                f"expected a unit quaternion as the rotation of an E57 scan, got {quaternion.tolist()}"
            )
        w, x, y, z = quaternion / length
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
    if not np.isfinite(place).all():
        raise CloudReadError(f"expected a finite place of an E57 scan, got {place.tolist()}")
    return (None if rotation is None or (rotation == np.eye(3)).all() else rotation), place


def _moved(
    vectors: NDArray[np.floating], rotation: NDArray[np.float64] | None, place: NDArray[np.float64] | None
) -> NDArray[np.floating]:
    """Vectors (n, 3) in the file's frame; the same array, in its own type, if the pose changes nothing."""
    if rotation is not None:
        vectors = vectors.astype(np.float64) @ rotation.T
    return vectors if place is None or not place.any() else vectors + place


def _cartesian(spherical: NDArray[np.floating]) -> NDArray[np.float64]:
    """Points (n, 3) of ranges in metres, azimuths from x and elevations from the xy plane in radians."""
    ranges, azimuth, elevation = spherical.astype(np.float64).T
    flat = ranges * np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), ranges * np.sin(elevation)], axis=1)


def _joined(scans: list[_Scan]) -> Cloud:
    """Cloud of all scans, one after the other."""
    if len(scans) == 1:
        only = scans[0]
        return unflatten(only.points, only.colors, only.fields, only.description, only.viewpoint)
    counts = [len(scan.points) for scan in scans]
    names = dict.fromkeys(name for scan in scans for name in scan.fields)
    fields: Arrays = {_SCAN: np.repeat(np.arange(len(scans), dtype=np.uint16), counts)}
    for name in names:
        kind = np.result_type(*(scan.fields[name] for scan in scans if name in scan.fields))
        nothing = np.nan if kind.kind == "f" else 0
        parts = [scan.fields.get(name, np.full(n, nothing, kind)) for scan, n in zip(scans, counts, strict=True)]
        fields[name if name != _SCAN else f"{_SCAN}_2"] = np.concatenate(parts)
    colors = None
    if any(scan.colors is not None for scan in scans):
        black = [np.zeros((n, 3), np.uint8) for n in counts]
        colors = np.concatenate([b if s.colors is None else s.colors for s, b in zip(scans, black, strict=True)])
    places = [scan.viewpoint for scan in scans]
    known = [np.broadcast_to(p, (n, 3)) for p, n in zip(places, counts, strict=True) if p is not None]
    viewpoint = np.concatenate(known) if len(known) == len(scans) else None
    return unflatten(np.concatenate([scan.points for scan in scans]), colors, fields, None, viewpoint)


# ---- Writing -------------------------------------------------------------------------------------------------------


def encode_e57(cloud: Cloud, suffix: str) -> bytes:
    """Bytes of an E57 file of one scan with every column of a cloud.

    Columns that the standard defines keep their names: ``intensity``, ``rowIndex``, ``columnIndex``, ``returnIndex``,
    ``returnCount``, ``timeStamp`` and so on. Normals go into the common extension ``nor``. All other columns go into
    the extension ``pcgraph``, vectors as ``name_0``, ``name_1`` and so on. Characters that XML forbids in names become
    ``_`` in the file; `read_e57` returns the original names. Types stay, but bools become uint8 and float16 becomes
    float32. A viewpoint (3,) becomes the scan's pose. Coordinates are then relative to it, in float64, and come back
    the same but for the rounding of doubles.

    Raises
    ------
    CloudWriteError
        A column has whole numbers beyond 63 bits; or pye57 is missing.
    """
    points = cloud.points
    library = _library(CloudWriteError, "writing")
    kept = [name for name, column in cloud.columns.items() if name in _KEPT and column.ndim == cloud.points.ndim - 1]
    fields, description = flatten(cloud, kept, _TAKEN, _safe_name)
    place = cloud.viewpoint if cloud.viewpoint is not None and cloud.viewpoint.ndim == 1 else None
    local = points if place is None or not place.any() else points - place
    stored: Arrays = dict(zip(_CARTESIAN, local.T, strict=True))
    stored[_INVALID] = np.zeros(len(points), np.uint8)  # all are valid; pye57 reads no scan that does not say it
    if cloud.colors is not None:
        stored |= dict(zip(_COLORS, cloud.colors.reshape(-1, 3).T, strict=True))
    normals = dict(zip(NORMALS, _NORMAL_FIELDS, strict=True)) if cloud.normals is not None else {}
    for name, values in fields.items():
        stored[name if name in kept else normals.get(name, f"{_OWN}:{name}")] = _storable(name, values)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cloud.e57"
        try:
            image = library.ImageFile(str(path), "w")
            try:
                _write(library, image, stored, place, description.decode())
            finally:
                image.close()
        except library.E57Exception as error:
            raise CloudWriteError(f"the E57 library cannot write this cloud: {library_reason(error)}") from None
        return path.read_bytes()


def _safe_name(name: str, room: int) -> str:
    """The name with ``_`` for characters that XML forbids; it may have any length."""
    return re.sub(r"^(?=[^A-Za-z_])", "_", re.sub(r"[^A-Za-z0-9_.-]", "_", name)) or "_"


def _storable(name: str, values: NDArray[np.generic]) -> NDArray[np.generic]:
    values = (
        values.astype("u1") if values.dtype.kind == "b" else values.astype("f4") if values.dtype == "f2" else values
    )
    if values.dtype.kind == "u" and int(values.max(initial=0)) > _MAX_INTEGER:
        raise CloudWriteError(
            f"E57 has whole numbers of 63 bits, but the column {name!r} has {int(values.max())}: "
            "leave it out, or write .las, .pcd or .npz"
        )
    return values


def _write(
    library: ModuleType, image: Any, stored: Arrays, place: NDArray[np.float64] | None, description: str
) -> None:
    """The tree of an E57 file with one scan of these fields."""

    def structure(**children: Any) -> Any:
        node = library.StructureNode(image)
        for name, child in children.items():
            node.set(name, child)
        return node

    def number(value: float) -> Any:
        return library.FloatNode(image, float(value))

    image.extensionsAdd("", library.E57_V1_0_URI)
    for prefix, uri in _EXTENSIONS.items():
        image.extensionsAdd(prefix, uri)
    digest = hashlib.sha256(b"".join(np.ascontiguousarray(values).tobytes() for values in stored.values())).digest()
    root = image.root()
    root.set("formatName", library.StringNode(image, "ASTM E57 3D Imaging Data File"))
    root.set("guid", library.StringNode(image, f"{{{UUID(bytes=digest[:16])}}}"))
    root.set("versionMajor", library.IntegerNode(image, library.E57_FORMAT_MAJOR))
    root.set("versionMinor", library.IntegerNode(image, library.E57_FORMAT_MINOR))
    scans = library.VectorNode(image, True)
    root.set("data3D", scans)
    root.set("images2D", library.VectorNode(image, True))
    scan = structure(guid=library.StringNode(image, f"{{{UUID(bytes=digest[16:])}}}"))
    scan.set(_DESCRIPTION, library.StringNode(image, description))
    if place is not None:
        turn = structure(w=number(1.0), x=number(0.0), y=number(0.0), z=number(0.0))
        at = structure(**{axis: number(value) for axis, value in zip("xyz", place, strict=True)})
        scan.set("pose", structure(rotation=turn, translation=at))
    if _COLORS[0] in stored:
        ends = (("Minimum", 0), ("Maximum", 255))
        limits = {f"{name}{end}": library.IntegerNode(image, value) for name in _COLORS for end, value in ends}
        scan.set("colorLimits", structure(**limits))
    if "intensity" in stored and np.isfinite(stored["intensity"]).any():
        known = stored["intensity"][np.isfinite(stored["intensity"])]
        limits = {"intensityMinimum": number(known.min()), "intensityMaximum": number(known.max())}
        scan.set("intensityLimits", structure(**limits))
    prototype, buffers = structure(), library.VectorSourceDestBuffer()
    arrays: list[NDArray[np.generic]] = []  # which the buffers point into
    for name, values in stored.items():
        states = library.IntegerNode(image, 0, 0, 0)
        prototype.set(name, states if name == _INVALID else _element(library, image, values.dtype))
        arrays.append(np.empty(len(values), _BUFFERS.get(values.dtype.str[1:], np.longlong)))
        arrays[-1][:] = values
        buffers.append(library.SourceDestBuffer(image, name, arrays[-1], len(values), True, True))
    points = library.CompressedVectorNode(image, prototype, library.VectorNode(image, True))
    scan.set("points", points)
    scans.append(scan)
    writer = points.writer(buffers)
    writer.write(len(arrays[0]))
    writer.close()


def _element(library: ModuleType, image: Any, kind: np.dtype[np.generic]) -> Any:
    """Field of a type; its limits are those of the type, so that `read_e57` finds the same type."""
    if kind.kind == "f":
        return library.FloatNode(image, 0.0, library.E57_SINGLE if kind.itemsize == 4 else library.E57_DOUBLE)
    limits = np.iinfo(kind.name)
    return library.IntegerNode(image, 0, int(limits.min), min(int(limits.max), _MAX_INTEGER))


# ---- The library ---------------------------------------------------------------------------------------------------


def _library(error: type[PcgraphError], what: str) -> ModuleType:
    """The module pye57.libe57; raises `error`, which names the extra, if it is missing."""
    try:
        from pye57 import libe57
    except ImportError:
        raise error(f"{what} .e57 needs pye57: pip install rangesim[e57]") from None
    return libe57


@contextmanager
def _named(file: CloudFile) -> Iterator[Path]:
    """Path of a file that the library can open: a temporary file if the content came from a pipe or an upload."""
    if file.path is not None:
        yield file.path
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cloud.e57"
        path.write_bytes(file.content)
        yield path


E57 = Format("e57", (".e57",), read_e57, encode_e57)
