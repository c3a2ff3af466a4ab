"""A data set as WebDataset shards: plain tar files, read from front to back, for training from object storage.

One sample per flow label, its files side by side under one key:

    flying_000017_000003.json        sequence, times in µs, size, emulator, seed; K (3x3), near and T_world_cam (4x4)
                                     where poses are known
    flying_000017_000003.old.npz     events of the interval before the label: x, y uint16, t int64 µs, p uint8; with
                                     labels.events also instance, depth and velocity of what made them, light
    flying_000017_000003.new.npz     events of the label's interval [from, to)
    flying_000017_000003.flow.png    DSEC 16-bit flow; also back.png, image.png, depth.npy, ids.png … where the data set
                                     has them: every label whose row names a ``shard``, in each form that is a file of
                                     its own (flow.npy, flow.flo)
    flying_000017_000003.camera.png  of a frame camera its last image whose exposure was over at the label's time, and
                                     beside it camera_sharp.png and camera_clean.png; its exposure stands in the json

The same data set, seed and shard size give the same bytes.
"""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np

from blinkgl.errors import AssetError, OutputError
from blinkgl.io.atomic import atomic_folder, output_errors, refuse_existing
from blinkgl.io.dsec import DsecEventReader
from blinkgl.io.event_labels import EVENT_LABELS, EventLabelsReader, with_truth
from blinkgl.io.records import named, shown
from blinkgl.io.sequence_tables import EXPOSURES, POSES, ExposureLine, picture_file, read_exposures, read_poses
from blinkgl.io.times import read_label_times
from blinkgl.labels import LABELS
from blinkgl.machine.heartbeat import heartbeat
from blinkgl.sequence_files.index import data_set, sequence_folders
from blinkgl.sequence_files.sequence_dir import read_manifest, whole
from blinkgl.types.events import TOLD, Events
from blinkgl.types.trees import Tree

_FLOW = LABELS["flow_forward"]
"""The label that makes a sample; without it there is none."""


def export_shards(
    root: str | Path,
    out: str | Path,
    *,
    shard_bytes: int = 512_000_000,
    seed: int = 0,
    note: Callable[[str], None] = lambda line: None,
) -> dict[str, list[int]]:
    """Write ``<out>/<split>-000000.tar`` …, all or none; return the samples per shard of each split.

    Labels are in a random order (``seed``) over all sequences of a split, since shards are read sequentially.
    note : called with a line for each sequence that is left out. Raises
    AssetError (no labels, a damaged sequence), OutputError (an existing folder, two sequences of one key, disk
    full)."""
    out = Path(out)
    refuse_existing(out)
    root = data_set(root)
    labels: dict[str, list[tuple[Path, int]]] = {}
    keys: dict[tuple[str, str], Path] = {}
    for number, folder in enumerate(sequence_folders(root), 1):
        heartbeat.at(f"sequence {number:,}")
        manifest = whole(folder)
        # A frame camera of a rig may have labels; its samples would have no events.
        lacks = "events" if "events.h5" not in manifest["files"] else "forward flow"
        count = 0 if lacks == "events" else sum(map(_FLOW.forms[0].holds, manifest["files"]))
        split = manifest.get("split") or "all"
        labels.setdefault(split, []).extend((folder, k) for k in range(count))
        if not count:
            note(f"{shown(folder.relative_to(root))}: no {lacks}")
        elif (other := keys.setdefault((split, _called(folder, manifest)), folder)) != folder:
            raise OutputError(
                "two sequences would have the same keys", where=str(other), value=str(folder), accepted="other names"
            )
    if not any(labels.values()):
        raise AssetError("no flow labels found", where=str(root), accepted="a folder that 'blinkgl generate' wrote")
    written = {}
    with atomic_folder(out) as folder:
        for split, entries in sorted(labels.items()):
            # Readers stream a shard from its beginning, so neighbours must not be of one sequence.
            order = np.random.default_rng(seed).permutation(len(entries))
            written[split] = _write(folder, split, (entries[i] for i in order), shard_bytes)
    return written


def _write(out: Path, split: str, entries: Iterator[tuple[Path, int]], shard_bytes: int) -> list[int]:
    counts: list[int] = []
    pending = next(entries, None)
    while pending is not None:
        path = out / f"{split}-{len(counts):06d}.tar"
        with output_errors(path):
            counts.append(0)
            with tarfile.open(path, "w") as shard:
                while pending is not None and (counts[-1] == 0 or shard.offset < shard_bytes):
                    for name, data in sample(*pending):
                        # Owner, mode and time keep their defaults: the bytes do not depend on the date.
                        member = tarfile.TarInfo(name)
                        member.size = len(data)
                        # USTAR's headers hold 100 bytes of a name.
                        shard.format = tarfile.USTAR_FORMAT if len(name.encode()) <= 100 else tarfile.PAX_FORMAT
                        shard.addfile(member, io.BytesIO(data))
                    counts[-1] += 1
                    pending = next(entries, None)
    return counts


