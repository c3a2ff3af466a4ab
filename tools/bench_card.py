"""ESIM and V2E by compute shaders against the numba kernels, and what the shaders move in memory.

    python -m blinkgl.tools.bench_card [--quick] [--traffic] [--only v2e] [--batches]

Processor time of numba's kernel, the card's, the card's given frames that lie there already, and that one with the sort
and the read-back one frame late that graphics cards have: in turns, frame by frame, on the benchmark's clips and on a
still picture; the events of all are compared. On OpenGL that the processor draws, this is the price of the detour; for
a graphics card there is ``gpu_suite``. ``--batches``: 1, 4 and 8 small sequences at once, as tiles of a kernel, with a
kernel each, and by numba, instead. ``--traffic``: no measurement, but a table computed from the sizes of the
buffers: bytes per pixel and frame and per pixel that fires, and what a card of a given memory bandwidth makes of them
at most.
"""

from __future__ import annotations

import argparse
import itertools
import time
from typing import Any

import numba
import numpy as np

from blinkgl.card import Atlas, AtlasV2e
from blinkgl.card.choice import CARDS as KERNELS
from blinkgl.config.events import EmulatorConfig, EsimConfig, V2eConfig
from blinkgl.events import Esim, Events, V2e
from blinkgl.events.table import emulator_of
from blinkgl.gl import GLContext, create_context
from blinkgl.machine import bench
from blinkgl.tools.bench import HEIGHT, WIDTH, clip

VARIANTS: dict[str, EmulatorConfig] = {
    "default": EsimConfig(),
    "refractory": EsimConfig(refractory_us=100.0),
    "jitter": EsimConfig(threshold_jitter=0.02),
    "v2e clean": V2eConfig(preset="clean"),
    "v2e default": V2eConfig(),
    "v2e noisy": V2eConfig(preset="noisy"),
}
CARDS = {"H100 SXM (HBM3)": 3350.0, "RTX 4090": 1008.0}
"""Memory bandwidth by the vendor's data sheets, GB/s."""
MARK = {"intensity": 4, "levels": 8, "bits, written and read three times": 4 * 4 / 32}
"""Bytes per pixel and frame, whether or not anything fires."""
UPLOAD = {"copy of the frame into the kernel's buffer, read and written": 8}
FIRE = {
    "list, written and read twice": 3 * 8,
    "intensity, now and before": 8,
    "levels, read and written": 16,
    "thresholds": 8,
    "record, written and read": 32,
    "count, written and read three times": 16,
    "place, written and read": 8,
}
"""Bytes per pixel that fires; of the default kernel."""
EVENT = {"packed event": 8}
SORT = {"events, read twice and written": 24, "digits: counted, added up, placed": 5}
"""Bytes per event and four bits of time, where events are sorted on the card."""


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer frames")
    parser.add_argument("--traffic", action="store_true", help="the computed table alone")
    parser.add_argument("--batches", action="store_true", help="small sequences at once, instead")
    parser.add_argument("--only", default="", help="kernels of these letters alone")
    arguments = parser.parse_args()
    if arguments.batches:
        with create_context() as gl:
            batches(gl)
        return
    if not arguments.traffic:
        with create_context() as gl:
            measure(gl, 12 if arguments.quick else 40, arguments.only)
    traffic()


