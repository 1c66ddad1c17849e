# SPDX-License-Identifier: Apache-2.0
"""Which correspondences agree with a model, whether more do than chance explains, and whether a simpler model would do.

OpenCV's USAC (a RANSAC with local optimisation) proposes a model of data with outliers. What this adds is the
judgement: `agree_by_chance` after Moisan and Stival ("A probabilistic criterion to detect rigid point matches between
two images", IJCV 2004), and `simpler_model_suffices`, the F test of nested models, which finds degenerate data by the
noise that they have instead of a threshold in pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from scipy import special

from rangesim.geometry.correspondences import ROUNDING, Array

Model = TypeVar("Model")

INLIER_PROBABILITY = 0.99
"""Of a correct correspondence to count as one."""
SIGNIFICANCE = 1e-5
"""Probability of taking degenerate data for sound ones, or chance for a model. Of planes and rotations it is an
ideal: an F fits their noise better than its parameters say, and up to 5 times 1e-3 of them pass a test at 1e-3
(measured)."""
MAX_ROUNDS = 20
MAX_EXCESS = 3.0
"""Times the stated noise that residuals may be."""


def usac(threshold_px: float, seed: int) -> Any:
    """Settings of OpenCV's robust estimators: a fixed random state, so that the same data give the same model."""
    import cv2

    settings = cv2.UsacParams()
    settings.threshold = threshold_px
    settings.confidence = 0.9999
    settings.maxIterations = 20000
    settings.randomGeneratorState = seed
    settings.isParallel = False
    settings.score = cv2.SCORE_METHOD_MSAC
    settings.loMethod = cv2.LOCAL_OPTIM_INNER_AND_ITER_LO
    settings.final_polisher = cv2.NONE_POLISHER
    return settings


def inlier_threshold(noise_px: float, dimensions: int) -> float:
    """Pixels; error of `dimensions` coordinates with that noise that a correct correspondence exceeds once in 100."""
    return float(noise_px * np.sqrt(special.chdtri(dimensions, 1.0 - INLIER_PROBABILITY)))


def consistent_set(
    inliers: np.ndarray,
    threshold: float,
    fit: Callable[[np.ndarray], Model],
    error: Callable[[Model], Array],
    least: int,
) -> tuple[Model, np.ndarray]:
    """The model of the inliers, and the inliers of the model: fitted and chosen in turns until the set stays.

    Parameters
    ----------
    inliers : (n,) bool, to start with. threshold : of the errors. least : inliers that a fit takes.
    fit : (n,) bool -> model. error : model -> (n,) errors of all correspondences; NaN or infinite is none.
    """
    model = fit(inliers)
    seen = {inliers.tobytes()}
    for _ in range(MAX_ROUNDS):
        chosen = np.nan_to_num(error(model), nan=np.inf) <= threshold
        if chosen.tobytes() in seen or chosen.sum() < least:
            break
        seen.add(chosen.tobytes())
        inliers, model = chosen, fit(chosen)
    return model, inliers


def agree_by_chance(agreeing: int, total: int, minimal: int, probability: float) -> bool:
    """Whether `agreeing` of `total` correspondences are no more than the best model of wrong ones would get.

    A model through `minimal` of them fits these exactly, and each other one by accident with `probability`. Over all
    choices of the minimal set, C(total, minimal) P(at least agreeing - minimal) models like this are expected of
    noise alone; more than `SIGNIFICANCE` of them is chance.
    """
    if agreeing <= minimal:
        return True
    more = special.bdtrc(agreeing - minimal - 1, total - minimal, min(1.0, probability))
    with np.errstate(divide="ignore"):
        return bool(_log_choose(total, minimal) + np.log(more) > np.log(SIGNIFICANCE))


def _log_choose(n: int, k: int) -> float:
    return float(np.log(np.arange(n - k + 1, n + 1) / np.arange(1, k + 1)).sum())


def chi2_limit(freedom: int) -> float:
    """What chi^2 of that many degrees of freedom exceeds by chance with a probability of `SIGNIFICANCE`; NaN, below
    which nothing is, of none."""
    return float(special.chdtri(freedom, SIGNIFICANCE)) if freedom > 0 else np.nan


