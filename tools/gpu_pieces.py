"""What gpu_suite measures without training a network. A piece returns its rows in order: what a row is called, and a
function that measures it and returns its columns, or several rows."""

from __future__ import annotations

import itertools
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numba
import numpy as np

from blinkgl.config.events import EsimConfig, V2eConfig
from blinkgl.config.run import load_run
from blinkgl.config.sequence import RenderConfig
from blinkgl.errors import AssetError, GLError
from blinkgl.events.table import emulator_of, make_emulator
from blinkgl.gl import Target, create_context
from blinkgl.io.dsec import DsecEventReader
from blinkgl.render.renderer import Renderer
from blinkgl.render.tensors import TextureReader
from blinkgl.show import doctor as machine
from blinkgl.tools import fingerprint as cases
from blinkgl.tools.bench_rows import probe_scene
from blinkgl.tools.shader_debugger.commands import run_diff
from blinkgl.tools.shader_debugger.session import moment, open_subject
from blinkgl.types.trees import Tree

try:
    import torch
    import torch.utils.benchmark

    from blinkgl.tensors import TensorEsim, TensorV2e, voxel_grid
    from blinkgl.tools import same_events
except ImportError:
    torch: Any = None

Row = Tree
Rows = Iterable[tuple[str, Callable[[], "Row | list[Row]"]]]
STEP_NS = 1_000_003
DENSITIES = (0.07, 1.0, 0.31, 0.01)
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
GRADED = (
    *("default", "hard_shadows", "soft_shadows", "skin_morph", "radtan", "fisheye", "lamps_fog", "panorama", "maps"),
    *("wave", "figure", "fish_flag", "living", "random_lamps", "stereo"),
)
"""Cases of the fingerprint that are compared with the float64 reference."""
WITHOUT_CODECS = ("output.compression=gzip", "preview.enabled=false")
"""hdf5plugin and PyAV do not travel."""
PACKED = "fingerprint.npz"


# --- the machine ------------------------------------------------------------------------------------------------------


def device_line(options: Namespace) -> str:
    """torch, its card, and the memory that is free there. Sets the device where none is asked for, and a thread."""
    numba.set_num_threads(1)
    cards = torch is not None and torch.cuda.is_available()
    options.device = options.device or ("cuda" if cards else "cpu")
    if torch is None:
        return "no torch"
    torch.set_num_threads(1)  # after numba, whose start changes it; more threads wait for each other, spinning
    if not options.device.startswith("cuda"):
        return f"torch {torch.__version__} on {options.device}, no card"
    free, total = (size / 1e9 for size in torch.cuda.mem_get_info(options.device))
    name = torch.cuda.get_device_name(options.device)
    return f"torch {torch.__version__} on {options.device} ({name}, {free:.0f} of {total:.0f} GB free)"


def compiling(options: Namespace) -> Rows:
    yield "all kernels", lambda: {"wall, s": command("blinkgl.show.compile_kernels")}


def doctor(options: Namespace) -> Rows:
    row = lambda c: {"": f"{c.section}: {c.name}", "status": c.status, "value": c.value, "remedy": c.remedy}
    yield "all", lambda: [row(check) for check in machine.examine(options.backend, options.egl_device).checks]


def command(module: str, *words: str, cache: str | None = None) -> float:
    """Run ``python -m`` a module to its end; return its wall seconds. cache : numba's. Raises RuntimeError."""
    environment = os.environ | ({"NUMBA_CACHE_DIR": cache} if cache else {})
    began, words = time.perf_counter(), (sys.executable, "-P", "-m", module, *words)
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"status {done.returncode}: {last_line(done.stderr)}")
    return time.perf_counter() - began


def last_line(text: str) -> str:
    """Return the last line that says something."""
    lines = [line for line in text.splitlines() if line.strip() and "this is a bug" not in line]
    return lines[-1] if lines else "(silent)"


def overrides(*pairs: str) -> list[str]:
    """Return them as words of a command line."""
    return [word for pair in pairs for word in ("--set", pair)]


def only(*groups: str) -> list[str]:
    """Return overrides that leave these groups of blinkflow.yaml."""
    known = load_run(str(resources.files("blinkgl.configs") / "blinkflow.yaml")).groups
    return [f"groups.{group.name}.enabled={str(group.name in groups).lower()}" for group in known]


