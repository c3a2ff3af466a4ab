"""The clocks of USD and Alembic files, from bytes that are written here by the formats' descriptions."""

import importlib.util
import struct
import zipfile
from pathlib import Path

import pytest

import blinkgl.blender

_FILE = Path(blinkgl.blender.__file__).parent / "inside" / "rates.py"
_SPEC = importlib.util.spec_from_file_location("rates", _FILE)
rates = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(rates)

TEXT = '#usda 1.0\n(\n    defaultPrim = "W"\n    {}\n    upAxis = "Z"\n)\n\n'
TEXT += 'def Xform "W"\n{{\n    custom double {} = 7\n}}\n'


@pytest.mark.parametrize(
    "settings, rate",
    [
        ("timeCodesPerSecond = 60", 60.0),
        ("timeCodesPerSecond = 29.97", 29.97),
        ("framesPerSecond = 30\n    timeCodesPerSecond = 48", 48.0),
        ("timeCodesPerSecond = 48\n    framesPerSecond = 30", 48.0),
        ("framesPerSecond = 30", 30.0),  # which stands in for it
        ("endTimeCode = 10", 24.0),  # the standard's default
    ],
)
@pytest.mark.parametrize("ending", [".usda", ".usd", ".usdz"])
def test_usd_of_text(tmp_path, settings, rate, ending):
    text = TEXT.format(settings, "timeCodesPerSecond").encode()
    file = tmp_path / f"a{ending}"
    if ending == ".usdz":
        with zipfile.ZipFile(file, "w") as archive:
            archive.writestr("root.usda", text)
            archive.writestr("other.usda", b"#usda 1.0\n(\n timeCodesPerSecond = 5\n)\n")
    else:
        file.write_bytes(text)
    assert rates.rate_of(file) == rate


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
    assert rates.rate_of(tmp_path / "a.abc") == (None if rate is None else pytest.approx(rate))


def test_what_is_not_stated(tmp_path):
    for name, data in (("a.usdc", b"PXR-USDC\0\10"), ("a.fbx", b"Kaydara"), ("a.usdz", b"PK"), ("a.abc", b"\x89HDF")):
        (tmp_path / name).write_bytes(data)
        assert rates.rate_of(tmp_path / name) is None
