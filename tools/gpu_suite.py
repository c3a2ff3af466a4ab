"""What has to be measured on a graphics card, in one command of ten minutes at most that needs no network.

    python -m blinkgl.tools.gpu_suite [--out FOLDER] [--small] [--device cuda] [--only events,kernel]

FOLDER then has ``gpu_suite.json`` and ``gpu_suite.md``; both are written after every row. A piece that this machine
cannot do says so in a line, and the others go on. Without a card everything runs on the processor: ``--small`` is the
rehearsal of a minute. Pieces:

doctor      what the machine has
frames      frames and labels beside the float64 reference
events      events on tensors beside numba's, bit for bit: every option, sizes from 1x1 to 1920x1080, environments that
            begin anew at different times, saved and restored; ``--events`` many of them
kernel      speed and memory of the event kernel by density and number of environments, beside numba on one core
end_to_end  OpenGL draws, torch makes events and voxel grids
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch

from blinkgl.config.events import EsimConfig, V2eConfig
from blinkgl.config.run import load_run
from blinkgl.config.sequence import RenderConfig
from blinkgl.errors import BlinkGLError
from blinkgl.events.table import emulator_of
from blinkgl.gl import create_context
from blinkgl.io.atomic import write_whole
from blinkgl.machine import bench
from blinkgl.render.renderer import Renderer
from blinkgl.show import doctor
from blinkgl.tensors import TensorEsim, TensorV2e, voxel_grid
from blinkgl.tools import bench_accuracy
from blinkgl.tools.bench import probe_scene

Row = dict[str, Any]
STEP_NS = 1_000_003
DENSITIES = (0.01, 0.07, 0.31, 1.0)
"""Events a pixel and frame that clips are made for; thresholds differ, so a row says how many there were."""
SIZES = ((1, 1, 5), (3, 7, 4), (32, 100, 7), (260, 346, 3), (480, 640, 2), (1080, 1920, 1))
"""Height, width, environments of the comparisons."""
_ALL_OF_V2E = {"leak_rate_hz": 5.0, "shot_noise_rate_hz": 20.0, "hot_pixel_fraction": 0.01, "causes": True}
VARIANTS = {
    "defaults": EsimConfig(),
    "one threshold": EsimConfig(threshold_sigma=0.0),
    "two thresholds": EsimConfig(threshold_sigma=0.0, contrast_threshold_off=0.3),
    "spread": EsimConfig(threshold_sigma=0.1, causes=True),
    "refractory": EsimConfig(refractory_us=300.0),
    "jitter": EsimConfig(threshold_jitter=0.03),
    "jitter, refractory": EsimConfig(threshold_jitter=0.03, refractory_us=100.0),
    "cut": EsimConfig(contrast_threshold=0.05, max_events_per_step=1000, refractory_us=50.0),
    "v2e clean": V2eConfig(preset="clean"),
    "v2e": V2eConfig(),
    "v2e, all": V2eConfig(**_ALL_OF_V2E),
    "v2e, photoreceptor noise": V2eConfig(**_ALL_OF_V2E, photoreceptor_noise=True),
    "v2e noisy": V2eConfig(preset="noisy", causes=True),
}


# --- pieces -----------------------------------------------------------------------------------------------------------


def doctor_piece(options: Namespace) -> Iterator[Row]:
    """What the machine has."""
    for check in doctor.examine(options.backend, options.egl_device).checks:
        line = asdict(check)
        yield {"": f"{line.pop('section')}: {line.pop('name')}", **line}


def frames_piece(options: Namespace) -> Iterator[Row]:
    """Frames and labels beside the float64 reference."""
    small = ["camera.width=96", "camera.height=72"] if options.small else []
    config = load_run(resources.files("blinkgl.configs") / "flying_objects.yaml", small)
    with create_context(options.backend, options.egl_device) as gl:
        for index in range(1 if options.small else 3):
            found = bench_accuracy.compare(gl, config, index)
            names = ("pixels", "ids_wrong", "depth_max", "velocity_max", "forward_max", "backward_max")
            yield {"": f"sequence {index}, {gl.renderer}", **{name: found[name] for name in names}}


def events_piece(options: Namespace) -> Iterator[Row]:
    """Events on tensors beside numba's, bit for bit."""
    sizes = SIZES[:3] if options.small else SIZES
    total = dict.fromkeys(VARIANTS, 0)
    for turn in itertools.count():
        for name, config in VARIANTS.items():
            # Large pictures in the first turn alone; noise of V2E takes a second for a million pixels.
            for height, width, envs in sizes if turn == 0 else sizes[2:-1]:
                total[name] += compared(config, height, width, envs, options.device, turn)
            if turn == 0:
                yield {"": name, "events, all the same": total[name]}
        if sum(total.values()) >= options.events:
            yield {"": f"all, {turn + 1} turns", "events, all the same": sum(total.values())}
            return


