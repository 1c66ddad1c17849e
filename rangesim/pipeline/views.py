# SPDX-License-Identifier: Apache-2.0
"""Takes several views of a scene in one call: a rig stands in each pose in turn and takes a range image there."""

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
from rangesim.fusion.posed_images import Scan
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
    """Range images of a scene from each pose of a path, with their ground truth.

    Each view is a light-transport pass. The scene is loaded once for all of them.

    Parameters
    ----------
    scene : Scene.
    rig : Rig, whose camera and emitter move together. Its own pose is used only if the path does not state its centre,
        distance or elevation.
    sensor : Sensor, with its default detector and decoder, or an Instrument, with its own.
    path : CameraPath, or poses (n, 4, 4) float64, T_world_camera, metres.
    settings, options : as for `rangesim.transport`. Their seed is not used, because each view has its own.
    ambient : as for `rangesim.expose`.
    seed : seed of light transport and noise, 0 to 2^64 - 1. The seeds of the views are derived from it.
    progress : function that is called with the number of views done.

    Returns
    -------
    Scan
        Range images with their poses, the ground truth of each view, and the true poses.

    Raises
    ------
    ValueError
        A pose is not rigid, or an error as of `rangesim.transport`, `rangesim.expose` or `rangesim.decode`.

    Examples
    --------
    >>> import rangesim
    >>> from rangesim.experiment import Turntable
    >>> scene = rangesim.load_scene("tabletop")  # doctest: +SKIP
    >>> views = scan(scene, scene.rig(), rangesim.StructuredLight(), Turntable(views=12))  # doctest: +SKIP
    """
    from rangesim.light_transport.transport_settings import with_options

    if not isinstance(sensor, (Sensor, Instrument)):
        raise ValueError(f"expected a sensor or an instrument, got {shown(sensor)}.")
    check_seed(seed)
    instrument = sensor if isinstance(sensor, Instrument) else Instrument("scan", sensor)
    poses = poses_of(path, Viewpoint(rig.T_world_camera, scene.working_distance_m))
    chosen_settings = with_options(settings, cast("TransportOptions", options))
    images, truths = [], []
    views = rendered_views(scene, rig, instrument, poses, chosen_settings, ambient, seed)
    for number, (image, truth) in enumerate(views, 1):
        images.append(image)
        truths.append(truth)
        if progress is not None:
            progress(number)
    return Scan(tuple(images), tuple(truths), poses)


def rendered_views(
    scene: Scene,
    rig: Rig,
    instrument: Instrument,
    poses: Array,
    settings: TransportSettings,
    ambient: Ambient | None,
    seed: int,
) -> Iterator[tuple[RangeImage, GroundTruth]]:
    """Range image and ground truth of each view, rendered when the caller asks for the next one.

    poses : (n, 4, 4) float64, T_world_camera, metres. The other parameters are those of `scan`.
    """
    from rangesim.instrument.transport import transport

    for number, T in enumerate(poses):
        placed = replace(rig, T_world_camera=T)
        here = replace(settings, seed=derived_seed(seed, number, 0))
        rigs = instrument.sensor.rigs(placed)
        signals = transport(scene, rigs[0] if len(rigs) == 1 else rigs, [instrument.sensor], here)
        noise_seed = derived_seed(seed, number, 1)
        capture = expose(
            signals, instrument.sensor, instrument.detector_in_use, instrument.exposure_s, noise_seed, ambient
        )
        yield decode(capture, instrument.decoder), signals.truth


def poses_of(path: CameraPath | ArrayLike | Sequence[ArrayLike], viewpoint: Viewpoint | None = None) -> Array:
    """Poses (n, 4, 4) float64, T_world_camera, of a camera path or of a list of poses."""
    return (path if isinstance(path, CameraPath) else PoseList(np.asarray(path))).poses(viewpoint)
