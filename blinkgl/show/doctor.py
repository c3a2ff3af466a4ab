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

import numpy as np
from rich.table import Table
from rich.text import Text

from blinkgl.errors import BlinkGLError
from blinkgl.machine.cpu import bf16_instructions
from blinkgl.machine.extras import EXTRAS, install, newer_than_tested, python
from blinkgl.machine.terminal import plain_console, say
from blinkgl.version import __version__

# ---------------------------------------------------------------------------------------------------------------------
# ``blinkgl doctor``: what this machine offers, what is missing, and the command that installs it.
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
    yield Check("System", "platform", "info", platform.platform())
    newer = newer_than_tested()
    yield Check(
        "System",
        "libraries",
        "info",
        ("newer than tested: " + ", ".join(newer)) if newer else "none is newer than tested",
    )
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    yield Check("System", "cores, memory", "info", f"{cores} cores, {memory:.1f} GiB")
    names = ("LP_NUM_THREADS", "NUMBA_NUM_THREADS", "NUMBA_CACHE_DIR", "OMP_NUM_THREADS")
    changed = [
        f"{name}={value}"
        for name, value in sorted(os.environ.items())
        if name in names or name.startswith(("GLCONTEXT_", "LIBGL_", "GALLIUM_", "MESA_", "__EGL_", "EGL_"))
    ]
    if changed:
        yield Check("System", "environment", "info", " ".join(changed))


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
        yield Check(section, "context", "ok", f"{where}, drawn by the {'CPU (software)' if gl.is_software else 'GPU'}")
        yield Check(section, "vendor", "info", gl.vendor)
        yield Check(section, "renderer", "info", gl.renderer)
        yield Check(section, "version", "ok", gl.version)
        info = gl.ctx.info
        yield Check(
            section,
            "limits",
            "info",
            f"texture {info['GL_MAX_TEXTURE_SIZE']} px, viewport "
            f"{'x'.join(str(v) for v in info['GL_MAX_VIEWPORT_DIMS'])}, {info['GL_MAX_DRAW_BUFFERS']} draw buffers, "
            f"{gl.ctx.max_samples} samples, anisotropy {gl.ctx.max_anisotropy:g}",
        )
        driver = "install a newer driver (OpenGL 4.5) or use 'gl: {backend: osmesa}'"
        for name in ("R32F", "RG32F", "RGBA32F", "R32UI", "R16F", "RGBA8"):
            yield _try(section, f"{name} target", lambda name=name: _draw_exactly(gl, name), driver)
        yield _try(section, "32F depth, reversed-Z", lambda: _draw_depth(gl), driver)
        yield _to_torch(gl, section)


def _to_torch(gl, section: str) -> Check:
    """Check the transfer of frames from this context to torch; on a GPU a frame is drawn, copied and compared."""
    name = "frames for torch"
    if gl.is_software:  # torch takes seconds to import
        return Check(section, name, "info", "in the processor's memory, where they are drawn")
    from blinkgl.gl import Target
    from blinkgl.render.tensors import TextureReader

    try:
        with Target(gl, 8, 8, ("R32F",), depth=False) as target:
            target.clear(0.25)
            reader = TextureReader(gl, target, 0, "cuda")
            reader.read()
            way, why = reader.way, reader.why
            reader.release()
    except BlinkGLError as error:
        return Check(section, name, "absent", error.problem, install("torch"))
    except Exception as error:  # noqa: BLE001 - a broken torch; the line has to appear
        return Check(section, name, "absent", " ".join(f"{type(error).__name__}: {error}".split())[:200])
    if way == "interop":
        return Check(section, name, "ok", "they stay on the card: CUDA reads what OpenGL draws")
    return Check(section, name, "absent", f"over the bus: {why}", install("cuda-bindings") if "bindings" in why else "")


_TRIANGLE = """#version 430 core
uniform vec4 corner_scale_zw = vec4(1, 1, 0, 1);  // clip x and y factors, clip z, clip w
void main() {
    vec2 corner = vec2(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1);
    gl_Position = vec4(corner * corner_scale_zw.xy * corner_scale_zw.w, corner_scale_zw.zw);
}"""


def _full_screen(gl, output: str, expression: str):
    program = gl.ctx.program(
        vertex_shader=_TRIANGLE, fragment_shader=f"#version 430 core\n{output}\nvoid main() {{ {expression} }}"
    )
    return program, gl.ctx.vertex_array(program, [])


