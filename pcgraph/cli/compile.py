# SPDX-License-Identifier: Apache-2.0
"""The command ``pcgraph compile``."""

from __future__ import annotations

import logging
import time

import typer


def compile_command() -> None:
    """Compile all kernels now, so that the first segmentation of an installation does not wait for them.

    Kernels that are compiled already stay as they are.
    """
    from pcgraph.all_kernels import compile_kernels

    logging.getLogger("pcgraph").setLevel(logging.ERROR)  # the message about compiling is no news to this user
    start = time.perf_counter()
    compile_kernels()
    typer.echo(f"{'seconds':<12} {time.perf_counter() - start:.2f}")
