"""Precision of computations, and islands of float32 where bfloat16 is not accurate enough."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from blinkgl.machine.cpu import bf16_instructions


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
    Fp32 islands (:func:`eflow.precision.fp32`) do not use it."""
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


@contextmanager
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
