"""How much a file may claim: what its header states is compared with what is there before memory is allocated."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

from blinkgl.errors import AssetError

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
