"""CUDA beside OpenGL, as far as it goes without a card: a stand-in of the driver that moves llvmpipe's bytes and holds
every caller to the order that the driver's manual asks for. That CUDA itself works is not shown here."""

from __future__ import annotations

import ctypes
import importlib
import inspect
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from blinkgl.card import CardEsim, Counts, Latest, TileSinks, Voxels, interop, tensors
from blinkgl.card.atlas import Atlas
from blinkgl.card.interop import CALLS, Cuda, NoInterop, Registered, prove, proven
from blinkgl.card.tensors import Reader, Way, way_here
from blinkgl.config.events import EsimConfig
from blinkgl.errors import EventDataError
from blinkgl.gl import create_context
from tests.events.clips import random_clip

torch = pytest.importorskip("torch")
STREAM, CONTEXT, CARD = 0x77, "primary", 1


class Driver:
    """``cuda.bindings.driver`` for one GL context.   fails : calls that answer with an error.   log : their names.
    spoils : bytes are other ones from the copy of this number on."""

    CUGLDeviceList = SimpleNamespace(CU_GL_DEVICE_LIST_ALL=1)
    CUgraphicsRegisterFlags = SimpleNamespace(CU_GRAPHICS_REGISTER_FLAGS_READ_ONLY=1)
    CUstream = staticmethod(lambda handle: ("stream", handle))

    def __init__(self, gl, fails=(), spoils=None, cards=(CARD,)):
        self.gl, self.fails, self.spoils, self.cards = gl, set(fails), spoils, list(cards)
        self.log: list[str] = []
        self.stack: list[str] = []
        self.registered: dict[int, int] = {}  # resource -> GL's name
        self.mapped: dict[int, ctypes.Array] = {}
        self.copies = 0

    def _said(self, name, *values):
        self.log.append(name)
        return (700,) + (None,) * len(values) if name in self.fails else (0, *values)

    def cuInit(self, Flags):
        return self._said("cuInit")

    def cuGetErrorName(self, error):
        return 0, b"CUDA_ERROR_OF_THE_TEST"

    def cuGLGetDevices(self, cudaDeviceCount, deviceList):
        assert cudaDeviceCount >= len(self.cards) and deviceList == 1
        return self._said("cuGLGetDevices", len(self.cards), self.cards)

    def cuDevicePrimaryCtxRetain(self, dev):
        return self._said("cuDevicePrimaryCtxRetain", CONTEXT)

    def cuCtxPushCurrent(self, ctx):
        assert ctx == CONTEXT
        self.stack.append(ctx)
        return self._said("cuCtxPushCurrent")

    def cuCtxPopCurrent(self):
        return self._said("cuCtxPopCurrent", self.stack.pop())

    def _inside(self):
        assert self.stack, "no context of CUDA's is current"

    def cuGraphicsGLRegisterBuffer(self, buffer, Flags):
        self._inside()
        assert buffer not in self.registered.values(), "registered twice"
        said = self._said("cuGraphicsGLRegisterBuffer", 1000 + buffer)
        if said[0] == 0:
            self.registered[1000 + buffer] = buffer
        return said

    def cuGraphicsMapResources(self, count, resources, hStream):
        self._inside()
        assert count == 1 and hStream == ("stream", STREAM) and resources in self.registered
        assert resources not in self.mapped, "mapped twice"
        said = self._said("cuGraphicsMapResources")
        if said[0] == 0:
            self.mapped[resources] = self._bytes_of(self.registered[resources])
        return said

    def _bytes_of(self, name):
        """What OpenGL has in a buffer."""
        u, n, p = ctypes.c_uint, ctypes.c_ssize_t, ctypes.c_void_p
        size = ctypes.c_int()
        self.gl.function("glBindBuffer", None, u, u)(0x8F36, name)
        self.gl.function("glGetBufferParameteriv", None, u, u, p)(0x8F36, 0x8764, ctypes.byref(size))
        assert size.value > 0, "the buffer has been deleted"
        memory = (ctypes.c_uint8 * size.value)()
        self.gl.function("glGetBufferSubData", None, u, n, n, p)(0x8F36, 0, size.value, memory)
        return memory

    def cuGraphicsResourceGetMappedPointer(self, resource):
        self._inside()
        memory = self.mapped[resource]
        return self._said("cuGraphicsResourceGetMappedPointer", ctypes.addressof(memory), len(memory))

    def cuMemcpyDtoDAsync(self, dstDevice, srcDevice, ByteCount, hStream):
        self._inside()
        assert hStream == ("stream", STREAM)
        (memory,) = self.mapped.values()
        first = ctypes.addressof(memory)
        assert first <= srcDevice and srcDevice + ByteCount <= first + len(memory)
        ctypes.memmove(dstDevice, srcDevice, ByteCount)
        if self.spoils is not None and self.copies >= self.spoils:
            ctypes.memset(dstDevice + 8, 0x5A, 3)
        self.copies += 1
        return self._said("cuMemcpyDtoDAsync")

    def cuGraphicsUnmapResources(self, count, resources, hStream):
        self._inside()
        assert count == 1 and hStream == ("stream", STREAM)
        del self.mapped[resources]
        return self._said("cuGraphicsUnmapResources")

    def cuGraphicsUnregisterResource(self, resource):
        self._inside()
        assert resource not in self.mapped
        self._bytes_of(self.registered.pop(resource))  # it is still there
        return self._said("cuGraphicsUnregisterResource")


