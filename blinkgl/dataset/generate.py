"""Generation of sequences: writes the items of :func:`~blinkgl.sequence.simulate_sequence`, in a simple loop."""

from __future__ import annotations

import platform
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from blinkgl.config.run import RunTemplate
from blinkgl.config.scene import lights_change
from blinkgl.config.sequence import PreviewConfig, SequenceConfig
from blinkgl.dataset.assets import check_assets
from blinkgl.dataset.plan import Plan, check_output, sequence_name
from blinkgl.dataset.report import Progress, SequenceReport, config_yaml
from blinkgl.gl import GLContext, create_context
from blinkgl.imaging.exposure import decibels
from blinkgl.io.sequence_tables import EXPOSURE_POSES, LIGHTS, POSES, TRACKS, ExposureLine
from blinkgl.labels import LABELS
from blinkgl.machine.plugins import plugin_versions
from blinkgl.sequence import (
    EventChunk,
    GroundTruth,
    Item,
    Picture,
    SensorSimulation,
    SequenceRequest,
    Simulation,
    simulate_sequence,
)
from blinkgl.sequence.request import StageClock
from blinkgl.sequence_files.preview import Panels, PreviewWriter
from blinkgl.sequence_files.rig_dir import sensors_yaml, write_lens
from blinkgl.sequence_files.sequence_dir import RIG, SequenceWriter, refuse_existing
from blinkgl.version import __version__

LOSSES = "events_cut_by_max_events_per_step", "events_lost_in_readout", "events_late_in_readout"
"""The manifest's counts of events that were made but are not in the file; see docs/formats.md."""

# ---------------------------------------------------------------------------------------------------------------------
# Passes a sequence's items to the preview.


