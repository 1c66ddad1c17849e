# SPDX-License-Identifier: Apache-2.0
"""Sums of sensor responses over the paths of the loop, on Dr.Jit arrays."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain, product
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.response import DenseResponse, LightPath, Response, SparseResponse


class DrjitMath:
    """The functions of `rangesim.response.Math` on Dr.Jit arrays."""

    cos, sin, floor, abs, exp, erf = dr.cos, dr.sin, dr.floor, dr.abs, dr.exp, dr.erf
    select = staticmethod(dr.select)

    @staticmethod
    def unsigned(x: mi.Float) -> mi.UInt32:
        return mi.UInt32(x)

    @staticmethod
    def array(table: np.ndarray) -> mi.Float:
        return mi.Float(table)

    @staticmethod
    def lookup(table: mi.Float | np.ndarray, index: mi.UInt32) -> mi.Float:
        return dr.gather(mi.Float, mi.Float(table), index)


class Runs(NamedTuple):
    """Pixels of a launch: some runs of successive pixels out of all pixels in a row.

    numbers : (k,) int, ascending; run i has the pixels i * length to (i + 1) * length - 1.
    length : number of pixels of a run. The last run of all may be shorter.
    pixels : number of all pixels.

    Examples
    --------
    >>> runs, image = Runs(np.array([0, 2]), length=2, pixels=5), np.zeros(5)
    >>> runs.places()
    array([0, 1, 4])
    >>> runs.write(np.array([1.0, 2.0, 3.0]), image)
    >>> image
    array([1., 2., 0., 0., 3.])
    """

    numbers: np.ndarray
    length: int
    pixels: int

    def places(self) -> np.ndarray:
        """(lanes,) int, indices of the pixels, ascending."""
        places = (self.numbers[:, None] * self.length + np.arange(self.length)).ravel()
        return places[: np.searchsorted(places, self.pixels)]

    def write(self, values: np.ndarray, image: np.ndarray) -> None:
        """Write the values (lanes,) to an image (pixels,), run by run: five times as fast as pixel by pixel."""
        whole = self.pixels // self.length
        rows = self.numbers[: np.searchsorted(self.numbers, whole)]
        of_runs = values[: len(rows) * self.length].reshape(len(rows), self.length)
        image[: whole * self.length].reshape(whole, self.length)[rows] = of_runs
        if len(rows) < len(self.numbers):
            image[whole * self.length :] = values[len(rows) * self.length :]


class Accumulators:
    """Sums of the responses of a number of pixels. One lane of a kernel works on each pixel.

    A dense channel is a loop variable of the lane, so it lives in registers and costs one multiply-add per vertex. A
    sparse response is a buffer in memory. Each lane adds to its own column: no two threads write to the same place, no
    atomics are needed, and sums are made in the same order on any machine.

    Parameters
    ----------
    responses : the responses whose channels are summed up.
    pixels : number of pixels.
    keeps_apart : whether smooth light has sums of its own. There are then two `parts`: other light, and smooth light.
    """

    def __init__(self, responses: Sequence[Response], pixels: int, keeps_apart: bool = False) -> None:
        self.responses = tuple(responses)
        self.pixels = pixels
        self.parts = 2 if keeps_apart else 1
        self.stride = dr.opaque(mi.UInt32, pixels)
        self.bins: dict[Response, mi.Float] = {
            r: dr.zeros(mi.Float, pixels * r.channels * self.parts) for r in responses if isinstance(r, SparseResponse)
        }
        dense = [r for r in responses if isinstance(r, DenseResponse)]
        self.dense = {r: [np.empty((r.channels, pixels), np.float32) for _ in range(self.parts)] for r in dense}

    def zeros(self, lanes: int) -> list[list[mi.Float]]:
        """Dense channels of lanes before their first path, one list per response; `add` updates them."""
        return [
            [dr.zeros(mi.Float, lanes) for _ in range(self.parts * r.channels)] if isinstance(r, DenseResponse) else []
            for r in self.responses
        ]

    def add(
        self,
        channels: list[list[mi.Float]],
        path: LightPath,
        radiance: mi.Float,
        place: mi.UInt32,
        active: mi.Bool,
        is_smooth: mi.Bool | bool = False,
    ) -> list[list[mi.Float]]:
        """Dense channels after a light path was added; sparse responses are added to their buffers.

        Parameters
        ----------
        radiance : Float, W/m2/sr, of the path; 0 where not `active`.
        place : UInt32, index of the lane's pixel among those of the accumulators.
        is_smooth : Bool, whether the light belongs to the part that is kept apart.
        """
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

    def pending(self) -> list[mi.Float]:
        """The buffers that a launch has added to. They must be evaluated together with the loop of the launch;
        otherwise the loop runs a second time for them."""
        return list(self.bins.values())

    def store(self, channels: list[list[mi.Float]], runs: Runs | None = None) -> None:
        """Keep the evaluated dense channels of some runs of pixels, or of all."""
        runs = runs or Runs(np.zeros(1, int), self.pixels, self.pixels)
        for response, values in zip(self.responses, channels, strict=True):
            if isinstance(response, DenseResponse):
                for image, value in zip(chain.from_iterable(self.dense[response]), values, strict=True):
                    runs.write(value.numpy(), image)

    def images(self) -> list[list[np.ndarray]]:
        """The sums of all pixels: for each response a list of its parts, (c, pixels) float32 each."""
        return [
            self.dense[r]
            if isinstance(r, DenseResponse)
            else list(self.bins[r].numpy().reshape(self.parts, -1, self.pixels))
            for r in self.responses
        ]
