"""Procedural textures and image files."""

from __future__ import annotations

import io
import struct
import tracemalloc
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image

from blinkgl.config.scene import TEXTURE_KINDS
from blinkgl.errors import AssetError
from blinkgl.scene.surfaces import images as I
from blinkgl.scene.surfaces.textures import procedural_hash, procedural_texture
from blinkgl.srgb import linear_from_srgb
from tests.refusals import refusal
from tests.shared_data import shared


@pytest.mark.parametrize("kind", TEXTURE_KINDS)
def test_procedural(kind):
    for index in range(6):
        texture = procedural_texture(kind, index, 128)
        again = procedural_texture(kind, index, 128)
        assert texture.image.shape == (128, 128, 3) and texture.image.dtype == np.uint8
        assert texture.image.tobytes() == again.image.tobytes() and texture.source_hash == procedural_hash(kind, index)
        assert texture.image.min() >= 15 and texture.image.max() <= 245  # never black, never clipped
        assert (texture.image @ np.array([0.299, 0.587, 0.114])).std() > 5
    assert procedural_texture(kind, 0, 128).image.tobytes() != procedural_texture(kind, 1, 128).image.tobytes()


@pytest.mark.parametrize("kind", ["value", "perlin", "fbm", "gradient"])
def test_smooth_kinds_tile(kind):
    """Across the wrapped edge neighbours differ no more than inside."""
    for index in range(4):
        image = procedural_texture(kind, index, 128).image.astype(float)
        inside = max(np.abs(np.diff(image, axis=a)).max() for a in (0, 1))
        assert np.abs(image[0] - image[-1]).max() <= 1.5 * inside + 2
        assert np.abs(image[:, 0] - image[:, -1]).max() <= 1.5 * inside + 2


def test_pips_are_those_of_a_die():
    """As many as the face says, dark on light or light on dark; and no kind of the pools."""
    for index in range(8):
        image = procedural_texture("pips", index, 384).image.astype(float)
        assert image.min() >= 15 and image.max() <= 245
        luma = image @ [0.299, 0.587, 0.114]
        ink = np.abs(luma - np.median(luma)) > 0.6 * np.abs(luma - np.median(luma)).max()
        counts = []
        for face in range(6):
            r, c = divmod(face, 3)
            part = ink[192 * r : 192 * (r + 1), 128 * c : 128 * (c + 1)].astype(np.uint8)
            _, _, stats, _ = cv2.connectedComponentsWithStats(part)
            counts.append(int((stats[1:, cv2.CC_STAT_AREA] > 100).sum()))
        assert counts == [1, 2, 3, 4, 5, 6]
    assert "pips" not in TEXTURE_KINDS


def write_image(path, mode="RGB", size=(8, 6), **options):
    Image.fromarray((np.arange(size[0] * size[1] * 3) % 255).astype(np.uint8).reshape(size[1], size[0], 3)).convert(
        mode
    ).save(path, **options)
    return path


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L", "P", "1"])
def test_modes(tmp_path, mode):
    image = I.load_image(write_image(tmp_path / "a.png", mode))
    assert image.shape == (6, 8, 3) and image.dtype == np.uint8


