# SPDX-License-Identifier: Apache-2.0
"""Python files of users as modules of this package, so that their classes can be pickled."""

import sys

from pcgraph.plumbing.python_files import FileImporter

__path__: list[str] = []  # makes this module a package, whose modules are the files
sys.meta_path.append(FileImporter(__name__.partition(".")[0]))
