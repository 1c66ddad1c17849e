# SPDX-License-Identifier: Apache-2.0
"""No file of the user is ever lost, and a directory is whole or not there: laws of `atomic_directories`."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pcgraph.plumbing.plain_files import write_file
from rangesim.files import atomic_directories
from rangesim.files.atomic_directories import (
    MANIFEST,
    STAGING,
    DirectoryKind,
    check_directory,
    new_directory,
    recover,
    replace_listed_file,
    verify_directory,
)


class Refused(Exception):
    """Of the kind below."""


KIND = DirectoryKind("test-kind", "sidecar.json", Refused)
OTHER = DirectoryKind("another-kind", "sidecar.json", Refused)

OLD = {"a.txt": "old a", "deep/b.txt": "old b", "gone/c.txt": "old c"}
NEW = {"a.txt": "new a", "deep/b.txt": "new b", "fresh/d.txt": "new d"}
MINE = {"NOTES.md": "mine", "mydata/x.csv": "1,2", "deep/mine.txt": "mine too"}


@pytest.fixture(autouse=True)
def disk_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a machine that loses its power nothing is tested here: fsync is called and told where, but takes no time."""
    monkeypatch.setattr(os, "fsync", os.fstat)


def write(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def publish(target: Path, files: dict[str, str], kind: DirectoryKind = KIND) -> None:
    with new_directory(target, kind) as folder:
        write(folder, {"sidecar.json": json.dumps({"format": kind.format}), **files})


def contents(folder: Path) -> dict[str, str]:
    """What is there, the bookkeeping left out."""
    found = {p.relative_to(folder).as_posix(): p for p in folder.rglob("*") if p.is_file() or p.is_symlink()}
    return {name: p.read_text() for name, p in found.items() if name not in (MANIFEST, "sidecar.json")}


def is_whole(folder: Path) -> bool:
    found = verify_directory(folder, KIND)
    return not found.missing and not found.changed


# ---- What is the user's stays ---------------------------------------------------------------------------------------


def test_a_result_is_replaced_and_the_users_files_stay(tmp_path: Path) -> None:
    publish(tmp_path / "n", OLD)
    write(tmp_path / "n", MINE)
    (tmp_path / "n" / "empty").mkdir()
    (tmp_path / "n" / "link").symlink_to("/nowhere")
    before = {name: (tmp_path / "n" / name).stat() for name in MINE}
    publish(tmp_path / "n", NEW)
    assert (
        contents(tmp_path / "n").items() >= {**NEW, **MINE}.items()
        if not (tmp_path / "n" / "link").is_symlink()
        else True
    )
    (tmp_path / "n" / "link").unlink()
    assert contents(tmp_path / "n") == {**NEW, **MINE}
    assert (tmp_path / "n" / "empty").is_dir()
    assert not (tmp_path / "n" / "gone").exists()
    for name, stat in before.items():  # not even touched
        now = (tmp_path / "n" / name).stat()
        assert (now.st_ino, now.st_mtime_ns, now.st_ctime_ns) == (stat.st_ino, stat.st_mtime_ns, stat.st_ctime_ns)
    assert verify_directory(tmp_path / "n", KIND).foreign == ("NOTES.md", "deep/mine.txt", "empty", "mydata/x.csv")


def test_what_appears_while_the_work_goes_on_stays(tmp_path: Path) -> None:
    for name in ("new", "empty", "old"):
        target = tmp_path / name
        if name == "empty":
            target.mkdir()
        if name == "old":
            publish(target, OLD)
        with new_directory(target, KIND) as folder:
            write(folder, NEW)
            write(target, MINE)
        assert contents(target) == {**NEW, **MINE}, name


@pytest.mark.parametrize("failure", [ValueError, KeyboardInterrupt])
def test_what_appeared_stays_when_the_work_fails(tmp_path: Path, failure: type[BaseException]) -> None:
    def fail(target: Path) -> None:
        with new_directory(target, KIND) as folder:
            write(folder, NEW)
            write(target, MINE)
            raise failure

    with pytest.raises(failure):
        fail(tmp_path / "n")
    assert contents(tmp_path / "n") == MINE
    assert not (tmp_path / "n" / STAGING).exists()


def test_a_file_in_the_way_is_left_and_the_new_result_is_kept_beside_it(tmp_path: Path) -> None:
    publish(tmp_path / "n", OLD)

    def collide(name: str, text: str) -> None:
        with new_directory(tmp_path / "n", KIND) as folder:
            write(folder, NEW)
            (tmp_path / "n" / name).parent.mkdir(exist_ok=True)
            (tmp_path / "n" / name).write_text(text)

    with pytest.raises(Refused, match=r"a\.txt appeared or was changed .* the new result is in .*test-kind-2"):
        collide("a.txt", "edited by hand")
    assert contents(tmp_path / "n") == {
        **OLD, "a.txt": "edited by hand", **{f"test-kind-2/{n}": t for n, t in NEW.items()},
        f"test-kind-2/{MANIFEST}": (tmp_path / "n" / "test-kind-2" / MANIFEST).read_text(),
    }  # fmt: skip
    (tmp_path / "n" / "a.txt").write_text("old a")
    with pytest.raises(Refused, match="test-kind-3"):
        collide("fresh", "a file where a folder is to be")
    shutil.rmtree(tmp_path / "n")
    with pytest.raises(Refused, match="test-kind-2"):
        collide(MANIFEST, "somebody else's")
    assert (tmp_path / "n" / MANIFEST).read_text() == "somebody else's"


def test_a_link_put_in_place_of_one_of_our_folders_is_never_followed(tmp_path: Path) -> None:
    publish(tmp_path / "n", OLD)
    (tmp_path / "n" / "deep").rename(tmp_path / "elsewhere")
    (tmp_path / "n" / "deep").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(Refused, match=r"deep/b\.txt was changed"):
        publish(tmp_path / "n", NEW)
    assert (tmp_path / "elsewhere" / "b.txt").read_text() == "old b"


# ---- What cannot be is refused before the work starts ---------------------------------------------------------------


def refuse(place: Path, message: str, inputs: tuple[Path, ...] = (), kind: DirectoryKind = KIND) -> None:
    """Both refuse alike, nothing changes, and the block is never entered."""
    top = place.parent
    before = sorted((p, p.lstat().st_mtime_ns) for p in top.rglob("*"))
    with pytest.raises(Refused, match=message) as caught:
        check_directory(place, kind, inputs)
    assert "\n" not in str(caught.value)
    with pytest.raises(Refused, match=message), new_directory(place, kind, inputs):
        pytest.fail("entered")
    assert sorted((p, p.lstat().st_mtime_ns) for p in top.rglob("*")) == before


def test_what_is_no_older_result_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "foreign", {"thesis.txt": "do not delete"})
    refuse(tmp_path / "foreign", "holds something else than a test-kind")
    (tmp_path / "file").write_text("")
    refuse(tmp_path / "file", "exists and is no directory")
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    refuse(tmp_path / "dangling", "is a link to .*nowhere, which does not exist")
    publish(tmp_path / "other", OLD, OTHER)
    refuse(tmp_path / "other", "holds something else than a test-kind")
    publish(tmp_path / "edited", OLD)
    (tmp_path / "edited" / "a.txt").write_text("edited")
    refuse(tmp_path / "edited", r"a\.txt was changed since rangesim wrote it")
    publish(tmp_path / "unlisted", OLD)
    (tmp_path / "unlisted" / MANIFEST).unlink()
    refuse(tmp_path / "unlisted", "without a valid manifest.json")
    write(tmp_path / "nearly", {f"{STAGING}/mine.txt": "mine"})
    with (
        pytest.raises(Refused, match="is no staging directory of rangesim"),
        new_directory(tmp_path / "nearly", KIND),
    ):
        pytest.fail("entered")
    assert contents(tmp_path / "nearly") == {f"{STAGING}/mine.txt": "mine"}


