# SPDX-License-Identifier: Apache-2.0
"""One entry point to the renderer: scene + rig + sensors -> signals."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Literal, get_args

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.caustics import PHOTONS, caustic_maps, check_photons
from rangesim.light_transport.cutouts import cutouts_of
from rangesim.light_transport.device import Device
from rangesim.light_transport.glint import trace_glint
from rangesim.light_transport.ground_truth import ground_truth, mean_reflectance
from rangesim.light_transport.indirect import smooth
from rangesim.light_transport.launches import Launches, Progress, Report, raised_as_it_is
from rangesim.light_transport.loop import Budget, Radiance, Settings, Traced, View, trace
from rangesim.light_transport.medium import media_of
from rangesim.light_transport.photons import has_delta
from rangesim.light_transport.responses import Accumulators
from rangesim.light_transport.sampling import Seed
from rangesim.light_transport.surfaces import surfaces_of
from rangesim.light_transport.truncation import Tally, estimate_truncation, warn_of_truncation
from rangesim.response import Response
from rangesim.rig import Rig
from rangesim.scene import Scene
from rangesim.seeds import check_seed
from rangesim.sensors import Sensor
from rangesim.signals import EnergySplit, Signals

BYTES_PER_LANE = 512
"""State of one lane besides its channels, an upper bound."""
Indirect = Literal["filtered", "raw"]
MATTE_SPP, OTHER_SPP = 16, 64
"""Samples of a pixel if their number is not given; measured by benchmarks/sampling_noise.py."""
TEXTURE_SAMPLES = 64
"""Samples of a pixel, at most, over which the reflectance of a texture is averaged."""
PATHS_SHARE = 0.95
"""Of the progress, that the path loop makes."""


@raised_as_it_is()
def transport(
    scene: Scene,
    rig: Rig,
    sensors: Sequence[Sensor | Response],
    *,
    spp: int | Literal["auto"] = "auto",
    max_depth: int = 5,
    rr_depth: int = 5,
    seed: int = 0,
    photons: int = PHOTONS,
    caustic_radius_m: float | None = None,
    glint: bool = True,
    indirect: Indirect = "filtered",
    memory_bytes: int = 2 << 30,
    progress: Callable[[float], None] | None = None,
) -> Signals:
    """Signals of any number of sensors that share a rig, from one pass of light paths.

    Parameters
    ----------
    scene : Scene
    rig : Rig
    sensors : sensors, or bare responses; none for energy split and ground truth alone.
    spp : int >= 1, samples (camera paths) per pixel; "auto": `MATTE_SPP` where a pixel shares its indirect light with
        its neighbours, so that sampling adds little to the noise of a sensor, and `OTHER_SPP` elsewhere.
    max_depth : int >= 1, segments of a path between surfaces that scatter it, up to the light: 2 is direct light alone,
        as in Mitsuba. Delta interactions (glass, mirrors, thin panes, coats, holes) do not count; they have a limit of
        their own, `rangesim.light_transport.delta_chain.MAX_CHAIN` in a row.
    rr_depth : int >= 1, surfaces that scatter after which Russian roulette may end a path.
    photons : int >= 0, caustic photons: the projector's light through glass and off mirrors, see
        `rangesim.light_transport.photons`; 0: none, and such light is missing. No cost without such surfaces.
    caustic_radius_m : metres, largest radius over which photons are gathered; None: as wide as the number of photons
        asks for, at most three pixels of the projector or of the camera at the distance of the point. Caustics are
        blurred by about half of it.
    glint : whether the camera sees the projector's lens, in a mirror, through glass or directly.
    indirect : "filtered": neighbouring pixels of a matte surface share their multipath, with a small bias and far less
        noise (`rangesim.light_transport.indirect`); "raw": the unbiased sum over each pixel's own paths.
    seed : int, 0 to 2^64 - 1; the same seed gives the same bytes, whatever the number of threads and the memory
        budget, and each its own noise.
    memory_bytes : the image is rendered in tiles that keep the renderer's arrays below this size; photons that landed
        come on top, some 200 bytes each.
    progress : called with the share done, 0..1, after each kernel launch, at most ten times a second. What it raises
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
    _check(scene, rig, sensors, spp=1 if spp == "auto" else spp, max_depth=max_depth, rr_depth=rr_depth)
    seed = check_seed(seed)
    check_photons(photons, caustic_radius_m)
    responses = list(dict.fromkeys(r for s in sensors for r in ([s] if isinstance(s, Response) else s.responses())))
    h, w = rig.camera.height, rig.camera.width
    if indirect not in get_args(Indirect):
        raise ValueError(f"expected indirect to be one of {', '.join(get_args(Indirect))}, got {indirect!r}.")
    keeps_apart = indirect == "filtered"
    channels: dict[Response, list[np.ndarray]] = {r: [] for r in responses}
    tiles: list[Traced] = []
    report = Progress(progress)
    launches = Launches(is_watched=progress is not None)
    media, surfaces = media_of(scene.mitsuba), surfaces_of(scene.mitsuba)
    here = scene.in_renderer(rig)
    truth, guides = ground_truth(scene, here, surfaces)
    shares = keeps_apart & (guides.instance.ravel() >= 0)
    samples = (np.where(shares, MATTE_SPP, OTHER_SPP) if spp == "auto" else np.full(h * w, spp)).astype(np.uint32)
    settings = Settings(
        seed=Seed.of(seed),
        max_depth=dr.opaque(mi.UInt32, max_depth),
        rr_depth=dr.opaque(mi.UInt32, rr_depth),
        delta=has_delta(scene.mitsuba),
        ambient=scene.has_ambient,
        lamps=scene.has_lamps,
    )
    maps = caustic_maps(
        scene,
        here,
        photons,
        caustic_radius_m,
        int(samples.min()),
        seed,
        memory_bytes,
        media,
        surfaces,
        partial(report, 0.0),
    )
    camera, projector, cutouts = Device.camera(here), Device.projector(here), cutouts_of(scene.mitsuba)
    view = View(scene.mitsuba, surfaces, camera, projector, maps, media, cutouts)
    budget = Budget(samples, rig.projector_irradiance)
    for begin, end in _tiles(h * w, responses, memory_bytes, 1 + keeps_apart):
        accumulators = Accumulators(responses, end - begin, keeps_apart)
        so_far = partial(_report, report, begin / (h * w), (end - begin) / (h * w))
        tiles.append(trace(view, settings, budget, accumulators, begin, launches, so_far))
        for response, values in zip(responses, accumulators.images(), strict=True):
            channels[response].append(values)
    sums = {r: _join(parts, h, w) for r, parts in channels.items()}
    radiances, tally = (_join([part[:, None] for part in parts], h, w)[:, 0] for parts in zip(*tiles, strict=True))
    tally[[name != "indirect" for name in Tally._fields]] /= samples.reshape(h, w)
    radiance = Radiance(*radiances)
    if keeps_apart:
        if scene.has_matte_textures:
            seen = mean_reflectance(view, settings, budget, scene.has_cutouts, min(int(samples.min()), TEXTURE_SAMPLES))
            guides = guides._replace(reflectance=seen.reshape(h, w))
        split = np.stack([radiance.multipath, radiance.faint])
        (multipath, faint), *filtered = smooth([split, *(both[1] for both in sums.values())], guides)
        radiance = radiance._replace(multipath=multipath, faint=faint)
        for (others, _), smoothed in zip(sums.values(), filtered, strict=True):
            others += smoothed
    images = {r: parts[0] for r, parts in sums.items()}
    highlights = np.zeros((1, h, w), np.float32)
    if glint:
        found = trace_glint(scene.mitsuba, here, responses, seed, media, surfaces, partial(report, PATHS_SHARE))
        found.add_to(highlights, found.radiance[None])
        for response, values in zip(responses, found.channels, strict=True):
            found.add_to(images[response], values)
    report(1.0)
    energy = _energy(radiance, highlights[0], samples.reshape(h, w))
    truncation = estimate_truncation(tally, energy, max_depth, maps.cut if maps else 0.0)
    warn_of_truncation(truncation, max_depth, stacklevel=3)  # where `transport` was called
    return Signals(rig, images, energy, truth, truncation=truncation)


