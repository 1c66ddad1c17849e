# SPDX-License-Identifier: Apache-2.0
"""Strategies partition all light paths: each path belongs to one of them."""

from __future__ import annotations

import numpy as np

from rangesim.environment.backend import select_variant
from rangesim.light_transport.strategies import owner


def test_each_path_belongs_to_exactly_one_strategy() -> None:
    select_variant()
    import mitsuba as mi

    has_vertex, chain = (x.ravel() for x in np.meshgrid([False, True], np.arange(4, dtype=np.uint32)))
    masks = owner(mi.Bool(has_vertex), mi.UInt32(chain))
    count = np.sum([mask.numpy() for mask in masks], axis=0)
    assert (count == 1).all()
    assert (masks.glint.numpy() == ~has_vertex).all()
    assert (masks.next_event.numpy() == (has_vertex & (chain == 0))).all()
