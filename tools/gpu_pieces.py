"""What ``gpu_suite.py`` measures, piece by piece: a class each, which adds rows that are not there yet.

A row is kept as soon as it is measured, so pieces loop over cases of seconds each and ask ``key in rows`` first. What a
machine cannot do is :class:`Absent`, with the reason; nothing else is caught here.
"""

from __future__ import annotations

import itertools
import multiprocessing
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from functools import lru_cache
from importlib import resources
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from blinkgl.card import Atlas, AtlasV2e, CardEsim, CardV2e, Voxels
from blinkgl.card.choice import CARDS as KERNELS
from blinkgl.card.reductions import OfTextures
from blinkgl.card.tensors import WAYS, way_here
from blinkgl.config.events import EmulatorConfig, EsimConfig, V2eConfig
from blinkgl.config.sequence import RenderConfig, RunTemplate, load_run
from blinkgl.dataset.generate import generate_run
from blinkgl.errors import BlinkGLError, GLError
from blinkgl.events import Esim
from blinkgl.events.table import emulator_of
from blinkgl.gl import GLContext, create_context, egl_devices
from blinkgl.labels import LABELS, LabelRequest
from blinkgl.render.renderer import Renderer
from blinkgl.show import checks as doctor
from blinkgl.timeline.reductions import OfArrays
from blinkgl.tools import bench_accuracy
from blinkgl.tools.bench import pace, probe_scene

if TYPE_CHECKING:
    from blinkgl.tools.gpu_suite import Rows

SECOND, STEP_NS = 1_000_000_000, 1_000_003
SIZES = {"128x128": (128, 128), "346x260": (346, 260), "640x480": (640, 480), "1280x720": (1280, 720)}
SMALL = {"64x48": (64, 48)}
FLOATS_APART = 2e-4
"""Of the largest value of a picture: what two correct rasterisers may differ by off silhouettes (texture filters have 8
bits of fraction)."""


class Absent(Exception):
    """This machine cannot do it; the text says why."""


class Rate(NamedTuple):
    """per_s : runs per second of wall time.   cpu_ms : processor milliseconds of this process per run."""

    per_s: float
    cpu_ms: float


def rate(run: Callable[[], object], seconds: float, warm_up: int = 2) -> Rate:
    """Of ``run()``, over and over for so many seconds, thrice at least."""
    for _ in range(warm_up):
        run()
    count, began, spent = 0, time.perf_counter(), time.process_time()
    while count < 3 or time.perf_counter() - began < seconds:
        run()
        count += 1
    return Rate(count / (time.perf_counter() - began), 1000 * (time.process_time() - spent) / count)


def sizes(options: Namespace) -> Mapping[str, tuple[int, int]]:
    return SMALL if options.small else SIZES


def seconds(options: Namespace) -> float:
    """That a case is measured for."""
    return 0.1 if options.small else 1.0


@contextmanager
def context(options: Namespace) -> Iterator[GLContext]:
    """What draws, or Absent. Prints whether it is a card."""
    try:
        gl = create_context(options.backend, options.device)
    except GLError as error:
        raise Absent(f"nothing draws here: {error}") from None
    with gl:
        print(f"{gl!r}{', the processor: no context on a card' if gl.is_software else ''}", flush=True)
        yield gl


class Piece:
    """title : of its table."""

    title: ClassVar[str]

    @classmethod
    def run(cls, rows: Rows, options: Namespace) -> None:
        """Adds the rows that are not there. Raises Absent."""
        raise NotImplementedError


class Doctor(Piece):
    title = "what the machine has"

    @classmethod
    def run(cls, rows: Rows, options: Namespace) -> None:
        for check in doctor.examine(options.backend, options.device).checks:
            line = asdict(check)
            key = f"{line.pop('section')}: {line.pop('name')}"
            if key not in rows:
                rows.add(key, **line)
        for index, text in enumerate(egl_devices()):
            if (key := f"context on EGL device {index}") not in rows:
                try:
                    with create_context("egl", index) as gl:
                        rows.add(key, status="info", value=f"{gl.renderer}, {gl.version}")
                except BlinkGLError as error:
                    rows.add(key, status="absent", value=f"{text}: {error}")