class NoCard(interop.Torch):
    """Tensors of the processor's, which pass for those of two cards."""

    def devices(self):
        return 2

    def empty(self, words, card):
        assert card == CARD
        return torch.full((words,), -7, dtype=torch.int32)

    def stream(self, card):
        return STREAM


@pytest.fixture
def cuda_of(gl, monkeypatch):
    """Makes :class:`Cuda` of a driver, and lets it be found for the context."""
    monkeypatch.setattr(interop, "_contexts", {})
    monkeypatch.setattr(interop, "_found", {})

    def make(**how):
        driver = Driver(gl, **how)
        return Cuda(gl, driver, NoCard()), driver

    return make


def test_the_stand_in_has_what_is_called():
    for name, parameters in CALLS.items():
        assert tuple(inspect.signature(getattr(Driver, name)).parameters)[1:] == parameters


def test_the_package_has_what_is_called():
    """Names and parameters of the installed cuda-bindings (which say so without a card)."""
    driver = pytest.importorskip("cuda.bindings.driver", reason="cuda-bindings is not installed")
    for name, parameters in CALLS.items():
        assert tuple(inspect.signature(getattr(driver, name)).parameters) == parameters, name
    assert int(driver.CUGLDeviceList.CU_GL_DEVICE_LIST_ALL) == 1
    assert int(driver.CUgraphicsRegisterFlags.CU_GRAPHICS_REGISTER_FLAGS_READ_ONLY) == 1
    assert int(driver.CUstream(STREAM)) == STREAM and int(driver.CUdevice(3)) == 3
    assert int(driver.CUresult.CUDA_SUCCESS) == 0


def test_a_copy_is_what_opengl_wrote_in_the_order_that_is_asked_for(gl, cuda_of):
    cuda, driver = cuda_of()
    buffer = gl.ctx.buffer(np.arange(64, dtype=np.int32).tobytes())
    registered = Registered(gl, cuda, buffer)
    driver.log.clear()
    assert registered.read(4 * 60, 16).tolist() == list(range(4, 64))
    assert driver.log == [
        "cuCtxPushCurrent",
        "cuGraphicsMapResources",
        "cuGraphicsResourceGetMappedPointer",
        "cuMemcpyDtoDAsync",
        "cuGraphicsUnmapResources",
        "cuCtxPopCurrent",
    ]
    first = registered.read(8)
    buffer.write(np.array([5, 6], np.int32).tobytes())  # unmapped, so that OpenGL may
    assert registered.read(8).tolist() == [5, 6] and first.tolist() == [0, 1], "tensors are their own"
    with pytest.raises(NoInterop, match=r"CUDA sees 256 of 256 bytes"):
        registered.read(256, 4)
    assert not driver.mapped and not driver.stack
    registered.release()
    registered.release()
    assert driver.log.count("cuGraphicsUnregisterResource") == 1
    with pytest.raises(NoInterop, match="not registered any more"):
        registered.read(4)
    buffer.release()


def test_it_proves_itself_with_what_a_shader_writes(gl, cuda_of):
    cuda, driver = cuda_of()
    prove(gl, cuda)
    assert driver.copies == 2 and not driver.registered and not driver.stack
    for spoils in (0, 1):  # the second pattern finds what was there before
        cuda, driver = cuda_of(spoils=spoils)
        with pytest.raises(NoInterop, match=r"^CUDA reads other bytes than OpenGL wrote \(1 of 26\d+ words\)"):
            prove(gl, cuda)
        assert not driver.registered


