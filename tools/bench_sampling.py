"""How many event frames the same accuracy of event times takes: time sampling x
reconstruction on mixed slow and fast motion.

    python -m blinkgl.tools.bench_sampling [--antialiasing none|ssaa2] [--scenes 3] [--quick] [--json FILE]

Random scenes whose clock runs slow, then fast, then slow again, and a still camera in front of a fast and some slow
objects. Each way of sampling is run at several densities; its events are matched one to one, within pixel, polarity and
5 ms, with those of frames 1/32 px apart (a larger limit would pair missed events with unrelated ones). From each way's
errors over its number of frames follows how many frames it needs for the median *and* the 95th percentile that another
way reaches. It counts frames and errors, so it may run on a busy machine.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from blinkgl.config.base import validate
from blinkgl.config.events import EsimConfig
from blinkgl.config.sequence import RenderConfig, SequenceConfig
from blinkgl.config.timeline import BrightnessTimeline, BudgetTimeline, DisplacementTimeline, UniformTimeline
from blinkgl.events import Events
from blinkgl.gl import create_context
from blinkgl.machine import bench
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import build_scene
from blinkgl.scene.types import Scene
from blinkgl.sequence import Simulation, simulate_sequence
from blinkgl.trade.metrics import EventErrors, SpeedMaps, event_errors

WIDTH, HEIGHT, DURATION_NS, LIMIT_US = 240, 180, 300_000_000, 5_000
SLOW, FAST, FAST_FROM, FAST_TO = 0.25, 4.0, 0.45, 0.65
"""Rates of the mixed scenes' clock, and the share of the sequence in which it runs fast."""
STEPS = dict(min_step_us=20.0, max_step_us=50_000.0)
EMULATOR = EsimConfig(threshold_sigma=0.0)

_US, _PX = (40, 80, 160, 320, 640, 1280, 2560), (0.005, 0.01, 0.02, 0.04, 0.08, 0.16, 0.32)
WAYS: dict[str, list[Any]] = {
    **{
        f"uniform, {r}": [
            UniformTimeline(fps=n / (DURATION_NS * 1e-9), reconstruction=r) for n in (20, 32, 52, 84, 136, 220)
        ]
        for r in ("linear", "hermite")
    },
    **{
        f"displacement, {r}": [
            DisplacementTimeline(max_px=px, reconstruction=r, **STEPS) for px in (0.35, 0.6, 1.0, 1.7, 2.9, 5.0)
        ]
        for r in ("linear", "pchip", "hermite")
    },
    "brightness, hermite": [
        BrightnessTimeline(max_fraction_of_threshold=f, reconstruction="hermite", **STEPS)
        for f in (0.7, 1.2, 2.0, 3.4, 5.8, 10.0)
    ],
    **{
        f"budget µs, {r}": [BudgetTimeline(max_time_error_us=us, reconstruction=r, **STEPS) for us in _US]
        for r in ("linear", "pchip", "hermite")
    },
    **{
        f"budget px, {r}": [BudgetTimeline(max_time_error_px=px, reconstruction=r, **STEPS) for px in _PX]
        for r in ("linear", "hermite")
    },
}
BASES = ("uniform, linear", "displacement, linear")


class WarpedPath:
    """A path whose clock runs at ``SLOW``, ``FAST`` and ``SLOW`` times its own rate, smoothly in
    between; it starts where the path starts."""

    is_static = False

    def __init__(self, path, t0_ns: int, length_ns: int):
        self.path, self.t0_ns, self.t1_ns = path, t0_ns, t0_ns + length_ns
        s = np.linspace(0, 1, 4001)
        ramp = lambda edge: 0.5 * (1 + np.tanh((s - edge) / 0.015))
        self._s, self._rate = s, SLOW + (FAST - SLOW) * (ramp(FAST_FROM) - ramp(FAST_TO))
        self._tau = np.concatenate([[0], np.cumsum((self._rate[1:] + self._rate[:-1]) / 2 * np.diff(s))])

    def _own(self, t_ns):
        """The path's own time, ns, and how fast it runs."""
        s = (np.asarray(t_ns) - self.t0_ns) / (self.t1_ns - self.t0_ns)
        at = np.interp(s, self._s, self._tau) * (self.t1_ns - self.t0_ns)
        return self.t0_ns + np.rint(at).astype(np.int64), np.interp(s, self._s, self._rate)

    def pose(self, t_ns):
        return self.path.pose(int(self._own(t_ns)[0]))

    def derivative(self, t_ns):
        own, rate = self._own(t_ns)
        return self.path.derivative(int(own)) * float(rate)

    def poses(self, t_ns):
        return self.path.poses(self._own(t_ns)[0])


