# SPDX-License-Identifier: Apache-2.0
"""Statistical tests of robust estimates: inliers, agreement by chance, degenerate data, residuals against the noise.

OpenCV's USAC (a RANSAC with local optimisation) proposes a model for data with outliers. This module judges it.
`agree_by_chance` follows Moisan and Stival ("A probabilistic criterion to detect rigid point matches between two
images", IJCV 2004). `simpler_model_suffices` is the chi^2 or F test of nested models: it finds degenerate data by their
noise and needs no threshold in pixels.

Used by: rangesim.geometry.homography, two_view and camera_pose; rangesim.calibration.suspects;
rangesim.multiview.bundle_adjustment, factorisation, incremental_reconstruction and nonrigid.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from scipy import special

from rangesim.geometry.correspondences import ROUNDING, Array

Model = TypeVar("Model")

INLIER_PROBABILITY = 0.99
"""Probability that a correct correspondence counts as an inlier, as a fraction. It sets the threshold of the error. The
value is a compromise: a smaller one loses correct pairs, a larger one lets more wrong pairs in."""

SIGNIFICANCE = 1e-5
"""Probability, as a fraction, with which a test may mistake degenerate data for sound data, or chance for a model. For
planes and rotations it is only nominal, because a fundamental matrix fits their noise better than its number of
parameters says: at a level of 1e-3, up to five times as many passed (measured)."""

MAX_ROUNDS = 20
"""Largest number of times that a model is fitted and its inliers are chosen again. A set that stays the same or comes
back ends the rounds sooner, so this bound is only for sets that keep changing."""

MAX_EXCESS = 3.0
"""Largest ratio of the residuals to the stated noise. Other values were not measured. Three leaves room for a noise
that is stated too small; larger residuals come from wrong pairs, and a covariance does not describe those."""


def usac(threshold_px: float, seed: int) -> Any:
    """Settings for OpenCV's robust estimators.

    The random state is fixed by `seed` and threads are off, so that the same data give the same model.
    """
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
    """The error in pixels that a correct correspondence exceeds once in 100 times.

    Parameters
    ----------
    noise_px : standard deviation of one coordinate.
    dimensions : number of coordinates of the vector whose length is the error.
    """
    return float(noise_px * np.sqrt(special.chdtri(dimensions, 1.0 - INLIER_PROBABILITY)))


def consistent_set(
    inliers: np.ndarray,
    threshold: float,
    fit: Callable[[np.ndarray], Model],
    error: Callable[[Model], Array],
    least: int,
) -> tuple[Model, np.ndarray]:
    """A model and its (n,) bool inliers: the model fitted to these inliers has exactly these inliers.

    Model and inliers are found in turns until the set of inliers no longer changes.

    Parameters
    ----------
    inliers : (n,) bool, the first set.
    threshold : largest error of an inlier, in the unit of `error`.
    fit : returns the model of an (n,) bool set.
    error : returns the (n,) errors of all correspondences under a model; those with NaN or infinity are no inliers.
    least : smallest number of inliers that a fit takes.
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
    """Whether `agreeing` of `total` correspondences are no more than the best model of wrong correspondences has.

    A model through a minimal set of `minimal` correspondences fits these exactly. It fits each of the other, wrong ones
    by accident with the given probability. With noise alone, one expects C(total, minimal) P(at least agreeing -
    minimal) such models over all minimal sets. If that number exceeds `SIGNIFICANCE`, the agreement may be chance.
    """
    if agreeing <= minimal:
        return True
    more = special.bdtrc(agreeing - minimal - 1, total - minimal, min(1.0, probability))
    with np.errstate(divide="ignore"):
        return bool(_log_choose(total, minimal) + np.log(more) > np.log(SIGNIFICANCE))


def _log_choose(n: int, k: int) -> float:
    """Natural logarithm of the binomial coefficient "n choose k"."""
    return float(np.log(np.arange(n - k + 1, n + 1) / np.arange(1, k + 1)).sum())


