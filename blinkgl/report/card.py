"""A data set described for those who find it: ``README.md`` with the card of a data hub, made from the files alone."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from blinkgl.config.reader import to_yaml
from blinkgl.errors import AssetError
from blinkgl.io.atomic import atomic_file, output_errors
from blinkgl.labels import LABELS
from blinkgl.report.charts import number, size
from blinkgl.report.collect import Collected, collect, task_of
from blinkgl.sequence_files.index import write_index
from blinkgl.sequence_files.sequence_dir import read_manifest

CARD = "README.md"
_SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))
_REMARK = (
    "`events.h5` is packed with Blosc: `import hdf5plugin` before h5py opens it. Times are µs on one clock; windows "
    "are half open. `config.yaml` of a sequence makes it again (`blinkgl generate`), `manifest.json` has its checksums."
)


@dataclass(frozen=True)
class Fact:
    """name, unit : in words.   value : what was measured of the data set."""

    name: str
    value: float
    unit: str


def write_card(root: str | Path, *, licence: str | None = None, url: str | None = None) -> Path:
    """Writes the card and ``index.jsonl`` into the data set and returns the card's path. licence : an SPDX name, such
    as "cc-by-4.0"; url : where the data set is to be found.

    Raises AssetError: no data set, or a README.md that is not ours; OutputError."""
    root = Path(root)
    found = collect(root, examples=0)
    card = root / CARD
    if card.exists() and "blinkgl" not in _head(card):
        raise AssetError("a page that BlinkGL did not write", where=str(card), accepted="it under another name")
    write_index(root)
    with atomic_file(card) as temporary, output_errors(card):
        temporary.write_text(card_of(found, facts_of(found), licence, url), encoding="utf-8")
    return card


def facts_of(found: Collected) -> list[Fact]:
    """Rates, displacements and event density, of every sequence or of the sample that reports look at."""
    cameras = [s for s in found.sequences if s["duration_us"]]
    # Rates are of one camera: two that see a second make twice the events.
    seconds = sum(s["duration_us"] for s in cameras) / 1e6
    simulated_us = found.simulated_us
    facts = [
        Fact("simulated time", sum(simulated_us.values()) / 1e6, "s"),
        Fact("sequences", len(simulated_us), ""),
        Fact("cameras", len(found.sequences), ""),
    ]
    if not cameras:
        return facts
    labels, frames = (sum(s[key] or 0 for s in cameras) for key in ("labels", "frames"))
    rate = found.quantities.get("rate", np.zeros(0))
    facts += [
        # A sequence begins an interval before its first label.
        Fact("labels a second", (labels + len(cameras)) / seconds, "Hz"),
        Fact("frames rendered a second", frames / seconds, "Hz"),
        Fact("events", sum(s["events"] or 0 for s in cameras), ""),
        Fact("events a second", sum(s["events"] or 0 for s in cameras) / seconds, "1/s"),
    ]
    if len(rate):
        facts += [Fact(f"events a pixel and second, {w}", v, "1/s") for w, v in _spread(rate)]
        per_label = rate * seconds / max(labels + len(cameras), 1)
        facts.append(Fact("events a pixel and label interval, mean", float(per_label.mean()), ""))
    for key, name, unit in (
        ("displacement", "flow over a label interval", "px"),
        ("speed", "image speed", "px/s"),
        ("depth", "depth", "world units"),
        ("objects", "objects in view", ""),
    ):
        if len(values := found.quantities.get(key, np.zeros(0))):
            facts += [Fact(f"{name}, {w}", v, unit) for w, v in _spread(values)]
    speed = found.quantities.get("speed", np.zeros(0))
    if len(rate) and len(speed) and np.median(speed) > 0:
        facts.append(Fact("events a pixel and px of flow", float(np.median(rate) / np.median(speed)), "1/px"))
    return facts


def _spread(values: np.ndarray) -> list[tuple[str, float]]:
    return [
        (name, float(np.percentile(values, share)))
        for name, share in (("10th percentile", 10), ("median", 50), ("90th percentile", 90))
    ]


def card_of(found: Collected, facts: list[Fact], licence: str | None, url: str | None) -> str:
    """The Markdown page, with the table of keys that data hubs read at its top."""
    name = found.root.resolve().name
    total = sum(s["labels"] or 0 for s in found.sequences)
    head = {
        **({} if licence is None else {"license": licence}),
        "pretty_name": name,
        "tags": ["event-camera", "optical-flow", "synthetic", "simulation", "blinkgl"],
        "size_categories": [next((text for limit, text in _SIZES if total < limit), "n>1M")],
    }
    splits = Counter(s["split"] for s in found.sequences)
    lines = ["---", to_yaml(head).rstrip(), "---", f"# {name}", ""]
    lines += [
        "Events of simulated cameras with exact ground truth, rendered by BlinkGL.",
        *(() if url is None else ("", url)),
        "",
        "| split | sequences | cameras | sizes | emulators |",
        "|---|---|---|---|---|",
    ]
    for split in sorted(splits, key=str):
        those = [s for s in found.sequences if s["split"] == split]
        sizes = ", ".join(sorted({f"{s['width']}x{s['height']}" for s in those}))
        emulators = ", ".join(sorted({str(s["emulator"]) for s in those}))
        made = len({task_of(s) for s in those})
        lines.append(f"| {split} | {made:,} | {len(those):,} | {sizes} | {emulators} |")
    lines += ["", "| measured | | |", "|---|---|---|"]
    lines += [f"| {f.name} | {number(f.value)} | {f.unit} |" for f in facts]
    lines += ["", f"On disk {size(sum(s['bytes'] for s in found.sequences))}. " + _licence(licence), "", "## Files", ""]
    lines += ["| below each sequence | what |", "|---|---|"]
    lines += [f"| `{pattern}` | {what} |" for pattern, what in _files(found)]
    lines += [
        "",
        _REMARK,
        "",
        "```python",
        "import h5py",
        "import hdf5plugin  # registers Blosc",
        "",
        f'with h5py.File("{_first(found)}/events.h5") as file:',
        '    t = file["events/t"][:].astype("i8") + file["t_offset"][()]  # µs',
        "```",
        "",
        "Percentiles of displacement, speed and depth are of a sample of labels; rates of every sequence.",
    ]
    return "\n".join(lines) + "\n"


_OTHERS = {
    "events.h5": "events/{x,y,p,t}, t µs relative to t_offset; ms_to_idx; Blosc (`import hdf5plugin`)",
    "event_labels.h5": "what made each event; Blosc (`import hdf5plugin`)",
    "poses.npz": "poses of camera and objects, intrinsics",
    "tracks.npz": "points on surfaces, followed (TAP-Vid's arrays)",
    "imu/imu.csv": "an inertial unit, EuRoC's columns",
    "manifest.json": "checksums, versions, seed",
    "config.yaml": "every value as drawn",
}


def _files(found: Collected) -> list[tuple[str, str]]:
    """(pattern below a sequence, what it is) of the kinds of files that the sequences have."""
    names: set[str] = {"manifest.json"}
    for line in found.sequences:
        names |= set(read_manifest(found.root / line["path"])["files"])
    kinds = [(file, what) for file, what in _OTHERS.items() if file in names]
    for label in LABELS.values():
        for form in label.forms:
            if any(form.holds(name) for name in names):
                kinds.append((f"{form.folder}/*.{form.ending}", label.about))
    return kinds


def _first(found: Collected) -> str:
    return found.sequences[0]["path"] if found.sequences else "train/sequence_000000"


def _licence(licence: str | None) -> str:
    return "No licence is stated." if licence is None else f"Licence: {licence}."


def _head(path: Path) -> str:
    with output_errors(path), open(path, encoding="utf-8", errors="replace") as file:
        return file.read(2000)
