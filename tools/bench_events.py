"""How fast the event emulators are.

    python -m blinkgl.tools.bench_events [--quick] [--json FILE]

The clip is a scikit-image photograph under roll, translation and zoom, 640x480, 1000 fps: ``mid`` with the photograph
blurred by 1.5 px (about 0.07 events per pixel and frame for ESIM at C = 0.2), ``dense`` as it is (about 0.3). Frames
go in as 8-bit or float32, logarithm included, sorted events come out; a figure is the median over whole passes of the
clip. Beside it are the peers' speeds on this kind of clip and machine, and the floor: an AVX-512 probe, one core,
logarithm given (all three from measurements of the project, see docs). Ratios within one run say more than absolute
numbers on a shared machine; the fastest pass is shown too.
"""

from __future__ import annotations

import argparse
import json
import resource
import time

import cv2
import numba
import numpy as np
from rich.console import Console
from rich.table import Table
from skimage import data

from blinkgl.config.events import EsimConfig, V2eConfig, VoltmeterConfig
from blinkgl.events import make_emulator
from blinkgl.machine import bench

HEIGHT, WIDTH, FPS = 480, 640, 1000
EMULATORS = {
    "ESIM": EsimConfig(contrast_threshold=0.2, threshold_sigma=0.0),
    "ESIM, spread C": EsimConfig(contrast_threshold=0.2, threshold_sigma=0.021),
    "V2E clean": V2eConfig(preset="clean"),
    "V2E default": V2eConfig(),
    "V2E noisy": V2eConfig(preset="noisy"),
    "Voltmeter": VoltmeterConfig(),
}
# Millions of events per second at 640x480, `mid`, on two cores where the peer can use them, else on one.
PEERS = {
    "ESIM": ("rpg_esim", 5.46),
    "ESIM, spread C": ("rpg_esim", 5.46),
    "V2E clean": ("v2e", 3.13),
    "V2E noisy": ("v2e", 0.65),
    "Voltmeter": ("DVS-Voltmeter", 0.20),
}
FLOOR = {"mid": 70.0, "dense": 153.0}
TARGETS = {
    ("ESIM", "mid"): 50,
    ("ESIM", "dense"): 100,
    ("V2E clean", "mid"): 30,
    ("V2E noisy", "mid"): 10,
    ("Voltmeter", "mid"): 10,
}