def _called(folder: Path, manifest: Tree) -> str:
    """Return what keys say of a sequence: its name, of a rig's camera with the rig's before it."""
    own = named(folder)
    return own.name if "sensor" not in manifest else f"{named(own.parent).name}-{own.name}"


def sample(folder: Path, k: int) -> Iterator[tuple[str, bytes]]:
    """Yield (member name, bytes) of the ``k``-th label of a sequence."""
    manifest = read_manifest(folder)
    called = _called(folder, manifest)
    key = f"{called}_{k:06d}"
    count = sum(map(_FLOW.forms[0].holds, manifest["files"]))
    start, end = read_label_times(folder / str(_FLOW.stamps), 2, count)[k]
    about: dict[str, object] = {
        "sequence": called,
        "label": k,
        "from_us": start,
        "to_us": end,
        "height": manifest["height"],
        "width": manifest["width"],
        "emulator": manifest.get("emulator"),
        "seed": manifest.get("seed"),
        **({"class": manifest["class"]} if "class" in manifest else {}),
    }
    about.update(_camera(folder, manifest, start))
    taken = _last_image(folder, manifest, start)
    if taken is not None:
        about["camera"] = {"image": taken[0], **asdict(taken[1])}
    told: tuple[str, ...] = ()
    with DsecEventReader(folder / "events.h5", size=(manifest["height"], manifest["width"])) as reader:
        # The interval before the label is as long as the label's own.
        windows = {"old": reader.slice(2 * start - end, start), "new": reader.slice(start, end)}
        if EVENT_LABELS in manifest["files"]:
            first = reader.number(2 * start - end), reader.number(start)
            windows = {name: with_truth(one, k, folder) for (name, one), k in zip(windows.items(), first)}
            with EventLabelsReader(folder) as labels:
                told = (*TOLD, "light") if labels.lights else TOLD
    yield f"{key}.json", json.dumps(about, sort_keys=True).encode()
    for name, events in windows.items():
        yield f"{key}.{name}.npz", _npz(events, told)
    for label in sorted(
        (label for label in LABELS.values() if label.shard), key=lambda label: (label is not _FLOW, label.shard)
    ):
        for form in label.forms:
            if form.file(k) in manifest["files"]:
                name = str(label.shard).rpartition(".")[0]
                read = form if form.read is not None else label.forms[0]
                value = label.read(folder / read.file(k), read, manifest["height"], manifest["width"])
                data: bytes | tuple[bytes, int] = (folder / form.file(k)).read_bytes()
                # An archive may hold more than was read.
                if form.encode is not None and (form is not read or form.ending == "npz"):
                    data = form.encode(value)
                yield f"{key}.{name}.{form.ending}", data if isinstance(data, bytes) else data[0]
    if taken is None:
        return
    for picture in manifest["frame_camera"]["pictures"]:
        ending = "camera.png" if picture == "images" else f"camera_{picture}.png"
        path, image = folder / picture_file(picture, taken[0]), LABELS["images"]
        image.read(path, image.forms[0], manifest["height"], manifest["width"])
        yield f"{key}.{ending}", path.read_bytes()


def _camera(folder: Path, manifest: Tree, t_us: int) -> Tree:
    """Return intrinsics, and the camera's pose at a label's time; nothing where a sequence has no poses."""
    if POSES not in manifest["files"]:
        return {}
    poses = read_poses(folder / POSES)
    # The pose whose microsecond is nearest to the label's.
    T_world_cam = poses["T_world_cam"][int(np.argmin(np.abs(poses["t_ns"] // 1000 - t_us)))]
    return {"K": poses["K"].tolist(), "near": float(poses["near"]), "T_world_cam": T_world_cam.tolist()}


def _last_image(folder: Path, manifest: Tree, t_us: int) -> tuple[int, ExposureLine] | None:
    """Return number and exposure of the frame camera's last image complete at ``t_us``; None: there was none."""
    if EXPOSURES not in manifest["files"]:
        return None
    there = [(k, line) for k, line in enumerate(read_exposures(folder)) if line.end_us <= t_us]
    return there[-1] if there else None


def _npz(events: Events, told: tuple[str, ...]) -> bytes:
    buffer = io.BytesIO()
    columns = {k: getattr(events, k) for k in events.columns if k != "truth"}
    if events.truth is not None:
        columns.update({k: events.truth[k] for k in told})
    np.savez_compressed(buffer, **columns)
    return buffer.getvalue()
