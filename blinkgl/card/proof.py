"""Does a card round as the processor does? It is asked, not believed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from blinkgl.card.kernels import IEEE, Kernels, Rounding
from blinkgl.events.arith import LOG_MAX_INPUT, log_q25

if TYPE_CHECKING:
    from blinkgl.gl import GLContext

_ASKED = 2**16
_answers: dict[tuple[str, str, str], Rounding] = {}


def rounding(gl: GLContext) -> Rounding:
    """What this card has to do in whole numbers: where its logarithm of 65,536 numbers (all orders of magnitude, and
    the ends of its intervals) or its sums, products, quotients and roots of as many pairs are not the processor's, bit
    for bit. Asked once per driver and process."""
    driver = (gl.vendor, gl.renderer, gl.version)
    if driver not in _answers:
        intensity = questions()
        logs = bool(np.array_equal(card_logs(gl, intensity, 0.0), log_q25(intensity)))
        floats, doubles = (_operations_agree(gl, kind) for kind in (np.float32, np.float64))
        _answers[driver] = Rounding(not (logs and all(floats[:2])), not all(floats[2:]), not all(doubles))
    return _answers[driver]


def _operations_agree(gl: GLContext, kind: type) -> list[bool]:
    """Whether sums, products, quotients and roots are the processor's."""
    wanted = np.stack(processor_operations(*pairs(kind)), axis=-1)
    return [bool(same) for same in (card_operations(gl, *pairs(kind)) == wanted).all(axis=0)]


def pairs(kind: type) -> tuple[np.ndarray, np.ndarray]:
    """(65536,) each, float32 or float64, above zero; sums of one and its neighbour's negative cancel."""
    rng = np.random.default_rng(2)
    a, b = (np.exp2(rng.uniform(-30, 30, _ASKED)).astype(kind) for _ in range(2))
    near = slice(0, _ASKED // 4)
    b[near] = a[near] * (1 + rng.integers(-8, 9, _ASKED // 4) * np.finfo(kind).eps).astype(kind)
    short = slice(_ASKED // 4, _ASKED // 2)  # of few bits: ties
    a[short], b[short] = (np.round(v[short] * 2.0**20) * 2.0**-10 + 2.0**-10 for v in (a, b))
    return a, b


def processor_operations(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, ...]:
    """a - b, a b, a / b, root of a."""
    return a - b, a * b, a / b, np.sqrt(a)


def card_operations(gl: GLContext, a: np.ndarray, b: np.ndarray, rounding: Rounding = IEEE) -> np.ndarray:
    """(N, 4) as :func:`processor_operations` has them, N a multiple of 64."""
    buffers = [gl.ctx.buffer(a.tobytes()), gl.ctx.buffer(b.tobytes()), gl.ctx.buffer(reserve=4 * a.nbytes)]
    try:
        double = {"DOUBLES": 1} if a.dtype == np.float64 else {}
        Kernels(gl, rounding).run("compute/rounding.glsl", double, dict(enumerate(buffers)), {}, items=a.size)
        return np.frombuffer(buffers[2].read(), a.dtype).reshape(-1, 4)
    finally:
        for buffer in buffers:
            buffer.release()


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
        Kernels(gl, Rounding(soft_float)).run(
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
