# SPDX-License-Identifier: Apache-2.0
"""Directions all around and along a plane, the plane on which most of a cloud lies, and places far from each other."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_STARTS = 8  # normals from which planes are looked for
_ALIKE, _SAME = 0.95, 0.99  # cosine between normals on one plane, and of those looked from once, and more
_BAND = 0.02  # of the diagonal of the places' bounding box, within which those on one plane lie


class DensestPlane(NamedTuple):
    """The plane on which most of some places lie.

    Attributes
    ----------
    normal : (3,) float64, unit
    offset : float
        Of the plane along its normal, in the places' unit.
    fraction : float, 0..1
        Of the places on it.
    """

    normal: NDArray[np.float64]
    offset: float
    fraction: float


def densest_plane(places: NDArray[np.float64], normals: NDArray[np.float64]) -> DensestPlane:
    """The plane on which most of n places lie, (n, 3), with normals towards either side, (n, 3).

    Some of the normals, and the commonest direction of all, each give way to the commonest direction near them; the
    plane is the band across one of these that holds most places with such normals. The commonest direction of all alone
    is turned aside by whatever else there is: by the sides of a crate on a table, 10 degrees.
    """
    some = normals[np.linspace(0, len(normals) - 1, _STARTS).astype(np.int64)]
    band = _BAND * float(np.linalg.norm(places.max(axis=0) - places.min(axis=0)))
    best, tried = DensestPlane(np.array([0.0, 0.0, 1.0]), 0.0, 0.0), np.zeros((0, 3))
    for start in (_commonest(normals), *some):
        if _alike(tried, start, _SAME).any():
            continue
        near = _alike(normals, start)
        normal = _commonest(normals[near]) if near.any() else start
        tried = np.concatenate((tried, start[None], normal[None]))
        offsets = np.sort(np.einsum("ij,j->i", places[_alike(normals, normal)], normal))
        if not len(offsets):
            continue
        within = np.searchsorted(offsets, offsets + band, "right") - np.arange(len(offsets))
        first = int(np.argmax(within))
        fraction = float(within[first]) / len(places)
        if fraction > best.fraction:
            best = DensestPlane(normal, float(np.median(offsets[first : first + within[first]])), fraction)
    return best


def _alike(normals: NDArray[np.float64], normal: NDArray[np.float64], least: float = _ALIKE) -> NDArray[np.bool_]:
    return np.abs(np.einsum("ij,j->i", normals, normal)) > least


def _commonest(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """The unit direction, (3,), with the largest mean square cosine to normals, (n, 3)."""
    direction: NDArray[np.float64] = np.linalg.eigh(np.einsum("ij,ik->jk", normals, normals))[1][:, -1]
    return direction


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
