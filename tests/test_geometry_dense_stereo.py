# SPDX-License-Identifier: Apache-2.0
"""Dense stereo: known shifts of a texture, what has no match, and OpenCV's matcher beside our own."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import pytest

from rangesim.geometry import DenseMatching, MatchOutcome, match_densely

SIZE = 60, 140
"""Height and width of the images, pixels."""
INSIDE = slice(8, -8), slice(40, -8)
"""Pixels whose windows lie in both images."""
METHODS = [
    ("census", "semi-global"),
    ("census", "local"),
    ("zncc", "semi-global"),
    ("zncc", "local"),
    ("opencv", "local"),
]


def waves(shift_px: np.ndarray | float = 0.0) -> np.ndarray:
    """(h, w) texture without a period, whose finest wave is four pixels long, seen `shift_px` farther to the right."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    random = np.random.default_rng(0)
    steps, phases = random.uniform(-1.5, 1.5, (60, 2)), random.uniform(0, 2 * np.pi, 60)
    return np.asarray(sum(np.sin(a * (x + shift_px) + b * y + c) for (a, b), c in zip(steps, phases, strict=True)))


@pytest.mark.parametrize(("method", "aggregation"), METHODS)
@pytest.mark.parametrize("shift_px", [7.0, 7.25, 7.5, 7.8])
def test_a_fractional_shift_is_found_without_pixel_locking(method: Any, aggregation: Any, shift_px: float) -> None:
    found = match_densely(waves(), waves(shift_px), (0, 20), DenseMatching(method, aggregation))
    error = (found.disparity_px - shift_px)[INSIDE]
    assert np.isfinite(error).all()
    assert np.abs(error).max() < 0.01


def test_the_parabola_locks_to_pixels_and_the_refinement_does_not() -> None:
    shift_px = 7.25
    errors = [
        np.nanmedian(match_densely(waves(), waves(shift_px), (0, 20), DenseMatching(refine=r)).disparity_px) - shift_px
        for r in (False, True)
    ]
    assert abs(errors[0]) > 10 * abs(errors[1])


@pytest.mark.parametrize("method", ["census", "zncc"])
def test_gain_and_offset_of_a_camera_change_nothing(method: Any) -> None:
    found = match_densely(waves(), 0.5 * waves(6.4) + 3.0, (0, 20), DenseMatching(method))
    assert np.abs(found.disparity_px - 6.4)[INSIDE].max() < 0.01


def test_the_stated_standard_deviation_is_that_of_the_errors() -> None:
    """Between one and two times: the noise of the interpolated image is blurred, and windows of neighbours overlap."""
    random, noise = np.random.default_rng(1), 0.5
    first, second = waves() + random.normal(0, noise, SIZE), waves(7.3) + random.normal(0, noise, SIZE)
    found = match_densely(first, second, (0, 20), noise=(noise, noise))
    error, sigma = (found.disparity_px - 7.3)[INSIDE], found.sigma_px[INSIDE]
    known = np.isfinite(error)
    assert known.mean() > 0.95
    assert 0.7 < np.std(error[known] / sigma[known]) < 1.5
    assert abs(np.mean(error[known])) < 0.02


def test_what_has_no_texture_says_so() -> None:
    random = np.random.default_rng(2)
    flat = [random.normal(0, 0.1, SIZE) for _ in range(2)]
    for method in ("census", "zncc", "opencv"):
        found = match_densely(*flat, (0, 20), DenseMatching(method), noise=(0.1, 0.1))  # type: ignore[arg-type]
        assert not np.isfinite(found.disparity_px[INSIDE]).any()
        assert (found.outcome[INSIDE] == MatchOutcome.NO_TEXTURE).mean() > 0.5
    even = match_densely(np.ones(SIZE), np.ones(SIZE), (0, 20))
    assert (even.outcome == MatchOutcome.NO_TEXTURE).all()


def test_opencv_takes_an_image_that_is_even_but_for_a_few_dots() -> None:
    """Its own quantiles see no contrast in it, so there is no match, but no error either."""
    sparse = np.zeros(SIZE)
    sparse[30, 60:80:4] = 1.0
    found = match_densely(sparse, sparse, (0, 20), DenseMatching("opencv"))
    assert not np.isfinite(found.disparity_px).any()


def test_a_periodic_texture_is_ambiguous_if_two_periods_fit_the_range() -> None:
    _, x = np.mgrid[: SIZE[0], : SIZE[1]]
    bars = [np.sin(2 * np.pi * (x + shift) / 8 + 0.2) for shift in (0, 5)]
    both = match_densely(bars[0], bars[1], (0, 20))
    assert not np.isfinite(both.disparity_px[INSIDE]).any()
    assert (both.outcome[INSIDE] == MatchOutcome.AMBIGUOUS).mean() > 0.9
    one = match_densely(bars[0], bars[1], (2, 8))
    assert np.nanmedian(one.disparity_px[INSIDE]) == pytest.approx(5, abs=0.02)


