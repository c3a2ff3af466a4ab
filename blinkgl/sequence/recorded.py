"""A sequence of recorded frames, as in E-Tartan: frames pass through the emulator, and their own flow becomes the
label. The first comment describes the expected folders."""

from __future__ import annotations

import contextlib
import glob
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from blinkgl.config.base import placed
from blinkgl.config.frames import FramesConfig, check_span
from blinkgl.errors import AssetError, ConfigError
from blinkgl.events.camera import EventCamera
from blinkgl.io.flow import READ_ENDINGS, flow_form, read_flow
from blinkgl.io.frames import IMAGE, read_any_image, stated_levels
from blinkgl.io.images import read_npy
from blinkgl.io.names import series
from blinkgl.io.stills import open_stills
from blinkgl.io.times import NANOSECONDS, Undeclared, read_timestamps
from blinkgl.labels import Flow, LabelFrame, asked_for
from blinkgl.recordings.decoding import Codes
from blinkgl.recordings.simulation import FrameUse, SimulationReport, Step, stepped, timed
from blinkgl.rng import Role, kernel_seed
from blinkgl.scene.reading import resolve
from blinkgl.sequence.given_flow import factor_that_fits
from blinkgl.sequence.request import GroundTruth, Picture, SequenceRequest, StageClock
from blinkgl.sequence.sensor import SensorSimulation
from blinkgl.tensors.choice import make_on_device
from blinkgl.types.events import Events

# ---------------------------------------------------------------------------------------------------------------------
# Folders of recorded frames: finding them, their images and their flow.
#
# A folder must look like a TartanAir trajectory: images in one sub-folder, one flow file per pair of frames in another,
# and, if there are any, masks of occluded pixels beside the flow (``*_mask.npy``, non-zero: the point is hidden or
# outside the image in the next frame). All are used in the order of their names. A third may hold the backward flow,
# one file per pair of frames, too.

_BACKWARD = re.compile(r"backward|bwd|into_?past|flow_?bw", re.IGNORECASE)
_UNEQUAL = 0.05
"""Part of a frame's interval by which times beside the images may differ from ``frames.fps``."""
_CHECKED_PAIRS = 3
"""Pairs of frames whose flow is compared with the images."""


def matching_folders(config: FramesConfig, base: Path) -> list[Path]:
    """Return the folders of ``frames.folders``, sorted. Raises ConfigError: none given, none found, or no image folder
    inside."""
    folders: list[Path] = []
    for number, pattern in enumerate(config.folders):
        # A name that is there is no pattern, and nothing of the run's own place is one.
        literal, places = resolve(pattern, base), str(resolve(pattern, Path(glob.escape(str(base)))))
        matches = [literal] if literal.is_dir() else sorted(p for p in map(Path, glob.glob(places)) if p.is_dir())
        if not matches:
            raise ConfigError(
                "no such folder",
                where=f"frames.folders.{number}",
                value=pattern,
                accepted="a folder of frames, or a pattern",
            )
        folders += matches
    if not folders:
        raise ConfigError(
            "no folders of frames", where="frames.folders", value=[], accepted="one folder per sequence, or patterns"
        )
    for folder in folders:
        if not (folder / config.images).is_dir():
            raise ConfigError(
                "no such folder",
                where="frames.images",
                value=str(folder / config.images),
                accepted="a folder of images",
            )
    return folders


def folder_of(config: FramesConfig, index: int, base: Path) -> Path:
    """Return the ``index``-th folder of frames; the only one for every index. Raises ConfigError as
    :func:`matching_folders`, or for too few."""
    folders = matching_folders(config, base)
    if len(folders) > 1 and index >= len(folders):
        raise ConfigError(f"{len(folders)} folders are too few for sequence {index}", where="frames.folders")
    return folders[index] if len(folders) > 1 else folders[0]


def used_images(config: FramesConfig, folder: Path) -> list[Path]:
    """Return the images of ``folder`` that become a sequence, in order. Raises AssetError: too few; ConfigError: they
    last longer than an event file can hold."""
    if not (folder / config.images).is_dir():
        raise AssetError("no such folder", where=str(folder / config.images))
    images = series(folder / config.images, IMAGE)
    used = slice(config.first, None if config.count is None else config.first + config.count)
    files = images.files[used]
    if missing := replace(images, files=files, numbers=images.numbers and images.numbers[used]).missing():
        # Its flow is missing, too, or would be half of what the images show.
        raise AssetError(
            missing[0].partition(":")[0],
            where=str(folder / config.images),
            accepted="every frame, or frames.first and frames.count for a part without a gap",
        )
    _check_stamps(folder / config.images, files, config.fps, used)
    if len(files) < 3 or (config.count and len(files) < config.count):
        raise AssetError(
            "too few frames",
            where=str(folder / config.images),
            value=len(files),
            accepted=f"at least {config.count or 3}",
        )
    with placed("frames.fps"):
        check_span(len(files), config.fps)
    return files


