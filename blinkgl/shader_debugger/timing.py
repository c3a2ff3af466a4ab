"""GPU time of every pass that generation runs for this configuration, by timer queries (GL_TIMESTAMP before and after).

A pass is timed as a whole, from clearing to the last draw, and waited for. Its *half-resolution twin* is the same pass
of the same scene with a quarter of the pixels: with V the vertex work and F the fragment work, T = V + F and T_half = V
+ F / 4, hence F = 4/3 (T - T_half). "Vertex" is thus all that does not grow with the pixels: vertex work, clearing,
draw calls, and on a software renderer, whose time stamps are the CPU's, the program that issues them. Program variants
are timed draw by draw in a second run, each draw waited for, so that tiled and deferred rasterisers cannot put one
draw's work into another's query; their sum is therefore larger than the pass.

llvmpipe bins a whole frame and answers queries tile by tile: inside an open frame, GL_TIME_ELAPSED is that of the last
tile (a few µs instead of some ms). On software renderers the work is therefore waited for around each time stamp; it
then agrees with the wall clock.

Frames are drawn whole; under a still camera generation redraws only what moves, which takes less.
overdraw: fragments that passed the depth test per pixel (GL_SAMPLES_PASSED), 1 when every pixel is shaded once. The
first run of everything is not counted: programs compile then.
"""

from __future__ import annotations

import ctypes
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from blinkgl.labels import LABELS, asked_for
from blinkgl.render.antialiasing import samples_of
from blinkgl.render.passes import Geometry, Pass
from blinkgl.scene.types import Scene
from blinkgl.shader_debugger.session import DebugPainter, DebugRenderer, Subject, When, open_renderer

HALF = 2


