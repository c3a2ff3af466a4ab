"""Where bf16 is not good enough: softmax and expectation, coordinates, flow accumulation,
upsampling (errors of px otherwise)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor


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
