"""Every field of every format of pictures and videos, set to each value of its specification and to values that are in
none: the codes equal what a reader written here, or a closed form, makes of them, or one line names the field."""

from __future__ import annotations

import io
import itertools
import struct
import warnings
import zlib
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from blinkgl.cli import run
from blinkgl.errors import BlinkGLError
from blinkgl.io import stills, video, yuv
from blinkgl.io.frames import open_frames
from blinkgl.io.reading import Declared
from blinkgl.io.stills import open_stills
from tests.videos import put_video

H, W = 6, 10
GREY = (np.arange(H * W).reshape(H, W) * 4).astype(np.uint8)
COLOUR = np.stack([GREY, 255 - GREY, GREY // 2], axis=-1)


def picture(path, background=None) -> tuple[np.ndarray, list[str]]:
    one = open_stills(path)
    return one.read(background=background), one.notes


def one_line(call, *words) -> str:
    with pytest.raises(BlinkGLError) as caught:
        call()
    text = str(caught.value)
    assert "\n" not in text and all(word in text for word in words), text
    return text


# ---------------------------------------------------------------------------------------------------------------------
# PNG and PNM, written byte by byte.


def png(depth: int, kind: int, samples: np.ndarray, palette: bytes = b"") -> bytes:
    """(H, W, channels) samples; kind is PNG's colour type."""
    rows = b""
    for row in samples.reshape(samples.shape[0], -1).tolist():
        bits = "".join(f"{value:0{depth}b}" for value in row)
        bits += "0" * (-len(bits) % 8)
        rows += b"\0" + int(bits, 2).to_bytes(len(bits) // 8, "big")
    chunk = lambda name, body: struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
    head = struct.pack(">IIBBBBB", samples.shape[1], samples.shape[0], depth, kind, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + (chunk(b"PLTE", palette) if palette else b"") + chunk(
        b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")  # fmt: skip


COLOUR_TYPES = {0: (1, (1, 2, 4, 8, 16)), 2: (3, (8, 16)), 3: (1, (1, 2, 4, 8)), 4: (2, (8, 16)), 6: (4, (8, 16))}
"""PNG's colour types (table 11.1): channels and bit depths."""


@pytest.mark.parametrize(("kind", "depth"), [(k, d) for k, (_, depths) in COLOUR_TYPES.items() for d in depths])
def test_colour_types_of_png(tmp_path, kind, depth):
    channels = COLOUR_TYPES[kind][0]
    rng, most = np.random.default_rng(kind * 20 + depth), 2**depth - 1
    samples = rng.integers(0, most + 1, (H, W, channels))
    palette = rng.integers(0, 256, 3 * 2**depth).astype(np.uint8).tobytes() if kind == 3 else b""
    (tmp_path / "a.png").write_bytes(png(depth, kind, samples, palette))
    image, notes = picture(tmp_path / "a.png")
    top = 65535 if depth == 16 else 255
    if kind == 3:
        expected = np.frombuffer(palette, np.uint8).reshape(-1, 3)[samples[..., 0]]
    else:
        codes = samples / most * top
        alpha = codes[..., -1:] / top if kind in (4, 6) else 1.0
        expected = np.rint(codes[..., : 3 if kind in (2, 6) else 1] * alpha)
        expected = expected if kind in (2, 6) else expected[..., 0]
    assert image.dtype == (np.uint16 if depth == 16 else np.uint8) and image.shape == expected.shape
    assert np.abs(image.astype(int) - expected).max() <= (1 if kind in (4, 6) else 0)
    assert bool(notes) == (kind in (4, 6))


@pytest.mark.parametrize(("kind", "depth"), [(0, 3), (1, 8), (2, 4), (3, 16), (5, 8), (7, 8)])
def test_colour_types_that_png_does_not_have(tmp_path, kind, depth):
    (tmp_path / "a.png").write_bytes(png(depth, kind, np.zeros((H, W, 1), int)))
    one_line(lambda: picture(tmp_path / "a.png"), "a.png", "decode")


MAXIMA = (1, 2, 15, 100, 254, 255, 256, 1000, 4095, 32767, 65534, 65535)


@pytest.mark.parametrize("most", MAXIMA)
@pytest.mark.parametrize("magic", ["P2", "P3", "P5", "P6"])
def test_maxima_of_pnm(tmp_path, magic, most):
    """Light is code / maximum, whatever the maximum (netpbm's pages)."""
    channels = 3 if magic in ("P3", "P6") else 1
    codes = np.random.default_rng(most).integers(0, most + 1, (H, W, channels))
    head = f"{magic}\n# a comment\n{W} {H}\n{most}\n".encode()
    if magic in ("P2", "P3"):
        body = " ".join(map(str, codes.ravel())).encode() + b"\n"
    else:
        body = codes.astype(">u2" if most > 255 else "u1").tobytes()
    for k in (0, 1):
        (tmp_path / f"{k}.{'ppm' if channels == 3 else 'pgm'}").write_bytes(head + body)
    source = open_frames(tmp_path, Declared(fps=10))
    image = next(iter(source))[0]
    white = source.levels[1] if source.levels else np.iinfo(image.dtype).max
    expected = codes / most
    assert np.abs(image / white - (expected if channels == 3 else expected[..., 0])).max() < 0.51 / min(
        white, 255 * 257
    )


@pytest.mark.parametrize("magic", ["P1", "P4"])
def test_bitmaps_of_pnm(tmp_path, magic):
    bits = np.random.default_rng(0).integers(0, 2, (H, 16))
    body = "\n".join(" ".join(map(str, row)) for row in bits.tolist()).encode() if magic == "P1" else np.packbits(
        bits.astype(np.uint8), axis=1).tobytes()  # fmt: skip
    (tmp_path / "a.pbm").write_bytes(f"{magic}\n16 {H}\n".encode() + body)
    assert np.array_equal(picture(tmp_path / "a.pbm")[0], 255 * (1 - bits))  # 1 is black


@pytest.mark.parametrize("head", [b"P5\n2 2\n0\n", b"P5\n2 2\n65536\n", b"P7\nWIDTH 2\n", b"P8\n2 2\n255\n", b"PX"])
def test_pnm_that_is_none(tmp_path, head):
    (tmp_path / "a.pgm").write_bytes(head + b"\0" * 16)
    one_line(lambda: picture(tmp_path / "a.pgm"), "PNM")


# ---------------------------------------------------------------------------------------------------------------------
# TIFF: tags are patched in whole files, so that each can have any value.


def tagged(path, image, tags: dict[int, int] | None = None, **options) -> None:
    """Write a page, and set tags of one 16-bit number."""
    tifffile.imwrite(path, image, metadata=None, **options)
    data = bytearray(path.read_bytes())
    at = struct.unpack_from("<I", data, 4)[0]
    for k in range(struct.unpack_from("<H", data, at)[0]):
        entry = at + 2 + 12 * k
        code, kind, count = struct.unpack_from("<HHI", data, entry)
        if code in (tags or {}) and kind == 3:
            place = entry + 8 if count <= 2 else struct.unpack_from("<I", data, entry + 8)[0]
            for j in range(count):
                struct.pack_into("<H", data, place + 2 * j, tags[code])
    path.write_bytes(data)


PHOTOMETRIC = {
    0: "white is zero", 1: "black is zero", 2: "RGB", 3: "palette", 4: "mask", 5: "CMYK", 6: "YCbCr", 8: "CIELab",
    9: "ICCLab", 10: "ITULab", 32803: "CFA", 32844: "LogL", 32845: "LogLuv", 34892: "LinearRaw", 51177: "depth",
    52527: "mask", 7: "none", 99: "none",
}  # fmt: skip
"""TIFF 6.0, its technical notes, and DNG 1.7."""
READ_PHOTOMETRIC = {0, 1, 2, 3, 5, 6}


@pytest.mark.parametrize("value", PHOTOMETRIC)
def test_photometric_of_tiff(tmp_path, value):
    path, colour = tmp_path / "a.tif", value in (2, 5, 6)
    if value == 3:
        palette = np.random.default_rng(0).integers(0, 256, (3, 256)).astype(np.uint16) * 257
        tifffile.imwrite(path, GREY, photometric="palette", colormap=palette, metadata=None)
        assert np.array_equal(picture(path)[0], np.moveaxis(palette // 257, 0, -1)[GREY])
    elif value == 5:
        ink = np.stack([GREY, 255 - GREY, GREY, np.full_like(GREY, 30)], axis=-1)
        tifffile.imwrite(path, ink, photometric="separated", metadata=None)
        black = 1 - ink[..., 3:] / 255
        assert np.abs(picture(path)[0] - 255 * (1 - ink[..., :3] / 255) * black).max() <= 1.01
    elif value == 6:
        Image.fromarray(COLOUR).convert("YCbCr").save(path)
        assert np.abs(picture(path)[0].astype(int) - COLOUR).max() <= 3
    elif value in READ_PHOTOMETRIC:
        tagged(path, COLOUR if colour else GREY, {262: value}, photometric="rgb" if colour else "minisblack")
        image, notes = picture(path)
        assert np.array_equal(image, 255 - GREY if value == 0 else COLOUR if colour else GREY)
        assert notes == []
    else:
        tagged(path, GREY, {262: value}, photometric="minisblack")
        one_line(lambda: picture(path), "PhotometricInterpretation", str(value))
    assert set(stills._PHOTOMETRIC) == READ_PHOTOMETRIC <= set(PHOTOMETRIC)


DTYPES = {
    "u1": (1, 8), "u2": (1, 16), "u4": (1, 32), "u8": (1, 64), "i1": (2, 8), "i2": (2, 16), "i4": (2, 32), "f2": (3,
    16), "f4": (3, 32), "f8": (3, 64), "c8": (6, 64), "c16": (6, 128),
}  # fmt: skip
"""TIFF's SampleFormat and BitsPerSample."""


@pytest.mark.parametrize("kind", DTYPES)
def test_samples_of_tiff(tmp_path, kind):
    tifffile.imwrite(tmp_path / "a.tif", (GREY // 2).astype(kind), photometric="minisblack", metadata=None)
    if DTYPES[kind] in stills._SAMPLES:
        image = picture(tmp_path / "a.tif")[0]
        assert np.array_equal(image, GREY // 2) and image.dtype in (np.uint8, np.uint16, np.float32)
    else:
        one_line(lambda: picture(tmp_path / "a.tif"), "SampleFormat, BitsPerSample", str(DTYPES[kind][1]))


@pytest.mark.parametrize("value", [4, 5, 0, 7])
def test_formats_of_samples_that_are_none(tmp_path, value):
    tagged(tmp_path / "a.tif", GREY.astype("f4"), {339: value}, photometric="minisblack")
    one_line(lambda: picture(tmp_path / "a.tif"), "SampleFormat", f"[{value}]")


@pytest.mark.parametrize("bits", [1, 2, 4, 10, 12, 14])
def test_bits_of_tiff(tmp_path, bits):
    """Fewer than 8 fill 8 bits; more stay codes, and white is the largest."""
    path, top = tmp_path / "a.tif", 2**bits - 1
    codes = np.random.default_rng(bits).integers(0, top + 1, (H, 16))
    packed = b"".join(
        int("".join(f"{v:0{bits}b}" for v in row), 2).to_bytes(16 * bits // 8, "big") for row in codes.tolist()
    )
    entries = [(256, 4, 16), (257, 4, H), (258, 3, bits), (259, 3, 1), (262, 3, 1), (273, 4, 8), (277, 3, 1),
               (278, 4, H), (279, 4, len(packed))]  # fmt: skip
    ifd = struct.pack("<H", len(entries)) + b"".join(struct.pack("<HHII", c, k, 1, v) for c, k, v in entries)
    path.write_bytes(b"II*\0" + struct.pack("<I", 8 + len(packed)) + packed + ifd + b"\0" * 4)
    try:
        one = open_stills(path)
        image = one.read()
    except BlinkGLError as error:
        assert bits > 8 and "\n" not in str(error)  # 12 packed bits want another library
    else:
        white = one.white or np.iinfo(image.dtype).max
        assert np.abs(image / white - codes / top).max() < 0.003


@pytest.mark.parametrize("value", range(10))
def test_orientations(tmp_path, value):
    """1 to 8, as TIFF 6.0 says: row 0 and column 0 are the sides that are named; others are refused or said."""
    tagged(tmp_path / "a.tif", COLOUR, {274: value}, photometric="rgb", extratags=[(274, 3, 1, 1, True)])
    upright = {
        1: COLOUR, 2: COLOUR[:, ::-1], 3: COLOUR[::-1, ::-1], 4: COLOUR[::-1], 5: COLOUR.swapaxes(0, 1),
        6: COLOUR[::-1].swapaxes(0, 1), 7: COLOUR[::-1, ::-1].swapaxes(0, 1), 8: COLOUR[:, ::-1].swapaxes(0, 1),
    }  # fmt: skip
    exif = Image.Exif()
    exif[274] = value
    Image.fromarray(COLOUR).save(tmp_path / "a.png", exif=exif)
    image, notes = picture(tmp_path / "a.png")
    if value in upright:
        assert np.array_equal(picture(tmp_path / "a.tif")[0], upright[value]) and np.array_equal(image, upright[value])
    else:
        if value:  # 0 is no tag for tifffile
            one_line(lambda: picture(tmp_path / "a.tif"), "Orientation", str(value))
        assert np.array_equal(image, COLOUR) and f"Orientation {value}" in notes[0]


@pytest.mark.parametrize("base", ["minisblack", "rgb"])
@pytest.mark.parametrize("extra", [0, 1, 2, 3, 9])
@pytest.mark.parametrize("kind", ["u1", "u2", "f4"])
def test_extra_samples(tmp_path, base, extra, kind):
    """Left out where they are not alpha; multiplied once where the file has not; over a colour; unknown ones
    refused."""
    top = {"u1": 255, "u2": 65535, "f4": 1.0}[kind]
    share = np.linspace(0.2, 1, H * W).reshape(H, W, 1)
    light = np.linspace(0, 0.6, H * W).reshape(H, W, 1) * ([0.5] if base == "minisblack" else [1, 0.5, 0.2])
    stored = light * share if extra == 1 else light
    data = np.concatenate([stored, share], axis=-1) * top
    data = data.astype("f4") if kind == "f4" else np.rint(data).astype(kind)
    path = tmp_path / "a.tif"
    tagged(path, data, {338: extra}, photometric=base, planarconfig="contig", extrasamples=["assocalpha"])
    if extra in (3, 9):
        one_line(lambda: picture(path), "ExtraSamples")
        return
    image, notes = picture(path, background=(255, 255, 255))
    expected = light if extra == 0 else light * share + (1 - share)
    expected = expected[..., 0] if base == "minisblack" else expected
    assert np.abs(image / top - expected).max() < 2 / 255 and len(notes) == 1
    assert ("left out: 1 further bands" in notes[0]) == (extra == 0)


def test_a_band_of_no_stated_meaning(tmp_path):
    """Near infrared beside red, green and blue is no alpha."""
    band = np.concatenate([COLOUR, 255 - GREY[..., None]], axis=-1)
    tifffile.imwrite(tmp_path / "a.tif", band, photometric="rgb", metadata=None, extrasamples=["unspecified"])
    image, notes = picture(tmp_path / "a.tif")
    assert np.array_equal(image, COLOUR) and "1 further bands" in notes[0]


@pytest.mark.parametrize("planar", ["contig", "separate"])
def test_planes(tmp_path, planar):
    data = COLOUR if planar == "contig" else np.moveaxis(COLOUR, -1, 0)
    tifffile.imwrite(tmp_path / "a.tif", data, photometric="rgb", planarconfig=planar, metadata=None)
    assert np.array_equal(picture(tmp_path / "a.tif")[0], COLOUR)


UNITS_OF_IMAGEJ = {"sec": 1e3, "s": 1e3, "ms": 1, "msec": 1, "µs": 1e-3, "us": 1e-3, "min": 6e4, "hour": 3.6e6,
                   "h": 3.6e6, "ns": 1e-6, None: 1e3, "fortnight": None, "pixel": None, "": None}  # fmt: skip


@pytest.mark.parametrize("unit", UNITS_OF_IMAGEJ)
@pytest.mark.parametrize("writer", ["imagej", "ome"])
def test_intervals_of_stacks(tmp_path, unit, writer):
    path, stack = tmp_path / ("a.tif" if writer == "imagej" else "a.ome.tif"), np.stack([GREY, GREY + 1, GREY + 2])
    spelt = unit.replace("µ", "\\u00B5") if unit and writer == "imagej" else unit
    said = {} if unit is None else {"tunit" if writer == "imagej" else "TimeIncrementUnit": spelt}
    if writer == "imagej":
        tifffile.imwrite(path, stack, imagej=True, metadata={"axes": "TYX", "finterval": 20.0, **said})
    else:
        extra = "".join(f' {k}="{v}"' for k, v in said.items())
        text = (f'<?xml version="1.0"?><OME><Image ID="I"><Pixels ID="P" DimensionOrder="XYZCT" Type="uint8" '
                f'SizeX="{W}" SizeY="{H}" SizeZ="1" SizeC="1" SizeT="3" TimeIncrement="20.0"{extra}/>'
                "</Image></OME>")  # fmt: skip
        tifffile.imwrite(path, stack, metadata=None, description=text.encode(), photometric="minisblack")
    scale = UNITS_OF_IMAGEJ[unit]
    if scale is None:
        source = open_frames(path, Declared(fps=100))
        assert [t for _, t, _ in source] == [0, 10_000_000, 20_000_000]
        assert any("of an unknown unit" in note for note in source.notes) and any(repr(unit) in n for n in source.notes)
    else:
        times = [t for _, t, _ in open_frames(path)]
        assert np.allclose(times, np.array([0, 20, 40]) * scale * 1e6, atol=1)


def test_a_stack_that_names_other_files_reads_none_of_them(tmp_path):
    for k in range(3):
        tifffile.imwrite(tmp_path / f"secret{k}.tif", np.full((H, W), 200, np.uint8))
    data = "".join(f'<TiffData FirstT="{k}" IFD="0"><UUID FileName="secret{k}.tif">urn:uuid:0-{k}</UUID></TiffData>'
                   for k in range(3))  # fmt: skip
    text = f'<OME><Image ID="I"><Pixels SizeX="{W}" SizeY="{H}" SizeT="3" SizeC="1">{data}</Pixels></Image></OME>'
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((H, W), np.uint8), description=text.encode(), metadata=None)
    assert open_stills(tmp_path / "a.tif").pages == 1 and picture(tmp_path / "a.tif")[0].max() == 0


# ---------------------------------------------------------------------------------------------------------------------
# Other pictures.


@pytest.mark.parametrize(
    "mode", ["1", "L", "LA", "RGB", "RGBA", "P", "PA", "CMYK", "YCbCr", "LAB", "I;16", "I", "F", "HSV"]
)
def test_modes_of_pillow(tmp_path, mode):
    """As a file of a format that holds the mode."""
    image = Image.fromarray(COLOUR).convert("L").convert(mode) if mode in ("I;16", "LAB") and mode != "LAB" else (
        Image.fromarray(COLOUR).convert(mode) if mode not in ("PA", "LAB", "HSV") else None)  # fmt: skip
    ending = {"CMYK": "jpg", "I": "png", "F": "tif", "YCbCr": "jpg"}.get(mode, "png")
    if image is None or mode == "I":
        assert (mode in stills._MODES) == (mode == "PA")
        return
    image.save(tmp_path / f"a.{ending}", **({"quality": 100, "subsampling": 0} if ending == "jpg" else {}))
    found, _ = picture(tmp_path / f"a.{ending}")
    expected = np.asarray(image.convert("RGB" if mode in ("CMYK", "YCbCr", "RGBA", "P", "RGB") else "L"))
    if mode == "F":
        expected = np.asarray(image)
    if mode == "I;16":
        expected = np.asarray(image)
    assert found.shape == expected.shape and np.abs(found.astype(float) - expected).max() <= (
        6 if ending == "jpg" else 0
    )
    assert mode in stills._MODES


@pytest.mark.parametrize("ending", ["jp2", "tga", "avif", "bmp", "webp", "gif", "jpg", "png", "tif"])
def test_endings_of_pictures(tmp_path, ending):
    options = {
        "jp2": {"irreversible": False},
        "webp": {"lossless": True},
        "avif": {"quality": 100},
        "jpg": {"quality": 98},
    }
    try:
        Image.fromarray(COLOUR).save(tmp_path / f"a.{ending}", **options.get(ending, {}))
    except (KeyError, OSError):
        pytest.skip(f"this Pillow writes no {ending}")
    image, _ = picture(tmp_path / f"a.{ending}")
    loss = {"jpg": 40, "avif": 40, "gif": 40}.get(ending, 0)
    assert image.shape == COLOUR.shape and np.abs(image.astype(int) - COLOUR).max() <= loss
    (tmp_path / f"A.{ending.upper()}").write_bytes((tmp_path / f"a.{ending}").read_bytes())
    assert np.array_equal(picture(tmp_path / f"A.{ending.upper()}")[0], image)


def jpeg(image=COLOUR) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "jpeg", quality=95)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("change", "whole"),
    [
        (lambda d: d, True),
        (lambda d: d + b"\0" * 50 + b"ftypmp42" + b"\xff\xda" + b"\1" * 90, True),
        (lambda d: d + jpeg(255 - COLOUR), True),
        (lambda d: d[:-2], True),
        (lambda d: d[: len(d) - 40], False),
        (lambda d: d[:30], False),
        (lambda d: b"", False),
    ],
)
def test_ends_of_jpeg(tmp_path, change, whole):
    """A motion photo, two pictures in one file, a mark of the end that is missing; and what is really cut."""
    data = jpeg(np.random.default_rng(0).integers(0, 255, (40, 56, 3)).astype(np.uint8))
    for k in range(4):
        (tmp_path / f"{k}.jpg").write_bytes(data)
    (tmp_path / "2.jpg").write_bytes(change(data))
    if whole:
        frames = [f for f, _, _ in open_frames(tmp_path, Declared(fps=10))]
        assert len(frames) == 4 and np.array_equal(frames[2], frames[0])
    else:
        one_line(lambda: list(open_frames(tmp_path, Declared(fps=10))), "2.jpg", "or --damaged keep")
        source = open_frames(tmp_path, Declared(fps=10, damaged="keep"))
        assert [t for _, t, _ in source] == [0, 10**8, 3 * 10**8] and any("left out: 2.jpg" in n for n in source.notes)


def test_grey_and_colour_and_links_that_lead_nowhere(tmp_path, capsys):
    for k in range(6):
        image = np.roll(GREY, k, axis=1)
        cv2.imwrite(str(tmp_path / f"{k}.png"), image if k % 2 else np.repeat(image[..., None], 3, axis=2))
    (tmp_path / "9.png").symlink_to(tmp_path / "gone.png")
    (tmp_path / "-1.png").symlink_to(tmp_path / "none.png")
    source = open_frames(tmp_path, Declared(fps=10))
    frames = [f for f, _, _ in source]
    assert [f.shape for f in frames] == [(H, W, 3)] * 6
    assert all(np.array_equal(f[..., c], np.roll(GREY, k, axis=1)) for k, f in enumerate(frames) for c in range(3))
    assert any("-1.png, 9.png: left out, since the link leads to no file" in note for note in source.notes)
    assert any("grey and colour" in note for note in source.notes)
    assert run(["simulate", str(tmp_path), "--out", str(tmp_path / "o.h5"), "--fps", "100"]) == 0


# ---------------------------------------------------------------------------------------------------------------------
# Videos: numbers of ITU-T H.273 as tags.

CURVES = {1: None, 2: None, 4: 2.2, 5: 2.8, 6: None, 7: None, 8: "linear", 9: "log", 10: "log", 11: None, 12: None,
          13: None, 14: None, 15: None, 16: "pq", 17: "smpte", 18: "hlg"}  # fmt: skip
MATRICES = {1: (0.2126, 0.0722), 2: (0.299, 0.114), 4: (0.30, 0.11), 5: (0.299, 0.114), 6: (0.299, 0.114),
            7: (0.212, 0.087), 9: (0.2627, 0.0593), 10: (0.2627, 0.0593)}  # fmt: skip
"""Weights of red and blue (H.273, table 4)."""


@pytest.mark.parametrize("curve", CURVES)
def test_curves_of_video(tmp_path, capsys, curve):
    path = put_video(tmp_path / "v.mp4", [COLOUR[:, :10]] * 3, codec="libx264", options={"qp": "0"}, curve=curve)
    reader = video.VideoReader(path)
    if curve in (9, 10, 17):
        status = run(["simulate", str(path), "--out", str(tmp_path / "e.h5")])
        error = capsys.readouterr().err
        assert status == 2 and "curve" in error and "--gamma" in error and error.count("\n") == 1
        assert run(["simulate", str(path), "--out", str(tmp_path / "e.h5"), "--gamma", "2.2"]) == 0
    else:
        assert reader.transfer == CURVES[curve]
    assert set(video.TRANSFERS) == set(CURVES)


@pytest.mark.parametrize("matrix", range(18))
@pytest.mark.parametrize("range_", [1, 2])
def test_matrices_and_ranges_of_video(tmp_path, matrix, range_):
    """Of one colour per frame, by the equations of H.273; what is not read is refused by its name."""
    yuv_codes = [(60, 128, 128), (120, 90, 150), (200, 140, 100)]
    planes = [np.stack([np.full((16, 16), v, np.uint8) for v in codes]) for codes in yuv_codes]
    path = put_video(
        tmp_path / "v.mkv", planes, codec="ffv1", source="yuv444p", size=(16, 16), range_=range_, matrix=matrix
    )
    with av.open(str(path)) as file:
        if int(next(file.decode(video=0)).colorspace) != matrix:
            pytest.skip(f"FFmpeg does not keep the matrix {matrix} here")
    if matrix not in MATRICES:
        one_line(lambda: video.VideoReader(path), "YUV matrix", f"got {matrix}")
        return
    red, blue = MATRICES[matrix]
    for (frame, _), (y, u, v) in zip(video.VideoReader(path), yuv_codes, strict=True):
        low, span, chroma = (16, 219, 224) if range_ == 1 else (0, 255, 255)
        light, cb, cr = (y - low) / span, (u - 128) / chroma, (v - 128) / chroma
        r, b = light + 2 * (1 - red) * cr, light + 2 * (1 - blue) * cb
        g = (light - red * r - blue * b) / (1 - red - blue)
        assert np.abs(frame[0, 0] - 255 * np.clip([r, g, b], 0, 1)).max() <= 1
    assert set(yuv._WEIGHTS) == set(MATRICES) and not set(MATRICES) & set(video._MATRICES)


@pytest.mark.parametrize("aspect", [Fraction(1), Fraction(2), Fraction(16, 11), Fraction(8, 9), Fraction(1, 2)])
def test_aspects_of_pixels(tmp_path, aspect):
    with av.open(str(tmp_path / "v.mp4"), "w") as file:
        stream = file.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt, stream.options = 48, 32, "yuv420p", {"qp": "0"}
        stream.codec_context.sample_aspect_ratio = aspect
        for k in range(3):
            file.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((32, 48, 3), 60 * k, np.uint8), "rgb24")))
        file.mux(stream.encode(None))
    source = open_frames(tmp_path / "v.mp4")
    shown = (32, round(48 * aspect)) if aspect >= 1 else (round(32 / aspect), 48)
    assert (source.height, source.width) == shown and next(iter(source))[0].shape[:2] == shown
    assert any("pixels are" in note for note in source.notes) == (aspect != 1)


@pytest.mark.parametrize("ending", ["y4m", "ts", "mts", "m2ts", "vob", "h264", "mkv", "avi", "mov", "qt", "mxf"])
def test_endings_of_videos(tmp_path, ending):
    """The same pictures in each container; a raw stream has the rate of its own header or none."""
    kind = {"y4m": "yuv4mpegpipe", "mts": "mpegts", "m2ts": "mpegts", "vob": "vob", "h264": "h264", "qt": "mov"}
    codec = {"y4m": "wrapped_avframe", "vob": "mpeg2video", "mxf": "mpeg2video"}.get(ending, "libx264")
    path = tmp_path / f"v.{ending}"
    with av.open(str(path), "w", format=kind.get(ending)) as file:
        stream = file.add_stream(codec, rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        if codec == "libx264":
            stream.options = {"threads": "1", "bf": "0"}
        for k in range(6):
            file.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((48, 64, 3), 30 * k, np.uint8), "rgb24")))
        file.mux(stream.encode(None))
    source = open_frames(path)
    found = list(source)
    assert len(found) == 6 and np.allclose(np.diff([t for _, t, _ in found]), 40_000_000, atol=20_000)
    assert all(abs(float(frame.mean()) - 30 * k) < 8 for k, (frame, _, _) in enumerate(found))


def test_a_bad_packet_costs_the_frames_that_need_it(tmp_path):
    """Of pictures that each stand alone one is lost; the refusal names the option, which reads the very file."""
    rng = np.random.default_rng(0)
    film = [rng.integers(0, 255, (48, 64, 3)).astype(np.uint8) for _ in range(20)]
    put_video(tmp_path / "v.mkv", film, codec="ffv1", options={"slicecrc": "1", "level": "3"}, pix_fmt="yuv444p")
    with av.open(str(tmp_path / "v.mkv")) as file:
        packets = [bytes(p) for p in file.demux(video=0) if p.size]
    data = (tmp_path / "v.mkv").read_bytes()
    at = data.index(packets[9])
    (tmp_path / "v.mkv").write_bytes(data[:at] + b"\0" * 60 + data[at + 60 :])
    try:
        count = len(list(open_frames(tmp_path / "v.mkv")))
    except BlinkGLError as error:
        assert "truncated or corrupt after frame 9" in str(error) and "--damaged keep" in str(error)
        source = open_frames(tmp_path / "v.mkv", Declared(damaged="keep"))
        kept = list(source)
        assert 18 <= len(kept) <= 19 and any("kept:" in note for note in source.notes)
        assert 9 not in [round(t / 1e7) for _, t, _ in kept]
    else:
        pytest.skip(f"FFmpeg passes over this damage: {count} frames")


def test_two_videos_in_one_file_are_listed(tmp_path):
    with av.open(str(tmp_path / "v.mkv"), "w") as file:
        streams = []
        for size in ((32, 48), (64, 96)):
            stream = file.add_stream("ffv1", rate=25)
            stream.height, stream.width, stream.pix_fmt = *size, "yuv444p"
            streams.append(stream)
        for k in range(3):
            for stream in streams:
                image = np.full((stream.height, stream.width, 3), 30 * k, np.uint8)
                file.mux(stream.encode(av.VideoFrame.from_ndarray(image, "rgb24")))
        for stream in streams:
            file.mux(stream.encode(None))
    with av.open(str(tmp_path / "v.mkv")) as file:
        default = av.stream.Disposition.default
        flagged = sum(bool(s.disposition & default) for s in file.streams.video)
    if flagged != 1:
        one_line(
            lambda: open_frames(tmp_path / "v.mkv"), "2 videos in the file", "--stream 0 (48x32)", "--stream 1 (96x64)"
        )
    for stream, size in (("0", (32, 48)), ("1", (64, 96))):
        source = open_frames(tmp_path / "v.mkv", Declared(stream=stream))
        assert (source.height, source.width) == size and len(list(source)) == 3


def test_arrays_of_frames_are_chosen_by_name(tmp_path):
    film = np.random.default_rng(0).integers(0, 255, (3, H, W)).astype(np.uint8)
    np.savez(tmp_path / "f.npz", images=film, video=255 - film, depth=film, timestamps_us=[0, 10, 20])
    one_line(lambda: open_frames(tmp_path / "f.npz"), "2 arrays of frames", "--stream 0 (images)", "--stream 1 (video)")
    for name, expected in (("images", film), ("1", 255 - film), ("depth", film)):
        frames = [f for f, _, _ in open_frames(tmp_path / "f.npz", Declared(stream=name))]
        assert np.array_equal(np.stack(frames), expected)
    for kind in ("?", "u1"):
        np.save(tmp_path / "f.npy", (film > 100).astype(kind))
        frames = [f for f, _, _ in open_frames(tmp_path / "f.npy", Declared(fps=10))]
        assert np.stack(frames).max() == (255 if kind == "?" else 1)


def test_every_pair_of_seldom_kinds_of_tiff(tmp_path):
    """Two fields at once: turned, and associated alpha; palettes, and turned."""
    for orientation, extra in itertools.product((3, 6), (1, 2)):
        data = np.concatenate([COLOUR // 2, np.full((H, W, 1), 128, np.uint8)], axis=-1)
        tagged(tmp_path / "a.tif", data, {338: extra, 274: orientation}, photometric="rgb",
               extrasamples=["assocalpha"], extratags=[(274, 3, 1, 1, True)])  # fmt: skip
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            image = picture(tmp_path / "a.tif")[0]
        light = np.rint(COLOUR // 2 * (1.0 if extra == 1 else 128 / 255))
        turned = light[::-1, ::-1] if orientation == 3 else light[::-1].swapaxes(0, 1)
        assert np.abs(image - turned).max() <= 1


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def test_what_a_png_states_comes_in_any_order(tmp_path):
    """Significant bits, a code of the curve, sRGB and gamma before the pixels, in each order; a code of the curve
    counts more than sRGB, and that more than gamma."""
    pixels = (np.arange(12).reshape(3, 4) * 300).astype(">u2")
    body = zlib.compress(b"".join(b"\0" + row.tobytes() for row in pixels))
    head, end = chunk(b"IHDR", struct.pack(">IIBBBBB", 4, 3, 16, 0, 0, 0, 0)), chunk(b"IEND", b"")
    stated = {
        b"sBIT": b"\x0c",
        b"cICP": bytes([9, 16, 0, 1]),
        b"sRGB": b"\0",
        b"gAMA": struct.pack(">I", 100000),
    }
    for kinds in (kinds for n in range(5) for kinds in itertools.permutations(stated, n)):
        chunks = b"".join(chunk(kind, stated[kind]) for kind in kinds)
        path = tmp_path / "a.png"
        path.write_bytes(b"\x89PNG\r\n\x1a\n" + head + chunks + chunk(b"IDAT", body) + end)
        one = open_stills(path)
        curve = "pq" if b"cICP" in kinds else None if b"sRGB" in kinds else "linear" if b"gAMA" in kinds else None
        assert (one.white, one.transfer) == (4095 if b"sBIT" in kinds else None, curve), kinds
        np.testing.assert_array_equal(one.read(), pixels)


def test_what_a_png_states_behind_a_large_chunk_is_read(tmp_path):
    """A profile of 5 kB and one of 100 kB before the other chunks; an animation behind one."""
    pixels = np.arange(12).reshape(3, 4).astype(">u2") * 100
    body = zlib.compress(b"".join(b"\0" + row.astype(">u2").tobytes() for row in pixels))
    head, end = chunk(b"IHDR", struct.pack(">IIBBBBB", 4, 3, 16, 0, 0, 0, 0)), chunk(b"IEND", b"")
    for size in (5_000, 100_000):
        stated = (
            chunk(b"zTXt", b"x\0\0" + bytes(size)) + chunk(b"sBIT", b"\x0c") + chunk(b"gAMA", struct.pack(">I", 100000))
        )
        (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + head + stated + chunk(b"IDAT", body) + end)
        one = open_stills(tmp_path / "a.png")
        assert (one.white, one.transfer) == (4095, "linear")
    frames = [Image.new("RGB", (4, 3), (k * 40,) * 3) for k in range(3)]
    frames[0].save(
        tmp_path / "b.png", save_all=True, append_images=frames[1:], duration=50, icc_profile=random_bytes(6000)
    )
    assert open_stills(tmp_path / "b.png").pages == 3


def random_bytes(count: int) -> bytes:
    return np.random.default_rng(0).integers(0, 256, count, np.uint8).tobytes()
