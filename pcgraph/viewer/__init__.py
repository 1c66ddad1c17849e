# SPDX-License-Identifier: Apache-2.0
"""The viewer: one HTML file that shows a cloud and its segmentation. Names load on first use. See docs/viewer.md."""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from pcgraph.viewer.cloud_data import Categories as Categories
    from pcgraph.viewer.cloud_data import Shown as Shown
    from pcgraph.viewer.page import view_page as view_page
    from pcgraph.viewer.page import views_page as views_page
    from pcgraph.viewer.page import write_view as write_view
    from pcgraph.viewer.tree_data import ShownTree as ShownTree
else:
    import lazy_loader

    __getattr__, __dir__, __all__ = lazy_loader.attach(
        __name__,
        submod_attrs={
            "cloud_data": ["Categories", "Shown"],
            "page": ["view_page", "views_page", "write_view"],
            "tree_data": ["ShownTree"],
        },
    )
