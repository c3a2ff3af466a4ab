"""Releasing one context must not free what belongs to another that happens to be current."""

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
    for n, program in zip(range(40, 80), ours):
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
