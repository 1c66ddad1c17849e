# SPDX-License-Identifier: Apache-2.0
"""One scene of a data set in files: the members of a tar file, named as WebDataset wants it.

NUMBER.scene.json        what was drawn, the objects with their poses, the cameras, the sensors and their statistics
NUMBER.camera.1.npz      the truth that the first camera sees, once for all sensors that share it
NUMBER.sensor.NAME.npz   the readings of the sensor NAME, and why they failed
NUMBER.frames.NAME.npz   the frames (k, h, w) of each of its cameras, if the data set keeps them
NUMBER.models.npz        meshes of the objects that come from no file: primitives, which are drawn for one scene alone

NUMBER is the scene's number in at least six digits. Members have no times, no owners and one order, so the same scene
always has the same bytes. Readers of WebDataset find JSON and NumPy's .npz; nothing here needs a decoder of its own.
"""

from __future__ import annotations

import tarfile
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from rangesim.capture.capture import DTYPES
from rangesim.causes import Cause
from rangesim.decoding.status import Status
from rangesim.errors import FileFormatError
from rangesim.files.array_files import arrays_from_bytes
from rangesim.files.schema import MAX_METRES, ArraySpec, Count, Name, Positive, Record, checked_arrays
from rangesim.instrument.instrument import is_name
from rangesim.results.experiment_results import ObjectsRecord, RowRecord
from rangesim.rig import Camera
from rangesim.rig.poses import pose
from rangesim.settings.config import from_dict, shown
from rangesim.triangle_mesh import TriangleMesh

SCENE_MEMBER = "scene.json"
"""Suffix of the member with the record of a scene. It is the first member of a scene."""
MODELS_MEMBER = "models.npz"
"""Suffix of the member with meshes."""
MAX_NORMAL = 1.001
"""Largest component of a unit vector in half precision, with room for its rounding of 0.0005."""
BLOCK = 512
"""Bytes of a block of a tar file. The tar format fixes it."""
END_OF_TAR = bytes(2 * BLOCK)
"""The two empty blocks that end a tar file."""

_SEGMENTS = {
    "supervoxels": ArraySpec("int32", low=-1, required=False),
    "labels": ArraySpec("int32", low=-1, required=False),
    "parents": ArraySpec("int32", ("nodes",), low=0, per_pixel=2, required=False),
    "altitudes": ArraySpec("float64", ("nodes",), low=0, inf=True, per_pixel=2, required=False),
}
_METRES = ArraySpec("float32", low=-MAX_METRES, high=MAX_METRES, nan=True)
CAMERA_ARRAYS = {
    "true_m": _METRES,
    "normal": ArraySpec("float16", ("h", "w", 3), low=-MAX_NORMAL, high=MAX_NORMAL, nan=True),
    "instance": ArraySpec("int32", low=-1),
    "material": ArraySpec("int8", low=-1),
    "amodal": ArraySpec("bool", ("objects", "h", "w")),
    "nearest_m": ArraySpec("float32", low=0, high=MAX_METRES, nan=True, required=False),
    "farthest_m": ArraySpec("float32", low=0, high=MAX_METRES, nan=True, required=False),
    **_SEGMENTS,
}
"""Type, shape and bounds of the arrays of a camera. `SampleRecord` says what the numbers stand for.

true_m : z for a pinhole camera, and ranges for every other one. normal : world. instance : index into `shapes`. amodal
: one mask for each of `objects`. nearest_m, farthest_m : of the surfaces in a zone. The others are the segmentation of
the true surface: `rangesim.results.experiment_results.Segmentation`.
"""
SENSOR_ARRAYS = {
    "reading_m": _METRES,
    "status": ArraySpec("uint8", high=max(Status)),
    "confidence": ArraySpec("float16", low=0, high=1.001, nan=True),
    "intensity": ArraySpec("float32", nan=True),
    "cause": ArraySpec("uint8", high=max(Cause)),
    "projector_column": ArraySpec("float32", nan=True, required=False),
    "projector_row": ArraySpec("float32", nan=True, required=False),
    "true_projector_column": ArraySpec("float32", nan=True, inf=True, required=False),
    "true_projector_row": ArraySpec("float32", nan=True, inf=True, required=False),
    "projector_visible": ArraySpec("bool", required=False),
    **_SEGMENTS,
}
"""Type, shape and bounds of the arrays of a sensor.

reading_m : as `true_m` of its camera. projector_column, projector_row : pixel coordinates of the projector as the
sensor decoded them, beside the true ones; for sensors that decode them. projector_visible : whether the emitter lights
the point. The last are the segmentation of the measured cloud.
"""


Sha256 = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]
"""A SHA-256 in hexadecimal digits."""


# ---- Records -------------------------------------------------------------------------------------------------------


class ShapeRecord(Record, frozen=True, kw_only=True):
    """A shape of the scene, with its material class."""

    name: Name
    material: Name


