# SPDX-License-Identifier: Apache-2.0
"""Signals and ground truth of zones, from those of the finer camera whose rays were traced.

Detectors count the light of a zone, not of its pixels. Expected counts are linear in radiance, so the mean radiance
over a zone, weighted by the light that its pixels take in, gives the counts that all its pixels would give together.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING

import numpy as np

from rangesim.rig import Rig
from rangesim.signals import EnergySplit, GroundTruth, SamplingError, StillSignals

if TYPE_CHECKING:
    from scipy.sparse import csr_array

MIN_PART = 0.01
"""Least weight of a pixel, as a fraction of the largest in its zone, for its depth to count in the zone's range of
depths. Blurred zones have pixels with next to no weight far outside."""


class ZoneSums:
    """Means over the zones of a rig's camera.

    Parameters
    ----------
    rig : Rig with a camera of zones.
    matrix : (n, m) sparse float64, weights of m pixels in n zones.

    Attributes
    ----------
    share : (n, m) sparse float64, fraction of a zone's light that is from each pixel in even light.
    """

    def __init__(self, rig: Rig, matrix: csr_array) -> None:
        self.rig, self.matrix = rig, matrix.tocsr()
        self.shape = rig.camera.height, rig.camera.width
        # The share keeps the entries of pixels without light, so that every row has one, as `reduceat` needs
        light, illumination = self.matrix.copy(), rig.traced.camera_illumination.ravel().astype(np.float64)
        light.data = light.data * illumination[light.indices]
        of_zone = np.maximum(light.sum(axis=1), np.finfo(np.float64).tiny)
        light.data = light.data * np.repeat(1 / of_zone, np.diff(light.indptr))
        self.share = light

    def image(self, values: np.ndarray) -> np.ndarray:
        """(..., rows, columns), mean of radiances (..., h, w) over each zone, in their type."""
        flat = values.reshape(-1, self.share.shape[1])
        return (
            np.stack([self.share @ row.astype(np.float64) for row in flat])
            .astype(values.dtype)
            .reshape(*values.shape[:-2], *self.shape)
        )

    def signals(self, fine: StillSignals) -> StillSignals:
        """Signals of the zones."""
        energy = EnergySplit(**{f.name: self.image(getattr(fine.energy, f.name)) for f in fields(EnergySplit)})
        sampling = fine.sampling
        if sampling is not None:
            errors = {response: self.image(values) for response, values in sampling.channels.items()}
            sampling = SamplingError(errors, self.image(sampling.projector))
        return replace(
            fine,
            rig=self.rig,
            energy=energy,
            truth=self.truth(fine.truth),
            channels={response: self.image(values) for response, values in fine.channels.items()},
            sampling=sampling,
        )

    def truth(self, fine: GroundTruth) -> GroundTruth:
        """Ground truth of the zones: the mean over the surface that fills most of a zone, and its range of depths.

        Where most of a zone sees no surface, there is none.
        """
        n, names = len(fine.instance_names) + 1, np.arange(len(fine.instance_names) + 1) - 1
        area = np.stack([self.share @ (fine.instance.ravel() == name) for name in names], axis=1)
        chosen = names[area.argmax(axis=1)]
        rows = np.repeat(np.arange(self.share.shape[0]), np.diff(self.share.indptr))
        is_of_it = fine.instance.ravel()[self.share.indices] == chosen[rows]
        of_it = self.share.copy()
        of_it.data = np.where(is_of_it, self.share.data, 0.0)
        seen = chosen >= 0

        def mean(values: np.ndarray) -> np.ndarray:
            flat = values.reshape(self.share.shape[1], -1).astype(np.float64)
            known = np.isfinite(flat)
            with np.errstate(invalid="ignore", divide="ignore"):
                result = (of_it @ np.where(known, flat, 0.0)) / (of_it @ known.astype(np.float64))
            result = np.where(seen[:, None], result, np.nan)
            return np.asarray(result.astype(values.dtype).reshape(*self.shape, *values.shape[2:]))

        normal, alone = mean(fine.normal), np.add.reduceat(is_of_it, self.share.indptr[:-1]).reshape(self.shape) == 1
        length = np.linalg.norm(normal, axis=-1, keepdims=True)
        visible = of_it @ fine.projector_visible.ravel().astype(np.float64) > 0.5 * of_it.sum(axis=1)
        material = np.full(n, -1, dtype=np.int32)
        for name in names[1:]:
            found = fine.material[fine.instance == name]
            material[name] = found[0] if found.size else -1
        nearest, farthest = self._range_of_depths(fine.range_m.ravel())
        return replace(
            fine,
            z=mean(fine.z),
            range_m=mean(fine.range_m),
            normal=np.where(alone[..., None], normal, normal / np.where(length > 0, length, 1)),
            instance=chosen.astype(np.int32).reshape(self.shape),
            material=np.where(seen, material[chosen], np.int32(-1)).reshape(self.shape),
            projector_uv=mean(fine.projector_uv),
            projector_visible=np.asarray(visible & seen).reshape(self.shape),
            nearest_m=nearest,
            farthest_m=farthest,
        )

    def _range_of_depths(self, range_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(rows, columns) float32 each, metres, least and largest range in each zone; NaN without any surface."""
        starts, indices, data = self.share.indptr[:-1], self.share.indices, self.share.data
        largest = np.repeat(np.maximum.reduceat(data, starts), np.diff(self.share.indptr))
        counts = (data >= MIN_PART * largest) & np.isfinite(range_m[indices])
        near = np.minimum.reduceat(np.where(counts, range_m[indices], np.float32(np.inf)), starts)
        far = np.maximum.reduceat(np.where(counts, range_m[indices], np.float32(-np.inf)), starts)
        nothing = ~np.isfinite(near)
        return tuple(  # type: ignore[return-value]
            np.where(nothing, np.float32(np.nan), x).astype(np.float32).reshape(self.shape) for x in (near, far)
        )

    def spread(self, values: np.ndarray) -> np.ndarray:
        """(h, w), for each pixel of the finer camera the largest of the values (rows, columns) of its zones."""
        rows = np.repeat(np.arange(self.matrix.shape[0]), np.diff(self.matrix.indptr))
        result = np.zeros(self.matrix.shape[1], dtype=values.dtype)
        np.maximum.at(result, self.matrix.indices, values.ravel()[rows])
        return result.reshape(self.rig.traced.camera.height, self.rig.traced.camera.width)
