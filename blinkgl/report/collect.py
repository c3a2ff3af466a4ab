"""The data of the page: a sample of labels for pictures and distributions, and every configuration for the
parameters."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.config.draw import is_distribution
from blinkgl.config.reader import read_table
from blinkgl.dataset.cross_checks import plan_of
from blinkgl.dataset.plan import Plan
from blinkgl.dataset.run_folder import RunFolder
from blinkgl.errors import AssetError, BlinkGLError, ConfigError
from blinkgl.io.flow import read_flow_png
from blinkgl.io.images import read_image
from blinkgl.io.pictures import TrackLines, picture, with_tracks
from blinkgl.io.records import shown
from blinkgl.io.sequence_tables import EXPOSURES, TRACKS, picture_file, read_exposures, read_tracks
from blinkgl.io.times import read_label_times
from blinkgl.labels import LABELS
from blinkgl.machine.heartbeat import heartbeat
from blinkgl.sequence_files.index import data_set, entry, sequence_folders, task_of
from blinkgl.sequence_files.sequence_dir import read_manifest, verify_sequence
from blinkgl.types.trees import Tree

SAMPLED_SEQUENCES, LABELS_EACH, PIXEL_STEP = 150, 3, 8
MAX_CONFIGS = 5000
_FLOW = LABELS["flow_forward"]


@dataclass(eq=False)
class Example:
    """What a sequence's preview does not show of one label: heading and picture, RGB uint8 (H, W, 3)."""

    name: str
    caption: str
    pictures: list[tuple[str, np.ndarray]]


RANGES = ("uniform", "log_uniform", "normal", "integer")
"""Kinds of distributions of numbers between the last two of their parameters."""


@dataclass
class Parameter:
    """A distribution of the recipe, and the values of the sequences."""

    group: str
    path: str
    kind: str
    spec: Any
    values: list[Any]


@dataclass(eq=False)
class Collected:
    """The contents of a data set's page."""

    root: Path
    sequences: list[Tree]
    """Lines of the index, one per camera: a rig's sequence has several."""
    plan: Plan | None
    environment: dict[str, str]
    failed: dict[str, str]
    costs: list[Tree]
    quantities: dict[str, np.ndarray] = field(default_factory=dict)
    examples: list[Example] = field(default_factory=list)
    parameters: list[Parameter] = field(default_factory=list)
    unreadable: list[str] = field(default_factory=list)
    dropped: dict[str, str] = field(default_factory=dict)
    """Sequences that were taken out on purpose."""
    damaged: set[str] = field(default_factory=set)
    """Paths of sequences that differ from their manifests: they are counted, but none of their files is opened."""

    @property
    def simulated_us(self) -> dict[str, int]:
        """Return the simulated time of each sequence, µs, by its folder. Cameras of a rig share it: it counts once."""
        spans: dict[str, int] = {}
        for line in self.sequences:
            spans[task_of(line)] = max(spans.get(task_of(line), 0), line["duration_us"] or 0)
        return spans


def collect(root: str | Path, *, examples: int = 6) -> Collected:
    """Collect the data of the page. Raises AssetError when there is no data set; unreadable sequences are listed."""
    root = data_set(root)
    sequences, unreadable, damaged = [], [], set()
    for number, folder in enumerate(sequence_folders(root), 1):
        heartbeat.at(f"sequence {number:,}")
        try:
            sequences.append(entry(root, folder))
        except BlinkGLError as error:
            unreadable.append(str(error))
            continue
        if problems := verify_sequence(folder, checksums=False):
            damaged.add(sequences[-1]["path"])
            unreadable.append(f"{shown(sequences[-1]['path'])}: {problems[0]}")
    run = RunFolder(root)
    try:
        plan, record, failed = plan_of(root), run.read("run.json") or {}, run.read("failed.json") or {}
    except BlinkGLError as error:
        plan, record, failed = None, {}, {}
        unreadable.append(str(error))
    if not sequences and plan is None:
        raise AssetError("no sequence found", where=str(root), accepted="a folder that 'blinkgl generate' wrote")
    collected = Collected(
        root,
        sequences,
        plan,
        record.get("environment", {}),
        failed,
        run.costs(),
        dropped=run.dropped,
        unreadable=unreadable,
        damaged=damaged,
    )
    rng = np.random.default_rng(0)
    _sample(collected, rng, examples)
    _parameters(collected, rng)
    return collected


