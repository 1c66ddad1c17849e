# SPDX-License-Identifier: Apache-2.0
"""The process in which readers run: reads requests as JSON lines, answers with what became of each.

Run as ``python -m fuzz.worker``; `fuzz.campaign.Watch` starts, watches and ends it. Imports are paid once, and the
memory that one case may take is limited to 1 GB beyond what the process holds when the case starts.
"""

from __future__ import annotations

import base64
import faulthandler
import gc
import json
import os
import pickle
import re
import resource
import sys
import tempfile
import time
import traceback
import warnings
from dataclasses import asdict, dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from fuzz.inputs import Input, clear
from fuzz.readers import READERS, SELF_TEST, Cases, Reader

LIMIT_S = 5.0
"""No answer may come later."""
LIMIT_BYTES = 1 << 30
"""Memory that one answer may take beyond what the process held before."""
MAX_MESSAGE = 500
"""Characters of a refusal, without the path."""
ROOT = Path(__file__).resolve().parents[2]
KNOWN = {**READERS, SELF_TEST.name: SELF_TEST}
PACKAGES = (f"{ROOT}/rangesim/", f"{ROOT}/pcgraph/")


@dataclass(frozen=True)
class Answer:
    """What became of one input.

    outcome : accepted, refused or failed.
    kind : of a failure: exception, message, warning, output, leak, result, late, crash, memory, accepted.
    error : type of the exception. place : innermost line of the packages. message : text of the exception.
    seconds : wall-clock time. peak_mb : memory beyond what the process held before.
    """

    outcome: str
    kind: str = ""
    error: str = ""
    place: str = ""
    message: str = ""
    seconds: float = 0.0
    peak_mb: float = 0.0

    @property
    def group(self) -> tuple[str, str, str]:
        """Failures of one group are one fault."""
        return self.kind, self.error, self.place


