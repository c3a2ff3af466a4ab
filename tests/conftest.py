"""Fixtures shared by all tests."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import gc
import os
import resource
import signal
import sys
from pathlib import Path

import pytest
import typer.main

from blinkgl.machine import command_line, heartbeat, plugins


def pytest_configure(config: pytest.Config) -> None:
    # Under xdist there is one process per core already: more llvmpipe and numba threads would only fight over them.
    if os.environ.get("PYTEST_XDIST_WORKER"):
        os.environ.setdefault("LP_NUM_THREADS", "0")
    # Runs of the tests count as one build, although somebody may be editing the code while they are on. (From the
    # start: a process looks once.)
    os.environ["BLINKGL_BUILD"] = "tests"
    # A shell starts what runs in the background with Ctrl-C ignored, and tests send it.
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    # Of a few hundred processes that tests start each would compile BlinkGL's three hundred modules anew: a second.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False
    gc.disable()  # while test files are imported, which stay: a quarter of that time


def pytest_collection_finish() -> None:
    # Thousands of tests and their modules stay until the end: the collector looked at all of them again and again, for
    # a fifth of the suite's time. What tests make themselves is collected as ever.
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)
    gc.enable()


_STATM = Path("/proc/self/statm")
_GROWTH = 200 * 2**20 // resource.getpagesize()
_tidied = 0  # pages that the process had when its memory was last given back


def pytest_runtest_logfinish() -> None:
    """Give memory back when the process has grown: the collector counts objects, and a few in a circle hold large
    arrays and OpenGL's programs; and glibc keeps what is freed unless it is told to return it."""
    global _tidied
    pages = int(_STATM.read_text().split()[1]) if _STATM.is_file() else 0
    if pages > _tidied + _GROWTH:
        gc.collect()
        with contextlib.suppress(AttributeError):  # another C library
            ctypes.CDLL(None).malloc_trim(0)
        _tidied = int(_STATM.read_text().split()[1])


class _Lender:
    """One context for all that a test file runs in this process, as a worker has one for all its sequences. A context
    of its own for every run had its shaders compiled anew, which was more than what it drew."""

    WHERE = (
        "blinkgl.dataset.generate",
        "blinkgl.dataset.work",
        "blinkgl.dataset.deep",
        "blinkgl.sequence.simulate",
        "blinkgl.tools.trade.run",
    )

    def __init__(self):
        self.context, self.lent = None, False

    def create_context(self, backend: str = "auto", device: int = 0):
        from blinkgl.gl import create_context

        if self.lent or backend != "auto" or device:
            return create_context(backend, device)
        if self.context is None or self.context.lost:
            self.end()
            self.context = create_context()
            self.context.release = self._come_back  # what "with" and everybody else ends it by
        self.lent = True
        self.context.make_current()
        return self.context

    def _come_back(self):
        self.lent = False

    def end(self):
        if self.context is not None:
            del self.context.release
            self.context.release()
        self.context, self.lent = None, False


@pytest.fixture(scope="session", autouse=True)
def _no_line_that_depends_on_the_machine():
    """Which command of the tests is the first to need a kernel depends on their order, and which is at work for half a
    minute on what else the machine does; their errors do not."""
    command_line.announced_compiling = lambda say: contextlib.nullcontext()
    heartbeat.EVERY_S = 86_400.0


@pytest.fixture(scope="session", autouse=True)
def _command_lines_are_made_once():
    """A process has one command, but here thousands: typer would read the signatures of all commands anew for each, and
    BlinkGL look through the installed packages for plug-ins."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(typer.main, "get_command", functools.cache(typer.main.get_command))
        patch.setattr(plugins, "entry_points", functools.cache(plugins.entry_points))
        yield


@pytest.fixture(scope="module", autouse=True)
def _lent_context():
    lender = _Lender()
    with pytest.MonkeyPatch.context() as patch:
        for name in lender.WHERE:
            if name in sys.modules:
                patch.setattr(sys.modules[name], "create_context", lender.create_context)
        yield lender
    lender.end()


@pytest.fixture
def own_contexts(_lent_context):
    """For tests of when a context begins and ends."""
    _lent_context.lent = True
    yield
    _lent_context.lent = False


@pytest.fixture(scope="module")
def _gl_session():
    """A context per test file: what one file does to OpenGL's state (other contexts, OSMesa, threads) ends with it."""
    from blinkgl.gl import create_context

    with create_context() as context:
        yield context


@pytest.fixture
def gl(_gl_session):
    """The test file's GLContext, current and in moderngl's default state; no GL error before nor after the test."""
    _gl_session.make_current()
    ctx = _gl_session.ctx
    ctx.enable_only(ctx.NOTHING)
    ctx.depth_func = "<"
    ctx.front_face = "ccw"
    ctx.cull_face = "back"
    assert ctx.error == "GL_NO_ERROR", "left over from before this test"
    yield _gl_session
    _gl_session.make_current()  # a test may have made other contexts
    assert ctx.error == "GL_NO_ERROR", "caused by this test"
