"""What becomes of an image's values on the way to a texture: exposure, bit depths, averages, against plain sums."""

from __future__ import annotations

import io

import cv2
import numpy as np
import pytest
from PIL import Image

from blinkgl.errors import AssetError
from blinkgl.scene.surfaces import images as I


def hdr(values: np.ndarray, comment: bytes = b"") -> bytes:
    data = cv2.imencode(".hdr", np.float32(values)[..., ::-1])[1].tobytes()
    return data.replace(b"\n", b"\n" + comment, 1) if comment else data


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
    stream = io.BytesIO()
    Image.fromarray(np.full((2, 3), value, dtype)).save(stream, "TIFF")
    with pytest.raises(AssetError, match="a: the image does not say how bright .*32-bit (floats|integers)"):
        I.decode_image(stream.getvalue(), None, "a")


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "BMP", "WEBP", "TIFF", "PPM", "GIF", "TGA"])
def test_every_format_that_is_named(kind):
    stream = io.BytesIO()
    picture = np.zeros((6, 9, 3), np.uint8)
    picture[:, 5:] = (250, 130, 10)
    Image.fromarray(picture).save(stream, kind)
    image = I.decode_image(stream.getvalue(), None, "a")
    assert image.shape == (6, 9, 3) and np.abs(image[:, [0, 8]].astype(int) - picture[:, [0, 8]]).max() < 20


@pytest.mark.parametrize("kind", ["EPS", "PDF", "ICNS"])
def test_others_are_refused(kind):
    stream = io.BytesIO()
    Image.fromarray(np.zeros((16, 16, 3), np.uint8)).save(stream, kind)
    with pytest.raises(AssetError, match="corrupt or of an unknown format; expected one of PNG, JPEG"):
        I.decode_image(stream.getvalue(), None, "a")


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