class PreviewRecorder:
    """Context manager; does nothing where no sequence has pictures. The flow panel shows the flow over a label
    interval, as the label does; recorded frames have none.

    sequences : of one camera, or of those of a rig, shown one below the other by their names."""

    def __init__(self, config: PreviewConfig, sequences: Sequence[SensorSimulation], writer: SequenceWriter):
        shown = [one for one in sequences if one.pictures_hz is not None]
        self._numbers = {one.name: number for number, one in enumerate(shown)}
        self._video: PreviewWriter | None = None
        if not shown:
            return
        self._clock = shown[0].clock
        rate = config.rate if shown[0].pictures_hz is None else shown[0].pictures_hz
        panels = [
            Panels(
                one.height,
                one.width,
                t0_us=one.t0_ns // 1000,
                flow=one.config.frames is None,
                rate_hz=rate,
                fps=rate / config.slowdown,
                label=one.name or "frame",
            )
            for one in shown
        ]
        self._video = PreviewWriter(writer.path("preview.mp4"), panels, rate / config.slowdown)

    def take(self, sequence: SensorSimulation, item: Item) -> None:
        """Add the items of a sequence, in order."""
        if self._video is None or (number := self._numbers.get(sequence.name)) is None:
            return
        if isinstance(item, EventChunk):
            with sequence.clock("preview"):
                self._video.panels[number].add_events(item.events)
        elif isinstance(item, Picture):
            with sequence.clock("preview"):
                if item.flow is not None:
                    self._video.panels[number].set_flow(item.flow)
                self._video.frame(item.t_ns // 1000, item.image, number)

    def __enter__(self) -> PreviewRecorder:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._video is not None:
            with self._clock("preview"):
                self._video.close() if kind is None else self._video.abort()


def generate_run(template: RunTemplate, out: str | Path, num: int | None = None) -> Iterator[SequenceReport]:
    """Generate ``num`` (default: the configuration's ``output.sequences``) sequences below ``out``, in order, in this
    process, and yield a report after each. The first error ends it; :mod:`blinkgl.dataset.run` is the loop that
    continues.

    Raises BlinkGLError: any configuration or asset error, no OpenGL, or an existing output folder; folders are checked
    before any work starts."""
    check_output(out)
    plan = Plan.of(template, num)
    for _, task in plan.tasks.present(Path(out)):
        refuse_existing(Path(out) / task.name)
    check_assets(plan)
    with ExitStack() as stack:
        gl = None
        for task in plan.tasks:
            config = plan.config(task)
            # The first sequence that is drawn opens the context, which the others share.
            if gl is None and config.frames is None:
                gl = stack.enter_context(create_context(config.gl.backend, config.gl.device))
            yield generate_sequence(config, task.index, out, gl, base=template.base)


def generate_sequence(
    config: SequenceConfig,
    index: int,
    out: str | Path,
    gl: GLContext | None,
    *,
    base: Path = Path("."),
    progress: Progress | None = None,
) -> SequenceReport:
    """Generate one sequence directory, completely or not at all.

    gl : context to draw with; not used (None) for a sequence that is converted from frames.
    base : folder that relative paths in the configuration start from.
    Raises BlinkGLError for every error of the user or the machine."""
    report = SequenceReport(index, Path(out) / sequence_name(config.output, index))
    pictures_hz = config.preview.rate if config.preview.enabled else None
    request = SequenceRequest(config, index, base, pictures_hz=pictures_hz)
    with simulate_sequence(request, gl) as sequence, _folder(sequence, report.path) as folder:
        units = list(sequence.inertial_units())  # a velocity that jumps is refused before anything is drawn
        with PreviewRecorder(config.preview, sequence.members, folder) as preview, ExitStack() as stack:
            writers = {
                member.name: stack.enter_context(folder.of_camera(member.name, **_settings(member)))
                if member.name
                else folder
                for member in sequence.members
            }
            if progress is not None:  # notes come before anything is drawn
                report.count(sequence)
                progress(report, 0.0)
            for member, item in sequence.by_sensor():
                write_item(writers[member.name], member, item)
                preview.take(member, item)
                if isinstance(item, EventChunk) and progress is not None:
                    report.count(sequence)
                    progress(report, (item.t_ns - sequence.t0_ns) / (sequence.t1_ns - sequence.t0_ns))
            for member in sequence.members:
                write_end(writers[member.name], member)
        if config.sensors is not None:
            with sequence.clock("write"):
                for name, unit_config, inertial in units:
                    folder.imu(unit_config, vars(inertial), f"{name}/")
                folder.text(RIG, sensors_yaml(config.sensors))
                folder.info.update(_shared_info(sequence))
        report.count(sequence)
        flushing = StageClock()  # leaving the block waits for the writers' threads and syncs the files
    report.finish(sequence, flushing.total)
    return report


def _folder(sequence: Simulation, path: Path) -> SequenceWriter:
    """Return the writer of the sequence's own folder, which is that of a single camera, too."""
    text, several = config_yaml(sequence.config, sequence.index), sequence.config.sensors is not None
    if several:
        return SequenceWriter(path, None, None, config_yaml=text, t_offset_us=sequence.t0_ns // 1000, events=False)
    return SequenceWriter(path, config_yaml=text, **_settings(sequence.members[0]))


def _settings(sequence: SensorSimulation) -> dict[str, Any]:
    """Return the arguments of a camera's writer."""
    return {
        "height": sequence.height,
        "width": sequence.width,
        "t_offset_us": sequence.t0_ns // 1000,
        "labels": sequence.config.labels,
        "events": sequence.camera is not None,
        "truth": sequence.records_truth,
        "lights": sequence.records_truth and lights_change(sequence.config.scene),
        "codec": sequence.config.output.compression,
    }


def write_item(writer: SequenceWriter, sequence: SensorSimulation, item: Item) -> None:
    """Write an item, except pictures for display."""
    if isinstance(item, Picture):
        return
    with sequence.clock("write"):
        if isinstance(item, EventChunk):
            if sequence.camera is not None:
                writer.append_events(item.events)
        elif isinstance(item, GroundTruth):
            _write_labels(writer, item)
        else:
            line = ExposureLine(
                item.start_ns / 1000,
                item.end_ns / 1000,
                item.exposure_ns / 1000,
                item.row_ns / 1000,
                decibels(item.gain),
                item.instants,
            )
            writer.image(item.pictures, line)


def write_end(writer: SequenceWriter, sequence: SensorSimulation) -> None:
    """Write what is known only at the end."""
    with sequence.clock("write"):
        if poses := sequence.poses():
            writer.arrays(POSES, **poses)
        if exposed := sequence.exposure_poses():
            writer.arrays(EXPOSURE_POSES, **exposed)
        if (camera := sequence.lens) is not None:
            write_lens(writer, camera)
        if (inertial := sequence.imu()) is not None and sequence.config.imu is not None:
            writer.imu(sequence.config.imu, vars(inertial))
        if (tracks := sequence.tracks()) is not None:
            writer.arrays(TRACKS, **vars(tracks))
        if lights := sequence.lights():
            writer.arrays(LIGHTS, **lights)
        writer.t_end_us = sequence.t1_ns // 1000
        writer.info.update(manifest_info(sequence))


def _write_labels(writer: SequenceWriter, truth: GroundTruth) -> None:
    leads_to: dict[str | None, int | None] = {"forward": truth.forward_ns, "backward": truth.backward_ns}
    for name, value in truth.frame.values.items():
        to_ns = leads_to.get(LABELS[name].towards)
        writer.label(name, truth.k, value, truth.t_ns // 1000, None if to_ns is None else to_ns // 1000)


def manifest_info(sequence: SensorSimulation) -> dict:
    """Return the manifest's entries about a camera's source; no clock times (same seed, same manifest)."""
    camera, opencv = sequence.camera, {} if sequence.config.frames is None else {"opencv": cv2.__version__}
    emulator = {}
    if camera is not None:
        emulator = {"emulator": sequence.config.events.emulator, "events_device": camera.emulator.device}
    return {
        **_made_by(sequence, {**opencv, **sequence.libraries}),
        **emulator,
        **dict(zip(LOSSES, sequence.losses, strict=True)),
        **({"events_by_cause": sequence.causes} if sequence.causes else {}),
        **sequence.facts(),
    }


def _shared_info(rig: Simulation) -> dict:
    """Return :func:`manifest_info` of what several sensors have in common."""
    facts, sensors = rig.members[0].facts() if rig.members else {}, rig.config.sensors or ()
    common = ("opengl", "timeline", "triangles", "objects", "scene_log", "not_drawn", "dynamics")
    return {
        **_made_by(rig, rig.libraries),
        "sensors": [one.name for one in sensors],
        "cameras": [one.name for one in sensors if one.sees],
        **{key: facts[key] for key in common if key in facts},
    }


def _made_by(sequence: Simulation | SensorSimulation, libraries: Mapping[str, str]) -> dict:
    """Return a manifest's entries: which sequence it is, what made it, and how much. libraries : versions besides those
    always used."""
    import numba

    versions = {"python": platform.python_version(), "numpy": np.__version__, "numba": numba.__version__}
    return {
        "blinkgl": __version__,
        "versions": {**versions, **libraries, **plugin_versions()},
        "seed": sequence.config.seed,
        "sequence": sequence.index,
        "split": sequence.config.output.split,
        **({} if sequence.config.output.label is None else {"class": sequence.config.output.label}),
        "frames": sequence.frames,
        "labels": sequence.labels,
        # between whole microseconds, as every time in the files
        "duration_us": sequence.t1_ns // 1000 - sequence.t0_ns // 1000,
    }
