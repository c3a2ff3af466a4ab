"""``simulate_sequence``: which kind of simulation a configuration asks for."""

from __future__ import annotations

from blinkgl.errors import ConfigError
from blinkgl.gl import GLContext
from blinkgl.sequence.recorded import RecordedSequence
from blinkgl.sequence.rendered import RenderedSequence
from blinkgl.sequence.request import SequenceRequest
from blinkgl.sequence.simulate import Simulation


def simulate_sequence(request: SequenceRequest, gl: GLContext | None = None) -> Simulation:
    """Return the sequence of a single camera, ready for iteration: :class:`EventChunk`, :class:`GroundTruth`,
    :class:`CameraImage` and :class:`Picture` in time order.

    gl : context to draw with; None: a new one, where something is drawn.
    Raises BlinkGLError for every error of the user or the machine, here or while iterating."""
    if request.config.sensors is not None:
        raise ConfigError(
            "several sensors are simulated together, not as one camera",
            where="sensors",
            value=[one.name for one in request.config.sensors],
            accepted="record_rig or simulate_rig, or a configuration of a single camera",
        )
    return RenderedSequence(request, gl) if request.config.frames is None else RecordedSequence(request)
