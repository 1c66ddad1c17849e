# SPDX-License-Identifier: Apache-2.0
"""An experiment: what to measure and with what, its run, its cost, its results."""

from rangesim.experiment.experiment import (
    Experiment,
    experiment_from_dict,
    experiment_to_dict,
    load_experiment,
)

__all__ = [
    "Experiment",
    "experiment_from_dict",
    "experiment_to_dict",
    "load_experiment",
]
