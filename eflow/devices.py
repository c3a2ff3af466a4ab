"""Devices of a training, the processes of torchrun, and communication between them."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

import torch
import torch.distributed as dist

from blinkgl.errors import ConfigError
from eflow.allocator import keep_memory
from eflow.config import TrainConfig
from eflow.precision import use_tf32


def setup(config: TrainConfig) -> tuple[int, int, torch.device]:
    """Join the process group of torchrun, if any, and return (rank, world, device).

    world : number of processes; rank : the number of this one."""
    # Set by torchrun.
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
    # torch gives memory back after each step and asks for it again, which costs more than the step's small layers.
    if kind == "cpu":
        keep_memory()
    if config.run.threads:
        torch.set_num_threads(config.run.threads)
    if world > 1 and not dist.is_initialized():
        dist.init_process_group("nccl" if kind == "cuda" else "gloo")
    return rank, world, device


def to_device(batch: dict, device: torch.device, channels_last: bool) -> dict:
    """Copy the tensors of a batch to the device, those of events in the memory layout of the network."""
    out = {k: v.to(device, non_blocking=True) if torch.is_tensor(v) else v for k, v in batch.items()}
    if channels_last:
        out.update({k: out[k].contiguous(memory_format=torch.channels_last) for k in ("old", "new") if k in out})
    return out


def agree(reason: str | None, device: torch.device) -> str | None:
    """Return the most important reason to stop of all processes, so that all stop at the same step; None: continue."""
    codes = [None, "signal", "time limit", "stop"]
    code = torch.tensor(codes.index(reason), device=device)
    dist.all_reduce(code, op=dist.ReduceOp.MAX)
    return codes[int(code)]


@contextlib.contextmanager
def compile_errors(enabled: bool) -> Iterator[None]:
    """Raise a ConfigError if torch.compile lacks something on this machine (a C++ compiler, Triton)."""
    try:
        yield
    except Exception as error:
        if enabled and type(error).__module__.startswith(("torch._dynamo", "torch._inductor")):
            reason = next(iter(str(error).strip().splitlines()), type(error).__name__)
            raise ConfigError(
                f"torch.compile does not work here: {reason}", where="run.compile", value=True, accepted="false"
            ) from error
        raise
