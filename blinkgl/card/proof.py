"""Does a card round sums and products of floats as the processor does? It is asked, not believed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from blinkgl.card.kernels import Kernels
from blinkgl.events.arith import LOG_MAX_INPUT, log_q25

if TYPE_CHECKING:
    from blinkgl.gl import GLContext

_ASKED = 2**16
_answers: dict[tuple[str, str, str], bool] = {}


def rounds_like_ieee(gl: GLContext) -> bool:
    """Whether the shader's logarithm of 65,536 numbers (all orders of magnitude, and the ends of its intervals) is the
    processor's, bit for bit. Asked once per driver and process."""
    driver = (gl.vendor, gl.renderer, gl.version)
    if driver not in _answers:
        intensity = questions()
        _answers[driver] = bool(np.array_equal(card_logs(gl, intensity, 0.0), log_q25(intensity)))
    return _answers[driver]


def questions() -> np.ndarray:
    """(65536,) float32 in [2^-30, 2^30]."""
    rng = np.random.default_rng(1)
    spread = np.exp(rng.uniform(-20.7, 20.7, _ASKED - 2048)).astype(np.float32)
    half = np.float32(np.sqrt(0.5)) * np.float32(2.0) ** rng.integers(-29, 29, 1024).astype(np.float32)
    near = half.view(np.int32) + rng.integers(-3, 4, 1024).astype(np.int32)  # where the interval changes
    one = np.float32(1.0).view(np.int32) + np.arange(-512, 512, dtype=np.int32)  # where cancellation is
    both = np.concatenate([near, one]).view(np.float32)
    return np.clip(np.concatenate([spread, both]), 1 / LOG_MAX_INPUT, LOG_MAX_INPUT).astype(np.float32)


def card_logs(gl: GLContext, intensity: np.ndarray, eps: float, soft_float: bool = False) -> np.ndarray:
    """(N,) int32 of (N,) float32, N a multiple of 64: what the event kernels take for the logarithm."""
    given, taken = gl.ctx.buffer(intensity.tobytes()), gl.ctx.buffer(reserve=intensity.nbytes)
    try:
        Kernels(gl, soft_float).run(
            "compute/logarithms.glsl",
            {},
            {0: given, 1: taken},
            {"eps": float(np.float32(eps))},
            items=intensity.size // 4,
        )
        return np.frombuffer(taken.read(), np.int32)
    finally:
        given.release()
        taken.release()
