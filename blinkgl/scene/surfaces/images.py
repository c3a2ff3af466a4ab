"""Image files as :class:`~blinkgl.scene.types.Texture` images: limits checked before decoding, corrupt files refused.

Pillow's limit against decompression bombs is a module-wide number far below what ``max_size`` allows, and changing it
would affect the whole process. So files are opened by Pillow's readers directly, and the limit is
:data:`MAX_PIXELS`.
"""

from __future__ import annotations

import hashlib
import io
import math
import re
import struct
import zlib
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image, ImageOps

from blinkgl.errors import AssetError
from blinkgl.io.images import png_chunks
from blinkgl.scene.reading import contents, reading
from blinkgl.srgb import DECODE_8BIT, LUMA, to_srgb8

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff", ".ppm", ".pgm", ".hdr", ".exr")
# The first bytes of an OpenEXR file, and of these and Radiance files.
_EXR = b"v/1\x01"
_HDR = (b"#?", _EXR)
MAX_SIDE = 16_384  # the configuration's limit of max_size, and OpenGL implementations'
MAX_PIXELS = MAX_SIDE**2
MAX_HDR_PIXELS = MAX_PIXELS // 2  # 12 bytes each: a panorama of 16384x8192
_MAX_LINE = 1 << 20
# Pillow reads many more; some run other programs (EPS), and none is a texture format.
_FORMATS = ("PNG", "JPEG", "BMP", "WEBP", "TIFF", "PPM", "GIF", "DDS", "TGA")
UNKNOWN_FORMAT = "the image is corrupt or of an unknown format"
_BLOCK_PIXELS = 1 << 22  # pixels converted or averaged at a time: limits the extra memory of a large image
HDR_WHITE = 1.5  # largest radiance kept of an HDR image: light sources would outweigh everything else
# Without those that are mostly black (retina, hubble_deep_field): no light, no events.
_PHOTOGRAPHS = (
    "astronaut.png",
    "brick.png",
    "camera.png",
    "chelsea.png",
    "coffee.png",
    "coins.png",
    "grass.png",
    "gravel.png",
    "ihc.png",
    "moon.png",
    "motorcycle_left.png",
    "rocket.jpg",
)


def content_hash(*chunks: bytes | memoryview) -> str:
    """Return 32 hex digits of the content's hash."""
    digest = hashlib.blake2b(digest_size=16)
    for chunk in chunks:
        digest.update(chunk)
    return digest.hexdigest()


def photographs() -> dict[str, Path]:
    """Return name -> file of the photographs inside the installed scikit-image; empty without it. Nothing is
    downloaded."""
    spec = find_spec("skimage")
    if spec is None or not spec.submodule_search_locations:
        return {}
    folder = Path(spec.submodule_search_locations[0]) / "data"
    return {Path(name).stem: folder / name for name in _PHOTOGRAPHS if (folder / name).is_file()}


def load_image(path: Path) -> np.ndarray:
    """Return (h, w, 3) uint8 sRGB, or float32 linear light for Radiance ``.hdr`` and OpenEXR.

    HDR images are exposed so that their 90th percentile is 0.8 and clipped at :data:`HDR_WHITE`. While it is reduced,
    an image takes at most 7 bytes per pixel of the file (HDR: 25), and some 100 MB more.
    Raises :class:`AssetError` naming the file when it is missing, corrupt, truncated or beyond :data:`MAX_PIXELS`.
    """
    return decode_image(contents(Path(path), "image"), None, str(path))


def decode_image(data: bytes, max_size: int | None, where: str, gamma: bool = True) -> np.ndarray:
    """Return :func:`load_image` of bytes already read. gamma : whether the file's own gamma counts (PNG's gAMA); glTF
    says that it does not."""
    with reading("image", where):
        image = _decode_hdr(data, where) if data.startswith(_HDR) else _decode_ldr(data, where, gamma)
        return shrink(image, max_size)


def decode_numbers(data: bytes, max_size: int | None, where: str) -> np.ndarray:
    """Return (h, w, 3) uint8 of an image that stores three numbers per pixel, 255 for 1 (normals, roughness): as
    stored, reduced by their mean. Raises AssetError as :func:`load_image`, and for high dynamic range."""
    with reading("image", where):
        if data.startswith(_HDR):
            raise AssetError(
                "a map of numbers is a high-dynamic-range image", where=where, accepted="8 or 16 bits a channel"
            )
        return _smaller(_decode_ldr(data, where), max_size)


