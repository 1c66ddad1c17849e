# SPDX-License-Identifier: Apache-2.0
"""Results of a transport pass: signals, energy split and ground truth, as NumPy arrays."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple, overload

import numpy as np

from rangesim.response import GLINT, DenseResponse, LightPath, NumpyMath, Response, SparseResponse
from rangesim.rig import Rig
from rangesim.sensor import Sensor
from rangesim.settings.config import ShortRepr

ALL = "all"
"""Name of the row for all material classes together, in tables and mappings by class."""
NO_SAMPLING_ERROR = "expected signals whose sampling error is known: those of a pass of at least 3 samples per pixel."
"""Message of the ValueError for a caller who asks for a sampling error that is not known."""


@dataclass(frozen=True, eq=False, repr=False)
class EnergySplit(ShortRepr):
    """Radiance of each pixel by the kind of light path; the parts add up to all light.

    Each part is (h, w) float32, W/m2/sr.

    direct : emitter -> surface -> camera.
    multipath : paths with two or more scattering (non-delta) surfaces.
    specular : the camera sees one lit surface in a mirror or through glass.
    caustic : the emitter lights the surface by way of a mirror or through glass.
    glint : the camera sees the emitter itself, in a mirror, through glass or directly.
    ambient : light of everything but the emitter, before any filter.
    """

    direct: np.ndarray
    multipath: np.ndarray
    specular: np.ndarray
    caustic: np.ndarray
    glint: np.ndarray
    ambient: np.ndarray

    @property
    def projector(self) -> np.ndarray:
        """All light of the emitter at full power, without ambient light: (h, w) float32, W/m2/sr."""
        return self.direct + self.multipath + self.specular + self.caustic + self.glint

    def scaled(self, factor: float) -> EnergySplit:
        """The same split with that many times the emitter's light; ambient light stays as it is."""
        kinds = ("direct", "multipath", "specular", "caustic", "glint")
        return replace(self, **{kind: np.float32(factor) * getattr(self, kind) for kind in kinds})


class Surface(NamedTuple):
    """A part of the ground truth that a row of a table is about.

    kind : "object", "part" (a shape of an object that has several), "material" or "all". name : of the object, of the
        shape or of the material class, or "all".
    mask : (h, w) bool, its pixels.
    """

    kind: str
    name: str
    mask: np.ndarray


@dataclass(frozen=True, eq=False, repr=False)
class GroundTruth(ShortRepr):
    """First surface behind each pixel centre. Where there is none, numbers are NaN and indices are -1.

    z, range_m : (h, w) float32, metres, depth along the camera's axis and Euclidean distance from the camera centre.
    normal : (h, w, 3) float32, unit vectors, world, on the camera's side of the surface.
    instance : (h, w) int32, index into `instance_names`.
    material : (h, w) int32, index into `material_names`.
    projector_uv : (h, w, 2) float32, pixel coordinates of the point in the projector, also outside its image.
    projector_visible : (h, w) bool, whether the straight line to the projector is free and the point is in its image.
    nearest_m, farthest_m : (h, w) float32, metres, least and largest range of the surfaces within a zone; the other
        fields then describe the surface that fills most of it. None: pixels are no `rangesim.rig.Zones`.
    instance_objects : for each instance the name of the object that it is a part of; empty for background, such as a
        table or a wall (`rangesim.scene.objects`). No names at all: not known.

    Examples
    --------
    >>> from rangesim import load_signals
    >>> truth = load_signals("signals.npz").truth  # doctest: +SKIP
    >>> pixels = {name: int(mask.sum()) for name, mask in truth.classes().items()}  # doctest: +SKIP
    """

    z: np.ndarray
    range_m: np.ndarray
    normal: np.ndarray
    instance: np.ndarray
    material: np.ndarray
    projector_uv: np.ndarray
    projector_visible: np.ndarray
    instance_names: tuple[str, ...] = ()
    material_names: tuple[str, ...] = ()
    nearest_m: np.ndarray | None = None
    farthest_m: np.ndarray | None = None
    instance_objects: tuple[str, ...] = ()

    @property
    def object_names(self) -> tuple[str, ...]:
        """Names of the objects of the scene, seen or not; none if there is only background, or if it is not known."""
        return tuple(dict.fromkeys(name for name in self.instance_objects if name))

    @property
    def object_index(self) -> np.ndarray:
        """(h, w) int32, index into `object_names` of the object behind each pixel; -1 for background and nothing."""
        if not self.instance_objects:
            return np.full_like(self.instance, -1)
        index_of = {name: i for i, name in enumerate(self.object_names)}
        of_instance = [index_of.get(name, -1) for name in self.instance_objects]
        return np.array([*of_instance, -1], dtype=np.int32)[self.instance]

    def objects(self) -> dict[str, np.ndarray]:
        """Pixels of each object that the camera sees, as (h, w) bool by name."""
        index = self.object_index
        masks = {name: index == i for i, name in enumerate(self.object_names)}
        return {name: mask for name, mask in masks.items() if mask.any()}

    def parts(self) -> dict[str, np.ndarray]:
        """Pixels of each shape that the camera sees of an object of several shapes, as (h, w) bool by name."""
        shapes = list(zip(self.instance_names, self.instance_objects, strict=False))
        several = {thing for _, thing in shapes if thing and self.instance_objects.count(thing) > 1}
        masks = {name: self.instance == i for i, (name, thing) in enumerate(shapes) if thing in several}
        return {name: mask for name, mask in masks.items() if mask.any()}

    def classes(self) -> dict[str, np.ndarray]:
        """Pixels of each material class that occurs, as (h, w) bool by name; "all" comes last, and may be empty."""
        seen = np.isfinite(self.z)
        of_class = {name: seen & (self.material == i) for i, name in enumerate(self.material_names)}
        return {name: mask for name, mask in of_class.items() if mask.any()} | {ALL: seen}

    def surfaces(self) -> list[Surface]:
        """The surfaces that tables have rows for: objects, their parts, material classes, and all together."""
        *materials, (_, seen) = self.classes().items()
        groups = {"object": self.objects().items(), "part": self.parts().items(), "material": materials}
        return [Surface(kind, *item) for kind, items in groups.items() for item in items] + [Surface(ALL, ALL, seen)]


