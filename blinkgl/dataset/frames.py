"""Sequences out of recorded frames: the E-Tartan way. Frames go through the emulator, the frames' own flow becomes the label.

A folder is expected to look like a TartanAir trajectory: images in one sub-folder, one flow file per pair of frames in
another, and, where there are any, masks of occluded pixels beside the flow (``*_mask.npy``, non-zero: the point is hidden
or outside the image in the next frame).
"""

from __future__ import annotations

import glob
import os
import platform
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

import blinkgl
from blinkgl.config.base import Refused
from blinkgl.config.frames import FramesConfig, check_span
from blinkgl.config.sequence import SequenceConfig
from blinkgl.dataset.clock import StageClock
from blinkgl.dataset.report import Progress, SequenceReport, config_yaml, losses
from blinkgl.errors import AssetError, ConfigError
from blinkgl.io.flow import read_flow
from blinkgl.io.frames import IMAGE, read_any_image
from blinkgl.io.images import read_npy
from blinkgl.io.preview import PreviewWriter
from blinkgl.io.sequence_dir import SequenceWriter
from blinkgl.labels import Flow, asked_for
from blinkgl.recordings.simulation import Decoder, SimulationReport, simulate
from blinkgl.rng import Role, kernel_seed
from blinkgl.scene.worlds.pool import resolve

RECORDED = ("images", "flow_forward", "occlusion_forward")
"""Labels that recorded frames may bring."""
_FLOW = (".npy", ".flo", ".png")


def matching_folders(config: FramesConfig, base: Path) -> list[Path]:
    """The folders that ``frames.folders`` names, sorted. ConfigError: none named, none found, or no image folder inside."""
    found: list[Path] = []
    for number, pattern in enumerate(config.folders):
        matches = sorted(Path(p) for p in glob.glob(str(resolve(pattern, base))) if Path(p).is_dir())
        if not matches:
            raise ConfigError("no such folder", where=f"frames.folders.{number}", value=pattern, accepted="a folder of frames, or a pattern")
        found += matches
    if not found:
        raise ConfigError("no folders of frames", where="frames.folders", value=[], accepted="one folder per sequence, or patterns")
    for folder in found:
        if not (folder / config.images).is_dir():
            raise ConfigError("no such folder", where="frames.images", value=str(folder / config.images), accepted="a folder of images")
    return found


def folder_of(config: FramesConfig, index: int, base: Path) -> Path:
    """The ``index``-th folder of frames; the only one for every index. Raises ConfigError as :func:`matching_folders`, or for too few."""
    folders = matching_folders(config, base)
    if len(folders) > 1 and index >= len(folders):
        raise ConfigError(f"{len(folders)} folders are too few for sequence {index}", where="frames.folders")
    return folders[index] if len(folders) > 1 else folders[0]


def used_images(config: FramesConfig, folder: Path) -> list[Path]:
    """The images of ``folder`` that become a sequence, in order. AssetError: too few; ConfigError: they last longer than an event
    file can hold."""
    files = _listed(folder / config.images, IMAGE)[config.first:]
    files = files[: config.count]
    if len(files) < 3 or (config.count and len(files) < config.count):
        raise AssetError("too few frames", where=str(folder / config.images), value=len(files), accepted=f"at least {config.count or 3}")
    try:
        check_span(len(files), config.fps)
    except Refused as error:
        raise ConfigError(error.problem, where="frames.fps", value=error.value, accepted=error.accepted) from None
    return files


