"""The whole configuration of a generation run, and of one sequence of it.

``load_run(path, overrides)`` reads a YAML file; ``RunTemplate.sequence(i)`` draws the i-th sequence's parameters
and returns a frozen, validated :class:`SequenceConfig` of plain values. Nothing else in the project knows YAML.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import Field, model_validator

from blinkgl.config.base import Config, validate
from blinkgl.config.draw import draw, extremes
from blinkgl.config.events import EmulatorConfig, EsimConfig
from blinkgl.config.frames import FramesConfig
from blinkgl.config.gl import GLConfig
from blinkgl.config.lod import LodConfig
from blinkgl.config.quality import Quality, with_quality
from blinkgl.config.scene import RandomSceneConfig, SceneConfig
from blinkgl.config.sensor import ReadoutConfig, load_sensor
from blinkgl.config.timeline import DisplacementTimeline, TimelineConfig
from blinkgl.errors import ConfigError

NS_PER_S = 1_000_000_000
MAX_YAML_BYTES = 4 << 20


class CameraConfig(Config):
    """A pin-hole camera. Give the field of view or the focal length, not both."""

    width: int = Field(346, ge=1, le=16384, description="columns, px")
    height: int = Field(260, ge=1, le=16384, description="rows, px")
    fov: float | None = Field(None, gt=0.01, lt=179.9, description="horizontal field of view, degrees; default 60")
    focal: float | None = Field(None, ge=1e-3, le=1e9, description="focal length, px (fx = fy)")
    cx: float | None = Field(None, ge=-1e6, le=1e6, description="principal point x, px; default the image centre, (width - 1) / 2")
    cy: float | None = Field(None, ge=-1e6, le=1e6, description="principal point y, px; default (height - 1) / 2")
    near: float = Field(0.05, ge=1e-9, le=1e9, description="near plane: nothing nearer is drawn, world units")

    @model_validator(mode="after")
    def _one_of(self):
        if self.fov is not None and self.focal is not None:
            raise ValueError("give fov or focal, not both")
        return self

    @property
    def fx(self) -> float:
        import math

        if self.focal is not None:
            return self.focal
        return 0.5 * self.width / math.tan(math.radians(self.fov if self.fov is not None else 60.0) / 2)

    fy = fx

    @property
    def principal_point(self) -> tuple[float, float]:
        return (self.cx if self.cx is not None else (self.width - 1) / 2,
                self.cy if self.cy is not None else (self.height - 1) / 2)


class TimeConfig(Config):
    """Labels at ``label_rate`` over ``duration`` seconds; the simulation starts one label interval earlier
    (pre-roll), so that every label has a full window of events before and after it."""

    duration: float = Field(1.0, gt=0, le=86400 * 2, description="labelled time, s")
    label_rate: float = Field(10.0, gt=0, le=1e5, description="labels (flow, images) per second, Hz")
    start: float = Field(0.0, ge=0, le=1e7, description="clock at the start of the pre-roll, s")

    @model_validator(mode="after")
    def _at_least_one(self):
        if self.duration * self.label_rate < 1 - 1e-9:
            raise ValueError("duration * label_rate must be at least 1 label")
        return self

    @property
    def interval_ns(self) -> int:
        """Label interval, ns."""
        return round(NS_PER_S / self.label_rate)

    @property
    def label_count(self) -> int:
        """Number of labels with flow to the next one."""
        return int(self.duration * self.label_rate + 1e-9)

    @property
    def t0_ns(self) -> int:
        """Start of the pre-roll."""
        return round(self.start * NS_PER_S)

    @property
    def t1_ns(self) -> int:
        """End of the last label's interval."""
        return self.label_times_ns[-1]

    @property
    def label_times_ns(self) -> list[int]:
        """label_count + 1 times; flow k runs from label k to label k + 1."""
        return [self.t0_ns + (k + 1) * self.interval_ns for k in range(self.label_count + 1)]


Antialiasing = Literal["none", "msaa4", "taps4", "ssaa2", "ssaa4"]
ImageAntialiasing = Literal["none", "msaa4", "ssaa2", "ssaa4"]


class RenderConfig(Config):
    """How a frame is drawn."""

    antialiasing: Antialiasing = Field("none", description="event frames: msaa4 filters silhouettes (4 coverage samples a pixel), taps4 textures (4 "
                                       "lookups a pixel); ssaa2 and ssaa4 draw 2 x 2 and 4 x 4 finer and average everything. Labels are never filtered. Costs: "
                                       "docs/results.md")
    image_antialiasing: ImageAntialiasing = Field("ssaa2", description="the same for the colour images at label times")
    anisotropy: float = Field(1.0, ge=1, le=16, description="texture anisotropy, 1 is off (halves the rate on software GL)")
    mip_bias: float = Field(0.0, ge=-8, le=8, description="added to the mip level that is looked up, log2: -1 is sharper by 2, and aliases more")
    lod: LodConfig = Field(LodConfig(), description="level of detail of meshes")


