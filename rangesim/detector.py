# SPDX-License-Identifier: Apache-2.0
"""Radiance to digital numbers, after EMVA 1288."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Detector:
    """Linear image sensor after EMVA Standard 1288, release 4.0 (symbols of the standard in brackets).

    Parameters
    ----------
    pixel_pitch_m : float, metres; pixels are square [sqrt A].
    wavelength_m : float, metres, of the projector's light [lambda].
    quantum_efficiency : float in (0, 1], fill factor and lens transmission included [eta].
    full_well_e : float, electrons, saturation capacity [mu_e.sat].
    read_noise_e : float, electrons rms, temporal dark noise [sigma_d].
    dark_current_e_s : float, electrons per second [mu_I].
    bits : int, ADC resolution.
    offset_dn : float, digital numbers, black level [mu_y.dark].
    ambient_transmission : float in 0..1, share of ambient light that the band-pass filter lets through.
    """

    pixel_pitch_m: float = 5e-6
    wavelength_m: float = 850e-9
    quantum_efficiency: float = 0.4
    full_well_e: float = 12_000.0
    read_noise_e: float = 5.0
    dark_current_e_s: float = 20.0
    bits: int = 12
    offset_dn: float = 16.0
    ambient_transmission: float = 0.05
