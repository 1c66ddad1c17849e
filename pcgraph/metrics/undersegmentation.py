# SPDX-License-Identifier: Apache-2.0
"""Undersegmentation error: how far segments leak over the borders of true segments."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from pcgraph.metrics.table import contingency, sizes


def undersegmentation_error(
    labels: ArrayLike,
    truth: ArrayLike,
    *,
    definition: Literal["neubert_protzel", "levinshtein", "papon"] = "neubert_protzel",
) -> float:
    """UE, 0 at best, in one of three definitions; S a segment, G a true segment, N the number of points.

    Parameters
    ----------
    labels, truth : same shape, int
        Points negative in either are left out.
    definition : str
        "neubert_protzel" (2012), 0..1: sum over pairs of min(|S and G|, |S without G|), over N.
        "papon" (VCCS, 2013), >= 0: sum over G of the sizes of all S that meet G, less N, over N.
        "levinshtein" (2009), >= 0: mean over G of (sizes of all S that meet G, less |G|) / |G|.

    Raises
    ------
    ValueError
        As `contingency`; or the definition is unknown.
    """
    table = contingency(labels, truth)
    found, true = sizes(table)
    met = found[table.row]  # the whole of each segment, once for each true segment that it meets
    if definition == "neubert_protzel":
        return float(np.minimum(table.data, met - table.data).sum() / true.sum())
    if definition == "papon":
        return float((met.sum() - true.sum()) / true.sum())
    if definition == "levinshtein":
        return float((np.bincount(table.col, met, len(true)) / true - 1).mean())
    raise ValueError(f"expected definition 'neubert_protzel', 'papon' or 'levinshtein', got {definition!r}")
