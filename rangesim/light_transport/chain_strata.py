# SPDX-License-Identifier: Apache-2.0
"""Strata of specular chains: which way the samples of a pixel take at glass.

At glass a path is reflected or refracted. So a pixel of glass sees several places at once, each by a chain of its own,
and a random choice at each surface makes the noise of a binomial distribution. The *main chain* takes the likelier way
at each surface. Every other chain leaves it at one of them. These are the strata: the chains that leave the main chain
at its first surface of glass, at its second and so on, and those that follow it over its first few surfaces.

Each stratum has a fixed number of samples (stratified sampling: Cochran, Sampling Techniques, 1977, chapter 5), and a
path takes the way of its stratum for certain. If n samples come to a surface by the main chain, one of them leaves it.
The light of this one counts n p times, where p is the probability of the less likely way, and that of the others
n (1 - p) / (n - 1) times. Where p is above 1 / n, one is too few. There the others leave as well, with the probability
at which n p of them do in all, and every sample counts once. A sample that finds no surface at which to leave the main
chain stays with the others, so none is lost at the rim of a glass.

The chains that leave bring little light, but light from elsewhere, so half of the samples are theirs. The samples of
each stratum fill the pixel evenly.
"""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.delta_surfaces import splits_light
from rangesim.light_transport.sampling import aligned
from rangesim.light_transport.surfaces import number_of, table_of

MAX_BRANCHES = 4
"""Largest number of surfaces at which samples leave the main chain: a hollow glass has four faces, as have two panes.
Beyond them, random choices remain. With 2 (6) on `glassware`, 320 x 240, 64 samples, the noise of AMCW on glass is 1.2
(1.2) times as large."""
PERIOD = 2 * MAX_BRANCHES
"""Number of samples of a half after which the strata come again; one for each branch, and as many of the main chain."""
MIN_SAMPLES = 8
"""Smallest number of samples of a pixel that has strata. With fewer, some strata would have no sample."""
NEVER = 0xFFFFFFFF
"""Value of `Stratum.leaves_at` of paths that follow the main chain."""
STRATUM_STEP = 0x10000
"""Difference between the first numbers of the samples of two strata, so that their places in the pixel differ."""
CERTAIN = 1 - 1e-6
"""Probability of a way from which on no light takes the other: rounding of single precision leaves no more."""


class Stratum(NamedTuple):
    """The stratum of a sample.

    number : UInt32, number of the sample among those of its stratum and pixel.
    leaves_at : UInt32, number of the surface of glass, from 0, at which the path leaves the main chain; `NEVER` if it
        follows it.
    """

    number: mi.UInt32
    leaves_at: mi.UInt32


class Choice(NamedTuple):
    """The choice of a way at a surface of glass.

    number : Float in 0..1, from which the BSDF samples this way.
    is_made : Bool, whether the stratum decides. Where it does not, `number` and `left_over` are those that were given.
    factor : Float, by which the weight of the sample is multiplied.
    left_over : Float, uniform number in 0..1 for later choices.
    turns : UInt32, samples of a period that go on along the main chain, as the path does; 0 if no stratum decides any
        more.
    """

    number: mi.Float
    is_made: mi.Bool
    factor: mi.Float
    left_over: mi.Float
    turns: mi.UInt32


