"""What must be true of a data set, whoever is asked: the run, the files, verify, the report,
the shards, eflow, explain."""

from __future__ import annotations

import io
import itertools
import json
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from blinkgl.config.sequence import SequenceConfig
from blinkgl.dataset.explain import Explanation
from blinkgl.dataset.report import SequenceReport
from blinkgl.dataset.shards import export_shards
from blinkgl.dataset.verify import verify_dataset
from blinkgl.io.dsec import DsecEventReader
from blinkgl.io.flow import read_flo, read_flow_png
from blinkgl.io.sequence_tables import read_exposures
from blinkgl.labels import LABELS, asked_for
from blinkgl.report.collect import collect
from blinkgl.report.page import write_report
from blinkgl.sequence_files.index import read_index
from blinkgl.sequence_files.sequence_dir import read_manifest
from blinkgl.types.events import Events, count_causes, named_causes

LEFT_OUT = {label.heading: label.forms[0].folder + "/" for label in LABELS.values()} | {
    "occlusion masks": "occlusion/",
    "preview": "preview.mp4",
}
"""What explain says is left out -> how the names of its files would begin."""


class Findings(list):
    """Lines of disagreement; empty when all agree."""

    def expect(self, true: bool, what: str) -> None:
        if not true:
            self.append(what)

    def same(self, what: str, **values: Any) -> None:
        """All the values, each under the name of who says so, are equal."""
        if len({json.dumps(v, sort_keys=True, default=str) for v in values.values()}) > 1:
            self.append(f"{what}: " + ", ".join(f"{k} {v}" for k, v in values.items()))


def of_data_set(out: Path, made: dict[str, SequenceReport], scratch: Path) -> Findings:
    """The run's reports against the files, and every reader of the data set against the others."""
    found = Findings()
    verified = verify_dataset(out, deep=len(made))
    found.expect(verified.clean and not verified.notes, f"verify: {verified.problems} {verified.notes}")
    found.same(
        "sequences", run=sorted(made), verify=sorted(verified.deep), index=[line["path"] for line in read_index(out)]
    )
    page = write_report(out, scratch / "report.html", overwrite=True)
    told = collect(out)
    found.expect(
        page.stat().st_size > 1000 and not told.unreadable and not told.failed,
        f"report: {told.unreadable} {told.failed}",
    )
    found.same("index", report=told.sequences, index=read_index(out))
    found.expect(verify_dataset(out).clean, "verify after the report")
    lines, costs = {line["path"]: line for line in told.sequences}, {line["name"]: line for line in told.costs}
    for name, report in made.items():
        manifest = read_manifest(out / name)
        for key in ("events", "labels", "frames"):
            found.same(
                f"{name}: {key}",
                run=getattr(report, key),
                manifest=manifest[key],
                index=lines[name][key],
                costs=costs[name][key],
            )
        found += [f"{name}: {line}" for line in of_sequence(out / name, manifest)]
    rates = [1e6 * line["events"] / line["duration_us"] / (line["height"] * line["width"]) for line in told.sequences]
    found.expect(np.allclose(told.quantities["rate"], rates), "report: event rates")
    found += _readers(out, scratch / "shards")
    return found


