"""Runs from Python: a YAML file or a :class:`~blinkgl.front.scenes.Scene` in, a data set out."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from blinkgl.config.base import Config, validate_field
from blinkgl.config.draw import middle
from blinkgl.config.recipe import merge
from blinkgl.config.recipes import with_recipes
from blinkgl.config.sequence import RunTemplate, SequenceConfig, load_run, with_sensors
from blinkgl.errors import ConfigError
from blinkgl.front import arguments as check
from blinkgl.front.scenes import Scene
from blinkgl.labels import LABELS

if TYPE_CHECKING:
    from blinkgl.dataset.run import Outcome
    from blinkgl.dataset.verify import Verification
    from blinkgl.scene.types import Scene as SceneData

MAX_INDEX = 10_000_000
Source = Scene | RunTemplate
EmulatorSettings = str | Mapping[str, Any] | Config
ImageSettings = str | Mapping[str, Any] | Config
ImuSettings = str | Mapping[str, Any] | Config
TrackSettings = str | Mapping[str, Any] | Config


class Timeline:
    """When frames are drawn for the emulator: ``Timeline("displacement", max_px=0.5)``.

    kind : "uniform" (fps, Hz), "displacement" (max_px, px), "brightness" (max_fraction_of_threshold) or "budget"
    (max_time_error_us or max_time_error_px). values : keys of that kind, and ``reconstruction``;
    see ``timeline:`` in docs/configuration.md.
    Raises ConfigError."""

    def __init__(self, kind: str = "displacement", **values: Any):
        self.tree = {"kind": check.plain(kind), **check.plain(values)}
        try:
            validate_field(SequenceConfig, "timeline", self.tree)
        except ConfigError as error:
            where = (error.where or "timeline").replace("timeline", "Timeline", 1)
            raise ConfigError(error.problem, where=where, value=error.value, accepted=error.accepted) from None

    def __repr__(self) -> str:
        return f"Timeline({', '.join(f'{k}={v!r}' for k, v in self.tree.items())})"


def load(path: str | os.PathLike, overrides: Sequence[str] = (), *, seed: int | None = None) -> RunTemplate:
    """The run that a YAML file describes, checked: what :func:`generate`, :func:`record`, :func:`render_frame` take.

    overrides : "path.to.key=value", as ``--set``.   seed : instead of the file's.
    ``load(path).sequence(3)`` is the configuration of sequence 3, every value drawn.
    Raises ConfigError: missing file, bad YAML (with line and column), unknown key, bad value."""
    overrides = list(check.one_of(overrides, "overrides", (list, tuple), "a list of texts"))
    for text in overrides:
        check.one_of(text, "overrides", str, "path.to.key=value")
    return load_run(check.path(path, "path"), overrides, seed=None if seed is None else check.seed(seed))


def generate(
    source: Source,
    out: str | os.PathLike,
    *,
    num: int | None = None,
    workers: int = 1,
    resume: bool = False,
    emulator: EmulatorSettings | None = None,
    sensor: str | None = None,
    timeline: Timeline | None = None,
    quality: str | None = None,
    labels: Sequence[str | float] | None = None,
    images: ImageSettings | None = None,
    imu: ImuSettings | None = None,
    tracks: TrackSettings | None = None,
) -> Outcome:
    """Makes a data set below the folder ``out``, as ``blinkgl generate`` does: the same files, bit for bit.

    source : :class:`Scene` or what :func:`load` gave.   num : how many sequences (of each group at
    most).   workers : processes; 1: this one.
    resume : go on where ``out`` holds sequences of this run.   emulator, sensor, timeline,
    quality, labels, images, imu, tracks : as of :func:`record`.
    Returns what was made (``made.events``, ``made.labels`` …) and what was set aside.
    Raises BlinkGLError: ConfigError (also a scene with arrays in it: save them to files
    first), AssetError, GLError, OutputError."""
    from blinkgl.dataset.executor import Inline, Local
    from blinkgl.dataset.run import run_dataset

    template = configured(
        source,
        emulator=emulator,
        sensor=sensor,
        timeline=timeline,
        quality=quality,
        labels=labels,
        images=images,
        imu=imu,
        tracks=tracks,
    )
    if isinstance(source, Scene) and not source.on_disk:
        raise ConfigError(
            "the scene holds arrays, which the data set could not be made from again",
            where="source",
            value=source,
            accepted="meshes and images in files, or record()",
        )
    num = None if num is None else check.whole(num, "num", 1, 10_000_000)
    executor = Inline() if check.whole(workers, "workers", 1, 1024) == 1 else Local(workers)
    template.check()
    return run_dataset(template, check.path(out, "out"), executor, num=num, resume=bool(resume))


def verify(folder: str | os.PathLike, *, deep: int = 0, seed: int = 0) -> Verification:
    """Looks through a data set; ``.clean`` says whether all is well, ``.problems`` what is not, by sequence.

    deep : so many sequences are made again and compared.   seed : draws which. Raises AssetError: no data set there."""
    from blinkgl.dataset.verify import verify_dataset

    return verify_dataset(check.path(folder, "folder"), deep=check.whole(deep, "deep", 0, 2**31), seed=check.seed(seed))


def configured(
    source: Source,
    *,
    emulator: EmulatorSettings | None = None,
    sensor: str | None = None,
    timeline: Timeline | None = None,
    quality: str | None = None,
    labels: Sequence[str | float] | None = None,
    images: ImageSettings | None = None,
    imu: ImuSettings | None = None,
    tracks: TrackSettings | None = None,
) -> RunTemplate:
    """``source`` as a run, with what is given here laid over it. Raises ConfigError."""
    check.one_of(source, "source", (Scene, RunTemplate), "a Scene, or what load() gives")
    template = source.template() if isinstance(source, Scene) else source
    own: dict[str, Any] = check.given(sensor=sensor, quality=quality)
    if emulator is not None:
        own["events"] = events_tree(emulator)
    if timeline is not None:
        own["timeline"] = check.one_of(timeline, "timeline", Timeline, "a Timeline").tree
    if labels is not None:
        own["labels"] = labels_tree(labels)
    if images is not None:
        own["images"] = images_tree(images)
    if imu is not None:
        own["imu"] = section_tree(
            "imu", imu, "preset", "an inertial unit", "a preset's name, or a table such as {'rate': 400}"
        )
    if tracks is not None:
        own["tracks"] = section_tree(
            "tracks", tracks, "choose", "point tracks", "grid, random, surface, or a table such as {'points': 100}"
        )
    own = with_recipes(with_sensors(own, Path.cwd()))
    if "quality" in own:
        validate_field(SequenceConfig, "quality", own["quality"])
    if "sensor" in own:
        validate_field(SequenceConfig, "sensor", middle(own["sensor"]))
    return RunTemplate(merge(template.tree, own), template.base) if own else template


def scene_of(source: Source, config: SequenceConfig, index: int) -> SceneData:
    """What sequence ``index`` shows. Raises ConfigError and AssetError."""
    if isinstance(source, Scene):
        return source.build(config)
    from blinkgl.scene.build import sequence_scene

    return sequence_scene(config, index, source.base)


def events_tree(emulator: EmulatorSettings) -> dict[str, Any]:
    """``events:`` of a name, a table with ``emulator``, or a configuration. Raises ConfigError."""
    from blinkgl.recordings.simulation import emulator_config

    if not isinstance(emulator, (str, Mapping, Config)):
        raise ConfigError(
            "not an emulator",
            where="emulator",
            value=emulator,
            accepted="a name, or a table such as {'emulator': 'v2e', 'cutoff_hz': 200}",
        )
    tree = (
        emulator.model_dump()
        if isinstance(emulator, Config)
        else {"emulator": emulator}
        if isinstance(emulator, str)
        else check.plain(emulator)
    )
    emulator_config(tree)
    return tree


def images_tree(images: ImageSettings) -> dict[str, Any]:
    """``images:`` of a preset's name, a table, or a configuration. Raises ConfigError."""
    return section_tree(
        "images",
        images,
        "preset",
        "a frame camera",
        "a preset's name, or a table such as {'exposure_us': 10000, 'photon_noise': True}",
    )


