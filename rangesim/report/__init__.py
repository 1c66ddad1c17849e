# SPDX-License-Identifier: Apache-2.0
"""Reports: HTML pages that open without a network, and tables in Markdown."""

from rangesim.report.experiment_page import render_report, write_report
from rangesim.report.tables import errors_markdown, failures_markdown

__all__ = ["errors_markdown", "failures_markdown", "render_report", "write_report"]
