"""What happens in a sequence, in the order in which it does. All arrays are the receiver's to keep."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from blinkgl.imaging import CameraImage
from blinkgl.labels import LabelFrame
from blinkgl.types.events import Events


@dataclass(frozen=True, eq=False)
class EventChunk:
    """The events that have left the sensor since the chunk before.

    t_ns : with this chunk, every event before this time's microsecond, t_ns // 1000, has been
    given.   events : t in µs; may be empty."""

    t_ns: int
    events: Events


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """What is true at a label's time. Every event before its microsecond, t_ns // 1000,
    came before it, and no other did.

    k : number of the label, from 0.   t_ns : its time, ns.
    frame : what ``labels:`` asks for, as :class:`LabelFrame` says; images as they were drawn, float32 linear light, or
    as they were recorded, sRGB codes. At the last time of a sequence, from where nothing leads on, images alone.
    forward_ns, backward_ns : where it leads, ns; None: nowhere.
    T_world_cam : (4, 4) float64, OpenCV axes.   T_world_obj : (n, 4, 4) float64, n objects.
    Both are None where nobody knows (recorded frames)."""

    k: int
    t_ns: int
    frame: LabelFrame
    forward_ns: int | None = None
    backward_ns: int | None = None
    T_world_cam: np.ndarray | None = None
    T_world_obj: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Picture:
    """How it looks at t_ns, for somebody who watches: comes after the events up to then.

    image : (H, W, 3) or (H, W) float32 linear light.   velocity : (H, W, 2) float32 px/s, or None
    where nobody knows (recorded frames)."""

    t_ns: int
    image: np.ndarray
    velocity: np.ndarray | None = None


Item = EventChunk | GroundTruth | CameraImage | Picture