class Worker:
    """Folders, captured output and seeds of this process."""

    def __init__(self, folder: Path, seeds: dict[str, dict[str, Input]], limit_s: float) -> None:
        self.inputs, self.temporary = folder / "case", folder / "tmp"
        self.inputs.mkdir(exist_ok=True)
        self.temporary.mkdir(exist_ok=True)
        tempfile.tempdir = str(self.temporary)
        os.environ["TMPDIR"] = str(self.temporary)
        self.output = open(folder / "output", "w+b", buffering=0)  # noqa: SIM115 - lives as long as the process
        os.dup2(self.output.fileno(), 1)
        os.dup2(self.output.fileno(), 2)
        # Where a crash or a hang happened is read by who watches.
        self.trace = open(folder / "trace", "w+b", buffering=0)  # noqa: SIM115
        faulthandler.enable(self.trace)
        self.seeds = seeds
        self.limit_s = limit_s
        self.cases: dict[str, Cases] = {}

    def cases_of(self, name: str) -> Cases:
        """The inputs of a reader."""
        if name not in self.cases:
            self.cases[name] = Cases(KNOWN[name], self.seeds[name])
        return self.cases[name]

    def answer(self, request: dict[str, Any]) -> Answer:
        """Read one input and judge what came of it."""
        reader = KNOWN[request["reader"]]
        if "input" in request:
            one = pickle.loads(base64.b64decode(request["input"]))
        else:
            one = self.cases_of(reader.name)(request["seed"], request["case"])
        return self.judge(reader, one)

    def read_seeds(self, name: str) -> None:
        """Read the seeds of a reader: what is imported, compiled and cached once is not charged to a case."""
        for seed in self.seeds[name].values():
            self.judge(KNOWN[name], seed, limited=False)

    def judge(self, reader: Reader, one: Input, limited: bool = True) -> Answer:
        """The answer to one input; leaves no trace of it."""
        os.chdir(self.inputs.parent)
        clear(self.inputs)
        clear(self.temporary)
        path = one.write(self.inputs)
        os.chdir(self.inputs)
        before = {str(p) for p in self.inputs.rglob("*")}
        files_before = _open_files()
        size, held = _memory()
        self.output.truncate(0)
        self.output.seek(0)
        self.trace.truncate(0)
        self.trace.seek(0)
        places = {"{entry}": str(path), "{out}": str(self.inputs / "out")}
        arguments = tuple(places.get(word, word) for word in one.arguments)
        if limited:
            _limit(size + LIMIT_BYTES)
            faulthandler.dump_traceback_later(0.9 * self.limit_s, file=self.trace)
        seen: list[warnings.WarningMessage] = []
        start = time.perf_counter()
        try:
            with warnings.catch_warnings(record=True) as seen:
                warnings.simplefilter("always")
                found = _call(reader, path, arguments)
        finally:
            seconds = time.perf_counter() - start
            faulthandler.cancel_dump_traceback_later()
            _limit(resource.RLIM_INFINITY)
        peak_mb = max(0.0, (_peak() - held) / 2**20)
        fault = found if found.outcome == "failed" else None
        fault = fault or self._said(reader, found, path, one) or _warned(seen)
        fault = fault or self._left(reader, before, files_before)
        if fault is None and limited and seconds > self.limit_s:
            fault = Answer("failed", "late", found.error, found.place, found.message)
        return Answer(**(asdict(fault or found) | {"seconds": seconds, "peak_mb": peak_mb}))

    def _said(self, reader: Reader, found: Answer, path: Path, one: Input) -> Answer | None:
        """A failure if the reader printed what it should not, or its refusal is not one sentence about the file."""
        self.output.seek(0)
        text = self.output.read().decode("utf-8", "replace")
        if not reader.command and text:
            return Answer("failed", "output", found.error, _pattern(text, path), text[:2000])
        if found.outcome == "refused":
            message = found.message
            if reader.command:
                if found.error == "2":
                    return None  # a usage message of several lines
                message = text.removesuffix("\n")
                if reader.lists:
                    message = message.rpartition("\n")[2]
                if not message.startswith(f"{reader.command}: "):
                    return Answer("failed", "message", "exit 1", "no line of ours", text[:2000])
            problem = _fault_of_message(message, path, one, reader.names_file, bool(reader.command))
            if problem:
                return Answer("failed", "message", f"{found.error}: {problem}", found.place, message[:2000])
        elif reader.command and "Traceback" in text:
            return Answer("failed", "output", found.error, "traceback", text[-2000:])
        return None

    def _left(self, reader: Reader, before: set[str], files_before: int) -> Answer | None:
        """A failure if files are left open, or left behind."""
        if _open_files() > files_before:
            gc.collect()
            if _open_files() > files_before:
                opened = [os.readlink(f"/proc/self/fd/{fd}") for fd in os.listdir("/proc/self/fd") if _is_link(fd)]
                return Answer("failed", "leak", "open file", "", " ".join(sorted(opened))[-500:])
        if left := [p.name for p in self.temporary.iterdir()]:
            return Answer("failed", "leak", "temporary file", "", " ".join(left)[:500])
        after = {str(p) for p in self.inputs.rglob("*")}
        relative = (p.removeprefix(f"{self.inputs}/") for p in after - before)
        strange = [p for p in relative if not any(fnmatch(p, pattern) for pattern in reader.may_write)]
        if strange or (before - after and not reader.may_write):
            return Answer("failed", "leak", "file", "", " ".join(strange)[:500])
        return None


def _call(reader: Reader, path: Path, arguments: tuple[str, ...]) -> Answer:
    """The answer of a reader, without a look at what it printed or left."""
    if reader.command:
        sys.argv = [reader.command, *arguments]
    try:
        result = reader.read(path, arguments)
    except SystemExit as end:
        if reader.command and end.code in (0, 1, 2, None):
            return Answer("refused" if end.code else "accepted", "", str(end.code or 0), _place(end))
        return Answer("failed", "exception", "SystemExit", _place(end), str(end))
    except BaseException as error:  # noqa: BLE001 - whatever it is, it is judged and written down
        kind, place = type(error).__name__, _place(error)
        if _is_refusal(error, reader):
            return Answer("refused", "", kind, place, str(error))
        return Answer("failed", "exception", kind, place, str(error)[:2000])
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
    try:
        reader.check(result)
    except Exception as error:  # noqa: BLE001 - likewise
        place = traceback.extract_tb(error.__traceback__)[-1]
        return Answer(
            "failed", "result", type(error).__name__, f"{Path(place.filename).name}: {place.line}", str(error)[:2000]
        )
    return Answer("accepted")


