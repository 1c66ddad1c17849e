# SPDX-License-Identifier: Apache-2.0
"""Laws of the engine of campaigns: what is done is kept, what fails is said, and the bytes are always the same."""

from __future__ import annotations

import errno
import itertools
import json
import os
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from pcgraph.plumbing.python_files import run_python_file
from rangesim.campaign import ItemStore, Outcome, Workers, engine, in_worker, item_store, run_items, workers
from rangesim.errors import EnvironmentProblem, FileFormatError, RangesimWarning

THREADS = (*in_worker.THREAD_VARIABLES, "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
counter = itertools.count()


def answer(question: Any) -> Any:
    """What an item may do: give bytes or none, raise, warn, hang, leak, or take its worker along."""
    match question:
        case "no bytes":
            return 3
        case "raise":
            raise RuntimeError("no\nluck")
        case "exit":
            sys.exit(2)
        case "warn":
            warnings.warn("dark", RangesimWarning, stacklevel=1)
        case "hang":
            time.sleep(100)
        case "die":
            os.abort()
        case "threads":
            return json.dumps({name: os.environ.get(name) for name in THREADS}).encode()
        case "count":
            return str(next(counter)).encode()
    return repr(question).encode()


@pytest.fixture(scope="module")
def here() -> Iterator[Workers]:
    """A scheduler and one worker in this process: quick, but no item may end it."""
    from distributed import LocalCluster

    options = {
        "dashboard_address": ":0",
        "scheduler_kwargs": {"dashboard": False},
        "protocol": "tcp",
        "silence_logs": 50,
    }
    with (
        pytest.MonkeyPatch.context() as patch,
        LocalCluster(n_workers=1, threads_per_worker=1, processes=False, **options) as cluster,
    ):
        for name in in_worker.THREAD_VARIABLES:  # else the worker sets them, in this process
            patch.setenv(name, os.environ.get(name, "1"))
        yield Workers(scheduler=cluster.scheduler_address)


# ---- The store -----------------------------------------------------------------------------------------------------


def test_a_changed_result_is_refused(tmp_path: Path) -> None:
    store = ItemStore(tmp_path)
    store.write("a", b"result")
    assert store.read("a") == b"result"
    (file,) = tmp_path.glob("items/*/a.item")
    other = file.with_name("b.item")
    for broken in (file.read_bytes()[:-1], file.read_bytes()[:20], b"", file.read_bytes().replace(b"1\n", b"2\n")):
        file.write_bytes(broken)
        with pytest.raises(FileFormatError, match="checksum"):
            store.read("a")
    store.discard("a")
    assert "a" not in store
    assert not other.exists()
    with pytest.raises(KeyError):
        store.read("a")


def test_an_item_under_the_name_of_another_is_refused(tmp_path: Path) -> None:
    store = ItemStore(tmp_path)
    store.write("a", b"result")
    store.write("b", b"other")
    store._file("a").replace(store._file("b"))
    with pytest.raises(FileFormatError, match="checksum"):
        store.read("b")


@pytest.mark.parametrize("key", ["", "../a", "A", "a/b", "a b", ".a", "x" * 201, "é", "a\n", 3])
def test_strange_keys_are_refused_before_anything_is_written(tmp_path: Path, key: Any) -> None:
    with pytest.raises(ValueError, match="expected a key"):
        run_items(answer, {"a": 0, key: 1}, ItemStore(tmp_path / "c"))
    assert not (tmp_path / "c").exists()


def test_one_directory_holds_one_campaign(tmp_path: Path) -> None:
    ItemStore(tmp_path, {"sensor": {"spp": 8}, "name": "x"}).pin({"function": {"name": "f"}})
    ItemStore(tmp_path, {"name": "x", "sensor": {"spp": 8}}).pin({"function": {"name": "f"}})
    with pytest.raises(ValueError, match=r"settings\.sensor\.spp was 8 and is 4 now"):
        ItemStore(tmp_path, {"sensor": {"spp": 4}, "name": "x"}).pin({"function": {"name": "f"}})
    with pytest.raises(ValueError, match=r"function\.name was 'f' and is 'g' now"):
        ItemStore(tmp_path, {"sensor": {"spp": 8}, "name": "x"}).pin({"function": {"name": "g"}})
    (tmp_path / "campaign.json").write_text("[1]")
    with pytest.raises(FileFormatError, match="no campaign"):
        ItemStore(tmp_path).pin({})


@dataclass(frozen=True)
class Place:
    name: str
    at: Any


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (1, 2),
        (1, 1.5),
        ({"a": 1}, {"a": 2}),
        ([1, 2], [2, 1]),
        (Place("x", 1), Place("x", 2)),
        (np.ones(3), np.zeros(3)),
    ],
)
def test_a_result_of_other_settings_is_refused(tmp_path: Path, one: Any, other: Any) -> None:
    store = ItemStore(tmp_path)
    store.write("a", b"result", one)
    assert store.check_argument("a", one)
    with pytest.raises(ValueError, match="item a, computed from other settings"):
        store.check_argument("a", other)