@pytest.mark.parametrize("name", ["~", "~/results", "--noise-free", "deep/--noise-free"])
def test_names_that_mean_something_else_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """A directory of the name `~` invites `rm -rf ~`."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(Refused, match="looks like"), new_directory(name, KIND):
        pytest.fail("entered")
    assert list(tmp_path.iterdir()) == []
    publish(Path("./x/~"), NEW)
    assert contents(tmp_path / "x" / "~") == NEW


def test_inputs_are_kept_apart(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    refuse(tmp_path / "in", "is the input itself", (tmp_path / "in",))
    refuse(tmp_path / "in" / "below", "lies inside the input", (tmp_path / "in",))
    (tmp_path / "link").symlink_to(tmp_path / "in")
    refuse(tmp_path / "link", "is the input itself", (tmp_path / "in",))


def test_links_to_directories_are_written_through(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    assert check_directory(tmp_path / "link", KIND) == tmp_path / "real"
    publish(tmp_path / "link", NEW)
    assert (tmp_path / "link").is_symlink()
    assert contents(tmp_path / "real") == NEW
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    publish(Path(), NEW)
    publish(Path(), OLD)
    assert contents(tmp_path / "here") == OLD


def test_a_place_that_never_comes_into_being_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in /proc, where making a directory says that there is none; it was once tried for ever."""
    monkeypatch.setattr(atomic_directories, "_ATTEMPTS", 20)

    def vanishes(path: Path, *_: object, **__: object) -> None:
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))

    monkeypatch.setattr(Path, "mkdir", vanishes)
    with pytest.raises(Refused, match="cannot be made"):
        publish(tmp_path / "n", NEW)
    assert not (tmp_path / "n").exists()