def _is_refusal(error: BaseException, reader: Reader) -> bool:
    """Whether an exception is one by which this reader refuses; a subclass of ValueError is not: that one escaped."""
    kinds = {kind.__name__ for kind in type(error).__mro__}
    if type(error) is not ValueError:
        kinds.discard("ValueError")
    return not reader.command and bool(kinds & set(reader.refuses))


def _fault_of_message(message: str, path: Path, one: Input, names_file: bool, command: bool) -> str:
    """What is wrong with a refusal, or nothing."""
    names = {str(path), path.name, *(name.rpartition("/")[2] for name in one.files)} - {""}
    about_file = any(name in message or repr(name)[1:-1] in message for name in names)
    if command:
        about_file |= any(" ".join(name.split()) in message for name in names)
    else:  # a path is the user's own; a command line must print it harmlessly all the same
        for name in sorted(names, key=len, reverse=True):
            message = message.replace(name, "FILE")
    if not message.strip():
        return "empty"
    if not message.isprintable():
        return "not one printable line"
    if "Traceback (most recent" in message:
        return "holds a traceback"
    if len(message) > MAX_MESSAGE + (len(str(path)) if command else 0):
        return f"longer than {MAX_MESSAGE} characters"
    return "" if about_file or not names_file else "does not name the file"


def _is_ours(category: type[Warning]) -> bool:
    """Whether a warning is a sentence of rangesim's, which is not imported here."""
    return any(kind.__name__ == "RangesimWarning" for kind in category.__mro__)


def _warned(seen: list[warnings.WarningMessage]) -> Answer | None:
    """A failure if something warned: a reader accepts or refuses."""
    for one in seen:
        if issubclass(one.category, DeprecationWarning) or _is_ours(one.category):
            continue
        return Answer(
            "failed", "warning", one.category.__name__, _short(one.filename, one.lineno), str(one.message)[:500]
        )
    return None


def _place(error: BaseException) -> str:
    """Innermost line of the packages in a traceback."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [f for f in frames if f.filename.startswith(PACKAGES)]
    last = (own or list(frames))[-1]
    return _short(last.filename, last.lineno or 0)


def _short(filename: str, line: int) -> str:
    name = filename.removeprefix(f"{ROOT}/").rpartition("site-packages/")[2]
    return f"{name}:{line}"


def _pattern(text: str, path: Path) -> str:
    """What the first line of a text has in common with others of its kind: an error code, or two words."""
    line = next((line.strip() for line in text.replace(str(path), "FILE").splitlines() if line.strip()), "")
    code = re.search(r"\b[A-Z]+_ERR_[A-Z_]+\b", line)
    return code[0] if code else " ".join(re.findall(r"[A-Za-z_]+", line)[:2])


def _open_files() -> int:
    return len(os.listdir("/proc/self/fd"))


def _is_link(fd: str) -> bool:
    return os.path.lexists(f"/proc/self/fd/{fd}")


def _memory() -> tuple[int, int]:
    """Bytes of the address space and of memory held; resets the peak."""
    with open("/proc/self/clear_refs", "w") as file:
        file.write("5")
    size, held = Path("/proc/self/statm").read_text().split()[:2]
    return int(size) * resource.getpagesize(), int(held) * resource.getpagesize()


def _peak() -> int:
    """Largest memory held since `_memory`, bytes."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM"):
            return int(line.split()[1]) * 1024
    return 0


def _limit(n_bytes: int) -> None:
    """Limit the address space of this process; it may be raised again."""
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (n_bytes, hard))


def main() -> None:
    """Serve requests until the input ends."""
    folder = Path(sys.argv[1])
    requests, answers = os.fdopen(os.dup(0), "r"), os.fdopen(os.dup(1), "w")
    with open(os.devnull) as nothing:
        os.dup2(nothing.fileno(), 0)
    from rangesim.environment.llvm import ensure_llvm

    ensure_llvm()
    store = Path(sys.argv[2])
    if not store.exists():
        made = {name: reader.seeds() for name, reader in KNOWN.items()}
        partial = store.with_suffix(".part")
        partial.write_bytes(pickle.dumps(made))
        partial.rename(store)
    worker = Worker(folder, pickle.loads(store.read_bytes()), float(sys.argv[3]))
    answers.write("ready\n")
    answers.flush()
    for line in requests:
        request = json.loads(line)
        if "warm" in request:
            worker.read_seeds(request["warm"])
            answers.write("warm\n")
        else:
            answers.write(json.dumps(asdict(worker.answer(request))) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
