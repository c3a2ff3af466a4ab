"""Fields that few files have, and that were read wrongly without a word: transparent codes, hidden pictures, slices,
palettes of 8 bits, chroma of every fourth column; third codes of polarity, offsets and sizes beside the columns."""

from __future__ import annotations

import struct
import zlib

import h5py
import numpy as np
import pytest
import tifffile

from blinkgl.errors import BlinkGLError
from blinkgl.io.formats import open_events
from blinkgl.io.frames import open_frames
from blinkgl.io.reading import Declared, EventReading
from blinkgl.io.stills import open_stills
from blinkgl.io.video import VideoReader
from tests.io.some_events import same, some_events
from tests.videos import put_video

H, W = 6, 10
GREY = (np.arange(H * W).reshape(H, W) * 4).astype(np.uint8)
DEEP = GREY.astype(np.uint16) * 257
E = some_events(60, 70_000, 90_000, 180, 240)


def one_line(call, *words) -> None:
    with pytest.raises(BlinkGLError) as caught:
        call()
    text = str(caught.value)
    assert "\n" not in text and all(word in text for word in words), text


# ---------------------------------------------------------------------------------------------------------------------
# Pictures.


def chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def rows_of(image: np.ndarray) -> bytes:
    big = image.astype(">u2" if image.dtype == np.uint16 else "u1")
    return zlib.compress(b"".join(b"\0" + row.tobytes() for row in big))


def png_of(image: np.ndarray, kind: int, *chunks: bytes, after: bytes = b"") -> bytes:
    bits = 8 * image.dtype.itemsize
    head = struct.pack(">IIBBBBB", image.shape[1], image.shape[0], bits, kind, 0, 0, 0)
    body = chunk(b"IHDR", head) + b"".join(chunks) + chunk(b"IDAT", rows_of(image)) + after
    return b"\x89PNG\r\n\x1a\n" + body + chunk(b"IEND", b"")