def test_exif_orientation_is_applied(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6  # to be turned a quarter
    write_image(tmp_path / "a.jpg", exif=exif)
    assert I.load_image(tmp_path / "a.jpg").shape == (8, 6, 3)


def test_hdr_is_linear_and_bounded():
    image = I.load_image(shared("data/assets/hdri/park.hdr"))
    assert (
        image.dtype == np.float32 and image.shape == (512, 1024, 3) and image.min() >= 0 and image.max() <= I.HDR_WHITE
    )
    assert np.percentile(image.max(axis=2), 90) == pytest.approx(0.8, rel=1e-3)


def test_cube_faces_look_where_they_should():
    """A panorama that stores the viewing direction comes back as the directions of the six sides."""
    h, w = 256, 512
    longitude = ((np.arange(w) + 0.5) / w - 0.5) * 2 * np.pi
    latitude = (0.5 - (np.arange(h) + 0.5) / h) * np.pi
    direction = np.stack(
        [
            np.cos(latitude)[:, None] * np.cos(longitude),
            -np.cos(latitude)[:, None] * np.sin(longitude),
            np.repeat(np.sin(latitude)[:, None], w, axis=1),
        ],
        axis=2,
    ).astype(np.float32)
    s = (np.arange(32) + 0.5) / 32 * 2 - 1
    right, down = np.meshgrid(s, s)
    for face, (forward, to_right, to_down) in zip(I.cube_faces(direction, 32), I.SKY_SIDES):
        ray = forward + right[..., None] * to_right + down[..., None] * to_down
        ray /= np.linalg.norm(ray, axis=2, keepdims=True)
        assert np.abs(face - ray).max() < 0.02
        assert np.cross(to_right, to_down) == pytest.approx(forward)  # not mirrored for the viewer inside


def encoded(image: np.ndarray, form: str, **options) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, form, **options)
    return stream.getvalue()


NOISE = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)


@pytest.mark.parametrize(
    "data, problem",
    [
        (b"", "corrupt or of an unknown format"),
        (b"not an image at all", "corrupt or of an unknown format"),
        (encoded(NOISE, "PNG")[:2000], "corrupt or of an unknown format"),
        (encoded(NOISE, "JPEG")[:1500], "corrupt or of an unknown format"),
        (encoded(NOISE, "PNG").replace(b"IDAT", b"JDAT"), "corrupt or of an unknown format"),
        (b"#?RADIANCE\n\n-Y 90000 +X 90000\n", "too large (got '90000x90000')"),
        (b"#?RADIANCE\n\n-Y 16 +X 16\nshort", "corrupt"),
        (b"#?RADIANCE\nno size", "corrupt (no size"),
    ],
)
def test_bad_images_are_named(tmp_path, data, problem, capfd):
    path = tmp_path / "picture.jpg"
    path.write_bytes(data)
    message = refusal(AssetError, I.load_image, path)
    assert message.startswith(str(path)) and problem in message


def chunk(kind: bytes, body: bytes) -> bytes:
    return len(body).to_bytes(4, "big") + kind + body + zlib.crc32(kind + body).to_bytes(4, "big")


