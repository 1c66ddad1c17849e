# SPDX-License-Identifier: Apache-2.0
"""Campaigns: many independent items of work, each a pure function of its settings, on Dask (docs/campaigns.md).

Python loads each name when it is first used. Running items needs the extra `campaign` (Dask); reading a store does not.

Examples
--------
>>> from rangesim.campaign import ItemStore, Workers, run_items
>>> store = ItemStore("out/squares")  # doctest: +SKIP
>>> outcome = run_items(function, {"a": 1, "b": 2}, store, Workers(count=2))  # doctest: +SKIP
>>> store.read("a")  # doctest: +SKIP
"""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from rangesim.campaign.engine import Outcome as Outcome
    from rangesim.campaign.engine import run_items as run_items
    from rangesim.campaign.item_store import ItemStore as ItemStore
    from rangesim.campaign.item_store import QuarantinedItem as QuarantinedItem
    from rangesim.campaign.workers import Workers as Workers
else:
    import lazy_loader

    __getattr__, __dir__, __all__ = lazy_loader.attach(
        __name__,
        submod_attrs={
            "engine": ["Outcome", "run_items"],
            "item_store": ["ItemStore", "QuarantinedItem"],
            "workers": ["Workers"],
        },
    )
