"""The configuration of a generation run, and of one of its sequences.

``load_run(path, overrides)`` reads a YAML file; ``RunTemplate.sequence(i)`` draws the i-th sequence's parameters and
returns a frozen, validated :class:`SequenceConfig` of plain values. All that can be drawn is checked when the file is
read (:mod:`blinkgl.config.draw`).
"""

from __future__ import annotations

import re
from typing import Annotated, ClassVar, Literal, NamedTuple

from pydantic import AfterValidator, BeforeValidator, Field

from blinkgl.config.base import Config, Former, Refused, always, rule
from blinkgl.config.camera import CameraConfig, room_for
from blinkgl.config.events import EmulatorConfig, EsimConfig
from blinkgl.config.frames import MAX_SPAN_S, FramesConfig
from blinkgl.config.images import ImagesConfig, check_images, readout_us
from blinkgl.config.labels import LabelsConfig
from blinkgl.config.names import shipped_names
from blinkgl.config.optics import OpticsConfig
from blinkgl.config.over_time import ImuConfig, TracksConfig, check_imu, check_tracks
from blinkgl.config.quality import DEFAULT, Quality
from blinkgl.config.readout import ReadoutConfig, drain_us
from blinkgl.config.rig import (
    SECTIONS,
    RigSensorConfig,
)
from blinkgl.config.scene import RandomSceneConfig, SceneConfig
from blinkgl.config.sensor import Sensor
from blinkgl.config.timeline import DisplacementTimeline, TimelineConfig

# ---------------------------------------------------------------------------------------------------------------------
# The ``gl:`` section: the OpenGL implementation that renders.


class GLConfig(Config):
    """The OpenGL implementation."""

    backend: Literal["auto", "egl", "osmesa"] = Field(
        "auto", description="auto: EGL, or OSMesa (software) if EGL is missing"
    )
    device: int = Field(0, ge=0, description="number of the EGL device in `blinkgl doctor`; not used by osmesa")


NS_PER_S = 1_000_000_000
MAX_LABELS = 1_000_000
"""File names of a sequence have six digits."""


class TimeConfig(Config):
    """Labels at ``label_rate`` over ``duration`` seconds. The simulation starts one label interval earlier (pre-roll),
    so that the first label has events before it."""

    duration: float = Field(
        1.0,
        gt=0,
        le=86400 * 2,
        description="labelled time, s; with one label interval before and after at most 71.6 minutes",
    )
    label_rate: float = Field(10.0, gt=0, le=1e5, description="labels (flow, images) per second, Hz")
    start: float = Field(0.0, ge=0, le=1e7, description="clock at the start of the pre-roll, s")

    @rule("duration", "label_rate")
    def _labels(duration: float, rate: float):
        if duration * rate < 1 - 1e-9:
            raise Refused("duration * label_rate must be at least 1 label")
        if duration * rate > MAX_LABELS:
            raise Refused(
                f"{duration * rate:.0f} labels",
                where="label_rate",
                value=rate,
                accepted=f"duration * label_rate of at most {MAX_LABELS}",
            )
        if span_s(duration, rate) > MAX_SPAN_S:
            raise Refused(
                f"with one label interval before and one after, {span_s(duration, rate):.6g} s are more than the "
                f"{MAX_SPAN_S:.1f} s (71.6 minutes) that an event file can hold",
                where="duration",
                value=duration,
                accepted="a shorter one, or more sequences",
            )

    @property
    def interval_ns(self) -> int:
        """Return the label interval, ns."""
        return round(NS_PER_S / self.label_rate)

    @property
    def label_count(self) -> int:
        """Return the number of labels with flow to the next one."""
        return int(self.duration * self.label_rate + 1e-9)

    @property
    def cut(self) -> tuple[str, ...]:
        """Return a line on the part of ``duration`` after the last whole label interval, which is left out; () if there
        is none."""
        whole = self.label_count / self.label_rate
        if self.duration - whole < 1e-6 * self.duration:
            return ()
        used = f"time.duration: {self.duration:.6g} s are {whole:.6g} s, {self.label_count} intervals of labels"
        return (f"{used} (a multiple of 1 / time.label_rate = {1 / self.label_rate:.6g} s is whole)",)

    @property
    def t0_ns(self) -> int:
        """Return the start of the pre-roll, ns."""
        return round(self.start * NS_PER_S)

    @property
    def t1_ns(self) -> int:
        """Return the end of the last label's interval, ns."""
        return self.t0_ns + (self.label_count + 1) * self.interval_ns

    @property
    def label_times_ns(self) -> range:
        """Return the label_count + 1 times, ns; flow k runs from label k to label k + 1."""
        return range(self.t0_ns + self.interval_ns, self.t1_ns + 1, self.interval_ns)


