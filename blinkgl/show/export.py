"""``blinkgl export``: prints what was written, and notes on it."""

from __future__ import annotations

from pathlib import Path

from blinkgl.dataset.cross_checks import guarded, lost, strangers
from blinkgl.dataset.shards import export_shards
from blinkgl.errors import ConfigError
from blinkgl.io.atomic import refuse_existing
from blinkgl.layouts import export_layout, layout_of
from blinkgl.machine.terminal import plain_console, say
from blinkgl.sequence_files.index import made_folders
from blinkgl.sequence_files.sequence_dir import MANIFEST

SHARDS = "webdataset"


def refuse_early(out: str, layout: str) -> None:
    """Raise ConfigError for an unknown layout, OutputError if ``out`` exists. For exports after hours of other work."""
    if layout != SHARDS:
        layout_of(layout)
    refuse_existing(out)


def run(
    root: str,
    out: str,
    *,
    layout: str | None,
    shard_mb: float | None = None,
    seed: int | None = None,
    quiet: bool = False,
) -> int:
    """Export and print what was written, unless ``quiet``; return 0.

    layout : "webdataset", the default, or one of :data:`~blinkgl.layouts.LAYOUTS`; the others are of
    :func:`~blinkgl.dataset.shards.export_shards`. Raises ConfigError and as the two do."""
    console = plain_console(quiet=quiet)
    layout = layout or SHARDS
    left_out = lambda line: say(console, f"left out: {line}")
    if Path(root).is_dir() and not (Path(root) / MANIFEST).is_file():
        folders = list(made_folders(root))
        for line in guarded(lambda: [*strangers(Path(root), folders), *lost(Path(root), folders)]):
            left_out(line)
    if layout == SHARDS:
        with console.status("writing shards"):
            written = export_shards(
                root, out, shard_bytes=int((shard_mb or 512.0) * 1e6), seed=seed or 0, note=left_out
            )
        for split, counts in written.items():
            shards = f"{len(counts)} shard{'s' * (len(counts) != 1)}"
            say(console, f"{out}/{split}-*.tar: {sum(counts):,} samples in {shards}")
        return 0
    layout_of(layout)  # refuses an unknown layout before the check of options
    for name, value in (("--shard-mb", shard_mb), ("--seed", seed)):
        if value is not None:
            raise ConfigError(f"layout '{layout}' has no shards", where=name, value=value, accepted=f"it with {SHARDS}")
    with console.status(f"writing {layout}"):
        done = export_layout(root, out, layout)
    for line in done.said:
        say(console, line)
    say(console, f"{out}: {done.sequences:,} sequence{'s' * (done.sequences != 1)} for {done.opened_by}")
    return 0
