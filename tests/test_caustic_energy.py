# SPDX-License-Identifier: Apache-2.0
"""The projector's light beyond glass and mirrors lands in full, and where an independent forward trace puts it."""

from __future__ import annotations

from pathlib import Path

import caustic_energy
import pytest

REFERENCE = caustic_energy.load()


@pytest.mark.parametrize("name", REFERENCE)
def test_all_light_of_delta_chains_lands_on_the_right_wall(name: str, tmp_path: Path) -> None:
    expected = REFERENCE[name]
    scene = caustic_energy.scene_of(name, tmp_path)
    ours, _ = caustic_energy.traced_flux(scene, caustic_energy.rig_of())
    assert sum(ours.values()) == pytest.approx(expected.total, rel=3e-3)
    for wall, flux in ours.items():
        # Some 50 000 photons land; whether a face reflects one is drawn, which makes up to 0.16 % of noise
        assert flux == pytest.approx(expected.receivers[wall], abs=6e-3 * expected.total)


def test_the_references_are_certain_to_a_thousandth() -> None:
    """Their scenes are all there, and their numbers of interactions add up to their walls."""
    assert set(REFERENCE) == set(caustic_energy.GLASSWARE)
    for flux in REFERENCE.values():
        assert flux.standard_error < 1e-3
        assert flux.receiver_error < 1e-3
        assert sum(flux.receivers.values()) == pytest.approx(flux.total, abs=1e-6)
        assert sum(flux.interactions) == pytest.approx(flux.total, abs=1e-6)
