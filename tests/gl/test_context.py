"""Contexts: both backends draw the same, are released cleanly, and fail with one line."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from blinkgl.errors import GLError
from blinkgl.gl import context as context_module, create_context, egl_devices

VERTEX = """#version 430 core
in vec3 position;
void main() { gl_Position = vec4(position, 1.0); }"""
FRAGMENT = """#version 430 core
out vec4 colour;
void main() { colour = vec4(gl_FragCoord.xy * 0.1, sin(gl_FragCoord.x), gl_FragCoord.z); }"""


def needs(*backends: str) -> None:
    """Skip unless this machine has the libraries; machines with only one of the two are fine."""
    if "egl" in backends and not egl_devices():
        pytest.skip("no EGL device here")
    if "osmesa" in backends:
        try:
            context_module._load_library()
        except context_module.OSMesaUnavailable as error:
            pytest.skip(str(error))


def draw(gl) -> tuple[np.ndarray, np.ndarray]:
    """A skewed triangle into RGBA32F and 32F depth."""
    program = gl.ctx.program(vertex_shader=VERTEX, fragment_shader=FRAGMENT)
    corners = np.array([[-0.9, -0.8, 0.1], [0.95, -0.3, 1e-7], [0.1, 0.9, 0.7]], np.float32)
    vertices = gl.ctx.vertex_array(program, [(gl.ctx.buffer(corners), "3f", "position")])
    gl.ctx.enable_only(gl.ctx.DEPTH_TEST)
    gl.ctx.depth_func = ">"
    with gl.framebuffer(61, 47, ("RGBA32F",)) as target:
        target.clear((9, 8, 7, 6), depth=0.0)
        vertices.render()
        assert gl.ctx.error == "GL_NO_ERROR"
        return target.read(), target.read_depth()


@pytest.mark.parametrize("backend", ["egl", "osmesa"])
def test_backend_draws_and_is_released(backend):
    needs(backend)
    with create_context(backend) as gl:
        assert gl.backend == backend and gl.renderer and gl.vendor and gl.version and gl.notes == ()
        assert gl.ctx.version_code >= 430
        colour, depth = draw(gl)
    covered = depth > 0
    assert 0.3 < covered.mean() < 0.6
    assert np.all(colour[~covered] == [9, 8, 7, 6])
    y, x = np.nonzero(covered)
    # Row 0 is GL's row 0.
    np.testing.assert_allclose(colour[y, x, :2], np.stack([x + 0.5, y + 0.5], 1) * 0.1, rtol=1e-6)
    np.testing.assert_allclose(colour[y, x, 3], depth[y, x], rtol=1e-6)  # zero-to-one: no 0.5 * z + 0.5 anywhere
    gl.release()  # twice is harmless


def test_osmesa_equals_egl_software():
    needs("egl", "osmesa")
    with create_context("egl") as gl:
        if not gl.is_software:
            pytest.skip("EGL draws on a GPU: equal bits are not promised")
        egl = draw(gl)
    with create_context("osmesa") as gl:
        assert gl.is_software
        other = draw(gl)
    for a, b in zip(egl, other):
        assert a.tobytes() == b.tobytes()


@pytest.mark.parametrize("pair", [("egl", "egl"), ("egl", "osmesa"), ("osmesa", "egl")])
def test_two_contexts_side_by_side(pair):
    needs(*pair)
    with create_context(pair[0]) as first:
        expected = draw(first)
        with create_context(pair[1]) as second:
            draw(second)
            first.make_current()
            again = draw(first)
            second.make_current()
            draw(second)
        first.make_current()  # releasing the second left none current
        last = draw(first)
    for a, b, c in zip(expected, again, last):
        assert a.tobytes() == b.tobytes() == c.tobytes()


WORKER = """
import hashlib, sys
sys.path.insert(0, sys.argv[1])
from test_context import create_context, draw
with create_context() as gl:
    colour, depth = draw(gl)
