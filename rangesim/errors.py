# SPDX-License-Identifier: Apache-2.0
"""Errors that are about files and the environment; bad arguments are a plain ValueError.

The message of each is one clear sentence that names what was found, what is needed and the fix: the
command line prints it as it stands.
"""

from __future__ import annotations

__all__ = ["EnvironmentProblem", "FileFormatError", "RangesimError"]


class RangesimError(Exception):
    """Base of every error that rangesim raises itself, except ValueError for bad arguments."""


class FileFormatError(RangesimError):
    """A file is missing, broken, or does not hold what its place asks for."""


class EnvironmentProblem(RangesimError):
    """This machine lacks something that rangesim needs, such as a new enough LLVM."""
