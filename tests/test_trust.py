# SPDX-License-Identifier: Apache-2.0
"""What the commands do to a user's files, and where signals reach them: those in the processes that a user starts."""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_result import ROOT, small_result
from tiers import to_validate

import pcgraph.cli
import rangesim.cli
import rangesim.report
from rangesim.files.atomic_directories import MANIFEST, STAGING
from rangesim.report import render_report
from rangesim.results.captures import SIDECAR
from rangesim.results.experiment_results import Result

PLANE = str(ROOT / "scenes" / "plane.xml")
TINY = ("--sensor", "ideal-tof", "--width", "32", "--height", "24", "--spp", "1", "--no-caustics")


@dataclass(frozen=True)
class Done:
    """What a command left behind: exit status, and what it wrote to its streams."""

    returncode: int
    stdout: str
    stderr: str


Command = Callable[..., Done]
MAIN = {"rangesim": rangesim.cli.main, "pcgraph": pcgraph.cli.main}


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Command:
    """Calls a command's entry point with arguments, in this process."""

    def call(*arguments: object, package: str = "rangesim") -> Done:
        monkeypatch.setattr(sys, "argv", [package, *map(str, arguments)])
        capfd.readouterr()
        try:
            MAIN[package]()
            status = 0
        except SystemExit as end:
            status = int(end.code or 0)
        return Done(status, *capfd.readouterr())

    return call


@pytest.fixture
def run(command: Command) -> Command:
    """`rangesim run` of a small image, into a directory."""
    return lambda out, *more: command("run", PLANE, *TINY, "--out", out, *more)


def assert_refused(done: Done, message: str) -> None:
    assert done.returncode == 1
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert done.stdout == ""


# ---- A user's file is never removed ---------------------------------------------------------------------------------


def test_a_users_files_stay_when_a_result_is_replaced(command: Command, run: Command, tmp_path: Path) -> None:
    """`rangesim run S --out n; echo x > n/NOTES.md; mkdir n/mydata; rangesim run S --out n`, word for word."""
    out = tmp_path / "n"
    assert run(out).returncode == 0
    (out / "NOTES.md").write_text("x\n")
    (out / "mydata").mkdir()
    (out / "ideal-tof" / "thoughts.txt").write_text("mine")
    assert run(out, "--seed", 5).returncode == 0
    assert (out / "NOTES.md").read_text() == "x\n"
    assert (out / "mydata").is_dir()
    assert (out / "ideal-tof" / "thoughts.txt").read_text() == "mine"
    assert json.loads((out / "experiment.json").read_text())["experiment"]["seed"] == 5
    done = command("verify", out)
    assert done.returncode == 0
    assert "NOTES.md" in done.stdout
    assert "files are as they were written" in done.stdout


def test_files_changed_by_hand_are_not_overwritten(command: Command, run: Command, tmp_path: Path) -> None:
    out = tmp_path / "n"
    run(out)
    (out / "comparison.md").write_text("my own words")
    assert_refused(run(out), "comparison.md was changed since rangesim wrote it")
    done = command("verify", out)
    assert (done.returncode, done.stdout) == (1, f"changed: {out / 'comparison.md'}\n")
    (out / "comparison.md").unlink()
    (out / "report.html").write_text("annotated")
    assert_refused(command("report", out), "report.html was changed since rangesim wrote it")
    assert (out / "report.html").read_text() == "annotated"


def test_places_that_cannot_be_are_refused_before_the_work(command: Command, tmp_path: Path) -> None:
    capture = tmp_path / "capture"
    shutil.copytree(small_result() / "lines" / "capture", capture)
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    for arguments, message in (
        (["run", PLANE, *TINY, "--spp", "1000000", "--out", tmp_path / "dangling"], "is a link to"),
        (["run", PLANE, *TINY, "--spp", "1000000", "--out", tmp_path], "holds something else than a rangesim-result"),
        (["decode", capture, "--out", capture], "is the input itself"),
        (["decode", capture, "--out", capture / "decoded"], "lies inside the input"),
        (["decode", capture, "--out", tmp_path / "dangling"], "is a link to"),
    ):
        before = sorted(tmp_path.rglob("*"))
        assert_refused(command(*arguments), message)
        assert sorted(tmp_path.rglob("*")) == before


