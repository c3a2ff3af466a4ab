"""Pictures, ground truth and events of a scene as arrays, nothing written."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field

import numpy as np

from blinkgl.config.labels import LabelsConfig
from blinkgl.config.sequence import SequenceConfig
from blinkgl.errors import ConfigError
from blinkgl.events.types import Events
from blinkgl.front import arguments as check
from blinkgl.front.runs import Emulator, Source, Timeline, configured, labels_tree
from blinkgl.front.scenes import Scene
from blinkgl.gl import create_context
from blinkgl.labels import Flow, LabelFrame, asked_for
from blinkgl.render.renderer import Renderer as SceneRenderer
from blinkgl.scene import types as data
from blinkgl.scene.build import build_scene
from blinkgl.sequence import EventChunk, GroundTruth, simulate as core
from blinkgl.srgb import to_srgb8

_LATEST_S = 1e7


def _built(source: Source, index: int, **sections) -> tuple[SequenceConfig, data.Scene]:
    """Configuration and scene of one sequence. Raises ConfigError and AssetError."""
    config = configured(source, **sections).sequence(check.whole(index, "index", 0, 10_000_000))
    if config.frames is not None:
        raise ConfigError("nothing to draw: it converts recorded frames", where="source", accepted="use generate()")
    if isinstance(source, Scene):
        return config, source.build(config)
    return config, build_scene(config.scene, config.camera, config.time.t0_ns, config.time.t1_ns, split=config.output.split, seed=config.seed,
                               sequence=index, base=source.base)


@dataclass(frozen=True, eq=False)
class Recording:
    """A sequence in memory.

    events : all of them, t in µs on the scene's clock.   t_us : (K,) int64, times of the labels.
    labels : K times :class:`LabelFrame`; what was not asked for is None in it.
    images : (K + 1, H, W, 3) uint8 sRGB at ``image_t_us`` (K + 1,) int64, or None.
    config : every value as drawn.   frames : how many the emulator saw.   lost : events that its limit and the read-out swallowed."""

    events: Events
    t_us: np.ndarray
    labels: tuple[LabelFrame, ...]
    image_t_us: np.ndarray
    images: np.ndarray | None
    config: SequenceConfig = field(repr=False)
    frames: int
    lost: int

    @property
    def flow(self) -> np.ndarray:
        """(K, H, W, 2) float32 px, +x right, +y down, from each label's time to the next; 0 where :attr:`valid` is False."""
        return np.stack([flow.flow for flow in self._forward()])

    @property
    def valid(self) -> np.ndarray:
        """(K, H, W) bool."""
        return np.stack([flow.valid for flow in self._forward()])

    def window(self, k: int) -> Events:
        """Events from label ``k``'s time until the next one's, those that flow ``k`` spans."""
        k = check.whole(k, "k", 0, len(self.t_us) - 1)
        return self.events.window(int(self.t_us[k]), int(self.image_t_us[k + 1]))

    def _forward(self) -> list[Flow]:
        flows = [label.forward for label in self.labels if label.forward is not None]
        if len(flows) < len(self.labels):
            raise ConfigError("the recording has no forward flow", where="labels", accepted="'flow' among them")
        return flows