@pytest.mark.parametrize("background", [None, (255, 255, 255)])
@pytest.mark.parametrize("kind", ["grey8", "grey16", "colour8", "colour16"])
def test_the_transparent_code_of_png(tmp_path, kind, background):
    """Pixels of tRNS's code are transparent, all others opaque (PNG specification, 11.3.1.1)."""
    image = GREY if kind.endswith("8") else DEEP
    image = np.stack([image, image[::-1], image // 2], axis=-1) if kind.startswith("colour") else image
    code = np.atleast_1d(image[2, 3]).tolist()
    data = png_of(image, 2 if len(code) == 3 else 0, chunk(b"tRNS", struct.pack(f">{len(code)}H", *code)))
    (tmp_path / "a.png").write_bytes(data)
    one = open_stills(tmp_path / "a.png")
    found = one.read(background=background)
    hidden = (image.reshape(H, W, -1) == code).all(axis=-1)
    expected = image.copy()
    expected[hidden] = 0 if background is None else np.iinfo(image.dtype).max
    expected = expected if expected.ndim == found.ndim else expected[..., None]
    assert hidden.any() and np.array_equal(found, np.broadcast_to(expected, found.shape))
    assert "transparent" in one.notes[0]


@pytest.mark.parametrize("hidden", [False, True])
@pytest.mark.parametrize("image", [GREY, DEEP], ids=["8", "16"])
def test_pictures_of_animated_png(tmp_path, image, hidden):
    """A default image without an fcTL of its own is shown by programs that know no animations, and is no frame."""
    film = [np.roll(image, k, axis=1) for k in range(3)]
    control = lambda number: chunk(b"fcTL", struct.pack(">IIIIIHHBB", number, W, H, 0, 0, 1, 25, 0, 0))
    first = [chunk(b"acTL", struct.pack(">II", 3, 0))] + ([] if hidden else [control(0)])
    number, later = len(first) - 1, b""
    for frame in film if hidden else film[1:]:
        later += control(number) + chunk(b"fdAT", struct.pack(">I", number + 1) + rows_of(frame))
        number += 2
    (tmp_path / "a.png").write_bytes(png_of(image[::-1].copy() if hidden else film[0], 0, *first, after=later))
    found = list(open_frames(tmp_path / "a.png"))
    assert [t for _, t, _ in found] == [0, 40_000_000, 80_000_000]
    for (frame, _, _), expected in zip(found, film):
        assert np.array_equal(frame, expected if frame.ndim == 2 else np.repeat(expected[..., None], 3, axis=-1))


@pytest.mark.parametrize("axes", ["TYX", "ZYX", "TZYX", "TCYX", "ZCYX"])
@pytest.mark.parametrize("ome", [False, True])
def test_axes_of_stacks(tmp_path, axes, ome):
    """Pages are frames where one axis counts them; slices and channels at each time are not."""
    shape = [2] * (len(axes) - 2) + [H, W]
    path = tmp_path / ("a.ome.tif" if ome else "a.tif")
    tifffile.imwrite(path, np.zeros(shape, np.uint8), imagej=not ome, metadata={"axes": axes}, photometric="minisblack")
    if len(axes) == 3:
        assert len(list(open_frames(path, Declared(fps=10)))) == 2
    else:
        one_line(lambda: open_frames(path, Declared(fps=10)), "channels or slices", "pages that are frames")


@pytest.mark.parametrize("kind", ["u1", "u2", "i2", "f4"])
def test_white_is_zero_of_numbers_that_have_no_largest(tmp_path, kind):
    tifffile.imwrite(tmp_path / "a.tif", GREY.astype(kind), photometric="miniswhite", metadata=None)
    if kind.startswith("u"):
        assert np.array_equal(open_stills(tmp_path / "a.tif").read(), np.iinfo(kind).max - GREY.astype(kind))
    else:
        one_line(lambda: open_stills(tmp_path / "a.tif"), "white is zero", "SampleFormat")


@pytest.mark.parametrize("step", [1, 257])
def test_palettes_of_8_and_16_bits(tmp_path, step):
    """A palette whose largest number is below 256 has 8 bits, as libtiff reads it."""
    palette = np.random.default_rng(0).integers(0, 256, (3, 256))
    colormap = (palette * step).astype(np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", GREY, photometric="palette", colormap=colormap, metadata=None)
    assert np.array_equal(open_stills(tmp_path / "a.tif").read(), np.moveaxis(palette, 0, -1)[GREY])


@pytest.mark.parametrize("most", [255, 1023])
@pytest.mark.parametrize("change", ["whole", "cut", "two"])
def test_ends_of_binary_pnm(tmp_path, capfd, most, change):
    body = b"P5 #size\n10 6\n%d\n" % most + GREY.astype("u1" if most < 256 else ">u2").tobytes()
    data = {"whole": body, "cut": body[:-9], "two": body * 2}[change]
    for k in range(3):
        (tmp_path / f"{k}.pgm").write_bytes(data if k == 1 else body)
    if change == "cut":
        one_line(lambda: list(open_frames(tmp_path, Declared(fps=10))), "1.pgm", "or --damaged keep")
        assert len(list(open_frames(tmp_path, Declared(fps=10, damaged="keep")))) == 2
    else:
        source = open_frames(tmp_path, Declared(fps=10))
        assert all(np.array_equal(frame, GREY) for frame, _, _ in source)
        assert any("the pictures behind the first" in note for note in source.notes) == (change == "two")
    assert capfd.readouterr().err == ""


def test_a_cut_png_of_16_bits_is_damage(tmp_path):
    for k in range(3):
        data = png_of(DEEP, 0)
        (tmp_path / f"{k}.png").write_bytes(data[:-30] if k == 1 else data)
    one_line(lambda: list(open_frames(tmp_path, Declared(fps=10))), "1.png", "or --damaged keep")
    assert len(list(open_frames(tmp_path, Declared(fps=10, damaged="keep")))) == 2


@pytest.mark.parametrize("kind", ["yuv444p", "yuv422p", "yuv420p", "yuv440p", "yuv411p", "yuv410p"])
def test_widths_of_chroma(tmp_path, kind):
    """Two halves of one colour each, by the equations of BT.601: chroma of every first, second or fourth column."""
    across, down = {"yuv422p": (2, 1), "yuv420p": (2, 2), "yuv440p": (1, 2), "yuv411p": (4, 1), "yuv410p": (4, 4)}.get(
        kind, (1, 1)
    )
    columns = np.arange(32)
    halves = [np.where(columns < 16, a, b) for a, b in ((60, 180), (90, 150), (160, 100))]
    planes = [np.tile(halves[0], (16, 1)), *(np.tile(half[::across], (16 // down, 1)) for half in halves[1:])]
    flat = np.concatenate([plane.astype(np.uint8).ravel() for plane in planes])
    head = b"YUV4MPEG2 W32 H16 F25:1 Ip A1:1 C" + kind.removeprefix("yuv").removesuffix("p").encode() + b"\n"
    if kind in ("yuv440p", "yuv410p"):
        pytest.skip("Y4M has no name for it")
    (tmp_path / "v.y4m").write_bytes(head + (b"FRAME\n" + flat.tobytes()) * 3)
    frame, _ = next(iter(VideoReader(tmp_path / "v.y4m")))
    y, u, v = (half[[2, 29]].astype(float) for half in halves)
    light, cb, cr = (y - 16) / 219, (u - 128) / 224, (v - 128) / 224
    rgb = np.stack([light + 1.402 * cr, light - 0.344136 * cb - 0.714136 * cr, light + 1.772 * cb], axis=-1)
    assert np.abs(frame[8, [2, 29]] - 255 * np.clip(rgb, 0, 1)).max() <= 1.5


def test_side_data_that_pyav_has_no_name_for(tmp_path):
    film = [np.full((16, 16, 3), 30 * k, np.uint8) for k in range(3)]
    path = put_video(tmp_path / "v.mov", film, codec="tiff", pix_fmt="rgb24")
    assert all(np.array_equal(frame, film[k]) for k, (frame, _) in enumerate(VideoReader(path)))


# ---------------------------------------------------------------------------------------------------------------------
# Events.


@pytest.mark.parametrize("where", ["npz", "csv"])
@pytest.mark.parametrize("codes", [(0, 1), (-1, 1), (-1, 0), (-1, 0, 1), (0,), (1,), (-1,)])
def test_off_has_one_code(tmp_path, codes, where):
    """0 and 1, or -1 and 1: of three codes, or of -1 and 0, the file does not say which is which."""
    p = np.array(codes)[np.arange(len(E)) % len(codes)]
    path = tmp_path / f"e.{where}"
    if where == "npz":
        np.savez(path, t_us=E.t, x=E.x, y=E.y, p=p)
    else:
        rows = zip(E.t.tolist(), E.x.tolist(), E.y.tolist(), p.tolist())
        path.write_text("t_us,x,y,p\n" + "".join(f"{t},{x},{y},{q}\n" for t, x, y, q in rows))
    if {-1, 0} <= set(codes):
        proposed = "--polarity -1/0" if len(codes) == 2 else "--polarity, the numbers"
        one_line(lambda: open_events(path).read(), proposed)
    else:
        assert np.array_equal(open_events(path).read().p, p == 1)
    if codes == (-1, 0):
        assert np.array_equal(open_events(path, EventReading.of(polarity="-1/0")).read().p, p == 0)


@pytest.mark.parametrize("place", ["beside", "root", "attribute", "npz"])
def test_offsets_beside_the_columns(tmp_path, place):
    columns = {"t_us": E.t - 5000, "x": E.x, "y": E.y, "p": E.p}
    path = tmp_path / ("e.npz" if place == "npz" else "e.h5")
    if place == "npz":
        np.savez(path, **columns, t_offset=5000)
    else:
        with h5py.File(path, "w") as file:
            for name, values in columns.items():
                file[f"events/{name}"] = values
            if place == "attribute":
                file.attrs["t_offset"] = 5000
            else:
                file["events/t_offset" if place == "beside" else "t_offset"] = 5000
    file = open_events(path)
    assert same(file.read(), E) and file.notes == []


NAMES = (
    "resolution",
    "sensor_size",
    "img_size",
    "image_shape",
    "t0",
    "start_time",
    "time_scale",
    "H",
    "W",
    "img_width",
)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("place", ["npz", "data set", "attribute"])
def test_what_seems_to_be_stated_is_said(tmp_path, name, place):
    """A name that no reader knows, and that may be a size, an offset or a unit, is left out by name."""
    columns = {"t_us": E.t, "x": E.x, "y": E.y, "p": E.p}
    path = tmp_path / ("e.npz" if place == "npz" else "e.h5")
    if place == "npz":
        np.savez(path, **columns, **{name: [240, 180], "note": "hello"})
    else:
        with h5py.File(path, "w") as file:
            for k, values in columns.items():
                file[f"events/{k}"] = values
            if place == "attribute":
                file["events"].attrs[name] = [240, 180]
            else:
                file[f"events/{name}"] = [240, 180]
    file = open_events(path)
    if name == "resolution" and place != "npz":
        assert (file.width, file.height) == (240, 180)  # as M3ED's
    else:
        assert file.notes == [f"left out: {name}, whose meaning is not known (--size, --time-unit, --origin)"]
    assert same(file.read(), E)


def test_lines_that_end_with_carriage_returns(tmp_path):
    text = "t_us,x,y,p\n1,2,3,1\n2,3,4,0\n"
    (tmp_path / "e.csv").write_bytes(text.replace("\n", "\r").encode())
    one_line(lambda: open_events(tmp_path / "e.csv"), "carriage returns alone")
    (tmp_path / "e.csv").write_bytes(text.replace("\n", "\r\n").encode())
    assert open_events(tmp_path / "e.csv").read().x.tolist() == [2, 3]
