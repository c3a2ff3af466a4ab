"""``blinkgl doctor``: prints the examined parts, then the missing ones and the commands that install them."""

from __future__ import annotations

import json
import os
import platform
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib import metadata
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table
from rich.text import Text

from blinkgl.errors import BlinkGLError
from blinkgl.machine.extras import EXTRAS, install, newer_than_tested, python
from blinkgl.machine.terminal import plain_console, say
from blinkgl.version import __version__

if TYPE_CHECKING:
    from blinkgl.gl import GLContext

# ---------------------------------------------------------------------------------------------------------------------
# What a run needs, what is missing, and the command that installs it; then the extras, one line each.
#
# Every check *does* the operation (renders, encodes, compresses, compiles) and compares the result: a driver that
# advertises 32-bit float targets but rounds them fails here and not in a data set.


@dataclass(frozen=True)
class Check:
    """One line. status: "ok", "missing" (required), "absent" (optional) or "info"."""

    section: str
    name: str
    status: str
    value: str
    remedy: str = ""


@dataclass(frozen=True)
class Report:
    """The results of all checks."""

    checks: tuple[Check, ...]

    @property
    def ok(self) -> bool:
        """Whether all required parts are present."""
        return all(check.status != "missing" for check in self.checks)

    def to_json(self) -> str:
        return json.dumps({"ok": self.ok, "checks": [asdict(check) for check in self.checks]}, indent=2)


def examine(backend: str = "auto", device: int = 0) -> Report:
    """Run every check. ``backend``, ``device``: the OpenGL to examine, as in the ``gl:`` section of a config."""
    return Report((*_system(), *_opengl(backend, device), *_numba(), *_codecs(), *_extras()))


def _try(section: str, name: str, action: Callable[[], str], remedy: str) -> Check:
    """Return the check of an action; ``action`` returns the text of success and raises any exception on failure."""
    try:
        return Check(section, name, "ok", action())
    except Exception as error:  # noqa: BLE001 - whatever a broken installation throws, the line has to appear
        return Check(section, name, "missing", " ".join(f"{type(error).__name__}: {error}".split())[:200], remedy)


# --- system -----------------------------------------------------------------------------------------------------------


def _system() -> Iterator[Check]:
    yield Check("System", "blinkgl", "info", __version__)
    new_enough = sys.version_info >= (3, 11)
    yield Check(
        "System",
        "Python",
        "ok" if new_enough else "missing",
        platform.python_version(),
        "" if new_enough else "use Python 3.11 or newer",
    )
    newer = newer_than_tested()
    yield Check(
        "System",
        "libraries",
        "info",
        ("newer than tested: " + ", ".join(newer)) if newer else "none is newer than tested",
    )


# --- OpenGL -----------------------------------------------------------------------------------------------------------


def _opengl(backend: str, device: int) -> Iterator[Check]:
    from blinkgl.gl import create_context, egl_devices
    from blinkgl.gl.context import APT_PACKAGES, REMEDY

    section = "OpenGL"
    devices = egl_devices()
    for index, text in enumerate(devices):
        yield Check(section, f"EGL device {index}", "info", text)
    if not devices:
        yield Check(
            section, "EGL devices", "absent", "none", f"sudo apt-get install -y --no-install-recommends {APT_PACKAGES}"
        )
    try:
        gl = create_context(backend, device)
    except BlinkGLError as error:
        yield Check(section, "context", "missing", error.problem, (error.accepted or REMEDY).removeprefix("run "))
        return
    with gl:
        for note in gl.notes:
            yield Check(section, "tried before", "info", note)
        where = f"EGL device {gl.device}" if gl.backend == "egl" else "OSMesa"
        drawn_by = f"the {'CPU' if gl.is_software else 'GPU'}: {gl.renderer}, {gl.version}"
        yield Check(section, "context", "ok", f"{where}, drawn by {drawn_by}")
        driver = "install a newer driver (OpenGL 4.5) or use 'gl: {backend: osmesa}'"
        for name in ("R32F", "RG32F", "RGBA32F", "R32UI"):
            yield _try(section, f"{name} target", lambda name=name: _draw_exactly(gl, name), driver)
        yield _try(section, "32F depth, reversed-Z", lambda: _draw_depth(gl), driver)


_TRIANGLE = """#version 430 core
uniform vec4 corner_scale_zw = vec4(1, 1, 0, 1);  // clip x and y factors, clip z, clip w
void main() {
    vec2 corner = vec2(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1);
    gl_Position = vec4(corner * corner_scale_zw.xy * corner_scale_zw.w, corner_scale_zw.zw);
}"""


