"""How much a file may claim: what its header states is compared with what is there before memory is allocated."""

from __future__ import annotations

import os

from blinkgl.errors import AssetError

_UNSUSPECTED, _MOST_RATIO = 1 << 28, 100
"""What is packed may unpack to so many bytes, or to so many times its own: events pack to a tenth, pictures to a
fiftieth."""


def check_claim(size: int, where: str, packed: int | None = None) -> None:
    """Check that ``size`` bytes, as a header states them, may be allocated.   packed : bytes in the file that they are
    unpacked from; None: they lie there as they are.

    Raises AssetError: more than half of this machine's memory, or far more than so many bytes unpack to."""
    limit = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    if size > limit:
        raise AssetError(
            "too large for this machine's memory",
            where=where,
            value=f"{size / 1e9:.1f} GB",
            accepted=f"at most {limit / 1e9:.1f} GB",
        )
    if packed is not None and size > max(_UNSUSPECTED, _MOST_RATIO * packed):
        raise AssetError(
            f"unpacks to more than {_MOST_RATIO} times its size",
            where=where,
            value=f"{size} bytes of {packed}",
            accepted="a file that is not packed",
        )