@pytest.mark.parametrize("call", [name for name in CALLS if name not in ("cuGetErrorName", "cuCtxPopCurrent")])
def test_any_call_that_fails_is_a_reason(gl, cuda_of, call):
    """And nothing stays mapped, registered or current, as far as the driver lets go."""
    driver = Driver(gl, fails={call})
    try:
        prove(gl, Cuda(gl, driver, NoCard()))
    except NoInterop as why:
        assert str(why) == f"{call}: CUDA_ERROR_OF_THE_TEST"
    else:
        assert call == "cuGraphicsUnregisterResource", "the end of a proof that went well"
    assert not driver.mapped and not driver.registered


def test_what_is_missing_is_a_reason(gl, cuda_of, monkeypatch):
    with pytest.raises(NoInterop, match="^CUDA knows no card of this OpenGL context$"):
        cuda_of(cards=())
    with pytest.raises(NoInterop, match="^OpenGL draws on CUDA's card 6, and torch sees 2$"):
        cuda_of(cards=(6,))
    monkeypatch.setattr(interop, "_contexts", {})
    with pytest.raises(NoInterop, match=r"^cuGLGetDevices: AttributeError: .*CUGLDeviceList|^cuInit: AttributeError"):
        Cuda(gl, SimpleNamespace(), NoCard())  # a package of another layout
    if not torch.cuda.is_available():
        with pytest.raises(NoInterop, match="^torch sees no CUDA device$"):
            Cuda(gl)
    monkeypatch.setitem(sys.modules, "cuda.bindings.driver", None)
    with pytest.raises(NoInterop, match=r"^no cuda-bindings \(ModuleNotFoundError: "):
        Cuda(gl, None, NoCard())
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(NoInterop, match=r"^no torch \("):
        Cuda(gl)


def test_the_answer_is_found_once(gl, monkeypatch):
    asked = []
    monkeypatch.setattr(interop, "_tried", lambda gl: asked.append(gl) or "because")
    monkeypatch.setattr(interop, "_found", {})
    assert proven(gl) == proven(gl) == "because" and asked == [gl]


def test_a_processor_that_draws_is_a_reason(gl):
    if not gl.is_software:
        pytest.skip("a card draws here")
    assert interop._tried(gl).startswith("the processor draws (")


# --- tensors --------------------------------------------------------------------------------------------------------


class OnCard:
    """Passes for torch.device("cuda", 1)."""

    type, index = "cuda", CARD

    def __str__(self):
        return f"cuda:{self.index}"


def test_ways(gl, cuda_of, monkeypatch):
    cuda, driver = cuda_of()
    buffer = gl.ctx.buffer(np.arange(32, dtype=np.int32).tobytes())
    monkeypatch.setattr(tensors, "proven", lambda gl: cuda)
    reader = Reader(gl, buffer, OnCard())
    assert reader.way == Way("interop") and reader.read(128).tolist() == list(range(32))
    reader.release()
    assert not driver.registered
    other = OnCard()
    other.index = 0
    assert Reader(gl, buffer, other).way == ("pinned", "OpenGL draws on cuda:1, tensors are asked for on cuda:0")
    driver.fails = {"cuGraphicsGLRegisterBuffer"}
    assert str(Reader(gl, buffer, OnCard()).way) == "pinned: cuGraphicsGLRegisterBuffer: CUDA_ERROR_OF_THE_TEST"
    monkeypatch.setattr(tensors, "proven", lambda gl: "no cuda-bindings")
    assert str(Reader(gl, buffer, OnCard()).way) == "pinned: no cuda-bindings"
    here = Reader(gl, buffer, torch.device("cpu"))
    assert here.way.way == "pageable" and here.read(64, 64).tolist() == list(range(16, 32))
    buffer.release()


@pytest.mark.parametrize("call", ["cuGraphicsMapResources", "cuMemcpyDtoDAsync", "cuGraphicsUnmapResources"])
def test_a_read_that_fails_is_done_another_way_and_says_so(gl, cuda_of, monkeypatch, call):
    cuda, driver = cuda_of()
    buffer = gl.ctx.buffer(np.arange(32, dtype=np.int32).tobytes())
    monkeypatch.setattr(tensors, "proven", lambda gl: cuda)
    reader, by = Reader(gl, buffer, OnCard()), []
    monkeypatch.setattr(reader, "_by_pinned", lambda size, offset: by.append((size, offset)))
    driver.fails = {call}
    reader.read(64, 32)
    assert by == [(64, 32)] and str(reader.way) == f"pinned: {call}: CUDA_ERROR_OF_THE_TEST"
    assert not driver.registered
    driver.fails = set()
    reader.read(64)
    assert len(by) == 2, "it is not tried again"
    buffer.release()