# --- pictures ---------------------------------------------------------------------------------------------------------


def frames(options: Namespace) -> Rows:
    """Cases of the fingerprint at their size, then flying_objects."""
    cases.assets(folder := Path(tempfile.mkdtemp(dir=options.scratch)))
    for name in GRADED[:3] if options.small else GRADED:
        yield name, lambda name=name: _beside_reference(str(cases.recipe_of(name, folder)))
    size = ("camera.width=96", "camera.height=72") if options.small else ()
    for index in range(1 if options.small else 3):
        run = partial(_beside_reference, str(resources.files("blinkgl.configs") / "flying_objects.yaml"), index, size)
        yield f"flying_objects, sequence {index}", run


def _beside_reference(config: str, index: int = 0, changes: tuple[str, ...] = ()) -> Row:
    subject = open_subject(config, sequence=index, overrides=changes)
    result, reports = run_diff(subject, moment(subject), None, [])
    over = [report.quantity.name for report in reports if not report.passed]
    share, worst = max(
        (report.value / report.tolerance, report.quantity.name) for report in reports if report.tolerance
    )
    share_text = f"{worst} {share:.2g} of its tolerance"
    return {"buffers": len(reports), "over": ", ".join(over) or "none", "worst": share_text, "passed": result["passed"]}


def fingerprint(options: Namespace) -> Rows:
    packed = Path(options.packed) / PACKED
    if not packed.is_file():
        raise AssetError("nothing to compare with", where=str(packed), accepted="use --pack before")
    known = dict(np.load(packed))
    for name in [*cases.table()["cases"]][: 4 if options.small else None]:
        yield name, partial(_beside_packed, name, known)


def _beside_packed(name: str, known: dict[str, np.ndarray]) -> Row:
    """Compare the files of a case, by the share of values that are more than 2 % of their range off."""
    made, far = arrays_of(name), {}
    for path in made.keys() & known.keys():
        ours, theirs = made[path].astype(np.float64), known[path].astype(np.float64)
        same_size = ours.shape == theirs.shape
        far[path] = float((np.abs(ours - theirs) > 0.02 * np.ptp(theirs)).mean()) if same_size else 1.0
    others = sum(path not in made for path in known if path.startswith(f"{name}/")) + len(made.keys() - known.keys())
    events = [(int(made[path].sum()), int(known[path].sum())) for path in far if path.endswith(".h5")]
    share, worst = max((share, path) for path, share in far.items())
    row = {"files": len(made), "other files": others, "events, theirs": ", ".join(f"{a:,}, {b:,}" for a, b in events)}
    return row | {"values that differ, %": 100 * share, "where": worst if share else ""}


def arrays_of(name: str) -> dict[str, np.ndarray]:
    """Return the pictures and labels of a case of the fingerprint, and the number of events in each of its pixels."""
    arrays = {}
    with tempfile.TemporaryDirectory() as folder:
        cases.assets(Path(folder))
        out = cases.generated(name, Path(folder), WITHOUT_CODECS)
        for path in [*out.rglob("*.png"), *out.rglob("events.h5")]:
            if path.suffix == ".png":
                array = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            else:
                with DsecEventReader(path) as reader:
                    assert reader.height is not None and reader.width is not None
                    events, sides = reader.slice(0, 2**40), (range(reader.height + 1), range(reader.width + 1))
                array = np.histogram2d(events.y, events.x, sides)[0].astype(np.uint16)
            assert array is not None
            arrays[f"{name}/{path.relative_to(out).as_posix()}"] = array
    return arrays


# --- events on tensors ------------------------------------------------------------------------------------------------


def events(options: Namespace) -> Iterator[tuple[str, Callable[[], Row]]]:
    sizes, total = SIZES[:3] if options.small else SIZES, 0

    def compare(config: EsimConfig | V2eConfig, turn: int) -> Row:
        nonlocal total
        kinds = (TensorEsim if isinstance(config, EsimConfig) else TensorV2e, emulator_of(config))
        before, changes = total, {"device": options.device, "seed": 2**64 - 2 + turn, "frames_seed": turn}
        # Large pictures in the first turn alone; noise of V2E takes a second for a million pixels.
        for height, width, envs in sizes if turn == 0 else sizes[2:-1]:
            density = 0.1 if height * width > 10_000 else 0.3 * (1 + turn % 3)
            total += same_events.compare(*kinds, config, height, width, envs, density=density, **changes)
        return {"events, all the same": total - before, "so far": total}

    for turn, (name, config) in itertools.product(range(1000), VARIANTS.items()):
        if turn and (total >= options.events or total == 0):
            return
        yield f"{name}, turn {turn}", partial(compare, config, turn)


