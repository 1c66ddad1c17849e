# SPDX-License-Identifier: Apache-2.0
"""How well a segmentation fits a true one; names load on first use. Definitions and sources: docs/metrics.md.

The names, and where they come from, are listed in `__init__.pyi`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
