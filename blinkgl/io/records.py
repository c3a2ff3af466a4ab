"""Records on disk that somebody else may have written or damaged: read with limits, and only from regular files.

For any content of a manifest, an index or a run's record, reading returns data in the form of its model, or one line
that says what is wrong. What the header of a larger file claims is compared with what is there before memory is
allocated.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from blinkgl.errors import AssetError, BlinkGLError, EventDataError

if TYPE_CHECKING:  # reading events alone does not wait for it
    from pydantic import TypeAdapter, ValidationError

MAX_RECORD_BYTES = 512 << 20
MAX_NAME_BYTES = 1024


def open_regular(path: str | os.PathLike) -> int:
    """Return a file descriptor for reading. Raises OSError; AssetError for anything but a regular file: a pipe could
    block forever, a device has no end. A link at the end of the path is followed only to such a file."""
    # O_NONBLOCK, because opening a pipe that nobody writes to would wait.
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise AssetError("not a regular file", where=str(path))
    return descriptor


@contextlib.contextmanager
def input_errors(path: str | os.PathLike, problem: str = "cannot read") -> Iterator[None]:
    """Convert an ``OSError`` of reading ``path`` to an :class:`AssetError` of one line."""
    try:
        yield
    except OSError as error:
        raise AssetError(f"{problem}: {error.strerror}", where=str(path)) from error


@contextlib.contextmanager
def decoding(path: str | os.PathLike, problem: str, kind: type[AssetError] = AssetError) -> Iterator[None]:
    """Convert whatever a library raises on damaged bytes to an :class:`AssetError`, or another ``kind``, of one
    line."""
    try:
        yield
    except BlinkGLError as error:
        # Columns do not know the file that they come from.
        if isinstance(error, EventDataError) and str(path) not in str(error.where):
            raise kind(f"{problem}: {error}", where=str(path)) from error
        raise
    except Exception as error:
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise kind(f"{problem}: {reason}", where=str(path)) from error


def read_text(path: str | os.PathLike, limit: int = MAX_RECORD_BYTES) -> str:
    """Return UTF-8 text of a regular file. Raises FileNotFoundError; AssetError: unreadable, not text, more than
    ``limit`` bytes."""
    try:
        with open(open_regular(path), "rb") as file:
            # One byte more than allowed tells a file that is too large without reading it whole.
            data = file.read(limit + 1)
        if len(data) > limit:
            raise AssetError("too large", where=str(path), accepted=f"at most {limit} bytes")
        return data.decode("utf-8")
    except FileNotFoundError:
        raise
    except ValueError:  # bytes that are not UTF-8; a path that contains NUL
        raise AssetError("not a text file in UTF-8", where=str(path)) from None
    except OSError as error:
        raise AssetError(f"cannot be read: {error.strerror}", where=str(path)) from error


def parse(text: str, model: TypeAdapter | None = None) -> Any:
    """Return plain data from JSON text, as written, once ``model`` has accepted it. Raises ValueError with one line:
    not JSON, nested too deeply, a key twice, or not in the model's form."""
    try:
        data = json.loads(text, object_pairs_hook=_unique)
        if model is not None:
            _validate(model, data)
        return data
    except RecursionError:
        raise ValueError("nested too deeply") from None
    except json.JSONDecodeError as error:
        raise ValueError(f"not JSON: {error.msg.lower()} at line {error.lineno}") from None


def _validate(model: TypeAdapter, data: object) -> None:
    from pydantic import ValidationError

    try:
        model.validate_python(data)
    except ValidationError as error:
        raise ValueError(first_problem(error)) from None


def first_problem(error: ValidationError) -> str:
    """Return the first place where data are not in the form of a model, and why."""
    first = error.errors(include_url=False)[0]
    place, message = ".".join(shown(part) for part in first["loc"]), first["msg"].removeprefix("Value error, ").lower()
    return f"{place}: {message}" if place else message


SEAL = "record_sha256"
_OPEN = "0" * 64


def sealed(record: Mapping[str, object], default: Callable[[object], object] | None = None) -> str:
    """Return the JSON text of a record with a hash of itself: SHA-256 of the text with zeros in the hash's place."""
    text = json.dumps({**record, SEAL: _OPEN}, indent=1, sort_keys=True, default=default) + "\n"
    digest = hashlib.sha256(text.encode()).hexdigest()
    # The hash has as many digits as the zeros: no byte moves.
    return text.replace(f'"{SEAL}": "{_OPEN}"', f'"{SEAL}": "{digest}"')


def seal_problem(text: str) -> str | None:
    """Return the problem of a sealed record's hash; None where it is right."""
    seal = re.search(rf'"{SEAL}": "([0-9a-f]{{64}})"', text)
    if seal is None:
        return f"'{SEAL}' is missing"
    whole = text[: seal.start(1)] + _OPEN + text[seal.end(1) :]
    return None if hashlib.sha256(whole.encode()).hexdigest() == seal[1] else "checksum differs"


def _unique(pairs: list[tuple[str, object]]) -> dict[str, object]:
    table = dict(pairs)
    if len(table) != len(pairs):
        raise ValueError("a key is given twice")
    return table


def shown(name: object, most: int = 160) -> str:
    """Return a name from disk for printing on a terminal: one line, no control characters, not too long."""
    text = str(name)
    text = text if text.isprintable() else ascii(text)[1:-1]
    return text if len(text) <= most else text[: most - 1] + "…"


