"""Which light that changes over time changed each pixel between two frames of the event pass.

Light adds up: the frame at t less the same frame with one light as it was at the frame before is what this light
changed. What no light explains is motion.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from blinkgl.render.moment import Held, Moment
from blinkgl.render.renderer import Renderer
from blinkgl.scene.waveforms import factor_at

_ROUNDING = 2.0**-18
"""Share of a pixel's luminance below which a change is the rounding of float32 sums."""


class LightTruth:
    """Returns the light of every pixel's change from one frame to the next.

    light : the frame of a moment, (H, W) float32 that stays valid."""

    def __init__(self, renderer: Renderer, light: Callable[[Moment], np.ndarray]):
        self._scene, self._moment, self._light = renderer.scene, renderer.moment, light
        numbers = {name: number for number, name in enumerate(self._scene.waveforms)}
        self._sources = [(numbers[name], Held(wave, part)) for name, wave, part in self._scene.changing_lights]
        self._before: tuple[int, np.ndarray] | None = None

    def of(self, t_ns: int, now: np.ndarray) -> np.ndarray:
        """Return (H, W) int32: the number of the light in ``scene.waveforms`` that did most of the change since the
        frame of the last call, in its direction; -1 where motion did, or nothing changed. Call it at every frame.

        now : (H, W) float32, the frame at t_ns."""
        last, self._before = self._before, (t_ns, now)
        which = np.full(now.shape, -1, np.int32)
        if last is None:
            return which
        t0_ns, total = self._scene.t0_ns, now - last[1]
        most, rest = np.abs(now) * _ROUNDING, total.copy()
        shares = []
        for number, source in self._sources:
            # The frame as it would be had this light alone kept its factor: the difference is its share of the change.
            held = source._replace(factor=factor_at(source.wave, last[0], t0_ns))
            if held.factor != factor_at(source.wave, t_ns, t0_ns):
                share = now - self._light(self._moment(t_ns).holding(held))
                shares.append((number, share))
                # What no light explains is the motion's.
                rest -= share
        # Only a part in the direction of the whole change can be what made it.
        most = np.maximum(most, rest * np.sign(total))
        for number, share in shares:
            part = share * np.sign(total)
            which[part > most] = number
            most = np.maximum(most, part)
        return which
