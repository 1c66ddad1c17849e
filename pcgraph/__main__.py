# SPDX-License-Identifier: Apache-2.0
"""``python -m pcgraph``, and the script ``pcgraph``: handlers of signals come before all other imports."""

from __future__ import annotations


def main() -> None:
    """Run the command line."""
    from pcgraph.plumbing.interrupts import end_on_signals, run

    end_on_signals("pcgraph", writes=True)
    from pcgraph.cli import main as command

    run(command)


if __name__ == "__main__":
    main()