def section_tree(key: str, given: Any, named: str, what: str, accepted: str) -> dict[str, Any]:
    """A section of a configuration of a table, a configuration, or a text, which is its key ``named``.
    Raises ConfigError."""
    if not isinstance(given, (str, Mapping, Config)):
        raise ConfigError(f"not {what}", where=key, value=given, accepted=accepted)
    tree = (
        given.model_dump(exclude_unset=True)
        if isinstance(given, Config)
        else {named: given}
        if isinstance(given, str)
        else check.plain(given)
    )
    validate_field(SequenceConfig, key, tree)
    return tree


OF_EVENTS = ("events",)
"""Labels that are of events and not of a time."""


def label_names(labels: Sequence[str | float]) -> set[str | float]:
    """Names, and intervals of flow, s. Raises ConfigError: no such label (:mod:`blinkgl.labels`)."""
    known = [*dict.fromkeys(label.said for label in LABELS.values()), *OF_EVENTS]
    wanted = check.one_of(labels, "labels", (list, tuple, set, frozenset), "a list of names of labels")
    for name in wanted:
        if name not in known and not is_interval(name):
            raise ConfigError("unknown label", where="labels", value=name, accepted=", ".join(known))
    return set(wanted)


def is_interval(label: Any) -> bool:
    """Whether a label is the interval of a flow, s; which ones there may be says ``labels.flow``."""
    return isinstance(label, (int, float)) and not isinstance(label, bool)


def labels_tree(labels: Sequence[str | float]) -> dict[str, Any]:
    """``labels:`` that asks for these and no others. Raises ConfigError as :func:`label_names`."""
    wanted = label_names(labels)
    everything: dict[str, Any] = {}
    asked: dict[str, Any] = {}
    for label in LABELS.values():
        label.ask(everything)
        if label.said in wanted:
            label.ask(asked)
    if intervals := [float(one) for one in wanted if is_interval(one)]:
        asked["flow"] = [*asked.get("flow", ()), *sorted(intervals)]
    tree = {key: asked.get(key, [] if isinstance(value, list) else False) for key, value in everything.items()}
    return {**tree, **{name: name in wanted for name in OF_EVENTS}}
