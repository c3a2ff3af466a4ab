"""Tensors of events that never leave the card: voxel grids, counts, time surfaces.

    sink = Voxels(card, bins=5)
    sink.begin(t0_us, t1_us)
    for frame, t_ns in frames:
        card.advance(frame, t_ns)     # as `step`, but no event is read back
        sink.add()
    grid = sink.read()                # or sink.tensor(): torch's, on the card where that goes

Everything is added up in whole numbers, so that the order in which a card does it leaves no trace: the same events are
the same tensor, bit for bit, on any card and on the processor (:mod:`tests.card.test_sinks` has the twins).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from blinkgl.card.kernels import PIXELS_PER_GROUP, Kernels
from blinkgl.card.memory import refuse_if_out_of_memory, refuse_too_large
from blinkgl.card.tensors import Readers, Way
from blinkgl.errors import EventDataError
from blinkgl.events.emulator import MAX_SIDE
from blinkgl.events.packing import MAX_CAUSE_ROWS

if TYPE_CHECKING:
    from blinkgl.card.emulator import CardEmulator

ONE = 2**16
"""An event, in a voxel grid."""
MAX_WINDOW_US = 2**30
MAX_BINS = 256


def refuse_window(t0_us: int, t1_us: int) -> None:
    """Raises EventDataError: no length, or over 17 minutes."""
    if not 0 < t1_us - t0_us <= MAX_WINDOW_US:
        raise EventDataError(
            "a window has an end after its start",
            where="window",
            value=f"{t0_us} to {t1_us} us",
            accepted=f"up to {MAX_WINDOW_US} us",
        )


def refuse_bins(bins: int) -> None:
    """Raises EventDataError: none, or too many."""
    if not 1 <= bins <= MAX_BINS:
        raise EventDataError("number of bins out of range", where="bins", value=bins, accepted=f"1 to {MAX_BINS}")


class _Sink:
    """Of one emulator on a card. shape : of what :meth:`read` gives."""

    define: ClassVar[str]
    """Of the shader's variant."""

    @staticmethod
    def finished(whole: np.ndarray, t0_us: int) -> np.ndarray:
        """What :meth:`read` gives of the sums, (planes, H, W) int32, of a window from ``t0_us`` on."""
        raise NotImplementedError

    @staticmethod
    def finished_tensor(whole: Any, t0_us: int) -> Any:
        """The same of a torch tensor, on its device. (``whole`` is nobody else's.)"""
        raise NotImplementedError

    def read(self) -> np.ndarray:
        """The window so far."""
        return self.finished(self.whole(), self._window_us[0])

    def tensor(self, device: str | None = None, at_best: str = "interop") -> Any:
        """The window so far as a torch tensor of its own: the numbers and the type of :meth:`read`.

        device : "cpu", "cuda", "cuda:1"; None: the card that draws, where torch sees it.   at_best : "pinned" and
        "pageable" leave shorter ways out; :meth:`way` says which it is.
        Raises EventDataError: no torch, no such device, no such way."""
        reader = self._readers.on(device, at_best)
        return self.finished_tensor(reader.read(self._buffer.size).reshape(self.shape), self._window_us[0])

    def way(self, device: str | None = None, at_best: str = "interop") -> Way:
        """How :meth:`tensor` goes to a device, and why no shorter way. Raises as :meth:`tensor`."""
        return self._readers.on(device, at_best).way

    def __init__(self, card: CardEmulator, planes: int):
        self._card, self.shape = card, (planes, card.height, card.width)
        card.gl.resume()
        self._kernels = Kernels(card.gl)
        size, what = 4 * planes * card.height * card.width, f"{planes} planes of {card.width}x{card.height}"
        refuse_too_large(card.gl, {"sink": size}, what, (card.width, card.height))
        self._buffer = card.gl.ctx.buffer(reserve=size)
        refuse_if_out_of_memory(card.gl, what)
        self._readers = Readers(card.gl, self._buffer)
        self._window_us = (0, 1)

    def begin(self, t0_us: int, t1_us: int) -> None:
        """A new window [t0_us, t1_us), empty. Raises EventDataError: no length, or over 17 minutes."""
        refuse_window(t0_us, t1_us)
        self._card.gl.resume()
        self._window_us = (t0_us, t1_us)
        self._buffer.clear()

    def add(self) -> None:
        """The events of the card's last step, those outside of the window left out."""
        card, (t0_us, t1_us) = self._card, self._window_us
        packed, count, base_us = card.on_card
        if not count or base_us >= t1_us or base_us - t0_us < -(2**31):
            return
        card.gl.resume()
        values = {
            "count": count,
            "width": card.width,
            "pixels": card.height * card.width,
            "rows": (MAX_CAUSE_ROWS if card.causes else MAX_SIDE) - 1,
            "shift_us": base_us - t0_us,
            "span_us": t1_us - t0_us,
            "bins": self.shape[0],
        }
        buffers = {0: packed, 1: self._buffer}
        self._kernels.run(
            "compute/events_sink.glsl", {self.define: 1}, buffers, values, items=count, local=PIXELS_PER_GROUP
        )

    def whole(self) -> np.ndarray:
        """What has been added up, int32, as it lies on the card."""
        self._card.gl.resume()
        return np.frombuffer(self._buffer.read(), np.int32).reshape(self.shape)

    def release(self) -> None:
        """Frees the buffer. Harmless when repeated."""
        if not self._card.gl.released:
            with self._card.gl.borrowed():
                self._readers.release()
                self._buffer.release()


class Voxels(_Sink):
    """(bins, H, W) float32: +1 for ON, -1 for OFF, shared linearly in time between the two nearest bins, which stand
    from the window's start to its end; in steps of 2^-16, and up to 32,767 events in one place."""

    define = "VOXELS"

    def __init__(self, card: CardEmulator, bins: int = 5):
        refuse_bins(bins)
        super().__init__(card, bins)

    @staticmethod
    def finished(whole: np.ndarray, t0_us: int) -> np.ndarray:
        return whole.astype(np.float32) / np.float32(ONE)

    @staticmethod
    def finished_tensor(whole: Any, t0_us: int) -> Any:
        return whole.float() / ONE


class Counts(_Sink):
    """(2, H, W) int32: OFF and ON events."""

    define = "COUNTS"

    def __init__(self, card: CardEmulator):
        super().__init__(card, 2)

    @staticmethod
    def finished(whole: np.ndarray, t0_us: int) -> np.ndarray:
        return whole.copy()

    @staticmethod
    def finished_tensor(whole: Any, t0_us: int) -> Any:
        return whole


class Latest(_Sink):
    """(2, H, W) int64 µs: time of the last OFF and ON event, -1: there is none (a time surface before it decays)."""

    define = "LATEST"

    def __init__(self, card: CardEmulator):
        super().__init__(card, 2)

    @staticmethod
    def finished(whole: np.ndarray, t0_us: int) -> np.ndarray:
        since = whole.astype(np.int64)
        return np.where(since > 0, since - 1 + t0_us, -1)

    @staticmethod
    def finished_tensor(whole: Any, t0_us: int) -> Any:
        since = whole.long()
        return (since - 1 + t0_us).masked_fill_(since <= 0, -1)