def test_links_and_the_current_directory_are_written_to_and_said(
    run: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    done = run(tmp_path / "link")
    assert done.returncode == 0
    assert done.stderr == f"rangesim: {tmp_path / 'link'} is a link; the results go to {tmp_path / 'real'}.\n"
    assert (tmp_path / "real" / "report.html").is_file()
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    for _ in range(2):
        assert run(".").returncode == 0
    assert (tmp_path / "here" / "report.html").is_file()


def test_results_without_a_manifest_are_not_taken_for_ours(run: Command, tmp_path: Path) -> None:
    """Those of older versions: nobody knows which of the files in them are the user's."""
    run(tmp_path / "n")
    (tmp_path / "n" / MANIFEST).unlink()
    assert_refused(run(tmp_path / "n"), "without a valid manifest.json")


def test_a_foreign_file_named_like_segments_stays(command: Command, tmp_path: Path) -> None:
    cloud, out = tmp_path / "scan.ply", tmp_path / "scan.segments.ply"
    shutil.copy(small_result() / "lines" / "cloud.ply", cloud)
    out.write_bytes(b"ply\ncomment mine\nend_header\n")
    for place in (tmp_path, out):
        assert_refused(
            command("segment", cloud, "--out", place, package="pcgraph"), f"{out.name} exists: add --overwrite"
        )
    assert out.read_bytes() == b"ply\ncomment mine\nend_header\n"
    for _ in range(2):
        assert command("segment", cloud, "--out", tmp_path, "--overwrite", package="pcgraph").returncode == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["scan.ply", "scan.segmentation.npz", out.name]


# ---- Durable and clean ----------------------------------------------------------------------------------------------


MOMENTS = (
    (0.0, signal.SIGINT),
    (0.02, signal.SIGTERM),
    (0.1, signal.SIGINT),
    (0.1, signal.SIGTERM),
    (0.4, signal.SIGINT),
    (1.0, signal.SIGTERM),
)
"""Seconds after the start, about, and what is sent then; both ways through the same handler."""


@pytest.mark.parametrize("package", ["rangesim", "pcgraph"])
def test_signals_end_a_command_in_one_line_at_any_moment(tmp_path: Path, package: str) -> None:
    """Also while Python still imports; before that, the interpreter's own start is not ours to change."""
    arguments = ("run", PLANE, *TINY, "--spp", "20000") if package == "rangesim" else ("segment", big_cloud(tmp_path))
    line = [sys.executable, "-m", package, *map(str, arguments), "--out", str(tmp_path / "out" / "n")]
    ended = 0
    for pause_s, number in MOMENTS:
        with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            wait_until_handled(process)
            time.sleep(pause_s * random.Random(f"{package}{number}{pause_s}").uniform(0.8, 1.2))
            process.send_signal(number)
            start = time.monotonic()
            _, err = process.communicate(timeout=60)
            assert time.monotonic() - start < 5.0
        if process.returncode == 0 or (process.returncode == 128 + number and "nothing was written" not in err):
            written = {path.name for path in (tmp_path / "out" / "n").iterdir()}
            assert written >= ({"report.html"} if package == "rangesim" else {"big.segments.ply"})
            shutil.rmtree(tmp_path / "out")
            continue
        assert process.returncode == 128 + number, err
        assert err == f"{package}: interrupted; nothing was written.\n"
        assert not (tmp_path / "out").exists()
        ended += 1
    assert ended >= len(MOMENTS) - 1


@pytest.mark.parametrize(
    ("package", "number"),
    [
        ("pcgraph", signal.SIGTERM),
        *to_validate(("rangesim", signal.SIGINT), ("rangesim", signal.SIGTERM), ("pcgraph", signal.SIGINT)),
    ],
)
@pytest.mark.validation
def test_a_signal_after_the_last_line_is_one_line_too_or_comes_too_late(
    tmp_path: Path, package: str, number: signal.Signals
) -> None:
    """The interpreter takes a while to end, with large libraries; here there is more to take apart, at two places."""
    if package == "rangesim":
        arguments = ["compare", str(small_result())]
    else:
        arguments = ["segment", str(small_result() / "lines" / "cloud.ply")]
        arguments += ["--out", str(tmp_path / "out"), "--overwrite"]
    code = f"""if True:
        import atexit, sys, time
        from {package}.__main__ main
        class Slow:
            def __del__(self, sleep=time.sleep):
                sleep(2.0)
        sys.modules["slow"] = Slow()
        sys.argv = [{package!r}, *sys.argv[1:]]
        exits = sys.exit
        def end(*given):
            atexit.register(time.sleep, SECONDS)
            print("the end", flush=True)
            exits(*given)
        sys.exit = end
        main()
    """.replace("__main__ main", "__main__ import main")
    for seconds, pause_s in ((0.0, 0.0), (0.0, 0.1), (0.0, 0.4), (0.5, 0.1)):
        line = [sys.executable, "-c", code.replace("SECONDS", str(seconds)), *arguments]
        with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            while (text := process.stdout.readline()) != "the end\n":
                assert text
            time.sleep(pause_s)
            process.send_signal(number)
            _, err = process.communicate(timeout=60)
        err = re.sub("^rangesim: the exposure is automatic.*\n", "", err)  # of the work before
        ended = (128 + number, f"{package}: interrupted.\n")
        assert (process.returncode, err) in ({ended} if seconds else {ended, (0, "")})


def wait_until_handled(process: subprocess.Popen[str]) -> None:
    """Until the process catches SIGINT and SIGTERM, as Linux says."""
    if not Path("/proc/self/status").is_file():
        time.sleep(0.2)
        return
    wanted = 1 << (signal.SIGINT - 1) | 1 << (signal.SIGTERM - 1)
    for _ in range(2000):
        status = Path(f"/proc/{process.pid}/status").read_text().splitlines()
        caught = int(next(line for line in status if line.startswith("SigCgt")).split()[1], 16)
        threads = int(next(line for line in status if line.startswith("Threads")).split()[1])
        if caught & wanted == wanted and threads > 1:
            return
        time.sleep(0.001)
    pytest.fail("the process never cared for signals")


def big_cloud(folder: Path) -> Path:
    path = folder / "big.ply"
    points = np.random.default_rng(0).normal(size=(400_000, 3)).astype("<f4")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    path.write_bytes(header.encode() + points.tobytes())
    return path


def test_what_a_killed_run_left_is_cleared_by_the_next(run: Command, tmp_path: Path) -> None:
    out = tmp_path / "n"
    line = [sys.executable, "-m", "rangesim", "run", PLANE, *TINY, "--spp", "20000", "--out", str(out)]
    with subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        while not list((out / STAGING).glob("work-*")):
            assert process.poll() is None
            time.sleep(0.01)
        process.kill()
    assert (out / STAGING).exists()
    assert run(out).returncode == 0
    assert [p for p in out.rglob("*") if p.name.startswith(".")] == []
    assert [p for p in tmp_path.iterdir() if p.name.startswith(".")] == []


@pytest.mark.skipif(not hasattr(signal, "SIGXFSZ"), reason="sizes of files are limited on POSIX")
def test_a_full_disk_is_said_in_one_sentence_and_leaves_the_older_result(run: Command, tmp_path: Path) -> None:
    import resource

    out = tmp_path / "n"
    for seed in (0, 1):  # the second replaces, too
        assert run(out, "--seed", seed).returncode == 0
    before = {p: p.read_bytes() for p in out.rglob("*") if p.is_file()}
    largest = max(map(len, before.values()))
    allowed = resource.getrlimit(resource.RLIMIT_FSIZE)
    for size in (3000, 12_000, largest // 2):
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, allowed[1]))
        try:
            done = run(out, "--seed", 2)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, allowed)
        # Dr.Jit says on a line of its own if it cannot keep a kernel, as where another process is at it.
        ours = [line for line in done.stderr.splitlines(keepends=True) if not line.startswith("jit_")]
        assert_refused(
            replace(done, stderr="".join(ours)),
            f"rangesim: cannot write {out}: the file would be larger than allowed; nothing was written, make room or "
            "name another place.\n",
        )
        assert {p: p.read_bytes() for p in out.rglob("*") if p.is_file()} == before


