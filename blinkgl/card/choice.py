"""Which device makes the events: ``events.device``.

``cpu`` and ``gl`` are obeyed. ``auto`` is ``gl`` where frames are drawn by a graphics card, its kernel does what the
configuration asks for, and a short clip has given the events of the processor; else ``cpu``. It looks at no clock: the
same machine chooses the same device again. (On OpenGL that the processor draws, the numba kernel is two to three times
as fast; see docs/gpu.md.)
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from blinkgl.card.emulator import CardEmulator
from blinkgl.card.esim import CardEsim
from blinkgl.card.v2e import CardV2e
from blinkgl.errors import EventDataError, GLError
from blinkgl.events.emulator import Emulator
from blinkgl.events.esim import Esim
from blinkgl.events.v2e import V2e
from blinkgl.gl import create_context
from blinkgl.types.events import Events

if TYPE_CHECKING:
    from blinkgl.gl import GLContext

CARDS: dict[Any, type[CardEsim | CardV2e]] = {Esim: CardEsim, V2e: CardV2e}
"""The classes whose kernels there are for the card, by those for the processor."""
_answers: dict[tuple[str, ...], bool] = {}


def emulator_on(
    kind: Callable[..., Emulator],
    config: Any,
    height: int,
    width: int,
    seed: int,
    reconstruction: str,
    gl: GLContext | None,
) -> Emulator:
    """The emulator ``kind`` on the device that ``config.device`` asks for.

    gl : context of the frames; None: ``gl`` makes one of its own, which is released with the emulator.
    Raises EventDataError and GLError, naming the key, where the card is asked for and cannot do it."""
    card, given = CARDS.get(kind), (height, width, config, seed, reconstruction)
    if getattr(config, "device", "cpu") == "gl":
        if card is None:
            raise EventDataError(
                "this emulator has no kernel for the card", where="events.device", value="gl", accepted="cpu, or auto"
            )
        return _asked_for(card, kind, *given, gl)
    if card is not None and gl is not None and not gl.is_software and card.unfit(config, reconstruction) is None:
        with suppress(GLError):  # no compute shaders, or pictures too large for its buffers
            if same_events(gl, config, kind):
                return card(*given, gl=gl)
    return kind(*given)


def _asked_for(
    card: Any,
    kind: Any,
    height: int,
    width: int,
    config: Any,
    seed: int,
    reconstruction: str,
    given: GLContext | None,
) -> CardEmulator:
    if problem := card.unfit(config, reconstruction):
        raise problem
    gl = given or create_context()
    try:
        if not same_events(gl, config, kind):
            raise GLError(
                "the card's events of a trial are not the processor's",
                where="events.device",
                value=f"{gl.renderer}, OpenGL {gl.version}",
                accepted="events.device: cpu, or another driver",
            )
        return card(height, width, config, seed, reconstruction, gl=gl, owns_gl=given is None)
    except Exception:
        if given is None:
            gl.release()
        raise


def same_events(gl: GLContext, config: Any = None, kind: Any = Esim) -> bool:
    """Whether a short clip, 32 x 64 pixels and three intervals, has the same events on the card as on the processor.
    Asked once per driver, kernel and process.

    config : whose kernels; None: those of the defaults."""
    card = CARDS[kind]
    trial: Any = card.trial(config or kind.Config())
    key = (gl.vendor, gl.renderer, gl.version, trial.model_dump_json())
    if key not in _answers:
        rng = np.random.default_rng(1)
        clip = np.exp(rng.normal(-1, 0.5, (4, 32, 64))).astype(np.float32)
        made, processor = card(32, 64, trial, 1, gl=gl), kind(32, 64, trial, 1)
        try:
            times = range(0, 4_000_000, 1_000_003)
            run = lambda one: Events.concatenate([*(one.step(f, t) for f, t in zip(clip, times)), one.flush()])
            _answers[key] = _equal(run(made), run(processor))
        finally:
            made.release()
    return _answers[key]


def _equal(a: Events, b: Events) -> bool:
    return a.columns == b.columns and all(np.array_equal(getattr(a, name), getattr(b, name)) for name in a.columns)
