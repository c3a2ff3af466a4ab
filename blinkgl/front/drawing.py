"""Pictures and ground truth of a scene at any time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import ExitStack
from typing import Any, NoReturn

import numpy as np

from blinkgl.config.labels import LabelsConfig
from blinkgl.config.problems import validate
from blinkgl.errors import ConfigError
from blinkgl.front import arguments as check
from blinkgl.front.runs import MAX_INDEX, Source, configured, scene_of
from blinkgl.front.sections import OF_EVENTS, label_names, labels_tree
from blinkgl.gl import create_context
from blinkgl.labels import LABELS, LabelFrame, asked_for
from blinkgl.machine.closing import Closing
from blinkgl.render.frames import Frame
from blinkgl.render.passes import Pass
from blinkgl.render.renderer import Renderer as SceneRenderer
from blinkgl.srgb import to_srgb8

_LATEST_S = 1e7


class Renderer(Closing):
    """Draws one sequence's scene at any time. Holds OpenGL: ``with Renderer(scene) as renderer: renderer.image(0.2)``.

    source : :class:`Scene` or the result of :func:`load`.   index : number of the sequence.   quality : as of
    :func:`record`. Times are seconds on the scene's clock, from ``start_s`` to ``end_s``;
    outside them nothing moves.
    Raises ConfigError, AssetError, GLError."""

    @check.public()
    def __init__(self, source: Source, *, index: int = 0, quality: str | None = None):
        self.config = configured(source, quality=quality).sequence(check.whole(index, "index", 0, MAX_INDEX))
        if self.config.frames is not None:
            raise ConfigError(
                "the source has nothing to draw: it converts recorded frames",
                where="source",
                accepted="use generate() or record()",
            )
        self.scene = scene_of(source, self.config, index)
        self.start_s, self.end_s = self.config.time.t0_ns * 1e-9, self.config.time.t1_ns * 1e-9
        with ExitStack() as stack:
            gl = stack.enter_context(create_context(self.config.gl.backend, self.config.gl.device))
            self._renderer: Any = stack.enter_context(SceneRenderer(gl, self.scene, self.config.render))
            self._stack = stack.pop_all()

    def close(self) -> None:
        """Release OpenGL; every later use raises ConfigError."""
        self._stack.close()
        self._renderer = _Closed()

    def luminance(self, t: float) -> np.ndarray:
        """Return (H, W) float32 linear luminance at t s, the input of emulators."""
        return self._renderer.luminance(_ns(t, "t")).read()

    def image(self, t: float) -> np.ndarray:
        """Return (H, W, 3) uint8 sRGB at t s."""
        return to_srgb8(self._renderer.colour(_ns(t, "t")).read())

    def frame(
        self,
        t: float,
        labels: Sequence[str | float] = ("images",),
        *,
        to: float | None = None,
        back_to: float | None = None,
    ) -> LabelFrame:
        """Return the :class:`LabelFrame` at t s with the named buffers; "images" is its ``colour``, (H, W, 3) float32
        linear.

        labels : as of :func:`record`, except "events", which has no single time.
        to, back_to : s, end times of the forward and backward flow; default: one label interval later and earlier."""
        if of_events := [name for name in OF_EVENTS if name in label_names(labels)]:
            raise ConfigError(
                "a label of events has no value at a time", where="labels", value=of_events[0], accepted="record()"
            )
        asked = validate(LabelsConfig, labels_tree(labels), where="labels")
        request = asked_for(asked)
        for name in request:
            LABELS[name].check(self._renderer.scene, asked)
        t_ns, interval = _ns(t, "t"), self.config.time.interval_ns
        return self._renderer.labels(
            t_ns,
            request,
            t_ns + interval if to is None else _ns(to, "to"),
            t_ns - interval if back_to is None else _ns(back_to, "back_to"),
        )

    def draw(self, pass_: Pass, t_ns: int) -> Frame:
        """Return the :class:`~blinkgl.render.frames.Frame` of any pass, also one of your own, at a time in whole
        nanoseconds: ``renderer.draw(pass_, 100_000_000).read()`` is its first output, (H, W) or (H, W, C). The passes
        that it reads are drawn first. A lens with distortion gets the flat picture that it looks at.

        Raises ConfigError for another value than a pass and a whole number; GLError, with file and line, for a program
        that does not compile. After the pass's next picture the frame of this one raises GLError."""
        if not isinstance(pass_, Pass):
            raise ConfigError(
                "not a pass", where="pass_", value=pass_, accepted="an instance of ScreenPass or ScenePass"
            )
        most = int(_LATEST_S * 1e9)
        return self._renderer.draw(pass_, check.whole(t_ns, "t_ns", -most, most))


class _Closed:
    """What a closed renderer draws with."""

    def __getattr__(self, name: str) -> NoReturn:
        raise ConfigError(
            "the renderer is closed", where="Renderer", accepted="use it before close(), or make a new one"
        )


def _ns(seconds: float, where: str) -> int:
    return math.floor(check.number(seconds, where, least=-_LATEST_S, most=_LATEST_S) * 1e9 + 0.5)


@check.public()
def render_frame(
    source: Source, t: float, labels: Sequence[str | float] = ("images",), *, index: int = 0, to: float | None = None
) -> LabelFrame:
    """Return one :class:`LabelFrame` at t s; for many, use a :class:`Renderer`, which creates the OpenGL context once.

    labels : as of :func:`record`; images are ``.colour``, (H, W, 3) float32 linear, flow is
    ``.forward``, px, others have their own names.
    to : s, end time of the flow; default: one label interval later.   Raises as :class:`Renderer`."""
    with Renderer(source, index=index) as renderer:
        return renderer.frame(t, labels, to=to)
