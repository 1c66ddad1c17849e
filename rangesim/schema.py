# SPDX-License-Identifier: Apache-2.0
"""Files of settings and arrays that this package reads back."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rangesim.errors import FileFormatError


def read_sidecar(path: Path, kind: str) -> dict[str, Any]:
    """Contents of a JSON file that states `format` as `kind`; FileFormatError if it is missing or another."""
    if not path.is_file():
        raise FileFormatError(f"{path.parent} is no {kind} directory: it has no {path.name}.")
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise FileFormatError(f"{path} is no valid JSON: {error}.") from error
    if not isinstance(info, dict) or info.get("format") != kind:
        raise FileFormatError(f"{path} is no {kind} file.")
    return info


def write_json(path: Path, data: dict[str, Any]) -> None:
    """Write plain data, indented."""
    path.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
