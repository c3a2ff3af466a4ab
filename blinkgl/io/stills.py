"""Pictures that somebody else stored, as frames: upright, every page of a stack or animation, without alpha.

What a file says is used: the orientation of EXIF and TIFF, the transfer curve of PNG (gAMA, cICP), significant bits
(sBIT, BitsPerSample, MaxSampleValue, the maximum of PGM), the delays of animations.
"""

from __future__ import annotations

import io
import logging
import re
import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image, ImageSequence

from blinkgl.errors import AssetError
from blinkgl.io.alpha import over
from blinkgl.io.images import decode_image, png_chunks, read_pfm, size_problem
from blinkgl.io.records import decoding, input_errors

SUFFIXES = frozenset(".png .apng .jpg .jpeg .bmp .tif .tiff .webp .gif .pgm .ppm .pnm .exr .hdr .pfm".split())
_ANIMATED = {".gif", ".webp", ".png", ".apng"}
_TIFF = {".tif", ".tiff"}
_UNSTATED_MS = 100
"""Delay of an animation's frame that states none: what browsers show."""
# The tag of the orientation in EXIF and TIFF.
_ORIENTATION = 274


@dataclass
class Stills:
    """The pictures of one file.

    pages : their number.   delays_ms : how long each is shown, None for files that are not animated.   transfer : curve
    that the file states, "linear", "pq", "hlg" or an exponent; None: none, or sRGB.   white : code of white that the
    file states; None: the type's largest.   notes : what was guessed, converted or left out, a line each.

    :meth:`read` returns (H, W) or (H, W, 3) RGB, uint8, uint16 or float32."""

    path: Path
    pages: int = 1
    delays_ms: list[float] | None = None
    transfer: str | float | None = None
    white: int | None = None
    notes: list[str] = field(default_factory=list)

    def read(self, page: int = 0, background: tuple[int, int, int] | None = None) -> np.ndarray:
        """Return a page.   background : (r, g, b), 0 to 255, below transparent pixels; None: black. Raises AssetError:
        undecodable, or of another pixel type."""
        return next(self.iterate(background, page))

    def iterate(self, background: tuple[int, int, int] | None = None, first: int = 0) -> Iterator[np.ndarray]:
        """Yield the pages from ``first`` on, as :meth:`read`."""
        for image in self._pages(first):
            image = _plain(image, self.path)
            if image.ndim == 3 and image.shape[2] in (2, 4):
                image, note = over(image, background)
                if note and note not in self.notes:
                    self.notes.append(note)
            yield np.ascontiguousarray(image)

    def _pages(self, first: int) -> Iterator[np.ndarray]:
        suffix = self.path.suffix.lower()
        if suffix == ".pfm":
            yield read_pfm(self.path)
        elif suffix == ".exr":
            from blinkgl.io.video import decode_exr

            yield decode_exr(_bytes(self.path), str(self.path))
        elif suffix in _TIFF:
            yield from self._tiff_pages(first)
        elif self.delays_ms is not None:
            yield from self._animation(first)
        else:
            data = _bytes(self.path)
            image = decode_image(data, self.path)
            if image.ndim == 3:
                # OpenCV's order of channels is BGR.
                image = image[..., [2, 1, 0, 3][: image.shape[2]]]
            yield upright(image, _orientation(data, self.path))

    def _animation(self, first: int) -> Iterator[np.ndarray]:
        with _pillow(self.path) as image, _decoding(self.path):
            for k, page in enumerate(ImageSequence.Iterator(image)):
                if k >= first:
                    yield np.asarray(page.convert("RGBA"))

    def _tiff_pages(self, first: int) -> Iterator[np.ndarray]:
        tifffile = _tifffile()
        with _decoding(self.path), tifffile.TiffFile(self.path) as file:
            for k in range(first, self.pages):
                page = file.series[0].keyframe
                try:
                    image = file.asarray(key=k, series=0)
                except (ValueError, ImportError) as error:  # LZW and JPEG want another library, which OpenCV has
                    if "imagecodecs" not in str(error):
                        raise
                    found, images = cv2.imreadmulti(str(self.path), start=k, count=1, flags=cv2.IMREAD_UNCHANGED)
                    if not found:
                        raise AssetError("cannot decode image", where=str(self.path), value=str(error)) from error
                    image = images[0] if images[0].ndim == 2 else images[0][..., [2, 1, 0, 3][: images[0].shape[2]]]
                else:
                    image = _tiff_colours(image, page)
                yield upright(image, _tag(page, _ORIENTATION) or 1)


