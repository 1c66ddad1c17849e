# SPDX-License-Identifier: Apache-2.0
"""One entry point to the renderer: scene + rig + sensors -> signals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal, get_args

import numpy as np

from rangesim.experiment.adaptive_sampling import AdaptiveSampling
from rangesim.light_transport.caustics import PHOTONS, caustic_maps, check_photons
from rangesim.light_transport.glint import Glint, trace_glint
from rangesim.light_transport.ground_truth import ground_truth, mean_reflectance
from rangesim.light_transport.indirect import LightFilter
from rangesim.light_transport.kernel_launches import Launches, Progress, raised_as_it_is, report_part
from rangesim.light_transport.loop import Radiance, Settings, View
from rangesim.light_transport.sampling_error import MIN_FOR_HALVES, Estimate
from rangesim.light_transport.traced_scene import TracedScene
from rangesim.light_transport.truncation import estimate_truncation, warn_of_truncation
from rangesim.response import Response
from rangesim.rig import Rig
from rangesim.scene import Scene
from rangesim.sensor import Sensor
from rangesim.settings.seeds import check_seed
from rangesim.signals import EnergySplit, Signals

Indirect = Literal["filtered", "raw"]
MATTE_SPP, OTHER_SPP = 16, 64
"""Samples of a pixel that shares its indirect light, and of others, where no sensor says how many it needs."""
PATHS_FRACTION = 0.95
"""Of the progress, that the samples make."""
TEXTURE_SAMPLES = 64
"""Samples of a pixel, at most, over which the reflectance of a texture is averaged."""


@raised_as_it_is()
def transport(
    scene: Scene,
    rig: Rig,
    sensors: Sequence[Sensor | Response],
    *,
    spp: int | Literal["auto"] | AdaptiveSampling = "auto",
    max_depth: int = 5,
    rr_depth: int = 5,
    seed: int = 0,
    photons: int = PHOTONS,
    caustic_radius_m: float | None = None,
    glint: bool = True,
    indirect: Indirect = "filtered",
    sampling_error: bool = True,
    memory_bytes: int = 2 << 30,
    progress: Callable[[float], None] | None = None,
) -> Signals:
    """Signals of any number of sensors that share a rig, from one pass of light paths.

    Parameters
    ----------
    scene : Scene
    rig : Rig
    sensors : sensors, or bare responses; none for energy split and ground truth alone.
    spp : int >= 1, samples (camera paths) per pixel. Or AdaptiveSampling: 8, and then up to 64, as many as it takes
        until the renderer's noise in the readings of its instruments is small against that of their detectors. "auto":
        this, for the sensors with their usual detectors; for bare responses, 16 where pixels share their indirect light
        and 64 elsewhere.
    max_depth : int >= 1, segments of a path between surfaces that scatter it, up to the light: 2 is direct light alone,
        as in Mitsuba. Delta interactions (glass, mirrors, thin panes, coats, holes) do not count; they have a limit of
        their own, `rangesim.light_transport.specular_chain.MAX_CHAIN` in a row.
    rr_depth : int >= 1, surfaces that scatter after which Russian roulette may end a path.
    photons : int >= 0, caustic photons: the projector's light through glass and off mirrors, see
        `rangesim.light_transport.photons`; 0: none, and such light is missing. No cost without such surfaces.
    caustic_radius_m : metres, largest radius over which photons are gathered; None: as wide as the number of photons
        asks for, at most three pixels of the projector or of the camera at the distance of the point. Caustics are
        blurred by about half of it.
    glint : whether the camera sees the projector's lens, in a mirror, through glass or directly.
    indirect : "filtered": neighbouring pixels of a matte surface share their multipath, with a small bias and far less
        noise (`rangesim.light_transport.indirect`); "raw": the unbiased sum over each pixel's own paths.
    sampling_error : whether `Signals.sampling` is estimated, which takes as much memory again as the signals and some
        time; adaptive sampling needs it.
    seed : int, 0 to 2^64 - 1; the same seed gives the same bytes, whatever the number of threads and the memory
        budget, and each its own noise.
    memory_bytes : the image is rendered in tiles that keep the renderer's arrays below this size; photons that landed
        come on top, some 200 bytes each.
    progress : called with the fraction done, 0..1, after each kernel launch, at most ten times a second. What it raises
        ends the pass.

    Raises
    ------
    ValueError
        A number out of its range, patterns that do not fit the projector, or too little memory.

    Warns
    -----
    TruncationWarning
        By estimate (`Signals.truncation`), more than 2 % of the projector's light is left out.
    """
    counts: dict[str, Any] = {"max_depth": max_depth, "rr_depth": rr_depth}
    _check(
        scene, rig, sensors, **counts if spp == "auto" or isinstance(spp, AdaptiveSampling) else counts | {"spp": spp}
    )
    seed = check_seed(seed)
    check_photons(photons, caustic_radius_m)
    responses = list(dict.fromkeys(r for s in sensors for r in ([s] if isinstance(s, Response) else s.responses())))
    adaptive = _adaptive(spp, sensors) if sampling_error else None
    for one in adaptive.instruments if adaptive else ():
        if missing := set(one.sensor.responses()) - set(responses):
            raise ValueError(f"expected sensors that have {missing.pop()}, for instrument {one.name!r} of spp.")
    h, w = rig.camera.height, rig.camera.width
    if isinstance(spp, AdaptiveSampling) and not sampling_error:
        raise ValueError("expected sampling_error=True with AdaptiveSampling, which goes by it.")
    if indirect not in get_args(Indirect):
        raise ValueError(f"expected indirect to be one of {', '.join(get_args(Indirect))}, got {indirect!r}.")
    keeps_apart = indirect == "filtered"
    report, launches = Progress(progress), Launches(is_watched=progress is not None)
    here = scene.in_renderer(rig)
    traced = TracedScene.of(scene.mitsuba, here)
    truth, guides = ground_truth(scene, traced, rig)
    if adaptive:
        samples = np.full(h * w, adaptive.first_spp)
    elif spp == "auto":
        samples = np.where(keeps_apart & (guides.instance.ravel() >= 0), MATTE_SPP, OTHER_SPP)
    else:
        samples = np.full(h * w, spp)
    fewest = int(samples.min())
    settings = Settings.of(scene, seed, max_depth, rr_depth)
    at_work = partial(report, 0.0)
    maps = caustic_maps(traced, here, photons, caustic_radius_m, fewest, seed, memory_bytes, at_work)
    view = View(traced, maps)
    if keeps_apart and scene.has_matte_textures:
        seen = mean_reflectance(view, settings, rig, scene.has_cutouts, min(fewest, TEXTURE_SAMPLES))
        guides = guides._replace(reflectance=seen)
    shared = LightFilter(guides) if keeps_apart else None
    glints = trace_glint(traced, here, responses, seed, at_work) if glint else None
    has_halves = sampling_error and fewest >= MIN_FOR_HALVES
    estimate = Estimate(view, settings, rig, responses, keeps_apart, has_halves, memory_bytes, launches)

    def signals_of(some: Sequence[Response] | None) -> Signals:
        channels, radiance, error = estimate.means(shared, some)
        if glints and error:
            glints.add_to(error.projector[None], glints.radiance_error[None])
            for response, values in error.channels.items():
                glints.add_to(values, glints.channels_error[response])
        return Signals(rig, channels, _energy(channels, radiance, glints), truth, sampling=error)

    left = 0.5 * PATHS_FRACTION if adaptive else 0.0  # how much follows is not known
    estimate.sample(np.arange(h * w), samples, partial(report_part, report, 0.0, PATHS_FRACTION - left))
    if adaptive and adaptive.max_spp > fewest:
        more = adaptive.samples(truth, lambda sensor: signals_of(sensor.responses())).ravel() - samples
        pixels = np.flatnonzero(more)
        if len(pixels):
            estimate.sample(pixels, more[pixels], partial(report_part, report, PATHS_FRACTION - left, left))
    signals = signals_of(None)
    report(1.0)
    truncation = estimate_truncation(estimate.mean_tally(), signals.energy, max_depth, maps.cut if maps else 0.0)
    warn_of_truncation(truncation, max_depth, stacklevel=3)  # where `transport` was called
    return replace(signals, truncation=truncation)


def _adaptive(spp: Any, sensors: Sequence[Sensor | Response]) -> AdaptiveSampling | None:
    """How the number of samples follows from readings; None: it does not."""
    if isinstance(spp, AdaptiveSampling):
        return spp
    readers = [s for s in sensors if isinstance(s, Sensor)]
    return AdaptiveSampling.of(readers) if spp == "auto" and readers and len(readers) == len(sensors) else None


def _energy(channels: dict[Response, np.ndarray], radiance: Radiance, glints: Glint | None) -> EnergySplit:
    """The energy split; glint is added to it and to the channels."""
    highlights = np.zeros((1, *radiance.direct.shape), np.float32)
    if glints:
        glints.add_to(highlights, glints.radiance[None])
        for response, values in channels.items():
            glints.add_to(values, glints.channels[response])
    return EnergySplit(
        direct=radiance.direct,
        multipath=radiance.multipath,
        specular=radiance.specular,
        caustic=radiance.caustic + radiance.faint,
        glint=highlights[0],
        ambient=radiance.ambient,
    )


def _check(scene: Scene, rig: Rig, sensors: Sequence[Sensor | Response], **counts: Any) -> None:
    if not isinstance(scene, Scene):
        raise ValueError(f"expected a Scene, as load_scene returns, got {type(scene).__name__}.")
    if not isinstance(rig, Rig):
        raise ValueError(f"expected a Rig, as scene.rig() returns, got {type(rig).__name__}.")
    if not isinstance(sensors, Sequence) or not all(isinstance(s, (Sensor, Response)) for s in sensors):
        raise ValueError(f"expected a list of sensors, for example [StructuredLight()], got {sensors!r}.")
    for sensor in sensors:
        sensor.check(rig.projector.width, rig.projector.height)
    for name, value in counts.items():
        if not isinstance(value, (int, np.integer)) or value < 1:
            raise ValueError(f"expected {name} to be a whole number of at least 1, got {value!r}.")
