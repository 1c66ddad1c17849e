# SPDX-License-Identifier: Apache-2.0
"""Single files are written whole or not at all, and none is lost: the laws of `pcgraph.plumbing.plain_files`."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path

import pytest

import pcgraph
from pcgraph.plumbing import plain_files
from pcgraph.plumbing.plain_files import write_file, write_files
from pcgraph.tree.learned import EdgeModel


class Refused(Exception):
    """What the writer is told to raise."""


def test_a_file_is_replaced_whole_and_keeps_its_mode(tmp_path: Path) -> None:
    path = tmp_path / "x.bin"
    write_file(path, b"one", Refused)
    assert path.stat().st_mode & 0o777 == 0o666 & ~_umask()
    path.chmod(0o600)
    (tmp_path / "link").symlink_to("x.bin")
    write_file(tmp_path / "link", b"two", Refused)
    assert (path.read_bytes(), path.stat().st_mode & 0o777) == (b"two", 0o600)
    assert (tmp_path / "link").is_symlink()
    write_file(tmp_path / "a" / "b" / "y", b"three", Refused, make_parents=True)
    for place in (tmp_path / "none" / "z", tmp_path, path / "below", Path("/dev/null")):
        with pytest.raises(Refused, match="cannot write"):
            write_file(place, b"", Refused)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "link", "x.bin"]


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def test_parts_of_dead_writers_are_cleared_and_those_of_living_ones_stay(tmp_path: Path) -> None:
    dead, other = tmp_path / f".x.bin.{'0' * 16}.part", tmp_path / f".y.bin.{'0' * 16}.part"
    mine = tmp_path / ".x.bin.notes.part"
    alive = tmp_path / f".x.bin.{'1' * 16}.part"
    for path in (dead, other, mine, alive):
        path.write_text("")
    fcntl = pytest.importorskip("fcntl")
    with alive.open() as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        write_file(tmp_path / "x.bin", b"", Refused)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([alive.name, mine.name, other.name, "x.bin"])


def test_writers_of_one_file_in_several_processes_all_succeed(tmp_path: Path) -> None:
    """A part is locked until it is in its place, so that no other process takes it for one that was left behind."""
    pytest.importorskip("fcntl")
    code = (
        "import sys; from pathlib import Path; from pcgraph.plumbing.plain_files import write_files\n"
        "both = {Path(sys.argv[1]) / name: sys.argv[2].encode() * 1000 for name in 'xy'}\n"
        "for _ in range(100): write_files(both, OSError)"
    )
    writers = [subprocess.Popen([sys.executable, "-c", code, tmp_path, letter]) for letter in "abc"]
    assert [writer.wait(60) for writer in writers] == [0, 0, 0]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["x", "y"]
    assert {len(set((tmp_path / name).read_bytes())) for name in "xy"} == {1}


def test_a_file_that_has_appeared_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "y").write_bytes(b"theirs")
    with pytest.raises(Refused, match="y: it exists by now"):
        write_files({tmp_path / "n" / "x": b"1", tmp_path / "y": b"2"}, Refused, make_parents=True, overwrite=False)
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("y", b"theirs")]


@pytest.mark.parametrize("failing", ["open", "fsync", "replace"])
def test_files_that_belong_together_come_together_or_not_at_all(
    tmp_path: Path, failing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []
    real = getattr(os, failing)

    def full(*arguments: object, **options: object) -> object:
        calls.append(arguments)
        if len(calls) == 2 or failing == "replace":
            raise OSError(28, "No space left on device")
        return real(*arguments, **options)

    monkeypatch.setattr(os, failing, full)
    with pytest.raises(Refused, match="no space left on the device; make room there"):
        write_files({tmp_path / "a" / "x": b"1", tmp_path / "a" / "b" / "y": b"2"}, Refused, make_parents=True)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("held", ["open", "fsync"])
def test_a_signal_takes_what_is_half_written_and_its_directories_away(
    tmp_path: Path, held: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As `pcgraph segment --out new/directory` stopped between the making of the directory and the end of its files."""
    entered, go_on, abandoned = threading.Event(), threading.Event(), threading.Event()
    real, real_fsync = getattr(os, held), os.fsync

    def slow(*arguments: object, **options: object) -> object:
        done = real(*arguments, **options)
        if threading.current_thread() is worker and not entered.is_set():
            entered.set()
            go_on.wait(10)
        return done

    def not_before_all_is_abandoned(handle: int) -> None:
        if threading.current_thread() is worker:
            abandoned.wait(10)
        real_fsync(handle)

    def work() -> None:
        with suppress(Refused):
            write_files({tmp_path / "n" / "a": b"1", tmp_path / "n" / "b": b"2"}, Refused, make_parents=True)

    worker = threading.Thread(target=work)
    monkeypatch.setattr(os, held, slow)
    if held == "open":  # under the lock, which is waited for
        monkeypatch.setattr(os, "fsync", not_before_all_is_abandoned)
        threading.Timer(0.2, go_on.set).start()
    worker.start()
    assert entered.wait(10)
    assert plain_files._abandon()
    assert list(tmp_path.iterdir()) == []
    abandoned.set()
    go_on.set()
    worker.join(10)
    assert list(tmp_path.iterdir()) == []
    assert not plain_files._abandon()


@pytest.fixture(scope="module")
def savers(boxes):
    """Calls that save something to a path, by the ending of its name."""
    from sklearn.tree import DecisionTreeClassifier

    points, truth, result = boxes
    model = EdgeModel(("step_voxels",), (0.0,), (1.0,), (2.0,), -2.0, 0.5)
    taught = pcgraph.learning.NodeClassifier(DecisionTreeClassifier(max_depth=2)).fit(result, truth)
    return {
        "graphml": result.graph.write_graphml,
        "linkage.json": pcgraph.LearnedLinkage(model).save,
        "model.json": model.save,
        "classifier.json": taught.save,
        "ply": lambda path: pcgraph.write_segmentation(path, pcgraph.Cloud(points), result),
        "npz": lambda path: pcgraph.write_segmentation(path, pcgraph.Cloud(points), result),
    }


SAVERS = ("graphml", "linkage.json", "model.json", "classifier.json", "ply", "npz")


@pytest.mark.parametrize("ending", SAVERS)
def test_everything_that_saves_replaces_whole_files_or_none(savers, ending, tmp_path, monkeypatch):
    save, path = savers[ending], tmp_path / f"a.{ending}"
    save(path)
    whole = path.read_bytes()
    path.write_text("mine")
    path.chmod(0o640)
    (tmp_path / f"link.{ending}").symlink_to(path)
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", raising(OSError(errno.ENOSPC, "full")))
        with pytest.raises(pcgraph.CloudWriteError, match="no space left"):
            save(path)
    assert path.read_text() == "mine"
    save(str(tmp_path / f"link.{ending}"))
    assert (tmp_path / f"link.{ending}").is_symlink()
    assert path.read_bytes() == whole or ending == "npz"  # whose archive holds the time
    assert path.stat().st_mode & 0o777 == 0o640
    folder = tmp_path / f"folder.{ending}"
    folder.mkdir()
    for place in (folder, tmp_path / "nowhere" / path.name):
        with pytest.raises(pcgraph.CloudWriteError):
            save(place)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([path.name, f"link.{ending}", folder.name])


def raising(problem):
    def call(*_, **__):
        raise problem

    return call
