# SPDX-License-Identifier: Apache-2.0
"""Python files of users as modules of this package, so that what they define can be pickled."""

import sys

from pcgraph.plumbing.python_files import FileImporter

__path__: list[str] = []  # makes a package of this module, for the modules of the files
sys.meta_path.append(FileImporter(__name__.partition(".")[0]))
