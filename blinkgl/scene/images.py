"""Image files as :class:`~blinkgl.scene.types.Texture` images: limits checked before decoding, corrupt files refused."""

from __future__ import annotations

import hashlib
import io
import re
import warnings
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageOps

from blinkgl.errors import AssetError
from blinkgl.srgb import DECODE_8BIT, to_srgb8

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff", ".ppm", ".pgm", ".hdr")
MAX_PIXELS = 120_000_000
HDR_WHITE = 1.5     # brightest radiance kept of an HDR image: light sources would drown everything else
# Not those that are mostly black (retina, hubble_deep_field): no light, no events.
_PHOTOGRAPHS = ("astronaut.png", "brick.png", "camera.png", "chelsea.png", "coffee.png", "coins.png", "grass.png", "gravel.png",
                "ihc.png", "moon.png", "motorcycle_left.png", "rocket.jpg")


def content_hash(*chunks: bytes) -> str:
    """32 hex digits of the content."""
    digest = hashlib.blake2b(digest_size=16)
    for chunk in chunks:
        digest.update(chunk)
    return digest.hexdigest()


def photographs() -> dict[str, Path]:
    """name -> file of the photographs inside the installed scikit-image; empty without it. Nothing is downloaded."""
    spec = find_spec("skimage")
    if spec is None or not spec.submodule_search_locations:
        return {}
    folder = Path(spec.submodule_search_locations[0]) / "data"
    return {Path(name).stem: folder / name for name in _PHOTOGRAPHS if (folder / name).is_file()}


def load_image(path: Path, max_size: int | None = None, where: str | None = None) -> np.ndarray:
    """(h, w, 3) uint8 sRGB, or float32 linear light for Radiance ``.hdr``; the longer side at most ``max_size`` px.

    HDR images are exposed so that their 90th percentile is 0.8 and clipped at :data:`HDR_WHITE`.
    Raises :class:`AssetError` naming the file when it is missing, corrupt, truncated or beyond :data:`MAX_PIXELS`.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise AssetError(f"cannot read the image: {error.strerror or error}", where=where or str(path)) from None
    return decode_image(data, max_size, where or str(path))


def decode_image(data: bytes, max_size: int | None, where: str) -> np.ndarray:
    """:func:`load_image` from bytes already read."""
    image = _decode_hdr(data, where) if data[:2] == b"#?" else _decode_ldr(data, where)
    return shrink(image, max_size)


def _decode_ldr(data: bytes, where: str) -> np.ndarray:
    # Pillow, because it says so when a file is truncated; OpenCV returns a half grey picture.
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(data)) as opened:
                width, height = opened.size
                _check_size(width, height, where)
                opened.load()
                image = ImageOps.exif_transpose(opened)
                if image.mode.startswith("I") or image.mode == "F":     # 16-bit grey
                    grey = np.asarray(image, np.float64)
                    image = Image.fromarray((grey / (65535 if grey.max() > 255 else 255) * 255).clip(0, 255).astype(np.uint8))
                return np.ascontiguousarray(np.asarray(image.convert("RGB")))
    except AssetError:
        raise
    except Exception as error:     # Pillow's decoders raise anything: OSError, SyntaxError, ValueError, struct.error, …
        detail = f"{type(error).__name__}: {' '.join(str(error).split())[:80]}"
        raise AssetError(f"the image is corrupt or of an unknown format ({detail})", where=where) from None


def _decode_hdr(data: bytes, where: str) -> np.ndarray:
    size = re.search(rb"\n[-+][XY] (\d{1,9}) [-+][XY] (\d{1,9})\n", data[:8192])
    if size is None:
        raise AssetError("the image is corrupt (no size in the Radiance header)", where=where)
    _check_size(int(size[2]), int(size[1]), where)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None or image.ndim != 3 or not np.isfinite(image).all():
        raise AssetError("the image is corrupt or of an unknown format", where=where)
    image = image[..., 2::-1].astype(np.float32)
    level = float(np.percentile(image.max(axis=2), 90))
    return np.clip(image * (0.8 / level if level > 0 else 1.0), 0, HDR_WHITE)


def _check_size(width: int, height: int, where: str) -> None:
    if width * height > MAX_PIXELS:
        raise AssetError("the image is too large", where=where, value=f"{width}x{height}", accepted=f"at most {MAX_PIXELS // 10**6} Mpx")


def shrink(image: np.ndarray, max_size: int | None) -> np.ndarray:
    """Area average in linear light down to a longer side of ``max_size`` px; smaller images are returned as they are."""
    height, width = image.shape[:2]
    if max_size is None or max(height, width) <= max_size:
        return image
    factor = max_size / max(height, width)
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    if image.dtype == np.float32:
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return to_srgb8(cv2.resize(DECODE_8BIT[image], size, interpolation=cv2.INTER_AREA))


def cube_faces(panorama: np.ndarray, size: int, margin: float = 0.0) -> list[np.ndarray]:
    """The six sides of a box seen from its centre, from an equirectangular image: +x, -x, +y, -y, +z, -z, each (size,
    size, 3) of the panorama's dtype, upright, not mirrored (right is right for the viewer inside). ``margin``: the image
    reaches this fraction of a half edge over the box's edges, so that filtering near them finds what is really there.

    The panorama's middle column is seen in direction +x, and longitude grows to the right, i.e. clockwise from above.
    """
    height, width = panorama.shape[:2]
    s = ((np.arange(size) + 0.5) / size * 2 - 1) * (1 + margin)
    right, down = np.meshgrid(s, s)
    padded = np.concatenate([panorama[:, -2:], panorama, panorama[:, :2]], axis=1)    # the seam is interpolated across
    faces = []
    for forward, to_right, to_down in SKY_SIDES:
        ray = np.asarray(forward, float) + right[..., None] * to_right + down[..., None] * to_down
        longitude = -np.arctan2(ray[..., 1], ray[..., 0])
        latitude = np.arctan2(ray[..., 2], np.hypot(ray[..., 0], ray[..., 1]))
        x = (longitude / (2 * np.pi) + 0.5) * width - 0.5 + 2
        y = (0.5 - latitude / np.pi) * height - 0.5
        faces.append(cv2.remap(padded, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
    return faces


# (forward, right, down) of the six sides for a viewer inside.
SKY_SIDES = tuple(tuple(np.array(v, float) for v in side) for side in (
    ((1, 0, 0), (0, -1, 0), (0, 0, -1)), ((-1, 0, 0), (0, 1, 0), (0, 0, -1)), ((0, 1, 0), (1, 0, 0), (0, 0, -1)),
    ((0, -1, 0), (-1, 0, 0), (0, 0, -1)), ((0, 0, 1), (0, -1, 0), (1, 0, 0)), ((0, 0, -1), (0, -1, 0), (-1, 0, 0))))
