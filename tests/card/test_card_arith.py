"""The numbers of the card: logarithms, 64-bit division, doubles of whole numbers, draws; all as on the processor."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.card.kernels import Kernels, Rounding
from blinkgl.card.proof import card_logs, card_operations, pairs, processor_operations, questions, rounding
from blinkgl.events.arith import log_q25
from blinkgl.events.philox import Stream, normal2

HEAD = """layout(local_size_x = 64) in;
layout(std430, binding = 0) readonly buffer A { uvec2 a[]; };
layout(std430, binding = 1) readonly buffer B { uvec2 b[]; };
layout(std430, binding = 2) buffer Out { uvec2 result[]; };
void main() {
    uint i = gl_GlobalInvocationID.x;
"""


def computed(gl, folder, include: str, body: str, a: np.ndarray, b: np.ndarray, **soft: bool) -> np.ndarray:
    """(N,) uint64 of (N,) 64-bit numbers, N a multiple of 64, by a program of one line."""
    file = folder / "one.glsl"
    file.write_text(f'#include "{include}"\n{HEAD}    result[i] = {body};\n}}\n')
    buffers = [gl.ctx.buffer(np.ascontiguousarray(x).tobytes()) for x in (a, b)] + [gl.ctx.buffer(reserve=a.nbytes)]
    Kernels(gl, Rounding(**soft)).run(str(file), {}, dict(enumerate(buffers)), {}, items=a.size)
    out = np.frombuffer(buffers[2].read(), np.uint64)
    for buffer in buffers:
        buffer.release()
    gl.shaders.clear()
    return out


@pytest.mark.parametrize("soft_float", [False, True])
@pytest.mark.parametrize("eps", [0.0, 1e-3, 1e-9])
def test_logarithms_are_those_of_the_processor(gl, eps, soft_float):
    asked = questions()
    wanted = log_q25(asked + np.float32(eps))
    np.testing.assert_array_equal(card_logs(gl, asked, eps, soft_float), wanted)
    dark = np.zeros(64, np.float32)  # what is added is all there is
    if eps:
        np.testing.assert_array_equal(
            card_logs(gl, dark, eps, soft_float), np.broadcast_to(log_q25(np.full(1, eps, np.float32)), 64)
        )


def test_a_driver_that_rounds_otherwise_is_found_out(gl, monkeypatch):
    from blinkgl.card import proof

    right = rounding(gl)
    assert right == Rounding()  # llvmpipe's is the processor's own
    wrong_in_one = lambda array, k: np.where(np.arange(len(array)) == 77, np.nextafter(array[:, k], 9e9), array[:, k])

    def asked(kind: type, k: int):
        def operations(gl, a, b):
            taken = card_operations(gl, a, b).copy()
            taken[:, k] = wrong_in_one(taken, k) if a.dtype == kind else taken[:, k]
            return taken

        monkeypatch.setattr(proof, "_answers", {})
        monkeypatch.setattr(proof, "card_operations", operations)
        return rounding(gl)

    assert asked(np.float32, 0) == asked(np.float32, 1) == Rounding(soft_float=True)
    assert asked(np.float32, 2) == asked(np.float32, 3) == Rounding(soft_division=True)
    assert asked(np.float64, 1) == asked(np.float64, 2) == Rounding(soft_double=True)
    monkeypatch.setattr(proof, "_answers", {})
    monkeypatch.setattr(proof, "card_operations", card_operations)
    monkeypatch.setattr(proof, "card_logs", lambda gl, v, eps: log_q25(v) + (v == v[77]))  # one of 65,536, by one
    assert rounding(gl) == Rounding(soft_float=True)


@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_operations_are_those_of_the_processor(gl, kind, soft):
    a, b = pairs(kind)
    taken = card_operations(gl, a, b, Rounding(soft, soft, soft))
    for k, wanted in enumerate(processor_operations(a, b)):
        np.testing.assert_array_equal(taken[:, k], wanted)


def doubles(seed: int, positive: bool = False) -> np.ndarray:
    """(8192,) of many sizes, with short mantissas, near ties and zeros among them."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=8192) * np.exp2(rng.integers(-40, 40, 8192))
    x[:2000] = np.round(x[:2000] * 8) / 8
    x[2000:3000] = 1.0 + rng.integers(-3, 4, 1000) * 2.0**-52
    x[3000:4000] = np.float32(x[3000:4000])
    return np.abs(x) + 2.0**-60 if positive else x


@pytest.mark.parametrize(
    ("body", "wanted", "positive"),
    [
        ("add_double(a[i], b[i])", np.add, False),
        ("mul_double(a[i], b[i])", np.multiply, False),
        ("div_double(a[i], b[i])", np.divide, True),
        ("sqrt_double(a[i])", lambda a, _: np.sqrt(a), True),
    ],
)
def test_doubles_of_whole_numbers(gl, tmp_path, body, wanted, positive):
    a, b = doubles(1, positive), doubles(2, positive)
    b[4000:5000] = -a[4000:5000] * (1 + np.arange(1000) % 3 * 2.0**-52) if not positive else b[4000:5000]
    got = computed(gl, tmp_path, "soft_double.glsl", body, a, b).view(np.float64)
    np.testing.assert_array_equal(got, wanted(a, b))


def test_floor_of_doubles(gl, tmp_path):
    a = np.clip(doubles(3), -(2.0**31), 2.0**31 - 1)
    got = computed(gl, tmp_path, "soft_double.glsl", "uvec2(uint(floor_of(a[i])), 0u)", a, a)
    np.testing.assert_array_equal(got.astype(np.uint32).view(np.int32), np.floor(a).astype(np.int64))


def test_draws_are_those_of_the_processor(gl, tmp_path):
    rng = np.random.default_rng(5)
    seed, pixel, index = (rng.integers(0, 2**k, 1024, dtype=np.uint64) for k in (64, 31, 31))
    a, b = normal2(seed, pixel, np.uint64(Stream.JITTER), index)
    counter = pixel | (index << np.uint64(32))
    for soft in (False, True):
        for name, wanted in (("on", a), ("off", b)):
            body = "uvec2(0u); DOUBLE on, off; normal2(a[i], b[i].x, JITTER_STREAM, b[i].y, on, off); "
            body += f"result[i] = WORDS_OF({name})"
            got = computed(gl, tmp_path, "normal.glsl", body, seed, counter, soft_double=soft).view(np.float64)
            np.testing.assert_array_equal(got, wanted)


def test_division_of_64_bits(gl, tmp_path):
    rng = np.random.default_rng(6)
    b = rng.integers(1, 2 ** rng.integers(1, 32, 8192)).astype(np.uint64)
    quotient = rng.integers(0, 2 ** rng.integers(1, 33, 8192)).astype(np.uint64)
    rest = np.where(rng.random(8192) < 0.3, b - np.uint64(1), rng.integers(0, b.astype(np.int64)).astype(np.uint64))
    rest[:1000] = 0
    body = "uvec2(0u); uint rest; uint q = divide64(a[i], b[i].x, rest); result[i] = uvec2(q, rest)"
    got = computed(gl, tmp_path, "words64.glsl", body, quotient * b + rest, b)
    np.testing.assert_array_equal(got, quotient | (rest << np.uint64(32)))