def clip(kind: str, frames: int) -> tuple[np.ndarray, float]:
    """(N, H, W) uint8 frames and the mean displacement in px per frame."""
    photo = data.grass() if kind == "dense" else cv2.GaussianBlur(data.grass(), (0, 0), 1.5)
    out, speeds, before = np.empty((frames, HEIGHT, WIDTH), np.uint8), [], None
    y, x = np.mgrid[0:HEIGHT:16, 0:WIDTH:16]
    for k in range(frames):
        s = 0.65 * k / FPS  # 0.63 px per frame in the mean
        angle, zoom = 0.6 * np.sin(2 * np.pi * s), 1.06 + 0.2 * np.sin(3 * np.pi * s)
        c, d = zoom * np.cos(angle), zoom * np.sin(angle)
        shift = np.array([WIDTH / 2 + 420 * s, HEIGHT / 2 + 300 * s])
        move = np.array([[c, -d, shift[0] - c * 256 + d * 256], [d, c, shift[1] - d * 256 - c * 256]])
        out[k] = cv2.warpAffine(photo, move, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        back = np.linalg.inv(np.vstack([move, [0, 0, 1]]))
        if before is not None:  # where the point now at (x, y) was a frame ago
            source = np.stack([x, y, np.ones_like(x)]).reshape(3, -1)
            was = before @ (back @ source)
            speeds.append(np.hypot(*(was[:2] - source[:2])).mean())
        before = np.vstack([move, [0, 0, 1]])
    return out, float(np.mean(speeds))


def one_pass(config, frames: np.ndarray, decode: np.ndarray | None = None) -> tuple[float, int]:
    """Seconds in ``step`` after the first frame, and events."""
    emulator = make_emulator(config, HEIGHT, WIDTH, 0)
    if decode is not None:
        emulator.set_decode(decode)
    emulator.step(frames[0], 0)
    events, started = 0, time.perf_counter()
    for k in range(1, len(frames)):
        events += len(emulator.step(frames[k], k * 1_000_000_000 // FPS))
    return time.perf_counter() - started, events


def measure(config, frames: np.ndarray, passes: int) -> dict[str, float]:
    """Median over passes, after one that does not count."""
    one_pass(config, frames[:8])
    results = [one_pass(config, frames) for _ in range(passes)]
    took, events, steps = np.array([r[0] for r in results]), results[0][1], len(frames) - 1
    emulator = make_emulator(config, HEIGHT, WIDTH, 0)
    return {
        "Mev/s": events / np.median(took) / 1e6,
        "best Mev/s": events / took.min() / 1e6,
        "frames/s": steps / np.median(took),
        "ns/px-frame": np.median(took) / steps / (HEIGHT * WIDTH) * 1e9,
        "events/px-frame": events / steps / (HEIGHT * WIDTH),
        "state B/px": emulator.state_bytes_per_pixel,
    }


def quiet(passes: int, steps: int) -> dict[str, float]:
    """ESIM on a still float frame, one thread: ns per pixel-frame with and without the logarithm."""
    from blinkgl.events.esim import log_block

    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    frame = (data.grass()[:480].astype(np.float32) / 255).repeat(2, axis=1)[:, :WIDTH].copy()
    still = np.broadcast_to(frame, (steps, HEIGHT, WIDTH))
    out = np.empty(HEIGHT * WIDTH, np.int32)
    config = EMULATORS["ESIM"]
    one_pass(config, still[:3])
    whole = np.median([one_pass(config, still)[0] for _ in range(passes)]) / (steps - 1)
    codes = (frame * 255).astype(np.uint8)
    table = np.median([one_pass(config, np.broadcast_to(codes, still.shape))[0] for _ in range(passes)]) / (steps - 1)
    log = bench.seconds(lambda: log_block(frame.reshape(-1), np.float32(1e-3), out), repeat=10 * passes)["median"]
    numba.set_num_threads(threads)
    pixel = 1e9 / (HEIGHT * WIDTH)
    return {
        "float frame": whole * pixel,
        "of that the logarithm": log * pixel,
        "without": (whole - log) * pixel,
        "8-bit frame": table * pixel,
    }


def peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer frames and passes")
    parser.add_argument("--json", metavar="FILE", help="write the figures there too")
    arguments = parser.parse_args()
    frames, passes = (60, 3) if arguments.quick else (240, 10)
    console, threads = Console(width=150), numba.get_num_threads()
    report = {"machine": bench.machine_line(), "threads": threads, "frames": frames, "passes": passes, "clips": {}}
    console.print(report["machine"], f"· {threads} threads", highlight=False)
    for kind in ("mid", "dense"):
        codes, speed = clip(kind, frames)
        floats = codes.astype(np.float32) / np.float32(255)
        table = Table(
            title=f"{kind}: {WIDTH}x{HEIGHT}, {frames} frames at {FPS} fps, {speed:.2f} px/frame, median of {passes}"
        )
        for column in (
            "emulator",
            "input",
            "ev/px-frame",
            "Mev/s",
            "best",
            "frames/s",
            "ns/px-frame",
            "B/px",
            "x peer",
            "of floor",
            "target",
        ):
            table.add_column(column, justify="left" if column in ("emulator", "input") else "right")
        for name, config in EMULATORS.items():
            for kind_of_input, source in (("uint8", codes), ("float32", floats)):
                figures = measure(config, source, passes)
                peer, speed_of_peer = PEERS.get(name, (None, None))
                if kind == "mid" and peer:
                    figures[f"x {peer}"] = figures["Mev/s"] / speed_of_peer
                if name == "ESIM":
                    figures["of floor"] = figures["Mev/s"] / FLOOR[kind]
                target = TARGETS.get((name, kind))
                report["clips"].setdefault(kind, {}).setdefault(name, {})[kind_of_input] = figures
                table.add_row(
                    name,
                    kind_of_input,
                    f"{figures['events/px-frame']:.3f}",
                    f"{figures['Mev/s']:.1f}",
                    f"{figures['best Mev/s']:.1f}",
                    f"{figures['frames/s']:.0f}",
                    f"{figures['ns/px-frame']:.2f}",
                    f"{figures['state B/px']:.0f}",
                    f"{figures[f'x {peer}']:.1f}" if kind == "mid" and peer else "",
                    f"{figures['of floor']:.2f}" if name == "ESIM" else "",
                    f">= {target}" if target else "",
                )
        console.print(table)
    report["quiet ns per pixel-frame"] = {k: float(v) for k, v in quiet(passes, frames).items()}
    console.print(
        "quiet pixels, ESIM, one core, ns per pixel-frame:",
        {k: round(v, 2) for k, v in report["quiet ns per pixel-frame"].items()},
        "(target <= 0.6 without the logarithm)",
    )

    # Memory: the same clip ten times over must not need more than once.
    for name, config in EMULATORS.items():
        codes, _ = clip("mid", 30)
        one_pass(config, codes)
        before = peak_mib()
        one_pass(config, np.tile(codes, (10, 1, 1)))
        growth = peak_mib() - before - 9 * codes.nbytes / 2**20
        report.setdefault("memory growth MiB, 10x the clip", {})[name] = max(0.0, growth)
    console.print("peak memory, 10 times the clip against once, MiB more:", report["memory growth MiB, 10x the clip"])
    if arguments.json:
        with open(arguments.json, "w", encoding="utf-8") as file:
            json.dump(report, file, indent=2)


if __name__ == "__main__":
    main()