@dataclass(frozen=True)
class Truncation:
    """Estimate of the emitter's light that a pass left out, split by the limit that ended the light paths.

    Each field is a fraction of all the emitter's light in the image, including what is left out and excluding glint.
    See `rangesim.light_transport.truncation`.

    depth : light of paths with more scattering surfaces than `max_depth` allows. NaN if `max_depth` is 2 or less,
        because such a pass computes direct light only.
    chains : light of camera paths with more delta interactions in a row than allowed.
    caustics : light that the projector throws onto surfaces with more delta interactions in a row than allowed.

    Examples
    --------
    >>> from rangesim.signals import Truncation
    >>> Truncation(depth=float("nan"), chains=0.01, caustics=0.005).total
    0.015
    """

    depth: float
    chains: float
    caustics: float

    @property
    def total(self) -> float:
        """Sum of all parts that are known (not NaN), as a fraction of the emitter's light."""
        return float(np.nansum([self.depth, self.chains, self.caustics]))


@dataclass(frozen=True, eq=False, repr=False)
class SamplingError(ShortRepr):
    """Random numbers with the same statistics as the error that the sampling of light paths leaves in signals.

    It is half the difference between the results of two halves of the samples, scaled where the halves differ in size.
    At each pixel it has the variance of the error, and the error's covariance between channels. It is not the error.

    channels : response -> (c, h, w) float32, W/m2/sr, error of `StillSignals.channels`.
    projector : (h, w) float32, W/m2/sr, error of `EnergySplit.projector`.
    """

    channels: dict[Response, np.ndarray]
    projector: np.ndarray


@dataclass(frozen=True, eq=False, repr=False)
class Signals(ShortRepr, ABC):
    """Light that sensors expose, at one time (`StillSignals`) or at several times (`rangesim.motion.MovingSignals`).

    `rangesim.transport` returns it, `rangesim.load_signals` reads it from a file, and `rangesim.expose` takes it.

    rig : Rig, camera and emitter of the pass.
    energy : EnergySplit, radiance by the kind of light path.
    truth : GroundTruth, the first surface behind each pixel.
    motion_m : (h, w) float32, metres, distance that the surface behind a pixel moves while its frames are taken, see
        `rangesim.motion`; None if nothing moves.
    truncation : Truncation, estimate of the light that is left out; None: not known.

    Examples
    --------
    The light of one pass is exposed by any sensor of that pass, with any detector and exposure:

    >>> import rangesim
    >>> sensor = rangesim.StructuredLight()
    >>> scene = rangesim.load_scene("matte")  # doctest: +SKIP
    >>> signals = rangesim.transport(scene, scene.rig(width=160), sensor)  # doctest: +SKIP
    >>> bright = rangesim.expose(signals, sensor, exposure_s=1e-2)  # doctest: +SKIP
    >>> noisy = rangesim.expose(signals, sensor, rangesim.Detector(read_noise_e=20.0))  # doctest: +SKIP
    """

    rig: Rig
    energy: EnergySplit
    truth: GroundTruth
    motion_m: np.ndarray | None = field(kw_only=True, default=None)
    truncation: Truncation | None = field(kw_only=True, default=None)

    @property
    def cameras(self) -> tuple[Signals, ...]:
        """Signals of each camera of the pass, the reference camera's first; by default these alone."""
        return (self,)

    def at_wavelength(self, wavelength_m: float | None) -> Signals:
        """The same signals of an emitter with this wavelength in metres; None: not stated.

        The renderer is monochrome, so the light is the same; what a detector makes of it may differ.
        """
        return replace(self, rig=replace(self.rig, wavelength_m=wavelength_m))

    @property
    @abstractmethod
    def knows_sampling_error(self) -> bool:
        """Whether the sampling error is known, so that `frames` can add it."""

    @abstractmethod
    def frames(self, sensor: Sensor, ambient_transmission: float = 1.0, sampling_errors: float = 0.0) -> np.ndarray:
        """Frames of a sensor without the detector's noise: (k, h, w) float32, W/m2/sr.

        sensor : a sensor that was part of the pass.
        ambient_transmission : factor (0..1) on the ambient light.
        sampling_errors : factor on the draw of the sampling error that is added; 0: none is added.

        Raises
        ------
        ValueError
            The pass has no signals of this sensor, or the sampling error is asked for but not known.
        """