def span_s(duration: float, label_rate: float) -> float:
    """Return the time from the start of the pre-roll to the end of the last label's interval, s; at most half a label
    too long."""
    return duration + 1 / label_rate


def _is_offered(name: object) -> object:
    """Refuse multi-sampling, which 0.1.0 had: it cost more than ``taps4`` and had more error than ``ssaa2``
    (docs/trade.md)."""
    if name == "msaa4":
        raise Refused(
            "multi-sampling was removed", value=name, accepted="edges, which filters silhouettes and textures"
        )
    return name


Antialiasing = Annotated[
    Literal["none", "taps4", "edges", "edges2", "ssaa2", "ssaa4", "ssaa8"], BeforeValidator(_is_offered)
]
ImageAntialiasing = Annotated[
    Literal["none", "edges", "edges2", "ssaa2", "ssaa4", "ssaa8"], BeforeValidator(_is_offered)
]


class RenderConfig(Config):
    """Quality of drawing."""

    antialiasing: Antialiasing = Field(
        "none",
        description="event frames. taps4: textures by 4 lookups per pixel; edges: silhouettes, too, by their area; "
        "edges2: the same at 2 x 2 resolution (both become ssaa4 or ssaa8 where outlines crowd); ssaa2, ssaa4, ssaa8: "
        "means of 2 x 2, 4 x 4, 8 x 8 samples (docs/trade.md)",
    )
    image_antialiasing: ImageAntialiasing = Field("ssaa2", description="the same for the colour images at label times")
    anisotropy: float = Field(
        1.0,
        ge=1,
        le=16,
        description="texture anisotropy, 1: off (above 1 with software GL half the speed, and seconds per frame near "
        "a horizon)",
    )
    mip_bias: float = Field(
        0.0,
        ge=-8,
        le=8,
        description="added to the mip level, log2: -1 doubles the sharpness, with more aliasing",
    )
    former: ClassVar[dict[str, Former]] = {
        "lod": Former(
            "meshes that are as fine as you want them drawn",
            lambda value: isinstance(value, dict) and value.get("enabled", False) is False,
        )
    }


class PreviewConfig(Config):
    """The video preview.mp4: frames, events and flow side by side."""

    enabled: bool = Field(True, description="false: no preview")
    rate: float = Field(30.0, gt=0, le=1e4, description="frames per second of simulated time, Hz")
    slowdown: ClassVar[float] = 2.0
    """The video plays this many times slower than the simulation."""
    former: ClassVar[dict[str, Former]] = {"slowdown": always(slowdown)}


def _file_name(name: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}", name):
        raise Refused(
            "not a name for folders",
            value=name,
            accepted="a letter or digit, then letters, digits, '_', '-' and '.', at most 100",
        )
    return name


class OutputConfig(Config):
    """Names and number of the sequences: `OUT/SPLIT/NAME_000000`, …"""

    name: Annotated[str, AfterValidator(_file_name)] = Field("sequence", description="name of the sequences")
    split: Literal["train", "test"] = Field(
        "train", description="split of the object and texture pools, which are disjoint by content"
    )
    sequences: int = Field(1, ge=1, le=10_000_000, description="number of sequences (--num overrides it)")
    first_index: int = Field(
        0, ge=0, le=10_000_000, description="number of the first; sequence n depends only on the seed and n"
    )
    compression: Literal["zstd", "lz4", "gzip"] = Field(
        "zstd",
        description="of HDF5 files. zstd: in Blosc, as DSEC's; lz4: faster, some percent larger; gzip: slower, but "
        "read without hdf5plugin",
    )
    label: str | None = Field(
        None,
        pattern=r"^[^\x00-\x1f]{1,255}$",
        description="class of all sequences: `class` in manifest.json and shards",
    )


