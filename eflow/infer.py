"""Inference: padding, windows of a stream, a network or a method that is called with them."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F

from blinkgl.errors import ConfigError, EventDataError
from blinkgl.io.formats import EventFile, open_events
from blinkgl.io.reading import AS_FILE, EventReading
from blinkgl.types.events import Events
from eflow.data.representation import VoxelGrid, grids_of
from eflow.data.window import SIDES, RawSample, StreamWindow, Window, hit_pixels
from eflow.methods import Method
from eflow.methods.contrast import sharpest_length
from eflow.methods.dominant import toward_dominant
from eflow.models import FlowModel, FlowPrediction
from eflow.ops.resample import forward_warp
from eflow.shipped import is_shipped
from eflow.types import Batch, Flow, Grid

PICTURED = VoxelGrid(bins=2, normalise="none")
"""Grid for the pictures of a method, which reads events and no grid."""


def pad_batch(batch: Batch, model: FlowModel) -> tuple[Batch, int, int]:
    """Return the batch with old and new padded by zeros to a size that the network accepts, and the (left, top) of the
    original image in it.

    Padding is at the right and bottom, to multiples of the network's stride: less than one low-resolution token is
    added on a side, and no token is padding alone. A network can ask for another padding (``pad_to``,
    ``pad_start``)."""
    height, width = batch["new"].shape[-2:]
    multiple = model.pad_to or model.divisor
    # -width % multiple is what is missing to the next multiple.
    right, down = -width % multiple, -height % multiple
    left, top = (right, down) if model.pad_start else (0, 0)
    pad = (left, right - left, top, down - top)
    return {**batch, **{k: F.pad(batch[k], pad) for k in SIDES if k in batch}}, left, top


@torch.inference_mode()
def predict(model: FlowModel, batch: Batch, *, precision: str = "fp32") -> FlowPrediction:
    """Return the prediction of the model in evaluation mode, at the size of the batch.

    batch : old, new (N, C, H, W), optional flow_init. Raises EventDataError: smaller than ``model.least``."""
    height, width = batch["new"].shape[-2:]
    if min(height, width) < model.least:
        raise EventDataError(
            "input is too small for the network",
            where=type(model).__name__,
            value=(height, width),
            accepted=f"at least {model.least} px a side",
        )
    device = next(model.parameters()).device
    batch = {k: v.to(device) for k, v in batch.items() if torch.is_tensor(v)}
    was_training = model.training
    model.eval()
    try:
        with torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16"):
            padded, left, top = pad_batch(batch, model)
            out = model(padded)
    finally:
        model.train(was_training)
    # Padding and bf16 stay in here: callers get float32 at the size of their batch.
    return FlowPrediction(
        [f[..., top : top + height, left : left + width].float() for f in out.flows],
        out.kind,
        out.has_match,
        out.low,
    )


def within(flow: Flow, before: Flow | None, share: float) -> Flow:
    """Return the flow (H, W, 2) px from t to t + share · Δ of the flow t -> t + Δ: at the constant acceleration between
    it and the flow ``before``, t - Δ -> t, where that leads to the pixel, else at constant velocity.

    With acceleration a px/Δ², F = v + a / 2 and P = v - a / 2, and the way is v s + a s² / 2."""
    if share == 1:
        return flow
    if before is None:
        return flow * np.float32(share)
    moved = forward_warp(torch.from_numpy(before).permute(2, 0, 1)[None])[0].permute(1, 2, 0).numpy()
    acceleration = np.where(moved.any(-1, keepdims=True), flow - moved, 0)
    return (share * flow - 0.5 * share * (1 - share) * acceleration).astype(np.float32)


def largest_change(model: FlowModel, other: FlowModel) -> float:
    """Return the largest difference between the flows of two networks of one kind, px, for 20,000 random events."""
    rng, count, side = np.random.default_rng(0), 20_000, 128
    x, y = rng.integers(side, size=(2, count)).astype(np.uint16)
    t, p = np.sort(rng.integers(20_000, size=count)), rng.integers(2, size=count).astype(np.uint8)
    half = count // 2
    middle = int(t[half])
    windows = {
        "old": Window(x[:half], y[:half], t[:half], p[:half], 0, middle),
        "new": Window(x[half:], y[half:], t[half:], p[half:], middle, 20_000),
    }
    batch = {k: torch.from_numpy(model.representation(windows[k], side, side))[None] for k in model.reads}
    return float((predict(model, batch).flow - predict(other, batch).flow).abs().max())


def windows(
    file: EventFile,
    span_us: int,
    *,
    start_us: int | None = None,
    end_us: int | None = None,
    reads: Sequence[str] = SIDES,
) -> Iterator[StreamWindow]:
    """Yield the successive windows of an event file, at reference times start + Δ, start + 2Δ, … while both windows are
    inside [start, end). If only the new window is read, the first reference time is start.

    start_us, end_us : default: the time of the first event, and that of the last + 1.
    The file is streamed: two windows and a chunk are in memory.
    Raises EventDataError: :data:`JUMP` windows in a row have no event; a clock that jumps would give billions."""
    pending, t, skipped = Events.empty(), None, span_us if "old" in reads else 0
    last = 0
    for chunk in file.chunks():
        pending = Events.concatenate([pending, chunk])
        if t is None or start_us is None:
            start_us = int(pending.t[0]) if start_us is None else start_us
            t = start_us + skipped
        last = int(chunk.t[-1])
        while last >= t + span_us and (end_us is None or t + span_us <= end_us):
            if pending.t[0] > t + JUMP * span_us:
                raise EventDataError(
                    f"event times jump by {(int(pending.t[0]) - t) * 1e-6:.6g} s",
                    where=f"{file.path}, {(t - start_us) / 1000:.15g} ms after the first",
                    accepted="--end-ms before the jump or --start-ms after it",
                )
            yield StreamWindow.of(pending, t - span_us, t, t + span_us)
            # The next pair begins with this one's new window.
            pending = pending.window(t, last + 1)
            t += span_us
        if end_us is not None and last >= end_us:
            return
        # Of the events before the first window the last ones stay, so that a silent one is no jump of the clock.
        pending = pending.window(min(t - span_us, last), last + 1)
    if t is not None and last + 1 >= t + span_us and (end_us is None or t + span_us <= end_us):
        yield StreamWindow.of(pending, t - span_us, t, t + span_us)


JUMP = 10_000
"""Number of empty windows in a row from which the clock of a recording is considered to have jumped."""
SHORTEST_PX = 2.0
"""Displacement in a window below which both shipped networks leave 0.25 to 0.65 of zero flow's error."""
FIRST_US = 30_000
"""Length of the windows that :func:`likely_span` looks at first, µs."""
LIKELY_PX = 5.0
"""Displacement in a window that :func:`likely_span` aims at, px: networks are trained on 2 to 8 px."""