def record(source: Source, *, index: int = 0, emulator: Emulator | None = None, sensor: str | None = None, timeline: Timeline | None = None,
           quality: str | None = None, labels: Sequence[str] | None = None) -> Recording:
    """Events, images and ground truth of one sequence as arrays: what :func:`generate` writes, held in memory.

    source : :class:`Scene` or what :func:`load` gave.   index : number of the sequence.
    emulator : "esim", "v2e", "voltmeter", or a table with its values, ``{"emulator": "v2e", "cutoff_hz": 200}``.
    sensor : camera whose size, emulator values and read-out are taken, such as "davis346".   timeline : :class:`Timeline`.
    quality : "fast", "balanced", "accurate" or "reference".
    labels : of images, flow, flow_backward, occlusion, depth, ids, normals, velocity; default: the source's (images, flow, occlusion).
    Raises ConfigError, AssetError, GLError, EventDataError."""
    config, scene = _built(source, index, emulator=emulator, sensor=sensor, timeline=timeline, quality=quality, labels=labels)
    images, frames, chunks, times = [], [], [], []
    with core.simulate_sequence(config, index, scene=scene) as sequence:
        for item in sequence:
            if isinstance(item, EventChunk):
                chunks.append(item.events)
                continue
            assert isinstance(item, GroundTruth), "no pictures were asked for"
            times.append(item.t_ns // 1000)
            if (image := item.frame.values.pop("images", None)) is not None:
                images.append(to_srgb8(image))
            if item.forward_ns is not None:
                frames.append(item.frame)
    t_us, camera = np.array(times, np.int64), sequence.camera
    assert camera is not None, "a scene is seen by an event camera"
    return Recording(Events.concatenate(chunks), t_us[:-1], tuple(frames), t_us, np.stack(images) if images else None, config, sequence.frames,
                     camera.saturated + camera.dropped)


class Renderer:
    """Draws one sequence's scene at any time. Holds OpenGL: ``with Renderer(scene) as renderer: renderer.image(0.2)``.

    source : :class:`Scene` or what :func:`load` gave.   index : number of the sequence.   quality : as of :func:`record`.
    Times are seconds on the scene's clock, from ``start_s`` to ``end_s``; outside them everything stands still.
    Raises ConfigError, AssetError, GLError."""

    def __init__(self, source: Source, *, index: int = 0, quality: str | None = None):
        self.config, self.scene = _built(source, index, quality=quality)
        self.start_s, self.end_s = self.config.time.t0_ns * 1e-9, self.config.time.t1_ns * 1e-9
        with ExitStack() as stack:
            gl = stack.enter_context(create_context(self.config.gl.backend, self.config.gl.device))
            self._renderer = stack.enter_context(SceneRenderer(gl, self.scene, self.config.render))
            self._stack = stack.pop_all()

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Lets go of OpenGL."""
        self._stack.close()

    def luminance(self, t: float) -> np.ndarray:
        """(H, W) float32 linear luminance at t s: what emulators take."""
        return self._renderer.luminance(_ns(t, "t")).read()

    def image(self, t: float) -> np.ndarray:
        """(H, W, 3) uint8 sRGB at t s."""
        return to_srgb8(self._renderer.colour(_ns(t, "t")).read())

    def frame(self, t: float, labels: Sequence[str] = ("images",), *, to: float | None = None, back_to: float | None = None) -> LabelFrame:
        """:class:`LabelFrame` at t s with the named buffers; "images" is its ``colour``, (H, W, 3) float32 linear.

        labels : as of :func:`record`.   to, back_to : s, where flow and flow_backward lead; default: one label interval on and back."""
        request = asked_for(LabelsConfig.model_validate(labels_tree(labels)))
        t_ns, interval = _ns(t, "t"), self.config.time.interval_ns
        return self._renderer.labels(t_ns, request, t_ns + interval if to is None else _ns(to, "to"),
                                     t_ns - interval if back_to is None else _ns(back_to, "back_to"))


def _ns(seconds: float, where: str) -> int:
    return math.floor(check.number(seconds, where, least=-_LATEST_S, most=_LATEST_S) * 1e9 + 0.5)


def render_frame(source: Source, t: float, labels: Sequence[str] = ("images",), *, index: int = 0, to: float | None = None) -> LabelFrame:
    """One :class:`LabelFrame` at t s; for many, a :class:`Renderer` saves making OpenGL's context each time.

    labels : of images (``.colour``, (H, W, 3) float32 linear), flow (``.forward``, px), flow_backward, occlusion, depth (m), ids, normals,
    velocity (px/s).   to : s, where the flow leads; default: one label interval on.   Raises as :class:`Renderer`."""
    with Renderer(source, index=index) as renderer:
        return renderer.frame(t, labels, to=to)
