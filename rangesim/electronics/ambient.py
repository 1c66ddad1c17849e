# SPDX-License-Identifier: Apache-2.0
"""Ambient light by kind and strength: how much of it passes a sensor's band-pass filter.

A transport pass keeps the light of the scene's own emitters apart (`Signals.energy.ambient`), without a spectrum, in
the units of the scene file. `Ambient` says what that light is: an illuminant with a spectrum, and how strong. Light is
linear, so both are factors on the finished pass:

    ambient radiance that counts = energy.ambient * scale * fraction

scale : broadband irradiance of the illuminant over the irradiance in the scene's units.
fraction : of the illuminant's broadband irradiance, the part inside the filter's band.

Reflectances are those of the scene, so of the sensor's wavelength, as they should be: only light of that band counts.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from scipy.special import ndtr

from rangesim.electronics.sunlight import BELOW_W_M2, EDGES_NM, SPECTRAL_W_M2_NM, TOTAL_W_M2
from rangesim.settings.bounds import Bounds, check_fields

SECOND_RADIATION_CONSTANT = 1.438_776_877e-2
"""h c / k in metre kelvins (CODATA 2018)."""
LUMINOUS_EFFICACY = 683.0
"""Lumens per watt at the peak of V(lambda)."""
Kelvins = Annotated[float, Bounds("positive and finite", 300, 1e5)]
Strength = Annotated[float, Bounds("0 or positive", 0, 1e12)]
_VISIBLE_NM = np.arange(380.0, 781.0)


def photopic(wavelength_nm: Any) -> np.ndarray:
    """V(lambda), the eye's sensitivity, 0..1, of wavelengths in nm; within 0.008 of the CIE 1924 table.

    Wyman, Sloan, Shirley, Simple Analytic Approximations to the CIE XYZ Color Matching Functions, JCGT 2(2), 2013.
    """
    x = np.asarray(wavelength_nm, dtype=np.float64)
    first, second = (x - 568.8) / np.where(x < 568.8, 46.9, 40.5), (x - 530.9) / np.where(x < 530.9, 16.3, 31.1)
    return np.asarray(0.821 * np.exp(-0.5 * first**2) + 0.286 * np.exp(-0.5 * second**2))


class Illuminant(ABC):
    """A spectrum, as the fraction of its irradiance below each wavelength."""

    @abstractmethod
    def below(self, wavelength_nm: np.ndarray) -> np.ndarray:
        """Fraction 0..1 of the broadband irradiance at wavelengths below those given, nm. ValueError where unknown."""

    def fraction(self, low_nm: float, high_nm: float) -> float:
        """Fraction 0..1 of the broadband irradiance between two wavelengths, nm."""
        low, high = self.below(np.array([low_nm, high_nm]))
        return float(high - low)

    @property
    def efficacy_lm_w(self) -> float:
        """Luminous efficacy of radiation: lux per W/m2 of broadband irradiance."""
        weights = photopic((_VISIBLE_NM[1:] + _VISIBLE_NM[:-1]) / 2)
        return float(LUMINOUS_EFFICACY * (weights * np.diff(self.below(_VISIBLE_NM))).sum())


class Sun(Illuminant):
    """Sunlight and sky, ASTM G173-03 global (`rangesim.electronics.sunlight`); broadband is 280 to 4000 nm."""

    def below(self, wavelength_nm: np.ndarray) -> np.ndarray:
        if np.min(wavelength_nm) < EDGES_NM[0] or np.max(wavelength_nm) > EDGES_NM[-1]:
            raise ValueError(
                f"expected wavelengths of {EDGES_NM[0]:g} to {EDGES_NM[-1]:g} nm for sunlight, "
                f"got {np.min(wavelength_nm):g} to {np.max(wavelength_nm):g}."
            )
        sums = BELOW_W_M2 + np.concatenate([[0.0], np.cumsum(SPECTRAL_W_M2_NM * np.diff(EDGES_NM))])
        return np.asarray(np.interp(wavelength_nm, EDGES_NM, sums) / TOTAL_W_M2)


@dataclass(frozen=True)
class Tungsten(Illuminant):
    """A black body, which a filament nearly is; broadband is all wavelengths.

    temperature_k : float, kelvins; CIE illuminant A is 2856, a halogen lamp about 3000.
    """

    temperature_k: Kelvins = 2856.0

    def __post_init__(self) -> None:
        check_fields(self)

    def below(self, wavelength_nm: np.ndarray) -> np.ndarray:
        """15 / pi^4 sum of e^(-n x) / n (x^3 + 3 x^2 / n + 6 x / n^2 + 6 / n^3), x = c2 / (lambda T).

        Chang and Rhee, Blackbody radiation functions, Int. Comm. Heat Mass Transfer 11, 451 (1984).
        """
        x = SECOND_RADIATION_CONSTANT / (
            np.asarray(wavelength_nm, dtype=np.float64)[..., None] * 1e-9 * self.temperature_k
        )
        n = np.arange(1.0, 60.0)
        terms = np.exp(-n * x) / n * (x**3 + 3 * x**2 / n + 6 * x / n**2 + 6 / n**3)
        return np.asarray(15 / np.pi**4 * terms.sum(axis=-1))


class WhiteLed(Illuminant):
    """A blue diode under phosphor, about 4100 K: two Gaussians, the phosphor's of two widths (Jin et al. 2013).

    Fitted to CIE 15:2018 illuminant LED-B3, 380 to 780 nm (rms 2 % of the peak, efficacy to 1 %). Beyond 780 nm it is
    the tail of the fit; real lamps have next to nothing there either.
    """

    # weight of the amplitude, centre nm, standard deviations below and above it, nm
    _PARTS = ((0.942, 448.1, 8.73, 8.88), (1.0, 589.7, 76.1, 59.3))

    def below(self, wavelength_nm: np.ndarray) -> np.ndarray:
        x = np.asarray(wavelength_nm, dtype=np.float64)
        total = sum(a * (low + high) / 2 for a, _, low, high in self._PARTS)
        parts = []
        for a, centre, low, high in self._PARTS:
            rising = low * ndtr((np.minimum(x, centre) - centre) / low)
            falling = high * (ndtr((np.maximum(x, centre) - centre) / high) - 0.5)
            parts.append(a * (rising + falling))
        return np.asarray(sum(parts) / total)


@dataclass(frozen=True)
class Ambient:
    """What the light of the scene's own emitters is, and how strong.

    Parameters
    ----------
    illuminant : "sun" (ASTM G173), "tungsten" (black body of `temperature_k`), or "led" (white, phosphor); light of
        fluorescent tubes has as little near infrared as an LED's.
    illuminance_lux : float, lux, at a surface that receives `scene_irradiance_w_m2` in the scene.
    irradiance_w_m2 : float, W/m2, the same in broadband irradiance; one of the two at most. With neither, the scene's
        units are taken at their word: broadband W/m2/sr.
    scene_irradiance_w_m2 : float, what the scene's emitters give, in the units of the scene file, where the illuminance
        is meant. A `constant` emitter of radiance L gives pi L on an open surface.
    temperature_k : float, kelvins, of tungsten; CIE illuminant A is 2856, a halogen lamp about 3000.
    """

    illuminant: Literal["sun", "tungsten", "led"]
    illuminance_lux: Strength | None = None
    irradiance_w_m2: Strength | None = None
    scene_irradiance_w_m2: Annotated[float, Bounds("positive and finite", 1e-9, 1e12)] = 1.0
    temperature_k: Kelvins = 2856.0

    def __post_init__(self) -> None:
        check_fields(self)
        if self.illuminance_lux is not None and self.irradiance_w_m2 is not None:
            raise ValueError("expected illuminance_lux or irradiance_w_m2, got both.")

    def check_emitters(self, scene_has_any: bool) -> None:
        """Raise ValueError if there is light to scale, but none in the scene."""
        if self.scale > 0 and not scene_has_any:
            raise ValueError(
                "expected a scene with emitters for the ambient light to scale, got one without such light."
            )

    @cached_property
    def spectrum(self) -> Illuminant:
        """The illuminant."""
        if self.illuminant == "tungsten":
            return Tungsten(self.temperature_k)
        return Sun() if self.illuminant == "sun" else WhiteLed()

    @property
    def scale(self) -> float:
        """Broadband W/m2 of the illuminant per W/m2 in the scene's units."""
        if self.illuminance_lux is not None:
            return self.illuminance_lux / self.spectrum.efficacy_lm_w / self.scene_irradiance_w_m2
        if self.irradiance_w_m2 is not None:
            return self.irradiance_w_m2 / self.scene_irradiance_w_m2
        return 1.0

    def in_band(self, centre_m: float, width_m: float) -> float:
        """Factor on the scene's ambient light for a band-pass filter of that centre and full width, metres."""
        if width_m == 0:
            return 0.0
        return self.scale * self.spectrum.fraction(1e9 * (centre_m - width_m / 2), 1e9 * (centre_m + width_m / 2))