def random_scene(seed: int, still_camera: bool = False) -> Scene:
    motion = {"kind": "static"} if still_camera else {"speed": [0.4, 1.2], "rotation_rate": [10, 30]}
    tree = {
        "camera": {"width": WIDTH, "height": HEIGHT},
        "time": {"duration": 0.6, "label_rate": 1 / 0.6},
        "scene": {
            "kind": "random",
            "objects": {"count": 12, "distance": [2, 8]},
            "camera_motion": motion,
            "object_motion": {"speed": [0.2, 1.5], "rotation_rate": [20, 120], "static_share": 0.4},
        },
    }
    c = validate(SequenceConfig, tree)
    scene = build_scene(
        c.scene, c.camera, c.time.t0_ns, c.time.t1_ns, split="train", seed=seed, sequence=0, base=Path(".")
    )
    warp = lambda path: path if path.is_static else WarpedPath(path, scene.t0_ns, DURATION_NS)
    objects = list(scene.objects)
    if still_camera:  # the first that moves runs fast, the others on their own slow clock
        fast = next(i for i, o in enumerate(objects) if not o.path.is_static)
        objects[fast] = replace(objects[fast], path=warp(objects[fast].path))
    else:
        objects = [replace(o, path=warp(o.path)) for o in objects]
    return replace(scene, objects=tuple(objects), t1_ns=scene.t0_ns + DURATION_NS).with_path(warp(scene.rig.path))


@dataclass
class Run:
    frames: int
    errors: EventErrors
    info: dict


def simulate(timeline, renderer: Renderer) -> tuple[Events, Simulation]:
    run = simulate_sequence(SequenceConfig(timeline=timeline, events=EMULATOR), labels=False, renderer=renderer)
    return Events.concatenate([chunk.events for chunk in run.chunks()]), run


def measure(scene: Scene, gl, antialiasing: str, thin: int, say) -> dict[str, list[Run]]:
    t0, t1 = scene.t0_ns // 1000, scene.t1_ns // 1000
    with Renderer(gl, scene, RenderConfig(antialiasing=antialiasing)) as renderer:
        dense, run = simulate(
            DisplacementTimeline(max_px=1 / 32, percentile=99, min_step_us=5, max_step_us=2000, sample_every=6),
            renderer,
        )
        times = np.linspace(scene.t0_ns, scene.t1_ns, 121).astype(np.int64)
        speeds = SpeedMaps(
            times // 1000, np.stack([np.hypot(*np.moveaxis(renderer.velocity(int(t)).read(), -1, 0)) for t in times])
        )
        say(f"  reference: {run.frames} frames, {len(dense):,} events")
        results: dict[str, list[Run]] = {}
        for name, settings in WAYS.items():
            results[name] = []
            for timeline in settings[::thin]:
                events, run = simulate(timeline, renderer)
                results[name].append(
                    Run(run.frames, event_errors(dense, events, speeds, t0, t1, limit_us=LIMIT_US), run.timeline.info())
                )
            say(
                f"  {name}: "
                + ", ".join(
                    f"{r.frames} ({r.errors.time_median_us:.0f}/{r.errors.time_p95_us:.0f} µs, "
                    f"{r.errors.shift_median_px:.3f}/{r.errors.shift_p95_px:.3f} px, {100 * r.errors.missed:.0f} % "
                    "missed)"
                    for r in results[name]
                )
            )
    return results


