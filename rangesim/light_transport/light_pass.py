# SPDX-License-Identifier: Apache-2.0
"""A light-transport pass: it traces the light of a scene once and returns the signals of every camera and sensor.

`trace_light` is the whole pass. `_CameraPass` is the part of one camera, and `loop.py` the loop over its light paths.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from rangesim.light_transport.caustic_sheets import Sheets
from rangesim.light_transport.caustics import caustic_sheets, lamp_caustics, sheet_scene
from rangesim.light_transport.chain_strata import ChainStrata
from rangesim.light_transport.glint import Glint, trace_glint
from rangesim.light_transport.ground_truth import ground_truth, mean_reflectance
from rangesim.light_transport.indirect_filter import LightFilter
from rangesim.light_transport.kernel_launches import Launches, Progress, Report, raised_as_it_is, report_part
from rangesim.light_transport.loop import PathSettings, Radiance, View
from rangesim.light_transport.narrow_lobes import warn_of_narrow_lobes
from rangesim.light_transport.ray_tables import camera_device
from rangesim.light_transport.samples_per_pixel import MOST_FOR_CAUSTICS, Sampler, samples_for_caustics
from rangesim.light_transport.sampling_error import MIN_FOR_HALVES, Estimate
from rangesim.light_transport.traced_scene import TracedScene
from rangesim.light_transport.transport_settings import TransportSettings
from rangesim.light_transport.truncation import estimate_truncation
from rangesim.light_transport.zone_sums import ZoneSums
from rangesim.response import Response
from rangesim.rig import Beam, Camera, Intrinsics, Rig, Zones
from rangesim.scene import Scene
from rangesim.scene.materials import MATERIAL_CLASSES
from rangesim.scene.media import body_around, inside_out
from rangesim.sensor import Sensor
from rangesim.settings.config import shown
from rangesim.settings.seeds import derived_seed
from rangesim.signals import EnergySplit, StillSignals

MATTE_SPP = 16
"""Samples per pixel for matte pixels that share their indirect light, if no sampler decides. They need fewer samples
than others, because sharing averages over many pixels. With twice as many, they would take twice as long."""
OTHER_SPP = 64
"""Samples per pixel for all other pixels, if no sampler decides. With twice as many, the noise would be lower by a
factor of 1.4, and the time twice as long."""
PATHS_FRACTION = 0.95
"""Fraction of the work that the progress bar shows as done when all samples are taken. The rest is for the filter and
the sums. The value changes the progress bar and nothing else."""
RAYS_TO_MEDIA = 16
"""Number of columns, and of rows, of the rays that look for media on the wrong side of their boundary. These 256 rays
may miss a body that covers less than one of the cells between them. More rays would find smaller bodies and take
longer."""
PLACES = 8
"""Number of places along the way of a scanner at which it must be in air. A body that it crosses between two of them is
not noticed; more places take more rays."""
TEXTURE_SAMPLES = 64
"""Largest number of samples per pixel over which the reflectance of a texture is averaged. More samples take longer and
change a mean over a pixel little, because samples are spread evenly."""


@raised_as_it_is()
def trace_light(
    scene: Scene,
    rigs: Sequence[Rig],
    sensors: Sequence[Sensor | Response],
    settings: TransportSettings,
    progress: Callable[[float], None] | None = None,
) -> list[StillSignals]:
    """Signals of each camera from one pass of light paths, with the channels of all sensors.

    Parameters
    ----------
    rigs : rigs with the same emitter and different cameras. The triangles of caustics are made once for all cameras.
    sensors : sensors, or bare responses. Equal responses share their channels.
    settings : TransportSettings. spp "auto" means `MATTE_SPP` samples where matte pixels share their indirect light,
        and `OTHER_SPP` elsewhere.
    progress : as for `rangesim.transport`.

    Raises
    ------
    ValueError
        As `rangesim.transport`.
    """
    _check(scene, rigs, sensors, progress)
    report, launches = Progress(progress), Launches(is_watched=progress is not None)
    responses = list(dict.fromkeys(r for s in sensors for r in ([s] if isinstance(s, Response) else s.responses())))
    if isinstance(settings.spp, Sampler):
        settings.spp.check(responses)
    traced = TracedScene.of(scene.mitsuba, scene.in_renderer(rigs[0]))
    warn_of_narrow_lobes(traced, [instance.name for instance in scene.instances], settings.caustics)
    views = [_CameraPass(scene, traced, one, settings, number, launches) for number, one in enumerate(rigs)]
    here, at_work = [view.here for view in views], partial(report, 0.0)
    sheets = caustic_sheets(traced, here, settings, at_work)
    of_lamps = lamp_caustics(traced, here, [view.range_m for view in views], settings, at_work)
    signals = []
    for number, view in enumerate(views):
        part = partial(report_part, report, number / len(views), 1 / len(views))
        signals.append(view.trace(responses, sheets, of_lamps, launches, part))
    return signals


class _CameraPass:
    """The part of a pass that belongs to one camera: its ground truth, its samples and its signals.

    Parameters
    ----------
    scene, settings : as for `trace_light`.
    traced : TracedScene with the emitter of the pass; its camera is replaced.
    rig : Rig of this camera.
    number : index of the camera, from 0. Each camera has random numbers of its own.
    launches : Launches of the path loop.
    """

    def __init__(
        self,
        scene: Scene,
        traced: TracedScene,
        rig: Rig,
        settings: TransportSettings,
        number: int,
        launches: Launches,
    ) -> None:
        self.zones = ZoneSums(rig, rig.camera.matrix) if isinstance(rig.camera, Zones) else None
        rig = rig.traced
        self.scene, self.rig, self.here = scene, rig, scene.in_renderer(rig)
        self.settings = replace(settings, seed=derived_seed(settings.seed, number)) if number else settings
        self.traced = traced._replace(camera=camera_device(self.here))
        # The indirect light of beams changes from pixel to pixel, because each has a spot of its own
        can_share = rig.camera.has_neighbours and not isinstance(rig.projector, Beam)
        self.is_filtered = settings.indirect == "filtered" and can_share
        self.truth, self.guides, branches = ground_truth(scene, self.traced, rig, self.is_filtered, launches)
        self.strata = None if branches is None else ChainStrata(scene.mitsuba, branches)
        spp, pixels = settings.spp, rig.camera.height * rig.camera.width
        if isinstance(spp, Sampler):
            self.samples = np.full(pixels, spp.first_spp)
        elif isinstance(spp, int):
            self.samples = np.full(pixels, spp)
        else:
            is_shared = np.zeros(pixels, bool)
            if self.guides is not None:
                is_matte = self.truth.material == MATERIAL_CLASSES.index("matte")
                is_shared = (is_matte & (self.guides.instance >= 0)).ravel()
            self.samples = np.where(is_shared, MATTE_SPP, OTHER_SPP)

    @property
    def range_m(self) -> float:
        """Median of the distances of what the camera sees, metres; NaN if it sees nothing."""
        seen = self.truth.range_m[np.isfinite(self.truth.range_m)]
        return float(np.median(seen)) if len(seen) else np.nan

    def trace(
        self,
        responses: Sequence[Response],
        sheets: Sheets | None,
        of_lamps: Sheets | None,
        launches: Launches,
        report: Report,
    ) -> StillSignals:
        """Signals of this camera.

        Parameters
        ----------
        responses : responses whose channels are accumulated.
        sheets, of_lamps : Sheets of the emitter, and of lamps of the scene; None: there are none.
        launches : size of the kernel launches.
        report : function that is called with the fraction of this camera's work that is done, 0..1.
        """
        settings, rig, guides = self.settings, self.rig, self.guides
        sampler = settings.spp if isinstance(settings.spp, Sampler) else None
        fewest = int(self.samples.min())
        light, ambient = (sheet_scene(one, self.here, fewest, settings.seed) for one in (sheets, of_lamps))
        view = View(self.traced, light, ambient, self.strata)
        of_paths = PathSettings.of(self.scene, settings)
        if guides is not None and self.scene.has_matte_textures:
            few = min(fewest, TEXTURE_SAMPLES)
            guides = guides.with_reflectance(mean_reflectance(view, of_paths, rig, self.scene.has_cutouts, few))
        shared = LightFilter(guides) if guides is not None else None
        at_work = partial(report, 0.0)
        sees_glint = settings.glint and not isinstance(rig.projector, Beam)
        most = int(self.samples.max())
        glints = trace_glint(self.traced, self.here, responses, settings.seed, most, at_work) if sees_glint else None
        has_halves = settings.sampling_error and fewest >= MIN_FOR_HALVES
        estimate = Estimate(
            view, of_paths, rig, responses, self.is_filtered, has_halves, settings.memory_bytes, launches
        )

        def signals_of(some: Sequence[Response] | None) -> StillSignals:
            channels, radiance, error = estimate.means(shared, some)
            if glints and error:
                glints.add_to(error.projector[None], glints.radiance_error[None])
                for response, values in error.channels.items():
                    glints.add_to(values, glints.channels_error[response])
            energy = _energy(channels, radiance, glints)
            return StillSignals(rig, energy, self.truth, channels=channels, sampling=error)

        left = 0.5 * PATHS_FRACTION if sampler else 0.0  # assumed, because the sampler's second number is not known yet
        pixels = np.arange(len(self.samples))
        estimate.sample(pixels, self.samples, partial(report_part, report, 0.0, PATHS_FRACTION - left))
        more = np.zeros_like(self.samples)
        if sampler and sampler.most_spp > fewest:
            more = self._samples(sampler, signals_of).ravel() - self.samples
        if not isinstance(settings.spp, int) and has_halves and view.sheets is not None:
            most_spp = sampler.most_spp if sampler else MOST_FOR_CAUSTICS
            more = np.maximum(more, samples_for_caustics(*estimate.caustics_and_light(), self.samples, most_spp))
        pixels = np.flatnonzero(more)
        if len(pixels):
            estimate.sample(pixels, more[pixels], partial(report_part, report, PATHS_FRACTION - left, left))
        signals = signals_of(None)
        report(1.0)
        cut = sheets.cut if sheets else 0.0
        truncation = estimate_truncation(estimate.mean_tally(), signals.energy, settings.max_depth, cut)
        signals = replace(signals, truncation=truncation)
        return signals if self.zones is None else self.zones.signals(signals)

    def _samples(self, sampler: Sampler, signals_of: Callable[[Sequence[Response] | None], StillSignals]) -> np.ndarray:
        """Number of samples of each pixel, (h, w); for zones, so many that the zones' readings need no more."""
        zones = self.zones
        if zones is None:
            return sampler.samples(self.truth, signals_of)
        return zones.spread(sampler.samples(zones.truth(self.truth), lambda some: zones.signals(signals_of(some))))


