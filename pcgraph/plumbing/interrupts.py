# SPDX-License-Identifier: Apache-2.0
"""Ending a command on SIGINT, SIGTERM or SIGHUP, with one line of text, whatever the command is doing.

Python runs signal handlers between two bytecodes of the main thread. An exception that a handler raises can be
swallowed by an unfinished import, a compiler that calls back, or a destructor. So the handlers here do nothing. A
thread waits for the signal's number on a pipe (`signal.set_wakeup_fd`) and ends the process, also while the main thread
runs compiled code that has released the interpreter lock.

A process whose work is done exits at once. Python's own shutdown takes up to half a second with large libraries, and
removes the handlers first, so a signal during the shutdown would kill the process without a message.

This module imports only the standard library, so that it can come before every other import.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator

handled = False
"""Whether a thread of this module ends the process on a signal."""
removers: list[Callable[[], bool]] = []
"""Functions that remove work in progress, called before the process ends, the last one first. Each returns whether
there was any."""
endings: list[Callable[[], str]] = []
"""Functions that return what the last line says after "interrupted", in place of what it says of files."""
LOST_OUTPUT = 120
"""Exit status of a command whose last output could not be written: 120, as in Python itself."""
SIGNALS = (signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else []))
"""Signals that end a command. Windows has no SIGHUP."""


def end_on_signals(program: str, writes: bool) -> None:
    """Make signals remove work in progress, print one line, and end the process with status 130, 143 or 129.

    Parameters
    ----------
    program : str
        Name at the beginning of the line.
    writes : bool
        Whether the command writes files. If so, the line says what became of them.
    """
    _open_standard_streams()
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:  # nohup and the like
            signal.signal(number, lambda *_: None)
    atexit.register(_leave)  # registered first, so that it is called last
    global handled
    handled = True
    threading.Thread(target=_wait, args=(reader, os.dup(2), program, writes), name="interrupts", daemon=True).start()


def _open_standard_streams() -> None:
    """Open the standard streams that the parent has closed (`>&-`).

    Otherwise a file that is opened later gets the number of a stream, and libraries print into the file.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    if sys.stdout is None:
        sys.stdout = os.fdopen(1, "w", closefd=False)
    if sys.stderr is None:
        sys.stderr = os.fdopen(2, "w", closefd=False)


def run(command: Callable[[], None]) -> None:
    """Run a command, the last work of the process, and keep its exit status for the end of the process."""
    global _status
    try:
        command()
        _status = 0
    except SystemExit as end:
        if end.code is None or isinstance(end.code, int):  # else Python prints it
            _status = end.code or 0
        raise


_ending = threading.Event()
_end_lock = threading.Lock()
"""The lock of the thread that ends the process: the one that waits for signals, or the main thread."""
_status: int | None = None
"""Exit status of the process after its command has ended; None before, and after an error that Python has to print."""
_written = 0
"""Count of the files and directories that this process has written, so that the last line can say if there are none."""


def count() -> None:
    """Count a file or a directory that has been written."""
    global _written
    _written += 1


@contextlib.contextmanager
def last_words(text: Callable[[], str]) -> Iterator[None]:
    """Let the last line say what a function returns, if a signal ends the process while the block runs."""
    endings.append(text)
    try:
        yield
    finally:
        endings.remove(text)


@contextlib.contextmanager
def holding(lock: threading.RLock) -> Iterator[None]:
    """Hold a lock; never release it if the process is about to end, so that no other thread begins new work."""
    lock.acquire()
    try:
        yield
    finally:
        if not _ending.is_set():
            lock.release()


def _leave() -> None:
    """End the process if its command has ended and no signal has come; wait if one has.

    All other functions registered with `atexit` have run by now. The main thread of an interrupted command fails,
    because its work is removed; it must not end the process with an error of its own.
    """
    status = _status
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):  # the reader has closed the pipe, or the disk is full
            status = status or LOST_OUTPUT
    with _end_lock:
        if status is not None and not _ending.is_set():
            os._exit(status & 0xFF)
    while _ending.is_set():
        time.sleep(1.0)


def _wait(reader: int, screen: int, program: str, writes: bool) -> None:
    """Wait for the numbers of signals on a pipe, and end the process on one of `SIGNALS`."""
    while True:
        number = os.read(reader, 1)[0]
        if number in SIGNALS:
            _end(number, screen, program, writes)


def _end(number: int, screen: int, program: str, writes: bool) -> None:
    """End the process; `screen` is the stderr of the start, since libraries may be kept quiet by another one."""
    with _end_lock:
        _ending.set()
    try:
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
        clear = "\r\x1b[2K\x1b[?25h" if os.isatty(screen) else ""  # a progress bar may have hidden the cursor
        _silence_others()
        began = sum(remove() for remove in reversed(removers))
        text = "; nothing was written" if writes and (began or not _written) else ""
        text = f"; {endings[-1]()}" if endings else text
        with contextlib.suppress(OSError):
            os.write(screen, f"{clear}{program}: interrupted{text}.\n".encode())
    finally:
        os._exit(128 + number)


def _silence_others() -> None:
    """Discard all further output, because the main thread may fail, as its work is removed, and print an error."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