def test_order_of_keys_makes_no_other_settings(tmp_path: Path) -> None:
    store = ItemStore(tmp_path)
    store.write("a", b"result", {"x": {1, 2, 3}, "y": 1})
    assert store.check_argument("a", {"y": 1, "x": {3, 2, 1}})


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EACCES])
def test_a_disk_that_takes_no_more_ends_the_run_and_the_next_one_goes_on(
    tmp_path: Path, here: Workers, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    items, store, real = {f"i{n}": n for n in range(6)}, ItemStore(tmp_path), item_store.replace_file
    written: list[Path] = []

    def full(path: Path, content: bytes) -> None:
        if path.suffix == ".item":
            if len(written) == 3:
                raise OSError(number, os.strerror(number), str(path))
            written.append(path)
        real(path, content)

    monkeypatch.setattr(item_store, "replace_file", full)
    with pytest.raises(
        EnvironmentProblem, match=r"cannot write .*; 3 of 6 items are done and kept; run the same again"
    ):
        run_items(answer, items, store, here)
    monkeypatch.setattr(item_store, "replace_file", real)
    outcome = run_items(answer, items, store, here)
    assert (outcome.computed, outcome.kept) == (3, 3)


def test_a_file_in_the_way_is_said(tmp_path: Path) -> None:
    (tmp_path / "c").write_text("mine")
    with pytest.raises(EnvironmentProblem, match="cannot write to"):
        run_items(answer, {"a": 1}, ItemStore(tmp_path / "c"))


def test_a_broken_file_is_said_before_anything_runs(tmp_path: Path) -> None:
    store = ItemStore(tmp_path)
    store.write("a", b"result", 1)
    store._file("a").write_bytes(b"")
    with pytest.raises(FileFormatError, match="is broken; delete it"):
        run_items(answer, {"a": 1, "b": 2}, ItemStore(tmp_path))


def test_one_process_at_a_time_has_a_directory(tmp_path: Path) -> None:
    store = ItemStore(tmp_path)
    with store.claimed(), pytest.raises(EnvironmentProblem, match="another process"):
        run_items(answer, {"a": 1}, ItemStore(tmp_path))


# ---- Runs ----------------------------------------------------------------------------------------------------------

ITEMS = {
    "plain": 1,
    "deep": {"x": [2]},
    "none": "no bytes",
    "unlucky": "raise",
    "exits": "exit",
    "dark": "warn",
    "darker": "warn",
    "threads": "threads",
}
BAD = {"none", "unlucky", "exits"}


def test_good_items_are_stored_and_bad_ones_quarantined(tmp_path: Path, here: Workers) -> None:
    done: list[str] = []
    told: list[tuple[str, float]] = []
    store = ItemStore(tmp_path / "c", {"x": 1})
    outcome = run_items(answer, ITEMS, store, here, lambda *words: told.append(words), done.append)
    assert (outcome.computed, outcome.kept, outcome.exit_status) == (len(ITEMS) - 3, 0, 1)
    assert set(done) == set(store.keys()) == set(ITEMS) - BAD
    assert all(store.read(key) == answer(ITEMS[key]) for key in {"plain", "deep"})
    assert {item.key: item.argument for item in store.quarantined} == {key: ITEMS[key] for key in BAD}
    errors = {item.key: item.error for item in outcome.quarantined}
    assert errors == {
        "unlucky": "RuntimeError: no luck",
        "none": "expected bytes of the function, got int",
        "exits": "SystemExit: 2",
    }
    assert "in answer" in next(item.traceback for item in store.quarantined if item.key == "unlucky")
    assert outcome.warned == {"RangesimWarning": (2, "dark")}
    assert told[0] == ("0 of 8 items", 0.0)
    assert told[-1] == ("8 of 8 items, 3 failed", 1.0)
    assert [fraction for _, fraction in told] == sorted(fraction for _, fraction in told)
    assert all(text in str(outcome) for text in ("5 items computed, 0 kept, 3 failed", "unlucky: RuntimeError", "dark"))


def test_a_second_run_computes_only_what_is_missing_and_on_request_what_failed(tmp_path: Path, here: Workers) -> None:
    store = ItemStore(tmp_path)
    run_items(answer, {"a": 1, "b": "raise"}, store, here)
    done: list[str] = []
    again = run_items(answer, {"a": 1, "b": "raise", "c": 3}, store, here, on_done=done.append)
    assert (again.computed, again.kept, [item.key for item in again.quarantined]) == (1, 1, ["b"])
    assert done == ["c"]
    nothing_left = run_items(answer, {"a": 1, "b": "raise", "c": 3}, store, Workers(scheduler="tcp://127.0.0.1:1"))
    assert nothing_left == Outcome(0, 2, again.quarantined)
    store.discard("b")
    assert run_items(answer, {"a": 1, "b": 2}, store, here).computed == 1
    store.quarantine(item_store.QuarantinedItem("d", "bad luck", 4))
    assert run_items(answer, {"d": 4}, store, here, retry=True).exit_status == 0
    with pytest.raises(ValueError, match="item a, computed from other settings"):
        run_items(answer, {"a": 2}, store, here)


def test_a_campaign_of_nothing_is_done(tmp_path: Path) -> None:
    assert run_items(answer, {}, ItemStore(tmp_path)) == Outcome()


class Million(Mapping[str, int]):
    """A lazy mapping that counts what is asked of it."""

    asked = 0

    def __len__(self) -> int:
        return 10**4

    def __iter__(self) -> Iterator[str]:
        return (f"i{n}" for n in range(len(self)))

    def __getitem__(self, key: str) -> int:
        self.asked += 1
        if self.asked > 50:
            raise KeyboardInterrupt
        return int(key[1:])


def test_a_lazy_campaign_is_submitted_in_a_window(tmp_path: Path, here: Workers) -> None:
    items, done = Million(), []
    with pytest.raises(KeyboardInterrupt):
        run_items(answer, items, ItemStore(tmp_path), here, on_done=done.append)
    assert len(done) >= 15  # each item is asked for when it is submitted and when it is stored, and 4 are submitted


def test_what_is_not_deterministic_is_said(tmp_path: Path, here: Workers) -> None:
    items: dict[str, Any] = {f"i{n}": n for n in range(30)}
    items["i0"] = "count"
    with pytest.raises(ValueError, match="item i0 gave other bytes when it was computed again"):
        run_items(answer, items, ItemStore(tmp_path), here)


def test_a_function_that_always_fails_ends_the_run(tmp_path: Path, here: Workers) -> None:
    with pytest.raises(ValueError, match=r"the first 20 items all failed, .* by RuntimeError: no luck"):
        run_items(answer, {f"i{n}": "raise" for n in range(100)}, ItemStore(tmp_path), here)


def test_what_cannot_be_sent_is_refused(tmp_path: Path) -> None:
    lock = threading.Lock()
    with pytest.raises(ValueError, match="cannot be sent"):
        run_items(lambda x: repr(lock).encode(), {"a": 1}, ItemStore(tmp_path))
    data = bytes(2 << 20)
    with pytest.raises(ValueError, match="at most 1048576 bytes"):
        run_items(lambda x: data, {"a": 1}, ItemStore(tmp_path))


def test_a_worker_of_another_version_is_refused(tmp_path: Path, here: Workers, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "all_versions", lambda: {**in_worker.all_versions(), "numpy": "1.0"})
    with pytest.raises(EnvironmentProblem, match=rf"numpy {np.__version__} \(here 1\.0\)"):
        run_items(answer, {"a": 1}, ItemStore(tmp_path), here)


def test_a_scheduler_that_does_not_answer_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "FIRST_ANSWER_S", 0.1)
    with pytest.raises(EnvironmentProblem, match=r"no scheduler answers at tcp://127\.0\.0\.1:1 .*0 of 1 items"):
        run_items(answer, {"a": 1}, ItemStore(tmp_path), Workers(scheduler="tcp://127.0.0.1:1"))
    with pytest.raises(ValueError, match="expected the address of a scheduler"):
        run_items(answer, {"a": 1}, ItemStore(tmp_path), Workers(scheduler="nonsense://x"))


