"""A sequence of recorded frames: the E-Tartan way. Frames go through the emulator, the
frames' own flow becomes the label. :mod:`blinkgl.sequence.folders` says what a folder has to look like."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.errors import AssetError, ConfigError
from blinkgl.events.camera import EventCamera
from blinkgl.labels import Flow, LabelFrame, asked_for
from blinkgl.recordings.simulation import FrameUse, Step, stepped, timed
from blinkgl.rng import Role, kernel_seed
from blinkgl.sequence.clock import StageClock
from blinkgl.sequence.folders import flow_files, folder_of, read_flow_of, read_frame, read_mask_of, used_images
from blinkgl.sequence.items import GroundTruth, Picture
from blinkgl.sequence.request import SequenceRequest
from blinkgl.sequence.simulate import Simulation
from blinkgl.tensors.choice import make_on_device
from blinkgl.types.events import Events

RECORDED = ("images", "flow_forward", "occlusion_forward")
"""Labels that recorded frames may bring."""


class RecordedSequence(Simulation):
    """A sequence of the ``index``-th folder of frames; see :func:`~blinkgl.sequence.simulate.simulate_sequence`.

    Label k is the flow from frame k + 1 to k + 2 (counted in the frames used), so that every label has a full interval
    of events before it, as in drawn sequences. Its ``config`` names the folder.   files : the
    images.   flows, masks : files of labels, or none.
    Raises BlinkGLError: unreadable or unequal frames, flow that does not fit them, frames too far apart."""

    def __init__(self, request: SequenceRequest):
        config, clock, frames = request.config, StageClock(), request.config.frames
        assert frames is not None
        self._recorded = frames
        self.folder = folder_of(frames, request.index, request.base)
        self.files = used_images(frames, self.folder)
        self.flows, self.masks = flow_files(self.folder, frames, self.files)
        self._kept: dict[int, np.ndarray] = {
            0: read_frame(self.files[0])
        }  # read already, and an image of a label to come
        size = self._kept[0].shape[:2]
        if frames.max_displacement is not None:
            with clock("scene"):
                for first, flow in zip(self.files, self.flows):
                    _refuse_far_apart(first, *read_flow_of(flow, size), frames.max_displacement)
        resolved = config.model_copy(
            update={"frames": frames.model_copy(update={"folders": (os.path.relpath(self.folder, request.base),)})}
        )
        camera = (
            EventCamera(
                config.events,
                config.readout,
                *size,
                kernel_seed(config.seed, request.index, Role.EVENTS),
                make=make_on_device,
            )
            if request.events
            else None
        )
        self._step: Step
        pictures_hz = None if request.pictures_hz is None else min(request.pictures_hz, frames.fps * 8)
        super().__init__(
            replace(request, config=resolved, pictures_hz=pictures_hz),
            clock,
            size=size,
            span_ns=(0, self._time_of(len(self.files) - 1, frames.fps)),
            camera=camera,
        )

    def _resume(self) -> None:
        """Nothing is drawn here."""

    @staticmethod
    def _time_of(k: int, fps: float) -> int:
        return round(k * 1e9 / fps)

    def _given(self) -> Iterator[tuple[np.ndarray, int, str]]:
        keep = self._labels and "images" in asked_for(self.config.labels)
        for k, file in enumerate(self.files):
            frame = self._kept.pop(0) if k == 0 else read_frame(file)
            if keep and k:
                self._kept[k] = frame
            yield frame, self._time_of(k, self._recorded.fps), str(file)

    def _event_pass(self) -> Iterator[tuple[int, Events]]:
        frames = self._recorded
        steps = stepped(
            timed(self._given()),
            self.camera,
            FrameUse(frames.gamma, frames.interpolate, frames.max_px, frames.keep_noise),
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
            values["images"] = self._kept.pop(number) if number in self._kept else read_frame(self.files[number])
        if number == len(self.files) - 1 or not self.flows or "flow_forward" not in request:
            return GroundTruth(k, t_ns, LabelFrame(t_ns, values))
        size = (self.height, self.width)
        values["flow_forward"] = Flow(*read_flow_of(self.flows[number], size))
        if self.masks and "occlusion_forward" in request:
            values["occlusion_forward"] = read_mask_of(self.masks[number], size)
        return GroundTruth(k, t_ns, LabelFrame(t_ns, values), forward_ns=self._time_of(number + 1, self._recorded.fps))

    def truth(self, t_ns: int, span_ns: int) -> GroundTruth:
        raise ConfigError("recorded frames have ground truth at their own times alone", where="frames")

    def _picture(self, t_ns: int) -> Picture:
        return Picture(t_ns, self._step.luminance())

    def poses(self) -> dict[str, np.ndarray]:
        return {}

    def facts(self) -> dict[str, Any]:
        return {
            "source": {
                "folder": self.folder.name,
                "images": len(self.files),
                "first": self.files[0].name,
                "last": self.files[-1].name,
            },
        }


def _refuse_far_apart(first: Path, flow: np.ndarray, valid: np.ndarray, most: float) -> None:
    """AssetError where things move so far to the next frame that what lies between cannot be interpolated."""
    length = np.hypot(flow[..., 0], flow[..., 1])[valid]
    far = float(np.percentile(length, 99)) if length.size else 0.0
    if far > most:
        raise AssetError(
            "too far from the next frame to be interpolated",
            where=str(first),
            value=f"{far:.3g} px",
            accepted=f"at most {most:g} px (frames.max_displacement), or frames.max_displacement: null",
        )