def test_two_at_a_time_are_told_apart(tmp_path: Path) -> None:
    publish(tmp_path / "n", OLD)
    with new_directory(tmp_path / "n", KIND) as folder:
        write(folder, NEW)
        with pytest.raises(Refused, match="another process is writing"):
            check_directory(tmp_path / "n", KIND)
        with pytest.raises(Refused, match="another process is writing"):
            publish(tmp_path / "n", OLD)
        assert is_whole(tmp_path / "n")  # readers see the older result meanwhile
        assert contents(tmp_path / "n").items() >= OLD.items()
    assert contents(tmp_path / "n") == NEW


@pytest.mark.parametrize(
    "damage",
    [b"", b"[]", b"{}", b"null", b'{"format": "rangesim-manifest"}', b"[" * 100_000, b'{"a": NaN}', b"\xed\xa0\x80"],
)
def test_a_damaged_manifest_makes_nothing_ours(tmp_path: Path, damage: bytes) -> None:
    publish(tmp_path / "n", OLD)
    (tmp_path / "n" / MANIFEST).write_bytes(damage)
    refuse(tmp_path / "n", "without a valid manifest.json")


@pytest.mark.parametrize("name", ["../victim", "/etc/passwd", "a/../../victim", "", ".", "deep//b.txt", f"{STAGING}/x"])
def test_a_crafted_manifest_reaches_nothing_outside(tmp_path: Path, name: str) -> None:
    (tmp_path / "victim").write_text("old a")
    publish(tmp_path / "n", OLD)
    manifest = json.loads((tmp_path / "n" / MANIFEST).read_text())
    manifest["files"][name] = manifest["files"]["a.txt"]
    (tmp_path / "n" / MANIFEST).write_text(json.dumps(manifest))
    refuse(tmp_path / "n", "without a valid manifest.json")


def test_a_crafted_journal_reaches_nothing_outside(tmp_path: Path) -> None:
    def craft(journal: object, **links: Path) -> Path:
        shutil.rmtree(tmp_path / "n", ignore_errors=True)
        publish(tmp_path / "n", OLD)
        (tmp_path / "n" / STAGING / "new").mkdir(parents=True)
        (tmp_path / "n" / STAGING / "lock").touch()
        (tmp_path / "n" / STAGING / "journal.json").write_text(json.dumps(journal))
        for name, target in links.items():
            place = tmp_path / "n" / name.replace("__", "/").replace("STAGING", STAGING)
            if place.is_dir():
                shutil.rmtree(place)
            place.symlink_to(target)
        return tmp_path / "n"

    home = tmp_path / "home"
    write(home, {"b.txt": "old b", "key": "secret"})
    digest = json.loads((craft({}) / MANIFEST).read_text())["files"]["deep/b.txt"]
    for journal, links in (
        ({"retire": {}, "place": ["../x"]}, {}),
        ({"retire": {"../home/b.txt": digest}, "place": []}, {}),
        ({"retire": {"deep/b.txt": digest}, "place": []}, {"STAGING__old": home}),
        ({"retire": {}, "place": ["key"]}, {"STAGING__new": home}),
        ({"retire": {}, "place": ["deep/x"]}, {"deep": home}),
    ):
        folder = craft(journal, **links)
        if (folder / STAGING / "new").is_dir() and not (folder / STAGING / "new").is_symlink():
            write(folder / STAGING / "new", {"deep/x": "evil"})
        try:
            recover(folder, Refused)
        except Refused as error:
            assert "\n" not in str(error)  # noqa: PT017  (some of them end well, having done nothing)
        assert contents(home) == {"b.txt": "old b", "key": "secret"}
    outside = craft({"retire": {"deep/b.txt": digest}, "place": []}, deep=home)
    recover(outside, Refused)
    assert contents(home) == {"b.txt": "old b", "key": "secret"}


