"""Contexts: both backends draw the same, are released cleanly, and fail with one line."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import yaml

from blinkgl.config.run import load_run
from blinkgl.dataset.executor import Inline
from blinkgl.dataset.run import run_dataset
from blinkgl.errors import GLError, may_pass
from blinkgl.gl import GLContext, Target, context as context_module, create_context, egl_devices
from tests.dataset.runs import tree
from tests.tiny_recipe import TINY

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
    with Target(gl, 61, 47, ("RGBA32F",)) as target:
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
    for text in ("first", "²"):
        monkeypatch.setenv("GLCONTEXT_DEVICE_INDEX", text)
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
        timeout=600,
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
    process.join(120)
    if process.is_alive():
        print(how, "hangs", flush=True)
        process.kill()
if {opened}:
    print("parent", len(draw(gl)), flush=True)
"""


def forked(opened: bool, *how: str) -> list[str]:
    code = FORK.format(tests=str(Path(__file__).parent), opened=opened, how=how)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_a_process_forked_after_a_context_is_told_so_and_does_not_hang():
    new, old, parent = forked(True, "new", "inherited")
    for line in (new, old):
        assert (
            "this process was forked from one that uses OpenGL, and would hang; use "
            "multiprocessing.get_context('spawn')"
        ) in line
    assert parent == "parent 2", "the parent goes on"


def test_a_process_forked_before_any_context_draws():
    assert forked(False, "new") == ["new drawn"]


# --- A context that a driver throws away in the middle of the work: noticed, and the work done again in another one.


class Gone:
    """A framebuffer that takes every call, and gives back what was there before."""

    use = clear = staticmethod(lambda *_: None)
    read = staticmethod(lambda components: b"\0" * components)


def test_a_context_that_draws_no_more_is_noticed(gl):
    for _ in range(300):  # each time another colour
        gl.check()
    assert not gl.lost

    with create_context() as other:
        other.idle = Gone
        said = r"^llvmpipe.*: the GPU has lost its context.*; expected another try, in a new context"
        with pytest.raises(GLError, match=said) as caught:
            other.check()
        assert other.lost and may_pass(caught.value)
    gl.make_current()
    gl.check()


def test_the_sequence_is_made_again_in_another_context(tmp_path, monkeypatch):
    """The first is lost when all of the first sequence has been drawn: nothing of it stays, and the files are those of
    a run without trouble."""
    recipe = tmp_path / "run.yaml"
    recipe.write_text(yaml.safe_dump({**TINY, "output": {"sequences": 2}}))
    run_dataset(load_run(recipe), tmp_path / "wanted", Inline())
    seen, check = [], GLContext.check

    def lose(self):
        seen.append(self)
        if len(seen) == 1:
            self.idle = Gone
        check(self)

    monkeypatch.setattr(GLContext, "check", lose)
    outcome = run_dataset(load_run(recipe), tmp_path / "out", Inline())
    assert len(outcome.made) == 2 and not outcome.set_aside
    assert seen[0].lost and seen[0].released and seen[1] is not seen[0] and not seen[-1].lost
    logs = "".join(path.read_text() for path in (tmp_path / "out/.run/logs").rglob("*.log"))
    assert "attempt 1 failed: llvmpipe" in logs and logs.count("\n") > 4
    assert tree(tmp_path / "out") == tree(tmp_path / "wanted")


# --- Releasing one context must not free what belongs to another that happens to be current.


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
        target = Target(gl, 4, 4, ("R32F",), depth=False)
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
    with Target(gl, 4, 4, ("R32UI",), depth=False) as target:
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
        assert made.wait(600)
        if "error" in box:
            pytest.skip("no EGL for a second context")
        gl.make_current()
        with Target(gl, 4, 4, ("R32F",), depth=False) as target:
            target.clear(1.0)
            with pytest.raises(GLError, match="another thread uses this context"):
                box["other"].release()
            target.clear(2.0)
            assert (target.read(0) == 2.0).all()
        assert not box["other"].released
    finally:
        done.set()
        thread.join()
    assert box["other"].released and gl.ctx.error == "GL_NO_ERROR"


def test_devices_are_of_the_library_that_draws(monkeypatch):
    """glcontext's variable names it; one that is not there has none."""
    monkeypatch.setenv("GLCONTEXT_LINUX_LIBEGL", "libNoSuchEGL.so.7")
    assert egl_devices() == []
