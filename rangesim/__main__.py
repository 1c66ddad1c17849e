# SPDX-License-Identifier: Apache-2.0
"""`python -m rangesim`, and the script `rangesim`: signals are taken care of before anything else is imported."""

from __future__ import annotations

import sys


def main() -> None:
    """Run the command line."""
    from pcgraph.plumbing.interrupts import end_on_signals, run

    end_on_signals("rangesim", writes=bool({"run", "scan", "decode", "report", "sweep"} & set(sys.argv[1:3])))
    from rangesim.cli import main as command

    run(command)


if __name__ == "__main__":
    main()
