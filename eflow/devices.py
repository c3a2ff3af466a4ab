"""Where a training computes: its device, the processes of torchrun, and what passes between them."""

from __future__ import annotations

import contextlib
import os

import torch
import torch.distributed as dist

from blinkgl.errors import ConfigError
from eflow.allocator import keep_memory
from eflow.config import TrainConfig
from eflow.precision import use_tf32


def setup(config: TrainConfig) -> tuple[int, int, torch.device]:
    """Return (rank, world, device) and join torchrun's process group where there is one.

    world : number of processes, of which this is the ``rank``-th."""
    rank, world, local = (int(os.environ.get(k, d)) for k, d in (("RANK", 0), ("WORLD_SIZE", 1), ("LOCAL_RANK", 0)))
    kind = config.run.device
    if kind == "auto":
        kind = "cuda" if torch.cuda.is_available() else "cpu"
    if kind == "cuda" and not torch.cuda.is_available():
        raise ConfigError("no CUDA device on this machine", where="run.device", value="cuda", accepted="cpu or auto")
    device = torch.device("cuda", local) if kind == "cuda" else torch.device("cpu")
    if kind == "cuda":
        torch.cuda.set_device(device)
        use_tf32(device, config.run.tf32)
    if kind == "cpu":
        keep_memory()
    if config.run.threads:
        torch.set_num_threads(config.run.threads)
    if world > 1 and not dist.is_initialized():
        dist.init_process_group("nccl" if kind == "cuda" else "gloo")
    return rank, world, device


def to_device(batch: dict, device: torch.device, channels_last: bool) -> dict:
    """Copy a batch's tensors to the device; the events' in the memory layout that the network has."""
    out = {k: v.to(device, non_blocking=True) if torch.is_tensor(v) else v for k, v in batch.items()}
    if channels_last:
        out.update({k: out[k].contiguous(memory_format=torch.channels_last) for k in ("old", "new") if k in out})
    return out


def agree(reason: str | None, device: torch.device) -> str | None:
    """Return the gravest reason to stop that any process has, so that all stop at the same step; None goes on."""
    codes = [None, "signal", "time limit", "stop"]
    code = torch.tensor(codes.index(reason), device=device)
    dist.all_reduce(code, op=dist.ReduceOp.MAX)
    return codes[int(code)]


@contextlib.contextmanager
def compile_errors(enabled: bool):
    """What torch.compile needs and does not find (a C++ compiler, Triton) is the machine's lack, not a bug of ours."""
    try:
        yield
    except Exception as error:
        if enabled and type(error).__module__.startswith(("torch._dynamo", "torch._inductor")):
            reason = next(iter(str(error).strip().splitlines()), type(error).__name__)
            raise ConfigError(
                f"torch.compile does not work here: {reason}", where="run.compile", value=True, accepted="false"
            ) from error
        raise
