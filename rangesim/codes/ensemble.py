# SPDX-License-Identifier: Apache-2.0
"""Ensemble of four codes that fail at different kinds of light from elsewhere, so that those that agree are right."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Annotated, ClassVar

import numpy as np

from rangesim.codes.axis_code import AxisCode, AxisFrames
from rangesim.codes.bit_code import BitCode
from rangesim.codes.bits import CELL_SIGMA
from rangesim.codes.code import Code, CodeThresholds
from rangesim.codes.gray import GrayCode
from rangesim.codes.max_min_stripe import MaxMinStripeCode
from rangesim.codes.xor import XorCode
from rangesim.decoding.row_bands import bands
from rangesim.decoding.status import Status
from rangesim.response import DenseResponse
from rangesim.sensor import Background
from rangesim.settings.bounds import check_fields, whole

MAX_APART_CELLS = 1.0
"""Largest distance at which two codes agree, in cells: that of neighbouring cells, which a pixel on an edge may see."""


@dataclass(frozen=True, eq=False)
class EnsembleAxisCode(AxisCode):
    """Coordinate on which codes agree.

    members : what each code decodes to.
    """

    members: tuple[AxisCode, ...] = ()


@dataclass(frozen=True)
class EnsembleCode(Code):
    """Two XOR codes, which withstand interreflection, and two Gray codes, which withstand blur and scattering.

    Where two codes or more agree within a cell, the mean of the two nearest ones is the coordinate. Where none agree,
    or two pairs agree on different places, the pixel is refused (`CODE_ERROR`). The paper takes what any two codes
    agree on; that pairs which contradict each other are refused is an addition.

    Parameters
    ----------
    cell_px : int, projector pixels per cell.

    References
    ----------
    Gupta, Agrawal, Veeraraghavan, Narasimhan: "Structured light 3D scanning in the presence of global illumination",
    CVPR (2011).

    Examples
    --------
    >>> EnsembleCode().names(4)[::4]
    ['xor02_bit1', 'xor04_bit1', 'gray_bit1', 'stripe_bit1']
    """

    cell_px: Annotated[int, whole(1, "projector")] = 1

    type_name: ClassVar[str] = "ensemble"
    title: ClassVar[str] = "Structured light (ensemble of codes)"

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def members(self) -> dict[str, BitCode]:
        """The codes, by what the names of their frames start with."""
        return {
            "xor02_": XorCode(0, self.cell_px),
            "xor04_": XorCode(1, self.cell_px),
            "gray_": GrayCode(self.cell_px),
            "stripe_": MaxMinStripeCode(self.cell_px),
        }

    def check(self, size: int) -> None:
        for code in self.members.values():
            code.check(size)

    def names(self, size: int) -> list[str]:
        return [prefix + name for prefix, code in self.members.items() for name in code.names(size)]

    def patterns(self, size: int) -> np.ndarray:
        return np.concatenate([code.patterns(size) for code in self.members.values()])

    def check_shown(self, size: int, shown: Sequence[str]) -> None:
        for prefix, code in self.members.items():
            code.check_shown(size, _of_member(shown, prefix))

    def responses(self, axis: int, size: int) -> tuple[DenseResponse, ...]:
        return tuple(response for code in self.members.values() for response in code.responses(axis, size))

    def frames(self, size: int, channels: Sequence[np.ndarray], white: np.ndarray) -> Iterator[np.ndarray]:
        for code, own in zip(self.members.values(), channels, strict=True):
            yield from code.frames(size, [own], white)

    def decode(self, seen: AxisFrames, thresholds: CodeThresholds) -> AxisCode:
        codes = [code.decode(seen.of_member(prefix), thresholds) for prefix, code in self.members.items()]
        coordinate, status = np.empty_like(codes[0].coordinate), np.empty_like(codes[0].status)
        for rows in bands(len(status)):
            coordinate[rows], status[rows] = self._vote(
                np.stack([code.coordinate[rows] for code in codes]), np.stack([code.status[rows] for code in codes])
            )
        sigma_px = np.broadcast_to(np.float32(CELL_SIGMA * self.cell_px), status.shape)
        return EnsembleAxisCode(coordinate, status, self.cell_px, sigma_px, members=tuple(codes))

    def _vote(self, places: np.ndarray, statuses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(h, w) each: the coordinate on which codes agree, and its status.

        Parameters
        ----------
        places, statuses : (4, h, w), coordinate and status of each code.
        """
        read, within = statuses == Status.OK, MAX_APART_CELLS * self.cell_px
        best, apart = places[0].copy(), np.full(places.shape[1:], np.inf, dtype=np.float32)
        low, high = np.full_like(apart, np.inf), np.full_like(apart, -np.inf)
        for i, j in combinations(range(len(places)), 2):
            distance = np.where(read[i] & read[j], np.abs(places[i] - places[j]), np.float32(np.inf))
            middle = (places[i] + places[j]) / 2
            agrees = distance <= within
            low, high = np.fmin(low, middle, where=agrees, out=low), np.fmax(high, middle, where=agrees, out=high)
            nearer = agrees & (distance < apart)
            best[nearer], apart[nearer] = middle[nearer], distance[nearer]
        status = np.where(read.sum(axis=0) >= 2, Status.CODE_ERROR, Status.LOW_SIGNAL).astype(np.uint8)
        status[(status == Status.LOW_SIGNAL) & (statuses == Status.SATURATED).any(axis=0)] = Status.SATURATED
        status[(apart <= within) & (high - low <= 2 * within)] = Status.OK
        return best, status

    def least_signal(
        self, size: int, shown: Sequence[str], thresholds: CodeThresholds, background: Background
    ) -> np.ndarray:
        needed = [
            code.least_signal(size, _of_member(shown, prefix), thresholds, background)
            for prefix, code in self.members.items()
        ]
        return np.sort(needed, axis=0)[1]  # two codes have to be read

    def contradiction(self, seen: AxisFrames, code: AxisCode) -> str | None:
        assert isinstance(code, EnsembleAxisCode)
        for (prefix, member), own in zip(self.members.items(), code.members, strict=True):
            if text := member.contradiction(seen.of_member(prefix), own):
                return text
        return None

    @property
    def details(self) -> str:
        name = "Ensemble of XOR and Gray codes"
        return name if self.cell_px == 1 else f"{name} of {self.cell_px} px"

    def representative(self, size: int) -> list[str]:
        prefix, code = next(iter(self.members.items()))
        return [prefix + name for name in code.representative(size)]


def _of_member(shown: Sequence[str], prefix: str) -> list[str]:
    """White and black, and the frames of a code without their prefix."""
    return [name.removeprefix(prefix) for name in shown if name in ("white", "black") or name.startswith(prefix)]
