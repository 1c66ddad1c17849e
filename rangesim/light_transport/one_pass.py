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
from rangesim.light_transport.indirect import Guides, smooth
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
from rangesim.signals import EnergySplit, SamplingError, Signals

BYTES_PER_LANE = 512
"""State of one lane besides its channels, an upper bound."""
Indirect = Literal["filtered", "raw"]
MATTE_SPP, OTHER_SPP = 16, 64
"""Samples of a pixel if their number is not given; measured by benchmarks/sampling_noise.py."""
FEWEST_FOR_HALVES = 3
"""Samples of a pixel: two and one."""
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
    report = Progress(progress)
    launches = Launches(is_watched=progress is not None)
    media, surfaces = media_of(scene.mitsuba), surfaces_of(scene.mitsuba)
    truth, guides = ground_truth(scene, rig, surfaces)
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
        rig,
        photons,
        caustic_radius_m,
        int(samples.min()),
        seed,
        memory_bytes,
        media,
        surfaces,
        partial(report, 0.0),
    )
    camera, projector, cutouts = Device.camera(rig), Device.projector(rig), cutouts_of(scene.mitsuba)
    view = View(scene.mitsuba, surfaces, camera, projector, maps, media, cutouts)
    whole = Budget(np.arange(h * w), samples, samples, rig.projector_irradiance)
    halves = whole.halves() if samples.min() >= FEWEST_FOR_HALVES else [whole]
    sums = [Sums(responses, 1 + keeps_apart, h, w) for _ in halves]
    done = 0
    for begin, end in _tiles(h * w, responses, memory_bytes, 1 + keeps_apart):
        for half, total in zip(halves, sums, strict=True):
            budget = half.of(slice(begin, end))
            accumulators = Accumulators(responses, end - begin, keeps_apart)
            taken = int(budget.samples.sum(dtype=np.int64))
            so_far = partial(_report, report, done / samples.sum(dtype=np.int64), taken / samples.sum(dtype=np.int64))
            traced = trace(view, settings, budget, accumulators, launches, so_far)
            total.add(slice(begin, end), traced, accumulators)
            done += taken
    tally = sum(total.tally for total in sums) / samples.reshape(h, w)
    mean = sums[0]
    error = mean.average(sums[1], *(half.samples.reshape(h, w) for half in halves)) if len(sums) == 2 else None
    if error is None:
        mean.divide(samples.reshape(h, w))
    if keeps_apart:
        if scene.has_matte_textures:
            seen = mean_reflectance(view, settings, whole, scene.has_cutouts, min(int(samples.min()), TEXTURE_SAMPLES))
            guides = guides._replace(reflectance=seen.reshape(h, w))
        _share_indirect([part for part in (mean, error) if part is not None], guides)
    radiance = Radiance(*mean.radiance)
    images = {r: parts[0] for r, parts in mean.channels.items()}
    highlights = np.zeros((1, h, w), np.float32)
    if glint:
        found = trace_glint(scene.mitsuba, rig, responses, seed, media, surfaces, partial(report, PATHS_SHARE))
        found.add_to(highlights, found.radiance[None])
        for response, values in zip(responses, found.channels, strict=True):
            found.add_to(images[response], values)
    report(1.0)
    energy = _energy(radiance, highlights[0])
    truncation = estimate_truncation(tally, energy, max_depth, maps.cut if maps else 0.0)
    warn_of_truncation(truncation, max_depth, stacklevel=3)  # where `transport` was called
    return Signals(rig, images, energy, truth, truncation=truncation, sampling=None if error is None else error.drawn())


class Sums:
    """Sums over samples of each pixel, or means.

    channels : response -> (parts, c, h, w) float32; `parts` as of `Accumulators`. radiance : (6, h, w) float32, in the
    order of `Radiance`. tally : (6, h, w) float32, in the order of `Tally`.
    """

    def __init__(self, responses: Sequence[Response], parts: int, h: int, w: int) -> None:
        self.channels = {r: np.zeros((parts, r.channels, h, w), np.float32) for r in responses}
        self.radiance = np.zeros((len(Radiance._fields), h, w), np.float32)
        self.tally = np.zeros((len(Tally._fields), h, w), np.float32)

    def add(self, pixels: slice, traced: Traced, accumulators: Accumulators) -> None:
        """Take the sums of some of the pixels."""
        parts = [*zip(self.channels.values(), accumulators.images(), strict=True)]
        for image, values in [*parts, (self.radiance, traced.radiance), (self.tally, traced.tally)]:
            image.reshape(*image.shape[:-2], -1)[..., pixels] = values

    def planes(self) -> Iterator[np.ndarray]:
        """Channels and radiance, one (h, w) view after the other."""
        for image in (*self.channels.values(), self.radiance):
            yield from image.reshape(-1, *image.shape[-2:])

    def divide(self, samples: np.ndarray) -> None:
        """Make means of these sums over so many samples (h, w)."""
        for plane in self.planes():
            plane /= samples

    def average(self, other: Sums, own_samples: np.ndarray, other_samples: np.ndarray) -> Sums:
        """Make means over all samples of these sums and the other; the other ones become a draw of the error of that.

        With means a and b over p and q samples, (a - b) sqrt(p q) / (p + q) has the variance of the mean of all.
        """
        p, q = own_samples.astype(np.float32), other_samples.astype(np.float32)
        n = p + q
        of_own, of_other = np.sqrt(q / p) / n, np.sqrt(p / q) / n
        for a, b in zip(self.planes(), other.planes(), strict=True):
            difference = a * of_own - b * of_other
            a += b
            a /= n
            b[:] = difference
        return other

    def drawn(self) -> SamplingError:
        """These errors, as signals keep them."""
        radiance = Radiance(*self.radiance)
        projector = radiance.direct + radiance.multipath + radiance.via_delta + radiance.caustic + radiance.faint
        return SamplingError({r: parts[0] for r, parts in self.channels.items()}, projector)


def _share_indirect(parts: Sequence[Sums], guides: Guides) -> None:
    """Let neighbouring pixels share what is smooth of their light, in place; what each part has first then has all."""
    smooth_light = [Radiance._fields.index("multipath"), Radiance._fields.index("faint")]
    images = [part.radiance[smooth_light] for part in parts]
    smooth(images + [values[1] for part in parts for values in part.channels.values()], guides)
    for part, image in zip(parts, images, strict=True):
        part.radiance[smooth_light] = image
        for direct, indirect in part.channels.values():
            direct += indirect


def _energy(radiance: Radiance, glint: np.ndarray) -> EnergySplit:
    return EnergySplit(
        direct=radiance.direct,
        multipath=radiance.multipath,
        via_delta=radiance.via_delta,
        caustic=radiance.caustic + radiance.faint,
        glint=glint,
        ambient=radiance.ambient,
    )


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
