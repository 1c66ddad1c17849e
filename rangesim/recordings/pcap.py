# SPDX-License-Identifier: Apache-2.0
"""UDP datagrams of a recording of network traffic (pcap), one after the other, in little memory."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from pcgraph.errors import CloudReadError
from pcgraph.io import pcap
from pcgraph.io.pcap import Datagram
from pcgraph.plumbing.plain_files import check_file
from rangesim.errors import FileFormatError


def datagrams(path: str | Path) -> Iterator[Datagram]:
    """Iterator over the whole UDP datagrams of a pcap file, in the order of the file; fragments are put together.

    A file that ends within a record ends there: so does a recording that was interrupted. Datagrams that the recording
    cut short or that lost a fragment are left out.

    Raises
    ------
    FileFormatError
        The file cannot be read or is no pcap file; it is raised at the first step of the iteration.
    """
    check_file(path, FileFormatError)
    try:
        with Path(path).open("rb") as file:
            yield from pcap.datagrams(file)
    except CloudReadError as error:
        raise FileFormatError(f"{path}: {error}.") from error
    except OSError as error:
        raise FileFormatError(f"cannot read {path}: {error.strerror or error}.") from error
