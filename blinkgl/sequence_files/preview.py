"""preview.mp4: frames, events and flow colours side by side, with the time; made while the sequence is generated."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from blinkgl.io.colour import count_events, event_colour, flow_colour, flow_wheel
from blinkgl.io.video import VideoWriter
from blinkgl.srgb import to_srgb8, tone_mapped
from blinkgl.timeline.sampling import Ticks
from blinkgl.types.events import Events

_BAR = 30
_GAP = 4
_BACK, _TEXT, _DIM = (22, 24, 28), (235, 238, 242), (150, 156, 166)
_MAX_PANEL_HEIGHT, _LEAST_PANEL_WIDTH = 360, 256
_EVENTS_PER_PIXEL = 0.35
"""Most events of a picture: of more, the newest are shown, since edges and textures would cover each other."""
_LEGEND = 27


class Panels:
    """The picture of one camera: frame, events and flow side by side. Frames are taken at ``rate_hz`` of simulated time
    and played at ``fps``, i.e. slowed by ``rate_hz / fps``.

    height, width : sensor size, px.   t0_us : start.   flow : False leaves the flow panel out.   label : of the frame.
    canvas : (h, w, 3) uint8, the composed picture."""

    def __init__(
        self,
        height: int,
        width: int,
        *,
        t0_us: int = 0,
        flow: bool = True,
        rate_hz: float = 40,
        fps: float = 20,
        label: str = "frame",
    ):
        self._counts = np.zeros((2, height, width), np.uint16)
        self._shown: list[Events] = []
        self._most, self._pending = max(1, round(_EVENTS_PER_PIXEL * height * width)), 0
        self._noise: int | None = None  # of the pending events; None: unknown
        factor = min(1.0, _MAX_PANEL_HEIGHT / height)
        if height < 200:  # whole pixels, with room for the captions
            factor = max(2, min(_MAX_PANEL_HEIGHT // height, math.ceil(_LEAST_PANEL_WIDTH / width)))
        # Video with halved chroma needs even sides.
        self._panel = (max(2, round(width * factor / 2) * 2), max(2, round(height * factor / 2) * 2))  # (w, h), even
        self._ticks, self._t0_us = Ticks(t0_us, rate_hz), t0_us
        self._slow = rate_hz / fps
        self._names = [label, "events", "optical flow"][: 3 if flow else 2]
        w, h = self._panel
        self._canvas = np.empty((h + _BAR, len(self._names) * (w + _GAP) - _GAP, 3), np.uint8)
        self._canvas[:] = _BACK
        self._flow_max, self._brightest = 0.0, 1.0
        self._has_flow = flow
        self._font, self._small = ImageFont.load_default(14), ImageFont.load_default(11)
        if flow:
            self._panel_view(2)[:] = (32, 34, 38)
            self._caption(2)

    @property
    def canvas(self) -> np.ndarray:
        return self._canvas

    def add_events(self, events: Events) -> None:
        """Add events to those of the next frame."""
        self._shown.append(events)
        while sum(map(len, self._shown[1:])) >= self._most:
            del self._shown[0]
        self._pending += len(events)
        if events.cause is not None:
            self._noise = (self._noise or 0) + int(np.count_nonzero(events.cause))

    def set_flow(self, flow: np.ndarray) -> None:
        """Set flow, (H, W, 2) px. Full saturation follows the 95th percentile of speed: up at once,
        down slowly, so that a passing object does not fade the rest and colours do not flicker."""
        if not self._has_flow:
            return
        # Every fourth pixel in x and y is enough for a percentile.
        speed = np.hypot(flow[::4, ::4, 0], flow[::4, ::4, 1])
        speed = speed[np.isfinite(speed)]
        if speed.size:
            # The scale follows larger motion at once and smaller slowly, so that colours do not flicker.
            self._flow_max = max(0.95 * self._flow_max, float(np.percentile(speed, 95)))
        nearest = lambda a: cv2.resize(a, self._panel, interpolation=cv2.INTER_NEAREST)  # keeps edges sharp
        self._panel_view(2)[:] = flow_colour(nearest(np.asarray(flow, np.float32)), self._flow_max or None)
        self._legend()
        self._caption(2, f"full colour = {self._flow_max:.3g} px")

    def due(self, t_us: int) -> bool:
        """Return whether :meth:`frame` at this time would be shown."""
        return self._ticks.due(t_us)

    def compose(self, t_us: int, image: np.ndarray) -> int:
        """Draw :attr:`canvas`; return for how many periods it is shown: those that have passed, 0 for none.
        image : (H, W[, 3]) float linear light, whose highlights are compressed where they exceed 1, or uint8 sRGB."""
        if not self.due(t_us):
            return 0
        small = self._fit(image)  # first: cheaper, and averages linear light
        small = self._toned(small) if small.dtype.kind == "f" else small
        shown = np.repeat(small[..., None], 3, axis=2) if small.ndim == 2 else small
        self._panel_view(0)[:] = shown
        self._caption(0, f"{(t_us - self._t0_us) / 1000:.1f} ms", f"slowed {self._slow:g}x")
        self._show_events()
        return self._ticks.passed(t_us)

    def _show_events(self) -> None:
        """Draw the newest pending events, and forget all."""
        few = min(self._most, self._pending)
        newest = Events.concatenate(self._shown) if self._shown else Events.empty()
        newest = newest.part(slice(len(newest) - few, None))
        self._counts[:] = 0
        count_events(newest.x, newest.y, newest.p, self._counts)
        self._panel_view(1)[:] = self._fit(event_colour(self._counts))
        cut = () if few == self._pending else (f"the newest {few:,}",)
        share = () if self._noise is None else (f"{100 * self._noise / max(self._pending, 1):.0f} % noise",)
        self._caption(1, f"{self._pending:,}", *cut, "ON blue, OFF red", *share)
        self._shown, self._pending, self._noise = [], 0, None if self._noise is None else 0

    def _toned(self, image: np.ndarray) -> np.ndarray:
        """Return uint8 sRGB without clipping. The assumed maximum follows a brighter picture at once and a darker one
        slowly, so that a passing light does not make the rest flicker."""
        self._brightest = max(1.0, 0.95 * self._brightest, float(np.nan_to_num(image, nan=0.0, posinf=0.0).max()))
        return to_srgb8(tone_mapped(image, self._brightest))

    def _panel_view(self, panel: int) -> np.ndarray:
        w, h = self._panel
        left = panel * (w + _GAP)
        return self._canvas[_BAR : _BAR + h, left : left + w]

    def _fit(self, image: np.ndarray) -> np.ndarray:
        larger = self._panel[1] > image.shape[0]
        return cv2.resize(image, self._panel, interpolation=cv2.INTER_NEAREST if larger else cv2.INTER_AREA)

    def _caption(self, panel: int, *details: str) -> None:
        """Write the panel's name, and as many of the details as there is room for."""
        w = self._panel[0]
        room = w - 24 - self._font.getlength(self._names[panel])
        while details and self._small.getlength("   ".join(details)) > room:
            details = details[:-1]
        strip = Image.new("RGB", (w, _BAR), _BACK)
        draw = ImageDraw.Draw(strip)
        draw.text((8, _BAR / 2), self._names[panel], fill=_TEXT, font=self._font, anchor="lm")
        draw.text((w - 8, _BAR / 2), "   ".join(details), fill=_DIM, font=self._small, anchor="rm")
        left = panel * (w + _GAP)
        self._canvas[:_BAR, left : left + w] = np.asarray(strip)

    def _legend(self) -> None:
        """Draw the colour wheel in the flow panel's lower right corner."""
        view = self._panel_view(2)
        size = 2 * _LEGEND + 1
        if min(view.shape[:2]) < 3 * size:
            return
        y, x = np.mgrid[-_LEGEND : _LEGEND + 1, -_LEGEND : _LEGEND + 1]
        inside = np.clip(_LEGEND + 0.5 - np.hypot(x, y), 0, 1)[..., None]  # one pixel of anti-aliasing
        wheel = cv2.resize(flow_wheel(), (size, size), interpolation=cv2.INTER_AREA)
        corner = view[-size - 6 : -6, -size - 6 : -6]
        # A dark ring with soft edges around the wheel.
        ring = np.clip(1.5 - np.abs(np.hypot(x, y) - _LEGEND), 0, 1)[..., None]
        mixed = corner * (1 - inside) + wheel * inside
        corner[:] = mixed * (1 - ring) + 60 * ring