def _energy(channels: dict[Response, np.ndarray], radiance: Radiance, glints: Glint | None) -> EnergySplit:
    """The energy split of a camera. Glint is added to it. Glint is also added to the channels, in place."""
    highlights = np.zeros((1, *radiance.direct.shape), np.float32)
    if glints:
        glints.add_to(highlights, glints.radiance[None])
        for response, values in channels.items():
            glints.add_to(values, glints.channels[response])
    return EnergySplit(
        direct=radiance.direct,
        multipath=radiance.multipath,
        specular=radiance.specular,
        caustic=radiance.caustic + radiance.smooth_caustic,
        glint=highlights[0] + radiance.glint,
        ambient=radiance.ambient,
    )


def _check(scene: Scene, rigs: Sequence[Rig], sensors: Sequence[Sensor | Response], progress: Any) -> None:
    """Raise ValueError if an argument of `trace_light` has a wrong type or does not fit the others."""
    if not isinstance(scene, Scene):
        raise ValueError(f"expected a Scene, as load_scene returns, got {type(scene).__name__}.")
    if not isinstance(rigs, Sequence):
        raise ValueError(f"expected a Rig, as scene.rig() returns, or a list of them, got {type(rigs).__name__}.")
    if not rigs or not all(isinstance(rig, Rig) for rig in rigs):
        raise ValueError(f"expected one Rig or more, got {shown(list(rigs))}.")
    for rig in rigs:
        _check_in_air(scene, rig)
    for number, rig in enumerate(rigs):
        if differ := rigs[0].differences_of_emitter(rig):
            raise ValueError(
                f"expected rigs that share their emitter, as `Rig.with_camera` makes them; rig {number} has another "
                f"{', another '.join(differ)} than rig 0."
            )
    if progress is not None and not callable(progress):
        raise ValueError(f"expected progress as a function, got {shown(progress)}.")
    if not isinstance(sensors, Sequence) or not all(isinstance(s, (Sensor, Response)) for s in sensors):
        raise ValueError(f"expected a list of sensors, for example [StructuredLight()], got {sensors!r}.")
    for sensor in sensors:
        sensor.check(rigs[0].projector.width, rigs[0].projector.height)


