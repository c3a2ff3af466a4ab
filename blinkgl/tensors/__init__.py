"""ESIM and V2E in torch: events as tensors, of many environments at once, on the device of the frames.

In:    linear luminance, (environments, H, W) float32 on one device; an emulator's configuration; seeds
Out:   TensorEvents on that device, bit for bit those of the numba kernels, and grids made of them
Start: batch.py (frames in, events out), then esim.py

Every operation is an eager torch operation, which IEEE 754 rounds the same way on every device; :mod:`~.arith` computes
the functions of :mod:`blinkgl.events.arith` by the same sums and products. So the same frames and seed make the same
events on a CPU and on a GPU. (``torch.compile`` may contract a product and a sum into one rounding; do not compile
these functions where the bits matter.)

torch takes seconds to import, so names are loaded when they are first used. Nothing here is differentiable, because
events are discrete.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from blinkgl.tensors.batch import TensorEvents, event_counts, latest_times, time_surface, voxel_grid
    from blinkgl.tensors.esim import TensorEsim
    from blinkgl.tensors.v2e import TensorV2e

__all__ = ["TensorEsim", "TensorEvents", "TensorV2e", "event_counts", "latest_times", "time_surface", "voxel_grid"]
_HOMES = {"TensorEsim": "esim", "TensorV2e": "v2e"}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES.get(name, 'batch')}"), name)
