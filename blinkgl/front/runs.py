"""Runs from Python: from a YAML file or a :class:`~blinkgl.front.scenes.Scene` to a data set."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, Unpack

from blinkgl.config.draw import middle
from blinkgl.config.expansion import expanded
from blinkgl.config.problems import validate_field
from blinkgl.config.reader import merge
from blinkgl.config.run import RunTemplate, load_run
from blinkgl.config.sequence import SequenceConfig
from blinkgl.errors import ConfigError
from blinkgl.front import arguments as check
from blinkgl.front.rigs import Rig
from blinkgl.front.scenes import Scene
from blinkgl.front.sections import Section, Timeline, sections
from blinkgl.scene.types import Scene as SceneData

if TYPE_CHECKING:
    from blinkgl.dataset.run import Outcome
    from blinkgl.dataset.verify import Verification
    from blinkgl.sequence.request import SequenceRequest

MAX_INDEX = 10_000_000
Source = Scene | RunTemplate


@check.public()
def load(path: str | os.PathLike, overrides: Sequence[str] = (), *, seed: int | None = None) -> RunTemplate:
    """Read and check the run of a YAML file, for :func:`generate`, :func:`record`, :func:`render_frame`.

    overrides : "path.to.key=value", as ``--set``.   seed : instead of the file's.
    ``load(path).sequence(3)`` is the configuration of sequence 3, every value drawn.
    Raises ConfigError: missing file, bad YAML (with line and column), unknown key, bad value."""
    overrides = list(check.one_of(overrides, "overrides", (list, tuple), "a list of texts"))
    for text in overrides:
        check.one_of(text, "overrides", str, "path.to.key=value")
    return load_run(check.path(path, "path"), overrides, seed=None if seed is None else check.seed(seed))


class Settings(TypedDict, total=False):
    """Values that replace those at the top level of a run's source; a group's own come before them
    (``groups``). :func:`blinkgl.record` describes them. None keeps the source's."""

    emulator: Section | None
    sensor: str | None
    timeline: Timeline | None
    quality: str | None
    labels: Sequence[str | float] | None
    images: Section | None
    imu: Section | None
    tracks: Section | None
    optics: Mapping[str, Any] | None
    readout: Mapping[str, Any] | None


@check.public(Settings)
def generate(
    source: Source,
    out: str | os.PathLike,
    *,
    num: int | None = None,
    workers: int = 1,
    resume: bool = False,
    rig: Rig | str | None = None,
    **settings: Unpack[Settings],
) -> Outcome:
    """Make a data set in the folder ``out``, as ``blinkgl generate`` does: the same files, bit for bit.

    source : :class:`Scene` or the result of :func:`load`.   num : number of sequences, dealt over the recipe's groups.
    workers : processes; 1: this one.
    resume : continue where ``out`` contains sequences of this run.   settings : emulator, sensor, timeline, quality,
    labels, images, imu, tracks, optics, readout as of :func:`record`, rig as of :func:`record`.
    Returns the counts (``made.events``, ``made.labels`` …) and the sequences set aside.
    Raises BlinkGLError: ConfigError (also for a scene with arrays: save them to files
    first), AssetError, GLError, OutputError."""
    from blinkgl.dataset.executor import Inline, Local
    from blinkgl.dataset.run import run_dataset

    template = configured(source, rig, **settings)
    if isinstance(source, Scene) and not source.on_disk:
        raise ConfigError(
            "the scene contains arrays, so the data set would not be reproducible",
            where="source",
            value=source,
            accepted="meshes and images in files, or record()",
        )
    num = None if num is None else check.whole(num, "num", 1, 10_000_000)
    executor = Inline() if check.whole(workers, "workers", 1, 1024) == 1 else Local(workers)
    template.check()
    return run_dataset(template, check.path(out, "out"), executor, num=num, resume=bool(resume))


@check.public()
def verify(folder: str | os.PathLike, *, deep: int = 0, seed: int = 0) -> Verification:
    """Check a data set; ``.clean`` tells whether it has no problem, ``.problems`` lists them by sequence.

    deep : number of sequences that are made again and compared.   seed : selects them.
    Raises AssetError: no data set there."""
    from blinkgl.dataset.verify import verify_dataset

    return verify_dataset(check.path(folder, "folder"), deep=check.whole(deep, "deep", 0, 2**31), seed=check.seed(seed))


def configured(source: Source, rig: Rig | str | None = None, **settings: Unpack[Settings]) -> RunTemplate:
    """Return ``source`` as a run, with the given values replacing its own. Raises ConfigError."""
    check.one_of(source, "source", (Scene, RunTemplate), "a Scene, or what load(path) gives")
    template = source.template() if isinstance(source, Scene) else source
    own = sections(settings)
    if rig is not None:
        named = Rig(preset=rig) if isinstance(rig, str) else rig
        own |= check.one_of(named, "rig", Rig, "a Rig, or a preset's name").tree
    own = expanded(own, Path.cwd())
    if "quality" in own:
        validate_field(SequenceConfig, "quality", own["quality"])
    if "sensor" in own:
        validate_field(SequenceConfig, "sensor", middle(own["sensor"]))
    return RunTemplate(merge(template.tree, own), template.base) if own else template


def requested(source: Source, config: SequenceConfig, index: int, **wanted: Any) -> SequenceRequest:
    """Return the request for sequence ``index`` of ``source``.   wanted : as of :class:`SequenceRequest`."""
    from blinkgl.sequence.request import SequenceRequest

    if isinstance(source, Scene):
        return SequenceRequest(config, index, scene=source.build(config), **wanted)
    return SequenceRequest(config, index, source.base, **wanted)


def scene_of(source: Source, config: SequenceConfig, index: int) -> SceneData:
    """Return the scene of sequence ``index``. Raises ConfigError and AssetError."""
    if isinstance(source, Scene):
        return source.build(config)
    from blinkgl.scene.build import sequence_scene

    return sequence_scene(config, index, source.base)
