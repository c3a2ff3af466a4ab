"""Pictures that somebody else stored, as frames: upright, every page of a stack or animation, without alpha.

imageio is the door of single pictures, and Pillow behind it decides what the numbers of a mode mean; OpenCV reads
what Pillow would reduce to 8 bits, tifffile the pages of stacks. What a file says is used: the orientation of EXIF and
TIFF, the transfer curve of PNG (gAMA, cICP), significant bits (sBIT, BitsPerSample, MaxSampleValue, the maximum of
PNM), alpha as TIFF states it, the delays of animations and the interval of ImageJ's and OME's stacks. Values that are
not in the tables here are refused or left out by name.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import logging
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any, BinaryIO, cast

import cv2
import numpy as np
from PIL import Image, ImageSequence

from blinkgl.errors import AssetError
from blinkgl.io.images import (
    chunks_before_pixels,
    decode_image,
    over,
    png_chunks,
    png_problem,
    read_pfm,
    size_problem,
)
from blinkgl.io.reading import Damage
from blinkgl.io.records import decoding, input_errors

SUFFIXES = frozenset(
    ".png .apng .jpg .jpeg .bmp .tif .tiff .webp .gif .pbm .pgm .ppm .pnm .exr .hdr .pfm .avif .jp2 .tga".split()
)
_KINDS = ("PNG", "JPEG", "JPEG2000", "BMP", "DIB", "WEBP", "GIF", "PPM", "AVIF", "TGA", "TIFF")
_ANIMATED = {".gif", ".webp", ".png", ".apng"}
_TIFF = {".tif", ".tiff"}
_UNSTATED_MS = 100
"""Delay of an animation's frame that states none: what browsers show."""
# The tag of the orientation in EXIF and TIFF.
_ORIENTATION = 274
_MODES = {
    "1": None, "L": None, "LA": None, "RGB": None, "RGBA": None, "I;16": None, "F": None, "P": "RGB", "PA": "RGBA",
    "CMYK": "RGB", "YCbCr": "RGB", "La": "LA", "RGBa": "RGBA", "RGBX": "RGB",
}  # fmt: skip
"""Pillow's modes -> the one that they are converted to; None: as they are."""
_PHOTOMETRIC = {
    0: "white is zero", 1: "black is zero", 2: "RGB", 3: "palette", 5: "CMYK", 6: "YCbCr",
}  # fmt: skip
"""TIFF's PhotometricInterpretation, as far as it is read; 5 and 6 through Pillow, which has them with 8 bits. CIELab
(8) is refused: TIFF and Pillow have a and b signed, and files of other writers have them from 128 on."""
_CONVERTED = (5, 6)
_SAMPLES = {(1, 1), (1, 2), (1, 4), (1, 8), (1, 10), (1, 12), (1, 14), (1, 16), (2, 16), (3, 16), (3, 32), (3, 64)}
"""TIFF's (SampleFormat, BitsPerSample) that are read: 1 unsigned, 2 signed (without negative values), 3 float."""
_EXTRA = {0: "unspecified", 1: "associated alpha", 2: "alpha"}
"""TIFF's ExtraSamples."""
_TIME_UNITS = {
    "s": 1e3, "sec": 1e3, "second": 1e3, "seconds": 1e3, "ms": 1.0, "msec": 1.0, "us": 1e-3, "µs": 1e-3, "usec": 1e-3,
    "ns": 1e-6, "min": 6e4, "minute": 6e4, "minutes": 6e4, "h": 3.6e6, "hour": 3.6e6, "hours": 3.6e6,
}  # fmt: skip
"""Units of the interval between the pages of ImageJ's and OME's stacks, in ms."""


