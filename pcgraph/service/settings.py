# SPDX-License-Identifier: Apache-2.0
"""Settings of the service: its address, its token and its limits."""

from __future__ import annotations

import ipaddress
import math
import os
from dataclasses import dataclass, field, fields
from pathlib import Path


def n_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True)
class ServiceSettings:
    """Address, token and limits of the service. The defaults are chosen by eye; none was varied.

    Attributes
    ----------
    host : str
        Address to listen at. At a loopback address, other computers cannot reach the service.
    port : int
    token : str, or None
        Secret that clients send as ``Authorization: Bearer TOKEN``. None: no client needs one.
    workers : int
        Processes that segment clouds. One more answers questions about finished segmentations.
    max_upload_mb : float, megabytes (10**6 bytes)
        Largest size of the body of a request.
    max_points : int
        Largest count of points in a cloud.
    max_seconds : float
        Time that a worker may take for a segmentation or for an answer; then the worker is killed.
    max_memory_gb : float, gigabytes (10**9 bytes)
        Largest private memory of a worker process (RLIMIT_DATA, which Linux enforces and macOS does not).
    max_queued : int
        Largest count of segmentations that wait for a worker; the same for answers.
    max_uploads : int
        Largest count of uploads that are received at the same time.
    max_upload_seconds : float
        Time in which an upload must have arrived.
    max_stored_gb : float, gigabytes (10**9 bytes)
        Largest size of all finished segmentations on the disk; beyond it, those unused for longest are removed.
    max_age_minutes : float
        Time after its last use at which a segmentation is removed.
    folder : Path, or None
        Folder in which the private folder of the service is made. Default: the system's folder for temporary files.
    """

    host: str = "127.0.0.1"
    port: int = 8000
    token: str | None = field(default=None, repr=False)
    workers: int = field(default_factory=lambda: max(2, n_cores() // 2))
    max_upload_mb: float = 512.0
    max_points: int = 20_000_000
    max_seconds: float = 60.0
    max_memory_gb: float = 4.0
    max_queued: int = 64
    max_uploads: int = 64
    max_upload_seconds: float = 120.0
    max_stored_gb: float = 4.0
    max_age_minutes: float = 60.0
    folder: Path | None = None

    def __post_init__(self) -> None:
        for one in fields(self):
            value = getattr(self, one.name)
            if isinstance(value, int | float) and one.name != "port" and not (0 < value < math.inf):
                raise ValueError(f"expected {one.name} as a finite number above 0, got {value}")
        if not 0 <= self.port < 1 << 16:
            raise ValueError(f"expected port as a whole number from 0 to 65535, got {self.port}")
        if self.folder is not None and not self.folder.is_dir():
            raise ValueError(f"expected folder as a directory that exists, got {self.folder}")
        if self.token is not None and not (self.token.isascii() and self.token.isprintable() and self.token.strip()):
            raise ValueError("expected token as one or more printable ASCII characters")
        if self.token is None and not self.is_loopback:
            raise ValueError(
                f"expected a token, because other computers can reach {self.host}: set PCGRAPH_TOKEN or give --token, "
                "or listen at 127.0.0.1"
            )

    @property
    def is_loopback(self) -> bool:
        """Whether only this computer reaches the host."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    @property
    def threads_per_worker(self) -> int:
        """Threads of a worker process, so that all workers together have one per core."""
        return max(1, n_cores() // self.workers)

    @property
    def max_upload_bytes(self) -> int:
        return int(self.max_upload_mb * 1e6)