class Frames(Piece):
    """Drawn by the card and by the processor's rasteriser, where there is one; and by the float64 reference."""

    title = "frames and labels: the card beside the processor and beside the float64 reference"

    @classmethod
    def run(cls, rows: Rows, options: Namespace) -> None:
        config = load_run(
            resources.files("blinkgl.configs") / "flying_objects.yaml",
            ["camera.width=96", "camera.height=72"] if options.small else [],
        )
        with context(options) as gl:
            for index in range(1 if options.small else 3):
                if (key := f"beside the reference, sequence {index}") not in rows:
                    found = bench_accuracy.compare(gl, config, index)
                    names = ("pixels", "ids_wrong", "depth_max", "velocity_max", "forward_max", "backward_max")
                    rows.add(key, **{name: found[name] for name in names})
            with _processor(gl) as other:
                for name, (width, height) in sizes(options).items():
                    for antialiasing in ("none", "msaa4", "taps4", "edges", "ssaa2"):
                        key = f"luminance {name}, {antialiasing}"
                        if key not in rows:
                            rows.add(key, **cls.apart(gl, other, width, height, antialiasing))

    @staticmethod
    def apart(gl: GLContext, other: GLContext, width: int, height: int, antialiasing: str) -> dict[str, Any]:
        """Of one frame: largest and median difference as shares of the largest value, share of pixels beyond
        FLOATS_APART, and who drew."""
        pictures, scene = [], probe_scene("tri/16", width, height)
        for one in (gl, other):
            one.resume()
            with Renderer(one, scene, RenderConfig(antialiasing=antialiasing)) as renderer:
                pictures.append(renderer.luminance(SECOND // 3).read())
        gl.resume()
        apart = np.abs(pictures[0] - pictures[1]) / pictures[1].max()
        return {
            "largest": float(apart.max()),
            "median": float(np.median(apart)),
            "beyond": float((apart > FLOATS_APART).mean()),
            "beside": f"{other.backend}:{other.device} {other.renderer}",
        }


@contextmanager
def _processor(gl: GLContext) -> Iterator[GLContext]:
    """A context of the processor's that is not ``gl``, or Absent."""
    software = [k for k, text in enumerate(egl_devices()) if "software" in text.lower()]
    for backend, device in [*(("egl", k) for k in software), ("osmesa", 0)]:
        if (backend, device) != (gl.backend, gl.device):
            try:
                other = create_context(backend, device)
            except GLError:
                continue
            with other:
                yield other
            return
    raise Absent("no rasteriser of the processor's beside it (Mesa's EGL or OSMesa)")


def noise(height: int, width: int, density: float, frames: int, seed: int = 1) -> np.ndarray:
    """(frames, H, W) float32 in which ``density`` events a pixel and frame are, at thresholds of 0.2: pixels drawn by
    lot go there and back again, over the same levels each time, from the second frame on."""
    rng, levels = np.random.default_rng(seed), max(1, int(np.ceil(density)))
    moving = rng.choice((-1.0, 1.0), (height, width)) * (rng.random((height, width)) < density / levels)
    places = np.where(np.arange(frames) % 2 == 1, levels + 0.5, -0.2)  # in thresholds; a little beyond the first level
    places[0] = 0.0
    return np.exp(0.2 * places[:, None, None] * moving - 1.0).astype(np.float32)


class Events(Piece):
    title = "events: the card's beside numba's, bit for bit"
    VARIANTS: ClassVar = {
        "plain": EsimConfig(threshold_sigma=0.0),
        "spread": EsimConfig(threshold_sigma=0.03),
        "refractory": EsimConfig(threshold_sigma=0.0, refractory_us=100.0),
        "jitter": EsimConfig(threshold_sigma=0.0, threshold_jitter=0.02),
        "threshold 0.02": EsimConfig(contrast_threshold=0.02),
        "v2e clean": V2eConfig(preset="clean"),
        "v2e": V2eConfig(),
        "v2e noisy": V2eConfig(preset="noisy", causes=True),
    }

    @classmethod
    def run(cls, rows: Rows, options: Namespace) -> None:
        places = {"16x16": (16, 16), **sizes(options)} | ({} if options.small else {"1920x1080": (1920, 1080)})
        with context(options) as gl:
            for (name, size), (variant, config), density in itertools.product(
                places.items(), cls.VARIANTS.items(), (0.01, 0.3, 3.0)
            ):
                key = f"{name}, {variant}, {density:g} events a pixel and frame"
                if key not in rows:
                    rows.add(key, **cls.compared(gl, config, *size, density))

    @staticmethod
    def compared(gl: GLContext, config: EmulatorConfig, width: int, height: int, density: float) -> dict[str, Any]:
        """Events of both, how many steps have others, and whether the states agree after the last."""
        kind: Any = emulator_of(config)
        both = kind(height, width, config, 3), KERNELS[kind](height, width, config, 3, gl=gl, late=False)
        counts, differ = [0, 0], 0
        for k, frame in enumerate(noise(height, width, density, 5)):
            a, b = (emulator.step(frame, k * STEP_NS) for emulator in both)
            counts = [counts[0] + len(a), counts[1] + len(b)]
            differ += not (
                a.columns == b.columns and all(np.array_equal(getattr(a, c), getattr(b, c)) for c in a.columns)
            )
        states = [emulator.state_dict() for emulator in both]
        both[1].release()
        same = all(np.array_equal(states[0][name], states[1][name]) for name in states[0])
        return {"numba": counts[0], "card": counts[1], "steps_that_differ": differ, "same_state": same}


class Passes(Piece):
    title = "frames/s of every pass, on the card alone and read back"

    @classmethod
    def run(cls, rows: Rows, options: Namespace) -> None:
        with context(options) as gl:
            for (name, size), kind in itertools.product(sizes(options).items(), ("tri/16", "full")):
                antialiasings = ("none", "taps4", "edges", "msaa4", "ssaa2", "ssaa4")
                for antialiasing in antialiasings:
                    wanted = {f"luminance {antialiasing}": lambda r, t: r.luminance(t)}
                    if antialiasing == "none":
                        wanted |= cls.others()
                    wanted = {f"{name} {kind}, {what}": draw for what, draw in wanted.items()}
                    wanted = {key: draw for key, draw in wanted.items() if key not in rows}
                    if wanted:
                        scene = probe_scene(kind, *size)
                        with Renderer(gl, scene, RenderConfig(antialiasing=antialiasing)) as renderer:
                            for key, draw in wanted.items():
                                rows.add(key, **cls.measured(gl, renderer, draw, seconds(options)))

    @staticmethod
    def others() -> dict[str, Callable[[Renderer, int], Any]]:
        drawn = LabelRequest(*(name for name in ("flow_forward", "depth", "ids") if name in LABELS))
        ranks = lru_cache(1)(lambda renderer: OfTextures(renderer.gl))
        return {
            "luminance and rate": lambda r, t: r.luminance(t, rate=True),
            "colour": lambda r, t: r.colour(t, "none"),
            "brightness, every 8th": lambda r, t: r.brightness(t, 8),
            "velocity": lambda r, t: r.velocity(t),
            "velocity, every 8th": lambda r, t: r.velocity_of_movers(t, 8),
            "velocity, every 8th, its percentile there": lambda r, t: ranks(r).speeds(r.velocity_of_movers(t, 8), 95.0),
            "velocity, every 8th, NumPy's percentile": lambda r, t: OfArrays().speeds(r.velocity_of_movers(t, 8), 95.0),
            "labels: flow, depth, ids": lambda r, t: r.labels(t, drawn, t + SECOND // 100),
        }

    @staticmethod
    def measured(gl: GLContext, renderer: Renderer, draw: Callable, span_s: float) -> dict[str, float]:
        """frames/s without and with read-back. (Labels are read back either way.)"""
        moments = (k * 7_000_000 % (2 * SECOND) for k in itertools.count())

        def stays() -> None:
            draw(renderer, next(moments))
            gl.ctx.finish()

        def comes() -> None:
            frame = draw(renderer, next(moments))
            if hasattr(frame, "view"):
                frame.view()

        alone, read = rate(stays, span_s), rate(comes, span_s)
        return {"frames_per_s": alone.per_s, "read_back_per_s": read.per_s, "cpu_ms": alone.cpu_ms}


class Kernel(Piece):
    title = "the event kernel alone, by density; frames lie on the card"

    @classmethod
    def run(cls, rows: Rows, options: Namespace) -> None:
        with context(options) as gl:
            for (name, size), density in itertools.product(sizes(options).items(), (0.0, 0.01, 0.07, 0.31, 1.0, 5.0)):
                many = ("plain", "refractory", "jitter", "v2e clean", "v2e", "v2e noisy")
                for variant in many if density == 0.31 else ("plain", "v2e"):
                    key = f"{name}, {variant}, {density:g} events a pixel and frame"
                    if key not in rows:
                        config = Events.VARIANTS[variant]
                        rows.add(key, **cls.measured(gl, config, *size, density, seconds(options)))

    @staticmethod
    def measured(
        gl: GLContext, config: EmulatorConfig, width: int, height: int, density: float, span_s: float
    ) -> dict[str, Any]:
        """Steps/s and events/s: events stay there; are read back and sorted; numba's on one core."""
        clip = noise(height, width, density, 3)
        textures = [gl.ctx.texture((width, height), 1, frame.tobytes(), dtype="f4") for frame in clip]
        found: dict[str, Any] = {}
        kind: Any = emulator_of(config)
        for name, frames in (("stay", textures), ("read", textures), ("numba", clip)):
            emulator: Any = (
                kind(height, width, config, 1) if name == "numba" else KERNELS[kind](height, width, config, gl=gl)
            )
            counts, steps = [0], itertools.count()

            def one(name=name, frames=frames, emulator=emulator, counts=counts, steps=steps) -> None:
                k = next(steps)
                step = emulator.advance if name == "stay" else emulator.step
                made = step(frames[1 + k % 2 if k else 0], k * STEP_NS)
                counts[0] += made if isinstance(made, int) else len(made)

            for _ in range(3):
                one()
            counts[0], before = 0, next(steps)
            measured = rate(one, span_s, 0)
            events = counts[0] / (next(steps) - before - 1)
            found |= {f"{name}_steps_per_s": measured.per_s, f"{name}_M_events_per_s": events * measured.per_s / 1e6}
            emulator.release()
        for texture in textures:
            texture.release()
        return {"events_per_step": events, **found}


def pipeline(
    gl: GLContext, count: int, width: int, height: int, how: str
) -> tuple[Callable[[], int], Callable[[], None]]:
    """(frame of ``count`` sequences drawn in turn and made events of, the end): the function returns the events.

    how : "voxels", all stays on the card; "events", they are read back; "batch", read back, the sequences being tiles
    of one kernel; "v2e" and "v2e batch", the same of V2E; "numba", frames are read back."""
    batch: Any = {"batch": Atlas, "v2e batch": AtlasV2e}.get(how)
    parts, atlas = [], None if batch is None else batch(gl, height, width, count)
    for k in range(count):
        renderer = Renderer(gl, probe_scene("tri/16", width, height), RenderConfig())
        emulator: Any
        if atlas is not None:
            emulator = atlas.emulator(V2eConfig() if how == "v2e batch" else EsimConfig())
        elif how == "v2e":
            emulator = CardV2e(height, width, gl=gl)
        else:
            emulator = Esim(height, width) if how == "numba" else CardEsim(height, width, gl=gl)
        parts.append(
            (renderer, emulator, Voxels(emulator) if how == "voxels" else None, itertools.count(k * 1_000_000))
        )
        if how == "voxels":
            parts[-1][2].begin(0, 1_000_000_000)
    ends: list[Callable[[], None]] = [part.release for row in parts for part in reversed(row[:3]) if part is not None]
    ends += [] if atlas is None else [atlas.release]

    def frame() -> int:
        events = 0
        for renderer, emulator, voxels, steps in parts:
            t_ns = next(steps) * 1_000_000 % (2 * SECOND)
            at = (emulator.t_ns or 0) + 1_000_000
            drawn = renderer.luminance(t_ns)
            if voxels is None:
                events += len(emulator.step(drawn.view() if how == "numba" else drawn.texture(), at))
            else:
                events += emulator.advance(drawn.texture(), at)
                voxels.add()
        return events

    return frame, lambda: [end() for end in ends] and None


class EndToEnd(Piece):
    title = "drawn, made events of, and put into voxels (1 ms between frames)"

    @classmethod
    def run(cls, rows: Rows, options: Namespace) -> None:
        with context(options) as gl:
            for (name, size), how in itertools.product(sizes(options).items(), ("voxels", "events", "numba")):
                if (key := f"{name}, {how}") not in rows:
                    rows.add(key, **paced(gl, 1, size, how, seconds(options)))


def paced(gl: GLContext, count: int, size: tuple[int, int], how: str, span_s: float) -> dict[str, float]:
    """Frames/s of ``count`` sequences together, and processor ms a frame."""
    frame, end = pipeline(gl, count, *size, how)
    events: list[int] = []
    measured = rate(lambda: events.append(frame()), span_s, 3)
    gl.ctx.finish()
    end()
    return {
        "frames_per_s": count * measured.per_s,
        "M_events_per_s": float(np.mean(events[3:])) * measured.per_s / 1e6,
        "cpu_ms_per_frame": measured.cpu_ms / count,
    }


def paced_here(size: tuple[int, int], how: str, span_s: float, backend: str, device: int) -> dict[str, float]:
    """:func:`paced` of one sequence in a process with a context of its own."""
    with create_context(backend, device) as gl:
        return paced(gl, 1, size, how, span_s)


class Batches(Piece):
    title = "several small sequences: as a batch or in turn in one context, and in processes with a context each"

    @classmethod
    def run(cls, rows: Rows, options: Namespace) -> None:
        small = dict(list(sizes(options).items())[: 1 if options.small else 2])
        counts = (1, 2) if options.small else (1, 2, 4, 8, 16)
        with context(options) as gl:
            hows = {
                "batch": "as a batch",
                "events": "in turn, events",
                "voxels": "in turn, voxels",
                "v2e batch": "as a batch, V2E",
                "v2e": "in turn, V2E",
            }
            for (name, size), count, how in itertools.product(small.items(), counts, hows):
                if (key := f"{name}, {count} in one context {hows[how]}") not in rows:
                    rows.add(key, **paced(gl, count, size, how, seconds(options)))
        spawn = multiprocessing.get_context("spawn")
        for (name, size), count, how in itertools.product(small.items(), counts, ("events", "voxels")):
            key = f"{name}, {count} processes, {how}"
            if key in rows:
                continue
            with spawn.Pool(count) as pool:
                arguments = (size, how, 4 * seconds(options), options.backend, options.device)
                found = pool.starmap(paced_here, [arguments] * count, chunksize=1)
            mean = {k: float(np.mean([one[k] for one in found])) for k in found[0]}
            rows.add(key, **{k: v * (count if k.endswith("_per_s") else 1) for k, v in mean.items()})


class Tensors(Piece):
    title = "tensors for torch: on the card by CUDA beside OpenGL, through pinned memory, through pageable memory"

    @classmethod
    def run(cls, rows: Rows, options: Namespace) -> None:
        try:
            import torch
        except ImportError as error:
            raise Absent(f"no torch here: {error}") from None
        with context(options) as gl:
            if "this machine" not in rows:
                way = way_here(gl)
                rows.add("this machine", way=way.way, why=way.why)
            device = "cuda" if torch.cuda.is_available() else "cpu"
            for (name, size), bins, at_best in itertools.product(
                sizes(options).items(), (5, 15), WAYS if device == "cuda" else WAYS[-1:]
            ):
                if (key := f"{name}, {bins} bins, {at_best}") not in rows:
                    rows.add(key, **cls.measured(gl, *size, bins, at_best, seconds(options)))

    @staticmethod
    def measured(
        gl: GLContext, width: int, height: int, bins: int, at_best: str, span_s: float
    ) -> dict[str, float | bool | str]:
        """Voxel grids, as torch's card has them: with every event of the clip in them, as often as it goes (the grid is
        read and waited for); and with a frame's events added to it before, as a training has it. ``same``: the bytes of
        ``read()``, after either."""
        import torch

        clip = noise(height, width, 0.31, 3)
        textures = [gl.ctx.texture((width, height), 1, frame.tobytes(), dtype="f4") for frame in clip]
        card = CardEsim(height, width, EsimConfig(), gl=gl)
        sink, steps = Voxels(card, bins), itertools.count()
        made: list[Any] = []

        def finish() -> None:
            if torch.cuda.is_available():
                torch.cuda.synchronize()

        def frame() -> None:
            k = next(steps)
            card.advance(textures[1 + k % 2 if k else 0], k * STEP_NS)
            if k % 50 == 0:
                sink.begin(k * STEP_NS // 1000, (k + 50) * STEP_NS // 1000)
            sink.add()

        def whole() -> None:
            made[:] = [sink.tensor(at_best=at_best)]
            finish()

        def sample() -> None:
            frame()
            whole()

        same = lambda: bool(np.array_equal(made[0].cpu().numpy(), sink.read()))
        for _ in range(3):
            frame()
        alone = rate(whole, span_s)
        right = same() and bool(sink.read().any())
        with_events = rate(sample, span_s)
        right, way = right and same(), sink.way(at_best=at_best)
        for thing in (sink, card, *textures):
            thing.release()
        return {
            "way": way.way,
            "why": "" if way.way == at_best else way.why,
            "same": right,
            "M_bytes_per_s": 4 * bins * width * height * alone.per_s / 1e6,
            "tensors_per_s": alone.per_s,
            "cpu_ms": alone.cpu_ms,
            "samples_per_s": with_events.per_s,
        }


class WholeRun(Piece):
    title = "a whole run of flying_objects, files included"

    @classmethod
    def run(cls, rows: Rows, options: Namespace) -> None:
        changes = ["time.duration=0.2", "camera.width=96", "camera.height=72"] if options.small else []
        for device in ("cpu", "gl"):
            if (key := f"events.device: {device}") in rows:
                continue
            template = load_run(
                resources.files("blinkgl.configs") / "flying_objects.yaml",
                [*changes, f"events.device={device}", f"gl.backend={options.backend}", f"gl.device={options.device}"],
            )
            with tempfile.TemporaryDirectory() as folder:
                short = RunTemplate(
                    {**template.tree, "time": {**template.tree["time"], "duration": 0.1}}, template.base
                )
                list(generate_run(short, f"{folder}/warm", 1))
                spent = time.process_time()
                report = next(iter(generate_run(template, f"{folder}/timed", 1)))
            rows.add(
                key,
                seconds_per_simulated_s=report.total_s / report.simulated_s,
                cpu_s=time.process_time() - spent,
                frames=report.frames,
                events=report.events,
                **{f"{stage}_s": spent_s for stage, spent_s in report.seconds.items()},
            )


class Trade(Piece):
    title = "hermite and msaa4 in `trade`, beside what they compete with"
    ONLY: ClassVar = ("displacement 1 px, none", "hermite", "msaa4", "ssaa2", "edges")

    @classmethod
    def run(cls, rows: Rows, options: Namespace) -> None:
        if rows.rows:
            return
        from blinkgl.trade.measure import QUICK, Options
        from blinkgl.trade.run import trade

        changes = ["camera.width=96", "camera.height=72", "time.duration=0.2"] if options.small else []
        template = load_run(
            resources.files("blinkgl.configs") / "flying_objects.yaml",
            [*changes, f"gl.backend={options.backend}", f"gl.device={options.device}"],
        )
        how = Options(**{**asdict(QUICK), "rounds": 1, "levels": ((4, 0.25),)}) if options.small else QUICK
        only = ["msaa4", "displacement 2 px, hermite"] if options.small else list(cls.ONLY)
        for row in trade(template, quick=True, only=only, options=how, say=print)["settings"]:
            names = ("wall_s", "cpu_s", "frames_per_s", "time_median_us", "missed", "extra", "voxel", "events")
            rows.add(row["name"], **{name: row[name] for name in names})


class Online(Piece):
    title = "samples rendered while they are used"

    @classmethod
    def run(cls, rows: Rows, options: Namespace) -> None:
        recipe = str(resources.files("blinkgl.configs") / "eflow" / "real_data.yaml")
        for workers in (1,) if options.small else (1, 2, 4, 8):
            for step_ms in (0.0,) if options.small else (0.0, 10.0, 25.0):
                if (key := f"{workers} workers, steps of {step_ms:g} ms") not in rows:
                    found = pace(recipe, workers, step_ms, 20 if options.small else 300)
                    names = ("samples_per_s", "waited", "render_ms", "failures")
                    rows.add(key, **{name: found[name] for name in names})


class Networks(Piece):
    title = "networks: a window forward, a training step, memory"

    @classmethod
    def run(cls, rows: Rows, options: Namespace) -> None:
        try:
            from eflow.bench import isolated
            from eflow.models import NETWORKS
        except ImportError as error:
            raise Absent(f"no eflow here: {error}") from None
        names = ("ev_flownet-tiny",) if options.small else tuple(NETWORKS)
        places = {"64x64": (64, 64)} if options.small else {"128x128": (128, 128), "640x480": (640, 480)}
        for name, (place, (width, height)), training in itertools.product(names, places.items(), (False, True)):
            for precision in ("fp32",) if options.small else ("fp32", "bf16"):
                key = f"{name}, {place}, {'training step' if training else 'forward'}, {precision}"
                if key in rows:
                    continue
                found = isolated(
                    name=name, height=height, width=width, training=training, precision=precision, repeats=5
                )
                kept = ("ms", "ms_min", "gmacs", "peak_mib", "parameters", "machine", "error")
                rows.add(key, **{k: found[k] for k in kept if k in found})


PIECES: dict[str, type[Piece]] = {
    "doctor": Doctor,
    "frames": Frames,
    "events": Events,
    "passes": Passes,
    "kernel": Kernel,
    "end_to_end": EndToEnd,
    "run": WholeRun,
    "batches": Batches,
    "tensors": Tensors,
    "online": Online,
    "networks": Networks,
    "trade": Trade,
}
"""By name, in the order in which they are measured."""

if __name__ == "__main__":
    sys.exit("see python -m blinkgl.tools.gpu_suite")