def test_verify_takes_captures_and_decoded_ones_too(command: Command, tmp_path: Path) -> None:
    capture = tmp_path / "capture"
    shutil.copytree(small_result() / "lines" / "capture", capture)
    assert command("decode", capture, "--out", tmp_path / "decoded").returncode == 0
    for folder in (capture, tmp_path / "decoded", small_result()):
        assert command("verify", folder).returncode == 0
    frame = next(capture.glob("*.png"))
    frame.write_bytes(frame.read_bytes()[:-1] + b"x")
    done = command("verify", capture)
    assert (done.returncode, done.stdout) == (1, f"changed: {frame}\n")
    assert done.stderr.endswith("were changed.\n")
    assert_refused(command("verify", tmp_path), "expected a directory that rangesim wrote")
    assert SIDECAR in command("verify", tmp_path).stderr


# ---- Found by attack ------------------------------------------------------------------------------------------------


@pytest.mark.skipif(not hasattr(os, "fork"), reason="streams are closed in a child before it runs")
@pytest.mark.parametrize("closed", [(0, 1, 2), *to_validate(((1,),), ((2,),))])
def test_closed_standard_streams_are_no_obstacle(command: Command, tmp_path: Path, closed: tuple[int, ...]) -> None:
    """`rangesim ... >&- 2>&-`: it works, no file takes the number of a stream, and signals end it as ever."""

    def close() -> None:
        for descriptor in closed:
            os.close(descriptor)

    out = tmp_path / "n"
    start = [sys.executable, "-m", "rangesim", "run", PLANE, *TINY, "--out", str(out)]
    assert subprocess.run(start, timeout=120, check=False, preexec_fn=close).returncode == 0
    assert command("verify", out).returncode == 0
    shutil.rmtree(out)
    with subprocess.Popen([*start, "--spp", "200000"], preexec_fn=close) as process:
        wait_until(lambda: bool(list((out / STAGING).glob("work-*"))), process)
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=20) == 130
    assert not out.exists()


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="terminals hang up on POSIX")
@pytest.mark.parametrize("ignored", [True, *to_validate(False)])
def test_a_closed_terminal_ends_a_run_as_an_interrupt_does(tmp_path: Path, ignored: bool) -> None:
    """But not with nohup, which ignores the signal beforehand, as it may have for the tests themselves."""
    out = tmp_path / "n"
    spp = "3000" if ignored else "20000"
    line = [sys.executable, "-m", "rangesim", "run", PLANE, *TINY, "--spp", spp, "--out", str(out)]
    start = partial(signal.signal, signal.SIGHUP, signal.SIG_IGN if ignored else signal.SIG_DFL)
    with subprocess.Popen(line, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, preexec_fn=start) as process:
        wait_until(lambda: bool(list((out / STAGING).glob("work-*"))), process)
        process.send_signal(signal.SIGHUP)
        _, err = process.communicate(timeout=60)
        assert process.returncode == (0 if ignored else 129)
        assert err == ("" if ignored else "rangesim: interrupted; nothing was written.\n")
    assert out.exists() == ignored