def _f_limit(more: int, rest: int) -> float:
    """The same of F of so many degrees of freedom, of its numerator and denominator."""
    return float(special.fdtri(more, rest, 1.0 - SIGNIFICANCE))


def simpler_model_suffices(
    simple: tuple[float, int], full: tuple[float, int], noise_px: float | None, rounding: float
) -> bool:
    """Whether data do not reject a simpler model that a fuller one contains: the fuller one is not determined then.

    With known noise, the simple model's sum of squares over the variance follows chi^2 of its degrees of freedom.
    Without, the rise of the sum of squares over what the full model leaves follows F. It is rejected where such a
    value has a probability below `SIGNIFICANCE`.

    Parameters
    ----------
    simple, full : sum of squares in px^2, and degrees of freedom: residuals less parameters. Infinite: it does not
        fit at all, and leaves nothing to tell the noise from.
    rounding : px; residuals below are none.
    """
    floor = rounding**2
    cost, freedom = simple
    if not np.isfinite(full[0]) and noise_px is None:
        return False
    if cost <= floor * freedom:
        return True
    if noise_px is not None:
        return bool(cost / noise_px**2 <= chi2_limit(freedom))
    rest, rest_freedom = full
    more = freedom - rest_freedom
    ratio = (cost - rest) / more / (max(rest, floor * rest_freedom) / rest_freedom)
    return bool(ratio <= _f_limit(more, rest_freedom))


def is_as_likely(cost: float, least: float, freedom: int, noise_px: float | None, rounding: float) -> bool:
    """Whether data do not reject a model with a sum of squares `cost` beside the best one of its kind, with `least`.

    Two such models, as the two poses of a plane, look at different components of the noise, so that their sums of
    squares are nearly independent: the test is chi^2, or F if the noise is unknown, of all degrees of freedom.
    """
    if noise_px is not None:
        return bool(cost / noise_px**2 <= chi2_limit(freedom))
    return bool(cost / max(least, rounding**2 * freedom) <= _f_limit(freedom, freedom))


def odds_are_open(cost: float, least: float, freedom: int, noise_px: float | None, rounding: float) -> bool:
    """Whether a model with a sum of squares `cost` has posterior odds above `SIGNIFICANCE` against the one with
    `least`.

    exp(-(cost - least) / 2 variance) with known noise; without, (least / cost)^(freedom / 2), that of the profile
    likelihood. For two models of the same data without points in space to be found along with them.
    """
    if noise_px is not None:
        log_odds = -(cost - least) / (2 * noise_px**2)
    else:
        floor = rounding**2 * freedom
        log_odds = -0.5 * freedom * np.log(max(cost, floor) / max(least, floor))
    return bool(log_odds > np.log(SIGNIFICANCE))


def refuse_misfit(cost: float, freedom: int, noise_px: float | None, model: str) -> None:
    """Raise ValueError if residuals are over three times the noise that was stated, and not by accident.

    Parameters
    ----------
    cost, freedom : sum of squares in px^2 of what the model leaves, and its degrees of freedom.
    """
    if noise_px is None or freedom <= 0:
        return
    excess = cost / noise_px**2
    if excess > MAX_EXCESS**2 * freedom and excess > chi2_limit(freedom):
        raise ValueError(
            f"expected pairs that {model} explains to their noise of {noise_px:.3g} px, got residuals of "
            f"{np.sqrt(cost / freedom):.3g} px; some pairs are wrong (find them by the robust function), or noise_px "
            "is."
        )


def spread(points: Array) -> float:
    """Extent of points (n, d): the root mean square of their distances from their centroid."""
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=-1).mean()))


def rounding_of(points: Array) -> float:
    """Pixels; residuals of points (n, 2) that are rounding."""
    return ROUNDING * max(spread(points), float(np.abs(points).max()) * 1e-3)


def bounding_area(points: Array) -> tuple[float, float]:
    """Area and diagonal of the bounding box of points (n, 2): where a wrong correspondence may lie."""
    size = np.ptp(points, axis=0)
    return float(max(size.prod(), 1e-300)), float(np.hypot(*size))
