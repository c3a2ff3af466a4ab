"""The answers to the page's requests, computed in one thread: an OpenGL context belongs to the thread that created
it."""

from __future__ import annotations

import math
import re
import shutil
import tempfile
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

import numpy as np

from blinkgl.errors import BlinkGLError, ConfigError
from blinkgl.gl import ShaderLoader
from blinkgl.gl.shader import ShaderError, expand, stages_of
from blinkgl.io import pictures
from blinkgl.io.pictures import MAPS
from blinkgl.render.passes.own import own_programs
from blinkgl.tools.shader_debugger import picture
from blinkgl.tools.shader_debugger.commands import _finite, _meaningful
from blinkgl.tools.shader_debugger.compare import Comparison, verdict
from blinkgl.tools.shader_debugger.diagnostics import Diagnostic, diagnose
from blinkgl.tools.shader_debugger.filters import FILTERED, filtered_names
from blinkgl.tools.shader_debugger.moments import (
    PASSES,
    GpuMoment,
    buffers_of,
    check_pass,
    open_reference,
)
from blinkgl.tools.shader_debugger.probe import _numbers, _surface_text, probe
from blinkgl.tools.shader_debugger.session import (
    Subject,
    When,
    check_pixel,
    files_of,
    moment,
    open_folder,
    open_renderer,
)
from blinkgl.types.trees import Tree

# ---------------------------------------------------------------------------------------------------------------------
# The requests of the page, and the reader of each parameter: only this part parses a query's text.

LONGEST = 2000  # characters of a query
LARGEST = 1e30  # ends of a colour scale: far above every buffer, and their difference is still finite
SOURCES = ("gpu", "reference")
COMPONENTS = ("auto", "length", "x", "y", "z", "w")

Reader = Callable[[str, str], Any]  # (parameter's name, its text; "" when not given) -> value


def _choice(what: str, known: tuple[str, ...], default: str | None) -> Reader:
    def read(key: str, text: str):
        if text and text not in known:
            raise ConfigError(what, where=key, value=text, accepted="one of " + ", ".join(known))
        return text or default

    return read


def _pass_and_source(key: str, text: str) -> tuple[str, str]:
    name, _, source = text.partition(":")
    if source not in SOURCES:
        raise ConfigError("unknown source", where=key, value=text, accepted="PASS:gpu or PASS:reference")
    return check_pass(name, where=key), source


def _seconds(key: str, text: str) -> float | None:
    try:
        return float(text) if text else None
    except ValueError:
        raise ConfigError("not a time", where=key, value=text, accepted="seconds") from None


def _number(key: str, text: str) -> float | None:
    try:
        value = float(text) if text else None
    except ValueError:
        value = math.nan
    # NaN compares false with everything.
    if value is not None and not abs(value) <= LARGEST:
        raise ConfigError(
            "not a number", where=key, value=text, accepted=f"a number between -{LARGEST:g} and {LARGEST:g}, or nothing"
        )
    return value


def _count(key: str, text: str) -> int:
    """Return the number; -1 when not given."""
    if text and not re.fullmatch(r"[0-9]{1,18}", text):
        raise ConfigError("not a version", where=key, value=text, accepted="a whole number")
    return int(text) if text else -1


_VIEW: dict[str, Reader] = {
    "t": _seconds,
    "component": _choice("no such component", COMPONENTS, "auto"),
    "map": _choice("unknown colour map", MAPS, None),
    "low": _number,
    "high": _number,
}

ROUTES: dict[str, dict[str, Reader]] = {
    "/state": {},
    "/image": {
        "pass": lambda key, text: check_pass(text, where=key),
        "source": _choice("unknown source", SOURCES, "gpu"),
        **_VIEW,
    },
    "/difference": {"a": _pass_and_source, "b": _pass_and_source, **_VIEW},
    # session.check_pixel parses x and y together.
    "/probe": {"x": lambda _, text: text, "y": lambda _, text: text, "t": _seconds},
    "/verdict": {"t": _seconds},
    "/wait": {"version": _count},
}
"""Parameters of each route; all are optional, where a default makes sense."""


