# SPDX-License-Identifier: Apache-2.0
"""Laws of the engine of campaigns."""

from __future__ import annotations

import os
import threading
from pathlib import Path
from typing import Any

import pytest

from rangesim.campaign import ItemStore, Outcome, Workers, run_items
from rangesim.errors import EnvironmentProblem, FileFormatError


def answer(question: Any) -> Any:
    """What an item may do: give bytes, give none, raise, or take its worker along."""
    if question == "no bytes":
        return 3
    if question == "raise":
        raise RuntimeError("no luck")
    if question == "die":
        os.abort()
    return repr(question).encode()


ITEMS = {
    "a": 1,
    "b": {"deep": [2]},
    "none": "no bytes",
    "unlucky": "raise",
    "deadly": "die",
    **{f"n{i}": i for i in range(9)},
}


def test_good_items_are_stored_and_bad_ones_quarantined(tmp_path: Path) -> None:
    done: list[str] = []
    store = ItemStore(tmp_path / "c", {"x": 1})
    outcome = run_items(answer, ITEMS, store, Workers(count=1), on_done=done.append)
    bad = {"none", "unlucky", "deadly"}
    assert (outcome.computed, outcome.kept, outcome.exit_status) == (len(ITEMS) - 3, 0, 1)
    assert set(done) == set(store.keys()) == set(ITEMS) - bad
    assert all(store.read(key) == answer(ITEMS[key]) for key in done)
    assert {item.key: item.argument for item in store.quarantined} == {key: ITEMS[key] for key in bad}
    errors = {item.key: item.error for item in store.quarantined}
    assert errors["unlucky"] == "RuntimeError: no luck"
    assert errors["none"] == "expected bytes of the function, got int"
    assert "died" in errors["deadly"]
    again = run_items(answer, ITEMS, store, Workers(count=1))  # nothing is left, so no worker starts
    assert again == Outcome(0, len(ITEMS) - 3, outcome.quarantined)


def test_a_changed_result_is_refused(tmp_path: Path) -> None:
    store = ItemStore(tmp_path)
    store.write("a", b"result")
    assert store.read("a") == b"result"
    (file,) = tmp_path.glob("items/*/a.item")
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(FileFormatError, match="checksum"):
        store.read("a")
    store.discard("a")
    assert "a" not in store


@pytest.mark.parametrize("key", ["", "../a", "A", "a/b", "a b", ".a", "x" * 201, "é", "a\n", 3])
def test_strange_keys_are_refused(tmp_path: Path, key: Any) -> None:
    with pytest.raises(ValueError, match="expected a key"):
        run_items(answer, {key: 1}, ItemStore(tmp_path))


def test_what_cannot_be_sent_is_refused(tmp_path: Path) -> None:
    lock = threading.Lock()
    with pytest.raises(ValueError, match="cannot be sent"):
        run_items(lambda x: repr(lock).encode(), {"a": 1}, ItemStore(tmp_path))


def test_one_run_at_a_time_has_a_directory(tmp_path: Path) -> None:
    store = ItemStore(tmp_path)
    with store.claimed(), pytest.raises(EnvironmentProblem, match="another process"):
        run_items(answer, {"a": 1}, ItemStore(tmp_path))
