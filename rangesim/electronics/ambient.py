# SPDX-License-Identifier: Apache-2.0
"""Ambient light by kind and strength: how much of it passes a sensor's band-pass filter.

A transport pass stores the light of the scene's own emitters separately (`Signals.energy.ambient`). The pass knows no
spectrum of that light, and gives it in the units of the scene file. `Ambient` states its spectrum (an illuminant) and
its strength. Light is linear, so both are factors on the finished pass:

    ambient radiance behind the filter = energy.ambient * scale * fraction

scale : broadband irradiance of the illuminant over the irradiance in the scene's units.
fraction : part of the illuminant's broadband irradiance that lies inside the filter's band.

The scene's reflectances hold at the sensor's wavelength. That is right for ambient light too, because only light in
the sensor's band reaches the detector.
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
"""Lumens per watt at the peak of V(lambda), as the SI defines the candela."""
Kelvins = Annotated[float, Bounds("positive and finite", 300, 1e5)]
"""Temperature of a black body in kelvins, from a warm room to hotter than any light source."""
Strength = Annotated[float, Bounds("0 or positive", 0, 1e12)]
"""Illuminance in lux, or irradiance in W/m2. The upper bound only excludes nonsense: sunlight on the ground has about
1e5 lux and 1000 W/m2."""
_VISIBLE_NM = np.arange(380.0, 781.0)
"""Wavelengths in nm, 1 nm apart, over which luminous efficacy is integrated: the visible range by CIE."""


def photopic(wavelength_nm: Any) -> np.ndarray:
    """V(lambda), the relative sensitivity of the eye (0..1) at wavelengths in nm; within 0.008 of the CIE 1924 table.

    References
    ----------
    Wyman, Sloan, Shirley: "Simple analytic approximations to the CIE XYZ color matching functions", JCGT 2(2), 2013.
    """
    x = np.asarray(wavelength_nm, dtype=np.float64)
    first, second = (x - 568.8) / np.where(x < 568.8, 46.9, 40.5), (x - 530.9) / np.where(x < 530.9, 16.3, 31.1)
    return np.asarray(0.821 * np.exp(-0.5 * first**2) + 0.286 * np.exp(-0.5 * second**2))


class Illuminant(ABC):
    """A spectrum of light, given by the fraction of its irradiance that lies below each wavelength."""

    @abstractmethod
    def below(self, wavelength_nm: np.ndarray) -> np.ndarray:
        """Fraction (0..1) of the broadband irradiance that lies below each wavelength, in nm.

        Raises
        ------
        ValueError
            The spectrum is not known at one of the wavelengths.
        """

    def fraction(self, low_nm: float, high_nm: float) -> float:
        """Fraction (0..1) of the broadband irradiance that lies between two wavelengths, in nm."""
        low, high = self.below(np.array([low_nm, high_nm]))
        return float(high - low)

    @property
    def efficacy_lm_w(self) -> float:
        """Luminous efficacy of radiation, lux per W/m2 of broadband irradiance."""
        weights = photopic((_VISIBLE_NM[1:] + _VISIBLE_NM[:-1]) / 2)
        return float(LUMINOUS_EFFICACY * (weights * np.diff(self.below(_VISIBLE_NM))).sum())


class Sun(Illuminant):
    """Light of sun and sky, ASTM G173-03 global (`rangesim.electronics.sunlight`); "broadband" means 280 to 4000 nm."""

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
    """Light of a black body, which a tungsten filament resembles closely; "broadband" means all wavelengths.

    temperature_k : float, kelvins; 2856 is CIE illuminant A, a halogen bulb has about 3000.
    """

    temperature_k: Kelvins = 2856.0

    def __post_init__(self) -> None:
        check_fields(self)

    def below(self, wavelength_nm: np.ndarray) -> np.ndarray:
        """Fraction (0..1) of the irradiance that lies below each wavelength, in nm.

        It is the series 15 / pi^4 sum over n of e^(-n x) / n (x^3 + 3 x^2 / n + 6 x / n^2 + 6 / n^3), with
        x = c2 / (lambda T).

        References
        ----------
        Chang, Rhee: "Blackbody radiation functions", Int. Comm. Heat Mass Transfer 11, 451 (1984).
        """
        x = SECOND_RADIATION_CONSTANT / (
            np.asarray(wavelength_nm, dtype=np.float64)[..., None] * 1e-9 * self.temperature_k
        )
        n = np.arange(1.0, 60.0)
        terms = np.exp(-n * x) / n * (x**3 + 3 * x**2 / n + 6 * x / n**2 + 6 / n**3)
        return np.asarray(15 / np.pi**4 * terms.sum(axis=-1))


class WhiteLed(Illuminant):
    """Light of a white LED: a blue diode under phosphor, about 4100 K.

    The spectrum is a sum of two Gaussians with two widths each (Jin et al. 2013). They were fitted to the CIE 15:2018
    illuminant LED-B3 from 380 to 780 nm. The rms error is 2 % of the peak, and the luminous efficacy is right to 1 %.
    Above 780 nm only the tail of the fit is left. A real LED emits next to nothing there, too.
    """

    _PARTS = ((0.942, 448.1, 8.73, 8.88), (1.0, 589.7, 76.1, 59.3))
    """Diode and phosphor: amplitude, centre in nm, standard deviations below and above the centre in nm."""

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
    """Spectrum and strength of the light that the scene's own emitters give.

    Parameters
    ----------
    illuminant : "sun" (ASTM G173), "tungsten" (black body of `temperature_k`), or "led" (white, with phosphor). Take
        "led" for fluorescent tubes too: they emit as little near infrared as a white LED.
    illuminance_lux : float, lux, on a surface that receives `scene_irradiance_w_m2` in the scene.
    irradiance_w_m2 : float, W/m2, broadband irradiance on that surface. Give this or `illuminance_lux`, not both.
        Without either, radiances in the scene file are taken as broadband W/m2/sr.
    scene_irradiance_w_m2 : float, irradiance that the scene's emitters give on that surface, in the units of the scene
        file. A `constant` emitter of radiance L gives pi L on an open surface.
    temperature_k : float, kelvins, of "tungsten" alone; 2856 is CIE illuminant A, a halogen bulb has about 3000.

    Raises
    ------
    ValueError
        A number out of its range, another illuminant, or both an illuminance and an irradiance.

    Examples
    --------
    Sunlight of 100 000 lux is 913 W/m2. A filter of 50 nm around 850 nm lets 4.8 % of it pass:

    >>> from rangesim import Ambient
    >>> sun = Ambient("sun", illuminance_lux=100_000)
    >>> round(sun.scale)
    913
    >>> round(sun.in_band(centre_m=850e-9, width_m=50e-9) / sun.scale, 3)
    0.048
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
        """Raise ValueError if this light is not zero and the scene has no emitters that could give it."""
        if self.scale > 0 and not scene_has_any:
            raise ValueError(
                "expected a scene with emitters of its own, because `ambient` scales their light, got one without any."
            )

    @cached_property
    def spectrum(self) -> Illuminant:
        """The illuminant with its spectrum."""
        if self.illuminant == "tungsten":
            return Tungsten(self.temperature_k)
        return Sun() if self.illuminant == "sun" else WhiteLed()

    @property
    def scale(self) -> float:
        """Broadband irradiance of the illuminant in W/m2, per W/m2 in the scene's units."""
        if self.illuminance_lux is not None:
            return self.illuminance_lux / self.spectrum.efficacy_lm_w / self.scene_irradiance_w_m2
        if self.irradiance_w_m2 is not None:
            return self.irradiance_w_m2 / self.scene_irradiance_w_m2
        return 1.0

    def in_band(self, centre_m: float, width_m: float) -> float:
        """Factor on the scene's ambient light for a band-pass filter of this centre and full width, both in metres."""
        if width_m == 0:
            return 0.0
        return self.scale * self.spectrum.fraction(1e9 * (centre_m - width_m / 2), 1e9 * (centre_m + width_m / 2))
