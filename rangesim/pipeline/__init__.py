# SPDX-License-Identifier: Apache-2.0
"""Carries out experiments and scans, and estimates their cost before the work starts.

`experiment_run.py` carries out an experiment: `carry_out` returns the result, and `run` writes it as well.
`scan_run.py` does the same for a scan. `shared_passes.py` decides which instruments share a light-transport pass. A
sweep over settings would be a further module here that calls `carry_out` for each experiment.
"""