def shown_names(names: Iterable[object], most: int = 12) -> str:
    """Return names from a file for one line: each as of :func:`shown`, of many the first ``most`` and how many more."""
    listed = list(names)
    more = f" and {len(listed) - most:,} more" if len(listed) > most else ""
    return ", ".join(shown(name, 60) for name in listed[:most]) + more


def path_inside(name: str) -> str:
    """Return ``name``. Raises ValueError unless it is a plain relative POSIX path inside its folder."""
    parts = name.split("/")
    try:
        sizes = [len(part.encode("utf-8")) for part in parts]
    except UnicodeEncodeError:
        raise ValueError("not a file name") from None
    if "\0" in name or min(sizes) == 0 or {".", ".."} & set(parts):
        raise ValueError("not a path inside the folder")
    # Limits of file systems: 255 bytes a name; the whole path has to fit into 4096.
    if max(sizes) > 255 or sum(sizes) + len(sizes) > MAX_NAME_BYTES:
        raise ValueError("not a file name: too long")
    return name


def plain_name(name: str) -> str:
    """Return ``name``. Raises ValueError unless it is the plain name of one folder, which can be printed."""
    if "/" in path_inside(name) or "\\" in name or name.startswith(".") or not name.isprintable():
        raise ValueError("not the plain name of a folder")
    return name


def named(path: Path) -> Path:
    """Return a path whose last part is a name: "." and ".." as the whole path, any other as it is."""
    return path if path.name not in ("", "..") else path.resolve()


def inside(folder: str | os.PathLike, name: str) -> Path:
    """Return the path of what a file names inside ``folder``, which itself may be a link. Every name of a record that
    becomes a path passes here. Raises AssetError: no plain relative path, or a symbolic link on the way, which could
    lead out of the folder."""
    path = Path(folder)
    try:
        parts = path_inside(name).split("/")
    except ValueError as error:
        raise AssetError(f"names {error}", where=str(path), value=name, accepted="a plain relative path") from None
    for part in parts:
        path /= part
        if path.is_symlink():
            raise AssetError("a symbolic link, which is not followed", where=str(path), accepted="the file itself")
    return path


def entries_below(folder: str | os.PathLike) -> Iterator[tuple[str, str, int]]:
    """Yield (POSIX path relative to ``folder``, kind, bytes) of everything below it; kind is "file", "empty folder",
    "symbolic link" or "special file". Links are not followed. Non-empty folders are not listed. Raises OSError."""
    pending = [""]
    while pending:
        prefix = pending.pop()
        empty = True
        with os.scandir(os.path.join(folder, prefix)) as entries:
            for entry in entries:
                empty = False
                name = prefix + entry.name
                status = entry.stat(follow_symlinks=False)
                if stat.S_ISDIR(status.st_mode):
                    pending.append(name + "/")
                else:
                    kind = (
                        "file"
                        if stat.S_ISREG(status.st_mode)
                        else "symbolic link"
                        if stat.S_ISLNK(status.st_mode)
                        else "special file"
                    )
                    yield name, kind, status.st_size
        if empty and prefix:
            yield prefix[:-1], "empty folder", 0


# What is packed may unpack to so many bytes, or so many times its own: events pack to a tenth, pictures to a fiftieth.
_UNSUSPECTED, _MOST_RATIO = 1 << 28, 100


def most_unpacked(packed: int, unsuspected: int = _UNSUSPECTED) -> int:
    """Return the bytes that ``packed`` bytes of a file may unpack to, at least ``unsuspected``."""
    return max(unsuspected, _MOST_RATIO * packed)


def unpacked(make: Callable[[], Any], data: bytes, unsuspected: int = _UNSUSPECTED) -> bytes:
    """Return what all streams in ``data`` unpack to.   make : returns an unpacker of bz2's form, of one stream.

    Raises ValueError: more than :func:`most_unpacked`, or a stream that is cut; and what the unpacker raises."""
    parts, left = [], most_unpacked(len(data), unsuspected)
    while data:
        unpacker = make()
        # One byte more than allowed tells a stream that is too long.
        parts.append(unpacker.decompress(data, max_length=left + 1))
        left -= len(parts[-1])
        if left < 0 or not unpacker.eof:
            raise ValueError("is cut" if left >= 0 else f"unpacks to more than {_MOST_RATIO} times its size")
        data = unpacker.unused_data
    return b"".join(parts)


def bounded(read: Callable[[int], bytes], packed: int, unsuspected: int = _UNSUSPECTED) -> Callable[[int], bytes]:
    """Return ``read`` of what ``packed`` bytes unpack to, which raises ValueError beyond :func:`most_unpacked`."""
    left = most_unpacked(packed, unsuspected)

    def within(size: int) -> bytes:
        nonlocal left
        data = read(size)
        left -= len(data)
        if left < 0:
            raise ValueError(f"unpacks to more than {_MOST_RATIO} times its size")
        return data

    return within


def check_claim(size: int, where: str, packed: int | None = None) -> None:
    """Check that ``size`` bytes, as a header states them, may be allocated.   packed : bytes in the file that they are
    unpacked from; None: they lie there as they are.

    Raises AssetError: more than half of this machine's memory, or far more than so many bytes unpack to."""
    limit = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    far = packed is not None and size > most_unpacked(packed)
    if far or size > limit:
        problem = f"unpacks to more than {_MOST_RATIO} times its size" if far else "too large for this machine's memory"
        raise AssetError(
            problem, where=where, value=f"{size} bytes", accepted=f"at most {limit / 1e9:.1f} GB, unpacked"
        )