def _draw_exactly(gl, name: str) -> str:
    """Draw values that only this format's full precision holds and read back the same bits."""
    from blinkgl.gl import Target

    integer, bytes_ = name.endswith("UI"), name.endswith("8")
    if integer:
        expected = np.array([4_000_000_001], np.uint32)
    elif bytes_:
        expected = np.array([0, 51, 102, 255], np.uint8)
    elif "16F" in name:
        expected = np.array([0.333251953125, -2049, 65504, 6.103515625e-05], np.float16)
    else:
        expected = np.array([16777215.0, -1.0000001, 1e-30, 3e38], np.float32)
    values = expected / 255 if bytes_ else expected
    literals = ", ".join(
        f"{v}u" if integer else f"{float(v):.9g}{'' if 'e' in f'{float(v):.9g}' or '.' in f'{float(v):.9g}' else '.0'}"
        for v in values
    )
    kind, expression = ("uint", literals) if integer else ("vec4", f"vec4({literals})")
    program, vertices = _full_screen(gl, f"layout(location = 0) out {kind} value;", f"value = {expression};")
    with Target(gl, 4, 4, (name,), depth=False) as target:
        target.clear()
        vertices.render(vertices=3)
        seen = target.read()
    vertices.release()
    program.release()
    wanted = expected[: seen.shape[2]] if seen.ndim == 3 else expected[0]
    if not np.all(seen == wanted):
        raise ValueError(f"drew {wanted}, read {seen[0, 0]}")
    return "exact"


def _draw_depth(gl) -> str:
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


# --- compute, codecs, extras ------------------------------------------------------------------------------------------


def _numba() -> Iterator[Check]:
    section = "Kernels"

    def version() -> str:
        import numba

        return f"{numba.__version__}, {numba.get_num_threads()} threads"

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
        return f"{count}, asleep when idle"

    def simd() -> str:
        from llvmlite import binding

        features = binding.get_host_cpu_features()
        widest = next(
            (name for name in ("avx512f", "avx2", "avx", "sse4.2", "sve", "neon") if features.get(name)), "none found"
        )
        return f"{widest} on {binding.get_host_cpu_name()}"

    def kernels() -> str:
        from blinkgl.machine.kernels import kept

        folder, count = kept()
        many = f"{count} compiled" if count else "none compiled yet: commands compile what they need"
        return f"{many}, in {folder} (blinkgl doctor --compile: all of them, about a minute)"

    mend = f"{python()} -m pip install --force-reinstall numba"
    yield _try(section, "numba", version, mend)
    yield _try(section, "threads", threads, mend)
    yield _try(section, "SIMD", simd, mend)
    yield _try(section, "kernels", kernels, mend)
    yield Check(
        section,
        "bf16",
        "info",
        bf16_instructions() or "no instructions for it: eflow computes in fp32, whatever a recipe says",
    )


def _codecs() -> Iterator[Check]:
    section = "Codecs"

    def blosc() -> str:
        import h5py
        import hdf5plugin

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

    pip = f"{python()} -m pip install --force-reinstall"
    yield _try(section, "HDF5 blosc-zstd", blosc, f"{pip} h5py hdf5plugin")
    yield _try(section, "libx264 video", x264, f"{pip} av")
    yield _try(section, "16-bit RGB PNG", png16, f"{pip} opencv-python-headless")


def _blender(value: str, purpose: str) -> tuple[list[str], str, str]:
    """Return missing parts, a description and the remedy; Blender may run in another interpreter."""
    from blinkgl.blender import process

    missing = process.available()
    if missing:
        return ["bpy"], value, missing.partition(": ")[2] or missing
    return [], value if process.interpreter() == sys.executable else f"by {process.interpreter()} ({purpose})", ""


def _extras() -> Iterator[Check]:
    for extra, (distributions, purpose) in EXTRAS.items():
        found, lacking = [], []
        for name in distributions:
            try:
                found.append(f"{name} {metadata.version(name)}")
            except metadata.PackageNotFoundError:
                lacking.append(name)
        value = ", ".join(found + [f"no {name}" for name in lacking]) + f" ({purpose})"
        remedy = install(*lacking) if lacking else ""
        if extra == "cycles":
            lacking, value, remedy = _blender(value, purpose)
        yield Check("Optional extras", f"[{extra}]", "absent" if lacking else "ok", value, remedy)


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
