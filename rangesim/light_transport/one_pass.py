# SPDX-License-Identifier: Apache-2.0
"""One entry point to the renderer: scene + rig + sensors -> signals."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.caustics import PHOTONS, caustic_maps, check_photons
from rangesim.light_transport.device import Device
from rangesim.light_transport.glint import trace_glint
from rangesim.light_transport.ground_truth import ground_truth
from rangesim.light_transport.launches import Launches, Progress, Report, raised_as_it_is
from rangesim.light_transport.loop import Radiance, Settings, View, trace
from rangesim.light_transport.medium import media_of
from rangesim.light_transport.responses import Accumulators
from rangesim.light_transport.sampling import Seed
from rangesim.light_transport.surfaces import surfaces_of
from rangesim.response import Response
from rangesim.rig import Rig
from rangesim.scene import Scene
from rangesim.seeds import check_seed
from rangesim.sensors import Sensor
from rangesim.signals import EnergySplit, GroundTruth, Signals

BYTES_PER_LANE = 512
"""State of one lane besides its channels, an upper bound."""
PATHS_SHARE = 0.95
"""Of the progress, that the path loop makes."""


@raised_as_it_is()
def transport(
    scene: Scene,
    rig: Rig,
    sensors: Sequence[Sensor | Response],
    *,
    spp: int = 64,
    max_depth: int = 5,
    rr_depth: int = 5,
    seed: int = 0,
    photons: int = PHOTONS,
    caustic_radius_m: float | None = None,
    glint: bool = True,
    memory_bytes: int = 2 << 30,
    progress: Callable[[float], None] | None = None,
) -> Signals:
    """Signals of any number of sensors that share a rig, from one pass of light paths.

    Parameters
    ----------
    scene : Scene
    rig : Rig
    sensors : sensors, or bare responses; none for energy split and ground truth alone.
    spp : int >= 1, samples (camera paths) per pixel.
    max_depth : int >= 1, segments of a path up to the light: 2 is direct light alone, as in Mitsuba. A photon's way
        from the projector counts as one segment, however many delta surfaces it met.
    rr_depth : int >= 1, surfaces after which Russian roulette may end a path.
    photons : int >= 0, caustic photons: the projector's light through glass and off mirrors, see
        `rangesim.light_transport.photons`; 0: none, and such light is missing. No cost without such surfaces.
    caustic_radius_m : metres, largest radius over which photons are gathered; None: as wide as the number of photons
        asks for, at most four pixels of the projector or three of the camera at the working distance. Caustics are
        blurred by about half of it.
    glint : whether the camera sees the projector's lens, in a mirror, through glass or directly.
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
    """
    _check(scene, rig, sensors, spp=spp, max_depth=max_depth, rr_depth=rr_depth)
    seed = check_seed(seed)
    check_photons(photons, caustic_radius_m)
    responses = list(dict.fromkeys(r for s in sensors for r in ([s] if isinstance(s, Response) else s.responses())))
    h, w = rig.camera.height, rig.camera.width
    channels: dict[Response, list[np.ndarray]] = {r: [] for r in responses}
    radiances: list[np.ndarray] = []
    report = Progress(progress)
    launches = Launches(is_watched=progress is not None)
    settings = Settings(
        seed=Seed.of(seed),
        spp=dr.opaque(mi.UInt32, spp),
        max_depth=dr.opaque(mi.UInt32, max_depth),
        rr_depth=dr.opaque(mi.UInt32, rr_depth),
        ambient=scene.has_ambient,
        lamps=scene.has_lamps,
    )
    irradiance = dr.opaque(mi.Float, rig.projector_irradiance / spp)  # so that sums over samples are means
    media, surfaces = media_of(scene.mitsuba), surfaces_of(scene.mitsuba)
    maps = caustic_maps(
        scene, rig, photons, caustic_radius_m, spp, seed, memory_bytes, media, surfaces, partial(report, 0.0)
    )
    view = View(scene.mitsuba, surfaces, Device.camera(rig), Device.projector(rig), irradiance, maps, media)
    for begin, end in _tiles(h * w, responses, memory_bytes):
        accumulators = Accumulators(responses, end - begin)
        so_far = partial(_report, report, begin / (h * w), (end - begin) / (h * w))
        radiances.append(trace(view, settings, spp, accumulators, begin, launches, so_far))
        for response, values in zip(responses, accumulators.images(), strict=True):
            channels[response].append(values)
    images = {r: _join(tiles, h, w) for r, tiles in channels.items()}
    highlights = np.zeros((1, h, w), np.float32)
    if glint:
        found = trace_glint(scene.mitsuba, rig, responses, seed, media, surfaces, partial(report, PATHS_SHARE))
        found.add_to(highlights, found.radiance[None])
        for response, values in zip(responses, found.channels, strict=True):
            found.add_to(images[response], values)
    report(1.0)
    truth = ground_truth(scene, rig, surfaces)
    return _signals(rig, truth, Radiance(*_join(radiances, h, w)), highlights[0], images, spp)


def _signals(
    rig: Rig, truth: GroundTruth, radiance: Radiance, glint: np.ndarray, channels: dict[Response, np.ndarray], spp: int
) -> Signals:
    split = EnergySplit(
        direct=radiance.direct,
        multipath=radiance.multipath,
        via_delta=radiance.via_delta,
        caustic=radiance.caustic,
        glint=glint,
        ambient=radiance.ambient / np.float32(spp),
    )
    return Signals(rig, channels, split, truth)


def _join(tiles: list[np.ndarray], h: int, w: int) -> np.ndarray:
    """(c, h, w) of tiles (c, pixels), without a copy where there is but one."""
    return (tiles[0] if len(tiles) == 1 else np.concatenate(tiles, axis=1)).reshape(-1, h, w)


def _report(report: Report, before: float, share: float, of_tile: float) -> None:
    report(PATHS_SHARE * (before + share * of_tile))


def _tiles(pixels: int, responses: Sequence[Response], memory_bytes: int) -> Iterator[tuple[int, int]]:
    """Ranges of flat pixel indices that fit the budget, of about equal size."""
    bytes_per_pixel = BYTES_PER_LANE + 4 * sum(r.channels for r in responses)
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
