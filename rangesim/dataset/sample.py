# SPDX-License-Identifier: Apache-2.0
"""The sample of a data set: one scene is drawn, measured with all its sensors, and put into bytes with its truth."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import msgspec
import numpy as np

from rangesim.dataset.dataset_spec import DatasetSpec
from rangesim.dataset.random_scene import PlacedObject, RandomScene, random_scene
from rangesim.dataset.sample_files import (
    MODELS_MEMBER,
    SCENE_MEMBER,
    CameraRecord,
    PlacedObjectRecord,
    SampleRecord,
    SensorRecord,
    ShapeRecord,
    tar_segment,
)
from rangesim.errors import RangesimWarning
from rangesim.files.array_files import arrays_to_bytes
from rangesim.pipeline.experiment_run import TrueSegmentations, carry_out
from rangesim.results.experiment_results import Measurement, RowRecord, Segmentation, objects_record
from rangesim.rig import Rig
from rangesim.settings.config import to_dict


def sample_bytes(spec: DatasetSpec, index: int) -> bytes:
    """The bytes of a scene: a part of a tar file, as `rangesim.dataset.sample_files` describes it.

    The scene depends on the specification and on its index alone.
    """
    return bytes_of(random_scene(spec, index), index, keeps_frames=spec.frames)


def bytes_of(drawn: RandomScene, number: int, keeps_frames: bool = False) -> bytes:
    """The bytes of a scene that is drawn already.

    number : number of the scene. keeps_frames : whether the frames of the sensors are kept.
    """
    from rangesim.light_transport.hidden_shapes import shapes_on_rays
    from rangesim.scene import load_scene

    true_segmentations = TrueSegmentations()
    with _collected_warnings() as sentences:
        scene = load_scene(drawn.scene).with_objects([each.name for each in drawn.objects])
        result = carry_out(drawn.experiment, scene=scene, sampling_error=False, true_segmentations=true_segmentations)
    measurements = result.measurements
    shape_of = {instance.name: i for i, instance in enumerate(scene.instances)}
    objects = [shape_of[each.name] for each in drawn.objects]
    members: dict[str, bytes] = {}
    cameras: list[tuple[CameraRecord, str]] = []
    sensors: list[SensorRecord] = []
    for one in measurements:
        rig = _rig(one)
        camera = _camera(rig)
        if camera not in [known for known, _ in cameras]:
            suffix = f"camera.{len(cameras) + 1}.npz"
            segments = _segments(true_segmentations.of(one.camera, one.truth))
            members[suffix] = arrays_to_bytes(_truth(one, shapes_on_rays(scene, rig)[objects]) | segments)
            cameras.append((camera, suffix))
        number_of_camera = 1 + [known for known, _ in cameras].index(camera)
        members[f"sensor.{one.name}.npz"] = arrays_to_bytes(_readings(one))
        if keeps_frames:
            members[f"frames.{one.name}.npz"] = arrays_to_bytes(
                {f"camera_{n}": capture.frames for n, capture in enumerate(one.capture.captures, 1)}
            )
        sensors.append(_sensor(one, rig, number_of_camera))
    if models := _models(drawn.objects):
        members[MODELS_MEMBER] = arrays_to_bytes(models)
    record = SampleRecord(
        number=number,
        seed=drawn.experiment.seed,
        drawn=drawn.to_dict(),
        shapes=[ShapeRecord(name=each.name, material=each.material) for each in scene.instances],
        objects=[_object(each, shape_of[each.name]) for each in drawn.objects],
        material_names=list(measurements[0].truth.material_names),
        cameras=[camera for camera, _ in cameras],
        sensors=sensors,
        warnings=sentences,
    )
    return tar_segment(number, {SCENE_MEMBER: msgspec.json.encode(record), **dict(sorted(members.items()))})


@contextmanager
def _collected_warnings() -> Iterator[list[str]]:
    """Sentences of the package's warnings that come up in the block, each once; other warnings go where they went."""
    sentences: list[str] = []
    with warnings.catch_warnings():
        warnings.simplefilter("always", RangesimWarning)
        show = warnings.showwarning

        def collect(message: Warning | str, category: type[Warning], *place: Any) -> None:
            if not issubclass(category, RangesimWarning):
                show(message, category, *place)
            elif str(message) not in sentences:
                sentences.append(str(message))

        warnings.showwarning = collect  # type: ignore[assignment]
        yield sentences