def likely_span(
    file: EventFile,
    predictor: Callable[[StreamWindow], tuple[np.ndarray, np.ndarray]],
    reads: Sequence[str] = SIDES,
    ends: tuple[int, int] | None = None,
) -> tuple[int, int]:
    """Return (Δ, longest possible Δ) in µs, where Δ is the time in which motion is about :data:`LIKELY_PX`.

    The speed is the median of the predictor's own flow at pixels with events, at three places of the recording; Δ is
    changed until that speed fits it, or until the flow no longer grows with it. Δ is at least 1 ms and at most half of
    the recording, or all of it if the predictor ``reads`` only the new window. ends : the first and the last µs of the
    part of the recording that counts; None: all of it. Raises EventDataError: no events, or none at those places."""
    if ends is None and (ends := ends_of(file)) is None:
        raise EventDataError("holds no events", where=str(file.path))
    first, last = ends
    longest = max((last + 1 - first) // (2 if "old" in reads else 1), 1000)
    span = min(FIRST_US, longest)
    before: tuple[int, float] | None = None
    for _ in range(4):
        speeds = []
        for window in at_places(file, span, first, last, reads):
            flow, _ = predictor(window)
            speeds.append(float(np.median(np.hypot(*flow[window.new.y, window.new.x].T))))
        if not speeds:
            raise EventDataError(
                "no events at a quarter, half and three quarters of the recording",
                where=str(file.path),
                accepted="--window-ms in milliseconds instead of auto",
            )
        speed = max(1e-3, float(np.median(speeds)))  # in this order, NaN is 1e-3
        # In windows that are too long for a network its flow no longer grows with them, which would ask for still
        # longer ones: the last length stays for which it grew at least by half of what the length did. Where hardly
        # anything moves this says nothing.
        grows = before is None or span < before[0] or speed >= 0.5 * before[1] * (1 + span / before[0])
        if before is not None and not grows and before[1] > LIKELY_PX / 10:
            return before[0], longest
        before = span, speed
        # Not more at once: the speed was measured at another length of window.
        factor = min(max(LIKELY_PX / speed, 0.4), 2.5)
        span = int(min(max(span * factor, 1000), longest))
        if 0.8 < factor < 1.25:
            break
    return span, longest


def ends_of(file: EventFile) -> tuple[int, int] | None:
    """Return the times of the first and the last event, µs; None: there is none."""
    ends = [(int(c.t[0]), int(c.t[-1])) for c in file.chunks() if len(c)]
    return (ends[0][0], ends[-1][1]) if ends else None


def at_places(
    file: EventFile, span: int, first: int, last: int, reads: Sequence[str] = SIDES
) -> Iterator[StreamWindow]:
    """Yield a window, or pair, of ``span`` µs at a quarter, half and three quarters from ``first`` to ``last``; those
    without events are left out."""
    for place in (0.25, 0.5, 0.75):
        # The reference time is at the place, unless a window would pass an end of the recording.
        start = max(first, min(round(first + place * (last - first)) - span, last + 1 - len(reads) * span))
        window = next(windows(file, span, start_us=start, end_us=last + 1, reads=reads), None)
        if window is not None and all(len(getattr(window, name)) for name in reads):
            yield window


def whole_file(file: EventFile, reads: tuple[str, ...] = SIDES) -> tuple[StreamWindow, float]:
    """Return the whole file as one pair, and the factor from the flow of its new window to that of the whole file at
    constant velocity.

    The first half is the old window, the second half the new one. If a network ``reads`` only the new window, that is
    the whole file. Raises EventDataError: fewer than two events."""
    events = file.read()
    if len(events) < 2:
        raise EventDataError("fewer than two events", where=str(file.path))
    t0, t1 = int(events.t[0]), int(events.t[-1]) + 1
    t = (t0 + t1) // 2 if "old" in reads else t0
    return StreamWindow.of(events, t0, t, t1), (t1 - t0) / (t1 - t)


VIEWS = (1, 4, 8)
"""Views of the events whose flows a network's answer may be the mean of: as they are; mirrored along x, y and both,
too; all of these with swapped polarities, too. What is chance in a network's error is another in each of them."""


def default_views(name: str) -> int:
    """Return the views of `eflow predict`: 4 of a shipped network, which was trained on mirrored samples; 1 of others,
    which may know only one way up."""
    return 4 if is_shipped(name) else 1


class Predictor:
    """A network, or a method that needs no training, that is called with the windows of a stream, one after the other.

    warm_start : the refinement of each window starts from the flow of the previous one, moved along itself, where it
    follows it (networks with an iterated low-resolution flow only).   warm : number of windows that did.
    refine : draw each flow of a network towards its dominant motion (:func:`eflow.methods.dominant.toward_dominant`),
    then multiply it by the factor that makes the events of its windows sharpest
    (:func:`eflow.methods.contrast.sharpest_length`).   unsharpened : windows whose flow kept its length, by reason.
    views : a network's flow is the mean of that of :data:`VIEWS` of the events.
    reads : the windows of a pair that are read. A window without events, or with too few for a method, has zero
    flow."""

    def __init__(
        self,
        model: FlowModel | Method,
        height: int,
        width: int,
        *,
        warm_start: bool = False,
        refine: bool = False,
        views: int = 1,
    ):
        if views not in VIEWS:
            raise ConfigError("not a number of views", where="views", value=views, accepted="1, 4 or 8")
        self.model, self.height, self.width = model, height, width
        self.warm_start, self.refine, self.views = warm_start, refine, views
        self.reads = model.reads if isinstance(model, FlowModel) else SIDES
        self.unsharpened: Counter[str] = Counter()
        self.warm = 0
        self._before: tuple[tuple[str, int], list[torch.Tensor]] | None = None
        """Scene and end of the previous window, and the low-resolution flow of each of its views, if a window may
        start from it."""

    def __call__(self, window: StreamWindow | RawSample) -> tuple[Flow, Grid]:
        """Return the flow (H, W, 2) float32 px, t -> t + Δ, and the new window's event tensor (C, H, W) float32.

        Raises EventDataError: events outside the window or the sensor."""
        if not isinstance(self.model, FlowModel):
            seen = PICTURED(window.new, self.height, self.width)
            try:
                return self.model(window.old, window.new, self.height, self.width), seen
            except EventDataError:  # too few events
                return self._still(), seen
        grids = grids_of(self.model.representation, window, self.reads, (self.height, self.width))
        if not all(len(getattr(window, name)) for name in self.reads):
            return self._still(), grids["new"]
        flow = self._predicted(window, grids)
        return self._refined(window, flow) if self.refine else flow, grids["new"]

    def _still(self) -> Flow:
        """Return zero flow for a window that tells none; the next one does not start from it."""
        self._before = None
        return np.zeros((self.height, self.width, 2), np.float32)

    def _predicted(self, window: StreamWindow | RawSample, grids: dict[str, Grid]) -> Flow:
        assert isinstance(self.model, FlowModel)
        before, lows, total = None, [], torch.zeros(())
        if self._before is not None and self._before[0] == (window.scene, window.new.t0):
            self.warm += 1
            before = self._before[1]
        # One after the other: correlations of eight views of a large sensor would not fit into memory.
        for k, (view, axes) in enumerate(self._seen(window, grids)):
            batch = {name: torch.from_numpy(grid)[None].flip(axes) for name, grid in view.items()}
            if before is not None:
                batch["flow_init"] = forward_warp(before[k])
            prediction = predict(self.model, batch)
            if self.warm_start and prediction.low is not None:
                lows.append(prediction.low)
            sign = torch.tensor([-1.0 if axis in axes else 1.0 for axis in (3, 2)])
            total = total + prediction.flow.flip(axes)[0].permute(1, 2, 0).cpu() * sign
        if lows:
            self._before = (window.scene, window.new.t1), lows
        return (total / self.views).numpy()

    def _seen(
        self, window: StreamWindow | RawSample, grids: dict[str, Grid]
    ) -> Iterator[tuple[dict[str, Grid], tuple[int, ...]]]:
        """Yield the tensors of every view, and the axes of (N, C, H, W) along which they are still to be mirrored."""
        assert isinstance(self.model, FlowModel)
        polarities = [grids]
        if self.views == 8:
            swapped = replace(window, old=window.old.inverted(), new=window.new.inverted())
            polarities.append(grids_of(self.model.representation, swapped, self.reads, (self.height, self.width)))
        for view in polarities:
            yield from ((view, axes) for axes in ((), (3,), (2,), (2, 3))[: self.views])

    def _refined(self, window: StreamWindow | RawSample, flow: Flow) -> Flow:
        read = [getattr(window, name) for name in self.reads]
        flow = toward_dominant(flow, hit_pixels(read, self.height, self.width))
        follows = len(window.old) and window.old.t1 == window.new.t0
        factor, why = sharpest_length([window.old, window.new] if follows else [window.new], flow)
        if why:
            self.unsharpened[why] += 1
        return flow * np.float32(factor)


def open_sized(path: str | os.PathLike, reading: EventReading = AS_FILE) -> EventFile:
    """Open an event file with its sensor size: declared, stored, or the smallest known sensor that contains its
    events."""
    return open_events(path, reading).sized()


def sensor_of(file: EventFile) -> tuple[int, int]:
    """Return (height, width) px of a file that :func:`open_sized` opened."""
    assert file.height is not None and file.width is not None
    return file.height, file.width


# ---------------------------------------------------------------------------------------------------------------------
# Warnings about a recording: clock ticks instead of µs, a few pixels with most of the events.
#
# They are not errors, since a network still returns a flow; but that flow is useless.

SLOWEST, FASTEST = 1e-3, 1e4
"""Plausible events per second and pixel: a dark still scene has 0.05; a refractory period of 100 µs allows 10,000."""
FLOOD, FEW = 0.5, 0.005
"""Pixels are called hot if the share ``FEW`` of all pixels has more than the share ``FLOOD`` of all events."""
_ENOUGH = 1000


def doubts(events: Events, height: int, width: int) -> list[str]:
    """Return warnings, one line each, about the first events of a recording of (height, width) px."""
    if len(events) < _ENOUGH:
        return []
    lines = []
    seconds = max(int(events.t[-1]) - int(events.t[0]), 1) * 1e-6
    rate = len(events) / seconds / (height * width)
    if not SLOWEST <= rate <= FASTEST:
        other = "ns, or ticks of the camera's clock" if rate < SLOWEST else "ms, or ticks of a slower clock"
        lines.append(
            f"{rate:.2g} events per second and pixel; cameras give 0.05 to 1000. Are the times {other}, instead of µs?"
        )
    counts = np.bincount(events.pixel(width), minlength=height * width)
    few = max(round(FEW * counts.size), 1)
    # The largest counts, without sorting all.
    share = np.partition(counts, -few)[-few:].sum() / len(events)
    if share > FLOOD:
        lines.append(
            f"{few} pixels ({100 * FEW:g} %) have {100 * share:.0f} % of the events: hot pixels or a flickering light; "
            "flow there is not motion"
        )
    return lines
