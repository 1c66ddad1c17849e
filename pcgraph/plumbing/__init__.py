# SPDX-License-Identifier: Apache-2.0
"""Plumbing that pcgraph and rangesim share: whole files, interrupts, Python files of the user, short `repr`s.

It knows nothing of points, and imports the standard library and NumPy alone.
"""
