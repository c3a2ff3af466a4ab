"""Sums that lie on the card as torch tensors, the shortest way that is there.

``interop``: copied on the card, nothing goes over the bus (:mod:`blinkgl.card.interop`, which says what has to be there
and has not run on a card yet). ``pinned``: read into memory that the card reaches by itself, and sent from there while
the processor goes on; over the bus twice. ``pageable``: read into ordinary memory, and copied from there where a card
is asked for. The numbers are the same bits all three ways.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from blinkgl.card.interop import NoInterop, Registered, proven
from blinkgl.errors import EventDataError

if TYPE_CHECKING:
    import moderngl

    from blinkgl.gl import GLContext

WAYS = ("interop", "pinned", "pageable")
_DEVICES = "cpu, cuda, or cuda:N"


class Way(NamedTuple):
    """way : one of :data:`WAYS`.   why : in a line, why it is not the one before; "": it is the first."""

    way: str
    why: str = ""

    def __str__(self) -> str:
        return f"{self.way}: {self.why}" if self.why else self.way


def _torch() -> Any:
    try:
        import torch
    except ImportError:
        raise EventDataError("tensors need torch", where="device", accepted="pip install torch, or read()") from None
    return torch


def _device(text: str | None, gl: GLContext) -> Any:
    """torch's device, with its number. Raises EventDataError: none of that name, or not here."""
    torch = _torch()
    if text is None:
        cuda = None if gl.is_software else proven(gl)
        text = f"cuda:{cuda.card}" if cuda is not None and not isinstance(cuda, str) else "cuda"
        text = text if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(text)
    except RuntimeError:
        raise EventDataError("no device of torch's", where="device", value=text, accepted=_DEVICES) from None
    if device.type not in ("cpu", "cuda"):
        raise EventDataError("not a device for tensors", where="device", value=text, accepted=_DEVICES)
    if device.type == "cuda":
        count = torch.cuda.device_count() if torch.cuda.is_available() else 0
        if (device.index or 0) >= count:
            raise EventDataError("no such card for torch", where="device", value=text, accepted=f"cpu ({count} cards)")
        if device.index is None:
            device = torch.device("cuda", torch.cuda.current_device())
    return device


class Reader:
    """Of a buffer of 32-bit words.   device : torch's, with its number.   at_best : one of :data:`WAYS`; those before
    it are not tried.   way : :class:`Way`, which may become a longer one when a read fails."""

    def __init__(self, gl: GLContext, buffer: moderngl.Buffer, device: Any, at_best: str = "interop"):
        self._gl, self._buffer, self.device = gl, buffer, device
        self._registered: Registered | None = None
        self._pinned: Any = None  # the memory, and when the card has done with it
        self._sent: Any = None
        self.way = self._chosen(at_best)

    def _chosen(self, at_best: str) -> Way:
        if self.device.type == "cpu":
            return Way("pageable", "tensors of the processor are asked for")
        if at_best != "interop":
            return Way(at_best, "it is asked for")
        cuda = proven(self._gl)
        if isinstance(cuda, str):
            return Way("pinned", cuda)
        if cuda.card != self.device.index:
            return Way("pinned", f"OpenGL draws on cuda:{cuda.card}, tensors are asked for on {self.device}")
        try:
            self._registered = Registered(self._gl, cuda, self._buffer)
        except NoInterop as why:
            return Way("pinned", str(why))
        return Way("interop")

    def read(self, size: int, offset: int = 0) -> Any:
        """(size / 4,) int32 tensor of its own, on the device: the buffer's bytes from ``offset`` on."""
        self._gl.resume()
        if self.way.way == "interop" and self._registered is not None:
            try:
                return self._registered.read(size, offset)
            except NoInterop as why:
                self._registered.release()
                self._registered, self.way = None, Way("pinned", str(why))
        if self.way.way == "pinned":
            try:
                return self._by_pinned(size, offset)
            except RuntimeError as error:  # torch: so much memory cannot be locked
                self._pinned, self.way = None, Way("pageable", " ".join(str(error).split())[:120])
        return self._by_pageable(size, offset)

    def _by_pinned(self, size: int, offset: int) -> Any:
        torch = _torch()
        if self._sent is not None:
            self._sent.synchronize()  # it may still be on its way out of this memory
        if self._pinned is None or 4 * len(self._pinned) < size:
            self._pinned = torch.empty(size // 4, dtype=torch.int32, pin_memory=True)
        part = self._pinned[: size // 4]
        self._buffer.read_into(part.numpy(), size, offset=offset)
        with torch.cuda.device(self.device):
            made = part.to(self.device, non_blocking=True)
            self._sent = torch.cuda.Event()
            self._sent.record()
        return made

    def _by_pageable(self, size: int, offset: int) -> Any:
        torch = _torch()
        made = torch.empty(size // 4, dtype=torch.int32)
        self._buffer.read_into(made.numpy(), size, offset=offset)
        return made.to(self.device)

    def release(self) -> None:
        """Before the buffer is. Harmless when repeated."""
        if self._registered is not None:
            self._registered.release()
            self._registered = None
        if self._sent is not None:
            self._sent.synchronize()
        self._pinned = self._sent = None


class Readers:
    """Of one buffer, by the device that is asked for."""

    def __init__(self, gl: GLContext, buffer: moderngl.Buffer):
        self._gl, self._buffer = gl, buffer
        self._made: dict[tuple[Any, str], Reader] = {}

    def on(self, name: str | None, at_best: str = "interop") -> Reader:
        """Made when it is first asked for.   name : "cpu", "cuda", "cuda:1"; None: the card that draws, where torch
        sees it, else any card, else the processor.   at_best : see :class:`Reader`. Raises EventDataError: no torch, no
        such device, no such way."""
        if at_best not in WAYS:
            raise EventDataError("no such way", where="at_best", value=at_best, accepted=", ".join(WAYS))
        device = _device(name, self._gl)
        if (device, at_best) not in self._made:
            self._made[device, at_best] = Reader(self._gl, self._buffer, device, at_best)
        return self._made[device, at_best]

    def release(self) -> None:
        for reader in self._made.values():
            reader.release()
        self._made = {}


def way_here(gl: GLContext) -> Way:
    """The one that tensors of this context would go to torch's device by. Raises EventDataError: no torch."""
    if not _torch().cuda.is_available():
        return Way("pageable", "torch sees no CUDA device")
    cuda = proven(gl)
    return Way("pinned", cuda) if isinstance(cuda, str) else Way("interop")
