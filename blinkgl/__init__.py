"""BlinkGL: event-camera and optical-flow data sets by rasterisation.

    import blinkgl

provides every name in ``__all__``. Use only these paths; the modules below may move. Names are loaded when they are
first used, so that ``import blinkgl`` itself is fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from blinkgl.version import __version__ as __version__

_HOMES = {
    "blinkgl.front.poses": ("Keyframes", "Pose", "Trajectory", "look_at"),
    "blinkgl.front.surfaces": ("Light", "Material"),
    "blinkgl.front.scenes": ("Animation", "Body", "Camera", "Deform", "Mesh", "Primitive", "Scene", "Way"),
    "blinkgl.front.rigs": ("Rig", "RigSensor"),
    "blinkgl.front.sections": ("Timeline",),
    "blinkgl.front.runs": ("generate", "load", "verify"),
    "blinkgl.front.sequences": (
        "Recording",
        "RigRecording",
        "record",
        "record_rig",
        "simulate_rig",
        "simulate_sequence",
    ),
    "blinkgl.front.drawing": ("Renderer", "render_frame"),
    "blinkgl.front.online": ("OnlineSequences",),
    "blinkgl.front.sensors": ("DvsVoltmeter", "Esim", "V2e", "load_sensor"),
    "blinkgl.front.event_files": ("convert", "open_events", "read_events", "write_events"),
    "blinkgl.front.files": (
        "calibrate",
        "compare",
        "read_flow",
        "read_trajectory",
        "simulate",
        "simulate_file",
        "write_flow",
        "write_trajectory",
    ),
    "blinkgl.types.events": ("Events",),
    "blinkgl.tensors": ("TensorEsim", "TensorEvents", "TensorV2e"),
    "blinkgl.sequence.request": ("CameraImage", "EventChunk", "GroundTruth", "Picture"),
    "blinkgl.labels.frames": ("LabelFrame",),
    "blinkgl.labels.values": ("Flow",),
    "blinkgl.online.samples": ("StreamSample", "WindowSample"),
    "blinkgl.online.stream": ("StreamStats",),
    "blinkgl.errors": ("AssetError", "BlinkGLError", "ConfigError", "EventDataError", "GLError", "OutputError"),
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}

if TYPE_CHECKING:  # for type checkers and editors; a test compares it with the table
    from blinkgl.errors import AssetError, BlinkGLError, ConfigError, EventDataError, GLError, OutputError
    from blinkgl.front.drawing import Renderer, render_frame
    from blinkgl.front.event_files import convert, open_events, read_events, write_events
    from blinkgl.front.files import (
        calibrate,
        compare,
        read_flow,
        read_trajectory,
        simulate,
        simulate_file,
        write_flow,
        write_trajectory,
    )
    from blinkgl.front.online import OnlineSequences
    from blinkgl.front.poses import Keyframes, Pose, Trajectory, look_at
    from blinkgl.front.rigs import Rig, RigSensor
    from blinkgl.front.runs import generate, load, verify
    from blinkgl.front.scenes import Animation, Body, Camera, Deform, Mesh, Primitive, Scene, Way
    from blinkgl.front.sections import Timeline
    from blinkgl.front.sensors import DvsVoltmeter, Esim, V2e, load_sensor
    from blinkgl.front.sequences import Recording, RigRecording, record, record_rig, simulate_rig, simulate_sequence
    from blinkgl.front.surfaces import Light, Material
    from blinkgl.labels.frames import LabelFrame
    from blinkgl.labels.values import Flow
    from blinkgl.online.samples import StreamSample, WindowSample
    from blinkgl.online.stream import StreamStats
    from blinkgl.sequence.request import CameraImage, EventChunk, GroundTruth, Picture
    from blinkgl.tensors import TensorEsim, TensorEvents, TensorV2e
    from blinkgl.types.events import Events

__all__ = [
    "Animation",
    "AssetError",
    "BlinkGLError",
    "Body",
    "Camera",
    "CameraImage",
    "ConfigError",
    "Deform",
    "DvsVoltmeter",
    "Esim",
    "EventChunk",
    "EventDataError",
    "Events",
    "Flow",
    "GLError",
    "GroundTruth",
    "Keyframes",
    "LabelFrame",
    "Light",
    "Material",
    "Mesh",
    "OnlineSequences",
    "OutputError",
    "Picture",
    "Pose",
    "Primitive",
    "Recording",
    "Renderer",
    "Rig",
    "RigRecording",
    "RigSensor",
    "Scene",
    "StreamSample",
    "StreamStats",
    "TensorEsim",
    "TensorEvents",
    "TensorV2e",
    "Timeline",
    "Trajectory",
    "V2e",
    "Way",
    "WindowSample",
    "calibrate",
    "compare",
    "convert",
    "generate",
    "load",
    "load_sensor",
    "look_at",
    "open_events",
    "read_events",
    "read_flow",
    "read_trajectory",
    "record",
    "record_rig",
    "render_frame",
    "simulate",
    "simulate_file",
    "simulate_rig",
    "simulate_sequence",
    "verify",
    "write_events",
    "write_flow",
    "write_trajectory",
]


if not TYPE_CHECKING:  # hidden from type checkers, which would accept every misspelt name

    def __getattr__(name: str) -> Any:
        if name not in _HOME:
            raise AttributeError(f"module 'blinkgl' has no attribute {name!r}")
        value = globals()[name] = getattr(import_module(_HOME[name]), name)
        return value


def __dir__() -> list[str]:
    return sorted({*(name for name in globals() if name.startswith("__")), *__all__})
