# SPDX-License-Identifier: Apache-2.0
"""Kills and full disks: what is left of a result, and of a user's files beside it.

    python benchmarks/crash_safety.py [--kills 200] [--disks 50] [--seed 0]

A small result is replaced again and again by `rangesim run` in a process of its own, which is ended by SIGKILL, SIGTERM
or SIGINT at a random moment, or by SIGKILL at one of the calls that change the disk (so also between any two renames of
the swap); or whose disk is full: a limit on file sizes, and as root a small tmpfs. After each, the user's files must be
the same files untouched, and the result that of before or that of the new run, whole. After a further run that ends
well, nothing else may lie there. The last line is JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from rangesim.errors import FileFormatError
from rangesim.files.atomic_directories import verify_directory
from rangesim.results.experiment_results import RESULT, read_settings

ROOT = Path(__file__).resolve().parents[1]
RUN = ["run", str(ROOT / "scenes" / "plane.xml"), "--sensor", "gray", "--sensor", "ideal-tof", "--width", "48",
       "--height", "36", "--spp", "1", "--no-caustics"]  # fmt: skip
KILL_AT_CALL = """
import os, signal, sys
from pathlib import Path
left = int(sys.argv.pop(1))
def counted(call):
    def wrapper(*args, **kwargs):
        global left
        left -= 1
        if left < 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return call(*args, **kwargs)
    return wrapper
for owner, name in ((os, "link"), (os, "replace"), (Path, "rename"), (Path, "unlink"), (Path, "rmdir")):
    setattr(owner, name, counted(getattr(owner, name)))
from rangesim.__main__ import main
main()
"""
HARMLESS = {"not killed", "fitted"}
"""How an attempt ends that the run outlives."""
CALLS = 70
"""About as many of these calls there are in one replacement."""
MINE = {"NOTES.md": "mine", "gray/thoughts.txt": "mine too", "mydata/x.csv": "1,2"}


class Place:
    """A result with files of the user's in it."""

    def __init__(self, folder: Path) -> None:
        self.out = folder / "n"
        self.seed = 0
        self.run()
        for name, text in MINE.items():
            (self.out / name).parent.mkdir(exist_ok=True)
            (self.out / name).write_text(text)
        self.mine = {name: self._state(name) for name in MINE}

    def command(self, seed: int) -> list[str]:
        return [sys.executable, "-m", "rangesim", *RUN, "--seed", str(seed), "--out", str(self.out)]

    def run(self) -> float:
        """Replace the result in peace; seconds."""
        start = time.monotonic()
        done = subprocess.run(self.command(self.seed + 1), check=False, capture_output=True, timeout=120)
        if done.returncode:
            raise RuntimeError(f"a run in peace ended with status {done.returncode}: {done.stderr.decode()[-2000:]}")
        self.seed += 1
        return time.monotonic() - start

    def _state(self, name: str) -> tuple[object, ...]:
        stat = (self.out / name).stat()
        return (self.out / name).read_text(), stat.st_ino, stat.st_mtime_ns, stat.st_ctime_ns

    def failures(self, attempted: int) -> list[str]:
        """What is wrong after a run with seed `attempted` came to an end; sets `seed` to that of what is there."""
        found = [f"touched {name}" for name in MINE if self._state(name) != self.mine[name]]
        try:
            verification = verify_directory(self.out, RESULT)
            there = read_settings(self.out).experiment["seed"]
        except FileFormatError as error:
            return [*found, str(error)]
        if verification.missing or verification.changed:
            found.append(f"torn: {verification}")
        if there not in (self.seed, attempted):
            found.append(f"seed {there}, expected {self.seed} or {attempted}")
        self.seed = there
        return found

    def litter(self) -> list[str]:
        """What lies there beside the result and the user's files, within and around it."""
        foreign = set(verify_directory(self.out, RESULT).foreign) - set(MINE)
        return [
            *foreign,
            *(p.name for p in self.out.rglob(".*")),
            *(p.name for p in self.out.parent.iterdir() if p != self.out),
        ]


