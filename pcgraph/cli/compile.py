# SPDX-License-Identifier: Apache-2.0
"""The command ``pcgraph compile``."""

from __future__ import annotations

import logging
import time

import typer


def compile_command() -> None:
    """Compile what the first segmentation of an installation would compile, so that it need not wait.

    What is compiled already is left as it is.
    """
    from pcgraph.all_kernels import compile_kernels

    logging.getLogger("pcgraph").setLevel(logging.ERROR)  # whoever asks for it knows what is waited for
    start = time.perf_counter()
    compile_kernels()
    typer.echo(f"{'seconds':<12} {time.perf_counter() - start:.2f}")
