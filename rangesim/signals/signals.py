# SPDX-License-Identifier: Apache-2.0
"""What one transport pass returns: signals, energy split and ground truth, as NumPy arrays."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace

import numpy as np

from rangesim.response import Response
from rangesim.rig import Rig
from rangesim.sensor import Sensor
from rangesim.settings.config import ShortRepr

ALL = "all"
"""Stands for all material classes."""
NO_SAMPLING_ERROR = "expected signals whose sampling error is known: those of a pass of at least 3 samples per pixel."


@dataclass(frozen=True, eq=False, repr=False)
class EnergySplit(ShortRepr):
    """Radiance per pixel by the kind of light path, each (h, w) float32, W/m2/sr; the parts add up to all light.

    direct : projector -> surface -> camera.
    multipath : two or more non-delta surfaces.
    specular : the camera sees the lit surface off a mirror or through glass, and nothing else between.
    caustic : the projector lights the surface off a mirror or through glass.
    glint : the camera sees the projector's lens off a mirror, through glass or directly.
    ambient : every light but the projector, before any filter.
    """

    direct: np.ndarray
    multipath: np.ndarray
    specular: np.ndarray
    caustic: np.ndarray
    glint: np.ndarray
    ambient: np.ndarray

    @property
    def projector(self) -> np.ndarray:
        """(h, w) float32, all light of the projector at full power, without ambient."""
        return self.direct + self.multipath + self.specular + self.caustic + self.glint


@dataclass(frozen=True, eq=False, repr=False)
class GroundTruth(ShortRepr):
    """First surface behind each pixel centre; NaN (ids: -1) where there is none.

    z, range_m : (h, w) float32, metres, depth along the axis and Euclidean distance from the camera centre.
    normal : (h, w, 3) float32, unit, world, towards the camera.
    instance : (h, w) int32, index into `instance_names`.
    material : (h, w) int32, index into `material_names`.
    projector_uv : (h, w, 2) float32, projector pixel coordinates of the point (also outside the projector's image).
    projector_visible : (h, w) bool, the straight segment to the projector is free and inside its image.
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

    def classes(self) -> dict[str, np.ndarray]:
        """(h, w) bool, pixels of each material class that occurs; of "all" last, which may have none."""
        seen = np.isfinite(self.z)
        of_class = {name: seen & (self.material == i) for i, name in enumerate(self.material_names)}
        return {name: mask for name, mask in of_class.items() if mask.any()} | {ALL: seen}


@dataclass(frozen=True)
class Truncation:
    """Estimate of the projector's light that a pass left out, by what ended it; fractions of all its light in the
    image, glint excepted and what is left out included. See `rangesim.light_transport.truncation`.

    depth : of paths with more scattering surfaces than `max_depth` allows; NaN where that is 2 or less, which asks for
        direct light alone. chains : of camera paths with too many delta interactions in a row. photons : of photons
        with too many.
    """

    depth: float
    chains: float
    photons: float

    @property
    def total(self) -> float:
        """All that is known to be left out, a fraction of the projector's light."""
        return float(np.nansum([self.depth, self.chains, self.photons]))


@dataclass(frozen=True, eq=False, repr=False)
class SamplingError(ShortRepr):
    """One draw of the error that the sampling of light paths leaves in signals: half the difference of what two halves
    of the samples say, scaled where these are not equal. It has the variance of the error, and its covariance between
    channels, at each pixel; it is not the error itself.

    channels : response -> (c, h, w) float32, W/m2/sr. projector : (h, w) float32, W/m2/sr, of `EnergySplit.projector`.
    """

    channels: dict[Response, np.ndarray]
    projector: np.ndarray


@dataclass(frozen=True, eq=False, repr=False)
class Signals(ShortRepr, ABC):
    """The light that sensors expose, of one time (`StillSignals`) or of several (`rangesim.motion.MovingSignals`).

    rig : Rig
    energy : EnergySplit
    truth : GroundTruth
    motion_m : (h, w) float32, metres, how far what a pixel sees moves while its frames are taken, see
        `rangesim.motion`; None: nothing moves.
    truncation : what the light transport left out, an estimate; None: not known.
    """

    rig: Rig
    energy: EnergySplit
    truth: GroundTruth
    motion_m: np.ndarray | None = field(kw_only=True, default=None)
    truncation: Truncation | None = field(kw_only=True, default=None)

    @property
    @abstractmethod
    def knows_sampling_error(self) -> bool:
        """Whether `frames` can have its sampling error added."""

    @abstractmethod
    def frames(self, sensor: Sensor, ambient_transmission: float = 1.0, sampling_errors: float = 0.0) -> np.ndarray:
        """(k, h, w) float32, W/m2/sr: the noise-free frames of `sensor`, which must have been part of the pass.

        sampling_errors : so many times a draw of the error that the sampling of light paths leaves is added.
        """


@dataclass(frozen=True, eq=False, repr=False)
class StillSignals(Signals):
    """Everything one transport pass accumulated for the sensors that share a rig.

    channels : response -> (c, h, w) float32, W/m2/sr.
    sampling : SamplingError; None: not known.
    """

    channels: dict[Response, np.ndarray] = field(kw_only=True)
    sampling: SamplingError | None = field(kw_only=True, default=None)

    def only(self, sensor: Sensor) -> StillSignals:
        """These signals without what other sensors need."""
        kept = sensor.responses()
        sampling = self.sampling
        if sampling is not None:
            sampling = replace(sampling, channels={r: sampling.channels[r] for r in kept})
        return replace(self, channels={r: self.channels[r] for r in kept}, sampling=sampling)

    @property
    def knows_sampling_error(self) -> bool:
        return self.sampling is not None

    def frames(self, sensor: Sensor, ambient_transmission: float = 1.0, sampling_errors: float = 0.0) -> np.ndarray:
        missing = [r for r in sensor.responses() if r not in self.channels]
        if missing:
            raise ValueError(
                f"expected signals of {sensor.type_name}, but the pass has no {missing[0]}; trace it with this sensor."
            )
        channels, projector = [self.channels[r] for r in sensor.responses()], self.energy.projector
        if sampling_errors:
            if self.sampling is None:
                raise ValueError(NO_SAMPLING_ERROR)
            scale, error = np.float32(sampling_errors), self.sampling
            channels = [c + scale * error.channels[r] for c, r in zip(channels, sensor.responses(), strict=True)]
            projector = projector + scale * error.projector
        frames = sensor.frames(channels, projector, ambient_transmission * self.energy.ambient)
        expected = (sensor.n_frames, *projector.shape)
        if not isinstance(frames, np.ndarray) or frames.shape != expected or frames.dtype != np.float32:
            got = f"{frames.shape} and {frames.dtype}" if isinstance(frames, np.ndarray) else type(frames).__name__
            raise ValueError(f"expected frames of {sensor.type_name} of shape {expected} and type float32, got {got}.")
        return frames
