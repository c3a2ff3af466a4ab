"""Blender as a process: its interpreter, its input, and its end.

    with Blender(PROGRAM, folder, limit_s=600) as blender:
        for words in blender.answers():      # dict per line of JSON on the program's standard output
            ...

The program gets the folder's path as its argument and a separate environment: no preferences, add-ons or scripts of the
user's Blender, no ``PYTHON*``, no OpenGL settings of this process. It ends with the ``with``, also after an
exception.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from blinkgl.errors import BlinkGLError
from blinkgl.machine.closing import Closing
from blinkgl.types.trees import Tree

ENVIRONMENT = "BLINKGL_BPY_PYTHON"
REMEDY = (
    "run pip install 'bpy>=4.5,<4.6' with Python 3.11, best in an environment of its own, and name its interpreter "
    f"in {ENVIRONMENT} (or install it here)"
)
# Variables that Blender needs to find its libraries, a display and a card. Others are not passed on.
_HANDED_ON = ("PATH", "LANG", "LC_", "TZ", "DISPLAY", "WAYLAND_", "XAUTHORITY", "LD_LIBRARY_PATH", "SYSTEMROOT")
_CARDS = ("LIBGL_", "MESA_", "EGL_", "__EGL_", "GALLIUM_", "VK_", "CUDA_", "NVIDIA_", "HIP_")


def interpreter() -> str:
    """Return the Python that runs Blender: the environment's, or this one."""
    return os.environ.get(ENVIRONMENT) or sys.executable


def available() -> str:
    """Return '' if bpy is installed (without loading it, which takes seconds), otherwise a line that tells what to
    do."""
    chosen = interpreter()
    if chosen == sys.executable:
        there = importlib.util.find_spec("bpy") is not None
    else:
        probe = "import importlib.util, sys; sys.exit(importlib.util.find_spec('bpy') is None)"
        try:
            there = subprocess.run([chosen, "-c", probe], capture_output=True).returncode == 0
        except OSError:
            return f"{ENVIRONMENT} names no interpreter that runs: {chosen}"
    return "" if there else f"no bpy (Blender as a Python module) for {chosen}: {REMEDY}"


def require() -> None:
    """Raise BlinkGLError if there is no bpy."""
    if missing := available():
        raise BlinkGLError(missing)


def environment(home: Path) -> dict[str, str]:
    """Return the environment of Blender's process: ``home``, an empty folder, replaces all of the user's folders."""
    # Blender reads add-ons, scripts and presets wherever variables point it: only these are passed on.
    handed_on = {key: value for key, value in os.environ.items() if key.startswith(_HANDED_ON + _CARDS)}
    for key in ("HOME", "TMPDIR", "BLENDER_USER_RESOURCES", "XDG_CONFIG_HOME", "XDG_CACHE_HOME", "XDG_DATA_HOME"):
        handed_on[key] = str(home)
    return handed_on


class Blender(Closing):
    """One process that runs ``program`` (a file, or a folder with a __main__.py) with ``folder`` as its argument.

    limit_s : seconds that it may take in total; None: no limit.
    Raises BlinkGLError if there is no bpy; its answers raise it when Blender refuses, exceeds the limit, or stops.
    """

    def __init__(self, program: Path, folder: Path, limit_s: float | None = None):
        require()
        self.program, self.folder, self.limit_s = program, folder, limit_s
        self.doing = "starting"
        home = folder / "home"
        home.mkdir(exist_ok=True)
        self._log = open(folder / "blender.log", "w+b")  # noqa: SIM115 - as long as the process
        self._ends = None if limit_s is None else time.monotonic() + limit_s
        self._process = subprocess.Popen(
            [interpreter(), str(program), str(folder)],
            env=environment(home),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            start_new_session=True,  # so that one signal ends it with its children
        )

    def close(self) -> None:
        """End the process and its children."""
        # It may end between the question and the signal.
        if self._process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            with contextlib.suppress(BrokenPipeError):
                pipe.close()
        self._log.close()

    def tell(self, words: Tree) -> None:
        """Send a line of JSON to the program's standard input. That it has ended is said by its answers."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(words).encode() + b"\n")
            self._process.stdin.flush()

    def answers(self) -> Iterator[Tree]:
        """Yield each line's object, until the program closes its standard output. A ``{"doing": …}`` is stored for
        errors and yielded; an ``{"error": …, "accepted": …}`` is raised."""
        for line in self._lines():
            try:
                words = json.loads(line)
            except ValueError:
                raise BlinkGLError("Blender's output cannot be read", where=interpreter(), value=line[:80]) from None
            if "error" in words:
                raise BlinkGLError(
                    words["error"], where=words.get("where", interpreter()), accepted=words.get("accepted", REMEDY)
                )
            self.doing = words.get("doing", self.doing)
            yield words

    def status(self) -> int:
        """Return the exit status, after the answers have ended; negative: the number of the signal that ended it."""
        return self._process.wait()

    def last_words(self) -> str:
        """Return the last line that Blender printed."""
        self._log.flush()
        lines = (self.folder / "blender.log").read_text(errors="replace").strip().splitlines()
        return lines[-1].strip() if lines else "no message"

    def _lines(self) -> Iterator[str]:
        assert self._process.stdout is not None
        pipe, rest = self._process.stdout.fileno(), b""
        while True:
            # One limit for the whole import, not for each line.
            left = None if self._ends is None else max(self._ends - time.monotonic(), 0.0)
            if not select.select([pipe], [], [], left)[0]:
                raise BlinkGLError(
                    f"Blender did not finish within {self.limit_s:g} s (while {self.doing})",
                    accepted="a longer time limit",
                )
            data = os.read(pipe, 1 << 16)
            if not data:
                break
            *lines, rest = (rest + data).split(b"\n")
            yield from (line.decode("utf-8", "replace") for line in lines if line.strip())


def how_it_ended(status: int) -> str:
    """Return the text of an exit status: "stopped (status 3)", or "crashed (SIGSEGV)" for a negative one."""
    if status >= 0:
        return f"stopped (status {status})"
    try:
        return f"crashed ({signal.Signals(-status).name})"
    except ValueError:
        return f"crashed (signal {-status})"
