# SPDX-License-Identifier: Apache-2.0
"""Content-Security-Policy of pages that run one script of ours and send no request."""

from __future__ import annotations

import base64
import hashlib


def content_policy(style: str, script: str) -> str:
    """Policy of a page that allows this style sheet, this script and pictures in the page itself.

    Everything else is refused: requests, frames, forms, markup from strings, and styles or handlers in attributes.
    """
    return "; ".join(
        (
            "default-src 'none'",
            "img-src data:",
            f"style-src '{_hash(style)}'",
            f"script-src '{_hash(script)}'",
            "base-uri 'none'",
            "form-action 'none'",
            "require-trusted-types-for 'script'",
            "trusted-types 'none'",
        )
    )


def _hash(text: str) -> str:
    """Hash of a script or style sheet as the policy names it."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode("ascii")
