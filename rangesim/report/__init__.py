# SPDX-License-Identifier: Apache-2.0
"""The HTML report of an experiment: one file that opens offline."""

from rangesim.report.build import render_report, write_report

__all__ = ["render_report", "write_report"]
