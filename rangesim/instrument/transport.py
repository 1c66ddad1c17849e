# SPDX-License-Identifier: Apache-2.0
"""`rangesim.transport`: one light-transport pass for several sensors, with as many samples as their readings need."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Unpack, overload

from rangesim.instrument.adaptive_sampling import AdaptiveSampling
from rangesim.light_transport.light_pass import trace_light
from rangesim.light_transport.transport_settings import TransportOptions, TransportSettings, with_options
from rangesim.light_transport.truncation import warn_of_truncation
from rangesim.response import Response
from rangesim.rig import Rig
from rangesim.scene import Scene
from rangesim.sensor import Sensor
from rangesim.signals import SignalSet, StillSignals


@overload
def transport(
    scene: Scene,
    rig: Rig,
    sensors: Sequence[Sensor | Response],
    settings: TransportSettings | None = ...,
    *,
    progress: Callable[[float], None] | None = ...,
    **options: Unpack[TransportOptions],
) -> StillSignals: ...


@overload
def transport(
    scene: Scene,
    rig: Sequence[Rig],
    sensors: Sequence[Sensor | Response],
    settings: TransportSettings | None = ...,
    *,
    progress: Callable[[float], None] | None = ...,
    **options: Unpack[TransportOptions],
) -> SignalSet: ...


def transport(
    scene: Scene,
    rig: Rig | Sequence[Rig],
    sensors: Sequence[Sensor | Response],
    settings: TransportSettings | None = None,
    *,
    progress: Callable[[float], None] | None = None,
    **options: Unpack[TransportOptions],
) -> StillSignals | SignalSet:
    """Signals of any number of sensors that share a rig, from one pass of light paths.

    Parameters
    ----------
    scene : Scene, as `rangesim.load_scene` returns.
    rig : Rig, or a list of rigs that have the same emitter and different cameras, as in active stereo (see
        `Rig.with_camera`). The triangles of caustics are then made once for all cameras.
    sensors : sensors, or bare responses. An empty list gives the energy split and the ground truth only.
    settings : TransportSettings, how the light is sampled; None: the defaults.
    progress : function that is called with the fraction done, 0..1, after each kernel launch, at most ten times a
        second. An exception that it raises ends the pass.
    options : fields of `TransportSettings`, which replace those of `settings`, such as spp=64 or seed=1.

    Returns
    -------
    StillSignals
        A SignalSet of them, one for each camera, if a list of rigs is given. Cameras do not share random numbers. The
        first camera gets the same bytes as in a pass without the others, if its pixels take the same number of samples.

    Raises
    ------
    ValueError
        A number out of its range; patterns that do not fit the projector; too little memory; rigs with different
        emitters; a camera or projector inside fog, water or another medium; a medium on the wrong side of its boundary.

    Warns
    -----
    TruncationWarning
        The pass leaves out more than 2 % of the projector's light, as estimated in `Signals.truncation`.

    Examples
    --------
    >>> import rangesim
    >>> scene = rangesim.load_scene("tabletop")  # doctest: +SKIP
    >>> signals = rangesim.transport(scene, scene.rig(), [rangesim.AmcwToF()], spp=16)  # doctest: +SKIP
    """
    settings = _with_sampler(with_options(settings, options), sensors)
    signals = trace_light(scene, [rig] if isinstance(rig, Rig) else rig, sensors, settings, progress)
    for number, one in enumerate(signals):
        of = f" of camera {number}" if len(signals) > 1 else ""
        warn_of_truncation(one.truncation, settings.max_depth, of, stacklevel=2)  # where `transport` was called
    return signals[0] if isinstance(rig, Rig) else SignalSet.of(signals)


def _with_sampler(settings: TransportSettings, sensors: Sequence[Sensor | Response]) -> TransportSettings:
    """The settings, with `AdaptiveSampling` for these sensors in place of spp="auto".

    The settings stay as they are if a bare response is among the sensors, because no reading tells how many samples it
    needs, or if the sampling error is not estimated.
    """
    readers = [sensor for sensor in sensors if isinstance(sensor, Sensor)] if isinstance(sensors, Sequence) else []
    if settings.spp != "auto" or not settings.sampling_error or not readers or len(readers) < len(sensors):
        return settings
    return replace(settings, spp=AdaptiveSampling.of(readers))