def frames_needed(runs: list[Run], unit: str, median: float, p95: float) -> float:
    """Frames at which both errors are reached, on straight lines of log error over log frames
    (beyond the runs: their last piece)."""
    runs = sorted(runs, key=lambda r: r.frames)
    needed = []
    for quantile, wanted in (("median", median), ("p95", p95)):
        x = np.log([r.frames for r in runs])
        y = np.log([max(getattr(r.errors, f"{unit[0]}_{quantile}_{unit[1]}"), 1e-9) for r in runs])
        y = np.minimum.accumulate(y)  # an error that rises with the frames is noise
        y = y - 1e-6 * np.arange(len(y))
        k = int(np.clip(np.searchsorted(-y, -np.log(wanted)), 1, len(y) - 1))
        needed.append(x[k - 1] + (np.log(wanted) - y[k - 1]) * (x[k] - x[k - 1]) / (y[k] - y[k - 1]))
    return float(np.exp(max(needed)))


def compare(results: list[dict[str, list[Run]]], unit: tuple[str, str], base: str) -> dict[str, dict[str, float]]:
    """Frames of ``base`` per frame of each way at the base's own errors, over the base's
    middle settings and the scenes."""
    table: dict[str, dict[str, float]] = {}
    for name in WAYS:
        ratios = []
        for result in results:
            for run in sorted(result[base], key=lambda r: r.frames)[1:-1]:
                e = run.errors
                wanted = [getattr(e, f"{unit[0]}_{q}_{unit[1]}") for q in ("median", "p95")]
                ratios.append(run.frames / frames_needed(result[name], unit, *wanted))
        table[name] = {
            "mean": float(np.exp(np.mean(np.log(ratios)))),
            "least": float(min(ratios)),
            "most": float(max(ratios)),
        }
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--antialiasing", default="ssaa2", choices=("none", "msaa4", "ssaa2", "ssaa4"))
    parser.add_argument("--scenes", type=int, default=3, help="mixed random scenes; a still camera comes on top")
    parser.add_argument("--quick", action="store_true", help="every other density")
    parser.add_argument("--json", metavar="FILE")
    options = parser.parse_args()
    console = Console()
    console.width = max(console.width, 150)
    say = lambda text: console.print(text, highlight=False, soft_wrap=True)
    scenes = {f"mixed {k}": (k, False) for k in range(1, options.scenes + 1)} | {"still camera": (11, True)}
    results = {}
    with create_context() as gl:
        say(bench.machine_line(gl.renderer))
        for name, arguments in scenes.items():
            say(name)
            results[name] = measure(random_scene(*arguments), gl, options.antialiasing, 2 if options.quick else 1, say)
    tables = {}
    for unit in (("time", "us"), ("shift", "px")):
        table = Table(
            title=f"frames of the base per frame of each way, same median and 95th percentile in {unit[1]} (mixed "
            "motion; geometric mean, least … most)",
            title_justify="left",
        )
        table.add_column("sampling, reconstruction")
        for base in BASES:
            table.add_column(f"base: {base}", justify="right")
        columns = {base: compare(list(results.values()), unit, base) for base in BASES}
        for way in WAYS:
            table.add_row(
                way,
                *(f"{c[way]['mean']:.2f}  ({c[way]['least']:.2f} … {c[way]['most']:.2f})" for c in columns.values()),
            )
        console.print(table)
        tables[unit[1]] = columns
    if options.json:
        runs = {
            scene: {
                way: [{"frames": r.frames, **r.errors.to_dict(), "info": r.info} for r in rs]
                for way, rs in result.items()
            }
            for scene, result in results.items()
        }
        Path(options.json).write_text(
            json.dumps({"antialiasing": options.antialiasing, "runs": runs, "ratios": tables}, indent=1)
        )


if __name__ == "__main__":
    main()