def _check_stamps(folder: Path, files: list[Path], fps: float, used: slice) -> None:
    """Raise ConfigError where a list of times beside the images says another rate than ``fps``, or unequal steps."""
    path = next((p for p in (folder / "timestamps.txt", folder.parent / "timestamps.txt") if p.is_file()), None)
    if path is None:
        return
    # A list that does not say its unit is compared in the one that fits best.
    known: list[np.ndarray] = []
    for unit in (None, *NANOSECONDS):
        with contextlib.suppress(Undeclared):
            known.append(np.diff(np.array(read_timestamps(path, unit).times_ns[used], np.float64)) * 1e-9)
            if unit is None:
                break
    steps = min(known, key=lambda one: abs(np.log(max(float(np.median(one)), 1e-12) * fps)) if len(one) else 0.0)
    if len(steps) + 1 != len(files) or not len(steps):
        return
    if np.abs(steps * fps - 1).max() > _UNEQUAL:
        raise ConfigError(
            f"{path} says other times",
            where="frames.fps",
            value=fps,
            accepted=f"{1 / np.median(steps):.6g}, and equal steps (they are {steps.min():.6g} to {steps.max():.6g} s)",
        )


def _folder_of_flow(folder: Path, flow: str) -> Path:
    # {0} is the folder's own name, {1} its parent's, …: other sets keep the flow of a scene in a tree of its own.
    parts = folder.absolute().parts[::-1]
    named = re.sub(r"\{(\d)\}", lambda digit: parts[min(int(digit[1]), len(parts) - 1)], flow)
    place = Path(os.path.normpath(folder / named))
    if not place.is_dir():
        raise AssetError("no such folder", where=str(place))
    return place


@dataclass(frozen=True)
class GivenFlow:
    """Flow files of frames 0, 1, …; the k-th leads from frame k to k + 1 or, ``backward``, from frame k + 1 to k.

    masks : files of pixels that are hidden at the flow's end, or none.   notes : what was guessed or left out."""

    files: list[Path]
    masks: list[Path]
    backward: bool = False
    notes: tuple[str, ...] = ()

    @property
    def direction(self) -> str:
        """Return "forward" or "backward"."""
        return "backward" if self.backward else "forward"

    def of_frame(self, number: int) -> int:
        """Return which file begins at frame ``number``."""
        return number - self.backward


def flow_files(folder: Path, frames: FramesConfig, images: list[Path]) -> GivenFlow:
    """Return the flow of the frames ``images`` of :func:`used_images`. Raises AssetError: no folder, too few, or, by
    the numbers in their names, one missing in between."""
    if frames.flow is None:
        return GivenFlow([], [])
    where, pairs = _folder_of_flow(folder, frames.flow), len(images) - 1
    is_mask = lambda path: path.stem.endswith("_mask")
    flows, masks = series(where, READ_ENDINGS, lambda path: not is_mask(path)), series(where, READ_ENDINGS, is_mask)
    notes = flows.notes + masks.notes
    backward = frames.flow_direction == "backward"
    if frames.flow_direction == "auto" and flows.files:
        backward = _BACKWARD.search(f"{where.name}/{flows.files[0].name}") is not None
        if backward:
            notes.append(f"{where.name}: flow to the frame before, as the names say (frames.flow_direction: forward)")
    recorded = len(series(images[0].parent, IMAGE).files)
    # With one a frame, the first frame's leads out of the sequence.
    first = frames.first + (backward and len(flows.files) == recorded)
    if len(flows.files) < first + pairs or (masks.files and len(masks.files) < first + pairs):
        raise AssetError(
            "not one flow file per pair of frames",
            where=str(where),
            value=f"{max(len(flows.files) - first, 0)} flow files, {len(masks.files)} masks",
            accepted=f"at least {pairs} for {len(images)} frames",
        )
    used = slice(first, first + pairs)
    # Files are used in the order of their names; a missing one would shift all later pairs.
    for files in (flows.files, masks.files):
        _check_in_step(files[used], images[1:] if backward else images, shifted=len(files) == recorded - 1)
    return GivenFlow(flows.files[used], masks.files[used], backward, tuple(notes))


def _check_in_step(files: list[Path], images: list[Path], shifted: bool) -> None:
    """Check that the first numbers in the names of ``files`` equal those of ``images`` or, where they may be
    ``shifted`` (frames from 0, flow from 1), increase with them. Names without numbers are not checked. Raises
    AssetError."""
    numbers = [(_number(file), _number(image)) for file, image in zip(files, images)]
    offsets = [of_file - of_image for of_file, of_image in numbers if of_file is not None and of_image is not None]
    if len(offsets) < len(numbers):
        return
    for file, image, offset in zip(files, images, offsets):
        if offset != (offsets[0] if shifted else 0):
            raise AssetError(
                "the files do not match the frames: one is missing before it, or the numbers in their names differ",
                where=str(file),
                value=f"it would go with {image.name}",
                accepted="the same numbers",
            )