def png_of(width: int, height: int, rows: int, colour: int = 2, bits: int = 8, value: int = 0) -> bytes:
    """A PNG whose header states ``height`` rows and which has ``rows``, in chunks of 100 bytes."""
    channels = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[colour]
    packed = zlib.compress((b"\0" + bytes([value]) * -(-width * channels * bits // 8)) * rows)
    head = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([bits, colour, 0, 0, 0])
    palette = chunk(b"PLTE", bytes(6)) if colour == 3 else b""
    parts = b"".join(chunk(b"IDAT", packed[k : k + 100]) for k in range(0, len(packed), 100))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + palette + parts + chunk(b"IEND", b"")


@pytest.mark.parametrize("colour, bits", [(0, 1), (0, 8), (0, 16), (2, 8), (2, 16), (3, 1), (3, 4), (4, 8), (6, 8)])
@pytest.mark.parametrize("value", [0, 255])
def test_a_png_has_the_rows_that_it_states(tmp_path, colour, bits, value):
    for rows in (37, 36, 1):
        (tmp_path / "a.png").write_bytes(png_of(53, 37, rows, colour, bits, value if colour != 3 else 0))
        if rows == 37:
            assert I.load_image(tmp_path / "a.png").shape == (37, 53, 3)
        else:
            with pytest.raises(AssetError, match=r"truncated or has another size \(got '53x37'\)"):
                I.load_image(tmp_path / "a.png")


def test_8k_textures_of_another_size_than_they_state(tmp_path):
    """One line each, whatever the format; a picture of one colour is packed as tightly as its format can."""
    black = encoded(np.zeros((8192, 8192, 3), np.uint8), "JPEG", optimize=True, quality=5)
    assert I.decode_image(black, 64, "a").shape == (64, 64, 3)
    spoiled = {"a.png": png_of(8192, 8192, 16)}
    for ending, kind, at, number in (
        ("jpg", "JPEG", lambda data: data.index(b"\xff\xc0") + 5, ">HH"),
        ("bmp", "BMP", lambda data: 18, "<ii"),
        ("webp", "WEBP", lambda data: data.index(b"\x9d\x01\x2a") + 3, "<HH"),
    ):
        data = bytearray(encoded(np.full((64, 64, 3), (10, 20, 30), np.uint8), kind))
        struct.pack_into(number, data, at(data), 8192, 8192)
        spoiled[f"a.{ending}"] = bytes(data)
    for name, data in spoiled.items():
        line = refusal(AssetError, I.decode_image, data, 2048, name)
        assert line.startswith(f"{name}: the image is ") and "truncated" in line + "truncated" * (name == "a.webp")


def test_a_huge_claim_is_refused_before_decoding(tmp_path):
    data = bytearray(encoded(NOISE, "PNG"))
    data[16:24] = (200_000).to_bytes(4, "big") * 2  # IHDR width and height
    data[29:33] = zlib.crc32(bytes(data[12:29])).to_bytes(4, "big")
    (tmp_path / "a.png").write_bytes(bytes(data))
    refusal(AssetError, I.load_image, tmp_path / "a.png", match="too large|corrupt")


def test_shrinking_in_blocks_is_shrinking_at_once(monkeypatch):
    image = np.random.default_rng(0).integers(0, 256, (301, 217, 3), dtype=np.uint8)
    for max_size in (300, 128, 7):
        whole = I.shrink(image, max_size)
        monkeypatch.setattr(I, "_BLOCK_PIXELS", 2000)
        assert len(I._blocks(301, 217)) > 10
        # The float32 sums differ in their last bit.
        assert np.abs(I.shrink(image, max_size).astype(int) - whole).max() <= 1
        monkeypatch.undo()
        linear = linear_from_srgb(image / 255.0).astype(np.float32)
        reference = cv2.resize(linear, whole.shape[1::-1], interpolation=cv2.INTER_AREA)
        assert np.abs(linear_from_srgb(whole / 255.0) - reference).max() < 6e-3  # half a code, at its widest


def test_no_other_program_is_run_for_a_texture():
    """Pillow hands EPS to Ghostscript: it is none of a texture's formats, whatever its name."""
    with pytest.raises(AssetError, match="corrupt or of an unknown format; expected one of PNG, JPEG"):
        I.decode_image(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n%%EndComments\n", 64, "a.png")


def test_missing_image(tmp_path):
    refusal(AssetError, I.load_image, tmp_path / "none.png", match="cannot read the image: No such file")


def test_photographs_are_bundled_ones():
    found = I.photographs()
    if not found:
        pytest.skip("scikit-image is not installed")
    assert "astronaut" in found and all(p.is_file() for p in found.values())


# --- What becomes of an image's values on the way to a texture: exposure, bit depths, averages, against plain sums.


def hdr(values: np.ndarray) -> bytes:
    return cv2.imencode(".hdr", np.float32(values)[..., ::-1])[1].tobytes()


def test_panoramas_are_exposed_by_their_ninetieth_percentile():
    """Every channel alike; what is brighter than white by a half is cut; darkness stays dark."""
    values = np.zeros((10, 10, 3))
    values[..., 1] = 4.0
    values[0, :5] = (64, 2, 16)
    image = I.decode_image(hdr(values), None, "a.hdr")
    assert image.dtype == np.float32 and image[5, 5] == pytest.approx([0, 0.8, 0], rel=0.01)
    assert image[0, 0] == pytest.approx([1.5, 0.4, 1.5], rel=0.01) and I.HDR_WHITE == 1.5
    assert not I.decode_image(hdr(np.zeros((8, 8, 3))), None, "a.hdr").any()


@pytest.mark.parametrize("kind", [".png", ".pgm", ".tiff"])
def test_sixteen_bits_of_grey(kind):
    grey = np.array([[65535, 33000, 0], [255, 256, 2570]], np.uint16)
    image = I.decode_image(cv2.imencode(kind, grey)[1].tobytes(), None, "a")
    assert image.shape == (2, 3, 3) and (image[..., 1] == [[255, 128, 0], [0, 0, 10]]).all()
    dark = I.decode_image(cv2.imencode(kind, grey // 300)[1].tobytes(), None, "a")  # no number above 255
    assert dark.max() == 0


@pytest.mark.parametrize("dtype, value", [(np.float32, 0.5), (np.int32, 70_000), (np.int32, -1)])
def test_grey_without_a_white_is_refused(dtype, value):
    data = encoded(np.full((2, 3), value, dtype), "TIFF")
    with pytest.raises(AssetError, match="a: the image has an unknown scale of brightness .*32-bit (floats|integers)"):
        I.decode_image(data, None, "a")


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "BMP", "WEBP", "TIFF", "PPM", "GIF", "TGA"])
def test_every_format_that_is_named(kind):
    picture = np.zeros((6, 9, 3), np.uint8)
    picture[:, 5:] = (250, 130, 10)
    image = I.decode_image(encoded(picture, kind), None, "a")
    assert image.shape == (6, 9, 3) and np.abs(image[:, [0, 8]].astype(int) - picture[:, [0, 8]]).max() < 20


@pytest.mark.parametrize("kind", ["EPS", "PDF", "ICNS"])
def test_others_are_refused(kind):
    data = encoded(np.zeros((16, 16, 3), np.uint8), kind)
    with pytest.raises(AssetError, match="corrupt or of an unknown format; expected one of PNG, JPEG"):
        I.decode_image(data, None, "a")


@pytest.mark.parametrize(
    "size, most", [((7, 5), 3), ((5, 7), 3), ((64, 3), 10), ((9, 9), 8), ((300, 2), 1), ((4, 4), 4), ((4, 4), None)]
)
@pytest.mark.parametrize("dtype", [np.float32, np.uint8])
def test_shrinking_is_the_mean_of_the_area(size, most, dtype):
    """Against an enlargement by whole numbers, averaged in whole blocks."""
    rng = np.random.default_rng(1)
    image = (
        rng.random((*size, 3), dtype=np.float32) if dtype == np.float32 else rng.integers(0, 256, (*size, 3), np.uint8)
    )
    small = I.shrink(image, most)
    if most is None or max(size) <= most:
        assert small is image
        return
    new = tuple(max(1, round(n * (most / max(size)))) for n in size)
    light = image if dtype == np.float32 else I.DECODE_8BIT[image]
    fine = np.repeat(np.repeat(light.astype(np.float64), new[0], axis=0), new[1], axis=1)
    mean = fine.reshape(new[0], size[0], new[1], size[1], 3).mean(axis=(1, 3))
    assert small.shape == (*new, 3) and small.dtype == dtype
    if dtype == np.float32:
        np.testing.assert_allclose(small, mean, atol=2e-6)
    else:
        assert np.abs(small.astype(int) - I.to_srgb8(mean.astype(np.float32)).astype(int)).max() <= 1


def test_contents_and_not_their_pieces_are_hashed():
    assert I.content_hash(b"ab", b"c") == I.content_hash(b"abc") != I.content_hash(b"abd")
    assert len(I.content_hash(b"")) == 32


def test_a_png_that_unpacks_to_more_than_it_states_takes_no_memory():
    """Its last row is black, so that its length is asked for; 64 MB of zeros stand in 64 kB."""
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", 8, 8, 8, 2, 0, 0, 0))
    data = b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(bytes(1 << 26))) + chunk(b"IEND", b"")
    tracemalloc.start()
    try:
        I.decode_image(data, None, "bomb.png")
    except AssetError:  # libpng may refuse what is too much, too
        pass
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 24
