"""The clocks of Alembic files, from bytes that are written here by the formats' descriptions."""

import importlib.util
import struct
from pathlib import Path

import pytest

import blinkgl.blender

_FILE = Path(blinkgl.blender.__file__).parent / "inside" / "rates.py"
_SPEC = importlib.util.spec_from_file_location("rates", _FILE)
rates = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(rates)


def ogawa(samplings) -> bytes:
    """An Ogawa file whose root has six children; the fifth lists (count, seconds a cycle, times) of samplings."""
    table = b"".join(
        struct.pack("<IdI", count, cycle, len(times)) + struct.pack(f"<{len(times)}d", *times)
        for count, cycle, times in samplings
    )
    data = b"Ogawa\xff\x00\x01" + struct.pack("<Q", 16)
    place = 16 + 8 + 6 * 8
    data += struct.pack("<7Q", 6, *[1 << 63] * 4, place | 1 << 63, 1 << 63)
    return data + struct.pack("<Q", len(table)) + table


@pytest.mark.parametrize(
    "samplings, rate",
    [
        ([(1, 1.0, [0.0]), (16, 1 / 30, [1 / 30])], 30.0),
        ([(250, 1 / 25, [0.0]), (1, 1.0, [0.0])], 25.0),
        ([(40, 1 / 24, [0.0, 0.25 / 24])], 48.0),  # two samples a cycle
        ([(1, 1.0, [0.0])], None),  # nothing moves
        ([], None),
    ],
)
def test_alembic(tmp_path, samplings, rate):
    (tmp_path / "a.abc").write_bytes(ogawa(samplings))
    assert rates.rate_of(tmp_path / "a.abc", tmp_path) == (None if rate is None else pytest.approx(rate))


def test_what_is_not_stated(tmp_path):
    for name, data in (("a.usdc", b"PXR-USDC\0\10"), ("a.fbx", b"Kaydara"), ("a.usdz", b"PK"), ("a.abc", b"\x89HDF")):
        (tmp_path / name).write_bytes(data)
        assert rates.rate_of(tmp_path / name, tmp_path) is None
