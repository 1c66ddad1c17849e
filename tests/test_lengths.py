# SPDX-License-Identifier: Apache-2.0
"""Lengths with a unit, in settings of any kind."""

from __future__ import annotations

import pytest

from rangesim.experiment import experiment_from_dict, experiment_to_dict
from rangesim.rig import Beam
from rangesim.settings.config import from_dict
from rangesim.settings.lengths import EXPONENTS, metres


@pytest.mark.parametrize("unit", EXPONENTS)
@pytest.mark.parametrize("number", ["1", "2.5", ".1", "1.1e2", "-3"])
def test_a_length_is_the_float_nearest_to_its_digits(number: str, unit: str) -> None:
    assert metres(f"{number}{unit}") == metres(f" {number} {unit} ") == float(f"{float(number)!r}e{EXPONENTS[unit]}")
    assert metres(number) == float(number)


@pytest.mark.parametrize(
    "text", ["", "mm", "2 feet", "2mm 3", "2" * 1000 + "x", "two mm", "nanmm", "inf m", "1e99999 m", "٣ mm", "2MM"]
)
def test_what_is_no_length_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="expected width to be a length such as '2mm'"):
        metres(text, "width")


def test_any_length_of_an_experiment_takes_a_unit() -> None:
    table = {"sensor": "amcw", "baseline_m": "3 cm", "wavelength_m": "845nm"}
    experiment = experiment_from_dict(
        {"scene": "part.ply", "unit_m": "1mm", "tolerance_m": "2mm", "instrument": [table]}
    )
    (one,) = experiment.instruments
    assert (experiment.unit_m, experiment.tolerance_m) == (0.001, 0.002)
    assert (one.baseline_m, one.wavelength_m) == (0.03, 845e-9)
    assert experiment_from_dict(experiment_to_dict(experiment)) == experiment
    with pytest.raises(ValueError, match=r"instrument\[0\]: .*baseline_m to be a length"):
        experiment_from_dict({"scene": "part.ply", "instrument": [{**table, "baseline_m": "3 inches"}]})
    assert from_dict(Beam, {"offset_m": ["5mm", 0.0]}).offset_m == (0.005, 0.0)
