"""What to make of a run, as one value: everybody who simulates a sequence hands it on whole."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from blinkgl.config.sequence import SequenceConfig
from blinkgl.errors import ConfigError
from blinkgl.render.renderer import Renderer
from blinkgl.scene.types import Scene


@dataclass(frozen=True, eq=False)
class SequenceRequest:
    """Sequence ``index`` of a run, or a part of it.

    config : every value as drawn.   base : folder that relative paths in it start from.
    events, labels : False leaves them out, ``labels`` ground truth and the frame camera's images; what ``labels:`` and
    ``images:`` do not ask for is left out anyway. Nothing is drawn that nobody asked for.
    pictures_hz : pictures per second of simulated time, at the frames of the event pass; None: none.
    scene : made already, instead of the configuration's.   renderer : made already, and not
    released at the end; its scene is drawn.
    window_ns : first and last time, ns, instead of all of the sequence. (These three: of
    what is drawn, not of recorded frames.)
    number : of the camera on its rig, by which noise differs.
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
    number: int = 0

    def __post_init__(self) -> None:
        if self.pictures_hz is not None and not self.events:
            raise ConfigError(
                "pictures are of event frames, and there are none",
                where="pictures_hz",
                value=self.pictures_hz,
                accepted="None, or events=True",
            )
        drawn = (self.scene, self.renderer, self.window_ns)
        if self.config.frames is not None and any(given is not None for given in drawn):
            raise ConfigError(
                "nothing is drawn of recorded frames",
                where="frames",
                accepted="no scene, renderer or window_ns",
            )