def half_scene(scene: Scene) -> Scene:
    """The same view at half the width and height (rounded down)."""
    camera = scene.camera
    return scene.with_camera(camera.resized(max(1, camera.width // HALF), max(1, camera.height // HALF)))


@dataclass
class Draws:
    """Of one pass or variant in one run."""

    gpu_ms: float = 0.0
    wall_ms: float = 0.0
    draws: int = 0
    triangles: int = 0
    fragments: int = 0
    variants: dict[str, Draws] = field(default_factory=dict)


class Stopwatch:
    """GPU time between start and stop by two time stamp queries, and the fragments drawn between them."""

    _TIMESTAMP, _RESULT = 0x8E28, 0x8866

    def __init__(self, gl: Any):
        uint, pointer = ctypes.c_uint, ctypes.c_void_p
        self._gl = gl
        self._stamp = gl.function("glQueryCounter", None, uint, uint)
        self._get = gl.function("glGetQueryObjectui64v", None, uint, uint, pointer)
        self._delete = gl.function("glDeleteQueries", None, ctypes.c_int, pointer)
        self._ids = (uint * 2)()
        gl.function("glGenQueries", None, ctypes.c_int, pointer)(2, self._ids)
        self._samples = gl.ctx.query(samples=True)

    def _mark(self, which: int) -> None:
        if self._gl.is_software:
            self._gl.ctx.finish()
        self._stamp(self._ids[which], self._TIMESTAMP)
        if self._gl.is_software:
            self._gl.ctx.finish()

    def start(self) -> None:
        self._gl.ctx.finish()
        self._mark(0)
        self._samples.__enter__()

    def stop(self) -> tuple[float, int]:
        """(ms, fragments) since :meth:`start`; waits for the GPU."""
        self._samples.__exit__(None, None, None)
        self._mark(1)
        self._gl.ctx.finish()
        times = []
        for query in self._ids:
            value = ctypes.c_uint64()
            self._get(query, self._RESULT, ctypes.byref(value))
            times.append(value.value)
        return (times[1] - times[0]) * 1e-6, self._samples.samples

    def release(self) -> None:
        self._delete(2, self._ids)


class TimedPainter(DebugPainter):
    """Counts what is drawn after :meth:`start`; measures it draw by draw when ``each`` is set."""

    def __init__(self, gl: Any, scene: Scene, resources: Any, stats: Any):
        super().__init__(gl, scene, resources, stats)
        self.watch = Stopwatch(gl)
        self.each, self.result = False, Draws()
        self._pass: Pass | None = None

    def start(self, each: bool) -> None:
        self.each, self.result = each, Draws()

    def programs(self, pass_: Any) -> Any:
        self._pass = pass_
        return super().programs(pass_)

    def draw(self, uniforms: Any, item: Any) -> Any:
        triangles = len(item.mesh.faces)
        if self.each:
            self.watch.start()
            super().draw(uniforms, item)
            ms, fragments = self.watch.stop()
            words = (*self._pass.defines(item.kind), *item.kind.defines(self._pass.lit))
            variant = " ".join([self._pass.program, *(word.removeprefix("OUT_") for word in words)])
            one = self.result.variants.setdefault(variant, Draws())
            one.gpu_ms, one.fragments = one.gpu_ms + ms, one.fragments + fragments
            one.draws, one.triangles = one.draws + 1, one.triangles + triangles
        else:
            super().draw(uniforms, item)
        self.result.draws += 1
        self.result.triangles += triangles


class TimedRenderer(DebugRenderer):
    """A renderer whose passes are measured: nothing of a frame is read."""

    def __init__(self, gl: Any, scene: Scene, config: Any):
        self.timed: TimedPainter | None = None
        super().__init__(gl, scene, config, painter=self._watched)

    def _watched(self, *arguments) -> TimedPainter:
        self.timed = TimedPainter(*arguments)
        return self.timed

    def release(self) -> None:
        self.timed.watch.release()
        super().release()

    def run(self, call: Any, each: bool) -> Draws:
        """What ``call(self)`` draws; as a whole, or draw by draw."""
        self.timed.start(each)
        if each:
            call(self)
            return self.timed.result
        self.timed.watch.start()
        wall = time.perf_counter()
        call(self)
        result = self.timed.result
        result.gpu_ms, result.fragments = self.timed.watch.stop()
        result.wall_ms = (time.perf_counter() - wall) * 1e3
        return result


def passes_of(subject: Subject, when: When) -> dict[str, tuple]:
    """name -> (call on a renderer, its scale: samples per pixel along x and y) of each pass that
    generation runs for this configuration."""
    config = subject.config
    asked, render = asked_for(config.labels), config.render
    rate = config.timeline.reconstruction == "hermite"
    out = {
        "luminance" + (" and rate" if rate else ""): (
            lambda r: r.luminance(when.t_ns, rate),
            samples_of(render.antialiasing).grid,
        )
    }
    if config.timeline.kind != "uniform":
        every = config.timeline.sample_every
        if config.timeline.kind == "brightness":
            out["brightness (timeline)"] = (lambda r: r.brightness(when.t_ns, every), 1 / every)
        else:
            out["velocity (timeline)"] = (lambda r: r.velocity(when.t_ns, every), 1 / every)
    if "images" in asked or config.preview.enabled:
        out["colour"] = (lambda r: r.colour(when.t_ns), samples_of(render.image_antialiasing).grid)
    names, ends = asked.buffers, {"forward": when.forward_ns, "backward": when.backward_ns}
    if names:
        out["labels"] = (lambda r: r.draw(Geometry(names), when.t_ns, ends), 1)
    if asked.there:
        there = asked.there
        who = ", ".join(dict.fromkeys(LABELS[name].said for name in asked if LABELS[name].there))
        out[f"{who}, per direction"] = (lambda r: r.draw(Geometry(there), when.forward_ns), 1)
    return out


def measure(subject: Subject, when: When, shaders: str | None = None, repeat: int = 15) -> dict:
    """Plain data (JSON): renderer, resolution, and per pass the medians over ``repeat`` runs. Times in ms."""
    with open_renderer(subject, shaders, as_configured=True) as opened:
        gl, config = opened.gl, subject.config.render
        out = {
            "config": subject.path,
            "sequence": subject.index,
            "t_s": when.t_ns * 1e-9,
            "renderer": gl.renderer,
            "version": gl.version,
            "software": gl.is_software,
            "width": opened.width,
            "height": opened.height,
            "repeat": repeat,
            "passes": [],
        }
        with (
            TimedRenderer(gl, subject.scene, config) as full,
            TimedRenderer(gl, half_scene(subject.scene), config) as half,
        ):
            ratio = full.width * full.height / (half.width * half.height)
            for name, (call, scale) in passes_of(subject, when).items():
                out["passes"].append(_measure_pass(name, call, scale, full, half, ratio, repeat))
    return out


def _measure_pass(name, call, scale, full: TimedRenderer, half: TimedRenderer, ratio: float, repeat: int) -> dict:
    runs: dict[str, list[Draws]] = {"full": [], "half": [], "each": []}
    for k in range(repeat + 1):
        # Interleaved: drift of the machine hits all alike.
        for kind, renderer in (("full", full), ("half", half), ("each", full)):
            result = renderer.run(call, each=kind == "each")
            if k:
                runs[kind].append(result)

    def median(kind, key="gpu_ms"):
        return float(np.median([getattr(run, key) for run in runs[kind]]))

    whole, small, first = median("full"), median("half"), runs["full"][0]
    # noise may put the split outside [0, whole]
    fragment = min(whole, max(0.0, (whole - small) * ratio / (ratio - 1))) if ratio > 1 else 0.0
    pixels = int(full.width * scale) * int(full.height * scale)
    # Less those of what is drawn over it: the box filter, or the lines of silhouettes, which no item draws.
    fragments = min(first.fragments, sum(one.fragments for one in runs["each"][0].variants.values()))
    variants = []
    for variant, one in runs["each"][0].variants.items():
        ms = float(np.median([run.variants[variant].gpu_ms for run in runs["each"]]))
        variants.append(
            {
                "variant": variant,
                "gpu_ms": ms,
                "draws": one.draws,
                "triangles": one.triangles,
                "fragments": one.fragments,
            }
        )
    variants.sort(key=lambda v: -v["gpu_ms"])
    return {
        "pass": name,
        "gpu_ms": whole,
        "wall_ms": median("full", "wall_ms"),
        "half_gpu_ms": small,
        "fragment_ms": fragment,
        "vertex_ms": whole - fragment,
        "draws": first.draws,
        "triangles": first.triangles,
        "fragments": fragments,
        "overdraw": fragments / pixels,
        "variants": variants,
    }


def as_text(result: dict) -> str:
    """The timing in lines for a person."""
    lines = [
        (
            f"{result['config']}, sequence {result['sequence']}, t = {result['t_s']:.6g} s, {result['width']} x "
            f"{result['height']} px, {result['renderer']}, median of {result['repeat']}"
        ),
        "",
        (
            f"{'pass':<26} {'GPU ms':>8} {'wall ms':>8} {'vertex':>8} {'fragment':>8} {'draws':>6} {'triangles':>9} "
            f"{'fragments':>10} {'overdraw':>8}"
        ),
    ]
    for p in result["passes"]:
        lines.append(
            f"{p['pass']:<26} {p['gpu_ms']:>8.3f} {p['wall_ms']:>8.3f} {p['vertex_ms']:>8.3f} "
            f"{p['fragment_ms']:>8.3f} {p['draws']:>6} {p['triangles']:>9} {p['fragments']:>10} {p['overdraw']:>8.2f}"
        )
    lines += ["", "per program variant, each draw waited for (the sum exceeds the pass):"]
    for p in result["passes"]:
        for v in p["variants"]:
            lines.append(
                f"  {p['pass']:<24} {v['gpu_ms']:>8.3f} ms {v['draws']:>5} draws {v['triangles']:>8} triangles "
                f"{v['fragments']:>9} fragments  {v['variant']}"
            )
    return "\n".join(lines)