@dataclass(frozen=True, eq=False, repr=False)
class StillSignals(Signals):
    """Everything that one transport pass accumulated, for all sensors that share its rig.

    channels : response -> (c, h, w) float32, W/m2/sr, light weighted by each channel of the response.
    sampling : SamplingError of `channels`; None: not known.
    """

    channels: dict[Response, np.ndarray] = field(kw_only=True)
    sampling: SamplingError | None = field(kw_only=True, default=None)

    def at_power(self, power_w: float) -> StillSignals:
        """The signals of the same pass if its emitter had another power, watts: light is linear."""
        factor = np.float32(power_w / self.rig.projector_power_w)
        if factor == 1:
            return self
        sampling = self.sampling
        if sampling is not None:
            errors = {r: factor * c for r, c in sampling.channels.items()}
            sampling = SamplingError(errors, factor * sampling.projector)
        return replace(
            self,
            rig=replace(self.rig, projector_power_w=power_w),
            energy=self.energy.scaled(float(factor)),
            channels={r: factor * c for r, c in self.channels.items()},
            sampling=sampling,
        )

    def only(self, sensor: Sensor) -> StillSignals:
        """The same signals without the channels that only other sensors need."""
        kept = sensor.responses()
        sampling = self.sampling
        if sampling is not None:
            sampling = replace(sampling, channels={r: sampling.channels[r] for r in kept})
        return replace(self, channels={r: self.channels[r] for r in kept}, sampling=sampling)

    @property
    def knows_sampling_error(self) -> bool:
        return self.sampling is not None

    def row_of_pixels(self, where: np.ndarray, sensor: Sensor) -> StillSignals:
        """The light of some pixels alone as an image of one row, (1, n), for `frames` of a sensor that is read by pixel
        (`Decoder.pixel_reader`). `rig` and `truth` are still those of the whole image.

        Parameters
        ----------
        where : (h, w) bool, the n pixels. sensor : the sensor whose channels are kept.
        """
        pixels = np.flatnonzero(where)

        def row_of(channels: dict[Response, np.ndarray]) -> dict[Response, np.ndarray]:
            return {r: channels[r].reshape(r.channels, -1).take(pixels, axis=1)[:, None] for r in sensor.responses()}

        energy = EnergySplit(*(getattr(self.energy, field.name)[where][None] for field in fields(self.energy)))
        sampling = self.sampling
        if sampling is not None:
            sampling = SamplingError(row_of(sampling.channels), sampling.projector[where][None])
        return replace(self, energy=energy, channels=row_of(self.channels), sampling=sampling)

    def frames(self, sensor: Sensor, ambient_transmission: float = 1.0, sampling_errors: float = 0.0) -> np.ndarray:
        missing = [r for r in sensor.responses() if r not in self.channels]
        if missing:
            raise ValueError(
                f"expected signals of {sensor.type_name}, but the pass has no {missing[0]}; "
                "run transport with this sensor, too."
            )
        channels, projector = [self.channels[r] for r in sensor.responses()], self.energy.projector
        if sampling_errors:
            if self.sampling is None:
                raise ValueError(NO_SAMPLING_ERROR)
            scale, error = np.float32(sampling_errors), self.sampling
            channels = [c + scale * error.channels[r] for c, r in zip(channels, sensor.responses(), strict=True)]
            projector = projector + scale * error.projector
        if self.rig.cover_glass is not None:
            window = np.float32(self.rig.cover_glass_radiance)
            channels = [
                c + window * _off_glass(r, self.rig)[:, None, None]
                for c, r in zip(channels, sensor.responses(), strict=True)
            ]
            projector = projector + window
        frames = sensor.frames(channels, projector, ambient_transmission * self.energy.ambient)
        expected = (sensor.n_frames, *projector.shape)
        if not isinstance(frames, np.ndarray) or frames.shape != expected or frames.dtype != np.float32:
            got = f"{frames.shape} and {frames.dtype}" if isinstance(frames, np.ndarray) else type(frames).__name__
            raise ValueError(f"expected frames of {sensor.type_name} of shape {expected} and type float32, got {got}.")
        return frames


