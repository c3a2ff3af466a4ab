"""Generates sequences: one function that reads from top to bottom, and the plainest loop around it.

Pass 1 is dense in time: luminance frames at adaptively chosen times go through the event emulator. Pass 2 is sparse:
images and ground truth at the label times. Both stream; memory does not depend on the sequence's length.
"""

from __future__ import annotations

import platform
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np

import blinkgl
from blinkgl.config.sequence import RunTemplate, SequenceConfig
from blinkgl.dataset.clock import StageClock
from blinkgl.dataset.event_pass import EventPass
from blinkgl.dataset.frames import convert_sequence
from blinkgl.dataset.plan import Plan, check_output, sequence_name
from blinkgl.dataset.preview import PreviewRecorder
from blinkgl.dataset.report import Progress, SequenceReport, config_yaml, losses
from blinkgl.events.readout import Readout
from blinkgl.gl import GLContext, create_context
from blinkgl.io.sequence_dir import SequenceWriter, refuse_existing
from blinkgl.labels import LABELS, LabelRequest, asked_for
from blinkgl.render.renderer import Renderer
from blinkgl.rng import Role, kernel_seed
from blinkgl.scene.build import build_scene
from blinkgl.scene.types import Scene


def generate_run(template: RunTemplate, out: str | Path, num: int | None = None,
                 progress: Progress | None = None) -> Iterator[SequenceReport]:
    """Generates ``num`` (default: the configuration's ``output.sequences``) sequences below ``out``, in order, in this
    process, yielding a report after each. The first error ends it; :mod:`blinkgl.dataset.run` is the loop that does not give up.

    Raises BlinkGLError: any configuration or asset error, no OpenGL, or an output folder that exists; the folders
    are looked at before any work starts."""
    check_output(out)
    plan = Plan.of(template, num)
    for _, task in plan.tasks.present(Path(out)):
        refuse_existing(Path(out) / task.name)
    plan.check_assets()
    with ExitStack() as stack:
        gl = None
        for task in plan.tasks:
            config = plan.config(task)
            if gl is None and config.frames is None:
                gl = stack.enter_context(create_context(config.gl.backend, config.gl.device))
            yield generate_sequence(config, task.index, out, gl, base=template.base, progress=progress)


