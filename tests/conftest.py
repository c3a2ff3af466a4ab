"""Fixtures shared by all tests."""

from __future__ import annotations

import gc
import os

import pytest


def pytest_configure(config: pytest.Config) -> None:
    # Under xdist there is one process per core already: more llvmpipe and numba threads would only fight over them.
    if os.environ.get("PYTEST_XDIST_WORKER"):
        os.environ.setdefault("LP_NUM_THREADS", "0")
    # pyrender imports its viewer's pyglet, which fails where there is only half of X11.
    os.environ.setdefault("PYGLET_HEADLESS", "1")
    # Runs of the tests count as one build, although somebody may be editing the code while they are on. (From the
    # start: a process looks once.)
    os.environ["BLINKGL_BUILD"] = "tests"


def pytest_collection_finish() -> None:
    # Thousands of tests and their modules stay until the end: the collector looked at all of them again and again, for
    # a fifth of the suite's time. What tests make themselves is collected as ever.
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)


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
