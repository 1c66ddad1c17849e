# SPDX-License-Identifier: Apache-2.0
"""The measured correlation of modulated light with its reference, as harmonics of its period."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from rangesim.settings.bounds import Bounds, check_fields

MAX_HARMONICS = 32
"""Largest number of harmonics: the 33rd of 20 MHz is 660 MHz, far above what lasers and pixels of such cameras follow,
and each harmonic adds a response to the light transport."""

SAMPLES = 4096
"""Number of phases of a period at which a correlation is tabulated. Linear interpolation between them errs by less than
3e-7 periods times the second derivative of the error, which is below 10 for harmonics of a tenth."""


@dataclass(frozen=True)
class Correlation:
    """The correlation C(phi) = cos(phi) + sum over k of a_k cos(k phi + psi_k), k = 2, 3, ...

    phi is the phase of the light minus the phase of the tap. Real sources and references are neither sines nor squares.
    Their harmonics make the phase of N taps err periodically, the "wiggling".

    Parameters
    ----------
    amplitudes : a_2, a_3, ..., as fractions of the amplitude of the first harmonic.
    phases_rad : psi_2, psi_3, ..., radians; (): all 0, an even correlation.

    Examples
    --------
    A triangle of a square source and a square reference, up to its fifth harmonic:

    >>> triangle = Correlation((0.0, 1 / 9, 0.0, 1 / 25))
    >>> triangle.orders
    (3, 5)
    >>> triangle.values([0.0, 0.5]).round(3)
    array([ 1.151, -1.151])

    References
    ----------
    Payne, Dorrington, Cree, Carnegie: "Improved measurement linearity and precision for AMCW time-of-flight range
    imaging cameras", Applied Optics 49 (2010).
    """

    amplitudes: tuple[Annotated[float, Bounds("a fraction of the first harmonic", -1, 1)], ...] = (0.0, 0.1)
    phases_rad: tuple[Annotated[float, Bounds("an angle in radians", -1e3, 1e3)], ...] = ()

    def __post_init__(self) -> None:
        check_fields(self)
        if not 1 <= len(self.amplitudes) < MAX_HARMONICS:
            raise ValueError(f"expected 1 to {MAX_HARMONICS - 1} amplitudes, got {len(self.amplitudes)}.")
        if self.phases_rad and len(self.phases_rad) != len(self.amplitudes):
            raise ValueError(
                f"expected as many phases_rad as amplitudes, {len(self.amplitudes)}, or none, "
                f"got {len(self.phases_rad)}."
            )

    @classmethod
    def measured(cls, curve: Sequence[float] | np.ndarray, harmonics: int = 8) -> Correlation:
        """The correlation that a curve shows, for example of a camera whose light is delayed step by step.

        Parameters
        ----------
        curve : (n,) float, readings of one tap at n evenly spaced delays of one period, in any unit and with any
            offset. The delay at which the curve begins does not matter.
        harmonics : number of the highest harmonic, at least 2; the curve needs more than twice as many samples.

        Raises
        ------
        ValueError
            Too few samples, a value that is not finite, or no first harmonic.

        Examples
        --------
        >>> delays = np.arange(40) / 40
        >>> curve = 7 + 2 * np.cos(2 * np.pi * (delays - 0.1)) + 0.2 * np.cos(6 * np.pi * (delays - 0.1))
        >>> found = Correlation.measured(curve, harmonics=3)
        >>> np.round(found.amplitudes, 4).tolist()
        [0.0, 0.1]
        """
        values = np.asarray(curve, dtype=np.float64)
        if not 2 <= harmonics <= MAX_HARMONICS:
            raise ValueError(f"expected 2 to {MAX_HARMONICS} harmonics, got {harmonics}.")
        if values.ndim != 1 or len(values) <= 2 * harmonics or not np.isfinite(values).all():
            raise ValueError(f"expected a curve of more than {2 * harmonics} finite samples, got {values.shape}.")
        spectrum = np.fft.rfft(values)[1 : harmonics + 1]
        if not abs(spectrum[0]) > 1e-9 * np.abs(values).sum():
            raise ValueError("expected a curve with a period of its own length, got one without a first harmonic.")
        k = np.arange(1, harmonics + 1)
        relative = spectrum * np.exp(-1j * k * np.angle(spectrum[0])) / abs(spectrum[0])
        return cls(tuple(np.abs(relative[1:]).tolist()), tuple(np.angle(relative[1:]).tolist()))

    @property
    def orders(self) -> tuple[int, ...]:
        """Orders k of the harmonics that are not 0, without the first."""
        return tuple(k for k, a in enumerate(self.amplitudes, start=2) if a)

    def coefficient(self, order: int) -> complex:
        """a_k e^(i psi_k) of a harmonic; 1 for the first one."""
        if order == 1:
            return 1.0 + 0.0j
        phase = self.phases_rad[order - 2] if self.phases_rad else 0.0
        return complex(self.amplitudes[order - 2] * np.exp(1j * phase))

    def values(self, turns: Sequence[float] | np.ndarray) -> np.ndarray:
        """(...) float64, the correlation at phases (...) in turns."""
        phi = 2 * np.pi * np.asarray(turns, dtype=np.float64)
        terms = (self.coefficient(k) * np.exp(1j * k * phi) for k in (1, *self.orders))
        return np.asarray(sum(term.real for term in terms))

    def read_by(self, taps: int, turns: np.ndarray) -> np.ndarray:
        """(...) float64, turns, phases that the sine formula of `taps` evenly spaced taps reads at true phases (...).

        The taps cannot tell harmonic n N + 1 from the first one, nor n N - 1 from the first one with the opposite sign
        of its phase.

        Examples
        --------
        Three taps read a second harmonic of 0.1 as an error of up to 0.1 radians, 0.016 turns:

        >>> turns = np.array([0.0, 1 / 12])
        >>> (Correlation((0.1,)).read_by(3, turns) - turns).round(4)
        array([ 0.    , -0.0159])
        """
        turns = np.asarray(turns, dtype=np.float64)
        error = np.zeros(turns.shape, dtype=np.complex128)
        for k in (1, *self.orders):
            harmonic = self.coefficient(k) * np.exp(2j * np.pi * k * turns)
            if k % taps == 1:
                error += harmonic * np.exp(-2j * np.pi * turns)
            elif k % taps == taps - 1:
                error += harmonic.conj() * np.exp(-2j * np.pi * turns)
        return np.asarray(turns + np.angle(error) / (2 * np.pi))

    def corrected(self, taps: int, read: np.ndarray) -> np.ndarray:
        """(...) float32 in [0, 1), turns, the true phases at which `taps` taps read the phases `read` (...).

        It inverts `read_by`, which has to grow with the phase.
        """
        true = np.arange(SAMPLES) / SAMPLES
        measured = self.read_by(taps, true)
        result = read + np.interp(read, measured, true - measured, period=1.0)
        return np.asarray(result - np.floor(result), dtype=np.float32)