def _off_glass(response: Response, rig: Rig) -> np.ndarray:
    """(c,) float32, weights with which a response counts light off the cover glass: the mean over the emitter's pixels.

    The light is no first return: a sensor that sees first returns alone does not see it.
    """
    assert rig.cover_glass is not None
    projector, length = rig.projector, rig.cover_glass.path_m
    total = np.zeros(response.channels)
    for row in range(projector.height):
        u = np.arange(projector.width) + 0.5
        path = LightPath(u, np.full_like(u, row + 0.5), np.full_like(u, length), np.zeros(u.shape, bool), GLINT)
        if isinstance(response, SparseResponse):
            for index, weight in response.bin_weights(path, NumpyMath()):
                weights = np.broadcast_to(weight, u.shape)
                total += np.bincount(index.astype(np.int64), weights, response.channels + 1)[: response.channels]
        elif isinstance(response, DenseResponse):
            total += [np.broadcast_to(w, u.shape).sum() for w in response.weights(path, NumpyMath())]
    return (total / (projector.width * projector.height)).astype(np.float32)


@dataclass(frozen=True, eq=False, repr=False)
class SignalSet(Signals, Sequence[Signals]):
    """Signals of several cameras with one emitter, as `rangesim.transport` returns for a list of rigs.

    The set has the attributes of the first camera's signals, which is the reference camera: `compare` and `explain`
    take the set as they take signals of one camera, and `expose` makes a `CaptureSet` of it. As a sequence it holds the
    signals of each camera, so ``for signals in ...`` and ``left, right = ...`` work, too.

    of_cameras : signals of each camera, the reference camera's first.

    Examples
    --------
    >>> import rangesim
    >>> from rangesim.sensors import ActiveStereo
    >>> scene, sensor = rangesim.load_scene("plane"), ActiveStereo()  # doctest: +SKIP
    >>> both = rangesim.transport(scene, sensor.rigs(scene.rig(0.025, (640, 400))), [sensor])  # doctest: +SKIP
    >>> image = rangesim.decode(rangesim.expose(both, sensor))  # doctest: +SKIP
    """

    of_cameras: tuple[Signals, ...] = field(kw_only=True)

    @classmethod
    def of(cls, signals: Sequence[Signals]) -> SignalSet:
        """The set of these signals, the reference camera's first.

        Raises
        ------
        ValueError
            There are none, or their rigs have different emitters.
        """
        cameras = tuple(signals)
        if not cameras or not all(isinstance(one, Signals) for one in cameras):
            raise ValueError(f"expected signals of one camera or more, got {signals!r}.")
        first = cameras[0]
        for number, other in enumerate(cameras[1:], 1):
            if names := other.rig.differences_of_emitter(first.rig):
                raise ValueError(f"expected signals of one emitter, but camera {number} has another {names[0]}.")
        return cls(
            first.rig, first.energy, first.truth, motion_m=first.motion_m, truncation=first.truncation,
            of_cameras=cameras,
        )  # fmt: skip

    def at_wavelength(self, wavelength_m: float | None) -> SignalSet:
        return SignalSet.of([one.at_wavelength(wavelength_m) for one in self.of_cameras])

    @property
    def cameras(self) -> tuple[Signals, ...]:
        return self.of_cameras

    def at_power(self, power_w: float) -> SignalSet:
        """The signals of the same pass if its emitter had another power, watts.

        Raises
        ------
        ValueError
            Something moves in the signals of a camera.
        """
        if not all(isinstance(one, StillSignals) for one in self.of_cameras):
            raise ValueError("expected signals of a world at rest.")
        return SignalSet.of([one.at_power(power_w) for one in self.of_cameras if isinstance(one, StillSignals)])

    @property
    def knows_sampling_error(self) -> bool:
        return all(one.knows_sampling_error for one in self.of_cameras)

    def frames(self, sensor: Sensor, ambient_transmission: float = 1.0, sampling_errors: float = 0.0) -> np.ndarray:
        """Frames of the reference camera; those of the others are `self[1].frames(...)` and so on."""
        return self.of_cameras[0].frames(sensor, ambient_transmission, sampling_errors)

    def __len__(self) -> int:
        return len(self.of_cameras)

    def __iter__(self) -> Iterator[Signals]:
        return iter(self.of_cameras)

    @overload
    def __getitem__(self, index: int) -> Signals: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Signals, ...]: ...
    def __getitem__(self, index: int | slice) -> Signals | tuple[Signals, ...]:
        return self.of_cameras[index]