@dataclass
class Stills:
    """The pictures of one file.

    pages : their number.   delays_ms : how long each is shown, None for files that are not animated.   transfer : curve
    that the file states, "linear", "pq", "hlg" or an exponent; None: none, or sRGB.   white : code of white that the
    file states; None: the type's largest.   notes : what was converted or left out, a line
    each.

    :meth:`read` returns (H, W) or (H, W, 3) RGB, uint8, uint16 or float32."""

    path: Path
    pages: int = 1
    delays_ms: list[float] | None = None
    transfer: str | float | None = None
    white: float | None = None
    notes: list[str] = field(default_factory=list)
    associated: bool | None = None

    def read(self, page: int = 0, background: tuple[int, int, int] | None = None) -> np.ndarray:
        """Return a page.   background : (r, g, b), 0 to 255, below transparent pixels; None: black. Raises AssetError:
        undecodable, or of another pixel type."""
        return next(self.iterate(background, page))

    def iterate(self, background: tuple[int, int, int] | None = None, first: int = 0) -> Iterator[np.ndarray]:
        """Yield the pages from ``first`` on, as :meth:`read`."""
        for image in self._pages(first):
            image = _plain(image, self.path)
            if image.ndim == 3 and image.shape[2] in (2, 4):
                image, note = over(image, background, associated=self.associated)
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
            by_opencv = suffix == ".hdr" or _deep(data)
            further = len(data) - _end_of_pnm(data)
            if further < 0:
                raise Damage("cannot decode image (truncated)", where=str(self.path), value=f"{-further} bytes too few")
            if re.match(rb"\s*P[456]\s", data[-further:] if further else b""):
                self._say("left out: the pictures behind the first of a file")
            image = _by_opencv(data, self.path) if by_opencv else _by_pillow(data, self.path, self.notes)
            yield upright(image, self._orientation(data))

    def _orientation(self, data: bytes) -> int:
        if data[:4] == b"\x89PNG" and b"eXIf" not in data:
            return 1
        try:
            with Image.open(io.BytesIO(data)) as image:
                value = int(image.getexif().get(_ORIENTATION, 1))
        except Exception:  # noqa: BLE001 - no kind with EXIF, or a damaged block of it, and the pixels are whole
            return 1
        if not 1 <= value <= 8:
            self._say(f"EXIF's Orientation {value} is none of 1 to 8: as stored")
            return 1
        return value

    def _say(self, note: str) -> None:
        if note not in self.notes:
            self.notes.append(note)

    def _animation(self, first: int) -> Iterator[np.ndarray]:
        with _pillow(self.path, self.path) as image, _decoding(self.path):
            for page in itertools.islice(ImageSequence.Iterator(image), first + _hidden(image), None):
                yield np.asarray(page if page.mode == "I;16" else page.convert("RGBA"))

    def _tiff_pages(self, first: int) -> Iterator[np.ndarray]:
        with _opened_tiff(self.path) as file:
            page = file.series[0].keyframe
            for k in range(first, self.pages):
                bits = _bits(page)
                if page.photometric in _CONVERTED or bits < 8:
                    image = _by_pillow(_bytes(self.path), self.path, self.notes, k)
                else:
                    try:
                        image = file.asarray(key=k, series=0)
                    except (ValueError, ImportError) as error:
                        if "imagecodecs" not in str(error):
                            raise
                        image = self._unpacked(page, bits, k)
                    image = self._colours(image, page)
                yield upright(image, _tag(page, _ORIENTATION) or 1)

    def _unpacked(self, page: Any, bits: int, k: int) -> np.ndarray:
        """Return a page whose packing tifffile leaves to another library: by Pillow, or of more bits by OpenCV."""
        if bits == 8:
            return _by_pillow(_bytes(self.path), self.path, self.notes, k, as_stored=True)
        images: Sequence[np.ndarray] = ()
        if page.photometric in (1, 2) and not page.extrasamples:
            images = cv2.imreadmulti(str(self.path), start=k, count=1, flags=cv2.IMREAD_UNCHANGED)[1]
        if not images:
            raise AssetError(
                f"samples that are packed by {page.compression!r} are not read",
                where=str(self.path),
                accepted="no compression, Deflate or PackBits",
            )
        return images[0] if images[0].ndim == 2 else images[0][..., ::-1]

    def _colours(self, image: np.ndarray, page: Any) -> np.ndarray:
        """Return (H, W), (H, W, 3) or, with alpha, (H, W, 2) or (H, W, 4) of a page as stored."""
        if image.ndim == 3 and page.axes == "SYX":
            image = np.moveaxis(image, 0, -1)
        if page.photometric == 3 and page.colormap is not None and image.ndim == 2:
            # A TIFF palette has 16 bits, 257 times a code of 8 bits; old writers have 8 bits there, as libtiff knows.
            palette = page.colormap if page.colormap.max() < 256 else page.colormap // 257
            return np.moveaxis(palette, 0, -1)[image].astype(np.uint8)
        if page.photometric == 0 and image.dtype.kind in "ub":
            image = ~image if image.dtype == bool else (2 ** _bits(page) - 1) - image
        if image.ndim == 2:
            return image
        base = 3 if page.photometric == 2 else 1
        extras = [int(code) for code in page.extrasamples]
        alpha = next((k for k, code in enumerate(extras) if code in (1, 2)), None)
        self.associated = None if alpha is None else extras[alpha] == 1
        more = image.shape[2] - base - (alpha is not None)
        if more:
            self._say(f"left out: {more} further bands, of which the file does not say that they are alpha")
        chosen_ = [*range(base), *([base + alpha] if alpha is not None else [])]
        return image[..., chosen_] if len(chosen_) > 1 else image[..., 0]