def decode_alpha(data: bytes, max_size: int | None, where: str) -> np.ndarray | None:
    """Return the opacity of an image's pixels, (h, w) uint8; None where all are opaque. Raises AssetError."""
    with reading("image", where):
        if data.startswith(_HDR):
            return None
        with _open(data, where) as image:
            _check_size(*image.size, where)
            if not image.has_transparency_data:
                return None
            image.load()
            ImageOps.exif_transpose(image, in_place=True)
            alpha = np.array(image.convert("RGBA").getchannel("A"))
        return None if alpha.min() == 255 else _smaller(alpha, max_size)


def _smaller(numbers: np.ndarray, max_size: int | None) -> np.ndarray:
    width, height = _reduced(numbers, max_size)
    same = (height, width) == numbers.shape[:2]
    return numbers if same else cv2.resize(numbers, (width, height), interpolation=cv2.INTER_AREA)


def _reduced(image: np.ndarray, max_size: int | None) -> tuple[int, int]:
    """Return width and height of an image whose longer side is reduced to ``max_size`` px."""
    height, width = image.shape[:2]
    factor = 1.0 if max_size is None else min(max_size / max(height, width), 1.0)
    return max(1, round(width * factor)), max(1, round(height * factor))


def _open(data: bytes, where: str) -> Image.Image:
    """Open an image as ``Image.open`` for the formats of textures, without its limit, which the caller replaces."""
    Image.init()
    stream = io.BytesIO(data)
    for name in _FORMATS:
        factory, accepts = Image.OPEN.get(name, (None, None))
        if factory is None or (accepts and accepts(data[:16]) is not True):
            continue
        stream.seek(0)
        try:
            return factory(stream, "")
        except Image.DecompressionBombError:  # some readers check the limit themselves
            raise AssetError(
                f"the image is too large for a {name} file", where=where, accepted="a PNG, or fewer pixels"
            ) from None
        except (SyntaxError, IndexError, TypeError, struct.error):  # another format after all: handled as in Image.open
            continue
    raise AssetError(
        UNKNOWN_FORMAT,
        where=where,
        accepted="one of " + ", ".join(_FORMATS) + ", Radiance HDR, OpenEXR",
    )


def _decode_ldr(data: bytes, where: str, gamma: bool = False) -> np.ndarray:
    # Pillow, because it reports a truncated file; OpenCV returns a half grey image.
    with _open(data, where) as image:
        _check_size(*image.size, where)
        image.load()
        if _is_short(data, image):
            accepted = "a file with all the pixels that its header states"
            value = "{}x{}".format(*image.size)
            raise AssetError("the image is truncated or has another size", where=where, value=value, accepted=accepted)
        ImageOps.exif_transpose(image, in_place=True)
        if image.mode.startswith("I") or image.mode == "F":
            return _codes(image.info if gamma else {})[_sixteen_bits(np.asarray(image), where)]
        width, height = image.size
        pixels = np.empty((height, width, 3), np.uint8)
        for rows in _blocks(height, width):
            block = image.crop((0, rows.start, width, rows.stop))
            pixels[rows] = np.asarray(block if block.mode == "RGB" else block.convert("RGB"))
        return _codes(image.info)[pixels] if gamma and "gamma" in image.info else pixels