def _full_screen(gl: GLContext, output: str, expression: str) -> tuple[Any, Any]:
    program = gl.ctx.program(
        vertex_shader=_TRIANGLE, fragment_shader=f"#version 430 core\n{output}\nvoid main() {{ {expression} }}"
    )
    return program, gl.ctx.vertex_array(program, [])


def _draw_exactly(gl: GLContext, name: str) -> str:
    """Draw values that only this format's full precision holds and read back the same bits."""
    from blinkgl.gl import Target

    if name.endswith("UI"):
        wanted, output, expression = np.array([4_000_000_001], np.uint32), "uint value", "4000000001u"
    else:
        wanted = np.array([16777215.0, -1.0000001, 1e-30, 3e38], np.float32)
        output, expression = "vec4 value", "vec4(16777215.0, -1.00000012, 1e-30, 3e38)"
    program, vertices = _full_screen(gl, f"layout(location = 0) out {output};", f"value = {expression};")
    with Target(gl, 4, 4, (name,), depth=False) as target:
        target.clear()
        vertices.render(vertices=3)
        seen = np.atleast_3d(target.read())
    vertices.release()
    program.release()
    if not np.all(seen == wanted[: seen.shape[2]]):
        raise ValueError(f"drew {wanted}, read {seen[0, 0]}")
    return "exact"


def _draw_depth(gl: GLContext) -> str:
    """Check near/z from 0.01 to 1e6 units to one float32 rounding, and that of two surfaces 1e-6 apart at 1e5 units the
    nearer one is drawn."""
    import moderngl

    from blinkgl.gl import Target

    near = 0.01
    program, vertices = _full_screen(gl, "uniform float value;\nlayout(location = 0) out float seen;", "seen = value;")
    with Target(gl, 4, 4, ("R32F",)) as target:
        gl.ctx.enable_only(moderngl.DEPTH_TEST)
        # Depth is near / z: 0 at infinity, and nearer is greater.
        gl.ctx.depth_func = ">"
        worst = 0.0
        for z in np.geomspace(0.011, 1e6, 33):
            target.clear(depth=0.0)
            program["corner_scale_zw"], program["value"] = (1, 1, near, z), 1.0
            vertices.render(vertices=3)
            worst = max(worst, float(np.abs(target.read_depth() * z / near - 1).max()))
        nearer, farther = 1e5, 1e5 * (1 + 1e-6)
        for order in ((nearer, farther), (farther, nearer)):
            target.clear(depth=0.0)
            for z in order:
                program["corner_scale_zw"], program["value"] = (1, 1, near, z), float(z == nearer)
                vertices.render(vertices=3)
            if not np.all(target.read() == 1.0):
                raise ValueError("surfaces 1e-6 apart at 1e5 units are confused")
        gl.ctx.enable_only(moderngl.NOTHING)
        gl.ctx.depth_func = "<"
    vertices.release()
    program.release()
    if worst > 1e-6:
        raise ValueError(f"relative depth error {worst:.1e}, expected <= 1e-6")
    return f"relative error {worst:.0e} up to 1e6 units, separates 1e-6 at 1e5 units"


_REINSTALL = f"{python()} -m pip install --force-reinstall"


# --- compute, codecs, extras ------------------------------------------------------------------------------------------


def _numba() -> Iterator[Check]:
    section = "Kernels"

    def threads() -> str:
        import numba

        from blinkgl.events.threads import run, take_part

        @numba.njit(nogil=True)
        def mark(taken, start, counts):
            part = take_part(taken, start)
            while part >= 0:
                counts[part] += part
                part = take_part(taken, start)

        count, sums = numba.get_num_threads(), np.zeros(1000, np.int64)
        run(mark, len(sums), (sums,), count)
        if not np.array_equal(sums, np.arange(len(sums))):
            raise ValueError("work divided between threads came out wrong")
        return f"{numba.__version__}, {count} threads, asleep when idle"

    def kernels() -> str:
        from blinkgl.machine.kernels import kept

        folder, count = kept()
        many = f"{count} compiled" if count else "none compiled yet: commands compile what they need"
        return f"{many}, in {folder} (blinkgl doctor --compile: all of them, about a minute)"

    mend = f"{_REINSTALL} numba"
    yield _try(section, "numba", threads, mend)
    yield _try(section, "kernels", kernels, mend)


