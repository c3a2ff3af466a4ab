"""A timeline's reductions on the card: the small picture stays there, sixteen bytes are read back.

What is ranked are whole numbers, in the order of the floats that they are the bits of; what is computed of them
(squares, a quotient, a product) is computed in whole numbers, too. So the percentile is
:class:`blinkgl.timeline.reductions.OfArrays`'s, bit for bit, and frames come at the same times.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from blinkgl.card.arith import words
from blinkgl.card.kernels import Kernels
from blinkgl.errors import GLError
from blinkgl.events.response import Response
from blinkgl.timeline.reductions import SLOWEST, STILL, Drawn, OfArrays, Ranked, between, place

if TYPE_CHECKING:
    import moderngl

    from blinkgl.gl import GLContext

_PICTURE_UNIT = 0
_answers: dict[tuple[str, str, str], bool] = {}


class OfTextures:
    """Of pictures that ``gl`` has drawn, (w, h) with two 32-bit floats a pixel or more, of which the first two count.
    Luminances up to 2^100: the slope of larger ones would be a subnormal number."""

    def __init__(self, gl: GLContext):
        self._gl, self._kernels = gl, Kernels(gl)
        gl.resume()
        self._lanes = 64 if gl.is_software else 1024
        self._keys: moderngl.Buffer | None = None
        self._found = gl.ctx.buffer(reserve=16)

    def speeds(self, drawn: Drawn, percent: float) -> Ranked:
        # The order of the squares is that of the lengths, and the root of single precision is the processor's.
        return self._ranked(drawn, {"SPEED": 1}, {"slowest": _bits(SLOWEST * SLOWEST)}, percent, np.sqrt)

    def changes(self, drawn: Drawn, response: Response, percent: float) -> Ranked:
        values = {name: _bits(np.float32(getattr(response, name))) for name in ("gain", "offset", "joint", "low_slope")}
        return self._ranked(drawn, {"CHANGE": 1}, {"slowest": _bits(SLOWEST), **values}, percent, lambda found: found)

    def _ranked(
        self, drawn: Drawn, defines: dict[str, int], values: dict[str, int], percent: float, meant: Any
    ) -> Ranked:
        texture = drawn.texture()
        width, height = texture.size
        count = width * height
        self._gl.resume()
        if self._keys is None or self._keys.size < 4 * count:
            if self._keys is not None:
                self._keys.release()
            self._keys = self._gl.ctx.buffer(reserve=4 * count)
        texture.use(_PICTURE_UNIT)
        values = {"picture": _PICTURE_UNIT, "count": count, "width": width, **values}
        self._kernels.run("compute/ranked.glsl", defines, {0: self._keys}, values, items=count)
        part = words(int(np.float64(percent / 100).view(np.uint64)))
        self._kernels.run(
            "compute/ranked.glsl",
            {"SELECT": 1, "LANES": self._lanes},
            {0: self._keys, 1: self._found},
            {"count": count, "part": part},
            items=1,
        )
        found = np.frombuffer(self._found.read(), np.uint32)
        if not (moving := int(found[0])):
            return STILL
        below, above, largest = meant(found[1:].view(np.float32))
        return Ranked(moving, between(below, above, place(moving, percent)[1]), float(largest))

    def release(self) -> None:
        """Frees the buffers. Harmless when repeated."""
        if not self._gl.released:
            with self._gl.borrowed():
                for buffer in (self._keys, self._found):
                    if buffer is not None:
                        buffer.release()


def reductions_on(gl: GLContext, device: str) -> OfTextures | OfArrays:
    """Who reduces small pictures that ``gl`` draws.

    device : "gl" or "auto", which is the processor where the card's answer to a trial is wrong. Raises GLError where
    the card is asked for and its answer is wrong."""
    if not ranks_right(gl):
        if device == "auto":
            return OfArrays()
        raise GLError(
            "the card's percentiles of a trial are not the processor's",
            where="events.device",
            value=f"{gl.renderer}, OpenGL {gl.version}",
            accepted="events.device: cpu, or another driver",
        )
    return OfTextures(gl)


def ranks_right(gl: GLContext) -> bool:
    """Whether a picture of 4,096 pairs of numbers of all orders of magnitude has the processor's percentiles. Asked
    once per driver and process."""
    driver = (gl.vendor, gl.renderer, gl.version)
    if driver not in _answers:
        rng = np.random.default_rng(1)
        spread = np.exp(rng.uniform(-40.0, 40.0, (64, 64, 2))).astype(np.float32)
        pair = np.stack([spread[..., 0], spread[..., 1] * rng.choice((-1, 0, 1), (64, 64))], axis=-1, dtype=np.float32)
        gl.resume()
        texture = gl.ctx.texture((64, 64), 2, pair.tobytes(), dtype="f4")
        card, drawn = OfTextures(gl), cast(Drawn, SimpleNamespace(read=lambda: pair, texture=lambda: texture))
        curves = Response(0.2, 1.0, 1e-3), Response(0.2, 1.0, 0.0, 0.08, 37.5)
        ask = lambda one: [one.speeds(drawn, 80.0), *(one.changes(drawn, curve, 95.0) for curve in curves)]
        try:
            with np.errstate(all="ignore"):
                _answers[driver] = ask(card) == ask(OfArrays())
        finally:
            card.release()
            texture.release()
    return _answers[driver]


def _bits(value: np.float32) -> int:
    return int(np.float32(value).view(np.uint32))