def read_query(route: str, text: str) -> dict[str, object]:
    """Return the values of every parameter of a route in :data:`ROUTES`, from the text after the
    question mark. Raises ConfigError."""
    readers = ROUTES[route]
    if len(text) > LONGEST:
        raise ConfigError(
            "the question is too long", where=route, value=len(text), accepted=f"at most {LONGEST} characters"
        )
    parameters: dict[str, str] = {}
    # Programs differ in how they read a parameter that is parameters twice.
    for key, value in parse_qsl(text, keep_blank_values=True):
        if key not in readers or key in parameters:
            raise ConfigError(
                "asked twice" if key in parameters else "unknown parameter",
                where=route,
                value=key,
                accepted="one of " + ", ".join(readers) if readers else "none",
            )
        parameters[key] = value
    return {key: read(key, parameters.get(key, "")) for key, read in readers.items()}


POLL_S = 0.15  # between two checks of the shader files
KEPT = 6  # moments in memory
MOST_ERRORS = 5  # shown at once


class _Loader(ShaderLoader):
    """Compiles from a copy of the shader folder. Programs are compiled at their first use; without the copy, one first
    used after a bad edit would be compiled from the bad file. It stores the last requested program, to find the sources
    of an error."""

    asked: tuple[str, dict] = ("", {})

    def __init__(self, ctx: Any, folder: Path):
        self._copy = tempfile.TemporaryDirectory(prefix="blinkgl-shaders-")
        shutil.copytree(folder, self._copy.name, dirs_exist_ok=True)
        super().__init__(ctx, Path(self._copy.name))

    def program(self, name, defines=None):
        self.asked = (name, dict(defines or {}))
        return super().program(name, defines)


