"""Releasing one context must not free what belongs to another that happens to be current."""

import threading

import numpy as np
import pytest

from blinkgl.errors import GLError
from blinkgl.gl import create_context


def test_names_of_another_context_survive(gl):
    """Programs and buffers of two contexts have the same numbers; the second is released while the first is current."""
    try:
        other = create_context("egl")
    except GLError:
        pytest.skip("no EGL for a second context")
    theirs = [other.program("downsample.glsl", {"FACTOR": n}) for n in range(2, 40)]
    gl.make_current()
    ours = [gl.program("downsample.glsl", {"FACTOR": n}) for n in range(40, 80)]
    if not {p.glo for p in theirs} & {p.glo for p in ours}:
        pytest.skip("the numbers of the two contexts' programs do not meet")
    other.release()
    assert other.released
    gl.make_current()
    for _, program in zip(range(40, 80), ours):
        target = gl.framebuffer(4, 4, ("R32F",), depth=False)
        target.use()
        gl.ctx.vertex_array(program, []).render(vertices=3)
        assert np.isfinite(target.read(0)).all()
        target.release()
    assert gl.ctx.error == "GL_NO_ERROR"


def test_an_abandoned_generator_leaves_the_current_context_current(gl):
    """The garbage collector may close it, and release its context, in the middle of somebody else's drawing."""

    def suspended():
        with create_context("egl") as other:
            other.program("downsample.glsl", {"FACTOR": 3})
            yield

    try:
        generator = suspended()
        next(generator)
    except GLError:
        pytest.skip("no EGL for a second context")
    gl.make_current()
    with gl.framebuffer(4, 4, ("R32UI",), depth=False) as target:
        target.clear(7)
        generator.close()
        target.clear(9)
        assert (target.read(0) == 9).all()
    assert gl.ctx.error == "GL_NO_ERROR"


def test_a_context_of_another_thread_is_refused_and_nothing_of_ours_is_freed(gl):
    """eglMakeCurrent fails for it; what was current here would then be drawn into, and its objects deleted."""
    made, done, box = threading.Event(), threading.Event(), {}

    def work():
        try:
            box["other"] = create_context("egl")
        except GLError as error:
            box["error"] = error
        made.set()
        done.wait()
        if "other" in box:
            box["other"].release()

    thread = threading.Thread(target=work)
    thread.start()
    try:
        assert made.wait(30)
        if "error" in box:
            pytest.skip("no EGL for a second context")
        gl.make_current()
        with gl.framebuffer(4, 4, ("R32F",), depth=False) as target:
            target.clear(1.0)
            with pytest.raises(GLError, match="in use by another thread"):
                box["other"].release()
            target.clear(2.0)
            assert (target.read(0) == 2.0).all()
        assert not box["other"].released
    finally:
        done.set()
        thread.join()
    assert box["other"].released and gl.ctx.error == "GL_NO_ERROR"