def _rig(measurement: Measurement) -> Rig:
    rig = measurement.capture.reference.rig
    assert rig is not None  # every measurement of an experiment has its rig
    return rig


def _camera(rig: Rig) -> CameraRecord:
    return CameraRecord(
        camera=to_dict(rig.camera),
        T_world_camera=rig.T_world_camera.tolist(),
        reads="z" if rig.camera.is_pinhole else "range",
    )


def _truth(one: Measurement, amodal: np.ndarray) -> dict[str, np.ndarray]:
    """Arrays of a camera but its segments, see `rangesim.dataset.sample_files.CAMERA_ARRAYS`."""
    truth = one.truth
    arrays = {
        "true_m": one.true_m,
        "normal": truth.normal.astype(np.float16),
        "instance": truth.instance,
        "material": truth.material.astype(np.int8),
        "amodal": amodal,
        "nearest_m": truth.nearest_m,
        "farthest_m": truth.farthest_m,
    }
    return {name: array for name, array in arrays.items() if array is not None}


def _segments(segmentation: Segmentation | None) -> dict[str, np.ndarray]:
    return {} if segmentation is None else dict(vars(segmentation))


def _readings(one: Measurement) -> dict[str, np.ndarray]:
    """Arrays of a sensor, see `rangesim.dataset.sample_files.SENSOR_ARRAYS`."""
    image = one.image
    arrays = {
        "reading_m": image.reading_m,
        "status": image.status,
        "confidence": image.confidence.astype(np.float16),
        "intensity": image.intensity,
        "cause": one.causes.cause,
    }
    decoded: dict[str, np.ndarray] = {}
    for axis, name in enumerate(("projector_column", "projector_row")):
        if (coordinates := getattr(image, name)) is not None:
            decoded |= {name: coordinates, f"true_{name}": one.truth.projector_uv[..., axis]}
    if decoded:
        decoded["projector_visible"] = one.truth.projector_visible
    return arrays | decoded | _segments(one.segmentation)


def _sensor(one: Measurement, rig: Rig, camera: int) -> SensorRecord:
    return SensorRecord(
        name=one.name,
        camera=camera,
        further_cameras=[_camera(capture.rig) for capture in one.capture.captures[1:] if capture.rig is not None],
        projector=to_dict(rig.projector),
        T_camera_projector=rig.T_camera_projector.tolist(),
        exposure_s=one.metadata.exposure_s,
        rows=[RowRecord(**row) for row in one.rows],
        objects=None if one.objects is None else objects_record(one.objects),
        doubts=list(one.image.doubts),
        notes=list(one.image.notes),
    )


def _models(objects: Sequence[PlacedObject]) -> dict[str, np.ndarray]:
    """Arrays of the meshes that come from no file."""
    own = {index: each.mesh for index, each in enumerate(objects) if not each.source_sha256}
    return {f"{name}_{index}": getattr(mesh, name) for index, mesh in own.items() for name in ("vertices", "faces")}


def _object(each: PlacedObject, shape: int) -> PlacedObjectRecord:
    return PlacedObjectRecord(
        shape=shape,
        model=each.model,
        sha256=hashlib.sha256(each.mesh.to_ply("part")).hexdigest(),
        from_file=bool(each.source_sha256),
        category=each.category,
        material=each.material,
        scale=float(each.scale),
        T_world_part=np.asarray(each.T_world_part, dtype=np.float64).tolist(),
    )