def test_a_missing_extra_is_one_sentence(tmp_path: Path) -> None:
    code = (
        "import sys; sys.modules['distributed'] = None\n"
        "from rangesim.campaign import ItemStore, run_items\n"
        f"run_items(len, {{'a': b''}}, ItemStore({str(tmp_path)!r}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("rangesim.errors.EnvironmentProblem: campaigns need Dask")


# ---- Worker processes ----------------------------------------------------------------------------------------------


@pytest.fixture
def user_file(tmp_path: Path) -> ModuleType:
    """A file of the user, with a file beside it, as FILE.py:NAME loads it; workers find neither."""
    folder = tmp_path / "files"
    folder.mkdir()
    (folder / "beside_it.py").write_text("def doubled(x):\n    return 2 * x\n")
    (folder / "mine.py").write_text(
        "from dataclasses import dataclass\nfrom beside_it import doubled\n\n"
        "@dataclass(frozen=True)\nclass Own:\n    x: int\n\n"
        "def work(own):\n    return f'{doubled(own.x)} {type(own).__name__}'.encode()\n"
    )
    module = run_python_file(folder / "mine.py", "rangesim")
    for file in folder.glob("*.py"):
        file.write_text("raise ImportError('a worker elsewhere has no such file')")
    return module


def threads_in_force(_: object) -> bytes:
    """Threads of Dr.Jit, numba and BLAS, as the libraries themselves say."""
    import numba
    import threadpoolctl

    from rangesim.environment.backend import dr

    pools = {pool["num_threads"] for pool in threadpoolctl.threadpool_info()}
    return json.dumps([dr.thread_count(), numba.config.NUMBA_NUM_THREADS, sorted(pools)]).encode()


def test_functions_and_classes_of_the_users_files_reach_worker_processes(tmp_path: Path, user_file: ModuleType) -> None:
    """And their threads divide the cores; what the embedded cluster sets in this process is undone."""
    before = dict(os.environ)
    store = ItemStore(tmp_path / "c")
    outcome = run_items(user_file.work, {"a": user_file.Own(21)}, store, Workers(count=1))
    assert outcome.exit_status == 0, outcome
    assert store.read("a") == b"42 Own"
    assert os.environ == before


@pytest.mark.validation
@pytest.mark.parametrize("count", [1, 2])
def test_workers_divide_the_cores_among_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    monkeypatch.setattr(workers, "cores", lambda: 4)
    monkeypatch.setenv("OMP_NUM_THREADS", "3")  # the user's setting would make the workers fight
    store = ItemStore(tmp_path)
    run_items(threads_in_force, {"a": 0, "b": 1}, store, Workers(count=count))
    drjit, numba, pools = json.loads(store.read("a"))
    assert (drjit, numba, pools) == (4 // count, 4 // count, [1])
    assert os.environ["OMP_NUM_THREADS"] == "3"