# ---- Failures and kills at any moment -------------------------------------------------------------------------------


CHANGES = ((os, "link"), (os, "replace"), (os, "fsync"), (Path, "rename"), (Path, "unlink"), (Path, "mkdir"))
"""Calls that change the disk."""


class Stop(BaseException):
    """A process that ends here."""


def before_each_change(monkeypatch: pytest.MonkeyPatch, act: Callable[[], None]) -> None:
    """Call `act` before every call that changes the disk."""

    def acting(call: Callable[..., object]) -> Callable[..., object]:
        def wrapper(*args: object, **kwargs: object) -> object:
            act()
            return call(*args, **kwargs)

        return wrapper

    for owner, name in CHANGES:
        monkeypatch.setattr(owner, name, acting(getattr(owner, name)))


def count_down(monkeypatch: pytest.MonkeyPatch, steps: int, failure: Callable[[], BaseException]) -> None:
    """Let the call number `steps` of all that change the disk fail before it does anything, and all after it."""
    left = iter(range(steps))

    def act() -> None:
        if next(left, None) is None:
            raise failure()

    before_each_change(monkeypatch, act)


def steps_of_a_replacement(tmp_path: Path) -> int:
    """How many calls there are to fail."""
    calls: list[None] = []
    with pytest.MonkeyPatch.context() as patch:
        publish(tmp_path / "count", OLD)
        before_each_change(patch, lambda: calls.append(None))
        patch.setattr(atomic_directories._Staging, "release", end_of_process)
        publish(tmp_path / "count", NEW)
    atomic_directories._claims.clear()
    return len(calls)


def end_of_process(claim: atomic_directories._Staging) -> None:
    """What is left to do for a claim whose process is killed: the system closes its files."""
    if claim.handle is not None:
        os.close(claim.handle)


def test_a_process_that_dies_at_any_step_leaves_the_old_or_the_new(tmp_path: Path) -> None:
    """After each call that changes the disk the world stops: nothing more of that process runs, as after SIGKILL."""
    steps = steps_of_a_replacement(tmp_path)
    assert steps > 20
    seen = set()
    publish(tmp_path / "before", OLD)
    write(tmp_path / "before", MINE)
    for step in range(steps):
        target = shutil.copytree(tmp_path / "before", tmp_path / f"n{step}")
        with pytest.MonkeyPatch.context() as patch:
            count_down(patch, step, Stop)
            patch.setattr(atomic_directories._Staging, "release", end_of_process)
            with pytest.raises(Stop):
                publish(target, NEW)
        atomic_directories._claims.clear()
        recover(target, Refused)
        assert is_whole(target)
        found = {k: v for k, v in contents(target).items() if not k.startswith(STAGING)}
        assert found in ({**OLD, **MINE}, {**NEW, **MINE}), step
        seen.add(found == {**NEW, **MINE})
        publish(target, NEW)
        assert contents(target) == {**NEW, **MINE}
        assert sorted(p.name for p in target.iterdir() if p.name.startswith(".")) == []
    assert seen == {False, True}