def open_stills(path: Path) -> Stills:
    """Return the pictures of a file, of which only the header is read. Raises AssetError: missing, or undecodable."""
    suffix = path.suffix.lower()
    if suffix in _TIFF:
        return _tiff(path)
    if suffix in _ANIMATED:
        head = _bytes(path, 4096 if suffix in (".png", ".apng") else 64)
        # acTL is a chunk of animated PNG files; bit 1 of a WebP file's flags says that it is animated.
        animated = suffix == ".gif" or b"acTL" in head or (head[8:16] == b"WEBPVP8X" and head[20] & 2)
        if animated:
            return _animated(path)
        return _png(path, head) if head[:4] == b"\x89PNG" else Stills(path)
    if suffix in (".pgm", ".ppm", ".pnm"):
        found = re.match(
            rb"P[56](?:\s+#[^\n]*)*\s+\d+(?:\s+#[^\n]*)*\s+\d+(?:\s+#[^\n]*)*\s+(\d+)\s", _bytes(path, 4096)
        )
        most = int(found[1]) if found else 0
        # OpenCV widens other 8-bit maxima itself.
        return Stills(path, white=most if 255 < most < 65535 else None)
    if not path.is_file():
        raise AssetError("no such file", where=str(path))
    return Stills(path, transfer="linear" if suffix in (".exr", ".hdr", ".pfm") else None)


def _png(path: Path, head: bytes) -> Stills:
    """Read the chunks before the pixels that say what codes mean (PNG specification, 11.3.2)."""
    stills, bits = Stills(path), 0
    for _, kind, body in png_chunks(head):
        if kind == b"IHDR":
            # The bit depth comes after width and height, four bytes each.
            bits = body[8]
        elif kind == b"cICP" and len(body) == 4:
            from blinkgl.io.video import TRANSFERS

            stills.transfer = TRANSFERS.get(body[1])
            break
        elif kind == b"gAMA" and len(body) == 4:
            # gAMA holds 100,000 times the exponent of encoding.
            exponent = 1e5 / max(int.from_bytes(body, "big"), 1)
            stills.transfer = "linear" if abs(exponent - 1) < 0.01 else None if abs(exponent - 2.2) < 0.02 else exponent
        elif kind == b"sRGB":
            stills.transfer = None
            break
        elif kind == b"sBIT" and bits == 16 and body and body[0] < 16:
            stills.white = 2 ** body[0] - 1  # only where the codes are no larger, which the reader of the clip checks
        elif kind in (b"IDAT", b"IEND"):
            break
    if stills.transfer is not None:
        curve = f"{stills.transfer:.4g}" if isinstance(stills.transfer, float) else stills.transfer
        stills.notes.append(f"the images state the curve {curve}")
    return stills


def _animated(path: Path) -> Stills:
    with _pillow(path) as image, _decoding(path):
        if problem := size_problem(*image.size):
            raise AssetError(problem, where=str(path))
        delays = []
        for page in ImageSequence.Iterator(image):
            if image.format == "WEBP":
                page.load()  # its delay is known then
            delays.append(float(page.info.get("duration", 0) or 0))
    notes = []
    if zero := sum(delay <= 0 for delay in delays):
        notes.append(f"{zero} frames state no delay: {_UNSTATED_MS} ms each, as browsers show them (--fps)")
    return Stills(path, len(delays), [delay if delay > 0 else _UNSTATED_MS for delay in delays], notes=notes)


def _tifffile() -> Any:
    """Return the library, which logs what it finds wrong with a file; the exceptions say it, too."""
    import tifffile

    logging.getLogger("tifffile").setLevel(logging.CRITICAL)
    return tifffile