def step_scene() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Both images of a near strip (15 px) before a far wall (5 px), and the true disparities of the first image."""
    left = np.full(SIZE, 5.0)
    left[:, 70:100] = 15.0
    far, near = waves(5.0), waves(15.0) + 5
    right = far.copy()
    right[:, 55:85] = near[:, 55:85]
    first = np.where(left > 10, waves() + 5, waves())
    return first, right, left


@pytest.mark.parametrize("method", ["census", "zncc"])
def test_pixels_that_the_second_camera_does_not_see_are_occluded(method: Any) -> None:
    first, second, truth = step_scene()
    found = match_densely(first, second, (0, 20), DenseMatching(method))
    hidden = np.zeros(SIZE, dtype=bool)
    hidden[:, 60:70] = True  # the wall that the strip covers in the second image
    refused = ~np.isfinite(found.disparity_px)
    assert refused[hidden].mean() > 0.9
    assert (found.outcome[hidden & refused] == MatchOutcome.OCCLUDED).mean() > 0.6
    seen = ~hidden & ~refused
    seen[:, :20] = False
    assert (np.abs(found.disparity_px - truth)[seen] < 0.5).mean() > 0.95


def test_a_disparity_beyond_the_range_is_refused() -> None:
    found = match_densely(waves(), waves(20.6), (0, 20))
    assert not np.isfinite(found.disparity_px[INSIDE]).any()
    assert (found.outcome[INSIDE] == MatchOutcome.OUT_OF_RANGE).mean() > 0.9


def test_pixels_without_an_image_have_no_match() -> None:
    first, second = waves(), waves(7.0)
    first[20:30, 60:70] = np.nan
    second[40:50, 60:70] = np.nan
    found = match_densely(first, second, (0, 20))
    assert (found.outcome[20:30, 60:70] == MatchOutcome.NO_IMAGE).all()
    assert not np.isfinite(found.disparity_px[42:48, 69:75]).any()
    assert np.nanmax(np.abs(found.disparity_px - 7.0)[INSIDE]) < 0.1


RANDOM = np.random.default_rng(3).random((20, 30))
STRANGE = {
    "no image": np.full((20, 30), np.nan),
    "one value": np.ones((20, 30)),
    "holes": np.where(RANDOM < 0.3, np.nan, RANDOM),
    "very bright": 1e30 * RANDOM,
    "very dark": 1e-30 * RANDOM,
    "negative": -RANDOM,
    "one row": RANDOM[:1],
    "few columns": RANDOM[:, :9],
}


@pytest.mark.parametrize("name", STRANGE)
@pytest.mark.parametrize(("method", "aggregation"), METHODS)
def test_strange_images_have_outcomes_for_all_pixels(name: str, method: Any, aggregation: Any) -> None:
    image = STRANGE[name]
    for second in (image, np.full(image.shape, np.nan), image[:, ::-1].copy()):
        for noise in ((0.0, 0.0), (0.1, 0.1)):
            found = match_densely(image, second, (0, 8), DenseMatching(method, aggregation), noise)
            np.testing.assert_array_equal(np.isfinite(found.disparity_px), found.outcome == MatchOutcome.MATCHED)
            assert not np.isfinite(found.disparity_px[np.isnan(image)]).any()


@pytest.mark.parametrize("method", ["census", "zncc"])
def test_the_number_of_threads_changes_no_byte(method: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    results = []
    for threads in (1, 2):
        monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", threads)
        results.append(match_densely(waves(), waves(7.3), (0, 20), DenseMatching(method)))
    for one, other in zip(*results, strict=True):
        assert one.tobytes() == other.tobytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"window_px": 8}, "expected window_px odd, got 8"),
        ({"small_penalty": 50, "large_penalty": 20}, "small_penalty to be at most large_penalty, got 50 and 20"),
        ({"method": "sift"}, "method"),
    ],
)
def test_settings_that_make_no_sense_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DenseMatching(**change)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.zeros((4, 4)), np.zeros((4, 5)), (0, 2)), "two images of one shape"),
        ((np.zeros((4, 8)), np.zeros((4, 8)), (5, 5)), "disparities"),
        ((np.zeros((4, 8)), np.zeros((4, 8)), (0, 9)), "within an image 8 pixels wide"),
    ],
)
def test_images_that_cannot_be_matched_are_refused(arguments: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        match_densely(*arguments)


@pytest.mark.parametrize("method", ["census", "zncc"])
@pytest.mark.parametrize(("steps", "stated"), [((1.0, 0.0), 0.1), ((0.8, 0.6), 0.1), ((0.6, -0.8), 0.02)])
def test_beside_a_lone_edge_nothing_is_read(method: Any, steps: tuple[float, float], stated: float) -> None:
    """The outline of a thing (12 px) before a wall without texture (5 px): windows that reach it would give the wall
    the disparity of the thing. The same holds if the noise is five times the stated one."""
    random = np.random.default_rng(4)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5

    def seen(shift_px: float) -> np.ndarray:
        across = steps[0] * (x + shift_px - 80) + steps[1] * (y - 30)
        return np.asarray(np.clip(3 * across, -3, 3) + random.normal(0, 0.1, SIZE))

    found = match_densely(seen(0.0), seen(12.0), (0, 20), DenseMatching(method), noise=(stated, stated))
    assert np.isfinite(found.disparity_px[INSIDE]).mean() < 0.002
    without = DenseMatching(method, texture_around=False)
    read = match_densely(seen(0.0), seen(12.0), (0, 20), without, noise=(stated, stated)).disparity_px
    assert np.nanmedian(read[INSIDE]) == pytest.approx(12.0, abs=0.2)


def test_where_texture_encloses_a_bright_thing_both_are_read() -> None:
    """Noise that grows with brightness does not hide the fainter texture around a bright thing."""
    random = np.random.default_rng(5)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    gain = [np.where(np.hypot(x + shift - 85, y - 30) < 14, 6.0, 1.0) for shift in (0.0, 7.3)]
    images = [g * (waves(s) + random.normal(0, 0.2, SIZE)) for g, s in zip(gain, (0.0, 7.3), strict=True)]
    found = match_densely(images[0], images[1], (0, 20), noise=(0.2 * gain[0], 0.2 * gain[1]))
    assert np.isfinite(found.disparity_px[INSIDE]).mean() > 0.9
