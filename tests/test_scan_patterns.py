# SPDX-License-Identifier: Apache-2.0
"""Scanners: even turns, figures that close, rosettes within their bounds, and Snell's law at the faces of prisms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rangesim.rig.scan_patterns import ScanRays, column_shifts, lissajous, risley, risley_prisms, spinning

ELEVATIONS = np.radians([15.0, 1.0, 0.0, -3.0, -25.0])
TEN_HERTZ_S = 0.1


def azimuth(rays: ScanRays) -> np.ndarray:
    return np.arctan2(rays.directions[..., 0], rays.directions[..., 2])


def off_axis(rays: ScanRays) -> np.ndarray:
    sideways = np.hypot(rays.directions[..., 0], rays.directions[..., 1])
    return np.arctan2(sideways, rays.directions[..., 2])  # exact near 0, where arccos is not


@pytest.mark.parametrize(
    "rays",
    [
        spinning(ELEVATIONS, 512, TEN_HERTZ_S, azimuth_offsets_rad=0.05, firing_times_s=np.arange(5) * 1e-6),
        lissajous(21_000.0, 1_400.0, (0.6, 0.4), 4_096, phase_rad=0.3),
        risley((0.17, 0.16), (121.6, -77.7), 10_000, 0.1),
        risley_prisms((0.3, 0.3), (1.51, 1.51), (121.6, -77.7), 10_000, 0.1),
    ],
)
def test_directions_have_unit_length_and_times_grow(rays: ScanRays) -> None:
    assert np.abs(np.linalg.norm(rays.directions, axis=-1) - 1).max() < 1e-14
    assert rays.times_s.shape == rays.directions.shape[:2]
    assert (np.diff(rays.times_s, axis=1) > 0).all()


# ---- Heads that turn ------------------------------------------------------------------------------------------------


def test_a_turn_covers_azimuth_evenly_and_keeps_elevations() -> None:
    rays = spinning(ELEVATIONS, 1024, TEN_HERTZ_S)
    for ring in azimuth(rays):
        steps = np.diff(np.unwrap(np.append(ring, ring[0])))  # the last step closes the turn
        np.testing.assert_allclose(steps[:-1], 2 * np.pi / 1024, atol=1e-12)
        assert np.isclose((steps[-1]) % (2 * np.pi), 2 * np.pi / 1024)
    elevations = np.arcsin(-rays.directions[..., 1])
    np.testing.assert_allclose(elevations, np.broadcast_to(ELEVATIONS[:, None], elevations.shape), atol=1e-14)
    assert rays.origins is None


def test_the_first_column_looks_forward_and_the_head_turns_to_the_right() -> None:
    rays = spinning([0.0, np.radians(10)], 4, TEN_HERTZ_S)
    np.testing.assert_allclose(rays.directions[0], [[0, 0, 1], [1, 0, 0], [0, 0, -1], [-1, 0, 0]], atol=1e-15)
    assert rays.directions[1, 0, 1] < 0  # y is down, so a raised beam has a negative y


def test_a_head_can_sweep_an_arc_to_the_left() -> None:
    rays = spinning([0.0], 120, TEN_HERTZ_S, first_azimuth_rad=np.radians(60), arc_rad=np.radians(-120))
    np.testing.assert_allclose(np.degrees(azimuth(rays)[0]), 60 - np.arange(120), atol=1e-9)


def test_beams_begin_where_the_head_has_turned() -> None:
    offset = 0.015806
    rays = spinning(ELEVATIONS, 360, TEN_HERTZ_S, np.radians(3.0), (0, 0, offset))
    assert rays.origins is not None
    np.testing.assert_allclose(np.linalg.norm(rays.origins, axis=-1), offset, atol=1e-15)
    begin = np.arctan2(rays.origins[..., 0], rays.origins[..., 2])
    turn = np.angle(np.exp(1j * (azimuth(rays) - begin)))
    np.testing.assert_allclose(turn, np.radians(3.0), atol=1e-12)


def test_rings_may_begin_at_different_heights() -> None:
    heights = np.array([0.0112, -0.0007])
    offsets = np.stack([0 * heights, -heights, 0 * heights], axis=-1)
    rays = spinning(np.radians([-15.0, 1.0]), 8, TEN_HERTZ_S, origin_offset_m=offsets)
    assert rays.origins is not None
    np.testing.assert_array_equal(rays.origins[..., 1], np.broadcast_to(-heights[:, None], (2, 8)))
    assert not rays.origins[..., ::2].any()


def test_the_head_of_a_vlp_16_turns_on_between_its_firings() -> None:
    cycle_s, step_s = 55.296e-6, 2.304e-6
    columns = 1808
    elevations = np.radians([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15])
    rays = spinning(elevations, columns, columns * cycle_s, firing_times_s=np.arange(16) * step_s)
    np.testing.assert_allclose(rays.times_s[:, 7], 7 * cycle_s + np.arange(16) * step_s)
    speed = 2 * np.pi / (columns * cycle_s)
    np.testing.assert_allclose(np.unwrap(azimuth(rays), axis=1), speed * rays.times_s, atol=1e-9)


@pytest.mark.parametrize("arc_deg", [360.0, -360.0, 120.0])
def test_shifted_columns_are_directions(arc_deg: float) -> None:
    leads = np.radians(np.array([11.24, 3.93, -3.29, -10.34, 10.81]))
    rays = spinning(ELEVATIONS, 1024, TEN_HERTZ_S, leads, arc_rad=np.radians(arc_deg))
    shifts = column_shifts(rays.directions)
    rolled = np.array([np.roll(row, shift) for row, shift in zip(azimuth(rays), shifts, strict=True)])
    inner = rolled[:, 300:-300]  # an arc does not close
    spread = np.ptp(np.unwrap(np.unwrap(inner, axis=1), axis=0), axis=0)
    assert spread.max() <= np.radians(abs(arc_deg)) / 1024 + 1e-12
    assert shifts.min() == 0
    assert not column_shifts(rays.directions[:, :1]).any()


# ---- Mirrors that oscillate -----------------------------------------------------------------------------------------


def test_a_lissajous_figure_closes_and_stays_within_its_amplitudes() -> None:
    rays = lissajous(700.0, 500.0, np.radians([35.0, 27.5]), 2 * 7000, duration_s=2 / 100)  # 7 : 5, so 1 / 100 s
    np.testing.assert_allclose(rays.directions[0, :7000], rays.directions[0, 7000:], atol=1e-12)
    assert np.isclose(np.abs(azimuth(rays)).max(), np.radians(35.0), atol=1e-6)
    assert np.isclose(np.abs(np.arcsin(rays.directions[..., 1])).max(), np.radians(27.5), atol=1e-6)


def test_a_figure_of_equal_frequencies_is_a_line_or_an_ellipse() -> None:
    line = lissajous(100.0, 100.0, (0.2, 0.1), 100)
    elevation = -np.arcsin(line.directions[..., 1])
    np.testing.assert_allclose(azimuth(line), 2 * elevation, atol=1e-15)
    ellipse = lissajous(100.0, 100.0, (0.2, 0.1), 100, phase_rad=np.pi / 2)
    elevation = -np.arcsin(ellipse.directions[..., 1])
    np.testing.assert_allclose((azimuth(ellipse) / 0.2) ** 2 + (elevation / 0.1) ** 2, 1, atol=1e-12)


def test_rows_follow_each_other_in_time() -> None:
    flat, rows = (lissajous(700.0, 500.0, (0.6, 0.4), n, 0.01) for n in (600, (20, 30)))
    np.testing.assert_array_equal(rows.times_s.reshape(1, -1), flat.times_s)
    np.testing.assert_array_equal(rows.directions.reshape(1, -1, 3), flat.directions)


# ---- Prisms that rotate ---------------------------------------------------------------------------------------------


def test_a_rosette_lies_between_its_two_circles_and_reaches_both() -> None:
    first, second = np.radians([10.0, 7.0])
    angles = off_axis(risley((first, second), (121.6, -77.7), 100_000, 1.0))
    assert first - second - 1e-12 <= angles.min() < first - second + 1e-5
    assert first + second - 1e-5 < angles.max() <= first + second + 1e-12


def test_prisms_that_rotate_together_draw_a_circle_and_opposite_ones_a_line() -> None:
    circle = risley((0.1, 0.06), (50.0, 50.0), 1000, 0.02, phases_rad=(0.0, np.pi / 2))
    np.testing.assert_allclose(off_axis(circle), np.hypot(0.1, 0.06), atol=1e-12)
    line = risley((0.1, 0.1), (50.0, -50.0), 1000, 0.02)
    assert np.abs(line.directions[..., 1]).max() < 1e-15
    assert np.isclose(np.abs(azimuth(line)).max(), 0.2)


def test_one_prism_refracts_as_snell_says() -> None:
    wedge, index = 0.35, 1.51
    rays = risley_prisms((wedge, 0.0), (index, 1.0), (10.0, 0.0), 360, 0.1)
    np.testing.assert_allclose(off_axis(rays), np.arcsin(index * np.sin(wedge)) - wedge, atol=1e-12)
    towards = np.arctan2(rays.directions[..., 1], rays.directions[..., 0])
    np.testing.assert_allclose(np.unwrap(towards[0]), 2 * np.pi * 10.0 * rays.times_s[0], atol=1e-9)


@pytest.mark.parametrize("side", [1, -1])
def test_two_prisms_in_line_refract_as_snell_says_in_their_plane(side: int) -> None:
    first, second, n1, n2 = 0.30, 0.25, 1.51, 1.46
    rays = risley_prisms((first, second), (n1, n2), (0.0, 0.0), 1, 1.0, (0.0, 0.0 if side > 0 else np.pi))
    between = np.arcsin(n1 * np.sin(first)) - first
    within = np.arcsin(np.sin(between) / n2)
    tilt = side * second
    expected = np.arcsin(n2 * np.sin(tilt + within)) - tilt
    assert np.isclose(azimuth(rays)[0, 0], expected, atol=1e-12)


def test_prisms_that_get_thin_draw_the_rosette_of_thin_ones() -> None:
    index, rates = 1.51, (121.6, -77.7)
    ratios = []
    for wedge in (0.08, 0.04, 0.02):
        exact = risley_prisms((wedge, wedge), (index, index), rates, 2000, 0.1)
        thin = risley(((index - 1) * wedge,) * 2, rates, 2000, 0.1)
        ratios.append(np.linalg.norm(exact.directions - thin.directions, axis=-1).max() / wedge**3)
    assert max(ratios) < 2
    assert np.ptp(ratios) < 0.1 * max(ratios)  # the difference is of third order


# ---- Errors ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "arguments", "words"),
    [
        (spinning, {"elevations_rad": [np.nan], "columns": 4, "period_s": 0.1}, "elevations_rad"),
        (spinning, {"elevations_rad": [10.0], "columns": 4, "period_s": 0.1}, "an elevation in radians"),
        (spinning, {"elevations_rad": 0.1, "columns": 4, "period_s": 0.1}, "shape"),
        (spinning, {"elevations_rad": [], "columns": 4, "period_s": 0.1}, "shape"),
        (spinning, {"elevations_rad": "up", "columns": 4, "period_s": 0.1}, "to be numbers"),
        (spinning, {"elevations_rad": [0.1], "columns": 0, "period_s": 0.1}, "columns"),
        (spinning, {"elevations_rad": [0.1], "columns": 4, "period_s": 0.0}, "period_s"),
        (spinning, {"elevations_rad": [0.1], "columns": 1 << 40, "period_s": 0.1}, "at most 100000000 rays"),
        (
            spinning,
            {"elevations_rad": [0.1], "columns": 4, "period_s": 0.1, "azimuth_offsets_rad": [0, 1]},
            r"shape \(1,\)",
        ),
        (spinning, {"elevations_rad": [0.1], "columns": 4, "period_s": 0.1, "firing_times_s": 1.0}, "firing_times_s"),
        (
            spinning,
            {"elevations_rad": [0.1], "columns": 4, "period_s": 0.1, "origin_offset_m": (0, 0, 15.8)},
            "in metres",
        ),
        (spinning, {"elevations_rad": [0.1], "columns": 4, "period_s": 0.1, "origin_offset_m": 0.1}, r"\(3,\)"),
        (lissajous, {"fast_hz": 1e3, "slow_hz": 0, "amplitudes_rad": (0.1, 0.1), "samples": 4}, "slow_hz"),
        (lissajous, {"fast_hz": 1e3, "slow_hz": 9.0, "amplitudes_rad": (2.0, 0.1), "samples": 4}, "right angle"),
        (lissajous, {"fast_hz": 1e3, "slow_hz": 9.0, "amplitudes_rad": 0.1, "samples": 4}, "two numbers"),
        (lissajous, {"fast_hz": 1e3, "slow_hz": 9.0, "amplitudes_rad": (0.1, 0.1), "samples": (4, 4, 4)}, "rows and"),
        (lissajous, {"fast_hz": 1e3, "slow_hz": 9.0, "amplitudes_rad": (0.1, 0.1), "samples": (1 << 20,) * 2}, "rays"),
        (risley, {"deflections_rad": (1.0, 1.0), "rates_hz": (1, 2), "samples": 4, "duration_s": 1.0}, "right angle"),
        (risley, {"deflections_rad": (0.1, 0.1), "rates_hz": (1, np.inf), "samples": 4, "duration_s": 1.0}, "rates_hz"),
        (
            risley_prisms,
            {"wedges_rad": (0.8, 0.1), "indices": (1.5, 1.5), "rates_hz": (1, 2), "samples": 4, "duration_s": 1.0},
            "total reflection",
        ),
    ],
)
def test_arguments_out_of_bounds_are_refused_in_one_sentence(make: Any, arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make(**arguments)
