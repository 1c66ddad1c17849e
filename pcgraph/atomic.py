# SPDX-License-Identifier: Apache-2.0
"""Files that appear whole or not at all."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from pcgraph.errors import CloudWriteError


def write_bytes(path: Path, content: bytes) -> None:
    """Nothing; afterwards `path` holds `content`, and no reader has ever seen a part of it.

    Raises
    ------
    CloudWriteError
        The folder does not exist or does not let us write.
    """
    temporary: str | None = None
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
        with os.fdopen(handle, "wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(temporary, 0o666 & ~mask)  # mkstemp gives 0600, which is not what a user expects of a result
        os.replace(temporary, path)
    except OSError as error:
        if temporary is not None and os.path.exists(temporary):
            os.unlink(temporary)
        raise CloudWriteError(f"cannot write {path}: {error.strerror or error}; choose another path") from None
