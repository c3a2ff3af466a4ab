"""``eflow bench``: time, arithmetic and memory per model and resolution, forward and training step."""

from __future__ import annotations

import platform
import resource
import statistics
import subprocess
import sys
import time
from typing import Any

import torch

from blinkgl.errors import ConfigError
from eflow.allocator import keep_memory
from eflow.counting import count
from eflow.losses import sequence_loss
from eflow.models import NETWORKS, SIZES, build_model, model_config

PRESETS: dict[str, dict] = {
    name if size == "base" else f"{name}-{size}": {"name": name, "size": size} for name in NETWORKS for size in SIZES
} | {"eflowformer-twins": {"name": "eflowformer", "layers": 2, "attention": "twins"}}
"""Names that ``eflow bench`` takes: every network in every size."""


def preset(name: str):
    """Model configuration of a bench name. Raises ConfigError."""
    if name not in PRESETS:
        raise ConfigError("unknown model", where="--model", value=name, accepted="one of " + ", ".join(PRESETS))
    return model_config(PRESETS[name])


def machine() -> str:
    """One line: processor or GPU, threads, torch."""
    if torch.cuda.is_available():
        return f"{torch.cuda.get_device_name()}, torch {torch.__version__}"
    model = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            model = next((line.split(":", 1)[1].strip() for line in file if line.startswith("model name")), model)
    except OSError:
        pass
    return f"{model}, {torch.get_num_threads()} threads, torch {torch.__version__}"


def measure(
    name: str,
    height: int,
    width: int,
    *,
    training: bool = False,
    plain: bool = False,
    repeats: int = 5,
    warmup: int = 1,
    precision: str = "fp32",
    batch: int = 1,
) -> dict[str, Any]:
    """Median (and smallest) milliseconds of a forward pass (or forward + backward + AdamW step),
    GMACs of the forward pass and peak memory in MiB.

    On the CPU the peak is the process's resident set, so :func:`isolated` measures each
    model in a process of its own."""
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if not plain:  # the allocator's setting is part of the fast path, and lasts for the process
        keep_memory()
    config = preset(name)
    torch.manual_seed(0)
    model = build_model(config).to(device).train(training)
    if hasattr(model, "plain"):
        model.plain = plain
    data = {k: torch.randn(batch, model.representation.channels, height, width, device=device) for k in ("old", "new")}
    target, valid = (
        torch.zeros(batch, 2, height, width, device=device),
        torch.ones(batch, height, width, dtype=torch.bool, device=device),
    )
    optimizer = torch.optim.AdamW(model.parameters(), 1e-5)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats()

    def step() -> None:
        with torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16"), torch.set_grad_enabled(training):
            prediction = model(data)
        if training:
            optimizer.zero_grad(set_to_none=True)
            sequence_loss(prediction, target, valid).backward()
            optimizer.step()
        if device.type == "cuda":
            torch.cuda.synchronize()

    times = []
    for i in range(warmup + repeats):
        began = time.perf_counter()
        step()
        times += [time.perf_counter() - began] if i >= warmup else []
    peak = (
        torch.cuda.max_memory_allocated()
        if device.type == "cuda"
        else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    )
    parameters, gmacs = count(config, height, width, plain=True)
    return {
        "model": name,
        "height": height,
        "width": width,
        "batch": batch,
        "mode": "train" if training else "forward",
        "plain": plain,
        "precision": precision,
        "ms": 1000 * statistics.median(times),
        "ms_min": 1000 * min(times),
        "gmacs": gmacs,
        "gmacs_done": count(config, height, width, plain=False)[1] if not plain and not training else gmacs,
        "parameters": parameters,
        "peak_mib": peak / 2**20,
        "machine": machine(),
    }


def isolated(**options) -> dict[str, Any]:
    """:func:`measure` in a fresh process."""
    import json

    code = (
        "import json\nfrom eflow.bench import "
        f"measure\nprint(json.dumps(measure(**json.loads({json.dumps(json.dumps(options))}))))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    if done.returncode:
        tail = done.stderr.strip().splitlines()
        return {
            **options,
            "model": options["name"],
            "error": "out of memory" if done.returncode < 0 else (tail[-1] if tail else "failed"),
        }
    return json.loads(done.stdout.splitlines()[-1])