class ChainStrata:
    """The strata of the pixels of an image.

    Parameters
    ----------
    scene : mitsuba.Scene
    branches : (h, w) int, number of surfaces at which samples leave the main chain, see `Scatterer.branches`; 0: the
        pixel has no strata.
    """

    def __init__(self, scene: mi.Scene, branches: np.ndarray) -> None:
        self.branches = mi.UInt32(aligned(branches, np.uint32))
        self.splits_of = mi.Bool(table_of(scene, list(map(splits_light, scene.shapes()))))

    def branches_of(self, pixel: mi.UInt32, samples: mi.UInt32) -> mi.UInt32:
        """Number of surfaces at which the samples of pixels leave the main chain; 0 where there are too few samples."""
        return dr.gather(mi.UInt32, self.branches, pixel, samples >= MIN_SAMPLES)

    def choice(
        self,
        bsdf: mi.BSDFPtr,
        si: mi.SurfaceInteraction3f,
        stratum: Stratum,
        branches: mi.UInt32,
        turns: mi.UInt32,
        number: mi.Float,
    ) -> Choice:
        """The choice of each path at the surface that it met.

        Parameters
        ----------
        branches : UInt32, number of surfaces at which samples of this pixel leave the main chain.
        turns : UInt32, samples of a period that came here by the main chain, as the path did; 0 if no stratum decides.
        number : Float, uniform in 0..1, evenly spread over the samples of the stratum.
        """
        is_made = (turns > 0) & dr.gather(mi.Bool, self.splits_of, number_of(si.shape), turns > 0)
        # With 0.5 glass takes the likelier way; it reflects for numbers up to the reflectance
        likelier, _ = bsdf.sample(mi.BSDFContext(), si, 0.5, mi.Point2f(0.5), is_made)
        reflects = mi.has_flag(likelier.sampled_type, mi.BSDFFlags.DeltaReflection)
        main, n = likelier.pdf, mi.Float(turns)
        other, splits = 1 - main, is_made & (main < CERTAIN)
        chance = dr.maximum((n * other - 1) / (n - 1), 0)
        has_to = splits & (PERIOD - turns == stratum.leaves_at)
        leaves = has_to | (splits & (number < chance))
        factor = dr.select(has_to, dr.minimum(n * other, 1), dr.select(leaves, 1, dr.maximum(n * main / (n - 1), 1)))
        left_over = dr.select(leaves, number / chance, (number - chance) / (1 - chance))
        stays = dr.select(splits, turns - 1, turns)
        return Choice(
            number=dr.select(is_made, dr.select(leaves == reflects, dr.one_minus_epsilon(mi.Float), 0), number),
            is_made=is_made,
            factor=dr.select(splits, factor, 1),
            left_over=dr.select(splits & ~has_to, left_over, number),
            turns=dr.select(leaves | (PERIOD - stays >= branches), 0, stays),
        )


def stratum_of(branches: mi.UInt32, shift: mi.UInt32, number: mi.UInt32) -> Stratum:
    """The stratum of a sample.

    In each half of the samples (`SampleAllocation.in_halves`), two samples follow the main chain, two leave it at two
    of the surfaces, two follow it, and two leave it at the other two. So 16 samples meet all strata in each half, and 8
    samples meet all of them in the two halves together. Where there are fewer branches, the main chain has the samples
    that are left.

    Parameters
    ----------
    branches : UInt32, number of surfaces at which samples of the pixel leave the main chain.
    shift : UInt32, random number of the pixel, which decides with which stratum it begins.
    number : UInt32, number of the sample among all samples of the pixel.
    """
    half, in_half = (number >> 1) & 1, ((number >> 2) << 1) | (number & 1)
    pair, second = (in_half & (PERIOD - 1)) >> 1, number & 1  # of the period
    leaves_first = (shift ^ half) & 1  # the others begin with the main chain
    later_first = ((shift >> 1) ^ half) & 1  # surfaces 2 and 3 come before 0 and 1
    branch = (((pair >> 1) ^ later_first) << 1) | (second ^ (shift >> 2) & 1)
    may_leave = (pair ^ leaves_first) & 1 == 1
    leaves = may_leave & (branch < branches)
    # The samples of the main chain are those of the half before this one that did not leave
    of_early = dr.minimum(branches, 2)
    of_first = dr.select(later_first == 1, branches - of_early, of_early)
    left = (in_half // PERIOD) * branches + dr.select(pair + leaves_first > 1, of_first, 0)
    left += dr.select(pair + leaves_first > 3, branches - of_first, 0)
    left += dr.select(may_leave & (second == 1) & (branch ^ 1 < branches), mi.UInt32(1), 0)
    of_stratum = dr.select(leaves, in_half // PERIOD, in_half - left)
    first = dr.select(leaves, (branch + 1) * STRATUM_STEP, 0)
    in_pairs = ((of_stratum >> 1) << 2) | (half << 1) | (of_stratum & 1)
    return Stratum(number=first + in_pairs, leaves_at=dr.select(leaves, branch, NEVER))