def _energy(radiance: Radiance, glint: np.ndarray, samples: np.ndarray) -> EnergySplit:
    return EnergySplit(
        direct=radiance.direct,
        multipath=radiance.multipath,
        via_delta=radiance.via_delta,
        caustic=radiance.caustic + radiance.faint,
        glint=glint,
        ambient=radiance.ambient / samples.astype(np.float32),
    )


def _join(tiles: list[np.ndarray], h: int, w: int) -> np.ndarray:
    """(parts, c, h, w) of tiles (parts, c, pixels), without a copy where there is but one."""
    return (tiles[0] if len(tiles) == 1 else np.concatenate(tiles, axis=-1)).reshape(*tiles[0].shape[:2], h, w)


def _report(report: Report, before: float, share: float, of_tile: float) -> None:
    report(PATHS_SHARE * (before + share * of_tile))


def _tiles(pixels: int, responses: Sequence[Response], memory_bytes: int, parts: int) -> Iterator[tuple[int, int]]:
    """Ranges of flat pixel indices that fit the budget, of about equal size."""
    bytes_per_pixel = BYTES_PER_LANE + 4 * parts * sum(r.channels for r in responses)
    if memory_bytes < bytes_per_pixel:
        raise ValueError(f"expected a memory budget of at least {bytes_per_pixel} bytes, got {memory_bytes}.")
    tiles = -(-pixels * bytes_per_pixel // memory_bytes)
    size = max(1, -(-pixels // tiles))
    for begin in range(0, pixels, size):
        yield begin, min(begin + size, pixels)


def _check(scene: Scene, rig: Rig, sensors: Sequence[Sensor | Response], **counts: int) -> None:
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
