"""Headless Chromium over the WebDriver protocol (https://www.w3.org/TR/webdriver2/), with
nothing but the standard library."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--window-size=1400,1100",
)


def missing() -> str | None:
    """What this machine lacks to run a browser test; None when nothing."""
    absent = [name for name in ("chromium", "chromedriver") if shutil.which(name) is None]
    return f"no {' and no '.join(absent)} (Debian: apt-get install chromium chromium-driver)" if absent else None


class Browser:
    """One window. ``with Browser(folder) as b: b.open(url); b.text("#probe")``; folder:
    empty, for the profile and logs."""

    def __init__(self, folder: Path):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self._base = f"http://127.0.0.1:{port}"
        self._log = (folder / "chromedriver.log").open("wb")
        self._driver = subprocess.Popen(["chromedriver", f"--port={port}"], stdout=self._log, stderr=self._log)
        try:
            self._until(lambda: self._call("GET", "/status")["ready"], 20)
            options = {"binary": shutil.which("chromium"), "args": [*FLAGS, f"--user-data-dir={folder / 'profile'}"]}
            answer = self._call(
                "POST",
                "/session",
                {"capabilities": {"alwaysMatch": {"browserName": "chrome", "goog:chromeOptions": options}}},
            )
            self._session = f"/session/{answer['sessionId']}"
        except BaseException:
            self._end()
            raise

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *exc: object) -> None:
        try:
            self._call("DELETE", self._session)
        finally:
            self._end()

    def _end(self) -> None:
        self._driver.terminate()
        self._driver.wait(10)
        self._log.close()

    def _call(self, method: str, path: str, body: dict | None = None) -> Any:
        data = None if method != "POST" else json.dumps(body or {}).encode()
        request = urllib.request.Request(self._base + path, data, {"Content-Type": "application/json"}, method=method)
        try:
            with urllib.request.urlopen(request, timeout=60) as answer:
                return json.load(answer)["value"]
        except urllib.error.HTTPError as error:
            raise RuntimeError(json.load(error)["value"]["message"]) from None

    @staticmethod
    def _until(condition, timeout: float) -> Any:
        end = time.monotonic() + timeout
        while True:
            try:
                if value := condition():
                    return value
            except (RuntimeError, OSError):
                if time.monotonic() > end:
                    raise
            if time.monotonic() > end:
                raise TimeoutError("the page did not get there in time")
            time.sleep(0.05)

    def open(self, url: str) -> None:
        self._call("POST", self._session + "/url", {"url": url})

    def run(self, script: str, *arguments: Any) -> Any:
        """The value that a JavaScript function body returns."""
        return self._call("POST", self._session + "/execute/sync", {"script": script, "args": list(arguments)})

    def wait(self, script: str, *arguments: Any, timeout: float = 20) -> Any:
        """The first true value of :meth:`run`."""
        return self._until(lambda: self.run(script, *arguments), timeout)

    def text(self, selector: str) -> str:
        return self.run(
            "const e = document.querySelector(arguments[0]); return e && !e.hidden ? e.textContent : ''", selector
        )

    def click_at(self, selector: str, fx: float, fy: float) -> None:
        """A real mouse click at a fraction of an element's width and height."""
        x, y = self.run(
            "const e = document.querySelector(arguments[0]); e.scrollIntoView({block: 'nearest'}); const r = "
            "e.getBoundingClientRect();return [r.left + arguments[1] * r.width, r.top + arguments[2] * r.height]",
            selector,
            fx,
            fy,
        )
        move = {"type": "pointerMove", "duration": 0, "origin": "viewport", "x": round(x), "y": round(y)}
        mouse = {
            "type": "pointer",
            "id": "mouse",
            "actions": [move, {"type": "pointerDown", "button": 0}, {"type": "pointerUp", "button": 0}],
        }
        self._call("POST", self._session + "/actions", {"actions": [mouse]})

    def choose(self, selector: str, value: str) -> None:
        """Sets a control as a person does: its value, then the events."""
        self.run(
            "const e = document.querySelector(arguments[0]); e.value = arguments[1];"
            "for (const kind of ['input', 'change']) e.dispatchEvent(new Event(kind, {bubbles: true}))",
            selector,
            value,
        )

    def errors(self) -> list[str]:
        """Messages of the browser's console at level SEVERE."""
        return [
            entry["message"]
            for entry in self._call("POST", self._session + "/se/log", {"type": "browser"})
            if entry["level"] == "SEVERE"
        ]