class PlacedObjectRecord(Record, frozen=True, kw_only=True):
    """An object of the scene.

    shape : index of its shape in `SampleRecord.shapes`, which is its number in `instance`.
    model : name of its mesh or primitive. sha256 : checksum of its mesh as a PLY file of coordinates of the part.
    from_file : whether the mesh comes from a file: it then stands in the store, and else in the scene's `models.npz`.
    scale : factor on the vertices of the model, before its pose.
    T_world_part : (4, 4) maps coordinates of the part to coordinates of the world, metres.
    """

    shape: Count
    model: Name
    sha256: Sha256
    from_file: bool
    category: Name
    material: Name
    scale: Positive
    T_world_part: list[list[float]]


class CameraRecord(Record, frozen=True, kw_only=True):
    """A camera. camera : plain data of `rangesim.rig.Camera`. T_world_camera : (4, 4), metres. reads : z or range."""

    camera: dict[str, Any]
    T_world_camera: list[list[float]]
    reads: Literal["z", "range"]

    @property
    def of_record(self) -> Camera:
        """The camera itself; FileFormatError if its data are broken."""
        try:
            return from_dict(Camera, self.camera, "camera")  # type: ignore[type-abstract]
        except ValueError as error:
            raise FileFormatError(str(error)) from error


class SensorRecord(Record, frozen=True, kw_only=True):
    """A sensor of the scene.

    camera : number of its camera, from 1. further_cameras : those of a sensor with several.
    projector : plain data of the emitter. exposure_s : None if it is noise-free.
    rows : statistics of each object and material class, as in `RowRecord`.
    objects : what the segmentation of its cloud makes of the objects.
    doubts, notes : sentences of the decoder.
    """

    name: Name
    camera: Count
    further_cameras: list[CameraRecord]
    projector: dict[str, Any]
    T_camera_projector: list[list[float]]
    exposure_s: float | None
    rows: Annotated[list[RowRecord], msgspec.Meta(min_length=1)]
    objects: ObjectsRecord | None
    doubts: list[str]
    notes: list[str]


class SampleRecord(Record, frozen=True, kw_only=True):
    """The contents of `scene.json`.

    number : number of the scene. seed : seed of its light and noise. drawn : all that was drawn for it.
    shapes : all shapes, in the order of the numbers in `instance`. objects : those of them that are objects, in the
        order of the masks in `amodal`. material_names : material classes, in the order of the numbers in `material`.
    warnings : sentences of warnings that came up while the scene was measured.
    """

    format: Literal["rangesim-sample"] = "rangesim-sample"
    format_version: Literal[1] = 1
    number: Count
    seed: Annotated[int, msgspec.Meta(ge=0)]
    drawn: dict[str, Any]
    shapes: list[ShapeRecord]
    objects: list[PlacedObjectRecord]
    material_names: list[Name]
    cameras: list[CameraRecord]
    sensors: list[SensorRecord]
    warnings: list[str]

    def sizes(self, member: str) -> dict[str, int]:
        """Height "h" and width "w" of the images of a member such as "sensor.amcw", and the number of "objects".

        Raises
        ------
        FileFormatError
            The scene has no such camera or sensor, or its camera is broken.
        """
        kind, _, name = member.partition(".")
        cameras = {str(number): number for number in range(1, len(self.cameras) + 1)}
        if kind != "camera":
            cameras = {sensor.name: sensor.camera for sensor in self.sensors}
        if not 1 <= cameras.get(name, 0) <= len(self.cameras):
            raise FileFormatError(f"expected a member of scene {self.number}'s record, got {member!r}.")
        camera = self.cameras[cameras[name] - 1].of_record
        return {"h": camera.height, "w": camera.width, "objects": len(self.objects)}


# ---- Members of a tar file -----------------------------------------------------------------------------------------


def scene_key(number: int) -> str:
    """The number of a scene as the names of its members begin with it.

    Examples
    --------
    >>> scene_key(123)
    '000123'
    """
    return f"{number:06d}"


def tar_segment(number: int, members: Mapping[str, bytes]) -> bytes:
    """The part of a tar file that holds a scene. Such parts, one after the other, and `END_OF_TAR` are a tar file.

    Parameters
    ----------
    members : contents by suffix, such as "scene.json".
    """
    parts = []
    for suffix, content in members.items():
        entry = tarfile.TarInfo(f"{scene_key(number)}.{suffix}")
        entry.size, entry.mode = len(content), 0o644
        parts += [entry.tobuf(tarfile.USTAR_FORMAT), content, bytes(-len(content) % BLOCK)]
    return b"".join(parts)