def measure(gl: GLContext, frames: int, only: str) -> None:
    """Prints processor ms a frame, in turns, median over ``frames``."""
    numba.set_num_threads(1)
    print(bench.machine_line(f"{gl.renderer}"))
    print(
        "| clip | kernel | events per pixel and frame | numba, ms | card, ms | ratio | textures, ms | sorts, late, ms |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for name in ("still", "mid", "dense"):
        pictures = np.zeros((frames + 4, HEIGHT, WIDTH), np.uint8) if name == "still" else clip(name, frames + 4)
        pictures = (pictures / 255.0).astype(np.float32)
        for variant, config in VARIANTS.items():
            if only not in variant:
                continue
            kind = emulator_of(config)
            on_card: Any = KERNELS[kind]
            ways = (
                kind(HEIGHT, WIDTH, config, 1),
                on_card(HEIGHT, WIDTH, config, 1, gl=gl, late=False, sorts=False),
                on_card(HEIGHT, WIDTH, config, 1, gl=gl, late=False, sorts=False),
                on_card(HEIGHT, WIDTH, config, 1, gl=gl, late=True, sorts=True),
            )
            spent: tuple[list[float], ...] = ([], [], [], [])
            made: tuple[list[Events], ...] = ([], [], [], [])
            texture = gl.ctx.texture((WIDTH, HEIGHT), 1, dtype="f4")
            for k, picture in enumerate(pictures):
                texture.write(picture)
                for j, emulator in enumerate(ways):
                    started = time.process_time()
                    made[j].append(emulator.step(picture if j < 2 else texture, k * 1_000_000))
                    gl.ctx.finish()
                    if k >= 4:
                        spent[j].append(time.process_time() - started)
            made[3].append(ways[3].flush())
            events = [Events.concatenate(parts) for parts in made]
            for one in events[1:]:
                if not all(np.array_equal(getattr(events[0], c), getattr(one, c)) for c in one.columns):
                    raise SystemExit(f"{name}, {variant}: other events")
            for emulator in ways:
                emulator.release()
            texture.release()
            mine, card, textures, late = (1e3 * float(np.median(s)) for s in spent)
            per_pixel = sum(map(len, made[0][4:])) / frames / pictures[0].size
            figures = f"{per_pixel:.3f} | {mine:.2f} | {card:.2f} | {card / mine:.2f} | {textures:.2f} | {late:.2f}"
            print(f"| {name} | {variant} | {figures} |", flush=True)


def batches(gl: GLContext, frames: int = 30) -> None:
    """Prints processor ms a frame and sequence, in turns, median over ``frames``; events are read back and sorted."""
    numba.set_num_threads(1)
    print(bench.machine_line(f"{gl.renderer}"))
    print("| size | kernel | sequences | events per pixel and frame | batch, ms | a kernel each, ms | numba, ms |")
    print("|---|---|---|---|---|---|---|")
    for height, width in ((128, 128), (260, 346)):
        moving = np.random.default_rng(0).random((height, width)) < 0.1
        clip = [np.exp(0.3 * np.sin(0.9 * k) * moving - 1.0).astype(np.float32) for k in range(8)]
        textures = [gl.ctx.texture((width, height), 1, frame.tobytes(), dtype="f4") for frame in clip]
        for (kind, batch), count in itertools.product({Esim: Atlas, V2e: AtlasV2e}.items(), (1, 4, 8)):
            atlas, config = batch(gl, height, width, count), kind.Config()
            ways: dict[str, list[Any]] = {
                "batch": [atlas.emulator(config, seed) for seed in range(count)],
                "each": [KERNELS[kind](height, width, config, seed, gl=gl, late=False) for seed in range(count)],
                "numba": [kind(height, width, config, seed) for seed in range(count)],
            }
            spent, made = ({name: [] for name in ways} for _ in range(2))
            for k, (name, emulators) in itertools.product(range(frames + 4), ways.items()):
                frame = (clip if name == "numba" else textures)[k % 8]
                started = time.process_time()
                made[name].append(sum(len(one.step(frame, k * 1_000_000)) for one in emulators))
                gl.ctx.finish()
                spent[name] += [1e3 * (time.process_time() - started) / count] if k >= 4 else []
            made["batch"].append(sum(len(one.flush()) for one in ways["batch"]))
            if not sum(made["batch"]) == sum(made["each"]) == sum(made["numba"]):
                raise SystemExit(f"{kind.__name__}: other events")
            density = sum(made["numba"]) / (frames + 4) / count / clip[0].size
            figures = " | ".join(f"{np.median(spent[name]):.2f}" for name in ways)
            print(f"| {width}x{height} | {config.emulator} | {count} | {density:.3f} | {figures} |", flush=True)
            for one in ways["each"]:
                one.release()
            atlas.release()
        for texture in textures:
            texture.release()


def traffic() -> None:
    """Prints the computed table."""
    quiet, copy, fire, event = (sum(table.values()) for table in (MARK, UPLOAD, FIRE, EVENT))
    print(f"\nper pixel and frame {quiet:.1f} B, {copy} B more where frames are copied; ", end="")
    print(
        f"per pixel that fires {fire} B; per event {event} B, {sum(SORT.values())} B for each four bits of time that ",
        end="",
    )
    print(f"are sorted, and {event} B over the bus")
    print("| 640x480 | " + " | ".join(f"{card}, {rate:.0f} GB/s" for card, rate in CARDS.items()) + " |")
    print("|---|" + "---|" * len(CARDS))
    pixels = HEIGHT * WIDTH
    for density in (0.0, 0.07, 0.31, 1.0):
        firing = min(density, 0.6)  # several events a pixel where it is dense
        moved = pixels * (quiet + copy + firing * fire + density * event)
        cells = []
        for rate in CARDS.values():
            frames = rate * 1e9 / moved
            cells.append(f"{frames:,.0f} frames/s, {frames * density * pixels / 1e6:,.0f} M events/s")
        print(f"| {density} events per pixel and frame: {moved / 1e6:.1f} MB | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