def _sample(collected: Collected, rng: np.random.Generator, examples: int) -> None:
    """Collect displacements, speeds, depths and numbers of objects from some labels, and rates from every sequence."""
    values: dict[str, list] = {k: [] for k in ("displacement", "speed", "depth", "objects", "share")}
    collected.quantities["rate"] = np.array(
        [
            1e6 * s["events"] / s["duration_us"] / (s["height"] * s["width"])
            for s in collected.sequences
            if s["duration_us"] and s["events"] is not None
        ]
    )
    collected.quantities["events"] = np.array(
        [s["events"] for s in collected.sequences if s["events"] is not None], float
    )
    order = rng.permutation(len(collected.sequences))[:SAMPLED_SEQUENCES]
    order = [number for number in order if collected.sequences[number]["path"] not in collected.damaged]
    shown = set(_spread(collected.sequences, order, examples))
    for number in order:
        line = collected.sequences[number]
        folder = collected.root / line["path"]
        try:
            flows = sorted((folder / _FLOW.forms[0].folder).glob("*.png"))
            if not flows:
                continue
            pairs = read_label_times(folder / _FLOW.stamps, 2, len(flows))
            picks = sorted(rng.permutation(len(flows))[:LABELS_EACH])
            for k in picks:
                flow, valid = read_flow_png(flows[k])
                # Every few pixels are enough for a distribution.
                displacement = np.hypot(flow[..., 0], flow[..., 1])[::PIXEL_STEP, ::PIXEL_STEP][
                    valid[::PIXEL_STEP, ::PIXEL_STEP]
                ]
                values["displacement"].append(displacement)
                values["speed"].append(displacement / ((pairs[k][1] - pairs[k][0]) * 1e-6))
                if (depth := _value(folder, "depth", flows[k])) is not None:
                    depth = depth[::PIXEL_STEP, ::PIXEL_STEP]
                    values["depth"].append(depth[np.isfinite(depth)])
                if (ids := _value(folder, "ids", flows[k])) is not None:
                    ids, counts = np.unique(ids, return_counts=True)
                    # Objects are numbered from 1.
                    counts = counts[ids > 0]
                    values["objects"].append([len(counts)])
                    values["share"].append(counts / (line["height"] * line["width"]))
            k = picks[len(picks) // 2]
            if number in shown and (pictures := _pictures(folder, line, int(flows[k].stem), pairs[k][0])):
                caption = f"{line['emulator'] or ''}, t = {pairs[k][0] / 1e6:.3f} s"
                collected.examples.append(Example(line["path"], caption, pictures))
        except (BlinkGLError, OSError, ValueError, IndexError) as error:
            collected.unreadable.append(f"{line['path']}: {' '.join(str(error).split())[:160]}")
    collected.examples.sort(key=lambda e: e.name)
    collected.quantities.update({k: np.concatenate(v).astype(float) for k, v in values.items() if v})


def _value(folder: Path, name: str, flow: Path) -> Any:
    """Return a label's content beside a file of flow; None where the sequence has no such label. Raises AssetError."""
    form = LABELS[name].forms[0]
    path = folder / form.file(int(flow.stem))
    return form.read(path) if form.read is not None and path.is_file() else None


def _spread(sequences: list[Tree], order: list[int], count: int) -> list[int]:
    """Choose from each (split, kind of name, emulator) in turn, so that rare kinds appear, too."""
    kinds: dict[tuple, list[int]] = {}
    for number in order:
        s = sequences[number]
        kinds.setdefault((s["split"], s["name"].rpartition("_")[0], s["emulator"]), []).append(int(number))
    chosen: list[int] = []
    while len(chosen) < min(count, len(order)):
        for members in kinds.values():
            if members and len(chosen) < count:
                chosen.append(members.pop(0))
    return chosen


def _pictures(folder: Path, line: Tree, index: int, t_us: int) -> list[tuple[str, np.ndarray]]:
    """Return headings and pictures of the frame camera, the labels but flow, and the tracks at a label's time."""
    file, pictures = folder / LABELS["images"].forms[0].file(index), []
    image = _rgb(read_image(file)) if file.is_file() else None
    if (folder / EXPOSURES).is_file():
        about, exposures = read_manifest(folder)["frame_camera"], read_exposures(folder)
        k = min(range(len(exposures)), key=lambda k: abs(exposures[k].middle_us - t_us))
        for name in about["pictures"]:
            codes = read_image(folder / picture_file(name, k)).astype(np.uint32) >> (about["bits"] - 8)
            title = (
                f"frame camera, {exposures[k].exposure_us / 1000:g} ms" if name == "images" else f"frame camera, {name}"
            )
            pictures.append((title, _rgb(codes.astype(np.uint8))))
    for name, label in LABELS.items():
        form = label.forms[0]
        if name in ("images", _FLOW.name) or form.read is None or not (folder / form.file(index)).is_file():
            continue
        value = form.read(folder / form.file(index))
        if image is not None and (over := label.drawn_on(image, value)) is not None:
            pictures.append((label.heading, over))
        pictures += [
            (view.title, picture(view.kind, view.of(value))[0])
            for view in label.views
            if not (view.kind == "mask" and len(label.views) > 1)
        ]
    if (folder / TRACKS).is_file():
        tracks, size = read_tracks(folder), np.array([line["width"], line["height"]])
        lines = TrackLines(tracks["t_us"], tracks["target_points"], tracks["occluded"], tracks["instance"], size)
        under = np.full((line["height"], line["width"], 3), 24, np.uint8) if image is None else image
        pictures.append((f"point tracks, {len(tracks['instance'])}", with_tracks(under, lines, t_us)))
    return pictures


def _rgb(image: np.ndarray) -> np.ndarray:
    return np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image


# ---- parameters ------------------------------------------------------------------------------------------------------


def _parameters(collected: Collected, rng: np.random.Generator) -> None:
    """Collect every distribution of the recipe with the drawn values of the sequences' config.yaml."""
    if collected.plan is None:
        return
    here = {task_of(s) for s in collected.sequences if s["path"] not in collected.damaged}
    numbers = sorted(n for name in here if (n := collected.plan.tasks.number(name)) is not None)
    tasks = [collected.plan.tasks[numbers[i]] for i in sorted(rng.permutation(len(numbers))[:MAX_CONFIGS])]
    configs: dict[str, list[dict]] = {}
    for task in tasks:
        try:
            configs.setdefault(task.group, []).append(read_table(collected.root / task.name / "config.yaml"))
        except ConfigError as error:
            collected.unreadable.append(f"{task.name}/config.yaml: {error.problem}")
    for group in collected.plan.used:
        _walk(group.name, group.template.tree, (), configs.get(group.name, []), collected.parameters)


def _walk(group: str, node: Any, path: tuple[str, ...], configs: list[dict], into: list[Parameter]) -> None:
    if is_distribution(node):
        # A distribution is a table of one key, its kind.
        kind, spec = next(iter(node.items()))
        values = [v for v in (_at(c, path) for c in configs) if v is not _MISSING]
        if kind in RANGES:
            into.append(Parameter(group, ".".join(path), kind, spec, [v for v in values if v is not None]))
            return
        options = [part["value"] for part in spec] if kind == "shares" else list(spec)
        # Plain options are counted as values; tables are counted by the option that fits, and may hold distributions in
        # turn.
        if all(not isinstance(o, (dict, list)) for o in options):
            into.append(Parameter(group, ".".join(path), kind, spec, values))
            return
        counted: list[object] = []
        for option in options:
            having = [c for c in configs if _fits(_at(c, path), option)]
            counted += [_label(option)] * len(having)
            _walk(group, option, path, having, into)
        labels = [_label(o) for o in options]
        into.append(
            Parameter(
                group,
                ".".join(path),
                kind,
                [{"share": p["share"], "value": la} for p, la in zip(spec, labels)] if kind == "shares" else labels,
                counted,
            )
        )
    elif isinstance(node, dict):
        for key, value in node.items():
            _walk(group, value, (*path, str(key)), configs, into)
    elif isinstance(node, list):
        for i, value in enumerate(node):
            _walk(group, value, (*path, str(i)), configs, into)


def _at(config: object, path: tuple[str, ...]) -> Any:
    for key in path:
        if isinstance(config, list) and key.isdigit() and int(key) < len(config):
            config = config[int(key)]
        elif isinstance(config, dict) and key in config:
            config = config[key]
        else:
            return _MISSING
    return config


_MISSING = object()


def _fits(value: Any, option: Any) -> bool:
    """Return whether a drawn table may come from this option: its plain keys are equal, drawn values are inside their
    range."""
    if is_distribution(option):
        kind, spec = next(iter(option.items()))
        return kind not in RANGES or (isinstance(value, (int, float)) and float(spec[-2]) <= value <= float(spec[-1]))
    if not isinstance(option, dict) or not isinstance(value, dict):
        return isinstance(option, list) or value == option
    return all(key in value and _fits(value[key], inner) for key, inner in option.items())


def _label(option: object) -> str:
    if isinstance(option, dict):
        return str(next((option[tag] for tag in ("emulator", "kind") if tag in option), "; ".join(map(str, option))))
    return str(option)