print(hashlib.sha256(colour.tobytes() + depth.tobytes()).hexdigest())
"""


# --- failures ---------------------------------------------------------------------------------------------------------


def test_device_out_of_range():
    needs("egl")
    for backend in ("egl", "auto"):  # auto must not hide that the chosen device does not exist
        with pytest.raises(
            GLError, match=r"^gl.device: no such EGL device \(got 99\); expected one of those `blinkgl doctor` lists$"
        ):
            create_context(backend, device=99)


def test_environment_overrides_the_device(monkeypatch):
    needs("egl")
    monkeypatch.setenv("GLCONTEXT_DEVICE_INDEX", "98")
    with pytest.raises(GLError, match="got 98"):
        create_context("egl", device=0)
    monkeypatch.setenv("GLCONTEXT_DEVICE_INDEX", "first")
    with pytest.raises(GLError, match="GLCONTEXT_DEVICE_INDEX: not a device number"):
        create_context("egl", device=0)


def test_auto_falls_back_to_osmesa_and_says_so(monkeypatch):
    needs("osmesa")
    monkeypatch.setenv("GLCONTEXT_LINUX_LIBEGL", "libmissing.so")
    with create_context("auto") as gl:
        assert gl.backend == "osmesa"
        assert "libmissing.so not loaded" in gl.notes[0]
        draw(gl)


def test_neither_is_one_line_with_the_remedy(monkeypatch):
    monkeypatch.setattr(context_module, "_EGL_LIBRARIES", ("libmissing.so",))
    monkeypatch.setattr(context_module, "LIBRARIES", ("libmissing.so",))
    with pytest.raises(GLError) as caught:
        create_context()
    line = str(caught.value)
    assert "\n" not in line
    assert "EGL device 0: libEGL.so.1 not found" in line and "OSMesa: libOSMesa.so not found" in line
    assert "run 'sudo apt-get install -y --no-install-recommends libegl1 libgl1 libgl1-mesa-dri libosmesa6'" in line
    for backend in ("egl", "osmesa"):
        with pytest.raises(GLError, match="apt-get"):
            create_context(backend)


@pytest.mark.parametrize(
    "raw, translated",
    [
        ("eglInitialize failed (0x3001)", "no working DRI driver"),
        ("requested device index 0, but found 0 devices", "no driver"),
        ("libGL.so not loaded", "libGL.so not loaded"),
        ("eglCreateContext failed (0x3009)", "no OpenGL 4.3 core"),
    ],
)
def test_glcontext_errors_are_translated(monkeypatch, raw, translated):
    needs("egl")  # the library is opened before glcontext is called
    from glcontext import egl

    def fail(**_):
        raise Exception(raw)  # noqa: TRY002 - what glcontext raises

    monkeypatch.setattr(egl, "create_context", fail)
    with pytest.raises(GLError, match=translated):
        create_context("egl")


def test_too_old_opengl_is_refused(monkeypatch):
    needs("osmesa")
    monkeypatch.setattr(context_module, "REQUIRED_VERSION", 990)
    with pytest.raises(GLError, match="Requested OpenGL version 990"):
        create_context("osmesa")


def test_unknown_backend():
    with pytest.raises(GLError, match="gl.backend: unknown backend \\(got 'glx'\\)"):
        create_context("glx")


def test_missing_gl_function(gl):
    address = gl._raw.load_opengl_function
    assert address("glClipControl")

    class Empty:
        def load_opengl_function(self, name):
            return 0

    raw, gl._raw = gl._raw, Empty()
    try:
        with pytest.raises(GLError, match="the driver has no glNope"):
            gl.function("glNope", None)
    finally:
        gl._raw = raw


# --- config -----------------------------------------------------------------------------------------------------------


def test_devices_are_listed_without_a_context():
    done = subprocess.run(
        [sys.executable, "-c", "import json; from blinkgl.gl import egl_devices; print(json.dumps(egl_devices()))"],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert all(isinstance(text, str) and text for text in json.loads(done.stdout))


FORK = """
import multiprocessing, sys
import numpy as np
from blinkgl.errors import GLError
from blinkgl.gl import create_context
sys.path.insert(0, {tests!r})
from test_context import draw

def child(how):
    try:
        if how == "new":
            with create_context() as other:
                draw(other)
        else:
            gl.make_current()
            draw(gl)
        print(how, "drawn", flush=True)
    except GLError as error:
        print(how, error, flush=True)
    gl.release()  # the parent's is left alone

if {opened}:
    gl = create_context()
    draw(gl)  # the driver's threads are started by the first triangles
else:
    class gl: release = staticmethod(lambda: None)
for how in {how}:
    process = multiprocessing.get_context("fork").Process(target=child, args=(how,))
    process.start()
    process.join(20)
    if process.is_alive():
        print(how, "hangs", flush=True)
        process.kill()
if {opened}:
    print("parent", len(draw(gl)), flush=True)
"""


def forked(opened: bool, *how: str) -> list[str]:
    code = FORK.format(tests=str(Path(__file__).parent), opened=opened, how=how)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_a_process_forked_after_a_context_is_told_so_and_does_not_hang():
    new, old, parent = forked(True, "new", "inherited")
    for line in (new, old):
        assert (
            "this process was forked from one that had opened OpenGL, and would hang; use "
            "multiprocessing.get_context('spawn')"
        ) in line
    assert parent == "parent 2", "the parent goes on"


def test_a_process_forked_before_any_context_draws():
    assert forked(False, "new") == ["new drawn"]