class Inspector:
    """Buffers, pictures and probes of one subject. All methods except the constructor belong to the worker's thread."""

    def __init__(self, subject: Subject, when: When, shaders: str | None):
        self.subject, self.first = subject, when
        self.folder = open_folder(shaders)
        self._shaders = shaders
        self.generation = 1
        self.errors: list[Diagnostic] = []
        self._shown = when
        # A time slider goes back and forth between a few moments.
        self.gpu = lru_cache(KEPT)(lambda when: GpuMoment(self.renderer, when))
        self.reference = lru_cache(KEPT)(lambda when: open_reference(subject, when, self.renderer.maps))
        self.comparison = lru_cache(KEPT)(lambda when: Comparison(self.gpu(when), self.reference(when)))

    def open(self) -> None:
        """Create the context and draw once. Raises GLError."""
        self._context = open_renderer(self.subject, self._shaders)
        self.renderer = self._context.__enter__()
        try:
            self.renderer.use_shaders(_Loader(self.renderer.gl.ctx, self.folder))
            self._draw_all(when=self.first)
        except BaseException as error:
            self._context.__exit__(type(error), error, None)
            raise

    def close(self) -> None:
        self._context.__exit__(None, None, None)

    # ---- moments -----------------------------------------------------------------------------------------------

    def _draw_all(self, when: When) -> None:
        made = GpuMoment(self.renderer, when)
        # Programs are compiled at the first drawing: draw with all, so that an error is shown now.
        for name in self._buffers():
            made[name]

    def _buffers(self):
        return buffers_of(self.subject.scene, filtered_names(self.subject.config, self.subject.scene))

    def _array(self, when: When, name: str, source: str) -> np.ndarray:
        if name in FILTERED:  # its reference is computed from the GPU's own picture
            return self.gpu(when)[name if source == "gpu" else f"{name}_reference"]
        return (self.gpu(when) if source == "gpu" else self.reference(when))[name]

    def _when(self, seconds: float | None) -> When:
        self._shown = moment(self.subject, seconds) if seconds is not None else self.first
        return self._shown

    # ---- answers -----------------------------------------------------------------------------------------------

    def state(self, q: Mapping[str, object]) -> dict:
        """Return what the page shows around the pictures."""
        scene, config, gl = self.subject.scene, self.subject.config, self.renderer.gl
        return {
            "config": self.subject.path,
            "sequence": self.subject.index,
            "seed": config.seed,
            "renderer": gl.renderer,
            "width": scene.camera.width,
            "height": scene.camera.height,
            "t0": scene.t0_ns * 1e-9,
            "t1": scene.t1_ns * 1e-9,
            "t": self.first.t_ns * 1e-9,
            "labels": [t * 1e-9 for t in config.time.label_times_ns],
            "interval": config.time.interval_ns * 1e-9,
            "maps": pictures.MAPS,
            "folder": str(self.folder),
            "passes": [asdict(info) for info in self._buffers().values()],
        }

    def shaders(self) -> dict:
        return {"generation": self.generation, "errors": [asdict(d) | {"where": d.where} for d in self.errors]}

    def image(self, q: Tree) -> tuple[bytes, dict]:
        """Return PNG and legend of one buffer. q : the result of :func:`questions.read_query`, here and below."""
        when, name = self._when(q["t"]), check_pass(q["pass"], self._buffers(), "pass")
        source = self.gpu(when) if q["source"] == "gpu" else self.reference(when)
        info = PASSES[name]
        rgb, legend = pictures.picture(
            info.kind,
            self._array(when, name, q["source"]),
            which=q["component"],
            colours=q["map"],
            low=q["low"],
            high=q["high"],
            hit=_meaningful(source, info),
        )
        return picture.png_bytes(rgb), legend | {"unit": info.unit}

    def difference(self, q: Tree) -> tuple[bytes, dict]:
        """Return PNG and legend of |A - B|, on a logarithmic scale unless q's low is 0."""
        when = self._when(q["t"])
        for key in "ab":
            check_pass(q[key][0], self._buffers(), key)
        a, b = (np.asarray(self._array(when, name, source), np.float64) for name, source in (q["a"], q["b"]))
        if a.shape != b.shape:
            raise ConfigError(
                "have different numbers of components",
                where="a, b",
                value=", ".join(":".join(q[k]) for k in "ab"),
                accepted="two of the same kind",
            )
        which = "length" if q["component"] == "auto" else q["component"]
        with np.errstate(invalid="ignore"):
            change = np.where(a == b, 0.0, a - b)
        values = np.abs(pictures.component(change, which))
        # The scale runs from the smallest to the largest difference; without any, it is arbitrary.
        some = values[np.isfinite(values) & (values > 0)]
        low, high = (float(v) for v in (np.quantile(some, 0.01), some.max())) if some.size else (1e-12, 1.0)
        low, high = min(low, 0.999 * high) if q["low"] is None else q["low"], high if q["high"] is None else q["high"]
        if low > 0:  # logarithmic: one flipped pixel on a silhouette would hide everything else
            values = np.where(np.isnan(values), values, np.clip(values, low, None))
        rgb, legend = pictures.picture(
            "depth", values, which="length", colours=q["map"] or picture.ERROR_MAP, low=low, high=high
        )
        return picture.png_bytes(rgb), legend | {"unit": PASSES[q["b"][0]].unit}

    def verdict(self, q: Tree) -> dict:
        """Return the comparison of all buffers with the reference: the verdict of ``diff``, and its text."""
        comparison = self.comparison(self._when(q["t"]))
        reports = [comparison.report(name) for name in comparison.names()]
        result = verdict(reports, self.renderer.unused, comparison.left_out())
        titles = {name: info.title for name, info in PASSES.items()}
        return _finite(
            result
            | {
                "titles": titles,
                "buffers": [r.quantity.name for r in reports if not r.passed],
                "compared": len(reports),
            }
        )

    def probe(self, q: Tree) -> dict:
        """Return the result of the command ``probe``, with its text of every number."""
        when = self._when(q["t"])
        x, y = check_pixel(self.subject.scene, f"{q['x']},{q['y']}")
        comparison = self.comparison(when)
        answer = probe(comparison.gpu, comparison.ref, x, y, comparison)
        for row in (*answer["buffers"], *answer["positions"]):
            row |= {f"{side}_text": _numbers(row[side]) for side in SOURCES}
        answer["surface_text"] = {side: _surface_text(answer["surface"][side]) for side in SOURCES}
        return _finite(answer)

    # ---- reloading ---------------------------------------------------------------------------------------------

    def reload(self) -> None:
        """Use the edited shaders if all of them compile and draw; otherwise keep the old
        ones and set :attr:`errors`."""
        old = self.renderer.gl.shaders
        new = _Loader(self.renderer.gl.ctx, self.folder)
        self.renderer.use_shaders(new)
        try:
            self._draw_all(self._shown)
        except ShaderError as error:
            # Each stage that includes the line reports the same message.
            diagnostics = dict.fromkeys(diagnose(error, self._sources(new), new.folder))
            self.errors = [d for d in diagnostics if d.kind == "error"][:MOST_ERRORS]
        except Exception as error:  # noqa: BLE001 - an edit that compiles but cannot be drawn with: not the tool's end
            self.errors = [
                Diagnostic(new.asked[0], 0, 0, "error", f"cannot be drawn with: {type(error).__name__}: {error}")
            ]
        else:
            self.errors = []
            self.generation += 1
            old.clear()
            self.gpu.cache_clear()
            self.comparison.cache_clear()
            return
        self.renderer.use_shaders(old)
        new.clear()

    def _sources(self, loader: _Loader) -> dict:
        try:
            name, defines = loader.asked
            return {stage: expand(name, stage, defines, loader.folder) for stage in stages_of(defines)}
        except ShaderError:
            return {}

    def stamps(self) -> tuple:
        """Return a value that changes whenever a shader file does. Safe in any thread."""
        out = []
        for path in [*files_of(self.folder), *own_programs()]:
            try:
                # Editors replace a file by renaming: it may be absent for a moment, or have another inode.
                info = path.stat()
                out.append((str(path), info.st_mtime_ns, info.st_size, info.st_ino))
            except OSError:
                pass
        return tuple(out)