def of_sequence(folder: Path, manifest: dict[str, Any]) -> Findings:
    """Events against manifest and configuration; the forms of flow against each other."""
    found = Findings()
    config = SequenceConfig.model_validate(yaml.safe_load((folder / "config.yaml").read_text()))
    end = manifest["t_offset_us"] + manifest["duration_us"]
    with DsecEventReader(folder / "events.h5") as reader:
        chunks = list(reader.chunks())
        count = sum(map(len, chunks))
        found.same(
            "events",
            manifest=manifest["events"],
            file=count,
            window=len(reader.slice(manifest["t_offset_us"], end + 1)),
        )
        found.expect(count > 0, "no events: the row says nothing")
        found.expect(
            all((c.t >= manifest["t_offset_us"]).all() and (c.t <= end).all() for c in chunks),
            "events outside the recording",
        )
    asked = getattr(config.events, "causes", False)
    found.same("causes", asked=asked, manifest="events_by_cause" in manifest)
    found.expect(all((c.cause is not None) == asked for c in chunks), "causes in the file, or not, against the wish")
    if asked and chunks:
        by_cause = named_causes(count_causes(Events.concatenate(chunks)))
        found.same("events by cause", file=by_cause, manifest=manifest["events_by_cause"])
    lost = manifest["events_lost_in_readout"] + manifest["events_late_in_readout"]
    behind = config.readout
    if behind is not None and behind.pixels is not None:
        pass  # events are under way at the end, dropped, or more than the emulator made
    elif behind is None or behind.events_per_second is None or behind.events_per_second >= 1e6:
        found.expect(lost == 0, f"{lost} events lost without a limit")
    else:
        found.expect(
            lost > 0 or 2e6 * count < behind.events_per_second * manifest["duration_us"],
            "a slow bus loses nothing",
        )
    if config.images is not None:
        lines, about = read_exposures(folder), manifest["frame_camera"]
        found.same(
            "frame camera",
            manifest=about["images"],
            exposures=len(lines),
            files=[len(list((folder / "frame_camera" / name).glob("*.png"))) for name in about["pictures"]][0],
            times=len(config.images.times) if config.images.times is not None else len(lines),
        )
        found.same("pictures", manifest=about["pictures"], configuration=list(config.images.pictures))
        found.expect(
            all(manifest["t_offset_us"] <= e.start_us < e.end_us <= end + 1 for e in lines), "an exposure outside"
        )
    found.expect((config.images is not None) == (folder / "frame_camera").is_dir(), "frame camera, or none")
    for direction in ("forward", "backward"):
        for path in sorted((folder / f"flow/{direction}").glob("*.png")):
            flow, valid = read_flow_png(path)
            if (npy := folder / f"flow/{direction}_npy/{path.stem}.npy").is_file():
                exact = np.load(npy)
                found.expect(
                    np.abs(exact[..., :2] - flow)[valid].max(initial=0) <= 0.5 / 128 + 1e-5,
                    f"{npy.name}: PNG and npy differ",
                )
            if (flo := folder / f"flow/{direction}_flo/{path.stem}.flo").is_file():
                found.expect(
                    np.abs(read_flo(flo)[0] - flow)[valid].max(initial=0) <= 0.5 / 128 + 1e-5,
                    f"{flo.name}: PNG and flo differ",
                )
    return found


def _readers(out: Path, shards: Path) -> Findings:
    """export and eflow give the same samples, and between them all events of every sequence with labels."""
    from eflow.data.sources import open_source

    found = Findings()
    written = export_shards(out, shards)
    samples: dict[str, dict[str, Any]] = {}
    for path in sorted(shards.glob("*.tar")):
        with tarfile.open(path) as tar:
            for member in tar:
                key, _, ending = member.name.partition(".")
                samples.setdefault(key, {})[ending] = tar.extractfile(member).read()
    source = open_source(out)
    found.same("labels", export=sum(map(sum, written.values())), tar=len(samples), eflow=len(source))
    seen: dict[Path, set[tuple[int, int]]] = {}
    total: dict[Path, int] = {}
    for number in range(len(source)):
        sequence, entry = source.entry(number)
        given, shard = source[number], samples[f"{sequence.events.parent.name}_{entry.index:06d}"]
        about = json.loads(shard["json"])
        found.same(
            f"{given.name}: interval", eflow=[entry.from_us, entry.to_us], export=[about["from_us"], about["to_us"]]
        )
        for which, window in (("old", given.old), ("new", given.new)):
            with np.load(io.BytesIO(shard[f"{which}.npz"]), allow_pickle=False) as columns:
                found.expect(
                    all(np.array_equal(columns[k], getattr(window, k)) for k in "xytp"), f"{given.name}: {which} window"
                )
            spans = seen.setdefault(sequence.events, set())
            if (window.t0, window.t1) not in spans:
                spans.add((window.t0, window.t1))
                total[sequence.events] = total.get(sequence.events, 0) + len(window)
        found.expect(
            given.flow.shape == (given.height, given.width, 2) and np.isfinite(given.flow).all(), f"{given.name}: flow"
        )
    for events, count in total.items():
        manifest = read_manifest(events.parent)
        spans, end = sorted(seen[events]), manifest["t_offset_us"] + manifest["duration_us"]
        whole = spans[0][0] <= manifest["t_offset_us"] and all(
            b[0] - a[1] in (0, -1) for a, b in itertools.pairwise(spans)
        )
        with DsecEventReader(events) as reader:
            last = len(reader.slice(end, end + 1))
            twice = sum(len(reader.slice(b[0], a[1])) for a, b in itertools.pairwise(spans))
        if whole and spans[-1][1] == end:
            found.same(f"{events.parent.name}: all windows", eflow=count - twice + last, manifest=manifest["events"])
    return found


