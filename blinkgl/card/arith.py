"""The constants of the emulators' arithmetic as GLSL: ``arith.glsl``, which no file holds, so that they stand in one
place, :mod:`blinkgl.events.arith`."""

from __future__ import annotations

import numpy as np

from blinkgl.events import arith, philox, v2e_model as v2e
from blinkgl.events.philox import Stream


def includes() -> dict[str, str]:
    """Text by the name that it is included by. Floats and doubles are given as their bits: no compiler has to read a
    decimal number right."""
    # Another module's constants, which nobody but its own functions and these shaders has to know.
    named = lambda letter, count: [getattr(arith, f"_{letter}{k}") for k in range(count)]
    log, sine, cosine, log1p = named("B", 7), named("S", 7), named("C", 8), named("A", 9)
    doubles = [*log, *sine, *cosine, np.float64(arith._LN2_64), arith._SQRT_HALF_BITS_64.view(np.float64)]  # noqa: SLF001
    lines = [
        f"#define Q_LN2 {int(arith._Q_LN2)}",  # noqa: SLF001
        f"#define SQRT_HALF_BITS {_float(arith._SQRT_HALF_BITS.view(np.float32))}",  # noqa: SLF001
        f"#define Q_SCALE_BITS {_float(arith._Q_SCALE)}",  # noqa: SLF001
        f"const uint LOG_BITS[{len(log1p)}] = uint[]({', '.join(_float(c) for c in log1p)});",
        f"#define LOG_FIRST 0\n#define LOG_COUNT {len(log)}",
        f"#define SIN_FIRST {len(log)}\n#define SIN_COUNT {len(sine)}",
        f"#define COS_FIRST {len(log) + len(sine)}\n#define COS_COUNT {len(cosine)}",
        f"#define LN2 {len(doubles) - 2}\n#define SQRT_HALF {len(doubles) - 1}",
        f"const uvec2 DOUBLES[{len(doubles)}] = uvec2[]({', '.join(_double(c) for c in doubles)});",
        f"#define JITTER_STREAM {int(Stream.JITTER)}u",
    ]
    return {"arith.glsl": "\n".join(lines) + "\n", "v2e_numbers.glsl": _of_v2e()}


def _of_v2e() -> str:
    """What V2E's shaders take beside that."""
    of = lambda module, names: {name: getattr(module, f"_{name}") for name in names.split()}
    floats = {
        **of(v2e, "JOINT SLOPE ZERO ONE HALF SMALLEST_K TABLE_LOW TABLE_PER TABLE_LAST"),
        **of(arith, "LN2_32 LOG2E_32 LN2_HI_32 LN2_LO_32 ROUND_32 EXP_MIN_32"),
        "DARK": v2e.DARK,
        "SETTLED": v2e.SETTLED,
        "FARTHEST": np.float32(1e6),
    }
    doubles = {
        **of(arith, "LOG2E_64 LN2_HI_64 LN2_LO_64 ROUND_64 FALL_MIN_64"),
        "DARKEST": v2e.DARKEST,
        "THREE_ROOT": philox._THREE_ROOT,  # noqa: SLF001
        "MEAN_OF_FOUR": 2.0 - 2.0 * 2.0**-32,
        "TWENTY": 20.0,
        "SPAN": 275.0,
        "THREE_QUARTERS": 0.75,
        "TENTH": 0.1,
        "MOST_NS": 1e18,
        "NS": 1e-9,
        "TWO": 2.0,
        "THREE": 3.0,
        "CLOSE": 2e-6,
        "CLOSEST": 1e-9,
    }
    lists = {
        "EXP_BITS": [getattr(arith, f"_E32_{k}") for k in range(7)],
        "GROWTH_BITS": [getattr(v2e, f"_P{k}") for k in range(7)],
        "LOG1P_BITS": [getattr(arith, f"_A{k}") for k in range(9)],
    }
    falls = [getattr(arith, f"_X{k}") for k in range(13)]
    lines = [
        *(f"#define F_{name} FLOAT_OF({_float(value)})" for name, value in floats.items()),
        *(f"#define D_{name} DOUBLE_OF({_double(np.float64(value))})" for name, value in doubles.items()),
        *(f"const uint {n}[{len(c)}] = uint[]({', '.join(_float(v) for v in c)});" for n, c in lists.items()),
        f"const uvec2 FALL_WORDS[{len(falls)}] = uvec2[]({', '.join(_double(c) for c in falls)});",
        *(f"#define {name}_STREAM {int(Stream[name])}u" for name in ("LEAK_JITTER", "SHOT", "NOISE")),
    ]
    return "\n".join(lines) + "\n"


def _float(value: np.float32) -> str:
    return f"0x{int(np.float32(value).view(np.uint32)):08X}u"


def _double(value: np.float64) -> str:
    low, high = words(int(np.float64(value).view(np.uint64)))
    return f"uvec2(0x{low:08X}u, 0x{high:08X}u)"


def words(value: int) -> tuple[int, int]:
    """(low, high) 32-bit word of a whole number of 64 bits, negative ones by two's complement."""
    value &= 2**64 - 1
    return value & 0xFFFFFFFF, value >> 32