def _is_short(data: bytes, image: Image.Image) -> bool:
    """Return whether a PNG or JPEG file ends before its last pixel; Pillow leaves the rest black or grey in silence."""
    width, height = image.size
    if image.format == "JPEG":
        # Each block of 8x8 px has a bit at least: the shortest code of Huffman's (ITU-T T.81, F.1.2).
        return width * height > 64 * 8 * len(data)
    bottom = image.crop((0, height - 1, width, height)) if image.format == "PNG" else None
    if bottom is None or np.asarray(bottom).any():
        return False
    # Bits of a sample; samples of a pixel by IHDR's type of colour: grey, RGB, palette, grey and RGB with alpha.
    bits = data[24] * {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[data[25]]
    # A byte before each row names its filter; interlaced files have more rows.
    unpacker, left = zlib.decompressobj(), height * (1 + math.ceil(width * bits / 8))
    for _, kind, body in png_chunks(data):
        # No more than is missing: what else a stranger's data would unpack to is never made.
        left -= len(unpacker.decompress(body, left)) if kind == b"IDAT" and left else 0
    return left > 0


def _codes(info: Mapping[Any, Any]) -> np.ndarray:
    """Return the sRGB code of each of 256 codes of a picture with Pillow's ``info``: of PNG's gAMA, unless the file has
    a profile, or a gamma next to sRGB's 1 / 2.2."""
    codes, power = np.arange(256, dtype=np.uint8), float(info.get("gamma") or 1 / 2.2)
    if info.keys() & {"srgb", "icc_profile"} or abs(power - 1 / 2.2) < 0.02:
        return codes
    return to_srgb8(((codes / 255.0) ** (1 / power)).astype(np.float32))


def _sixteen_bits(grey: np.ndarray, where: str) -> np.ndarray:
    """Return (h, w, 3) uint8 of 16-bit grey, white 65535 however dark the image is. Raises AssetError: numbers without
    a white."""
    if grey.dtype.kind == "f" or grey.min() < 0 or grey.max() > 65535:
        raise AssetError(
            "the image has an unknown scale of brightness",
            where=where,
            value=f"{8 * grey.itemsize}-bit {'floats' if grey.dtype.kind == 'f' else 'integers'}",
            accepted="8 or 16 bits a channel, or Radiance HDR",
        )
    return np.repeat((grey * (255 / 65535)).astype(np.uint8)[..., None], 3, axis=2)


def _blocks(height: int, width: int) -> list[slice]:
    rows = max(1, _BLOCK_PIXELS // width)
    return [slice(top, min(top + rows, height)) for top in range(0, height, rows)]


def load_panorama(path: Path, where: str | None = None) -> tuple[np.ndarray, float]:
    """Return an equirectangular image as light: (h, w, 3) float32 linear radiance as in the file, and the factor by
    which :func:`panorama_picture` exposes it (1 for 8-bit images).

    Raises :class:`AssetError` for what :func:`load_image` refuses, and where it is not a panorama: not twice as wide as
    high, with pixels that are not radiance (NaN, infinite, negative), or black."""
    where = where or str(path)
    data = contents(Path(path), "image", where)
    with reading("image", where):
        if data.startswith(_HDR):
            image = _radiance(data, where)
            factor = exposure(image)
        else:
            image, factor = DECODE_8BIT[shrink(_decode_ldr(data, where, gamma=True), 4096)], 1.0
    height, width = image.shape[:2]
    if not 1.9 < width / height < 2.1:
        raise AssetError(
            "not a panorama", where=where, value=f"{width}x{height}", accepted="twice as wide as it is high"
        )
    if image.min() < 0:
        raise AssetError(
            "a pixel is not a radiance", where=where, value=float(image.min()), accepted="numbers from 0 on"
        )
    if not image.max() > 0:
        raise AssetError("the panorama is black", where=where)
    return image, factor


def panorama_picture(path: Path) -> np.ndarray:
    """Return an equirectangular image as it is drawn: as :func:`load_image`, but an HDR image exposed as its light is
    (:func:`exposure`), so that both are one. Raises :class:`AssetError`."""
    data = contents(Path(path), "image", str(path))
    if not data.startswith(_HDR):
        return load_image(path)
    with reading("image", str(path)):
        image = _radiance(data, str(path))
        image *= np.float32(exposure(image))
        return np.clip(image, 0, HDR_WHITE, out=image)


def exposure(image: np.ndarray) -> float:
    """Return the factor that brings the luminance of a panorama below which 90 % of its solid angle lie to 0.8; where
    that is black, its mean."""
    luminance, height = image @ LUMA, len(image)
    # Rows of equal solid angle: their heights above the horizon are equally far apart in the sine.
    rows = np.floor(np.arccos(1 - (2 * np.arange(height) + 1) / height) / np.pi * height).astype(int)
    level = float(np.percentile(luminance[rows], 90))
    return 0.8 / (level if level > 0 else max(float(luminance.mean()), 1e-30))


def _radiance(data: bytes, where: str) -> np.ndarray:
    """Return (h, w, 3) float32 of a Radiance or OpenEXR file."""
    if data.startswith(_EXR):
        from blinkgl.io.video import decode_exr

        # The attribute's name, its type, its length of 16 bytes, and four 32-bit numbers.
        window = re.search(rb"dataWindow\0box2i\0\x10\0\0\0(.{16})", data[:8192], re.DOTALL)
        if window is None:
            raise AssetError("the image is corrupt (no size in the OpenEXR header)", where=where)
        x0, y0, x1, y1 = struct.unpack("<4i", window[1])
        if x1 < x0 or y1 < y0:
            raise AssetError("the image is corrupt (an empty OpenEXR window)", where=where)
        _check_size(x1 - x0 + 1, y1 - y0 + 1, where, MAX_HDR_PIXELS)
        image = decode_exr(data, where)
        image = np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image
        if not np.isfinite(image).all():
            y, x = np.argwhere(~np.isfinite(image).all(axis=2))[0].tolist()
            raise AssetError(
                "a pixel is not a radiance",
                where=f"{where}, x={x}, y={y}",
                value=image[y, x].tolist(),
                accepted="finite numbers",
            )
        return np.ascontiguousarray(image, np.float32)
    # The line of the resolution, such as "-Y 512 +X 1024": rows first.
    size = re.search(rb"\n[-+][XY] (\d{1,9}) [-+][XY] (\d{1,9})\n", data[:8192])
    if size is None:
        raise AssetError("the image is corrupt (no size in the Radiance header)", where=where)
    _check_size(int(size[2]), int(size[1]), where, MAX_HDR_PIXELS)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 3 or not np.isfinite(image).all():
        raise AssetError(UNKNOWN_FORMAT, where=where)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image)


def _decode_hdr(data: bytes, where: str) -> np.ndarray:
    image = _radiance(data, where)
    level = float(np.percentile(image.max(axis=2), 90, overwrite_input=True))
    image *= np.float32(0.8 / level if level > 0 else 1.0)
    return np.clip(image, 0, HDR_WHITE, out=image)


def _check_size(width: int, height: int, where: str, pixels: int = MAX_PIXELS) -> None:
    if width * height > pixels or max(width, height) > _MAX_LINE:
        raise AssetError("the image is too large", where=where, value=f"{width}x{height}", accepted=_most(pixels))


def _most(pixels: int) -> str:
    return f"at most {pixels / 1e6:.0f} Mpx, as {MAX_SIDE}x{pixels // MAX_SIDE} has"


def shrink(image: np.ndarray, max_size: int | None) -> np.ndarray:
    """Return the area average in linear light, the longer side reduced to ``max_size`` px; smaller images are returned
    unchanged."""
    (height, width), (new_width, new_height) = image.shape[:2], _reduced(image, max_size)
    if (height, width) == (new_height, new_width):
        return image
    made = np.empty((new_height, new_width, 3), image.dtype)
    # A block of the result at a time, across and then down: at once, linear light would take four times the image.
    for rows in _blocks(new_height, math.ceil(width * height / new_height)):
        top, bottom = rows.start * height / new_height, rows.stop * height / new_height
        source = slice(math.floor(top), min(math.ceil(bottom - 1e-9), height))
        linear = image[source] if image.dtype == np.float32 else DECODE_8BIT[image[source]]
        linear = cv2.resize(linear, (new_width, len(linear)), interpolation=cv2.INTER_AREA)
        edges = np.arange(rows.start, rows.stop + 1)[:, None] * (height / new_height)
        pixel = np.arange(source.start, source.stop)[None]
        # overlap: how much of each row of the source lies in each row of the result.
        overlap = np.minimum(edges[1:], pixel + 1) - np.maximum(edges[:-1], pixel)
        share = np.clip(overlap, 0, None) * (new_height / height)
        average = np.tensordot(share.astype(np.float32), linear, axes=1)
        made[rows] = average if image.dtype == np.float32 else to_srgb8(average)
    return made


def cube_faces(panorama: np.ndarray, size: int, margin: float = 0.0) -> list[np.ndarray]:
    """Return the six sides of a box seen from its centre, from an equirectangular image: +x, -x, +y, -y, +z, -z, each
    (size, size, 3) of the panorama's dtype, upright, not mirrored (right is right for the viewer inside). ``margin``:
    the image extends this fraction of a half edge beyond the box's edges, so that filtering near them is correct.

    The panorama's middle column is in direction +x, and longitude grows to the right, i.e. clockwise from above.
    """
    height, width = panorama.shape[:2]
    # Texel centres of a side from -1 to 1.
    s = ((np.arange(size) + 0.5) / size * 2 - 1) * (1 + margin)
    right, down = np.meshgrid(s, s)
    padded = np.concatenate([panorama[:, -2:], panorama, panorama[:, :2]], axis=1)  # interpolated across the seam
    faces = []
    for forward, to_right, to_down in SKY_SIDES:
        ray = np.asarray(forward, float) + right[..., None] * to_right + down[..., None] * to_down
        # Longitude grows clockwise as seen from above, against the azimuth.
        longitude = -np.arctan2(ray[..., 1], ray[..., 0])
        latitude = np.arctan2(ray[..., 2], np.hypot(ray[..., 0], ray[..., 1]))
        # The last 2 is for the columns added on the left.
        x = (longitude / (2 * np.pi) + 0.5) * width - 0.5 + 2
        y = (0.5 - latitude / np.pi) * height - 0.5
        faces.append(
            cv2.remap(
                padded, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
        )
    return faces


# (forward, right, down) of the six sides for a viewer inside.
SKY_SIDES = tuple(
    tuple(np.array(v, float) for v in side)
    for side in (
        ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
        ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
        ((0, 1, 0), (1, 0, 0), (0, 0, -1)),
        ((0, -1, 0), (-1, 0, 0), (0, 0, -1)),
        ((0, 0, 1), (0, -1, 0), (1, 0, 0)),
        ((0, 0, -1), (0, -1, 0), (-1, 0, 0)),
    )
)