def open_stills(path: Path) -> Stills:
    """Return the pictures of a file, of which only the header is read. Raises AssetError: missing, or undecodable."""
    suffix = path.suffix.lower()
    if suffix in _TIFF:
        return _tiff(path)
    if suffix in _ANIMATED:
        head = _bytes(path, 64)
        if head[:4] == b"\x89PNG":
            return _animated(path) if b"acTL" in (chunks := chunks_before_pixels(path)) else _png(path, chunks)
        # Bit 1 of a WebP file's flags says that it is animated.
        animated = suffix == ".gif" or (head[8:16] == b"WEBPVP8X" and head[20:21] > b"\1" and head[20] & 2)
        return _animated(path) if animated else Stills(path)
    if suffix in (".pbm", ".pgm", ".ppm", ".pnm"):
        head = _bytes(path, 4096)
        heading = re.match(rb"P([1-6])\s+\d+\s+\d+\s+(\d+)?", re.sub(rb"#[^\n]*", b"", head))
        most = int(heading[2] or 0) if heading and heading[1] in b"2356" else 1
        if not heading or not 1 <= most <= 65535:
            raise AssetError(
                "unknown kind of PNM", where=str(path), value=(head[:2], most), accepted="P1 to P6, maximum 1 to 65535"
            )
        # Up to 255 Pillow widens the codes to 8 bits.
        return Stills(path, white=float(most) if most > 255 else None)
    if not path.is_file():
        raise AssetError("no such file", where=str(path))
    return Stills(path, transfer="linear" if suffix in (".exr", ".hdr", ".pfm") else None)


def _png(path: Path, chunks: dict[bytes, bytes]) -> Stills:
    """Read what the chunks before the pixels say of codes (PNG specification, 11.3.2)."""
    stills = Stills(path)
    # They come in any order; of curves cICP counts more than sRGB, and that more than gAMA.
    if len(code := chunks.get(b"cICP", b"")) == 4:
        from blinkgl.io.video import TRANSFERS

        stills.transfer = TRANSFERS.get(code[1])
    elif b"sRGB" not in chunks and len(gamma := chunks.get(b"gAMA", b"")) == 4:
        # gAMA holds 100,000 times the exponent of encoding.
        exponent = 1e5 / max(int.from_bytes(gamma, "big"), 1)
        stills.transfer = "linear" if abs(exponent - 1) < 0.01 else None if abs(exponent - 2.2) < 0.02 else exponent
    significant = chunks.get(b"sBIT", b"")
    # The bit depth comes after width and height, four bytes each.
    if chunks.get(b"IHDR", b"")[8:9] == b"\x10" and significant and significant[0] < 16:
        # Only where the codes are no larger, which the reader of the clip checks.
        stills.white = 2 ** significant[0] - 1
    if stills.transfer is not None:
        curve = f"{stills.transfer:.4g}" if isinstance(stills.transfer, float) else stills.transfer
        stills.notes.append(f"the images state the curve {curve}")
    return stills


