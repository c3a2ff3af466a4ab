"""Which of the networks that come with the package suits a recording: the one for nearly affine flow, as of a camera
that turns, or the one for depth and for bodies that move their own ways."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from blinkgl.io.formats import EventFile
from eflow import infer
from eflow.cli_arguments import WindowsAsked
from eflow.data.window import StreamWindow, hit_pixels
from eflow.methods.dominant import dominant_motion

AUTO = "auto"
CAMERA, BODIES = "real_small", "real_bodies"
AFFINE = 0.33
"""Mean distance of the flow from its nearest affine field, as a share of its mean length, below which the flow is that
of a camera alone, before a scene of little depth. Medians of windows were .17 to .27 for seven recordings of moving
cameras and .42 to .88 for 24 simulated sequences of independent bodies with the network that it was chosen by, .34 to
.88 with the present one (docs/results_eflow.md)."""


def chosen(file: EventFile, asked: WindowsAsked, predictor: infer.Predictor) -> tuple[str, str]:
    """Return (name of a network, the line that says why): by the flow of ``predictor``, which is :data:`BODIES` and
    reads two windows, at three places of the recording."""
    distances, (height, width) = [], infer.sensor_of(file)
    for pair in _pairs(file, asked, predictor):
        if len(pair.old) and len(pair.new):
            flow, _ = predictor(pair)
            distances.append(dominant_motion(flow, hit_pixels((pair.old, pair.new), height, width))[1])
    if not distances:
        return CAMERA, f"{CAMERA}, since there is no pair of windows with events ({BODIES} needs two)"
    distance = float(np.median(distances))
    name, why = (CAMERA, "") if distance < AFFINE else (BODIES, ": depth shows, or bodies move their own ways")
    return name, f"{name}, since the flow is {100 * distance:.0f} % of its length off an affine field{why}"


def _pairs(file: EventFile, asked: WindowsAsked, predictor: infer.Predictor) -> Iterator[StreamWindow]:
    if asked.whole:
        yield infer.whole_file(file)[0]
        return
    if (ends := infer.ends_of(file)) is None:
        return
    first, last = ends
    start, end = asked.limits(first)
    first, last = max(first, start or first), min(last, end or last)
    span = asked.span_us or infer.likely_span(file, predictor)[0]
    yield from infer.at_places(file, span, first, last)
