# SPDX-License-Identifier: Apache-2.0
"""Detectors, which turn radiance into digital numbers: the base class, and linear image sensors of EMVA 1288.

A camera with entrance pupil radius a and focal length f turns the radiance L into the irradiance E = L pi (a/f)^2 on a
pixel. A pixel of the area A then receives E A t lambda / (h c) photons in the exposure time t. With f = fx sqrt(A) the
pixel pitch cancels: photons = L pi a^2 / (fx fy) t lambda / (h c), which is radiance times etendue. The fall-off
towards the image corners belongs to the rig (`Lens.vignetting`) and is part of the radiance already.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple

import numpy as np

from rangesim.rig import Rig
from rangesim.settings.bounds import Bounds, Fraction, Metres, PositiveFraction, Seconds, Wavelength, check_fields
from rangesim.settings.config import Named

if TYPE_CHECKING:
    from rangesim.electronics.ambient import Ambient

PLANCK_TIMES_C = 6.626_070_15e-34 * 299_792_458.0
"""h c in joule metres, exact by the definition of the SI (2019)."""
Bits = Annotated[int, Bounds("a number of bits", 1, 16)]
"""Resolution of an analogue-to-digital converter or a counter, 1 to 16 bits, because digital numbers are stored as
uint8 or uint16."""
BandWidth = Annotated[float, Bounds("0 or positive", 1e-12, 2e-2, or_zero=True)]
"""Full width of a band-pass filter in metres; at most twice the longest wavelength, because the lower end of the band
must be above 0 m."""


class Gate(NamedTuple):
    """Time bins in which a sensor counts photons; they follow each other, and start anew with each laser pulse.

    period_s : seconds from one pulse to the next.
    open_s : seconds of each period that all bins together cover.
    bins : number of bins, which is the number of frames.
    """

    period_s: float
    open_s: float
    bins: int


class Blindness(NamedTuple):
    """When the timers of a pixel count nothing although photons come, as decoders undo it.

    trials : number of laser pulses times that of timers.
    until_next_pulse : whether a timer is blind from its first count to the next pulse.
    dead : bins, time for which a SPAD is blind after it fired.
    period : bins, time from pulse to pulse.
    """

    trials: int
    until_next_pulse: bool
    dead: float
    period: float


class PhotoDetector(Named, ABC):
    """Electronics that turn the radiance of a sensor's frames into digital numbers; subclasses are frozen dataclasses.

    The argument `gate` of methods is `Sensor.gate`: the time bins in which photons are counted. It is None for a sensor
    whose frames integrate all light of an exposure.
    """

    known: ClassVar[dict[str, type[Any]]] = {}
    type_name: ClassVar[str]
    wavelength_m: float
    quantum_efficiency: float
    bits: int
    ambient_transmission: float
    band_width_m: float
    min_exposure_s: float
    max_exposure_s: float

    @property
    @abstractmethod
    def capacity_e(self) -> float:
        """Number of electrons (or counts) at which a pixel saturates."""

    @abstractmethod
    def mean_electrons(self, radiance: np.ndarray, gate: Gate | None, rig: Rig, exposure_s: float) -> np.ndarray:
        """Expected electrons (or counts) of frames, dark electrons included: (..., h, w) float64.

        radiance : (..., h, w) mean radiance of each frame, W/m2/sr.
        """

    @abstractmethod
    def read_out(self, radiance: np.ndarray, gate: Gate | None, rig: Rig, exposure_s: float, seed: int) -> np.ndarray:
        """Digital numbers with noise: (k, h, w) uint8 or uint16, see `dtype`.

        radiance : (k, h, w) mean radiance of each frame, W/m2/sr.
        seed : the same seed gives the same noise.

        Raises
        ------
        ValueError
            The detector integrates and the sensor counts, or the other way round.
        """

    @abstractmethod
    def check(self, gate: Gate | None) -> None:
        """Raise ValueError if the detector integrates and the sensor counts photons, or the other way round."""

    @property
    def black_level_dn(self) -> float:
        """Mean digital number of a pixel without light."""
        return 0.0

    def own_noise_e2(self, dark_e: float) -> float:
        """Variance, in electrons squared, that the detector itself adds to a frame with `dark_e` dark electrons."""
        return dark_e

    def noise_dn(self, dn: np.ndarray) -> np.ndarray | None:
        """Standard deviation of pixels with the mean `dn`, digital numbers; None for a detector that counts photons.

        The decoders of photon counts have their own statistics.
        """
        return None

    def photons_per_pulse(self, radiance: np.ndarray, gate: Gate | None, rig: Rig) -> np.ndarray | None:
        """Mean number of photons that a pixel detects per laser pulse: (h, w) float64; None if the detector integrates.

        radiance : (k, h, w) mean radiance of each frame, W/m2/sr.
        """
        return None

    def blindness(self, gate: Gate | None, exposure_s: float) -> Blindness | None:
        """When the timers of a pixel are blind; None for a detector that integrates, or if no photon is hidden."""
        return None

    def ambient_fraction(self, gate: Gate | None, ambient: Ambient | None = None) -> float:
        """Factor on the scene's ambient light: the part of it that passes the filter and is counted.

        ambient : spectrum and strength of that light; the filter's band then decides the factor. None: they are not
            known, and the factor is `ambient_transmission`.
        """
        return self.ambient_transmission if ambient is None else ambient.in_band(self.wavelength_m, self.band_width_m)

    @property
    def max_dn(self) -> int:
        """Largest digital number; a pixel with this number is saturated."""
        return int(2**self.bits - 1)

    @property
    def dtype(self) -> type[np.unsignedinteger]:
        """Smallest unsigned integer type that holds all digital numbers."""
        return np.uint8 if self.bits <= 8 else np.uint16

    def electron_rate_per_radiance(self, rig: Rig) -> float:
        """Electrons per second of exposure and per W/m2/sr of radiance."""
        etendue = rig.camera.etendue_m2sr(rig.camera_lens.aperture_radius_m)
        return float(etendue * self.quantum_efficiency * self.wavelength_m / PLANCK_TIMES_C)

    def _check(self) -> None:
        check_fields(self)
        if self.band_width_m >= 2 * self.wavelength_m:
            raise ValueError(
                f"expected a band_width_m below {2 * self.wavelength_m:g}, twice the wavelength_m, "
                f"got {self.band_width_m}."
            )
        if self.min_exposure_s > self.max_exposure_s:
            raise ValueError(
                f"expected min_exposure_s <= max_exposure_s, got {self.min_exposure_s} > {self.max_exposure_s}."
            )


class LinearPixel(NamedTuple):
    """The linear response of a `Detector` to radiance, for one exposure time.

    electrons_per_radiance : electrons per W/m2/sr.
    dark_e : electrons of the dark current.
    max_mean_e : electrons, largest expected number for which noise is drawn; the pixel is then saturated, whatever its
        noise.
    read_noise_e : electrons rms.
    gain_dn_e : digital numbers per electron.
    offset_dn, max_dn : digital numbers, black level and largest number.
    """

    electrons_per_radiance: float
    dark_e: float
    max_mean_e: float
    read_noise_e: float
    gain_dn_e: float
    offset_dn: float
    max_dn: int


def streams(seed: int, n: int) -> list[np.random.Generator]:
    """`n` independent random generators; the same seed gives the same generators."""
    return [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(n)]


@dataclass(frozen=True)
class Detector(PhotoDetector):
    """Linear image sensor as in EMVA Standard 1288, release 4.0 Linear (symbols of the standard in brackets).

    Parameters
    ----------
    wavelength_m : float, metres, wavelength of the emitter's light [lambda].
    quantum_efficiency : float in (0, 1], which includes the fill factor and the lens transmission [eta].
    full_well_e : float, electrons, saturation capacity [mu_e.sat]; it maps to the largest digital number. The well
        itself is a little deeper, so a saturated pixel reads that number in spite of its noise.
    read_noise_e : float, electrons rms, temporal dark noise [sigma_d].
    dark_current_e_s : float, electrons per second [mu_I].
    bits : int in 1..16, ADC resolution.
    offset_dn : float, digital numbers, black level [mu_y.dark without dark current].
    ambient_transmission : float in 0..1, fraction of ambient light that the band-pass filter lets through. It is used
        where the kind of light is not stated (`expose` without `ambient`); the default is right for sunlight and the
        default band.
    band_width_m : float, metres, full width of the band-pass filter around wavelength_m. It is used where the kind of
        light is stated. Inside the band, ambient light has the same losses as the emitter's light, and they are part of
        the quantum efficiency. Outside the band nothing passes. 0: no ambient light at all.
    pixel_pitch_m : float, metres; pixels are square [sqrt A]. No result depends on the pitch, because it cancels, see
        `rangesim.electronics.detector`.
    min_exposure_s, max_exposure_s : float, seconds, limits of the automatic exposure.

    Raises
    ------
    ValueError
        A number out of its range, or a black level that is not below the largest digital number.

    Examples
    --------
    The gain follows from the bits and the full well, and the noise at a digital number from the gain:

    >>> from rangesim import Detector
    >>> detector = Detector(bits=10, full_well_e=10_000, read_noise_e=4)
    >>> detector.max_dn, round(detector.gain_dn_e, 4)
    (1023, 0.1007)
    >>> [round(float(sigma), 2) for sigma in detector.noise_dn([16, 500, 1000])]
    [0.5, 7.0, 9.97]
    """

    wavelength_m: Wavelength = 850e-9
    quantum_efficiency: PositiveFraction = 0.4
    full_well_e: Annotated[float, Bounds("positive and finite", 1, 1e9)] = 12_000.0
    read_noise_e: Annotated[float, Bounds("0 or positive", 0, 1e9)] = 5.0
    dark_current_e_s: Annotated[float, Bounds("0 or positive", 0, 1e12)] = 20.0
    bits: Bits = 12
    offset_dn: Annotated[float, Bounds("0 or positive", 0, 65535)] = 16.0
    ambient_transmission: Fraction = 0.05
    band_width_m: BandWidth = 50e-9
    pixel_pitch_m: Metres = 5e-6
    min_exposure_s: Seconds = 10e-6
    max_exposure_s: Seconds = 0.1

    type_name: ClassVar[str] = "emva1288"

    def __post_init__(self) -> None:
        self._check()
        if self.offset_dn >= self.max_dn:
            raise ValueError(f"expected 0 <= offset_dn < {self.max_dn}, got {self.offset_dn}.")

    @classmethod
    def time_of_flight(cls) -> Detector:
        """A lock-in pixel of an indirect time-of-flight camera: large, deep, noisier, and behind a narrow filter."""
        return cls(full_well_e=100_000.0, read_noise_e=20.0, dark_current_e_s=1000.0, pixel_pitch_m=10e-6,
                   ambient_transmission=0.03, band_width_m=30e-9, max_exposure_s=0.02)  # fmt: skip

    @classmethod
    def ideal(cls) -> Detector:
        """A detector with shot noise and 16-bit quantisation alone: no losses, no dark electrons, and a deep well."""
        return cls(quantum_efficiency=1.0, full_well_e=1e6, read_noise_e=0.0, dark_current_e_s=0.0, bits=16,
                   offset_dn=0.0, ambient_transmission=0.0, band_width_m=0.0)  # fmt: skip

    @property
    def gain_dn_e(self) -> float:
        """Overall system gain in digital numbers per electron [K]."""
        return (self.max_dn - self.offset_dn) / self.full_well_e

    @property
    def capacity_e(self) -> float:
        return self.full_well_e

    def check(self, gate: Gate | None) -> None:
        if gate is not None:
            raise ValueError("expected a SpadDetector for a sensor that counts photons, got an integrating Detector.")

    @property
    def black_level_dn(self) -> float:
        return self.offset_dn

    def own_noise_e2(self, dark_e: float) -> float:
        return dark_e + self.read_noise_e**2 + 1 / (12 * self.gain_dn_e**2)

    def mean_electrons(self, radiance: np.ndarray, gate: Gate | None, rig: Rig, exposure_s: float) -> np.ndarray:
        pixel = self._pixel(rig, exposure_s)
        return np.asarray(pixel.electrons_per_radiance * np.asarray(radiance, dtype=np.float64) + pixel.dark_e)

    def read_out(self, radiance: np.ndarray, gate: Gate | None, rig: Rig, exposure_s: float, seed: int) -> np.ndarray:
        self.check(gate)
        from pcgraph.parallel import in_blocks
        from rangesim.electronics.shot_noise import read_frame

        pixel, rngs = self._pixel(rig, exposure_s), streams(seed, len(radiance))
        result = np.empty(radiance.shape, dtype=self.dtype)

        def read(start: int, stop: int) -> None:
            for k in range(start, stop):
                read_frame(rngs[k], np.ascontiguousarray(radiance[k], dtype=np.float32), pixel, result[k])

        in_blocks(read, len(radiance), smallest=1)
        return result

    def _pixel(self, rig: Rig, exposure_s: float) -> LinearPixel:
        return LinearPixel(
            electrons_per_radiance=self.electron_rate_per_radiance(rig) * exposure_s,
            dark_e=float(self.dark_current_e_s * exposure_s),
            max_mean_e=10.0 * self.full_well_e + 1000,
            read_noise_e=float(self.read_noise_e),
            gain_dn_e=float(self.gain_dn_e),
            offset_dn=float(self.offset_dn),
            max_dn=self.max_dn,
        )

    def noise_dn(self, dn: np.ndarray) -> np.ndarray:
        """Standard deviation of pixels with the mean `dn` (mu), in digital numbers: float32, in the shape of `dn`.

        It is sqrt(K^2 sigma_d^2 + 1/12 + K (mu - offset)).
        """
        k = self.gain_dn_e
        shot = k * np.maximum(np.asarray(dn, dtype=np.float32) - self.offset_dn, 0)
        return np.asarray(np.sqrt(np.float32(k**2 * self.read_noise_e**2 + 1 / 12) + shot), dtype=np.float32)
