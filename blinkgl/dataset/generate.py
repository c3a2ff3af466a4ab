"""Generates sequences: one function that reads from top to bottom, and the loop around it.

Pass 1 is dense in time: luminance frames at adaptively chosen times go through the event emulator. Pass 2 is sparse:
images and ground truth at the label times. Both stream; memory does not depend on the sequence's length.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml

import blinkgl
from blinkgl.config.sequence import OutputConfig, RunTemplate, SequenceConfig
from blinkgl.dataset.clock import StageClock
from blinkgl.dataset.preview import PreviewRecorder
from blinkgl.errors import OutputError
from blinkgl.events import make_emulator
from blinkgl.gl import GLContext, create_context
from blinkgl.io.sequence_dir import SequenceWriter, refuse_existing
from blinkgl.render.renderer import LabelRequest, Renderer
from blinkgl.render.statistics import largest_speed
from blinkgl.rng import Role, kernel_seed
from blinkgl.scene.build import build_scene, check_assets
from blinkgl.scene.types import Scene
from blinkgl.timeline import frame_times

Progress = Callable[["SequenceReport", float], None]
"""Called now and then with the running report and the fraction done, 0 … 1."""


@dataclass
class SequenceReport:
    """What one sequence cost and holds. Times in wall seconds; they are shown, never written into the data set."""

    index: int
    path: Path
    simulated_s: float = 0.0
    frames: int = 0
    events: int = 0
    triangles: int = 0
    labels: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    total_s: float = 0.0


def generate_run(template: RunTemplate, out: str | Path, num: int | None = None,
                 progress: Progress | None = None) -> Iterator[SequenceReport]:
    """Generates ``num`` (default: the configuration's ``output.sequences``) sequences below ``out``, in order,
    yielding a report after each.

    Raises BlinkGLError: any configuration or asset error, no OpenGL, or an output folder that exists; the folders
    are looked at before any work starts."""
    check_output(out)
    first = template.sequence(0)
    count = first.output.sequences if num is None else num
    indices = range(first.output.first_index, first.output.first_index + count)
    for index in indices:
        refuse_existing(sequence_folder(first.output, out, index))
    check_assets(first.scene, template.base, first.output.split)
    with create_context(first.gl.backend, first.gl.device) as gl:
        for index in indices:
            yield generate_sequence(template.sequence(index), index, out, gl, base=template.base, progress=progress)


def sequence_folder(output: OutputConfig, out: str | Path, index: int) -> Path:
    """<out>/<split>/<name>_<index>"""
    return Path(out) / output.split / f"{output.name}_{index:06d}"


def generate_sequence(config: SequenceConfig, index: int, out: str | Path, gl: GLContext, *, base: Path = Path("."),
                      progress: Progress | None = None) -> SequenceReport:
    """Generates one sequence directory, whole or not at all.

    base : folder that relative paths in the configuration start from.
    Raises BlinkGLError for anything the user or the machine caused."""
    clock = StageClock()
    report = SequenceReport(index, sequence_folder(config.output, out, index))
    t0_ns, t1_ns = config.time.t0_ns, config.time.t1_ns
    with clock("scene"):
        scene = build_scene(config.scene, config.camera, t0_ns, t1_ns, split=config.output.split, seed=config.seed,
                            sequence=index, base=base)
    with (
        Renderer(gl, scene, config.render) as renderer,
        SequenceWriter(report.path, scene.camera.height, scene.camera.width, config_yaml=config_yaml(config, index),
                       t_offset_us=t0_ns // 1000, float_flow=config.labels.float_flow) as writer,
    ):
        _simulate_events(config, index, scene, renderer, writer, clock, report, progress)
        _write_labels(config, renderer, writer, clock, report)
        with clock("write"):
            writer.poses(**poses_of(scene, [t0_ns, *config.time.label_times_ns]))
            writer.t_end_us = t1_ns // 1000
            writer.info.update(manifest_info(config, index, scene, gl, report, renderer.triangles))
        clock.add("render", renderer.stats.render_s)
        clock.add("read-back", renderer.stats.readback_s)
        report.triangles = renderer.triangles
        flushing = StageClock()  # leaving the block waits for the writers' threads and syncs the files
    clock.add("write", flushing.total)
    report.simulated_s = (t1_ns - t0_ns) * 1e-9
    report.seconds, report.total_s = clock.seconds, clock.total
    return report


def _simulate_events(config: SequenceConfig, index: int, scene: Scene, renderer: Renderer, writer: SequenceWriter,
                     clock: StageClock, report: SequenceReport, progress: Progress | None) -> None:
    """Pass 1: luminance frames through the emulator, events into events.h5, and the preview on the way."""
    camera, t0_ns, t1_ns = scene.camera, scene.t0_ns, scene.t1_ns
    emulator = make_emulator(config.events, camera.height, camera.width, kernel_seed(config.seed, index, Role.EVENTS))
    timeline = config.timeline

    def speed(t_ns: int) -> float:
        velocity = renderer.velocity(t_ns, timeline.sample_every)
        with clock("timeline"):
            return largest_speed(velocity, timeline.percentile)

    luminance = np.empty((camera.height, camera.width), np.float32)
    with PreviewRecorder(config, renderer, writer, clock) as preview:
        for t_ns in frame_times(timeline, t0_ns, t1_ns, speed):
            renderer.luminance(t_ns, out=luminance)
            with clock("events"):
                events = emulator.step(luminance, t_ns)
            with clock("write"):
                writer.append_events(events)
            preview.add_events(events)
            if preview.due(t_ns):
                preview.frame(t_ns)
            report.frames += 1
            report.events += len(events)
            if progress is not None:
                progress(report, (t_ns - t0_ns) / (t1_ns - t0_ns))


def _write_labels(config: SequenceConfig, renderer: Renderer, writer: SequenceWriter, clock: StageClock,
                  report: SequenceReport) -> None:
    """Pass 2: images at every label time, ground truth at every one but the last (whose flow has no end)."""
    labels = config.labels
    request = LabelRequest(depth=labels.depth, ids=labels.ids, normals=labels.normals, velocity=labels.velocity,
                           flow_forward="forward" in labels.flow, flow_backward="backward" in labels.flow,
                           occlusion=labels.occlusion)
    times = config.time.label_times_ns
    interval = config.time.interval_ns
    for k, t_ns in enumerate(times):
        if labels.images:
            colour = renderer.colour(t_ns)
            with clock("write"):
                writer.image(k, t_ns // 1000, colour)
        if k == len(times) - 1:
            break
        frame = renderer.labels(t_ns, request, t_ns + interval, t_ns - interval)
        with clock("write"):
            for direction, flow, t_other in (("forward", frame.forward, t_ns + interval),
                                             ("backward", frame.backward, t_ns - interval)):
                if flow is None:
                    continue
                writer.flow(direction, k, flow.flow, flow.valid, t_ns // 1000, t_other // 1000)
                if flow.occluded is not None:
                    writer.occlusion(direction, k, flow.occluded)
            for name in ("depth", "ids", "normals", "velocity"):
                if (array := getattr(frame, name)) is not None:
                    getattr(writer, name)(k, array)
        report.labels += 1


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


def config_yaml(config: SequenceConfig, index: int) -> str:
    """The resolved configuration as YAML; ``blinkgl generate`` takes it and makes this one sequence again."""
    tree = json.loads(config.model_dump_json())
    tree["output"].update(first_index=index, sequences=1)
    return (f"# BlinkGL {blinkgl.__version__}, sequence {index}: every value as drawn.\n"
            "# Relative paths start from the folder of the run's own configuration file.\n"
            + yaml.safe_dump(tree, sort_keys=False))


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
        "frames": report.frames,
        "labels": report.labels,
        "triangles": triangles,
        "duration_us": (scene.t1_ns - scene.t0_ns) // 1000,
        "objects": [{"name": o.name, "id": o.instance_id, "category": o.category,
                     "source_hashes": sorted({p.mesh.source_hash for p in o.parts})} for o in scene.objects],
        "scene_log": list(scene.log),
    }


def check_output(out: str | Path) -> None:
    """OutputError when ``out`` cannot become a folder of sequences."""
    out = Path(out)
    if out.exists() and not out.is_dir():
        raise OutputError("is a file", where=str(out), accepted="a folder")
