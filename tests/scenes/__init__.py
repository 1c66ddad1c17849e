# SPDX-License-Identifier: Apache-2.0
"""Made scenes for the tests, one module for each subject: clouds of which it is known what each point belongs to.

`rays` casts rays at planes, boxes and balls; `surfaces` samples surfaces that no sensor looked at. The others build on
these two: `images` of a depth camera, `tables`, `bodies`, `rooms`, `streets`, `land`. `graphs` makes adjacency graphs.
Lengths are metres and angles radians unless a docstring says otherwise. The same arguments give the same points.
"""
