# SPDX-License-Identifier: Apache-2.0
"""Compiled loops of codes of bits give what plain NumPy gives."""

from __future__ import annotations

import numpy as np
import pytest

from rangesim import Capture, Detector, StructuredLight
from rangesim.codes.bit_kernels import LeastDifference, append_bit, coarse_step, neighbour_keys, octaves_nearer
from rangesim.codes.bit_neighbours import Pairs
from rangesim.decoding.row_bands import in_bands


@pytest.mark.parametrize("kind", ["uint8", "uint16", "float32"])
@pytest.mark.parametrize("noise", [False, True])
def test_bits_and_uncertain_bits(kind: str, noise: bool) -> None:
    rng = np.random.default_rng(1)
    pattern, inverse = rng.integers(0, 256, (2, 20, 30)).astype(kind)
    contrast = rng.uniform(0, 200, (20, 30)).astype(np.float32)
    table = Detector(bits=8).noise_dn(np.arange(256)) ** 2
    variance = table if noise else np.zeros(0, dtype=np.float32)
    least = LeastDifference(np.float32(7), np.float32(0.1), np.float32(3), variance)
    code, uncertain = np.full((2, 20, 30), 2, dtype=np.int32)
    append_bit(pattern, inverse, contrast, least, code, uncertain)
    difference = pattern.astype(np.float32) - inverse.astype(np.float32)
    limit = np.maximum(np.float32(7), np.float32(0.1) * contrast)
    if noise:
        of_both = table[pattern.astype(int)] + table[inverse.astype(int)]
        limit = np.maximum(limit, np.float32(3) * np.sqrt(of_both))
    np.testing.assert_array_equal(code, 4 + (difference > 0))
    np.testing.assert_array_equal(uncertain, 4 + (np.abs(difference) < limit))


def test_numbers_beyond_the_table_of_noise_take_its_last_entry() -> None:
    frames = np.full((1, 4), 60_000, dtype=np.uint16)
    least = LeastDifference(np.float32(0), np.float32(0), np.float32(1), np.array([1.0, 100.0], dtype=np.float32))
    code, uncertain = np.zeros((2, 1, 4), dtype=np.int32)
    append_bit(frames, frames - 14, np.ones((1, 4), np.float32), least, code, uncertain)
    assert uncertain.all()  # 14 < sqrt(200)
    append_bit(frames, frames - 15, np.ones((1, 4), np.float32), least, code, uncertain)
    assert (uncertain == 2).all()


def test_neighbours_are_counted_and_compared() -> None:
    rng = np.random.default_rng(2)
    word = rng.integers(-1, 16, (40, 50)).astype(np.int32)
    first, second = word[:-1].ravel(), word[1:].ravel()
    both = (first >= 0) & (second >= 0)
    first, second = first[both], second[both]
    pairs = Pairs.of(neighbour_keys(word, 1, 0))
    assert pairs.counts.sum() == both.sum()
    before, after = (rng.permutation(16).astype(np.int32) for _ in range(2))
    old, new = (np.maximum(np.abs((t[second] >> 1) - (t[first] >> 1)), 0.5) for t in (before, after))
    octaves = np.log2(old / new)
    moved, nearer, gain = octaves_nearer(pairs, before, after, 1)
    assert (moved, nearer) == (np.count_nonzero(np.abs(octaves) >= 1), np.count_nonzero(octaves >= 1))
    assert gain == pytest.approx(octaves.sum())


def test_the_coarse_step_is_the_first_at_which_half_of_the_pairs_agree() -> None:
    cell_of = np.arange(16, dtype=np.int32)
    halves = Pairs.of(np.array([(4 << 32) | 6, (4 << 32) | 6, (0 << 32) | 8], dtype=np.int64))
    assert coarse_step(halves, cell_of, 5) == 2  # 4 and 6 agree without their two finest bits
    assert coarse_step(halves, cell_of, 4) == -1


def test_bands_in_threads_cover_the_image_once() -> None:
    image = np.zeros((333, 2))

    def add(rows: slice) -> None:
        image[rows] += 1

    in_bands(add, len(image))
    assert (image == 1).all()


def test_a_capture_of_a_known_detector_that_is_no_integer_is_read_as_well() -> None:
    sensor = StructuredLight(64, 4, "gray")
    frames = (100 + 200 * sensor.patterns()).astype(np.float32)
    assert sensor.default_decoder.coordinates(Capture(frames, sensor, detector=Detector())).status.max() == 0