def of_explanation(told: Explanation, config: SequenceConfig, report: SequenceReport) -> Findings:
    """What explain said before the run, against what the run made."""
    found = Findings()
    manifest = read_manifest(report.path)
    files, passes = manifest["files"], {p.name: p for p in told.passes}
    out = dict(told.left_out)
    recorded = config.frames is not None  # which have no scene, and so none of the labels that are computed from one
    for what, prefix in LEFT_OUT.items():
        if recorded and what not in ("images", "forward flow", "occlusion masks", "preview"):
            found.expect(not any(name.startswith(prefix) for name in files), f"frames: {prefix} are there")
            continue
        there = any(name.startswith(prefix) for name in files)
        found.expect(
            there != (what in out),
            f"explain: {what} {'is' if what in out else 'is not'} left out, files {'are' if there else 'are not'} "
            "there",
        )
    found.expect(("the sensor's read-out" in out) == (config.readout is None), "explain: read-out")
    if recorded:
        found.same(
            "emulator", explain=passes["frames and event kernel"].why.split("; ")[-2], manifest=manifest["emulator"]
        )
        found.same(
            "size", explain=told.scene["frames"].split(", ")[1], manifest=f"{manifest['width']}x{manifest['height']}"
        )
        found.same("event frames", explain=told.frames, manifest=manifest["frames"])
        return found
    count = lambda prefix, ending: sum(n.startswith(prefix) and n.endswith(ending) for n in files)
    events = next(p for name, p in passes.items() if name.startswith("event frames"))
    wanted = asked_for(config.labels).without("images")
    found.same("images", explain=passes["colour"].count if "colour" in passes else 0, files=count("images/", ".png"))
    found.same(
        "labels",
        explain=passes["labels"].count if "labels" in passes else 0,
        manifest=manifest["labels"] if wanted else 0,
    )
    found.same(
        "frame camera",
        explain=passes["frame camera"].count if "frame camera" in passes else 0,
        files=count("frame_camera/images/", ".png"),
    )
    found.same("preview", explain="preview" in passes, files="preview.mp4" in files)
    found.same("triangles", explain=told.scene["triangles"].split()[0], manifest=f"{manifest['triangles']:,}")
    found.expect(
        told.scene["camera"].startswith(f"{manifest['width']}x{manifest['height']},"),
        f"explain: camera {told.scene['camera']}",
    )
    found.same("emulator", explain=passes["event kernel"].why.split(";")[0], manifest=manifest["emulator"])
    found.same("timeline", explain=events.why.split()[1].strip(","), manifest=manifest["timeline"]["kind"])
    if config.timeline.kind == "uniform":
        found.same("event frames", explain=told.frames, manifest=manifest["frames"])
    else:
        # An estimate, from the pace at a few moments of a clip of 40 ms.
        low, high = sorted((told.frames, manifest["frames"]))
        found.expect(
            high <= 10 + 6 * low,
            f"event frames: explain {told.frames}, made {manifest['frames']}",
        )
    for what, off in (
        ("anisotropic filtering", config.render.anisotropy == 1),
        ("anti-aliasing of event frames", config.render.antialiasing == "none"),
    ):
        found.expect((what in out) == off, f"explain: {what}")
    return found
