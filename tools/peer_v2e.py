"""`compat: authors` of V2E beside its authors' program, which has to be there already (torch comes with the extra
[eflow]).

    python -m blinkgl.tools.peer_v2e DIR [--json FILE]

DIR holds their package ``v2ecore``. Both get the same frames, and their program our thresholds, leak rates, normals and
uniforms in the place of its generator's, so that event by event the two are the same or they are not: events that only
one of them has (by pixel, polarity, number of the frame), and how far the times of the others are apart at most (theirs
are float32 seconds). The size of the photoreceptor noise, which theirs finds by a simulation, is compared by itself and
then given. What theirs writes and shows is left out (``v2ecore.output``, ``screeninfo`` and the like are stood in for).
"""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import sys
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from rich.console import Console
from rich.table import Table

from blinkgl.config.events import V2eConfig
from blinkgl.events.esim import draw_thresholds
from blinkgl.events.philox import Stream, normal2, pixel_counters, uniform2
from blinkgl.events.v2e_authors import V2eAuthors, noise_size
from blinkgl.events.v2e_model import draw_leaks
from blinkgl.machine.bench import machine_line

CASES: dict[str, dict[str, Any]] = {
    "clean": dict(preset="clean"),
    "default": {},
    "noisy": dict(preset="noisy"),
    "noise, dead time of 3 ms": dict(preset="noisy", shot_noise_rate_hz=50.0, leak_rate_hz=5.0, refractory_us=3000.0),
    "noise, dead time of 3.137 ms": dict(
        preset="noisy", shot_noise_rate_hz=50.0, leak_rate_hz=5.0, refractory_us=3137.0
    ),
    "thresholds of 0.05 and 0.08": dict(
        contrast_threshold=0.05, contrast_threshold_off=0.08, threshold_sigma=0.01, refractory_us=531.7
    ),
    "photoreceptor noise": dict(preset="noisy", photoreceptor_noise=True, shot_noise_rate_hz=20.0),
}
_STOOD_IN = (
    "screeninfo",
    "v2ecore.output",
    "v2ecore.output.ae_text_output",
    "v2ecore.output.aedat2_output",
    "v2ecore.output.aedat4_output",
    "v2ecore.v2e_utils",
)
HEIGHT, WIDTH, FRAMES, SEED = 60, 80, 120, 5