def members_of(segment: bytes, place: str) -> dict[str, bytes]:
    """The members of a scene by suffix, from the bytes that `tar_segment` made.

    place : where the bytes come from, for messages.

    Raises
    ------
    FileFormatError
        The bytes are no such part of a tar file, or hold members of several scenes.
    """
    members: dict[str, bytes] = {}
    keys, at = set(), 0
    try:
        while at < len(segment):
            entry = tarfile.TarInfo.frombuf(segment[at : at + BLOCK], "utf-8", "surrogateescape")
            if entry.type != tarfile.REGTYPE or entry.size < 0:
                raise FileFormatError(f"{place}: expected plain files, got {shown(entry.name)}.")
            key, _, suffix = entry.name.partition(".")
            keys.add(key)
            members[suffix] = segment[at + BLOCK : at + BLOCK + entry.size]
            at += BLOCK + -(-entry.size // BLOCK) * BLOCK
    except tarfile.TarError as error:
        raise FileFormatError(f"{place}: expected a part of a tar file: {error}.") from error
    if len(keys) != 1:
        raise FileFormatError(f"{place}: expected the members of one scene, got {len(keys)}.")
    key = keys.pop()
    if not key.isascii() or not key.isdecimal() or tar_segment(int(key), members) != segment:
        raise FileFormatError(f"{place}: expected members as rangesim writes them, each once and whole.")
    return members


def record_of(members: Mapping[str, bytes], place: str) -> SampleRecord:
    """The record of a scene; FileFormatError if it is missing or broken, or contradicts itself."""
    if SCENE_MEMBER not in members:
        raise FileFormatError(f"{place}: expected the member {SCENE_MEMBER}, got {', '.join(members) or 'none'}.")
    try:
        record = msgspec.json.decode(members[SCENE_MEMBER], type=SampleRecord)
        _check(record)
    except (msgspec.DecodeError, UnicodeDecodeError, ValueError) as error:
        raise FileFormatError(f"{place}: {SCENE_MEMBER} is broken: {str(error).rstrip('.')}.") from error
    return record


def _check(record: SampleRecord) -> None:
    """Raise ValueError if the parts of a record do not fit together."""
    for index, each in enumerate(record.objects):
        pose(each.T_world_part, f"T_world_part of object {index}")
        if each.shape >= len(record.shapes):
            raise ValueError(f"expected object {index} to be one of {len(record.shapes)} shapes, got {each.shape}.")
    for number, camera in enumerate(record.cameras, 1):
        pose(camera.T_world_camera, f"T_world_camera of camera {number}")
    for sensor in record.sensors:
        if not is_name(sensor.name) or not 1 <= sensor.camera <= len(record.cameras):
            raise ValueError(
                f"expected sensors with the name of an instrument and one of {len(record.cameras)} cameras, got "
                f"{shown(sensor.name)} with camera {sensor.camera}."
            )


def mesh_in(members: Mapping[str, bytes], index: int, place: str) -> TriangleMesh:
    """The mesh of the scene's object of this index, which comes from no file; metres, coordinates of the part.

    Raises
    ------
    FileFormatError
        The member is missing or broken.
    """
    names, where = (f"vertices_{index}", f"faces_{index}"), f"{place}: {MODELS_MEMBER}"
    if MODELS_MEMBER not in members:
        raise FileFormatError(f"{place}: expected the member {MODELS_MEMBER}, got {', '.join(members)}.")
    arrays = arrays_from_bytes(members[MODELS_MEMBER], where, names)
    try:
        return TriangleMesh(*(arrays[name] for name in names))
    except ValueError as error:
        raise FileFormatError(f"{where}: {error}") from error


def arrays_of(members: Mapping[str, bytes], suffix: str, place: str, sizes: dict[str, int]) -> dict[str, np.ndarray]:
    """The arrays of a member such as "camera.1.npz", checked.

    sizes : height "h" and width "w" of the camera, and the number of "objects"; see `ArraySpec`.

    Raises
    ------
    FileFormatError
        The member is missing or broken, or an array is not as its specification says.
    """
    if suffix not in members:
        raise FileFormatError(f"{place}: expected the member {suffix}, got {', '.join(members) or 'none'}.")
    where, kind = f"{place}: {suffix}", suffix.partition(".")[0]
    if kind != "frames":
        return checked_arrays(members[suffix], where, CAMERA_ARRAYS if kind == "camera" else SENSOR_ARRAYS, sizes)
    frames = arrays_from_bytes(members[suffix], where)
    if not frames or any(name != f"camera_{n}" for n, name in enumerate(frames, 1)):
        raise FileFormatError(f"{where}: expected arrays camera_1, camera_2 ..., got {', '.join(frames) or 'none'}.")
    for name, array in frames.items():
        if array.dtype not in DTYPES or array.ndim != 3:
            raise FileFormatError(f"{where}: expected frames as {name}, got {array.dtype} of shape {array.shape}.")
    if frames["camera_1"].shape[1:] != (sizes["h"], sizes["w"]):
        raise FileFormatError(f"{where}: expected frames of {sizes['h']} x {sizes['w']} pixels.")
    return frames