def test_memory_that_cannot_be_pinned(gl, monkeypatch):
    """(Here there is none: torch refuses it without a card.)"""
    if torch.cuda.is_available():
        pytest.skip("memory can be pinned here")
    monkeypatch.setattr(tensors, "proven", lambda gl: "no cuda-bindings")
    buffer = gl.ctx.buffer(np.arange(32, dtype=np.int32).tobytes())
    reader = Reader(gl, buffer, OnCard())
    reader.device = torch.device("cpu")
    assert reader.way.way == "pinned" and reader.read(8, 4).tolist() == [1, 2]
    assert reader.way.way == "pageable" and reader.way.why
    buffer.release()


@pytest.mark.parametrize("on_card", [False, True])
def test_sinks_give_tensors_of_the_same_numbers(gl, cuda_of, monkeypatch, on_card):
    """Type and bits, of processor's tensors and of what the stand-in copies; an old tensor stays what it was."""
    cuda, driver = cuda_of()
    if on_card:
        monkeypatch.setattr(tensors, "proven", lambda gl: cuda)
        monkeypatch.setattr(tensors, "_device", lambda name, gl: device)
    device = OnCard()
    frames, times = random_clip(3, frames=4, height=24, width=40)
    card = CardEsim(24, 40, EsimConfig(), 2, gl=gl)
    sinks = Voxels(card, 3), Counts(card), Latest(card)
    for sink in sinks:
        sink.begin(int(times[0]) // 1000, int(times[-1]) // 1000)
    seen = []
    for frame, t in zip(frames, times, strict=True):
        card.advance(frame, int(t))
        for sink in sinks:
            sink.add()
        seen.append([(sink.tensor(), sink.read()) for sink in sinks])
    for made, read in (pair for row in seen for pair in row):
        assert made.numpy().dtype == read.dtype
        np.testing.assert_array_equal(made.numpy(), read)
    assert all((seen[1][k][1] != seen[3][k][1]).any() for k in range(3))
    assert {sink.way().way for sink in sinks} == {"interop" if on_card else "pageable"}
    for sink in sinks:
        sink.release()
    assert not driver.registered and driver.log.count("cuGraphicsUnregisterResource") == 3 * on_card
    card.release()


def test_tiles_give_tensors(gl, cuda_of, monkeypatch):
    cuda, driver = cuda_of()
    device = OnCard()
    monkeypatch.setattr(tensors, "proven", lambda gl: cuda)
    monkeypatch.setattr(tensors, "_device", lambda name, gl: device)
    frames, times = random_clip(3, frames=4, height=24, width=40)
    with Atlas(gl, 24, 40, tiles=2) as atlas:
        sink, tiles = (
            TileSinks(atlas, Latest),
            [atlas.emulator(EsimConfig(contrast_threshold=c), 1) for c in (0.1, 0.3)],
        )
        for tile in tiles:
            sink.begin(tile, int(times[0]) // 1000 + 500, int(times[-1]) // 1000)
        for frame, t in zip(frames, times, strict=True):
            for tile in tiles:
                tile.advance(frame, int(t))
            sink.add()
        one, other = (sink.tensor(tile).numpy() for tile in tiles)
        np.testing.assert_array_equal(one, sink.read(tiles[0]))
        np.testing.assert_array_equal(other, sink.read(tiles[1]))
        assert (one != other).any() and sink.way() == Way("interop")
        sink.release()
    assert not driver.registered


def test_a_context_that_ends_first_lets_go(cuda_of, monkeypatch):
    with create_context() as other:
        driver = Driver(other)
        registered = Registered(other, Cuda(other, driver, NoCard()), other.ctx.buffer(reserve=64))
        assert len(driver.registered) == 1
    assert not driver.registered and driver.log[-2:] == ["cuGraphicsUnregisterResource", "cuCtxPopCurrent"]
    registered.release()


def test_devices_that_there_are_not(gl):
    card = CardEsim(8, 8, EsimConfig(), gl=gl)
    sink = Counts(card)
    for name, said in (
        ("cuds", r"^device: no device of torch's \(got 'cuds'\); expected cpu, cuda, or cuda:N"),
        ("meta", r"^device: not a device for tensors \(got 'meta'\)"),
        ("cuda:97", r"^device: no such card for torch \(got 'cuda:97'\); expected cpu"),
    ):
        with pytest.raises(EventDataError, match=said):
            sink.tensor(name)
    sink.release()
    card.release()


def test_without_torch(gl, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(EventDataError, match=r"^device: tensors need torch; expected pip install torch, or read\(\)"):
        way_here(gl)
    assert importlib.util.find_spec("blinkgl.card.interop") is not None