def clip(fps: float, seed: int = 0) -> np.ndarray:
    """(N, H, W) uint8: gratings and dark ground that drift and flicker."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    rng, t = np.random.default_rng(seed), np.arange(FRAMES)[:, None, None] / fps
    texture = rng.uniform(0.05, 1.0, (HEIGHT, WIDTH))
    waves = 0.55 + 0.45 * np.sin(0.35 * x + 0.2 * y - 2 * np.pi * 6.0 * t)
    return np.round(255 * np.clip(texture * waves, 0, 1)).astype(np.uint8)


@contextlib.contextmanager
def _their_program(folder: Path) -> Iterator[Any]:
    """Their modules ``(emulator, emulator_utils)``. Raises ImportError where they are not in the folder."""
    with mock.patch.dict(sys.modules), mock.patch.object(sys, "path", [str(folder), *sys.path]):
        for name in _STOOD_IN:
            sys.modules[name] = mock.MagicMock()
        logging.getLogger("v2ecore").setLevel(logging.ERROR)
        from importlib import import_module

        yield import_module("v2ecore.emulator"), import_module("v2ecore.emulator_utils")


def _theirs(modules: Any, config: V2eConfig, seed: int, frames: np.ndarray, times_ns: np.ndarray) -> list[np.ndarray]:
    """Their events of each interval, (N, 4) t in s, x, y, sign, with the draws of this seed."""
    import torch

    program, _ = modules
    emulator = program.EventEmulator(
        pos_thres=config.contrast_threshold,
        neg_thres=config.contrast_threshold_off or config.contrast_threshold,
        sigma_thres=config.threshold_sigma,
        cutoff_hz=config.cutoff_hz,
        leak_rate_hz=config.leak_rate_hz,
        refractory_period_s=config.refractory_us * 1e-6,
        shot_noise_rate_hz=config.shot_noise_rate_hz,
        photoreceptor_noise=config.photoreceptor_noise,
        leak_jitter_fraction=config.leak_jitter,
        noise_rate_cov_decades=config.leak_cov_decades,
        device="cpu",
    )
    shape, pixels, key = (HEIGHT, WIDTH), pixel_counters(HEIGHT, WIDTH), np.uint64(seed)
    as_tensor = lambda values: torch.from_numpy(np.asarray(values).reshape(shape))
    with contextlib.redirect_stdout(None):
        emulator.generate_events(frames[0].astype(np.float64), times_ns[0] * 1e-9)
    nominal = config.contrast_threshold, config.contrast_threshold_off or config.contrast_threshold
    on, off = draw_thresholds(HEIGHT, WIDTH, *nominal, config.threshold_sigma, key, config.threshold_correlation)
    on, off = on.astype(np.float32), off.astype(np.float32)
    emulator.pos_thres, emulator.neg_thres = as_tensor(on), as_tensor(off)
    emulator.pos_thres_pre_prob = emulator.pos_thres_nominal / emulator.pos_thres
    emulator.neg_thres_pre_prob = emulator.neg_thres_nominal / emulator.neg_thres
    if config.leak_rate_hz:
        emulator.noise_rate_array = as_tensor(draw_leaks(HEIGHT, WIDTH, config, on, key) / (config.leak_rate_hz * on))
    made = []
    for k in range(1, len(frames)):
        hum, turn = normal2(key, pixels, np.uint64(Stream.NOISE), np.uint64(k))
        uniform, _ = uniform2(key, pixels, np.uint64(Stream.SHOT), np.uint64(k))
        normals = iter(([hum] if config.photoreceptor_noise else []) + [turn])
        size = _size(config, (times_ns[k] - times_ns[k - 1]) * 1e-9) if config.photoreceptor_noise else 0.0
        with (
            mock.patch.object(torch, "randn", lambda *a, normals=normals, **b: as_tensor(next(normals))),
            mock.patch.object(torch, "rand", lambda *a, uniform=uniform, **b: as_tensor(uniform)),
            mock.patch.object(program, "compute_photoreceptor_noise_voltage", lambda size=size, **b: size),
            contextlib.redirect_stdout(None),
        ):
            events = emulator.generate_events(frames[k].astype(np.float64), times_ns[k] * 1e-9)
        made.append(np.empty((0, 4)) if events is None else events)
    return made


def _size(config: V2eConfig, dt_s: float) -> float:
    on = config.contrast_threshold
    off = config.contrast_threshold_off or on
    return noise_size(config.shot_noise_rate_hz, config.cutoff_hz, dt_s, on, off, config.threshold_sigma)


def beside(modules: Any, values: dict[str, Any], fps: float) -> dict[str, float]:
    """Events of both, how many only one of them has, and the largest difference of times of the others in µs."""
    config, frames = V2eConfig(**values, compat="authors"), clip(fps)
    times_ns = np.round(np.arange(FRAMES) * 1e9 / fps).astype(np.int64)
    ours = V2eAuthors(HEIGHT, WIDTH, config, SEED)
    mine = [ours.step(frame, int(t)) for frame, t in zip(frames, times_ns)][1:]
    theirs = _theirs(modules, config, SEED, frames, times_ns)
    alone, apart, count, count_theirs = 0, 0.0, 0, 0
    for a, b in zip(mine, theirs):
        count, count_theirs = count + len(a), count_theirs + len(b)
        here = Counter(zip(a.x.tolist(), a.y.tolist(), a.p.tolist()))
        there = Counter((int(x), int(y), int(sign > 0)) for _, x, y, sign in b)
        alone += sum((here - there).values()) + sum((there - here).values())
        if len(a) == len(b) and len(a):
            apart = max(apart, float(np.abs(np.sort(a.t) - np.sort(b[:, 0] * 1e6)).max()))
    return {"ours": count, "theirs": count_theirs, "only one has": alone, "times apart, us": round(apart, 2)}


def sizes(modules: Any, fps: float) -> dict[str, float]:
    """The size of the photoreceptor noise by both, ln units."""
    config = V2eConfig(**CASES["photoreceptor noise"], compat="authors")
    their = modules[1].compute_photoreceptor_noise_voltage
    found = []
    for _ in range(9):
        their.last_sample_rate = None
        found.append(
            their(
                config.shot_noise_rate_hz,
                config.cutoff_hz,
                fps,
                config.contrast_threshold,
                config.contrast_threshold,
                config.threshold_sigma,
            )
        )
    return {"ours": _size(config, 1 / fps), "theirs": float(np.mean(found)), "spread": float(np.std(found))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="DIR", help="where their package v2ecore is")
    parser.add_argument("--json", metavar="FILE", help="write the figures there too")
    arguments = parser.parse_args()
    if not (arguments.folder / "v2ecore" / "emulator.py").is_file():
        parser.error(f"{arguments.folder}: no package v2ecore there")
    report: dict[str, Any] = {"machine": machine_line(), "events": {}, "noise sizes": {}}
    table = Table("case", "frames/s", "ours", "theirs", "only one has", "times apart at most, us")
    warnings.simplefilter("ignore")
    with _their_program(arguments.folder.resolve()) as modules:
        for fps in (100.0, 1000.0):
            for name, values in CASES.items():
                row = beside(modules, values, fps)
                report["events"][f"{name}, {fps:.0f}"] = row
                table.add_row(name, f"{fps:.0f}", *(f"{v:,}" for v in row.values()))
            report["noise sizes"][f"{fps:.0f}"] = sizes(modules, fps)
    console = Console(width=150)
    console.print(report["machine"], highlight=False)
    console.print(table)
    for fps, row in report["noise sizes"].items():
        console.print(f"photoreceptor noise, {fps} frames/s: " + ", ".join(f"{k} {v:.4f}" for k, v in row.items()))
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