def chi2_limit(freedom: int) -> float:
    """The value that chi^2 with `freedom` degrees of freedom exceeds with probability `SIGNIFICANCE`.

    Without degrees of freedom it is NaN, so that no comparison with it is true.
    """
    return float(special.chdtri(freedom, SIGNIFICANCE)) if freedom > 0 else np.nan


def _f_limit(more: int, rest: int) -> float:
    """The value that F exceeds with probability `SIGNIFICANCE`.

    F has `more` degrees of freedom in its numerator and `rest` in its denominator.
    """
    return float(special.fdtri(more, rest, 1.0 - SIGNIFICANCE))


def simpler_model_suffices(
    simple: tuple[float, int], full: tuple[float, int], noise_px: float | None, rounding: float
) -> bool:
    """Whether the data fit a simpler model, which the full model contains; the full model is then not determined.

    If the noise is known, the simple model's sum of squares over the variance follows chi^2 with its degrees of
    freedom. If it is unknown, the increase of the sum of squares over that of the full model follows F. The simple
    model is rejected where its value has a probability below `SIGNIFICANCE`.

    Parameters
    ----------
    simple, full : sum of squares in px^2, and degrees of freedom: the number of residuals less that of parameters. An
        infinite sum means that the model does not fit at all; the noise can then not be estimated from it.
    noise_px : standard deviation of a coordinate; None if it is unknown.
    rounding : smaller residuals than this, in pixels, count as 0.
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
    """Whether the data also fit a second model of the same kind, with a sum of squares `cost` above the best, `least`.

    Different components of the noise act on two such models, for example on the two poses of a plane. So their sums of
    squares are nearly independent. The test is chi^2 with all degrees of freedom, or F if the noise is unknown.
    """
    if noise_px is not None:
        return bool(cost / noise_px**2 <= chi2_limit(freedom))
    return bool(cost / max(least, rounding**2 * freedom) <= _f_limit(freedom, freedom))


def odds_are_open(cost: float, least: float, freedom: int, noise_px: float | None, rounding: float) -> bool:
    """Whether the posterior odds of a second model against the best one exceed `SIGNIFICANCE`.

    The second model has the sum of squares `cost`, the best one `least`. If the noise is known, the odds are
    exp(-(cost - least) / 2 variance). If it is unknown, they are (least / cost)^(freedom / 2), those of the profile
    likelihood. This holds for models that do not also estimate points in space.
    """
    if noise_px is not None:
        log_odds = -(cost - least) / (2 * noise_px**2)
    else:
        floor = rounding**2 * freedom
        log_odds = -0.5 * freedom * np.log(max(cost, floor) / max(least, floor))
    return bool(log_odds > np.log(SIGNIFICANCE))


def refuse_misfit(cost: float, freedom: int, noise_px: float | None, model: str) -> None:
    """Raise ValueError if the residuals are over three times the stated noise and chance does not explain it.

    Parameters
    ----------
    cost : sum of squares of the residuals in px^2.
    freedom : degrees of freedom: the number of residuals less that of parameters.
    noise_px : standard deviation of a coordinate; None if it is unknown, and then nothing is refused.
    model : name of the model for the message.
    """
    if noise_px is None or freedom <= 0:
        return
    excess = cost / noise_px**2
    if excess > MAX_EXCESS**2 * freedom and excess > chi2_limit(freedom):
        raise ValueError(
            f"expected pairs that {model} explains within their noise of {noise_px:.3g} px, got residuals of "
            f"{np.sqrt(cost / freedom):.3g} px; some pairs are wrong (the robust function finds them), or noise_px "
            "is too small."
        )


def spread(points: Array) -> float:
    """Extent of points (n, d), in their unit: the root mean square of their distances from their centroid."""
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=-1).mean()))


def rounding_of(points: Array) -> float:
    """The size in pixels up to which residuals of points (n, 2) count as rounding."""
    return ROUNDING * max(spread(points), float(np.abs(points).max()) * 1e-3)


def bounding_area(points: Array) -> tuple[float, float]:
    """Area in px^2 and diagonal in px of the bounding box of points (n, 2), where a wrong correspondence may lie."""
    size = np.ptp(points, axis=0)
    return float(max(size.prod(), 1e-300)), float(np.hypot(*size))