def wait_until(condition: Callable[[], bool], process: subprocess.Popen[Any]) -> None:
    for _ in range(3000):
        if condition():
            return
        assert process.poll() is None
        time.sleep(0.01)
    pytest.fail("it never came")


def test_a_place_whose_name_leads_through_what_is_not_there(run: Command, tmp_path: Path) -> None:
    done = run(tmp_path / "none" / ".." / "n")
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "n" / "report.html").is_file()


def test_verify_prints_a_line_for_each_file_whatever_its_name(command: Command, tmp_path: Path) -> None:
    folder = tmp_path / "n"
    shutil.copytree(small_result() / "lines" / "capture", folder)
    for name in (b"a\nchanged: b", b"\x1b[31mred", b"\xff"):
        Path(os.fsdecode(os.fsencode(folder) + b"/" + name)).touch()
    done = command("verify", folder)
    assert done.returncode == 0
    assert done.stdout.count("\n") == 4
    assert "\x1b" not in done.stdout


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes")
@pytest.mark.validation
def test_pipes_in_a_result_are_not_waited_for(tmp_path: Path) -> None:
    names = ("lines/measurement.json", "lines/comparison.json", "lines/capture/capture.json")
    for number, name in enumerate(names):
        folder = tmp_path / str(number)
        shutil.copytree(small_result(), folder)
        (folder / name).unlink()
        os.mkfifo(folder / name)
    code = """
import sys
from rangesim.cli import main
for folder in sys.argv[1:]:
    sys.argv = ["rangesim", "report", folder]
    try:
        main()
    except SystemExit as end:
        print(end.code)
"""
    line = [sys.executable, "-c", code, *(str(tmp_path / str(number)) for number in range(len(names)))]
    done = subprocess.run(line, capture_output=True, text=True, timeout=120, check=False)  # which waits no longer
    assert done.stdout == "1\n" * len(names)
    for number, (name, said) in enumerate(zip(names, done.stderr.splitlines(), strict=True)):
        assert str(tmp_path / str(number) / name).rpartition("/")[0] in said


def test_a_report_is_of_the_result_it_is_written_to(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While it is made no run replaces the result."""
    out = tmp_path / "n"
    shutil.copytree(small_result(), out)
    refused = []

    def render(result: Result, paper: str) -> str:
        line = [sys.executable, "-m", "rangesim", "run", PLANE, *TINY, "--out", str(out)]
        other = subprocess.run(line, capture_output=True, text=True, timeout=120, check=False)
        refused.append(Done(other.returncode, other.stdout, other.stderr))
        return render_report(result, paper)

    monkeypatch.setattr(rangesim.report, "render_report", render)
    assert command("report", out).returncode == 0
    assert_refused(*refused, "another process is writing")
    assert command("verify", out).returncode == 0
    assert not (out / STAGING).exists()
