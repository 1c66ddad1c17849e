# SPDX-License-Identifier: Apache-2.0
"""``python -m pcgraph``."""

from __future__ import annotations

from pcgraph.cli import main

if __name__ == "__main__":
    main()
