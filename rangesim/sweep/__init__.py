# SPDX-License-Identifier: Apache-2.0
"""Sweeps: sensors at all combinations of settings, with as few light-transport passes as can be (docs/sweeps.md).

Python loads each name when it is first used.

Examples
--------
>>> from rangesim.sweep import Sweep, carry_out, load_sweep, plan, write_sweep
>>> sweep = load_sweep("examples/sweep_distance.toml")  # doctest: +SKIP
>>> print(plan(sweep))  # doctest: +SKIP
>>> write_sweep(carry_out(sweep), "out/distance")  # doctest: +SKIP
"""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from rangesim.sweep.confidence_intervals import Interval as Interval
    from rangesim.sweep.passes import Plan as Plan
    from rangesim.sweep.passes import plan as plan
    from rangesim.sweep.sweep_directory import write_sweep as write_sweep
    from rangesim.sweep.sweep_result import SweepResult as SweepResult
    from rangesim.sweep.sweep_run import carry_out as carry_out
    from rangesim.sweep.sweep_settings import Sweep as Sweep
    from rangesim.sweep.sweep_settings import load_sweep as load_sweep
    from rangesim.sweep.sweep_settings import sweep_from_dict as sweep_from_dict
else:
    import lazy_loader

    __getattr__, __dir__, __all__ = lazy_loader.attach(
        __name__,
        submod_attrs={
            "confidence_intervals": ["Interval"],
            "passes": ["Plan", "plan"],
            "sweep_directory": ["write_sweep"],
            "sweep_result": ["SweepResult"],
            "sweep_run": ["carry_out"],
            "sweep_settings": ["Sweep", "load_sweep", "sweep_from_dict"],
        },
    )
