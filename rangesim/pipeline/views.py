# SPDX-License-Identifier: Apache-2.0
"""Several views of a scene in one call: poses of a rig, a range image from each."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike

from rangesim.capture.exposure import expose
from rangesim.decoding import decode
from rangesim.decoding.range_image import RangeImage
from rangesim.experiment.camera_paths import CameraPath, PoseList, Viewpoint
from rangesim.fusion.scan import Scan
from rangesim.instrument.instrument import Instrument
from rangesim.rig import Array, Rig
from rangesim.sensor import Sensor
from rangesim.settings.config import shown
from rangesim.settings.seeds import check_seed, derived_seed

if TYPE_CHECKING:
    from rangesim.electronics.ambient import Ambient
    from rangesim.light_transport.transport_settings import TransportOptions, TransportSettings
    from rangesim.scene import Scene
    from rangesim.signals import GroundTruth


def scan(
    scene: Scene,
    rig: Rig,
    sensor: Sensor | Instrument,
    path: CameraPath | ArrayLike,
    settings: TransportSettings | None = None,
    *,
    ambient: Ambient | None = None,
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
    **options: Any,
) -> Scan:
    """Range images of a scene from each pose of a path, one `transport` each; the scene is loaded once and shared.

    Parameters
    ----------
    rig : camera and emitter, which move together; its own pose does not count, but where a path names no centre: then
        that is what the rig looks at, at the scene's working distance.
    sensor : Sensor with its default electronics and decoder, or an Instrument with its own.
    path : CameraPath, or poses (n, 4, 4) T_world_camera.
    settings, options : of the light transport, as for `transport`; the seed is derived, other noise in each view.
    ambient : as for `expose`.
    seed : of light transport and noise, 0 to 2^64 - 1.
    progress : called with the number of views done.

    Raises
    ------
    ValueError
        Poses that are not rigid, or as `transport`, `expose` and `decode`.
    """
    from rangesim.light_transport.transport_settings import chosen

    if not isinstance(sensor, (Sensor, Instrument)):
        raise ValueError(f"expected a sensor or an instrument, got {shown(sensor)}.")
    check_seed(seed)
    instrument = sensor if isinstance(sensor, Instrument) else Instrument("scan", sensor)
    poses = poses_of(path, Viewpoint(rig.T_world_camera, scene.working_distance_m))
    chosen_settings = chosen(settings, cast("TransportOptions", options))
    images, truths = [], []
    for number, (image, truth) in enumerate(taken(scene, rig, instrument, poses, chosen_settings, ambient, seed), 1):
        images.append(image)
        truths.append(truth)
        if progress is not None:
            progress(number)
    return Scan(tuple(images), tuple(truths), poses)


def taken(
    scene: Scene,
    rig: Rig,
    instrument: Instrument,
    poses: Array,
    settings: TransportSettings,
    ambient: Ambient | None,
    seed: int,
) -> Iterator[tuple[RangeImage, GroundTruth]]:
    """The views of `scan` one after the other, each rendered when it is asked for: its readings, and the truth.

    poses : (n, 4, 4) T_world_camera. The rest as of `scan`.
    """
    from rangesim.instrument.transport import transport

    for number, T in enumerate(poses):
        placed = replace(rig, T_world_camera=T)
        here = replace(settings, seed=derived_seed(seed, number, 0))
        signals = transport(scene, placed, [instrument.sensor], here)
        noise_seed = derived_seed(seed, number, 1)
        capture = expose(
            signals, instrument.sensor, instrument.detector_in_use, instrument.exposure_s, noise_seed, ambient
        )
        yield decode(capture, instrument.decoder), signals.truth


def poses_of(path: CameraPath | ArrayLike | Sequence[ArrayLike], viewpoint: Viewpoint | None = None) -> Array:
    """(n, 4, 4) poses of a path, or as they are given."""
    return (path if isinstance(path, CameraPath) else PoseList(np.asarray(path))).poses(viewpoint)