def test_a_disk_that_fails_at_any_step_leaves_the_old_or_the_new(tmp_path: Path) -> None:
    """It is full or broken, by turns: both are told alike, and nothing asks which it was."""
    publish(tmp_path / "before", OLD)
    write(tmp_path / "before", MINE)
    for step in range(steps_of_a_replacement(tmp_path)):
        number = (errno.ENOSPC, errno.EIO)[step % 2]
        target = shutil.copytree(tmp_path / "before", tmp_path / f"n{step}")
        with pytest.MonkeyPatch.context() as patch:
            count_down(patch, step, partial(OSError, number, os.strerror(number)))
            with pytest.raises((Refused, OSError)) as caught:
                publish(target, NEW)
            assert "\n" not in str(caught.value)
        recover(target, Refused)
        assert is_whole(target)
        found = {k: v for k, v in contents(target).items() if not k.startswith(STAGING)}
        assert found in ({**OLD, **MINE}, {**NEW, **MINE}), step
        publish(target, NEW)
        assert contents(target) == {**NEW, **MINE}


def test_a_killed_process_leaves_staging_that_the_next_one_clears(tmp_path: Path) -> None:
    code = (
        "import os, signal, sys; from pathlib import Path\n"
        "from rangesim.files.atomic_directories import DirectoryKind, new_directory\n"
        "kind = DirectoryKind('test-kind', 'sidecar.json', OSError)\n"
        "with new_directory(sys.argv[1], kind) as folder:\n"
        "    (folder / 'half').write_text('x')\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    for target in (tmp_path / "new" / "n", tmp_path / "old"):
        if target.name == "old":
            publish(target, OLD)
        done = subprocess.run([sys.executable, "-c", code, str(target)], check=False, timeout=60)
        assert done.returncode == -9
        assert list((target / STAGING).glob("work-*/half"))
        publish(target, NEW)
        assert contents(target) == NEW
        assert not (target / STAGING).exists()


def test_abandon_waits_for_a_replacement_and_clears_the_rest(tmp_path: Path) -> None:
    entered, ended = threading.Event(), threading.Event()

    def work() -> None:
        with suppress(Refused), new_directory(tmp_path / "deep" / "n", KIND) as folder:
            write(folder, NEW)
            entered.set()
            ended.wait(10)

    thread = threading.Thread(target=work)
    thread.start()
    assert entered.wait(10)
    assert atomic_directories.abandon()
    assert list(tmp_path.iterdir()) == []
    ended.set()
    thread.join(10)
    assert not atomic_directories.abandon()


def test_work_that_goes_on_while_it_is_abandoned_leaves_nothing(tmp_path: Path) -> None:
    """The thread that ends a process clears away what the main thread still writes."""

    def work(entered: threading.Event) -> None:
        with suppress(Refused, OSError), new_directory(tmp_path / "n", KIND) as folder:
            (folder / "deep").mkdir()
            for i in range(10_000):
                (folder / "deep" / str(i)).write_text("")
                (folder / str(i)).write_text("")
                if i == 20:
                    entered.set()

    for _ in range(20):
        entered = threading.Event()
        thread = threading.Thread(target=work, args=(entered,))
        thread.start()
        assert entered.wait(10)
        assert atomic_directories.abandon()
        thread.join(20)
        assert list(tmp_path.iterdir()) == []


# ---- Files of a complete directory ----------------------------------------------------------------------------------


def test_one_file_of_a_directory_is_replaced_with_its_digest(tmp_path: Path) -> None:
    publish(tmp_path / "n", OLD)
    replace_listed_file(tmp_path / "n", "a.txt", lambda: b"again", KIND)
    assert is_whole(tmp_path / "n")
    assert contents(tmp_path / "n") == {**OLD, "a.txt": "again"}
    (tmp_path / "n" / "a.txt").write_text("by hand")
    with pytest.raises(Refused, match=r"a\.txt was changed since rangesim wrote it"):
        replace_listed_file(tmp_path / "n", "a.txt", lambda: b"again", KIND)
    (tmp_path / "n" / "a.txt").unlink()
    (tmp_path / "n" / "a.txt").symlink_to(tmp_path / "victim")
    (tmp_path / "victim").write_text("again")
    with pytest.raises(Refused, match="was changed"):
        replace_listed_file(tmp_path / "n", "a.txt", lambda: b"evil", KIND)
    assert (tmp_path / "victim").read_text() == "again"


def test_a_replaced_file_is_ours_at_every_step(tmp_path: Path) -> None:
    publish(tmp_path / "before", OLD)
    for step in range(12):
        target = shutil.copytree(tmp_path / "before", tmp_path / f"n{step}")
        with pytest.MonkeyPatch.context() as patch:
            count_down(patch, step, Stop)
            with suppress(Stop):
                replace_listed_file(target, "a.txt", lambda: b"again", KIND)
        assert is_whole(target), step
        publish(target, NEW)
        assert contents(target) == NEW


def test_verify_names_what_differs(tmp_path: Path) -> None:
    publish(tmp_path / "n", OLD)
    (tmp_path / "n" / "a.txt").write_text("old A")
    (tmp_path / "n" / "deep" / "b.txt").unlink()
    (tmp_path / "n" / "more").write_text("")
    found = verify_directory(tmp_path / "n", KIND)
    assert (found.changed, found.missing, found.foreign, found.files) == (("a.txt",), ("deep/b.txt",), ("more",), 4)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_sequence_keeps_what_is_the_users(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    """Files come from the user and from us under the same few names, in any order: the user's bytes are all there."""
    folder = tmp_path_factory.mktemp("any")
    target, mine = folder / "n", {}
    names = st.sampled_from(["a", "b", "c/d", "c/e", "f"])
    for turn in range(data.draw(st.integers(1, 6))):
        for name in data.draw(st.lists(names, max_size=2)):
            place = target / name
            if target.is_dir() and not place.exists() and not (target / name.split("/")[0]).is_file():
                write(target, {name: f"mine {turn}"})
                mine[name] = f"mine {turn}"
        files = dict.fromkeys(data.draw(st.sets(names, min_size=1)), f"ours {turn}")
        with suppress(Refused):
            publish(target, files)
        assert contents(target).items() >= mine.items()


# ---- Found by attack ------------------------------------------------------------------------------------------------


def in_another_process(code: str, *arguments: object) -> subprocess.Popen[str]:
    """A process that has the module's names, KIND and `publish` at hand."""
    lines = (
        "import json, os, sys; from pathlib import Path\nfrom rangesim.files.atomic_directories import *\n"
        "KIND = DirectoryKind('test-kind', 'sidecar.json', OSError)\n"
        "def fill(folder, name):\n"
        "    (folder / 'sidecar.json').write_text(json.dumps({'format': 'test-kind'}))\n"
        "    (folder / name).write_text(name)\n"
    )
    line = [sys.executable, "-c", lines + code, *map(str, arguments)]
    pipe = subprocess.PIPE
    return subprocess.Popen(line, stdin=pipe, stdout=pipe, stderr=subprocess.STDOUT, text=True)


def publish_while(target: Path, act: Callable[[Path], object]) -> None:
    """Publish NEW; what `act` does happens while the work goes on."""
    with new_directory(target, KIND) as folder:
        write(folder, {"sidecar.json": json.dumps({"format": "test-kind"}), **NEW})
        act(folder)


def test_a_directory_that_is_moved_away_takes_its_work_along(tmp_path: Path) -> None:
    """The user moves it and starts another run of that name: neither publishes, nor clears, what is the other's."""
    code = (
        "with new_directory(sys.argv[1], KIND) as folder:\n"
        "    fill(folder, 'B1'); print('in', flush=True); sys.stdin.readline(); (folder / 'B2').write_text('B2')\n"
    )
    others = []

    def move_and_start_another(folder: Path) -> None:
        (tmp_path / "n").rename(tmp_path / "moved")
        others.append(in_another_process(code, tmp_path / "n"))
        assert others[0].stdout is not None
        assert others[0].stdout.readline() == "in\n"
        (folder / "A").write_text("A")

    with pytest.raises(Refused, match="was moved or removed while the work went on"):
        publish_while(tmp_path / "n", move_and_start_another)
    assert others[0].communicate("\n", timeout=30) == ("", None)
    assert contents(tmp_path / "n") == {"B1": "B1", "B2": "B2"}
    assert is_whole(tmp_path / "n")


@pytest.mark.skipif(not hasattr(os, "fork"), reason="children share claims where processes fork")
@pytest.mark.parametrize("end", [SystemExit, None])
def test_a_child_that_leaves_the_block_changes_nothing(tmp_path: Path, end: type[BaseException] | None) -> None:
    code = (
        "try:\n"
        "    with new_directory(sys.argv[1], KIND) as folder:\n"
        "        fill(folder, 'a'); child = os.fork()\n"
        f"        if child == 0 and {end is not None}:\n"
        "            sys.exit()\n"
        "        if child: os.waitpid(child, 0); (folder / 'b').write_text('b')\n"
        "finally:\n"
        "    if child == 0: os._exit(0)\n"
    )
    assert in_another_process(code, tmp_path / "n").communicate(timeout=30) == ("", None)
    assert contents(tmp_path / "n") == {"a": "a", "b": "b"}
    assert not (tmp_path / "n" / STAGING).exists()


def test_a_result_copied_there_while_the_work_goes_on_is_the_users(tmp_path: Path) -> None:
    publish(tmp_path / "best", OLD)
    for name in ("new", "old"):
        if name == "old":
            publish(tmp_path / name, {"z": "z"})
        copy = partial(shutil.copytree, tmp_path / "best", tmp_path / name, dirs_exist_ok=True)
        with pytest.raises(Refused, match="appeared or was changed while the work went on"):
            publish_while(tmp_path / name, lambda _, copy=copy: copy())  # type: ignore[misc]
        assert contents(tmp_path / name).items() >= OLD.items()


def test_a_replacement_crosses_file_systems(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Something is mounted below the output, here `deep`: no link and no rename leads there."""

    def refusing(call: Callable[..., object]) -> Callable[..., object]:
        def wrapper(source: str | Path, place: str | Path, **kwargs: object) -> object:
            if Path(source).parent != Path(place).parent and "deep" in str(source) + str(place):
                raise OSError(errno.EXDEV, os.strerror(errno.EXDEV), str(source), None, str(place))
            return call(source, place, **kwargs)

        return wrapper

    publish(tmp_path / "n", OLD)
    write(tmp_path / "n", MINE)
    for owner, name in ((os, "link"), (os, "rename"), (Path, "rename")):
        monkeypatch.setattr(owner, name, refusing(getattr(owner, name)))
    publish(tmp_path / "n", NEW)
    assert contents(tmp_path / "n") == {**NEW, **MINE}
    assert is_whole(tmp_path / "n")
    assert not (tmp_path / "n" / STAGING).exists()


def test_a_second_interrupt_gives_the_directory_free(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C twice, the second while the first is cleared up, in an interpreter that lives on."""

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    def interrupt_twice(_: Path) -> None:
        monkeypatch.setattr(shutil, "rmtree", interrupted)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        publish_while(tmp_path / "n", interrupt_twice)
    monkeypatch.undo()
    publish(tmp_path / "n", NEW)
    assert contents(tmp_path / "n") == NEW


def test_a_process_killed_while_it_clears_up_leaves_what_the_next_one_knows(tmp_path: Path) -> None:
    real = os.unlink
    for step in range(8):
        target = tmp_path / f"n{step}"
        publish(target, OLD)
        left = [step]

        def unlink(path: str, left: list[int] = left, **kwargs: int) -> None:
            left[0] -= 1
            if left[0] < 0:
                raise Stop
            real(path, **kwargs)

        def fail(_: Path, unlink: Callable[..., None] = unlink) -> None:
            patch.setattr(os, "unlink", unlink)
            raise ValueError

        with pytest.MonkeyPatch.context() as patch, suppress(Stop, ValueError):
            publish_while(target, fail)
        publish(target, NEW)
        assert contents(target) == NEW


def test_processes_that_meet_say_so_and_nothing_else(tmp_path: Path) -> None:
    """Claims that are made while others are given up: no work is lost, and no other error comes."""
    code = (
        "import time; os.fsync = os.fstat; until = time.time() + 0.3\n"
        "while time.time() < until:\n"
        "    try:\n"
        "        with new_directory(sys.argv[1], KIND) as folder:\n"
        "            fill(folder, 'a')\n"
        "            if os.urandom(1) < b'\\xe0': raise KeyError\n"
        "    except KeyError: pass\n"
        "    except OSError as error:\n"
        "        if 'another process' not in str(error): print(error)\n"
    )
    processes = [in_another_process(code, tmp_path / "deep" / "n") for _ in range(3)]
    said = "".join(process.communicate(timeout=60)[0] for process in processes)
    assert "is no staging directory of rangesim" not in said
    assert "cannot create the directory" not in said


@pytest.mark.parametrize(
    ("name", "problem"), [("n", FileExistsError), (f"n/{STAGING}", FileNotFoundError), (f"n/{STAGING}", None)]
)
def test_a_directory_that_goes_while_it_is_made_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, problem: type[OSError] | None
) -> None:
    """Another process gives it up: where `mkdir` has found it, before `mkdir` looks into it, or after `mkdir`."""
    make, gone = Path.mkdir, [tmp_path / name]

    def mkdir(path: Path, *args: object, **kwargs: object) -> None:
        lost = path in gone
        if lost:
            gone.remove(path)
        if lost and problem is not None:
            raise problem(errno.EIO, "lost", str(path))
        make(path, *args, **kwargs)  # type: ignore[arg-type]
        if lost:
            path.rmdir()

    monkeypatch.setattr(Path, "mkdir", mkdir)
    publish(tmp_path / "n", NEW)
    assert contents(tmp_path / "n") == NEW
    assert not gone


def test_an_input_that_the_older_result_holds_is_refused(tmp_path: Path) -> None:
    publish(tmp_path / "n", OLD)
    write(tmp_path / "n", MINE)
    refuse(tmp_path / "n", "is a part of", (tmp_path / "n" / "gone" / "c.txt",))
    refuse(tmp_path / "n", "is a part of", (tmp_path / "n" / "gone",))
    check_directory(tmp_path / "n", KIND, [tmp_path / "n" / "NOTES.md"])


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes")
def test_a_pipe_named_as_the_lock_is_not_waited_for(tmp_path: Path) -> None:
    (tmp_path / "n" / STAGING).mkdir(parents=True)
    os.mkfifo(tmp_path / "n" / STAGING / "lock")
    code = "with new_directory(sys.argv[1], KIND): pass"
    with in_another_process(code, tmp_path / "n") as process:
        assert "is no staging directory of rangesim" in process.communicate(timeout=20)[0]


def test_names_as_long_as_the_file_system_takes_them(tmp_path: Path) -> None:
    for _ in range(2):
        write_file(tmp_path / ("a" * 251 + ".ply"), b"x", Refused)
        publish(tmp_path / ("d" * 255), OLD)
    refuse(tmp_path / ("d" * 256), "File name too long")
    with pytest.raises(Refused, match="File name too long"):
        write_file(tmp_path / ("a" * 256), b"x", Refused)
    assert sorted(len(p.name) for p in tmp_path.iterdir()) == [255, 255]


def test_what_the_user_made_read_only_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "x").write_text("mine")
    (tmp_path / "x").chmod(0o444)
    if os.access(tmp_path / "x", os.W_OK):  # root may write everything
        monkeypatch.setattr(os, "access", lambda path, mode: Path(path).stat().st_mode & 0o200)
    with pytest.raises(Refused, match="it is read-only"):
        write_file(tmp_path / "x", b"ours", Refused)
    assert (tmp_path / "x").read_text() == "mine"


def test_what_cannot_be_moved_away_is_refused_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A directory of somebody else's below: the swap would end half-way."""
    publish(tmp_path / "n", OLD)
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "deep")
    refuse(tmp_path / "n", r"deep/b\.txt cannot be replaced: permission denied")


def test_a_file_is_made_while_nobody_else_replaces_the_directory(tmp_path: Path) -> None:
    publish(tmp_path / "n", OLD)

    def make() -> bytes:
        with pytest.raises(Refused, match="another process is writing"):
            publish(tmp_path / "n", NEW)
        return b"again"

    replace_listed_file(tmp_path / "n", "a.txt", make, KIND)
    assert contents(tmp_path / "n") == {**OLD, "a.txt": "again"}
    assert not (tmp_path / "n" / STAGING).exists()
