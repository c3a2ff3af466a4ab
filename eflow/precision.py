"""The precision that a device computes in, and islands of float32 where bfloat16 is not good enough."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from blinkgl.machine.cpu import bf16_instructions


def lacks_bf16(device: torch.device) -> str:
    """Why bf16 makes no sense on the device, in words; "" where it does. By the instruction set, not by a timed probe:
    two probes on a busy machine may differ, and a run that is resumed should compute as it did."""
    if device.type == "cuda":
        if torch.cuda.is_bf16_supported(including_emulation=False):
            return ""
        return f"{torch.cuda.get_device_name(device)} has no bf16 units"
    if bf16_instructions():
        return ""
    return "this CPU has neither AVX-512 BF16 nor AMX, without which bf16 is 45 to 80 times slower than fp32"


def precision_on(device: torch.device, wanted: str, quiet: bool = False) -> str:
    """``wanted`` ("fp32" or "bf16"), or "fp32" where the device cannot; one line on stderr says so."""
    reason = lacks_bf16(device) if wanted == "bf16" else ""
    if reason and not quiet:
        print(f"precision: fp32 instead of bf16: {reason}", file=sys.stderr, flush=True)  # noqa: T201
    return "fp32" if reason else wanted


def use_tf32(device: torch.device, wanted: bool = True) -> bool:
    """Whether fp32 products on a card are made of TF32 ones from here on, which have ten bits instead of 23 and are
    several times faster: where it is wanted and the card has them (capability 8.0 and above). Fp32 islands
    (:func:`eflow.precision.fp32`) stay exact."""
    able = wanted and device.type == "cuda" and torch.cuda.get_device_capability(device) >= (8, 0)
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = able
    return able


# ---------------------------------------------------------------------------------------------------------------------
# Where bf16 is not good enough: softmax and expectation, coordinates, flow accumulation, upsampling (errors of px
# otherwise).


@contextmanager
def fp32(x: Tensor) -> Iterator[None]:
    """Context in which autocast, and on a card TF32, are off: an fp32 island. Cast the inputs with ``.float()``."""
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
