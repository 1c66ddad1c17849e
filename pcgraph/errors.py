# SPDX-License-Identifier: Apache-2.0
"""The exceptions of pcgraph that are not a plain ``ValueError``: those about files."""

from __future__ import annotations


class PcgraphError(Exception):
    """Base of every file error of pcgraph; the message is one sentence fit for a user."""


class CloudReadError(PcgraphError):
    """A file cannot be read as a point cloud: missing, truncated, or its header does not fit its data."""


class CloudWriteError(PcgraphError):
    """A result cannot be written: no such folder, no permission, or an unknown extension."""
