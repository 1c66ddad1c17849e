# SPDX-License-Identifier: Apache-2.0
"""The directory of a sweep: the passes, the tables and the page.

DIR/sweep.html          the page
    rows.csv, .parquet  a row for each point, sensor, seed and surface
    summary.csv         means over the seeds with 95 % confidence intervals
    sweep.json          the settings, the exposures that were fixed, versions
    campaign.json, items/, quarantine/   finished passes, see `rangesim.campaign`
"""

from __future__ import annotations

import json
from pathlib import Path

from pcgraph.plumbing.plain_files import write_file
from rangesim import __version__
from rangesim.errors import FileFormatError
from rangesim.settings.config import to_dict
from rangesim.sweep.sweep_result import SweepResult
from rangesim.sweep.sweep_settings import sweep_to_dict
from rangesim.sweep.sweep_tables import csv_bytes, parquet_bytes, rows_table, summary_table


def write_sweep(result: SweepResult, out: str | Path) -> Path:
    """Write the tables and the page of a sweep, each whole or not at all, and return the path of the page.

    Raises
    ------
    FileFormatError
        A file cannot be written.
    EnvironmentProblem
        pyarrow is not installed.
    """
    from rangesim.report.sweep_page import render_sweep_page

    folder = Path(out)
    settings = {
        "format": "rangesim-sweep",
        "format_version": 1,
        "sweep": sweep_to_dict(result.sweep),
        "working_distance_m": result.plan.working_distance_m,
        "exposures": {name: to_dict(one) for name, one in result.exposures.items()},
        "passes": len(result.plan.passes),
        "failed": {str(number): error for number, error in (result.failed or {}).items()},
        "rangesim": __version__,
    }
    rows = rows_table(result)
    contents = {
        "rows.csv": csv_bytes(rows),
        "rows.parquet": parquet_bytes(rows),
        "summary.csv": csv_bytes(summary_table(result)),
        "sweep.json": json.dumps(settings, indent=1).encode(),
        "sweep.html": render_sweep_page(result).encode(),
    }
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in contents.items():
        write_file(folder / name, content, FileFormatError)
    return folder / "sweep.html"