def _check_in_air(scene: Scene, rig: Rig) -> None:
    """Raise ValueError if the camera or the projector is inside a medium, or sees one from the wrong side.

    Light paths start in air, so both would be rendered wrongly.
    """
    T_camera = scene.in_renderer(rig).T_world_camera
    devices: list[tuple[str, Camera, np.ndarray]] = [("camera", rig.camera, T_camera)]
    if isinstance(rig.projector, Intrinsics):
        devices.append(("projector", rig.projector, T_camera @ rig.T_camera_projector))
    for name, device, T in devices:
        bodies = (body_around(scene.mitsuba, place) for place in _places(device, T))
        body = next((body for body in bodies if body is not None), None)
        if body is not None:
            raise ValueError(
                f"expected the {name} to stand in air, but it is inside the medium of shape {body!r}; move it out, or "
                "let the body begin in front of it."
            )
        directions = _directions_over(device) @ T[:3, :3].T
        match inside_out(scene.mitsuba, T[:3, 3], directions[np.isfinite(directions).all(axis=1)]):
            case (shape, "interior"):
                raise ValueError(
                    f"expected the normals of shape {shape!r} to point out of the medium inside, but the {name} sees "
                    "them from behind, as if the medium lay around the shape; turn them (flip_normals)."
                )
            case (shape, _):
                raise ValueError(
                    f"expected a body that holds the exterior medium of shape {shape!r}, but none is around it, so "
                    f"the {name} would stand in that medium; put one in front of it, or leave the medium out."
                )


def _places(device: Camera, T: np.ndarray) -> np.ndarray:
    """(n, 3) float64, metres, where rays start: the device's place T, and places of a scanner that moves."""
    if device.times_s is None:
        return T[None, :3, 3]
    origins = device.rays.origins.reshape(-1, 3)
    some = origins[np.linspace(0, len(origins) - 1, min(len(origins), PLACES)).astype(int)]
    return np.vstack([T[None, :3, 3], some @ T[:3, :3].T + T[:3, 3]])


def _directions_over(device: Camera) -> np.ndarray:
    """(n, 3) float64, directions of `RAYS_TO_MEDIA` x `RAYS_TO_MEDIA` rays that are spread over the device's image."""
    steps = (np.arange(RAYS_TO_MEDIA) + 0.5) / RAYS_TO_MEDIA
    x, y = np.meshgrid(steps * device.width, steps * device.height)
    if isinstance(device, Intrinsics):
        return device.directions(np.stack([x, y], axis=-1)).reshape(-1, 3)
    return device.rays.directions[y.astype(int), x.astype(int)].reshape(-1, 3)
