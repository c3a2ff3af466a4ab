"""The request of a sequence as one value, and its items in time: events, ground truth, pictures."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from blinkgl.config.sequence import SequenceConfig
from blinkgl.errors import ConfigError
from blinkgl.imaging import CameraImage
from blinkgl.labels import LabelFrame
from blinkgl.machine.compiling import compiled_s, working_clock
from blinkgl.render.renderer import Renderer
from blinkgl.scene.types import Scene
from blinkgl.types.events import Events


@dataclass(frozen=True, eq=False)
class SequenceRequest:
    """Sequence ``index`` of a run, or a part of it.

    config : every value as drawn.   base : folder that relative paths in it start from.
    events, labels : False leaves them out, ``labels`` ground truth and the frame camera's images; labels and images
    that the configuration does not request are always left out. Nothing is drawn unless it is used.
    pictures_hz : pictures per second of simulated time, at the frames of the event pass; None: none.
    scene : an existing one, instead of the configuration's.   renderer : an existing one of a single camera, which is
    not released at the end; its scene is drawn.
    window_ns : first and last time, ns, instead of the whole sequence. (These three: only for rendered sequences.)
    Raises ConfigError for parts that exclude each other."""

    config: SequenceConfig
    index: int = 0
    base: Path = field(default_factory=Path)
    events: bool = True
    labels: bool = True
    pictures_hz: float | None = None
    scene: Scene | None = None
    renderer: Renderer | None = None
    window_ns: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        if self.pictures_hz is not None and not self.events:
            raise ConfigError(
                "pictures need event frames",
                where="pictures_hz",
                value=self.pictures_hz,
                accepted="None, or events=True",
            )
        drawn = (self.scene, self.renderer, self.window_ns)
        if self.config.frames is not None and any(part is not None for part in drawn):
            raise ConfigError(
                "recorded frames are not drawn",
                where="frames",
                accepted="no scene, renderer or window_ns",
            )


# ---------------------------------------------------------------------------------------------------------------------
# Items of a sequence, in their order. All arrays belong to the receiver. ``sensor`` is the name of the camera that they
# are of; "" of a single camera.


@dataclass(frozen=True, eq=False)
class EventChunk:
    """The events that have left the sensor since the previous chunk.

    t_ns : with this chunk, every event before this time's microsecond, t_ns // 1000, has been returned.   events : t in
    µs; may be empty."""

    t_ns: int
    events: Events
    sensor: str = ""


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """Ground truth at a label's time. Exactly the events before its microsecond, t_ns // 1000, came before it.

    k : number of the label, from 0.   t_ns : its time, ns.
    frame : the labels of ``labels:``, see :class:`LabelFrame`; images as drawn, float32 linear light, or as recorded,
    sRGB codes. At the last time of a sequence, where no label begins, only images.
    forward_ns, backward_ns : the other times of flow, ns; None: none.
    T_world_cam : (4, 4) float64, OpenCV axes.   T_world_obj : (n, 4, 4) float64, n objects.
    Both are None where they are unknown (recorded frames)."""

    k: int
    t_ns: int
    frame: LabelFrame
    forward_ns: int | None = None
    backward_ns: int | None = None
    T_world_cam: np.ndarray | None = None
    T_world_obj: np.ndarray | None = None
    sensor: str = ""


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture at t_ns for display: comes after the events up to then.

    image : (H, W, 3) or (H, W) float32 linear light.   flow : (H, W, 2) float32, px from t_ns to a label interval
    later, 0 where nothing is seen; None where it is unknown: in recorded frames, and at the sequence's end."""

    t_ns: int
    image: np.ndarray
    flow: np.ndarray | None = None
    sensor: str = ""


Item = EventChunk | GroundTruth | CameraImage | Picture


# ---------------------------------------------------------------------------------------------------------------------
# Wall time of a sequence by stage.


class StageClock:
    """Wall seconds per named stage, without the compilation of kernels, which happens once per machine and is counted
    separately (``compile_s``). ``with clock("events"): …`` adds to a stage; stages do not nest."""

    def __init__(self) -> None:
        self.started = working_clock()
        self._compiled = compiled_s()
        self.seconds: dict[str, float] = defaultdict(float)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        begin = working_clock()
        try:
            yield
        finally:
            self.seconds[stage] += working_clock() - begin

    @property
    def total(self) -> float:
        return working_clock() - self.started

    @property
    def compile_s(self) -> float:
        return compiled_s() - self._compiled
