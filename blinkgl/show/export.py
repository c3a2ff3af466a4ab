"""``blinkgl export``: how many samples went into how many shards."""

from __future__ import annotations

from blinkgl.dataset.shards import export_shards
from blinkgl.show.terminal import plain_console, say


def run(root: str, out: str, *, shard_bytes: int, seed: int) -> int:
    """Arguments: of :func:`~blinkgl.dataset.shards.export_shards`."""
    console = plain_console()
    with console.status("writing shards"):
        written = export_shards(root, out, shard_bytes=shard_bytes, seed=seed)
    for split, counts in written.items():
        say(console, f"{out}/{split}-*.tar: {sum(counts):,} samples in {len(counts)} shard{'s' * (len(counts) != 1)}")
    return 0
