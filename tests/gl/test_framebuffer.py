"""Targets hold and give back exactly what was drawn, in every format; 32F depth with reversed-Z."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.errors import GLError
from blinkgl.gl import FORMATS, Target

TRIANGLE = """#version 430 core
uniform vec2 depth_w;  // clip z and w
void main() {
    vec2 corner = vec2(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1);
    gl_Position = vec4(corner * depth_w.y, depth_w);
}"""


def full_screen(gl, fragment: str):
    program = gl.ctx.program(vertex_shader=TRIANGLE, fragment_shader="#version 430 core\n" + fragment)
    program["depth_w"] = (0.5, 1.0)
    return program, gl.ctx.vertex_array(program, [])


def expected(name: str, height: int, width: int) -> np.ndarray:
    """Distinct values for every pixel and component that the format holds exactly."""
    pixel = FORMATS[name]
    n = np.arange(height * width * pixel.components).reshape(height, width, pixel.components)
    values = {
        "f1": n % 256,
        "f2": n % 2048 - 1024,
        "f4": (n - 7) * 1.25e-3,
        "u4": n + 4_000_000_000,
        "i4": n - 2_000_000_000,
    }[pixel.gl]
    values = values.astype(pixel.numpy)
    return values[..., 0] if pixel.components == 1 else values


@pytest.mark.parametrize("name", FORMATS)
def test_what_is_drawn_is_read(gl, name):
    width, height = 37, 23  # odd: rows of R8 are not 4-byte aligned
    pixel, wanted = FORMATS[name], expected(name, height, width)
    source = gl.ctx.texture((width, height), pixel.components, wanted.tobytes(), dtype=pixel.gl, alignment=1)
    source.filter = (gl.ctx.NEAREST, gl.ctx.NEAREST)
    prefix = {"u": "u", "i": "i"}.get(pixel.gl[0], "")
    program, vertices = full_screen(
        gl,
        f"uniform {prefix}sampler2D source; out {prefix}vec4 value;"
        "void main() { value = texelFetch(source, ivec2(gl_FragCoord.xy), 0); }",
    )
    with Target(gl, width, height, (name,), depth=False) as target:
        target.clear()
        source.use(0)
        vertices.render(vertices=3)
        seen = target.read()
        assert seen.dtype == pixel.numpy and seen.shape == wanted.shape
        np.testing.assert_array_equal(seen, wanted)
        # the fast way: in place, no other array
        out = np.full(wanted.shape, 77, pixel.numpy)
        assert target.read(out=out) is out
        np.testing.assert_array_equal(out, wanted)
        np.testing.assert_array_equal(target.read(region=(5, 3, 11, 7)), wanted[3:10, 5:16])
    for resource in (source, vertices, program):
        resource.release()


def test_attachments_are_cleared_each_by_its_own_value(gl):
    with Target(gl, 9, 5, ("R32F", "RGBA8", "R32UI", "R16F", "RG32F", "R32I")) as target:
        target.clear(1.5, (1, 0, 0.2, 1), 4_000_000_001, -0.5, (2, 3), -4, depth=0.25)
        for i, value in enumerate((1.5, [255, 0, 51, 255], 4_000_000_001, -0.5, [2, 3], -4)):
            assert np.all(target.read(i) == np.array(value))
        assert np.all(target.read_depth() == 0.25)
        target.clear()
        assert all(np.all(target.read(i) == 0) for i in range(6)) and np.all(target.read_depth() == 0)


def test_clear_honours_the_scissor(gl):
    with Target(gl, 8, 6, ("R32F",)) as target:
        target.clear(1.0, depth=0.5)
        target.fbo.scissor = (2, 1, 3, 4)
        target.clear(2.0, depth=0.75)
        target.fbo.scissor = None
        wanted = np.full((6, 8), 1.0, np.float32)
        wanted[1:5, 2:5] = 2.0
        np.testing.assert_array_equal(target.read(), wanted)
        np.testing.assert_array_equal(target.read_depth(), np.where(wanted == 2, np.float32(0.75), np.float32(0.5)))


def depths(gl, kind, colour, places):
    """Yield the depth of a target of this kind after triangles over all of it, of these clip z and w."""
    program, vertices = full_screen(gl, "out float value; void main() { value = 1.0; }")
    gl.ctx.enable_only(gl.ctx.DEPTH_TEST)
    gl.ctx.depth_func = ">"
    with Target(gl, 4, 4, colour, depth=kind) as target:
        for place in places:
            target.clear(depth=0.0)
            program["depth_w"] = place
            vertices.render(vertices=3)
            yield target.read_depth()
    vertices.release()
    program.release()


@pytest.mark.parametrize("kind", [True, "texture"])
def test_reversed_z_keeps_float_precision(gl, kind):
    """near/z to one rounding over 8 decades: 24-bit or [-1, 1] depth is wrong by tens of percent beyond 1e5 units."""
    near, far = 0.01, np.geomspace(0.011, 1e6, 25)
    for z, depth in zip(far, depths(gl, kind, ("R32F",), [(near, z) for z in far]), strict=True):
        np.testing.assert_allclose(depth, near / z, rtol=2.5e-7)


def test_depth_of_16_bits_is_rounded_to_its_steps(gl):
    true = np.linspace(0.001, 0.999, 57)
    made = np.array([*depths(gl, "texture of 16 bits", (), [(depth, 1.0) for depth in true])])
    # Of floats it would be a hundredth of that.
    assert 0.2 / 65535 < np.abs(made - true[:, None, None]).max() < 0.51 / 65535


def test_depth_texture_can_be_sampled(gl):
    program, vertices = full_screen(
        gl,
        "uniform sampler2D depths; out float value;"
        "void main() { value = texelFetch(depths, ivec2(gl_FragCoord.xy), 0).r; }",
    )
    with Target(gl, 5, 4, (), depth="texture") as first, Target(gl, 5, 4, ("R32F",), depth=False) as second:
        first.clear(depth=1.2345e-6)
        second.clear()
        first.depth.use(0)
        vertices.render(vertices=3)
        assert np.all(second.read() == np.float32(1.2345e-6))
    vertices.release()
    program.release()


def test_releasing_the_bound_target_leaves_a_usable_context(gl):
    for _ in range(3):
        target = Target(gl, 4, 4, ("R8",))
        target.clear()
        target.release()
        target.release()
        assert gl.ctx.error == "GL_NO_ERROR"


def test_bad_requests(gl):
    limit = gl.ctx.info["GL_MAX_TEXTURE_SIZE"]
    for size in ((0, 4), (4, limit + 1), (-1, 2)):
        with pytest.raises(GLError, match="exceeds this OpenGL's limit"):
            Target(gl, *size)
    with pytest.raises(GLError, match=r"unknown pixel format \(got 'R64F'\); expected one of R8, "):
        Target(gl, 4, 4, ("R64F",))
    with pytest.raises(GLError, match="unknown kind of depth"):
        Target(gl, 4, 4, depth="stencil")
    with pytest.raises(GLError, match="too many colour attachments"):
        Target(gl, 4, 4, ("R8",) * 99)
    with Target(gl, 6, 4, ("R32F",), depth=False) as target:
        for wrong in (np.empty((6, 4), np.float32), np.empty((4, 6)), np.empty((4, 12), np.float32)[:, ::2]):
            with pytest.raises(ValueError, match="out must be"):
                target.read(out=wrong)
        with pytest.raises(GLError, match="no depth"):
            target.read_depth()