def killed(place: Place, attempted: int, rng: random.Random, usual_s: float) -> str:
    """Start a run and end it; how."""
    if rng.random() < 0.5:
        line = place.command(attempted)
        line[1:3] = ["-c", KILL_AT_CALL, str(rng.randrange(CALLS))]
        done = subprocess.run(line, capture_output=True, check=False, timeout=120)
        return "at a call" if done.returncode == -signal.SIGKILL else "not killed"
    number = rng.choice([signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
    with subprocess.Popen(place.command(attempted), stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        time.sleep(rng.uniform(0.03, 1.02 * usual_s))
        process.send_signal(number)
        _, err = process.communicate(timeout=60)
    if process.returncode == 0:
        return "not killed"
    if process.returncode == -number and not err:  # by SIGKILL; else the interpreter had not yet come to our code
        return signal.Signals(number).name
    if process.returncode == 128 + number and err.count(b"\n") == 1:
        return signal.Signals(number).name
    return f"{signal.Signals(number).name}: status {process.returncode}, {err!r}"


def full(place: Place, attempted: int, rng: random.Random, tmpfs: bool) -> str:
    """Start a run whose disk fills; how it ended."""
    size = int(10 ** rng.uniform(2, 6))

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

    if tmpfs:
        state = os.statvfs(place.out.parent)
        used = (state.f_blocks - state.f_bfree) * state.f_frsize
        _mount(place.out.parent, "remount,", used // 1024 + rng.randrange(40, 1200))
    done = subprocess.run(
        place.command(attempted), capture_output=True, check=False, timeout=120, preexec_fn=None if tmpfs else limit
    )
    if tmpfs:
        _mount(place.out.parent, "remount,", 64 << 10)
    if done.returncode == 0:
        return "fitted"
    said = [line for line in done.stderr.splitlines() if not line.startswith(b"jit_kernel_write")]  # Dr.Jit's own cache
    return "refused" if done.returncode == 1 and len(said) == 1 else f"status {done.returncode}, {done.stderr!r}"


def _mount(folder: Path, option: str, kilobytes: int) -> None:
    source = [] if option else ["-t", "tmpfs"]
    subprocess.run(["mount", *source, "-o", f"{option}size={kilobytes}k", "tmpfs", str(folder)], check=True)


def trial(name: str, count: int, place: Place, attempt: Callable[[int], str], known: set[str]) -> int:
    """Attempts, each checked, until `count` of them met a kill or a full disk; the number of failures."""
    ends: Counter[str] = Counter()
    failures = number = 0
    while sum(n for how, n in ends.items() if how not in HARMLESS) < count:
        number += 1
        attempted = place.seed + 1000
        how = attempt(attempted)
        ends[how] += 1
        wrong = place.failures(attempted) + ([] if how in known else [how])
        if number % 5 == 0:
            try:
                place.run()
            except RuntimeError as error:
                wrong.append(str(error))
            wrong += [f"litter: {found}" for found in place.litter()] + place.failures(place.seed)
        failures += bool(wrong)
        for sentence in wrong:
            print(f"{name} {number}, {how}: {sentence}")
    print(name, dict(ends), "failures:", failures, flush=True)
    return failures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--disks", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rng = random.Random(options.seed)
    folder = Path(tempfile.mkdtemp(prefix="crash-safety-"))
    as_root = os.geteuid() == 0
    small = folder / "tmpfs"
    small.mkdir()
    (folder / "disk").mkdir()
    result: dict[str, int] = {}
    try:
        place = Place(folder / "disk")
        usual_s = place.run()
        wrong = trial("kills", options.kills, place, lambda seed: killed(place, seed, rng, usual_s),
                            {"at a call", "not killed", "SIGKILL", "SIGTERM", "SIGINT"})  # fmt: skip
        result |= {"kills": options.kills, "kill_failures": wrong}
        half = options.disks // 2 if as_root else options.disks
        wrong = trial("full disk (file size)", half, place, lambda seed: full(place, seed, rng, False),
                            {"fitted", "refused"})  # fmt: skip
        result |= {"full_disks": half, "full_disk_failures": wrong}
        if as_root:
            _mount(small, "", 64 << 10)
            on_tmpfs = Place(small)
            wrong = trial("full disk (tmpfs)", options.disks - half, on_tmpfs,
                                lambda seed: full(on_tmpfs, seed, rng, True), {"fitted", "refused"})  # fmt: skip
            result["full_disks"] += options.disks - half
            result["full_disk_failures"] += wrong
    finally:
        if os.path.ismount(small):
            subprocess.run(["umount", str(small)], check=True)
        shutil.rmtree(folder)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