def _animated(path: Path) -> Stills:
    with _pillow(path, path) as image, _decoding(path):
        if problem := size_problem(*image.size, path.stat().st_size):
            raise AssetError(problem, where=str(path))
        delays, notes = [], []
        if image.format == "PNG" and image.mode != "I;16" and _bytes(path, 25)[24] == 16:
            notes.append("left out: the lower 8 of the 16 bits of an animation in colour")
        for page in itertools.islice(ImageSequence.Iterator(image), _hidden(image), None):
            if image.format == "WEBP":
                page.load()  # its delay is known then
            delays.append(float(page.info.get("duration", 0) or 0))
    if zero := sum(delay <= 0 for delay in delays):
        notes.append(f"{zero} frames state no delay: {_UNSTATED_MS} ms each, as browsers show them (--fps)")
    return Stills(path, len(delays), [delay if delay > 0 else _UNSTATED_MS for delay in delays], notes=notes)


def _hidden(image: Image.Image) -> int:
    """Return how many of the pages are no part of an animation: the one that programs show which know none (APNG)."""
    return int(getattr(image, "default_image", False))


@contextlib.contextmanager
def _opened_tiff(path: Path) -> Iterator[Any]:
    """Open a file, and no other one that it names; the library's log says what its exceptions say, too."""
    import tifffile

    logging.getLogger("tifffile").setLevel(logging.CRITICAL)
    # OME-XML may name other files; what it says of its own is read from the description instead. MMStack's and NDTiff's
    # indices name those beside a file: bytes without a name and a folder have none.
    with (
        _decoding(path),
        open(path, "rb") as raw,
        mmap(raw.fileno(), 0, access=ACCESS_READ) as held,
        tifffile.TiffFile(cast(BinaryIO, held), is_ome=False) as file,
    ):
        yield file


def _bits(page: Any) -> int:
    return page.bitspersample if isinstance(page.bitspersample, int) else max(page.bitspersample)


