# SPDX-License-Identifier: Apache-2.0
"""Campaigns whose processes die, hang or leak: they end with the same bytes, and what fails is said."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import campaign
import pytest

from rangesim.campaign import ItemStore, Workers, engine, run_items

pytestmark = pytest.mark.validation
ROOT = Path(__file__).resolve().parents[1]
kept: list[bytes] = []


def faulty(question: Any) -> bytes:
    """An item that hangs, leaks or takes its worker along."""
    match question:
        case "hang":
            time.sleep(100)
        case "die":
            os.abort()
        case ("die once", file):
            if not Path(file).exists():
                Path(file).touch()
                os.kill(os.getpid(), signal.SIGKILL)
        case ("leak", _):
            kept.append(b"x" * 60_000_000)
        case ("sleep", seconds):
            time.sleep(seconds)
    return repr(question).encode()


def test_an_item_that_kills_its_worker_is_quarantined_and_its_neighbours_are_not(tmp_path: Path) -> None:
    items = {f"n{i}": i for i in range(20)} | {"deadly": "die", "unlucky": ("die once", str(tmp_path / "died"))}
    store = ItemStore(tmp_path / "c")
    outcome = run_items(faulty, items, store, Workers(count=2))
    (deadly,) = outcome.quarantined
    assert (deadly.key, deadly.argument, deadly.attempts) == ("deadly", "die", 3)
    assert "died 3 times while nothing else ran" in deadly.error
    assert all(store.read(key) == repr(items[key]).encode() for key in items if key != "deadly")


def test_an_item_that_hangs_is_quarantined_with_the_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "FIRST_LIMIT_S", 1.0)
    monkeypatch.setattr(engine, "MIN_LIMIT_S", 1.0)
    start = time.monotonic()
    outcome = run_items(faulty, {"h": "hang", **{f"n{i}": i for i in range(5)}}, ItemStore(tmp_path), Workers(count=1))
    (hanging,) = outcome.quarantined
    assert (hanging.key, hanging.error) == ("h", "did not end within 1 s, its time limit")
    assert "in faulty" in hanging.traceback
    assert (outcome.computed, time.monotonic() - start < 60) == (5, True)


def test_a_worker_that_leaks_is_replaced(tmp_path: Path) -> None:
    items = {f"n{i:03}": ("leak", i) for i in range(120)}
    outcome = run_items(faulty, items, ItemStore(tmp_path), Workers(count=1))
    assert (outcome.computed, outcome.exit_status) == (120, 0)
    assert outcome.replaced >= 1
    assert outcome.rss < 3e9  # 120 items would take 7 GB


def test_a_run_that_is_killed_again_and_again_ends_with_the_same_bytes() -> None:
    """On an embedded cluster, and by the address of a second scheduler process, which is killed, too."""
    found = campaign.kills(campaign.QUICK)
    assert (found["kills"], found["differing_bytes"], found["quarantined"], found["litter"]) == (4, 0, 0, 0)


SCRIPT = """
import os, sys, time
from pathlib import Path
def work(x):
    time.sleep(0.1)
    return repr(x).encode() * 1000
if __name__ == "__main__":
    from pcgraph.plumbing.interrupts import end_on_signals, run
    end_on_signals("campaign", writes=True)
    from rangesim.campaign import ItemStore, Workers, run_items
    run(lambda: print(run_items(work, {f"n{i}": i for i in range(60)}, ItemStore(sys.argv[1]), Workers(count=2))))
"""


def started(folder: Path, script: Path) -> subprocess.Popen[str]:
    script.write_text(SCRIPT)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    line = [sys.executable, str(script), str(folder)]
    return subprocess.Popen(line, env=environment, stdout=-1, stderr=-1, text=True, start_new_session=True)


def wait_for_items(folder: Path, count: int) -> None:
    while len(list(folder.glob("items/*/*.item"))) < count:
        time.sleep(0.02)


def living(session: int) -> list[int]:
    """Processes of a session that have not ended."""
    found = subprocess.run(["ps", "-o", "pid=,stat=", "-s", str(session)], capture_output=True, text=True, check=False)
    return [int(line.split()[0]) for line in found.stdout.splitlines() if "Z" not in line.split()[1]]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_driver_that_is_ended_leaves_no_process_and_the_next_run_goes_on(
    tmp_path: Path, number: signal.Signals
) -> None:
    out = tmp_path / "c"
    driver = started(out, tmp_path / "script.py")
    wait_for_items(out, 10)
    if number == signal.SIGINT:
        os.killpg(driver.pid, number)  # as Ctrl-C does
    else:
        driver.send_signal(number)
    _, said = driver.communicate(timeout=30)
    deadline = time.monotonic() + 10
    while living(driver.pid) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert living(driver.pid) == []
    if number != signal.SIGKILL:
        assert said.count("\n") == 1, said
        line = said.rstrip()
        assert line.startswith("campaign: interrupted; ")
        assert line.endswith(" of 60 items are done and kept; run the same again to go on.")
        assert driver.returncode == 128 + number
    assert not list(out.rglob("*.part")) or number == signal.SIGKILL
    stored = len(list(out.glob("items/*/*.item")))
    again = started(out, tmp_path / "script.py")
    told, said = again.communicate(timeout=60)
    assert (told, said) == (f"{60 - stored} items computed, {stored} kept, 0 failed\n", "")
    assert all(ItemStore(out).read(f"n{i}") == repr(i).encode() * 1000 for i in range(60))
    assert not list(out.rglob("*.part"))
