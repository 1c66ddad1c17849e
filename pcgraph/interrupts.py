# SPDX-License-Identifier: Apache-2.0
"""SIGINT and SIGTERM end a command with one line, whatever it is doing.

Python runs its handlers between two bytecodes of the main thread, and handlers that raise can be swallowed: by an
import half done, by a compiler that calls back, by a destructor. So the handlers here do nothing, and a thread that
waits for the signal's number on a pipe (`signal.set_wakeup_fd`) ends the process: also while the main thread is busy in
compiled code that has let go of the interpreter.

Only the standard library is imported, so that this can come before every other import.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading

SIGNALS = (signal.SIGINT, signal.SIGTERM)


def end_on_signals(program: str, writes: bool) -> None:
    """Let SIGINT and SIGTERM remove work in progress, print one line, and end with status 130 or 143.

    Parameters
    ----------
    program : begins the line. writes : whether the command writes files, so that the line says what became of them.
    """
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:  # nohup and the like
            signal.signal(number, lambda *_: None)
    threading.Thread(target=_wait, args=(reader, program, writes), name="interrupts", daemon=True).start()


def _wait(reader: int, program: str, writes: bool) -> None:
    while True:
        number = os.read(reader, 1)[0]
        if number in SIGNALS:
            _end(number, program, writes)


def _end(number: int, program: str, writes: bool) -> None:
    output = sys.modules.get("pcgraph.output")  # not loaded: nothing was begun
    began = bool(output.abandon()) if output is not None and hasattr(output, "abandon") else False
    done = output is not None and getattr(output, "completed", 0) > 0
    text = "; nothing was written" if writes and (began or not done) else ""
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.flush()
    clear = "\r\x1b[2K\x1b[?25h" if os.isatty(2) else ""  # a progress bar hides the cursor
    with contextlib.suppress(OSError):
        os.write(2, f"{clear}{program}: interrupted{text}.\n".encode())
    os._exit(128 + number)