def _tiff(path: Path) -> Stills:
    tifffile = _tifffile()
    with _decoding(path), tifffile.TiffFile(path) as file:
        series, notes = file.series[0], []
        page = series.keyframe
        if problem := size_problem(page.imagewidth, page.imagelength):
            raise AssetError(problem, where=str(path))
        if "C" in series.axes and len(series.shape) > 3:
            raise AssetError(
                "channels of a microscope as pages",
                where=str(path),
                value=f"{series.axes} {series.shape}",
                accepted="pages that are frames",
            )
        if len(file.series) > 1:
            notes.append(f"{path.name}: {len(file.series) - 1} further images of another size or type are left out")
        bits = page.bitspersample if isinstance(page.bitspersample, int) else max(page.bitspersample)
        most = _tag(page, 50717) or _tag(page, 281)  # DNG's WhiteLevel; MaxSampleValue
        most = max(most) if isinstance(most, tuple) else most
        white = most if page.dtype == np.uint16 and most and 255 < int(most) < 65535 else None
        white = 2**bits - 1 if white is None and 8 < bits < 16 else white
        interval = (file.imagej_metadata or {}).get("finterval")
        pages = len(series.pages)
        delays = [float(interval) * 1000] * pages if interval and pages > 1 else None
        linear = page.dtype is not None and page.dtype.kind == "f"
        return Stills(path, pages, delays, "linear" if linear else None, white, notes)


def _tiff_colours(image: np.ndarray, page: Any) -> np.ndarray:
    """Return (H, W), (H, W, 3) or (H, W, 4) of a page as stored."""
    if page.axes == "SYX":
        image = np.moveaxis(image, 0, -1)
    if page.photometric == 3 and page.colormap is not None:  # a palette
        # A TIFF palette has 16 bits, 257 times a code of 8 bits.
        return np.moveaxis(page.colormap, 0, -1)[image] // 257
    if page.photometric == 0 and image.dtype.kind in "ub":  # white is zero
        bits = page.bitspersample if isinstance(page.bitspersample, int) else 8
        return ~image if image.dtype == bool else (2**bits - 1) - image
    if image.ndim == 3 and image.shape[2] not in (3, 4) and image.shape[2] != 2:
        image = image[..., :3] if image.shape[2] > 4 else image[..., 0]
    return image


def _tag(page: Any, code: int) -> Any:
    tag = page.tags.get(code)
    return None if tag is None else tag.value


def _plain(image: np.ndarray, path: Path) -> np.ndarray:
    """Return a picture as uint8, uint16 or float32. Raises AssetError: another pixel type."""
    if image.dtype == bool:
        return image.astype(np.uint8) * np.uint8(255)
    if image.dtype == np.int16 and (not image.size or image.min() >= 0):
        return image.astype(np.uint16)
    if image.dtype.kind == "f":
        return image.astype(np.float32, copy=False)
    if image.dtype not in (np.uint8, np.uint16):
        raise AssetError(
            "unsupported pixel type", where=str(path), value=str(image.dtype), accepted="8-bit, 16-bit or float32"
        )
    return image


def upright(image: np.ndarray, orientation: int) -> np.ndarray:
    """Return an image turned and mirrored as EXIF's orientation (1 to 8; TIFF 6.0, page 36) says."""
    if orientation in (5, 6, 7, 8):
        image = image.swapaxes(0, 1)
    # After the transposition: which of columns and rows run backwards.
    across, down = {2: (1, 0), 3: (1, 1), 4: (0, 1), 6: (1, 0), 7: (1, 1), 8: (0, 1)}.get(orientation, (0, 0))
    return image[:: -1 if down else 1, :: -1 if across else 1]


def _orientation(data: bytes, path: Path) -> int:
    if path.suffix.lower() not in (".jpg", ".jpeg", ".png", ".webp", ".apng"):
        return 1
    if data[:4] == b"\x89PNG" and b"eXIf" not in data:
        return 1
    try:
        with Image.open(io.BytesIO(data)) as image:
            return int(image.getexif().get(_ORIENTATION, 1))
    except Exception:  # noqa: BLE001 - a damaged EXIF block raises anything, and the pixels are whole
        return 1


def _bytes(path: Path, most: int = -1) -> bytes:
    with input_errors(path, "cannot read image"), open(path, "rb") as file:
        return file.read(most)


def _decoding(path: Path) -> AbstractContextManager[None]:
    return decoding(path, "cannot decode image (corrupt or truncated)")


def _pillow(path: Path) -> Image.Image:
    with _decoding(path), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return Image.open(path)