def _number(path: Path) -> int | None:
    digits = re.search(r"\d+", path.stem)
    return None if digits is None else int(digits[0])


def read_flow_of(path: Path, size: tuple[int, int], form: str | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return flow (H, W, 2) float32 px and valid (H, W) bool of frames of (H, W) px. Raises AssetError: unreadable,
    another size."""
    flow, valid = read_flow(path, form)
    if flow.shape[:2] != size:
        raise AssetError("flow and image differ in size", where=str(path), value=flow.shape[:2], accepted=str(size))
    return flow, valid


def read_mask_of(path: Path, size: tuple[int, int]) -> np.ndarray:
    """Return a mask, (H, W) bool, of frames of (H, W) px. Raises AssetError: unreadable, another size."""
    mask = read_npy(path) if path.suffix == ".npy" else read_any_image(path)
    if mask.shape != size:
        raise AssetError("mask and image differ in size", where=str(path), value=mask.shape, accepted=str(size))
    return mask != 0


RECORDED = ("images", "flow_forward", "flow_backward", "occlusion_forward", "occlusion_backward")
"""Labels that recorded frames may have."""


class RecordedSequence(SensorSimulation):
    """A sequence of the ``index``-th folder of frames; see :class:`SensorSimulation`.

    Label k is the flow from frame k + 1 to k + 2 (counted in the frames used), so that every label has a full interval
    of events before it, as in rendered sequences. Its ``config`` names the folder.   files : the images.   flow : the
    files of labels.
    Raises BlinkGLError: unreadable or unequal frames, flow that does not fit them, frames too far apart."""

    def __init__(self, request: SequenceRequest):
        config, clock, frames = request.config, StageClock(), request.config.frames
        assert frames is not None
        self._recorded = frames
        self._report = SimulationReport()
        self.folder = folder_of(frames, request.index, request.base)
        self.files = used_images(frames, self.folder)
        self._report.notes += series(self.folder / frames.images, IMAGE).notes  # what is left out of the folder
        self.flow = flow_files(self.folder, frames, self.files)
        self._report.notes += self.flow.notes
        asked = config.labels.flow
        if request.labels and self.flow.files and asked and self.flow.direction not in asked:
            raise ConfigError(
                f"the flow of these frames leads {self.flow.direction}",
                where="labels.flow",
                value=list(asked),
                accepted=f"[{self.flow.direction}], or frames.flow: null",
            )
        self._kept: dict[int, np.ndarray] = {
            0: read_any_image(self.files[0])
        }  # read already, together with an image of a later label
        size = self._kept[0].shape[:2]
        self._form = None if frames.flow_format == "auto" else frames.flow_format
        if self.flow.files and self._form is None:
            self._form, note = flow_form(self.flow.files[0])
            self._report.notes += [note] if note else []
        with clock("scene"):
            if frames.max_displacement is not None:
                for first, flow in zip(self.files, self.flow.files):
                    _refuse_far_apart(first, *read_flow_of(flow, size, self._form), frames.max_displacement)
            if frames.check_flow:
                self._check_flow(size)
        resolved = config.model_copy(
            update={"frames": frames.model_copy(update={"folders": (os.path.relpath(self.folder, request.base),)})}
        )
        camera = (
            EventCamera(
                config.events.beside(request.base),
                config.readout,
                size[0],
                size[1],
                kernel_seed(config.seed, request.index, Role.EVENTS),
                make=make_on_device,
            )
            if request.events
            else None
        )
        self._step: Step
        pictures_hz = None if request.pictures_hz is None else min(request.pictures_hz, frames.fps * 8)
        super().__init__(
            request,
            resolved.cameras()[0],
            clock,
            size=size,
            span_ns=(0, self._time_of(len(self.files) - 1, frames.fps)),
            camera=camera,
            pictures_hz=pictures_hz,
        )

    def _resume(self) -> None:
        """Nothing is drawn here."""

    def _check_flow(self, size: tuple[int, int]) -> None:
        """Raise AssetError for flow that contradicts the images, on a few pairs spread over the sequence."""
        files, back = self.flow.files, self.flow.backward
        chosen = np.unique(np.linspace(0, len(files) - 1, _CHECKED_PAIRS if files else 0).astype(int))
        ends = {k: [read_any_image(self.files[n]) for n in ((k + 1, k) if back else (k, k + 1))] for k in chosen}
        pairs = [(one, other, *read_flow_of(files[k], size, self._form)) for k, (one, other) in ends.items()]
        if pairs and not any(valid.any() for _, _, _, valid in pairs):
            raise AssetError(
                "no pixel of the flow is valid",
                where=str(files[int(chosen[0])]),
                value=f"read as {self._form}",
                accepted="a third channel that is not 0 where flow is valid, or frames.check_flow: false",
            )
        if (fitting := factor_that_fits([pair for pair in pairs if pair[0].shape == pair[1].shape])) is not None:
            factor, error, own = fitting
            other_way = f"frames.flow_direction: {'forward' if back else 'backward'}"
            what = {0.0: "no motion at all", -1.0: f"its negative ({other_way}?)"}
            raise AssetError(
                f"the flow contradicts its images: {what.get(factor, f'its {factor:g}-fold')} explains them better",
                where=str(files[int(chosen[0])]),
                value=f"error {error:.2g} for {own:.2g} of the contrast, flow read as {self._form}",
                accepted="frames.flow_format, frames.flow_direction, or frames.check_flow: false",
            )

    @staticmethod
    def _time_of(k: int, fps: float) -> int:
        return round(k * 1e9 / fps)

    def _given(self) -> Iterator[tuple[np.ndarray, int, str]]:
        # The emulator is a frame ahead of the labels: what one of them shows need not be read twice.
        keep = self._labels and "images" in asked_for(self.config.labels)
        for k, file in enumerate(self.files):
            frame = self._kept.pop(0) if k == 0 else read_any_image(file)
            if keep and k:
                self._kept[k] = frame
            yield frame, self._time_of(k, self._recorded.fps), str(file)

    def _event_pass(self) -> Iterator[tuple[int, Events]]:
        frames, stated = self._recorded, open_stills(self.files[0])
        assert self.camera is not None
        ask = frames.white_level is None and frames.range is None and self._kept[0].dtype == np.uint16
        levels = stated_levels(self.files, ask=ask)
        steps = stepped(
            timed(self._given()),
            self.camera,
            FrameUse(
                Codes(frames.gamma, frames.white_level, frames.range, transfer=stated.transfer, levels=levels),
                frames.interpolate,
                frames.max_px,
                frames.keep_noise,
            ),
            report=self._report,
        )
        while True:
            with self.clock("events"):  # reading and interpolating, too
                step = next(steps, None)
            if step is None:
                return
            self._step = step
            yield step.t_ns, step.events

    def _label_times(self) -> Iterator[tuple[int, int]]:
        return ((k - 1, self._time_of(k, self._recorded.fps)) for k in range(1, len(self.files)))

    def _truth(self, k: int, t_ns: int) -> GroundTruth:
        number, request, values = k + 1, asked_for(self.config.labels), {}  # number: of the frame
        if "images" in request:
            values["images"] = self._kept.pop(number) if number in self._kept else read_any_image(self.files[number])
        way, file = self.flow.direction, self.flow.of_frame(number)
        if number == len(self.files) - 1 or not self.flow.files or f"flow_{way}" not in request:
            return GroundTruth(k, t_ns, LabelFrame(t_ns, values))
        size, frames = (self.height, self.width), self._recorded
        values[f"flow_{way}"] = Flow(*read_flow_of(self.flow.files[file], size, self._form))
        if self.flow.masks and f"occlusion_{way}" in request:
            values[f"occlusion_{way}"] = read_mask_of(self.flow.masks[file], size)
        before_ns = self._time_of(number - 1, frames.fps) if self.flow.backward else None
        return GroundTruth(k, t_ns, LabelFrame(t_ns, values), self._time_of(number + 1, frames.fps), before_ns)

    def truth(self, t_ns: int, span_ns: int) -> GroundTruth:
        raise ConfigError("recorded frames have ground truth only at their own times", where="frames")

    def _picture(self, t_ns: int) -> Picture:
        return Picture(t_ns, self._step.luminance())

    @property
    def notes(self) -> list[str]:
        return [*self._report.notes, *self._report.caveats]

    def poses(self) -> dict[str, np.ndarray]:
        return {}

    def facts(self) -> dict[str, object]:
        return {
            "source": {
                "folder": self.folder.name,
                "images": len(self.files),
                "first": self.files[0].name,
                "last": self.files[-1].name,
                **({"notes": self.notes} if self.notes else {}),
            },
        }


def _refuse_far_apart(first: Path, flow: np.ndarray, valid: np.ndarray, most: float) -> None:
    """Raise AssetError where the motion to the next frame is too large for interpolation."""
    length = np.hypot(flow[..., 0], flow[..., 1])[valid]
    far = float(np.percentile(length, 99)) if length.size else 0.0
    if far > most:
        raise AssetError(
            "too far from the next frame for interpolation",
            where=str(first),
            value=f"{far:.3g} px",
            accepted=f"at most {most:g} px (frames.max_displacement), or frames.max_displacement: null",
        )