def noise(height: int, width: int, density: float, frames: int) -> np.ndarray:
    """(frames, H, W) float32 with ``density`` events a pixel and frame at thresholds of 0.2: pixels drawn by lot go
    there and back again, over the same levels each time, from the second frame on."""
    rng, levels = np.random.default_rng(1), max(1, int(np.ceil(density)))
    moving = rng.choice((-1.0, 1.0), (height, width)) * (rng.random((height, width)) < density / levels)
    places = np.where(np.arange(frames) % 2 == 1, levels + 0.5, -0.5)  # in thresholds, beyond the levels by its spread
    return np.exp(0.2 * places[:, None, None] * moving - 1.0).astype(np.float32)


def timed(step: Callable[[int], int], seconds: float) -> tuple[float, float]:
    """Wall seconds of a step, with what the card does in it, and what it counts, both medians. torch warms it up and
    repeats it for so long."""
    counted, numbers = [], itertools.count()
    once = lambda: counted.append(step(next(numbers)))
    timer = torch.utils.benchmark.Timer("once()", globals={"once": once})
    return timer.blocked_autorange(min_run_time=seconds).median, float(np.median(counted))


def kernel(options: Namespace) -> Rows:
    height, width = (48, 64) if options.small else (480, 640)
    for density, envs in itertools.product(DENSITIES[:2] if options.small else DENSITIES, (1, 16, 256)):
        # A step would take a processor minutes and more than 10 GB.
        if options.device != "cpu" or density * envs * height * width < 3e7:
            name = f"{width}x{height}, {envs} environments, {density:g} events a pixel and frame asked for"
            yield name, partial(_kernel_speed, options, height, width, density, envs)


def _kernel_speed(options: Namespace, height: int, width: int, density: float, envs: int) -> Row:
    """Frames on the device, beside numba on one core."""
    card, config, pixels = options.device.startswith("cuda"), EsimConfig(), envs * height * width
    if card:
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
    clip = noise(height, width, density, 3)[1:]  # there and back again, for ever
    frames = torch.from_numpy(clip).to(options.device)[:, None].expand(2, envs, height, width).contiguous()
    batch = TensorEsim(height, width, config, envs=envs, device=options.device)
    single = make_emulator(config, height, width)
    seconds, made = timed(lambda k: len(batch.step(frames[k % 2], k * STEP_NS)), 0.06 if options.small else 1.5)
    numba_s, numba_made = timed(lambda k: len(single.step(clip[k % 2], k * STEP_NS)), 0.06 if options.small else 0.5)
    state = sum(t.numel() * t.element_size() for t in vars(batch).values() if isinstance(t, torch.Tensor))
    process_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "events a pixel and frame": made / pixels,
        "Mev/s": made / seconds / 1e6,
        "frames/s": envs / seconds,
        "ms a step and environment": 1e3 * seconds / envs,
        "numba Mev/s": numba_made / numba_s / 1e6,
        "of numba's speed": made / seconds / (numba_made / numba_s),
        "state, bytes a pixel": state / pixels,
        "peak, GB": torch.cuda.max_memory_allocated() / 1e9 if card else process_kib / 1e6,
    }


# --- from OpenGL to tensors -------------------------------------------------------------------------------------------


def transfer(options: Namespace) -> Rows:
    for way in ("interop", "pinned", "plain"):
        yield way, partial(_moved, options, way)


def _moved(options: Namespace, way: str) -> Row:
    """A picture of 640x480 floats; interop compares its first one with what OpenGL reads."""
    with (
        create_context(options.backend, options.egl_device) as gl,
        Target(gl, 640, 480, ("R32F",), depth=False) as target,
    ):
        target.colour[0].write(np.arange(640 * 480, dtype=np.float32).tobytes())
        reader = TextureReader(gl, target, 0, options.device)
        if (way == "interop" and reader.way != way) or (way == "pinned" and reader.device.type != "cuda"):
            raise GLError(f"not used here: {reader.why}", where=way)
        reader.way = way
        seconds, _ = timed(lambda k: int(reader.read()[0, 0]), 0.5)
        same = np.array_equal(reader.read().cpu().numpy(), target.read(0))
        reader.release()
    return {"ms a picture": 1e3 * seconds, "same numbers": same, "still by": reader.way}


