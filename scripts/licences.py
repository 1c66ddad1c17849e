# SPDX-License-Identifier: Apache-2.0
"""Print the licence of every package that an install of rangesim brings along; exit with 1 if one is not permissive.

    python scripts/licences.py

It follows the requirements of rangesim through the installed packages and reads what their metadata state, in this
order: a licence expression, the classifiers, the licence field. What the metadata leave open is in `KNOWN`.
"""

from __future__ import annotations

import re
import sys
from importlib.metadata import Distribution, PackageNotFoundError, distribution

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

PERMISSIVE = re.compile(
    r"\b(MIT|MIT-0|MIT-CMU|BSD|0BSD|Apache|ISC|HPND|PSF|Python Software Foundation|Python-2\.0|Zlib|Unlicense"
    r"|Public Domain|CC0|BSL-1\.0)\b|BSD-\d-Clause|PSF-2\.0|Apache-2\.0",
    re.IGNORECASE,
)
BY_FILE = re.compile(r"\bMPL\b|MPL-2\.0|Mozilla Public License 2\.0", re.IGNORECASE)
"""Copyleft of single files, which binds nobody who only uses the package."""
KNOWN = {
    "openexr": "BSD-3-Clause",  # LICENSE.md beside its metadata
}
"""Licences of packages whose metadata name none."""


def main() -> int:
    """0 if every licence is permissive."""
    found = {name: licence(package) for name, package in sorted(brought_along("rangesim").items())}
    print("| package | licence |\n| --- | --- |")
    for name, text in found.items():
        print(f"| {name} | {text} |")
    others = [f"{name} ({text})" for name, text in found.items() if not is_permissive(text)]
    if others:
        print(f"error: expected permissive licences, got {', '.join(others)}.", file=sys.stderr)
    return 1 if others else 0


def brought_along(root: str) -> dict[str, Distribution]:
    """Canonical name -> package, of all that `root` requires without extras, and they in turn, on this platform."""
    found: dict[str, Distribution] = {}
    waiting = requirements(distribution(root))
    while waiting:
        name = canonicalize_name(waiting.pop().name)
        if name in found:
            continue
        try:
            found[name] = distribution(name)
        except PackageNotFoundError:
            raise SystemExit(f"error: {name} is required but not installed; set up the environment first.") from None
        waiting += requirements(found[name])
    return found


def requirements(package: Distribution) -> list[Requirement]:
    """What a package requires here, without extras."""
    stated = [Requirement(text) for text in package.requires or ()]
    return [r for r in stated if r.marker is None or r.marker.evaluate({"extra": ""})]


def licence(package: Distribution) -> str:
    """What the package says of its licence, in a few words."""
    data = package.metadata
    expression = data.get("License-Expression")
    if expression:
        return str(expression)
    classifiers = [c.split(" :: ")[-1] for c in data.get_all("Classifier") or () if c.startswith("License ::")]
    named = [c for c in classifiers if c != "OSI Approved"]
    if named:
        return ", ".join(named)
    field = (data.get("License") or "").strip()
    if field:
        return field.splitlines()[0][:60]
    return KNOWN.get(canonicalize_name(data["Name"]), "not stated")


def is_permissive(text: str) -> bool:
    """Whether a licence asks for no more than its notice: every part that AND joins, one of those that OR joins."""
    parts = re.split(r"\s+AND\s+|,\s*", text)
    return all(any(PERMISSIVE.search(p) or BY_FILE.search(p) for p in re.split(r"\s+OR\s+", part)) for part in parts)


if __name__ == "__main__":
    sys.exit(main())
