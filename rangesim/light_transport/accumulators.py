# SPDX-License-Identifier: Apache-2.0
"""Sensor responses on Dr.Jit arrays: the accumulators of the path loop."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain, product
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
    """Where the responses of a number of pixels add up, one lane of a kernel for each pixel at work.

    A dense channel is a loop variable of the lane, so it lives in registers and costs one multiply-add per
    vertex. A sparse response is a buffer in memory: each lane adds to its own column, hence no two threads ever
    write to the same place, no atomics are needed, and sums are made in the same order on any machine.

    keeps_apart : whether smooth light has sums of its own. `parts` then are two: all other light, and that.
    """

    def __init__(self, responses: Sequence[Response], pixels: int, keeps_apart: bool = False) -> None:
        self.responses = tuple(responses)
        self.pixels = pixels
        self.parts = 2 if keeps_apart else 1
        self.stride = dr.opaque(mi.UInt32, pixels)
        self.bins: dict[Response, Any] = {
            r: dr.zeros(mi.Float, pixels * r.channels * self.parts) for r in responses if isinstance(r, SparseResponse)
        }
        dense = [r for r in responses if isinstance(r, DenseResponse)]
        self.dense = {r: [np.empty((r.channels, pixels), np.float32) for _ in range(self.parts)] for r in dense}

    def zeros(self, lanes: int) -> list[list[Any]]:
        """Fresh dense channels, the loop variable that `add` updates."""
        return [
            [dr.zeros(mi.Float, lanes) for _ in range(self.parts * r.channels)] if isinstance(r, DenseResponse) else []
            for r in self.responses
        ]

    def add(
        self, channels: list[list[Any]], path: LightPath, radiance: Any, place: Any, active: Any, is_smooth: Any = False
    ) -> list[list[Any]]:
        """Channels after a path of this radiance (0 where not `active`); `place` is the number of the lane's pixel."""
        math = DrjitMath()
        result = []
        for response, values in zip(self.responses, channels, strict=True):
            if isinstance(response, DenseResponse):
                weights = response.weights(path, math)
                brought = [radiance]
                if self.parts == 2:
                    brought = [dr.select(is_smooth, 0, radiance), dr.select(is_smooth, radiance, 0)]
                values = [dr.fma(b, w, v) for v, (b, w) in zip(values, product(brought, weights), strict=True)]
            elif isinstance(response, SparseResponse):
                for index, weight in response.bin_weights(path, math):
                    target = dr.fma(index, self.stride, place)
                    inside = active & (index < response.channels)
                    if self.parts == 2:
                        target += dr.select(is_smooth, response.channels * self.stride, 0)
                    brought = radiance * weight
                    dr.scatter_add(self.bins[response], brought, target, inside, mode=dr.ReduceMode.NoConflicts)
            result.append(values)
        return result

    def pending(self) -> list[Any]:
        """The buffers that a launch has added to: to be evaluated with its loop, or that runs a second time."""
        return list(self.bins.values())

    def store(self, channels: list[list[Any]], places: Any) -> None:
        """Keep the evaluated dense channels of the pixels with these numbers (a slice or (lanes,) int)."""
        for response, values in zip(self.responses, channels, strict=True):
            if isinstance(response, DenseResponse):
                for image, value in zip(chain.from_iterable(self.dense[response]), values, strict=True):
                    image[places] = value.numpy()

    def images(self) -> list[list[np.ndarray]]:
        """Of each response, its parts: (c, pixels) float32 each."""
        return [
            self.dense[r]
            if isinstance(r, DenseResponse)
            else list(self.bins[r].numpy().reshape(self.parts, -1, self.pixels))
            for r in self.responses
        ]