def _tiff(path: Path) -> Stills:
    with _opened_tiff(path) as file:
        series, notes, page = file.series[0], [], file.series[0].keyframe
        if problem := size_problem(
            page.imagewidth, page.imagelength, path.stat().st_size, max(1, page.samplesperpixel) * -(-_bits(page) // 8)
        ):
            raise AssetError(problem, where=str(path))
        _check_tags(page, path)
        stated, channels = _interval_ms(file, notes)
        # What the pages are, besides rows, columns and samples.
        along = [axis for axis, n in zip(series.axes, series.shape) if axis not in "YXS" and n > 1]
        if "C" in along or len(along) > 1 or channels > 1:
            raise AssetError(
                "channels or slices of a microscope as pages",
                where=str(path),
                value=f"{series.axes} {series.shape}",
                accepted="pages that are frames",
            )
        if len(file.series) > 1:
            notes.append(f"{path.name}: {len(file.series) - 1} further images of another size or type are left out")
        bits = _bits(page)
        most = _tag(page, 281)  # MaxSampleValue
        most = max(most) if isinstance(most, tuple) else most
        white = most if page.dtype == np.uint16 and most and 255 < int(most) < 65535 else None
        white = 2**bits - 1 if white is None and 8 < bits < 16 else white
        pages = len(series.pages)
        delays = [stated] * pages if stated and pages > 1 else None
        return Stills(
            path, pages, delays, "linear" if page.dtype is not None and page.dtype.kind == "f" else None, white, notes
        )


def _check_tags(page: Any, path: Path) -> None:
    """Raise AssetError, naming the tag, for a value that is not in the tables here."""
    # Tag 339 is SampleFormat; a file without it holds unsigned samples (1).
    formats = page.tags.get(339)
    formats = 1 if formats is None else formats.value
    kinds = {int(one) for one in (formats if isinstance(formats, tuple) else (formats,))}
    bits = _bits(page)
    held = (
        ("PhotometricInterpretation", int(page.photometric), page.photometric in _PHOTOMETRIC, list(_PHOTOMETRIC)),
        ("SampleFormat, BitsPerSample", (sorted(kinds), bits), all((k, bits) in _SAMPLES for k in kinds),
         "unsigned up to 16 bits, signed 16, float 16 to 64"),
        ("Orientation", _tag(page, _ORIENTATION), (_tag(page, _ORIENTATION) or 1) in range(1, 9), "1 to 8"),
        ("ExtraSamples", page.extrasamples, all(int(code) in _EXTRA for code in page.extrasamples), list(_EXTRA)),
        ("white is zero with SampleFormat", sorted(kinds), page.photometric != 0 or kinds == {1}, 1),
        ("bits of CMYK or YCbCr", bits, page.photometric not in _CONVERTED or bits == 8, 8),
    )  # fmt: skip
    for name, value, known, accepted in held:
        if not known:
            raise AssetError(f"TIFF's {name} is not read", where=str(path), value=value, accepted=str(accepted))


def _interval_ms(file: Any, notes: list[str]) -> tuple[float | None, int]:
    """Return the ms between pages that ImageJ's or OME's description states, and OME's number of pictures a time."""
    meta, text = file.imagej_metadata or {}, str(file.pages[0].description or "")
    pixels = dict(re.findall(r'(\w+)="([^"]*)"', next(iter(re.findall(r"<Pixels\b[^>]*>", text)), "")))
    sizes = {k: int(pixels.get(f"Size{k}", "1")) for k in "CZT" if pixels.get(f"Size{k}", "1").isdecimal()}
    channels = sizes.get("C", 1) * (sizes.get("Z", 1) if sizes.get("T", 1) > 1 else 1)
    value, unit = meta.get("finterval") or (1 / float(meta["fps"]) if meta.get("fps") else None), meta.get("tunit", "s")
    if "TimeIncrement" in pixels:
        value, unit = pixels["TimeIncrement"], pixels.get("TimeIncrementUnit", "s")
    unit = str(unit).strip().replace("\\u00B5", "µ").replace("μ", "µ")
    if not value:
        return None, channels
    try:
        interval = float(value) * _TIME_UNITS[unit]
    except (KeyError, ValueError):
        notes.append(f"left out: the interval between pages, {value} '{unit}', of an unknown unit (--fps)")
        return None, channels
    return (interval if 0 < interval < float("inf") else None), channels


_PNM = re.compile(rb"P([2356])(?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,5})\s")
"""Kind, width, height and maximum of a picture; comments may stand between them."""


def _deep(data: bytes) -> bool:
    """Return whether a picture has bits that Pillow would reduce to 8: PNG of 16 bits, PNM of a larger maximum."""
    heading = _PNM.match(data)
    return (data[:4] == b"\x89PNG" and data[24:25] == b"\x10") or bool(heading and int(heading[4]) > 255)


def _end_of_pnm(data: bytes) -> int:
    """Return where the samples of a binary PNM end; of any other picture, where the data do."""
    heading = _PNM.match(data)
    width, height = (int(heading[2]), int(heading[3])) if heading else (0, 0)
    if not heading or heading[1] not in b"56" or size_problem(width, height, len(data)):  # whoever decodes it says that
        return len(data)
    samples = width * height * (3 if heading[1] == b"6" else 1)
    return heading.end() + samples * (2 if int(heading[4]) > 255 else 1)


def _by_opencv(data: bytes, path: Path) -> np.ndarray:
    image = decode_image(data, path)
    # OpenCV's order of channels is BGR.
    if data[:4] == b"\x89PNG" and data[25:26] == b"\x04":  # grey with alpha, of which OpenCV makes colour
        return image[..., [0, 3]]
    if data[:4] == b"\x89PNG" and image.ndim == 2:
        # The code of grey that is transparent, which OpenCV leaves out.
        see_through = [int.from_bytes(body, "big") for _, kind, body in png_chunks(data) if kind == b"tRNS"]
        return (
            np.dstack([image, np.where(image == see_through[0], 0, 65535).astype(image.dtype)])
            if see_through
            else image
        )
    return image if image.ndim == 2 else image[..., [2, 1, 0, 3][: image.shape[2]]]


def _by_pillow(data: bytes, path: Path, notes: list[str], index: int = 0, *, as_stored: bool = False) -> np.ndarray:
    """Return a picture through imageio.   as_stored : alpha as it is, associated or not. Raises AssetError: a mode that
    is not in the table; Damage: cut."""
    import imageio.v3 as iio

    if problem := png_problem(data) if data[:4] == b"\x89PNG" else None:
        raise Damage(problem, where=str(path))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # The library tries all kinds that Pillow knows, some of which run other programs.
            with (
                _pillow(io.BytesIO(data), path),
                iio.imopen(io.BytesIO(data), "r", plugin="pillow") as file,
            ):
                meta = file.metadata(index=index, exclude_applied=False)
                if problem := size_problem(meta["shape"][0], meta["shape"][1], len(data)):
                    raise AssetError(problem, where=str(path))
                mode = meta["mode"]
                if mode not in _MODES:
                    raise AssetError(
                        "unknown mode of a picture", where=str(path), value=mode, accepted=", ".join(_MODES)
                    )
                transparent = "transparency" in meta and mode in ("1", "L", "RGB", "P")
                wanted = "RGBA" if transparent else _MODES[mode]
                wanted = None if as_stored and mode in ("RGBa", "La") else wanted
                how: dict[str, object] = {"mode": wanted}
                return file.read(index=index, **how)
    except AssetError:
        raise
    except Exception as error:
        if data[:2] == b"\xff\xd8" and "truncated" in str(error) and (image := _without_end(data)) is not None:
            notes.append("JPEG without its end mark, but whole")
            return image
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise Damage(f"cannot decode image (corrupt or truncated): {reason}", where=str(path)) from error


def _without_end(data: bytes) -> np.ndarray | None:
    """Return a JPEG's picture that lacks only the mark of its end; None: more is missing. What follows a whole scan
    changes no pixel; what is missing from one is filled from there."""
    pictures = []
    for behind in (b"\xff\xd9", b"\xaa" * 64 + b"\xff\xd9"):
        with contextlib.suppress(Exception), Image.open(io.BytesIO(data + behind)) as image:
            pictures.append(np.asarray(image.convert("RGB") if image.mode not in ("L", "RGB") else image))
    return pictures[0] if len(pictures) == 2 and np.array_equal(pictures[0], pictures[1]) else None


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


def _bytes(path: Path, most: int = -1) -> bytes:
    with input_errors(path, "cannot read image"), open(path, "rb") as file:
        return file.read(most)


def _decoding(path: Path) -> AbstractContextManager[None]:
    return decoding(path, "cannot decode image (corrupt or truncated)", Damage)


def _pillow(source: Path | io.BytesIO, path: Path) -> Image.Image:
    """Open a picture whose bytes are one of :data:`_KINDS`, whatever its name says."""
    with _decoding(path), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        Image.init()  # most kinds are known only then
        return Image.open(source, formats=[kind for kind in _KINDS if kind in Image.OPEN])
