"""Generates the sequence of a rig: those of its sensors in one folder, which appears whole or not at all."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

from blinkgl.config.sequence import SequenceConfig
from blinkgl.dataset.generate import made_by, write_end, write_item, writer_of
from blinkgl.dataset.plan import sequence_name
from blinkgl.dataset.preview import PreviewRecorder
from blinkgl.dataset.report import Progress, SequenceReport, config_yaml
from blinkgl.gl import GLContext
from blinkgl.sequence import EventChunk
from blinkgl.sequence.clock import StageClock
from blinkgl.sequence.rig import RigSequence, simulate_rig
from blinkgl.sequence_files.rig_dir import RigWriter


def generate_rig(
    config: SequenceConfig,
    index: int,
    out: str | Path,
    gl: GLContext | None,
    *,
    base: Path = Path("."),
    progress: Progress | None = None,
) -> SequenceReport:
    """As :func:`blinkgl.dataset.generate.generate_sequence`, of a configuration with ``sensors``."""
    report = SequenceReport(index, Path(out) / sequence_name(config.output, index))
    text = config_yaml(config, index)
    pictures_hz = config.preview.rate if config.preview.enabled else None
    with (
        simulate_rig(config, index, gl, base=base, pictures_hz=pictures_hz) as rig,
        RigWriter(report.path, config.sensors or (), config_yaml=text, t_offset_us=rig.t0_ns // 1000) as writer,
    ):
        span_ns = rig.t1_ns - rig.t0_ns
        units = list(rig.inertial_units())
        with PreviewRecorder(config.preview, rig.members, writer) as preview, ExitStack() as stack:
            writers = {
                member.name: stack.enter_context(writer_of(member, writer.folder(member.name), text))
                for member in rig.members
            }
            for member, item in rig:
                write_item(writers[member.name], member, item)
                preview.take(member, item)
                if isinstance(item, EventChunk) and progress is not None:
                    report.count(rig)
                    progress(report, (item.t_ns - rig.t0_ns) / span_ns)
            for member in rig.members:
                write_end(writers[member.name], member)
                writers[member.name].info["sensor"] = member.name
        with rig.clock("write"):
            for name in writers:
                writer.adopt(name)
            for name, unit_config, inertial in units:
                writer.imu(unit_config, vars(inertial), f"{name}/")
            writer.info.update(_manifest_info(rig))
        report.count(rig)
        flushing = StageClock()
    report.finish(rig, flushing.total)
    return report


def _manifest_info(rig: RigSequence) -> dict:
    """As :func:`blinkgl.dataset.generate.manifest_info`, of what its sensors have in common."""
    facts = rig.members[0].facts() if rig.members else {}
    common = ("opengl", "timeline", "triangles", "objects", "scene_log", "not_drawn", "dynamics")
    return {
        **made_by(rig.config, rig.index, rig.libraries),
        "frames": rig.frames,
        "labels": rig.labels,
        "duration_us": rig.t1_ns // 1000 - rig.t0_ns // 1000,
        **{key: facts[key] for key in common if key in facts},
    }