def generate_sequence(config: SequenceConfig, index: int, out: str | Path, gl: GLContext | None, *, base: Path = Path("."),
                      progress: Progress | None = None) -> SequenceReport:
    """Generates one sequence directory, whole or not at all.

    gl : context to draw with; not looked at (None) for a sequence that is converted from frames.
    base : folder that relative paths in the configuration start from.
    Raises BlinkGLError for anything the user or the machine caused."""
    path = Path(out) / sequence_name(config.output, index)
    if config.frames is not None:
        return convert_sequence(config, index, path, base=base, progress=progress)
    clock = StageClock()
    report = SequenceReport(index, path, seconds=clock.seconds)
    t0_ns, t1_ns = config.time.t0_ns, config.time.t1_ns
    with clock("scene"):
        scene = build_scene(config.scene, config.camera, t0_ns, t1_ns, split=config.output.split, seed=config.seed,
                            sequence=index, base=base)
    report.omissions = scene.omissions
    with (
        Renderer(gl, scene, config.render) as renderer,
        SequenceWriter(report.path, scene.camera.height, scene.camera.width, config_yaml=config_yaml(config, index),
                       t_offset_us=t0_ns // 1000, labels=config.labels) as writer,
    ):
        _simulate_events(config, index, scene, renderer, writer, clock, report, progress)
        _write_labels(config, renderer, writer, clock, report)
        with clock("write"):
            writer.poses(**poses_of(scene, [t0_ns, *config.time.label_times_ns]))
            writer.t_end_us = t1_ns // 1000
            writer.info.update(manifest_info(config, index, renderer.scene, gl, report, renderer.triangles))
        clock.seconds.update({"render": renderer.stats.render_s, "read-back": renderer.stats.readback_s})
        report.triangles = renderer.triangles
        flushing = StageClock()  # leaving the block waits for the writers' threads and syncs the files
    clock.add("write", flushing.total)
    report.simulated_s = (t1_ns - t0_ns) * 1e-9
    report.total_s, report.compile_s = clock.total, clock.compile_s
    return report


def _simulate_events(config: SequenceConfig, index: int, scene: Scene, renderer: Renderer, writer: SequenceWriter,
                     clock: StageClock, report: SequenceReport, progress: Progress | None) -> None:
    """Pass 1: luminance frames through the emulator, events into events.h5, and the preview on the way."""
    t0_ns, t1_ns = scene.t0_ns, scene.t1_ns
    readout = Readout(config.readout) if config.readout is not None else None
    frames = EventPass(config.timeline, config.events, renderer, kernel_seed(config.seed, index, Role.EVENTS), clock)
    with PreviewRecorder(config, renderer, writer, clock) as preview:
        for t_ns, events in frames:
            if readout is not None:
                with clock("events"):
                    events = readout.step(events, t_ns // 1000)
            with clock("write"):
                writer.append_events(events)
            preview.add_events(events)
            if preview.due(t_ns):
                preview.frame(t_ns)
            report.frames = frames.frames
            report.events += len(events)
            if progress is not None:
                clock.seconds.update({"render": renderer.stats.render_s, "read-back": renderer.stats.readback_s})
                progress(report, (t_ns - t0_ns) / (t1_ns - t0_ns))
    report.timeline = frames.timeline.info()
    writer.info["timeline"] = {"kind": config.timeline.kind, "reconstruction": config.timeline.reconstruction, **report.timeline}
    dropped, late = (readout.dropped, readout.late) if readout is not None else (0, 0)
    writer.info.update(losses(frames.emulator.saturated, dropped, late))


def _write_labels(config: SequenceConfig, renderer: Renderer, writer: SequenceWriter, clock: StageClock,
                  report: SequenceReport) -> None:
    """Pass 2: ground truth at the label times; at the last one, from which nothing leads on, images alone."""
    request = asked_for(config.labels)
    at_last = LabelRequest(*(name for name in request if LABELS[name].at_last))
    times = config.time.label_times_ns
    interval = config.time.interval_ns
    for k, t_ns in enumerate(times):
        last = k == len(times) - 1
        leads_to = {"forward": t_ns + interval, "backward": t_ns - interval}
        frame = renderer.labels(t_ns, at_last if last else request, leads_to["forward"], leads_to["backward"])
        with clock("write"):
            for name, value in frame.values.items():
                to_ns = leads_to.get(LABELS[name].towards)
                writer.label(name, k, value, t_ns // 1000, None if to_ns is None else to_ns // 1000)
        report.labels += not last


def poses_of(scene: Scene, times_ns: list[int]) -> dict[str, np.ndarray]:
    """Arrays of poses.npz: t_ns (M,) int64; T_world_cam (M, 4, 4) float64; T_world_obj (n, M, 4, 4) float64 in the
    order of object_ids (n,) and object_names (n,); K (3, 3); resolution (width, height); near."""
    t = np.asarray(times_ns, np.int64)
    return {
        "t_ns": t,
        "T_world_cam": scene.camera.path.poses(t),
        "T_world_obj": np.stack([o.path.poses(t) for o in scene.objects]) if scene.objects else np.zeros((0, len(t), 4, 4)),
        "object_ids": np.array([o.instance_id for o in scene.objects], np.int64),
        "object_names": np.array([o.name for o in scene.objects], dtype=str),
        "object_categories": np.array([o.category for o in scene.objects], dtype=str),
        "K": scene.camera.K,
        "resolution": np.array([scene.camera.width, scene.camera.height], np.int64),
        "near": np.array(scene.camera.near),
    }


def manifest_info(config: SequenceConfig, index: int, scene: Scene, gl: GLContext, report: SequenceReport,
                  triangles: int) -> dict:
    """What a person needs to know where the sequence came from; no clock times (same seed, same manifest)."""
    import numba

    return {
        "blinkgl": blinkgl.__version__,
        "versions": {"python": platform.python_version(), "numpy": np.__version__, "numba": numba.__version__},
        "opengl": {"renderer": gl.renderer, "version": gl.version, "vendor": gl.vendor, "backend": gl.backend},
        "seed": config.seed,
        "sequence": index,
        "split": config.output.split,
        "emulator": config.events.emulator,
        "frames": report.frames,
        "labels": report.labels,
        "triangles": triangles,
        "duration_us": scene.t1_ns // 1000 - scene.t0_ns // 1000,  # between whole microseconds, as every time in the files
        "objects": [{"name": o.name, "id": o.instance_id, "category": o.category,
                     "source_hashes": sorted({p.mesh.source_hash for p in o.parts})} for o in scene.objects],
        "scene_log": list(scene.log),
        "not_drawn": list(scene.omissions),
    }
