"""Names for the arrays and tensors that this package passes on: what they hold, their shape, dtype and unit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from torch import Tensor

Flow: TypeAlias = npt.NDArray[np.float32]
"""(H, W, 2) float32 px, +x right, +y down: the displacement of the point seen at a pixel."""
Mask: TypeAlias = npt.NDArray[np.bool_]
"""(H, W) bool, pixels."""
Grid: TypeAlias = npt.NDArray[np.float32]
"""(C, H, W) float32, the events of a window as channels."""
Picture: TypeAlias = npt.NDArray[np.uint8]
"""(H, W, 3) uint8, RGB."""
Times: TypeAlias = npt.NDArray[np.int64]
"""(N,) int64 µs."""
Numbers: TypeAlias = npt.NDArray[np.floating]
"""Any shape, a floating dtype; words say which."""
Batch: TypeAlias = "Mapping[str, Tensor]"
"""By name: ``old``, ``new`` (N, C, H, W) float32, of the windows that a network reads; ``flow_init`` (N, 2, H/8, W/8)
float32, px of that resolution, on request."""