def end_to_end(options: Namespace) -> Rows:
    for kind in ("tri/16", "full"):
        yield kind, partial(_drawn_and_seen, options, kind)


def _drawn_and_seen(options: Namespace, kind: str) -> Row:
    """Where frames go, and what each part takes."""
    (height, width), device = (48, 64) if options.small else (480, 640), options.device
    with (
        create_context(options.backend, options.egl_device) as gl,
        Renderer(gl, probe_scene(kind, width, height), RenderConfig(antialiasing="none")) as renderer,
    ):
        batch = TensorEsim(height, width, device=device)

        def step(k: int) -> int:
            frame = renderer.luminance(k * STEP_NS % 2_000_000_000)
            events = batch.step(frame.tensor(device)[None], k * STEP_NS)
            voxel_grid(events, 0, 10**9, 5)
            return len(events)

        def draw(k: int) -> int:
            renderer.luminance(k * STEP_NS % 2_000_000_000)
            gl.ctx.finish()
            return 0

        seconds, made = timed(step, 0.1 if options.small else 6.0)
        return {
            "drawn by": gl.renderer,
            "frames/s": 1 / seconds,
            "drawing alone, frames/s": 1 / timed(draw, 0.1 if options.small else 3.0)[0],
            "Mev/s": made / seconds / 1e6,
            "frames go by": renderer.luminance(0).transfer(device),
        }


# --- whole sequences --------------------------------------------------------------------------------------------------


def cold(options: Namespace) -> Rows:
    sizes = overrides("camera.width=64", "camera.height=48", "time.duration=0.1", *WITHOUT_CODECS)
    for name in ("no kernel compiled", "compiled"):
        words = ("generate", "flying_objects", "--out", f"{options.scratch}/{name}", "-q", *sizes)
        run = partial(command, "blinkgl", *words, cache=f"{options.scratch}/numba")
        yield f"a command to its end, {name}", lambda run=run: {"wall, s": run()}


def sequences(options: Namespace) -> Rows:
    """The most important first: what is cut off is what comes last."""
    sizes = ((64, 48),) if options.small else ((640, 480), (1280, 720))
    dancers = overrides(*only("dancers"), "groups.dancers.output.sequences=12")
    runs = {"flying_objects": ["flying_objects"], "dancers": ["blinkflow", *dancers], "stereo": ["stereo"]}
    counts = (1, 2) if options.small else (1, 4, 12)
    for workers, size, name in itertools.product(counts, sizes, runs):
        title = f"{name}, {size[0]}x{size[1]}, {workers} process{'es' if workers > 1 else ''}"
        yield title, partial(_generated, options, runs[name], size, workers)


def _generated(options: Namespace, run: list[str], size: tuple[int, int], workers: int) -> Row:
    """A sequence for each process; seconds by simulated second, the stages' a mean over the processes."""
    out = f"{tempfile.mkdtemp(dir=options.scratch)}/set"
    time_of = ("time.duration=0.1", "time.label_rate=20") if options.small else ("time.duration=1",)
    sizes = overrides(f"camera.width={size[0]}", f"camera.height={size[1]}", *WITHOUT_CODECS, *time_of)
    count = str(workers)
    wall = command("blinkgl", "generate", *run, *sizes, "--out", out, "-q", "--num", count, "--workers", count)
    costs = [json.loads(line) for line in Path(out, ".run", "costs.jsonl").read_text().splitlines()]
    simulated = sum(cost["simulated_s"] for cost in costs)
    share = lambda amounts: sum(amounts) / simulated
    stages = dict.fromkeys(stage for cost in costs for stage in cost["seconds"])
    return {
        "wall, s/s": share(cost["total_s"] for cost in costs),
        "processor, s/s": share(cost["cpu_s"] for cost in costs),
        "command, s/s of all": wall / simulated,
        **{f"{stage}, s/s": share(cost["seconds"].get(stage, 0.0) for cost in costs) for stage in stages},
    }
