# SPDX-License-Identifier: Apache-2.0
"""`rangesim.transport`: scene + rig + sensors -> signals, with as many samples as the readings need."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Unpack, overload

from rangesim.instrument.adaptive_sampling import AdaptiveSampling
from rangesim.light_transport.light_pass import trace_light
from rangesim.light_transport.transport_settings import TransportOptions, TransportSettings, chosen
from rangesim.light_transport.truncation import warn_of_truncation
from rangesim.response import Response
from rangesim.rig import Rig
from rangesim.scene import Scene
from rangesim.sensor import Sensor
from rangesim.signals import StillSignals


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
) -> list[StillSignals]: ...


def transport(
    scene: Scene,
    rig: Rig | Sequence[Rig],
    sensors: Sequence[Sensor | Response],
    settings: TransportSettings | None = None,
    *,
    progress: Callable[[float], None] | None = None,
    **options: Unpack[TransportOptions],
) -> StillSignals | list[StillSignals]:
    """Signals of any number of sensors that share a rig, from one pass of light paths.

    Parameters
    ----------
    scene : Scene
    rig : Rig, or a list of rigs that differ in their cameras alone: one emitter and several cameras, as in active
        stereo (see `Rig.with_camera`). Photons are then traced once for all.
    sensors : sensors, or bare responses; none for energy split and ground truth alone.
    settings : TransportSettings, how the light is sampled; None: the defaults.
    progress : called with the fraction done, 0..1, after each kernel launch, at most ten times a second. What it raises
        ends the pass.
    options : fields of `settings` in place of those, such as spp=64 or seed=1.

    Returns
    -------
    StillSignals
        With a list of rigs, a list of them, one for each camera. The first has the bytes of its camera alone, if pixels
        take equally many samples; cameras do not share random numbers.

    Raises
    ------
    ValueError
        A number out of its range, patterns that do not fit the projector, too little memory, rigs of different
        emitters, a camera or projector inside fog, water or another medium, or a medium
        on the wrong side of its boundary.

    Warns
    -----
    TruncationWarning
        By estimate (`Signals.truncation`), more than 2 % of the projector's light is left out.

    Examples
    --------
    >>> scene = rangesim.load_scene("tabletop")  # doctest: +SKIP
    >>> signals = rangesim.transport(scene, scene.rig(), [rangesim.AmcwToF()], spp=16)  # doctest: +SKIP
    """
    settings = _with_sampler(chosen(settings, options), sensors)
    signals = trace_light(scene, [rig] if isinstance(rig, Rig) else rig, sensors, settings, progress)
    for number, one in enumerate(signals):
        of = f" of camera {number}" if len(signals) > 1 else ""
        warn_of_truncation(one.truncation, settings.max_depth, of, stacklevel=2)  # where `transport` was called
    return signals[0] if isinstance(rig, Rig) else signals


def _with_sampler(settings: TransportSettings, sensors: Sequence[Sensor | Response]) -> TransportSettings:
    """The settings, in which "auto" samples stand for AdaptiveSampling where nothing but sensors is given."""
    readers = [sensor for sensor in sensors if isinstance(sensor, Sensor)] if isinstance(sensors, Sequence) else []
    if settings.spp != "auto" or not settings.sampling_error or not readers or len(readers) < len(sensors):
        return settings
    return replace(settings, spp=AdaptiveSampling.of(readers))