class LabelsConfig(Config):
    """What is written at label times. A pass that nobody asks for is not compiled, allocated or run."""

    images: bool = Field(True, description="sRGB PNG of the colour pass")
    flow: tuple[Literal["forward", "backward"], ...] = Field(("forward",), description="directions of optical flow, DSEC 16-bit PNG")
    float_flow: tuple[Literal["npy", "flo", "h5"], ...] = Field((), description="float32 flow besides the PNG")
    occlusion: bool = Field(True, description="masks of pixels that are not visible at the flow's other end")
    depth: bool = Field(False, description="float32 .npy, world units along the optical axis")
    ids: bool = Field(False, description="instance ids, 16-bit PNG")
    normals: bool = Field(False, description="unit normals in camera axes, float32 .npy")
    velocity: bool = Field(False, description="instantaneous image velocity, px/s, float32 .npy")


class PreviewConfig(Config):
    """preview.mp4: frames, events and flow side by side."""

    enabled: bool = Field(True, description="false: no preview")
    rate: float = Field(30.0, gt=0, le=1e4, description="pictures per second of simulated time, Hz")
    slowdown: float = Field(2.0, gt=0, le=1000, description="play-back this many times slower than the simulation")


class OutputConfig(Config):
    """Where sequences go below the output folder: `OUT/SPLIT/NAME_000000`, …"""

    name: str = Field("sequence", pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,99}$", description="name of the sequences")
    split: Literal["train", "test"] = Field("train", description="which side of the object and texture pools; disjoint by content")
    sequences: int = Field(1, ge=1, le=10_000_000, description="how many (--num overrides)")
    first_index: int = Field(0, ge=0, le=10_000_000, description="number of the first; sequence n depends on the seed and n alone")


class SequenceConfig(Config):
    """One sequence, every value plain and final."""

    seed: int = Field(0, ge=0, lt=2**63, description="of the whole run; 0 is a seed")
    output: OutputConfig = Field(OutputConfig(), description="where sequences go")
    camera: CameraConfig = Field(CameraConfig(), description="resolution and intrinsics")
    time: TimeConfig = Field(TimeConfig(), description="duration and label rate")
    quality: Quality | None = Field(None, description="fast, balanced, accurate or reference: gives timeline and render the values of a measured "
                                    "point of speed against accuracy (docs/trade.md); what is said beside it wins")
    timeline: TimelineConfig = Field(DisplacementTimeline(), description="when event frames are drawn")
    scene: SceneConfig = Field(RandomSceneConfig(), description="what is in front of the camera and how it moves")
    frames: FramesConfig | None = Field(None, description="recorded frames to convert; then nothing is rendered, and `camera`, `time`, "
                                        "`timeline`, `scene` and `render` have no meaning")
    render: RenderConfig = Field(RenderConfig(), description="how a frame is drawn")
    sensor: str | None = Field(None, description="davis240c, davis346, dvxplorer, gen31_vga or imx636: gives camera.width and height, events and "
                               "readout the camera's values; what is said beside it wins")
    events: EmulatorConfig = Field(EsimConfig(), description="the event camera's model and parameters")
    readout: ReadoutConfig | None = Field(None, description="the sensor's bus: events above its rate are late, then lost; null: no limit")
    labels: LabelsConfig = Field(LabelsConfig(), description="which ground truth is written")
    preview: PreviewConfig = Field(PreviewConfig(), description="preview.mp4")
    gl: GLConfig = Field(GLConfig(), description="which OpenGL to use")


@dataclass(frozen=True)
class RunTemplate:
    """A run before its per-sequence parameters are drawn.

    tree : plain data as read, overrides applied.   base : folder that relative paths in it start from.
    """

    tree: dict[str, Any]
    base: Path

    def sequence(self, index: int) -> SequenceConfig:
        """The validated configuration of sequence ``index`` (>= 0). Raises ConfigError, also where the file describes
        several groups of sequences (:mod:`blinkgl.config.recipe` takes those apart)."""
        if "groups" in self.tree:
            raise ConfigError("the recipe has groups; only a group has numbered sequences", where="groups")
        return _validated(draw(self.tree, self.seed, index))

    @property
    def seed(self) -> int:
        seed = self.tree.get("seed", 0)
        return seed if isinstance(seed, int) and not isinstance(seed, bool) else 0

    def check(self) -> SequenceConfig:
        """Validates both ends of every range, of every group; returns the first. Raises ConfigError before any work starts."""
        if "groups" in self.tree:
            from blinkgl.config.recipe import all_groups

            return [group.template.check() for group in all_groups(self)][0]
        return [_validated(tree) for tree in extremes(self.tree)][0]


