# SPDX-License-Identifier: Apache-2.0
"""Variation of information between two labellings, in bits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pcgraph.metrics.table import contingency, sizes


@dataclass(frozen=True)
class VariationOfInformation:
    """The two halves of the variation of information, bits, 0 at best.

    Attributes
    ----------
    split : float
        H(labels | truth): what it takes to name the segment of a point whose true segment is known; grows with
        oversegmentation.
    merge : float
        H(truth | labels): the other way round; grows with undersegmentation.
    """

    split: float
    merge: float

    @property
    def total(self) -> float:
        """VI, bits, 0..log2 N."""
        return self.split + self.merge


def variation_of_information(labels: ArrayLike, truth: ArrayLike) -> VariationOfInformation:
    """VI and its two halves, in bits (Meila 2007).

    Points negative in either are left out. Raises as `contingency`.
    """
    table = contingency(labels, truth)
    found, true = sizes(table)
    n = true.sum()
    split = table.data @ np.log2(true[table.col] / table.data) / n
    merge = table.data @ np.log2(found[table.row] / table.data) / n
    return VariationOfInformation(float(split), float(merge))