def compared(config: Any, height: int, width: int, envs: int, device: str, seed: int) -> int:
    """How many events a batch and single emulators make, which have to be the same.

    Every environment has intervals of its own, two begin anew at different frames, and the batch is saved and restored
    on the way. Raises AssertionError that names the first difference."""
    rng = np.random.default_rng((seed, height, width))
    kind: Any = TensorEsim if isinstance(config, EsimConfig) else TensorV2e
    make = lambda: kind(height, width, config, envs=envs, device=device, seed=2**64 - 2 + seed)
    single: Any = emulator_of(config)
    batch = make()
    alone = [single(height, width, config, one) for one in batch.seeds]
    t_ns, total, large = rng.integers(0, 10**9, envs), 0, height * width > 10_000
    for n in range(6):
        spread = 0.1 if large else 0.3 * (1 + seed % 3)
        frames = np.exp(rng.normal(-1, spread, (envs, height, width))).astype(np.float32)
        t_ns = t_ns + rng.integers(1, 3_000_000, envs)
        for k in {3: {0}, 5: {envs - 1, envs // 2}}.get(n, ()):
            batch.reset(np.arange(envs) == k)
            alone[k] = single(height, width, config, batch.seeds[k])
        if n == 4:
            state, batch = batch.state_dict(), make()
            batch.load_state_dict(state)
        chunks = batch.step(torch.from_numpy(frames).to(device), t_ns).numpy()
        for k, one in enumerate(alone):
            events = one.step(frames[k], int(t_ns[k]))
            total += len(events)
            for column in events.columns if len(events) else ("t",):
                same = np.array_equal(getattr(chunks[k], column), getattr(events, column))
                assert same, f"{config!r}, {width}x{height}, environment {k}, step {n}: {column} differs"
    return total


def noise(height: int, width: int, density: float, frames: int) -> np.ndarray:
    """(frames, H, W) float32 with ``density`` events a pixel and frame at thresholds of 0.2: pixels drawn by lot go
    there and back again, over the same levels each time, from the second frame on."""
    rng, levels = np.random.default_rng(1), max(1, int(np.ceil(density)))
    moving = rng.choice((-1.0, 1.0), (height, width)) * (rng.random((height, width)) < density / levels)
    places = np.where(np.arange(frames) % 2 == 1, levels + 0.5, -0.5)  # in thresholds, beyond the levels by its spread
    return np.exp(0.2 * places[:, None, None] * moving - 1.0).astype(np.float32)


def kernel_piece(options: Namespace) -> Iterator[Row]:
    """Speed and memory of the event kernel, frames on the device, in turns with numba on one core."""
    height, width = (48, 64) if options.small else (480, 640)
    config = EsimConfig()
    for density, envs in itertools.product(DENSITIES, (1, 16, 256)):
        if options.device == "cpu" and density * envs * height * width > 3e7:
            continue  # a step would take a processor minutes and more than 10 GB
        clip = noise(height, width, density, 3)[1:]  # there and back again, for ever
        frames = torch.from_numpy(clip).to(options.device)[:, None].expand(2, envs, height, width).contiguous()
        batch = TensorEsim(height, width, config, envs=envs, device=options.device)
        single = emulator_of(config)(height, width, config)
        ours = Stopwatch(lambda k, b=batch, f=frames: len(b.step(f[k % 2], k * STEP_NS)), options.device)
        theirs = Stopwatch(lambda k, e=single, c=clip: len(e.step(c[k % 2], k * STEP_NS)), "cpu")
        for _ in range(3 if options.small or envs == 256 else 8):
            ours.run(0.02 if options.small else 0.3)
            theirs.run(0.02 if options.small else 0.1)
        made = ours.counted / (ours.runs * envs * height * width)
        yield {
            "": f"{width}x{height}, {made:.2g} events a pixel and frame, {envs} environments",
            "Mev/s": ours.counted / ours.seconds / 1e6,
            "frames/s": envs * ours.runs / ours.seconds,
            "ms a step and environment": 1e3 * ours.seconds / ours.runs / envs,
            "numba Mev/s": theirs.counted / theirs.seconds / 1e6,
            "of numba's speed": ours.counted / ours.seconds / (theirs.counted / theirs.seconds),
            "state, bytes a pixel": state_bytes(batch) / (envs * height * width),
            "peak, GB": peak_gb(options.device),
        }


class Stopwatch:
    """Runs a step over and over: ``seconds`` of wall time, ``runs``, and the events ``counted``; two to warm up."""

    def __init__(self, step: Callable[[int], int], device: str):
        self._step, self._device, self._number = step, device, 0
        self.seconds, self.runs, self.counted = 0.0, 0, 0
        for _ in range(3):
            self._next()

    def _next(self) -> int:
        self._number += 1
        return self._step(self._number)

    def run(self, seconds: float) -> None:
        """For so long, once at least."""
        wait = torch.cuda.synchronize if self._device.startswith("cuda") else lambda: None
        wait()
        began = time.perf_counter()
        while True:
            self.counted += self._next()
            self.runs += 1
            wait()
            if time.perf_counter() - began > seconds:
                break
        self.seconds += time.perf_counter() - began


def state_bytes(batch: TensorEsim) -> int:
    """Of the tensors that a batch keeps."""
    return sum(
        value.numel() * value.element_size() for value in vars(batch).values() if isinstance(value, torch.Tensor)
    )


def peak_gb(device: str) -> float:
    """Most memory so far: of the card, or of this process."""
    if device.startswith("cuda"):
        return torch.cuda.max_memory_allocated() / 1e9
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def end_to_end_piece(options: Namespace) -> Iterator[Row]:
    """OpenGL draws, torch makes events and voxel grids; where frames go, and what each part takes."""
    height, width = (48, 64) if options.small else (480, 640)
    with create_context(options.backend, options.egl_device) as gl:
        for kind in ("tri/16", "full"):
            with Renderer(gl, probe_scene(kind, width, height), RenderConfig(antialiasing="none")) as renderer:
                batch = TensorEsim(height, width, device=options.device)

                def step(k: int, renderer: Any = renderer, batch: Any = batch) -> int:
                    frame = renderer.luminance(k * STEP_NS % 2_000_000_000)
                    events = batch.step(frame.tensor(options.device)[None], k * STEP_NS)
                    voxel_grid(events, 0, 10**9, 5)
                    return len(events)

                def draw(k: int, renderer: Any = renderer) -> int:
                    renderer.luminance(k * STEP_NS % 2_000_000_000)
                    gl.ctx.finish()
                    return 0

                whole, drawn = Stopwatch(step, options.device), Stopwatch(draw, options.device)
                for _ in range(2 if options.small else 6):
                    whole.run(0.05 if options.small else 1.0)
                    drawn.run(0.05 if options.small else 1.0)
                yield {
                    "": f"{width}x{height}, {kind}, {gl.renderer}",
                    "frames/s": whole.runs / whole.seconds,
                    "drawing alone, frames/s": drawn.runs / drawn.seconds,
                    "Mev/s": whole.counted / whole.seconds / 1e6,
                    "frames go by": renderer.luminance(0).transfer(options.device),
                }


PIECES: dict[str, Callable[[Namespace], Iterator[Row]]] = {
    "doctor": doctor_piece,
    "frames": frames_piece,
    "events": events_piece,
    "kernel": kernel_piece,
    "end_to_end": end_to_end_piece,
}


# --- the command ------------------------------------------------------------------------------------------------------


def table(rows: list[Row]) -> list[str]:
    """Lines of a Markdown table."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    show = lambda v: "" if v is None else f"{v:,.4g}" if isinstance(v, float) else str(v).replace("|", "/")
    return [
        "| " + " | ".join(columns) + " |",
        "|---" * len(columns) + "|",
        *("| " + " | ".join(show(row.get(name)) for name in columns) + " |" for row in rows),
    ]


def write(out: Path, report: dict[str, Any]) -> None:
    """``gpu_suite.json`` and ``gpu_suite.md``, whole."""
    lines = [f"# {report['machine']}, {report['device']}"]
    for name, piece in report["pieces"].items():
        said = f"{piece['state']}, {piece['seconds']:.0f} s {piece['said']}".rstrip()
        lines += ["", f"## {name}: {(PIECES[name].__doc__ or '').splitlines()[0]}", "", said, ""]
        lines += table(piece["rows"]) if piece["rows"] else []
    plain = lambda value: value.item() if isinstance(value, np.generic) else str(value)
    text = json.dumps(report, indent=1, default=plain)
    for name, content in (("gpu_suite.json", text), ("gpu_suite.md", "\n".join(lines))):
        write_whole(out / name, content + "\n")


def measured(name: str, options: Namespace, deadline: float, report: dict[str, Any]) -> dict[str, Any]:
    """One piece, put into the report and written row by row, as far as the time reaches; what became of it."""
    began, piece = time.monotonic(), {"state": "begun", "said": "", "seconds": 0.0, "rows": []}
    report["pieces"][name], state, said = piece, "done", ""
    try:
        for row in PIECES[name](options):
            piece["rows"].append(row)
            print(f"  {next(iter(row.values()))}", flush=True)
            write(options.out, report)
            if time.monotonic() > deadline:
                state, said = "cut", "the time was over"
                break
    except BlinkGLError as error:
        state, said = "absent", str(error)
    except Exception as error:  # noqa: BLE001 - the other pieces go on
        state, said = "failed", f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
    piece |= {"state": state, "said": said, "seconds": time.monotonic() - began}
    write(options.out, report)
    return piece


def parsed(arguments: list[str] | None) -> Namespace:
    """Of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    here = "cuda" if torch.cuda.is_available() else "cpu"
    parser.add_argument("--out", type=Path, default=Path("out/gpu_suite"))
    parser.add_argument("--minutes", type=float, default=9.0, help="of this call; what is left then is left out")
    parser.add_argument("--small", action="store_true", help="small pictures: does everything run?")
    parser.add_argument("--only", default=",".join(PIECES), help="pieces, with commas between")
    parser.add_argument("--events", type=float, help="of the comparison, at least; 1e7, with --small 1e5")
    parser.add_argument("--device", default=here, help="torch's")
    parser.add_argument("--backend", default="auto", help="of OpenGL's context: auto, egl, osmesa")
    parser.add_argument("--egl-device", type=int, default=0, help="as blinkgl doctor numbers them")
    options = parser.parse_args(arguments)
    options.only = [name for name in options.only.split(",") if name]
    if unknown := set(options.only) - set(PIECES):
        parser.error(f"--only: no piece is called {', '.join(sorted(unknown))}; expected {', '.join(PIECES)}")
    options.events = options.events or (1e5 if options.small else 1e7)
    return options


def main(arguments: list[str] | None = None) -> int:
    """See the module. 0: everything is measured, or cannot be here; 1: something failed."""
    options = parsed(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    numba.set_num_threads(1)
    torch.set_num_threads(1)  # after numba, whose start changes it; more threads wait for each other, spinning
    name_of_card = torch.cuda.get_device_name(options.device) if options.device.startswith("cuda") else "no card"
    report: dict[str, Any] = {"machine": bench.machine_line(), "device": f"torch on {options.device} ({name_of_card})"}
    report["pieces"], deadline = {}, time.monotonic() + 60 * options.minutes
    for name in options.only:
        print(f"{name} …", flush=True)
        piece = measured(name, options, deadline, report)
        print(f"{name}: {piece['state']}, {len(piece['rows'])} rows, {piece['seconds']:.0f} s {piece['said']}")
    print((options.out / "gpu_suite.md").read_text(encoding="utf-8"))
    return int(any(piece["state"] == "failed" for piece in report["pieces"].values()))


if __name__ == "__main__":
    sys.exit(main())
