# SPDX-License-Identifier: Apache-2.0
"""A page in headless Chromium, driven over the DevTools protocol: real mouse, every message, no further package."""

from __future__ import annotations

import base64
import json
import os
import select
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rangesim.environment.doctor import find_browser

BROWSER = find_browser()
QUIET = ("disable-background-networking", "disable-component-update", "disable-sync", "no-first-run", "no-sandbox")
OPTIONS = (*QUIET, "disable-gpu", "use-angle=swiftshader", "enable-unsafe-swiftshader", "hide-scrollbars")
WITHOUT_WEBGL = (*QUIET, "disable-gpu", "disable-3d-apis", "hide-scrollbars")
WATCH = """
window.violations = [];
addEventListener("securitypolicyviolation", (e) => violations.push(`${e.effectiveDirective} ${e.blockedURI}`));
"""
LAUNCHER = """
import os, sys
from fcntl import F_DUPFD, fcntl
commands, answers = (fcntl(int(end), F_DUPFD, 10) for end in sys.argv[1:3])
os.dup2(commands, 3)
os.dup2(answers, 4)
os.execv(sys.argv[3], sys.argv[3:])
"""
"""The browser reads commands from descriptor 3 and answers on 4."""


class Page:
    """One page. `said` holds what the browser reported of it: console messages, exceptions, refusals."""

    def __init__(self, commands: int, answers: int) -> None:
        self._commands, self._answers, self._buffer, self._last = commands, answers, b"", 0
        self._session: str | None = None
        self.said: list[str] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")
        self.call("Page.addScriptToEvaluateOnNewDocument", source=WATCH)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """What the browser answers to a command of the protocol."""
        self._last += 1
        command = {"id": self._last, "method": method, "params": parameters}
        if self._session:
            command["sessionId"] = self._session
        os.write(self._commands, json.dumps(command).encode() + b"\0")
        while True:
            message = self._read()
            if message.get("id") == self._last:
                assert "error" not in message, f"{method}: {message['error']}"
                return dict(message["result"])
            self._note(message)

    def open(self, path: Path, state: str = "") -> None:
        """Load a report and wait until it has drawn itself; what was said before is forgotten."""
        self.call("Page.navigate", url="about:blank")  # a change of the state alone would load nothing
        self.said.clear()
        self.call("Page.navigate", url=f"{path.resolve().as_uri()}#{state}")
        self.wait_for("document.readyState === 'complete' && document.documentElement.dataset.ready === 'yes'")

    def wait_for(self, condition: str, seconds: float = 30.0) -> None:
        """Return when a JavaScript expression is true."""
        end = time.monotonic() + seconds
        while not self.evaluate(condition):
            assert time.monotonic() < end, f"{condition} did not come true; the page said {self.said}"
            time.sleep(0.05)

    def evaluate(self, expression: str) -> Any:
        """The value of a JavaScript expression in the page."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]["exception"]["description"]
        return answer["result"].get("value")

    def place(self, selector: str, x: float = 0.5, y: float = 0.5) -> tuple[float, float]:
        """Pixels of the window, a place within the first element of a selector, which is scrolled into view."""
        code = f"""(() => {{ const e = document.querySelector({json.dumps(selector)});
            e.scrollIntoView({{ block: "center", behavior: "instant" }});
            const b = e.getBoundingClientRect(); return [b.left + {x} * b.width, b.top + {y} * b.height]; }})()"""
        left, top = self.evaluate(code)
        return left, top

    def mouse(self, kind: str, at: tuple[float, float], **more: Any) -> None:
        """Move, press or release the mouse, or turn its wheel."""
        self.call("Input.dispatchMouseEvent", type=kind, x=at[0], y=at[1], **more)

    def click(self, selector: str, x: float = 0.5, y: float = 0.5) -> None:
        """Click on a place within an element."""
        at = self.place(selector, x, y)
        for kind in ("mousePressed", "mouseReleased"):
            self.mouse(kind, at, button="left", clickCount=1)

    def drag(self, selector: str, dx: float) -> None:
        """Press in the middle of an element, move to the right and let go."""
        x, y = self.place(selector)
        self.mouse("mousePressed", (x, y), button="left", clickCount=1)
        self.mouse("mouseMoved", (x + dx, y), button="left", buttons=1)
        self.mouse("mouseReleased", (x + dx, y), button="left", clickCount=1)

    def screenshot(self, path: Path) -> None:
        """Write a picture of the window as PNG."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))

    def _read(self) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            assert select.select([self._answers], [], [], 120.0)[0], "the browser has not answered for two minutes"
            part = os.read(self._answers, 1 << 20)
            assert part, "the browser has ended"
            self._buffer += part
        message, _, self._buffer = self._buffer.partition(b"\0")
        return dict(json.loads(message))

    def _note(self, message: dict[str, Any]) -> None:
        what = message.get("params", {})
        if message.get("method") == "Runtime.consoleAPICalled":
            self.said.append(" ".join(str(a.get("value", a.get("description"))) for a in what["args"]))
        elif message.get("method") == "Runtime.exceptionThrown":
            details = what["exceptionDetails"]
            self.said.append(details.get("exception", {}).get("description", details["text"]))
        elif message.get("method") == "Log.entryAdded" and "GL Driver Message" not in what["entry"]["text"]:
            self.said.append(what["entry"]["text"])  # the driver remarks on the speed of software rendering


@contextmanager
def browser(folder: Path, options: tuple[str, ...] = OPTIONS) -> Iterator[Page]:
    """A page in a browser of its own, whose profile is in `folder`; it ends with the block."""
    assert BROWSER is not None
    theirs_in, commands = os.pipe()
    answers, theirs_out = os.pipe()
    command = [sys.executable, "-c", LAUNCHER, str(theirs_in), str(theirs_out), BROWSER]
    command += ["--headless", "--remote-debugging-pipe"]
    command += [*(f"--{o}" for o in options), f"--user-data-dir={folder / 'profile'}", "--window-size=1280,1000"]
    with (folder / "browser.log").open("w") as log:
        process = subprocess.Popen(command, pass_fds=(theirs_in, theirs_out), stdout=log, stderr=log)
        os.close(theirs_in)
        os.close(theirs_out)
        try:
            yield Page(commands, answers)
        finally:
            os.close(commands)  # at which it ends
            os.close(answers)
            try:
                process.wait(timeout=20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
