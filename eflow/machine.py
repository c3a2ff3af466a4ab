"""The machine that a network computes on: devices, the processes of torchrun and communication between them; precision,
with islands of float32 where bfloat16 is not accurate enough; memory."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
from collections.abc import Iterator

import torch
import torch.distributed as dist
from torch import Tensor

from blinkgl.errors import ConfigError
from blinkgl.machine.cpu import bf16_instructions
from eflow.config import TrainConfig


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


def lacks_bf16(device: torch.device) -> str:
    """Return the reason why bf16 is of no use on the device, as text; "" if it is of use.

    The instruction set decides, not a timed probe: probes on a busy machine may differ, and a resumed run should
    compute as before."""
    if device.type == "cuda":
        if torch.cuda.is_bf16_supported(including_emulation=False):
            return ""
        return f"{torch.cuda.get_device_name(device)} has no bf16 units"
    if bf16_instructions():
        return ""
    return "this CPU has neither AVX-512 BF16 nor AMX, without which bf16 is 45 to 80 times slower than fp32"


def precision_on(device: torch.device, wanted: str, quiet: bool = False) -> str:
    """Return ``wanted`` ("fp32" or "bf16"), or "fp32" and a line on stderr if the device has no bf16."""
    reason = lacks_bf16(device) if wanted == "bf16" else ""
    if reason and not quiet:
        print(f"precision: fp32 instead of bf16: {reason}", file=sys.stderr, flush=True)  # noqa: T201
    return "fp32" if reason else wanted


def use_tf32(device: torch.device, wanted: bool = True) -> bool:
    """Switch TF32 for fp32 products on or off, and return whether it is on.

    TF32 is several times faster and has ten bits of fraction instead of 23. It needs a GPU of capability 8.0 or above.
    Fp32 islands (:func:`fp32`) do not use it."""
    able = wanted and device.type == "cuda" and torch.cuda.get_device_capability(device) >= (8, 0)
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = able
    return able


def runs_once(x: Tensor) -> bool:
    """Whether the operations on ``x`` are executed on a processor, without gradients and without a record of them.

    Short cuts of the processor (numba kernels, blocks that fit the cache) are taken only then: a trace or an export
    would keep what they returned for its example as a constant."""
    recorded = torch.is_grad_enabled() or torch.compiler.is_compiling() or torch.jit.is_tracing()
    return x.device.type == "cpu" and not recorded


# ---------------------------------------------------------------------------------------------------------------------
# Parts that bf16 would compute with errors of pixels: softmax and expectation, coordinates, accumulation of flow,
# upsampling.


@contextlib.contextmanager
def fp32(x: Tensor) -> Iterator[None]:
    """Context without autocast and TF32, an fp32 island. Cast the inputs with ``.float()``."""
    with torch.autocast(x.device.type if x.device.type in ("cpu", "cuda") else "cpu", enabled=False):
        # TF32 keeps 10 bits of a float32's fraction.
        tf32 = x.device.type == "cuda" and torch.backends.cuda.matmul.allow_tf32
        if tf32:
            torch.backends.cuda.matmul.allow_tf32 = False
        try:
            yield
        finally:
            if tf32:
                torch.backends.cuda.matmul.allow_tf32 = True


_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # malloc.h


def keep_memory() -> bool:
    """Keep freed blocks for the rest of the process; return False if the C library has no ``mallopt``."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    return bool(mallopt(_MMAP_THRESHOLD, 1 << 30)) and bool(mallopt(_TRIM_THRESHOLD, (1 << 31) - 1))