class CameraOnRig(NamedTuple):
    """One camera of a sequence's rig: its index among the sensors, the name of its folder ("" for a single camera), the
    configuration of an equivalent single camera, and whether it gives events."""

    number: int
    name: str
    config: SequenceConfig
    gives_events: bool


_NOT_OF_FRAMES = {
    "sensors": "have only one camera",
    "images": "are already images",
    "optics": "have come through their own lens",
    "imu": "do not tell where their camera was",
    "tracks": "do not tell where their surfaces are",
}


class SequenceConfig(Config):
    """One sequence; all values are plain and final."""

    seed: int = Field(0, ge=0, lt=2**63, description="seed of the whole run; 0 is a seed")
    output: OutputConfig = Field(OutputConfig(), description="names and number of the sequences")
    camera: CameraConfig = Field(CameraConfig(), description="resolution, intrinsics and lens")
    time: TimeConfig = Field(TimeConfig(), description="duration and label rate")
    optics: OpticsConfig | None = Field(
        None, description="lens, point spread and colour filters of the event camera (docs/cameras.md)"
    )
    quality: Quality | None = Field(
        DEFAULT,
        description="sets timeline and render (docs/trade.md); keys beside it override it. null: the defaults of each "
        "table",
    )
    timeline: TimelineConfig = Field(DisplacementTimeline(), description="times of the event frames")
    scene: SceneConfig = Field(RandomSceneConfig(), description="objects, lights, camera motion")
    frames: FramesConfig | None = Field(
        None,
        description="recorded frames instead of rendering, without `camera`, `time`, `timeline`, `scene` and `render`",
    )
    render: RenderConfig = Field(RenderConfig(), description="quality of drawing")
    sensor: Sensor | None = Field(
        None,
        description=f"{', '.join(shipped_names('sensors'))}, a sensor file or its table: sets camera.width, "
        "camera.height, events and readout; keys beside it override it",
    )
    events: EmulatorConfig = Field(EsimConfig(), description="event camera model and parameters")
    readout: ReadoutConfig | None = Field(
        None,
        description="defects of the pixels, the bus, its clock, filters",
    )
    labels: LabelsConfig = Field(default_factory=LabelsConfig, description="ground truth to write")
    images: ImagesConfig | None = Field(None, description="a frame camera beside the event camera (docs/cameras.md)")
    imu: ImuConfig | None = Field(None, description="an inertial unit on the camera (docs/labels.md)")
    tracks: TracksConfig | None = Field(
        None, description="points on surfaces, followed through the sequence (docs/labels.md)"
    )
    rig: Literal["davis", "dsec", "mvsec", "stereo"] | None = Field(
        None, description="sensors of a known rig (docs/rigs.md); `sensors` given beside it override them by name"
    )
    sensors: tuple[RigSensorConfig, ...] | None = Field(
        None, min_length=1, description="several sensors on one rig (docs/rigs.md); null: a single camera"
    )
    preview: PreviewConfig = Field(PreviewConfig(), description="preview.mp4")
    gl: GLConfig = Field(GLConfig(), description="OpenGL implementation")

    def cameras(self) -> list[CameraOnRig]:
        """Return all cameras in order. A single camera is a rig of one, without a name."""
        if self.sensors is None:
            return [CameraOnRig(0, "", self, True)]
        return [
            CameraOnRig(k, one.name, self.of_sensor(k), one.events is not None)
            for k, one in enumerate(self.sensors)
            if one.sees
        ]

    def of_sensor(self, number: int) -> SequenceConfig:
        """Return the configuration of a single camera at the rig's origin that equals the sensor of this number,
        without a preview (the preview belongs to the rig). A sensor without events keeps the top level's `events`,
        which are not used."""
        assert self.sensors is not None
        one = self.sensors[number]
        own: dict[str, object] = {key: getattr(one, key) for key in SECTIONS}
        if one.events is None:
            own["events"] = self.events
        # A copy is not checked: whoever reads a run has the rules checked on it (config/run.py).
        preview = self.preview.model_copy(update={"enabled": False})
        return self.model_copy(update={**own, "rig": None, "sensors": None, "preview": preview})

    @rule("?frames", "?sensors", "?images", "?optics", "?imu", "?tracks")
    def _frames_have_no_others(frames: bool, *others: bool):
        instead = "null, or a scene instead of frames"
        for (key, problem), there in zip(_NOT_OF_FRAMES.items(), others, strict=True):
            if frames and there:
                raise Refused(f"recorded frames {problem}", where=key, accepted=instead)

    @rule("?sensors", "camera.lens", "scene.intrinsics")
    def _the_files_own_camera(sensors: bool, lens: str, intrinsics: str | None):
        cannot = (
            (sensors, "the file's camera cannot be used for a rig", "config"),
            (lens != "pinhole", "the file's camera is a pin-hole camera", "config, or camera.lens: pinhole"),
        )
        for other, problem, accepted in cannot:
            if other and intrinsics == "file":
                raise Refused(problem, where="scene.intrinsics", value=intrinsics, accepted=accepted)

    @rule("time.duration", "time.label_rate", "readout.events_per_second", "readout.row_ns", "readout.queue_events")
    def _late_events_fit(duration: float, label_rate: float, rate: float | None, row_ns: float, queue: int):
        if rate is not None and span_s(duration, label_rate) + 1e-6 * drain_us(rate, row_ns, queue) > MAX_SPAN_S:
            raise Refused(
                "delayed events of the read-out would be later than an event file can hold",
                where="time.duration",
                value=duration,
                accepted=f"at most {MAX_SPAN_S - 1 / label_rate - 1e-6 * drain_us(rate, row_ns, queue):.6g}",
            )

    @rule("time.start", "?readout")
    def _picoseconds_fit(start: float, readout: bool):
        if readout and start > 8e6:
            raise Refused(
                "too late for the read-out, which counts picoseconds",
                where="time.start",
                value=start,
                accepted="at most 8000000",
            )

    @rule("labels.flow", "time.duration", "time.label_rate", "?frames")
    def _flow_ends_in_the_sequence(flow: tuple[str | float, ...], duration: float, rate: float, frames: bool):
        most = int(duration * rate + 1e-9) / rate  # from the first label to the end, and from the last to the beginning
        for one in () if frames else flow:
            if isinstance(one, float) and abs(one) > most + 1e-6:
                raise Refused(
                    "the interval is too long: the flow would end outside the sequence",
                    where="labels.flow",
                    value=one,
                    accepted=f"intervals of at most {most:.6g} s, or a longer time.duration",
                )

    @rule("imu.rate", "time.duration", "time.label_rate")
    def _measurements_fit(rate: float | None, duration: float, label_rate: float):
        if rate is not None:
            check_imu(rate, span_s(duration, label_rate))

    @rule("tracks.points", "tracks.rate", "time.duration", "time.label_rate")
    def _tracks_fit(points: int | None, rate: float | None, duration: float, label_rate: float):
        if points is not None:
            check_tracks(points, label_rate if rate is None else rate, duration)

    @rule(
        "images.rate",
        "images.times",
        "images.exposure_us",
        "images.auto_exposure.longest_us",
        "images.row_us",
        "camera.height",
        "time.duration",
        "time.label_rate",
        "time.start",
    )
    def _exposures_fit(
        rate: float | None,
        times: tuple[float, ...] | None,
        exposure: float | None,
        longest: float | None,
        row_us: float,
        height: int,
        duration: float,
        label_rate: float,
        start: float,
    ):
        if exposure is not None:
            lasts = exposure if longest is None else longest
            count = int(duration * label_rate + 1e-9) + 1
            check_images(rate, times, lasts, readout_us(height, row_us), start, count / label_rate)

    @rule("scene.kind", "scene.region.height", "scene.camera_clearance", "camera")
    def _room_for_the_camera(kind: str, height: float, clearance: float, camera: CameraConfig):
        if kind == "random":
            room_for(camera.model, clearance, height)