class PreviewWriter(VideoWriter):
    """Streams a side-by-side video of one camera, or of several, one below the other; memory does not grow with the
    sequence.

        preview.panels[0].add_events(events)            every chunk
        preview.panels[0].set_flow(flow)                whenever a label exists; shown until the next
        if preview.panels[0].due(t_us):                 ask first: making the picture may be expensive
            preview.frame(t_us, image)

    path : ending decides the container, .mp4 usually.   panels : of each camera, of one ``rate_hz`` and ``fps``.

    Raises OutputError when the video cannot be written."""

    def __init__(self, path: str | os.PathLike, panels: Sequence[Panels], fps: float):
        self.panels = tuple(panels)
        heights = [one.canvas.shape[0] for one in self.panels]
        self._canvas = np.empty((sum(heights), max(one.canvas.shape[1] for one in self.panels), 3), np.uint8)
        self._canvas[:] = _BACK
        self._tops = np.cumsum([0, *heights[:-1]])
        height, width = self._canvas.shape[:2]
        super().__init__(path, height, width, fps, preset="superfast", crf=22)

    def frame(self, t_us: int, image: np.ndarray, number: int = 0) -> None:
        """Set the picture of the camera of this number, see :meth:`Panels.compose`; the last camera's picture completes
        the frame, which is then encoded, several times when more than one period has passed."""
        one, top = self.panels[number], self._tops[number]
        count = one.compose(t_us, image)
        if count:
            height, width = one.canvas.shape[:2]
            self._canvas[top : top + height, :width] = one.canvas
        if number == len(self.panels) - 1:
            for _ in range(count):
                self.write(self._canvas)