def _validated(tree: dict[str, Any]) -> SequenceConfig:
    """SequenceConfig of plain data, with the values of a named quality and sensor filled in where the tree says nothing."""
    tree = with_quality(tree)
    config = _possible(validate(SequenceConfig, tree))
    if config.sensor is None:
        return config
    sensor = load_sensor(config.sensor)
    table = lambda key: dict(tree[key]) if isinstance(tree.get(key), dict) else {}
    events = table("events")
    events = sensor.emulator(events.pop("emulator", "esim"), **events).model_dump()
    return validate(SequenceConfig, {"readout": sensor.readout.model_dump(), **tree, "events": events,
                                     "camera": {"width": sensor.width, "height": sensor.height, **table("camera")}})


def _possible(config: SequenceConfig) -> SequenceConfig:
    """The same; ConfigError where two of its tables contradict each other."""
    path, emulator = config.timeline.reconstruction, config.events.emulator
    if path != "linear" and emulator != "esim" and config.frames is None:
        raise ConfigError(f"{emulator} follows straight lines alone", where="timeline.reconstruction", value=path,
                          accepted="linear, or events.emulator: esim")
    return config


class _UniqueKeyLoader(yaml.SafeLoader):
    """SafeLoader that refuses a key given twice (plain YAML silently keeps the last one)."""


def _mapping(loader: _UniqueKeyLoader, node: yaml.MappingNode, deep: bool = False) -> dict:
    loader.flatten_mapping(node)
    seen: set = set()
    for key_node, _ in node.value:
        key = loader.construct_object(key_node, deep=True)
        if not isinstance(key, (str, int, float, bool)):
            raise yaml.constructor.ConstructorError(None, None, "a key is not plain text", key_node.start_mark)
        if key in seen:
            raise yaml.constructor.ConstructorError(None, None, f"key '{key}' is given twice", key_node.start_mark)
        seen.add(key)
    return yaml.SafeLoader.construct_mapping(loader, node, deep=True)


_UniqueKeyLoader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _mapping)


def load_run(path: str | Path, overrides: list[str] | tuple[str, ...] = (), *, seed: int | None = None) -> RunTemplate:
    """Reads a YAML file, applies ``a.b=c`` overrides (c is YAML) and an optional seed, checks every range.

    Raises ConfigError: missing or unreadable file, bad YAML (with line and column), unknown key, bad value."""
    path = Path(path)
    try:
        if path.stat().st_size > MAX_YAML_BYTES:
            raise ConfigError("file is too large for a configuration", where=str(path), accepted=f"at most {MAX_YAML_BYTES} bytes")
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError("no such file", where=str(path), accepted="a YAML file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot be read: {error.__class__.__name__}", where=str(path), accepted="a YAML text file in UTF-8") from None
    tree = parse_yaml(text, str(path))
    tree = {} if tree is None else tree
    if not isinstance(tree, dict):
        raise ConfigError("not a table of keys", where=str(path), value=tree, accepted="key: value lines")
    tree = apply_overrides(tree, overrides)
    if seed is not None:
        tree["seed"] = seed
    template = RunTemplate(tree, path.parent)
    template.check()
    return template


def parse_yaml(text: str, where: str) -> Any:
    """Plain data from YAML text, safely; ConfigError with line and column when it is not YAML."""
    try:
        return yaml.load(text, Loader=_UniqueKeyLoader)  # noqa: S506 (a SafeLoader)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        place = f"{where}:{mark.line + 1}:{mark.column + 1}" if mark else where
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise ConfigError(f"not valid YAML: {problem}", where=place) from None


def apply_overrides(tree: dict[str, Any], overrides: list[str] | tuple[str, ...]) -> dict[str, Any]:
    """Copy of ``tree`` with ``--set`` options applied; tables on the way are made when absent."""
    tree = copy.deepcopy(tree)
    for option in overrides:
        dotted, equals, text = option.partition("=")
        keys = dotted.strip().split(".")
        if not equals or not all(keys):
            raise ConfigError("not an override", where="--set", value=option, accepted="path.to.key=value")
        value = parse_yaml(text, f"--set {dotted}")
        node: Any = tree
        for depth, key in enumerate(keys):
            last = depth == len(keys) - 1
            if isinstance(node, list):
                if not key.isdigit() or int(key) >= len(node):
                    raise ConfigError("no such list entry", where="--set " + ".".join(keys[: depth + 1]), value=key,
                                      accepted=f"0 … {len(node) - 1}")
                key = int(key)
            elif not isinstance(node, dict):
                raise ConfigError("is a plain value and has no keys", where="--set " + ".".join(keys[:depth]), value=node)
            if last:
                node[key] = value
            elif isinstance(node, dict):
                if node.get(key) is None:
                    node[key] = {}
                node = node[key]
            else:
                node = node[key]
    return tree
