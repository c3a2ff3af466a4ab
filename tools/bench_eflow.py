"""How fast the event networks' own code is: voxel grids, samples, and inference against the RAFT-style twin.

    python -m blinkgl.tools.bench_eflow [--model eflowformer] [--size 640x480] [--rounds 5]
                                        [--data FOLDER] [--json FILE]

- Voxel grids of 15 bins at 640x480, one core: million events per second, uniform and clustered
  events, raw and rectified coordinates.
- Inference: rounds of the fast path and of the twin (``model.plain``: RAFT's lookup by 81 grid samples, its unfold
  upsampling, the mask in every iteration, nothing hoisted) alternate in two processes that are never busy at once;
  ratio of the medians, and of the medians of processor seconds. The flows are compared. The allocator's setting
  (eflow/allocator.py) lasts for a process, so it is tried in both ways for the twin.
- With --data, milliseconds to make one training sample from files, and to make its grids from
  events in memory: what a cache could save.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import time
from pathlib import Path

import numpy as np

from blinkgl.machine import bench
from eflow.ops.voxel import voxel_grid

BINS = 15


def voxels(height: int, width: int, events: int, rounds: int) -> dict[str, float]:
    """Million events per second on one core, the best of ``rounds`` (the kernel is serial); normalisation included."""
    rng = np.random.default_rng(0)
    t = np.sort(rng.integers(0, 100_000, events))
    p = rng.integers(0, 2, events).astype(np.uint8)
    uniform = rng.integers(0, width, events), rng.integers(0, height, events)
    # Along moving edges, as a camera sees them: 400 lines, each event at its line's place at its time.
    line = rng.integers(0, 400, events)
    edges = (
        (rng.random(400)[line] * width + 20 * t / 1e5) % width,
        (rng.random(400)[line] * height + 40 * rng.random(events)) % height,
    )
    out = {}
    for name, (x, y) in (("uniform", uniform), ("edges", edges)):
        for kind, dtype in (("integer pixels", np.uint16), ("rectified", np.float32)):
            columns = x.astype(dtype), y.astype(dtype), t, p
            run = lambda: voxel_grid(*columns, 0, 100_000, BINS, height, width)
            out[f"{name}, {kind}"] = events / 1e6 / bench.seconds(run, rounds, 1)["min"]
    return out


def _inference(pipe, name: str, height: int, width: int, plain: bool, keep: bool, threads: int) -> None:
    """A process with one model; answers every message with (wall s, processor s, flow)."""
    import torch

    from eflow.allocator import keep_memory
    from eflow.bench import preset
    from eflow.infer import predict
    from eflow.models import build_model

    torch.set_num_threads(threads)
    if keep:
        keep_memory()
    torch.manual_seed(0)
    model = build_model(preset(name)).eval()
    torch.nn.init.normal_(model.update.flow_head[-1].weight, std=0.02)  # else an untrained network says next to nothing
    model.plain = plain
    batch = {k: torch.randn(1, model.representation.channels, height, width) for k in ("old", "new")}
    while pipe.recv():
        wall, processor = time.perf_counter(), time.process_time()
        flow = predict(model, batch).flow
        pipe.send((time.perf_counter() - wall, time.process_time() - processor, flow.numpy()))


VARIANTS = {"fast": (False, True), "twin": (True, False), "twin, memory kept": (True, True)}


def inference(name: str, height: int, width: int, rounds: int, threads: int) -> dict:
    """Median wall and processor seconds per variant, ratios, and the largest difference of the flows in px."""
    context = multiprocessing.get_context("spawn")
    workers = {}
    for variant, (plain, keep) in VARIANTS.items():
        pipe, other = context.Pipe()
        process = context.Process(
            target=_inference, args=(other, name, height, width, plain, keep, threads), daemon=True
        )
        process.start()
        workers[variant] = (pipe, process)
    times, flows = {v: [] for v in VARIANTS}, {}
    for i in range(rounds + 1):
        for variant, (pipe, _) in workers.items():
            pipe.send(True)
            wall, processor, flows[variant] = pipe.recv()
            if i:  # the first round warms up
                times[variant].append((wall, processor))
    for pipe, process in workers.values():
        pipe.send(False)
        process.join()
    median = {v: np.median(times[v], axis=0) for v in VARIANTS}
    twins = [v for v in VARIANTS if v != "fast"]
    return {
        "seconds": {v: float(m[0]) for v, m in median.items()},
        "processor_seconds": {v: float(m[1]) for v, m in median.items()},
        "ratio": {v: float(median[v][0] / median["fast"][0]) for v in twins},
        "ratio_processor": {v: float(median[v][1] / median["fast"][1]) for v in twins},
        "px": {v: float(np.abs(flows[v] - flows["fast"]).max()) for v in twins},
        "mean_flow_px": float(np.abs(flows["fast"]).mean()),
        "times": times,
    }


def samples(folder: str, count: int = 50) -> dict[str, float]:
    """Milliseconds per sample: from files, and its two voxel grids alone."""
    from eflow.data.dataset import FlowDataset
    from eflow.data.representation import VoxelGrid
    from eflow.data.sources import open_source

    source, grid = open_source(folder), VoxelGrid()
    dataset = FlowDataset([source], grid, empty="skip")
    indices = np.linspace(0, len(dataset) - 1, count).round().astype(int).tolist()
    whole, grids = [], []
    for i in indices:
        raw = source[i]
        for times, run in (
            (whole, lambda: dataset[i]),
            (grids, lambda: [grid(w, raw.height, raw.width) for w in (raw.old, raw.new)]),
        ):
            began = time.perf_counter()
            run()
            times.append(time.perf_counter() - began)
    return {"sample_ms": 1000 * float(np.median(whole)), "grids_ms": 1000 * float(np.median(grids))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--model", default="eflowformer", choices=["eflowformer", "eflowformer-small", "eflowformer-twins", "eraft"]
    )
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--events", type=int, default=5_000_000)
    parser.add_argument("--data", help="a data set, to time samples of it")
    parser.add_argument("--json")
    a = parser.parse_args()
    width, height = (int(v) for v in a.size.split("x"))
    print(bench.machine_line())
    result: dict = {"machine": bench.machine_line(), "voxels_Mev_s": voxels(480, 640, a.events, a.rounds)}
    for name, value in result["voxels_Mev_s"].items():
        print(f"voxel grid, {name}: {value:.1f} M events/s on one core")
    if a.data:
        result["samples"] = samples(a.data)
        print(
            "one sample: {sample_ms:.2f} ms from files, of which its grids {grids_ms:.2f} ms".format(
                **result["samples"]
            )
        )
    result["inference"] = r = inference(a.model, height, width, a.rounds, a.threads)
    for variant in VARIANTS:
        line = (
            f"{a.model} {a.size}, {variant}: {r['seconds'][variant]:.2f} s, processor "
            f"{r['processor_seconds'][variant]:.2f} s"
        )
        if variant in r["ratio"]:
            line += (
                f"; {r['ratio'][variant]:.2f} times the fast path's time ({r['ratio_processor'][variant]:.2f} times "
                f"its processor time), flows of {r['mean_flow_px']:.1f} px agree to {r['px'][variant]:.1e} px"
            )
        print(line)
    if a.json:
        Path(a.json).write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