def _codecs() -> Iterator[Check]:
    section = "Codecs"

    def blosc() -> str:
        import h5py
        import hdf5plugin

        # Numbers that repeat, so that a compressor without effect shows in the ratio.
        data = np.arange(100_000, dtype=np.uint32) // 7
        with h5py.File("doctor.h5", "w", driver="core", backing_store=False) as file:
            file.create_dataset(
                "x",
                data=data,
                chunks=(1 << 14,),
                **hdf5plugin.Blosc(cname="zstd", clevel=1, shuffle=hdf5plugin.Blosc.SHUFFLE),
            )
            if not np.array_equal(file["x"][:], data):
                raise ValueError("read other values than written")
            ratio = data.nbytes / file["x"].id.get_storage_size()
        return f"round trip, {ratio:.0f}:1 (h5py {h5py.__version__}, HDF5 {h5py.version.hdf5_version})"

    def x264() -> str:
        import av

        from blinkgl.io.video import VideoReader, VideoWriter

        with tempfile.TemporaryDirectory() as folder:
            path = os.path.join(folder, "doctor.mp4")
            with VideoWriter(path, 64, 64, 10.0) as video:
                for level in (60, 120, 180):
                    video.write(np.full((64, 64, 3), level, np.uint8))
            means = [frame.mean() for frame, _ in VideoReader(path)]
        # H.264 is lossy; a few codes are no fault.
        if np.abs(np.array(means) - [60, 120, 180]).max() > 3:
            raise ValueError("read other values than written")
        return f"round trip (PyAV {av.__version__}, libavcodec {'.'.join(map(str, av.library_versions['libavcodec']))})"

    def png16() -> str:
        import cv2

        image = np.arange(32 * 32 * 3, dtype=np.uint16).reshape(32, 32, 3) * 21
        _, data = cv2.imencode(".png", image)
        read = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
        if read is None or not np.array_equal(read, image):
            raise ValueError("read other values than written")
        return f"round trip (OpenCV {cv2.__version__})"

    yield _try(section, "HDF5 blosc-zstd", blosc, f"{_REINSTALL} h5py hdf5plugin")
    yield _try(section, "libx264 video", x264, f"{_REINSTALL} av")
    yield _try(section, "16-bit RGB PNG", png16, f"{_REINSTALL} opencv-python-headless")


def _extras() -> Iterator[Check]:
    from blinkgl.blender import process

    for extra, (names, purpose) in EXTRAS.items():
        here = {name: next((one.version for one in metadata.distributions(name=name)), None) for name in names}
        lacking = [name for name in names if here[name] is None]
        versions = ", ".join(f"no {name}" if version is None else f"{name} {version}" for name, version in here.items())
        remedy = install(*lacking) if lacking else ""
        if extra == "cycles" and lacking and not (remedy := process.available().partition(": ")[2]):
            lacking, versions = [], f"by {process.interpreter()}"
        yield Check("Optional extras", f"[{extra}]", "absent" if lacking else "ok", f"{versions} ({purpose})", remedy)


_MARKS = {"ok": ("ok", "green"), "missing": ("MISSING", "bold red"), "absent": ("absent", "yellow"), "info": ("", "")}


def run(backend: str = "auto", device: int = 0, as_json: bool = False, compile_all: bool = False) -> int:
    """Print the report. Status 2 when something required is missing. compile_all : first compile all kernels."""
    if compile_all:
        from blinkgl.show.compile_kernels import compile_ahead

        say(plain_console(stderr=True), compile_ahead() or "all kernels were compiled before")
    report = examine(backend, device)
    if as_json:
        say(plain_console(), report.to_json())
    else:
        show(report)
    return 0 if report.ok else BlinkGLError.exit_status


def show(report: Report) -> None:
    """Print for people: sections, then what is missing with the commands that install it."""
    console = plain_console(highlight=False)
    if not console.is_terminal:
        console = plain_console(highlight=False, width=200)  # piped: one check, one line, for grep
    table = Table.grid(padding=(0, 2))
    for _ in range(3):
        table.add_column(overflow="fold")
    section = ""
    for check in report.checks:
        if check.section != section:
            section = check.section
            table.add_row(Text(f"\n{section}" if table.row_count else section, style="bold"))
        mark, style = _MARKS[check.status]
        table.add_row(Text("  " + check.name), Text(mark, style=style), Text(check.value))
    console.print(table)
    for status, title in (("missing", "Missing, and required:"), ("absent", "Optional:")):
        mendable = [check for check in report.checks if check.status == status and check.remedy]
        if mendable:
            console.print(Text(f"\n{title}", style="bold"))
            for check in mendable:
                console.print(Text(f"  {check.name}: {check.remedy}"), soft_wrap=True)
    console.print(
        Text("\nAll required parts are there." if report.ok else "\nSomething required is missing.", style="bold")
    )
