# SPDX-License-Identifier: Apache-2.0
"""Makes Python files of users (`FILE.py:NAME`) importable as modules of this package.

A class is pickled as the name of its module, so another process can unpickle the sensors that such files define.
"""

import sys

from pcgraph.plumbing.python_files import FileImporter

__path__: list[str] = []  # a module with a path is a package; the users' files are its modules
sys.meta_path.append(FileImporter(__name__.partition(".")[0]))
