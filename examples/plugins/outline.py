"""A pass of one's own: 1 where the pixel to the right shows another object (docs/extending.md, "A pass").

blinkgl shader passes demo --out out/outline --pass outline --plugin outline.py
blinkgl shader diff demo --pass outline --plugin outline.py
blinkgl shader check outline.glsl --plugin outline.py
"""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from blinkgl.render.passes import Geometry, Input, Output, ScreenPass
from blinkgl.render.passes.own import register


@dataclass(frozen=True)
class Outline(ScreenPass):
    program: ClassVar[str] = str(Path(__file__).with_name("outline.glsl"))
    inputs: ClassVar[tuple[Input, ...]] = (Input("ids", Geometry(("ids",))),)
    outputs: ClassVar[tuple[Output, ...]] = (Output("edge", "R32F"),)


def reference(scene, frame):
    """The same in NumPy, of the ray caster's ids."""
    beside = np.concatenate([frame.instance[:, 1:], frame.instance[:, -1:]], axis=1)
    return (frame.instance != beside).astype(np.float64)


register("outline", Outline(), title="outline of objects", kind="mask", reference=reference)