def convert_sequence(config: SequenceConfig, index: int, path: Path, *, base: Path = Path("."), progress: Progress | None = None) -> SequenceReport:
    """Makes the sequence directory ``path`` from the ``index``-th folder of frames, whole or not at all.

    Label k is the flow from frame k + 1 to k + 2 (counted in the frames used), so that every label has a full interval of
    events before it, as in generated sequences. Raises BlinkGLError: unreadable or unequal frames, flow that does not fit them."""
    frames = config.frames
    folder = folder_of(frames, index, base)
    files = used_images(frames, folder)
    flows, masks = flow_files(folder, frames, len(files))
    clock, report, counted = StageClock(), SequenceReport(index, path), SimulationReport()
    time_of = lambda k: round(k * 1e9 / frames.fps)  # frame k's time, ns
    first = read_frame(files[0])
    height, width = first.shape[:2]
    decode = Decoder(frames.gamma)

    def given() -> Iterator[tuple[np.ndarray, int, str]]:
        for k, file in enumerate(files):
            yield first if k == 0 else read_frame(file), time_of(k), str(file)
            if progress is not None:
                report.frames, report.events = counted.steps, counted.events
                progress(report, k / len(files))

    resolved = config.model_copy(update={"frames": frames.model_copy(update={"folders": (os.path.relpath(folder, base),)})})
    video: list[PreviewWriter] = []

    def on_frame(luminance, t_ns, events) -> None:
        if video:
            with clock("preview"):
                video[0].add_events(events)
                if video[0].due(t_ns // 1000):
                    video[0].frame(t_ns // 1000, decode(luminance, "") if luminance.dtype == np.uint8 else luminance)

    with SequenceWriter(path, height, width, config_yaml=config_yaml(resolved, index), labels=config.labels) as writer:
        if config.preview.enabled:
            rate = min(config.preview.rate, frames.fps * 8)
            video.append(PreviewWriter(writer.path("preview.mp4"), height, width, flow=False, rate_hz=rate, fps=rate / config.preview.slowdown))
        try:
            stream = simulate(given(), emulator=config.events, gamma=frames.gamma, interpolate=frames.interpolate, factor=frames.factor,
                              max_px=frames.max_px, seed=kernel_seed(config.seed, index, Role.EVENTS),
                              readout=config.readout, report=counted, on_frame=on_frame)
            while True:
                with clock("events"):
                    events = next(stream, None)
                if events is None:
                    break
                with clock("write"):
                    writer.append_events(events)
            if video:
                video[0].close()
        except BaseException:
            if video:
                video[0].abort()
            raise
        with clock("write"):
            _write_labels(config, files, flows, masks, time_of, (height, width), writer, report)
            writer.t_end_us = time_of(len(files) - 1) // 1000
            report.frames, report.events = counted.steps, counted.events
            writer.info.update(_manifest(config, index, folder, files, report, time_of(len(files) - 1)))
            writer.info.update(losses(counted.saturated, counted.lost, counted.late))
    report.simulated_s = time_of(len(files) - 1) * 1e-9
    report.seconds, report.total_s, report.compile_s = clock.seconds, clock.total, clock.compile_s
    return report


def _write_labels(config: SequenceConfig, files, flows, masks, time_of, size, writer: SequenceWriter, report: SequenceReport) -> None:
    request = asked_for(config.labels)
    for k in range(1, len(files)):
        times = (time_of(k) // 1000, time_of(k + 1) // 1000)
        if "images" in request:
            writer.label("images", k - 1, read_frame(files[k]), times[0])
        if k == len(files) - 1 or "flow_forward" not in request:
            continue
        if flows:
            writer.label("flow_forward", k - 1, Flow(*_flow(flows[k], size)), *times)
            if masks and "occlusion_forward" in request:
                mask = read_npy(masks[k])
                if mask.shape != size:
                    raise AssetError("mask and image differ in size", where=str(masks[k]), value=mask.shape, accepted=str(size))
                writer.label("occlusion_forward", k - 1, mask != 0, *times)
            report.labels += 1


def _manifest(config: SequenceConfig, index: int, folder: Path, files: list[Path], report: SequenceReport, end_ns: int) -> dict:
    import numba

    return {"blinkgl": blinkgl.__version__, "seed": config.seed, "sequence": index, "split": config.output.split,
            "emulator": config.events.emulator,
            "versions": {"python": platform.python_version(), "numpy": np.__version__, "numba": numba.__version__, "opencv": cv2.__version__},
            "frames": report.frames, "labels": report.labels, "duration_us": end_ns // 1000,
            "source": {"folder": folder.name, "images": len(files), "first": files[0].name, "last": files[-1].name}}


def _listed(folder: Path, suffixes) -> list[Path]:
    if not folder.is_dir():
        raise AssetError("no such folder", where=str(folder))
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in suffixes and p.is_file() and not p.name.startswith("."))


def flow_files(folder: Path, frames: FramesConfig, used: int) -> tuple[list[Path], list[Path]]:
    """(flow, masks) of the frames used; the k-th goes from frame k to frame k + 1."""
    if frames.flow is None:
        return [], []
    everything = _listed(folder / frames.flow, _FLOW)
    masks = [p for p in everything if p.stem.endswith("_mask")]
    flows = [p for p in everything if p not in set(masks)][frames.first:]
    if len(flows) < used - 1 or (masks and len(masks) < frames.first + used - 1):
        raise AssetError("not one flow file per pair of frames", where=str(folder / frames.flow),
                         value=f"{len(flows)} flow files, {len(masks)} masks", accepted=f"at least {used - 1} for {used} frames")
    return flows, masks[frames.first:]


def _flow(path: Path, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    flow, valid = read_flow(path)
    if flow.shape[:2] != size:
        raise AssetError("flow and image differ in size", where=str(path), value=flow.shape[:2], accepted=str(size))
    return flow, valid


def read_frame(path: Path) -> np.ndarray:
    """(H, W) or (H, W, 3) RGB of an image file, alpha dropped. Raises AssetError."""
    image = read_any_image(path)
    return image if image.ndim == 2 else np.ascontiguousarray(image[..., :3])