class Worker:
    """Runs an Inspector in its own thread, and watches its files. ``call`` may be used in any thread."""

    def __init__(self, inspector: Inspector):
        self.inspector = inspector
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="render")
        self._stop = threading.Event()
        self.changed = threading.Condition()
        self.version = 1  # counts reloads, good and bad
        try:
            self.call(inspector.open)
        except BaseException:
            self._thread.shutdown()
            raise
        self._watcher = threading.Thread(target=self._watch, name="watch", daemon=True)
        self._watcher.start()

    def call(self, function: Any, *arguments: Any) -> Any:
        """Return the result of ``function`` in the render thread; exceptions are raised here."""
        if self._stop.is_set():
            raise BlinkGLError("the server is stopping")
        return self._thread.submit(function, *arguments).result()

    def _watch(self) -> None:
        seen = last = self.inspector.stamps()
        while not self._stop.wait(POLL_S):
            # Two equal checks mean that no editor is writing at the moment.
            last, stamps = self.inspector.stamps(), last
            if stamps == last != seen:  # not while an editor is still writing: a file is empty for a moment
                seen = stamps
                self.call(self.inspector.reload)
                with self.changed:
                    self.version += 1
                    self.changed.notify_all()

    def wait(self, version: int, timeout: float) -> int:
        """Return the version, as soon as it differs from ``version`` or the time is over."""
        with self.changed:
            self.changed.wait_for(lambda: self.version != version or self._stop.is_set(), timeout)
            return self.version

    def close(self) -> None:
        self._stop.set()
        with self.changed:
            self.changed.notify_all()
        self._watcher.join()
        self._thread.submit(self.inspector.close)
        self._thread.shutdown()
