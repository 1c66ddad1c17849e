# SPDX-License-Identifier: Apache-2.0
"""Sensor responses on Dr.Jit arrays: the accumulators of the path loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.response import DenseResponse, LightPath, Response, SparseResponse


class DrjitMath:
    """`rangesim.response.Math` on Dr.Jit arrays."""

    cos, sin, floor, abs, exp, erf = dr.cos, dr.sin, dr.floor, dr.abs, dr.exp, dr.erf
    select = staticmethod(dr.select)

    @staticmethod
    def unsigned(x: Any) -> Any:
        return mi.UInt32(x)

    @staticmethod
    def array(table: np.ndarray) -> Any:
        return mi.Float(table)

    @staticmethod
    def lookup(table: Any, index: Any) -> Any:
        return dr.gather(mi.Float, mi.Float(table), index)


class Accumulators:
    """Where the responses of one tile of pixels, one lane per pixel, add up.

    A dense channel is a loop variable of the lane, so it lives in registers and costs one multiply-add per
    vertex. A sparse response is a buffer in memory: each lane adds to its own column, hence no two threads ever
    write to the same place, no atomics are needed, and sums are made in the same order on any machine.
    """

    def __init__(self, responses: Sequence[Response], lanes: int) -> None:
        self.responses = tuple(responses)
        self.lanes = lanes
        self.stride = dr.opaque(mi.UInt32, lanes)
        self.bins = {r: dr.zeros(mi.Float, lanes * r.channels) for r in responses if isinstance(r, SparseResponse)}

    def zeros(self) -> list[list[Any]]:
        """Fresh dense channels, the loop variable that `add` updates."""
        return [
            [dr.zeros(mi.Float, self.lanes) for _ in range(r.channels)] if isinstance(r, DenseResponse) else []
            for r in self.responses
        ]

    def add(self, channels: list[list[Any]], path: LightPath, radiance: Any, lane: Any, active: Any) -> list[list[Any]]:
        """Channels after a path of this radiance (0 where not `active`)."""
        math = DrjitMath()
        result = []
        for response, values in zip(self.responses, channels, strict=True):
            if isinstance(response, DenseResponse):
                weights = response.weights(path, math)
                values = [dr.fma(radiance, w, v) for v, w in zip(values, weights, strict=True)]
            elif isinstance(response, SparseResponse):
                index = response.bin(path, math)
                target = dr.fma(index, self.stride, lane)
                inside = active & (index < response.channels)
                dr.scatter_add(self.bins[response], radiance, target, inside, mode=dr.ReduceMode.NoConflicts)
            result.append(values)
        return result

    def images(self, channels: list[list[Any]], others: Sequence[Any]) -> tuple[list[np.ndarray], np.ndarray]:
        """(c, lanes) float32 of each response, and the `others`, Floats of the same loop, as (n, lanes) float32.

        All are evaluated at once: one by one, the loop would run once for each.
        """
        dr.eval(channels, list(others), list(self.bins.values()))
        images = [
            self.bins[r].numpy().reshape(-1, self.lanes) if r in self.bins else _stack(values)
            for r, values in zip(self.responses, channels, strict=True)
        ]
        return images, _stack(others)


def _stack(values: Sequence[Any]) -> np.ndarray:
    return np.stack([v.numpy() for v in values])
