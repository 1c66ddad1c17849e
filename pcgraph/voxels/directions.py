# SPDX-License-Identifier: Apache-2.0
"""Directions all around and along a plane, the plane on which most of a cloud lies, and places far from each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def densest_plane(places: NDArray[np.float64], normals: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """The plane on which most of n places lie, (n, 3), with normals towards either side: unit normal, (3,), and offset.

    It has the commonest normal, and lies amid the narrowest quarter of all offsets along it.
    """
    normal = np.linalg.eigh(np.einsum("ij,ik->jk", normals, normals))[1][:, -1]
    offsets = np.sort(np.einsum("ij,j->i", places, normal))
    quarter = len(offsets) // 4
    first = int(np.argmin(offsets[quarter:] - offsets[: len(offsets) - quarter]))
    return normal, float(offsets[first + quarter // 2])


def farthest_first(places: NDArray[np.float64], first: int, n: int) -> list[int]:
    """At most n of some places, (k, 3): one of them, then each time that which lies farthest from those before."""
    chosen, nearest = [first], np.full(len(places), np.inf)
    while len(chosen) < min(n, len(places)):
        ways = places - places[chosen[-1]]
        nearest = np.minimum(nearest, np.sqrt(np.einsum("ij,ij->i", ways, ways)))
        chosen.append(int(np.argmax(nearest)))
    return chosen


def sphere_directions(n: int) -> NDArray[np.float64]:
    """Unit vectors evenly over the sphere, (n, 3) float64, from +z downwards: a Fibonacci lattice."""
    number = np.arange(n) + 0.5
    z = 1.0 - 2.0 * number / n
    angle = np.pi * (3.0 - np.sqrt(5.0)) * number
    across = np.sqrt(1.0 - z * z)
    return np.stack((across * np.cos(angle), across * np.sin(angle), z), axis=1)


def plane_basis(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Two unit vectors, rows of (2, 3), that form a right-handed frame with a unit normal as the third."""
    helper = np.zeros(3)
    helper[int(np.abs(normal).argmin())] = 1.0
    first = _cross(helper, normal)
    first /= np.linalg.norm(first)
    return np.stack((first, _cross(normal, first)))


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cross product of two vectors, (3,); `np.cross` takes ten times as long for one."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
