# SPDX-License-Identifier: Apache-2.0
"""PDF of a page, printed by a browser that is installed on this machine."""

from __future__ import annotations

import os
import subprocess
import tempfile
from pathlib import Path

from rangesim.errors import EnvironmentProblem

TIMEOUT_S = 120
"""Seconds within which a browser prints a page: it takes 1 to 3 on two cores, and one that takes longer has stopped."""


def pdf_of(page: str, browser: str) -> bytes:
    """PDF of an HTML page.

    Parameters
    ----------
    page : the HTML page. Its style sheet chooses the size of the paper.
    browser : path or name of Chromium or of a browser that is built on it.

    Raises
    ------
    EnvironmentProblem
        The browser does not start, or prints nothing.
    """
    with tempfile.TemporaryDirectory(prefix="rangesim-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        (folder / "page.html").write_text(page, encoding="utf-8")
        command = [browser, "--headless", "--disable-gpu", "--no-first-run", f"--user-data-dir={folder / 'profile'}"]
        command += ["--no-pdf-header-footer", f"--print-to-pdf={folder / 'page.pdf'}"]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            command.append("--no-sandbox")  # with the sandbox, Chromium refuses to run as root
        command.append((folder / "page.html").as_uri())
        try:
            run = subprocess.run(command, capture_output=True, timeout=TIMEOUT_S)
        except OSError as problem:
            raise EnvironmentProblem(f"cannot start the browser {browser}: {problem.strerror or problem}") from problem
        except subprocess.TimeoutExpired:
            raise EnvironmentProblem(f"the browser {browser} printed nothing within {TIMEOUT_S} s") from None
        printed = folder / "page.pdf"
        content = printed.read_bytes() if printed.is_file() else b""
    if not (content.startswith(b"%PDF-") and content.rstrip().endswith(b"%%EOF")):
        said = run.stderr.decode(errors="replace").strip().splitlines()
        why = f": {said[-1]}" if said else f" and ended with status {run.returncode}"
        raise EnvironmentProblem(f"the browser {browser} printed no PDF{why}")
    return content
