"""Ground truth, one row per label: its configuration, drawing, files and grading.

In:    rows (:func:`register`).
Out:   :data:`LABELS`, which configuration, renderer, writer, verification, reports and the shader debugger read.
Start: label.py, which defines a row, and surface.py, the simplest rows. Neither OpenGL nor a compiler is imported here,
because reading a YAML imports this room.
"""

from blinkgl.labels.boxes import ObjectBoxes
from blinkgl.labels.disparity import Disparity
from blinkgl.labels.files import Form
from blinkgl.labels.flow import FlowTo
from blinkgl.labels.frames import LabelFrame, LabelRequest, asked_for
from blinkgl.labels.intervals import FlowIntervals, Flows, OcclusionIntervals, Occlusions
from blinkgl.labels.label import Label
from blinkgl.labels.occlusion import OcclusionAt
from blinkgl.labels.semantics import Semantics
from blinkgl.labels.surface import Depth, Ids, Images, Normals, SceneFlow, Velocity
from blinkgl.labels.table import LABELS, label_of, register
from blinkgl.labels.values import Flow

for _row in (
    Images(),
    Depth(),
    Disparity(),
    Ids(),
    Normals(),
    Velocity(),
    FlowTo("forward"),
    FlowTo("backward"),
    OcclusionAt("forward"),
    OcclusionAt("backward"),
    SceneFlow(),
    Semantics(),
    ObjectBoxes(),
    FlowIntervals(),
    OcclusionIntervals(),
):
    register(_row)

__all__ = [
    "LABELS",
    "Flow",
    "Flows",
    "Form",
    "Label",
    "LabelFrame",
    "LabelRequest",
    "Occlusions",
    "asked_for",
    "label_of",
    "register",
]
