# SPDX-License-Identifier: Apache-2.0
"""An estimate of the projector's light that a pass leaves out because it ends paths and chains somewhere.

A camera path brings light at each of its vertices. Let T_k be the throughput with which paths arrive at their k-th
vertex. It falls off geometrically after a few vertices: the ratio t = T_n / T_(n-1) at the last vertex that a pass
looks at is the mean albedo times the chance to meet another surface. (The estimate uses the ratio of throughputs,
because the ratio of the light itself goes up and down from vertex to vertex: directly lit surfaces mostly face
indirectly lit ones.) The throughput of all later vertices is T_n t / (1 - t). The estimate assumes that these vertices
get as much light per throughput as vertices 2 to n get on average:

    left out = T_n t / (1 - t) * (light at vertices 2..n) / (T_2 + ... + T_n)

For chains of delta interactions that are cut off, it assumes light as bright as that of all other paths. For light of
caustics whose chains are cut off, it assumes that it would land where the other light of caustics does.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from rangesim.errors import TruncationWarning
from rangesim.light_transport.specular_chain import MAX_CHAIN
from rangesim.signals import EnergySplit, Truncation

DIRECT_ALONE = 2
"""The `max_depth`, a count of segments, that asks for direct light alone, so that light at later vertices is not
known."""
MAX_LEFT_OUT = 0.02
"""Fraction of the projector's light that a pass may leave out without a warning. A smaller value would warn more often,
of light that changes few readings."""
MAX_DECAY = 0.99
"""Largest ratio t of the throughputs at successive vertices, because t / (1 - t) grows without a bound in a closed room
that absorbs next to nothing."""


Array = TypeVar("Array")


@dataclass
class Tally(Generic[Array]):
    """Sums over the samples of a pixel, from which the light that a pass leaves out is estimated.

    Throughput is radiance at the camera per radiance at the place; it has no unit.

    first : throughput at the first vertex that scatters.
    further : throughput at all later vertices up to the last, added up.
    before_last, last : throughput at the last but one and at the last of the vertices at which a pass looks for the
        projector.
    indirect : W/m2/sr, radiance that the projector brings at vertices after the first.
    cut : throughput of paths that ended because a chain of delta interactions was too long.
    """

    first: Array
    further: Array
    before_last: Array
    last: Array
    indirect: Array
    cut: Array


def estimate_truncation(tally: np.ndarray, energy: EnergySplit, max_depth: int, caustics_cut: float) -> Truncation:
    """Fractions of the projector's light that a pass left out.

    Parameters
    ----------
    tally : (6, h, w) float32, in the order of the fields of `Tally`.
    energy : EnergySplit, of the pass.
    max_depth : int, of the pass.
    caustics_cut : ratio of the power in chains that were cut off to the power of the caustics that landed.
    """
    first, further, before_last, last, indirect, cut = (float(x.sum(dtype=float)) for x in tally)
    seen = sum(float(x.sum(dtype=float)) for x in (energy.direct, energy.multipath, energy.specular, energy.caustic))
    by_depth = np.nan
    if max_depth > DIRECT_ALONE:
        t = min(max(last / before_last, 0.0), MAX_DECAY) if before_last else 0.0
        by_depth = indirect / further * last * t / (1 - t) if further else 0.0
    by_chains = seen * cut / (first + further) if first + further else 0.0
    by_caustics = float(energy.caustic.sum(dtype=float)) * caustics_cut
    parts = np.array([by_depth, by_chains, by_caustics])
    total = seen + np.nansum(parts)
    return Truncation(*(float(x) for x in parts / total)) if total else Truncation(0.0 * by_depth, 0.0, 0.0)


def warn_of_truncation(truncation: Truncation | None, max_depth: int, of: str, stacklevel: int) -> None:
    """Warn if a pass left out more than `MAX_LEFT_OUT`; `of` names the camera, if there are several."""
    if truncation is None or truncation.total <= MAX_LEFT_OUT:
        return
    why = f"a max_depth of {max_depth} ends light paths early; a larger one includes this light"
    if not truncation.depth > truncation.chains + truncation.caustics:
        why = f"it meets more than {MAX_CHAIN} surfaces of glass and mirrors in a row"
    text = f"about {truncation.total:.0%} of the projector's light is left out{of}: {why}."
    warnings.warn(TruncationWarning(text, truncation.total), stacklevel=stacklevel + 1)
