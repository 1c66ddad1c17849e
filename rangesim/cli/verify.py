# SPDX-License-Identifier: Apache-2.0
"""The command `rangesim verify`, which compares a directory with its manifest."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rangesim.errors import one_line


def verify_command(
    directory: Annotated[
        Path,
        typer.Argument(
            help="A directory that rangesim wrote: a result, a scan, a capture, a decoded capture, or a pattern set."
        ),
    ],
) -> None:
    """Compare the size and SHA-256 of every file in a directory with its manifest.

    Ends with status 1 if a file is missing or was changed. Files that are not rangesim's are listed and do not
    change the status.

    Example:

      rangesim verify out/tabletop
    """
    from rangesim.errors import FileFormatError
    from rangesim.files.atomic_directories import verify_directory
    from rangesim.results.captures import CAPTURE
    from rangesim.results.decoded_captures import DECODED
    from rangesim.results.experiment_results import RESULT
    from rangesim.results.pattern_sets import PATTERNS
    from rangesim.results.scan_results import SCAN

    kinds = (RESULT, SCAN, CAPTURE, DECODED, PATTERNS)
    kind = next((k for k in kinds if (directory / k.sidecar).is_file()), None)
    if kind is None:
        raise FileFormatError(
            f"expected a directory that rangesim wrote, with {', '.join(k.sidecar for k in kinds[:-1])} or "
            f"{kinds[-1].sidecar}; {directory} has none of them."
        )
    found = verify_directory(directory, kind)
    for word, names in (("missing", found.missing), ("changed", found.changed), ("not rangesim's", found.foreign)):
        for name in names:
            typer.echo(f"{word}: {one_line(directory / name)}")
    if found.missing or found.changed:
        raise FileFormatError(
            f"{directory}: of {found.files} files {len(found.missing)} are missing and {len(found.changed)} were "
            "changed."
        )
    typer.echo(f"{one_line(directory)}: all {found.files} files are as they were written.")
