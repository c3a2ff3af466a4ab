"""Frames as tensors: the numbers that are read, the ways there, and what stands between CUDA and a texture."""

from __future__ import annotations

import ctypes
from types import SimpleNamespace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from blinkgl.config.sequence import RenderConfig  # noqa: E402
from blinkgl.errors import GLError  # noqa: E402
from blinkgl.gl import Target  # noqa: E402
from blinkgl.render.renderer import Renderer  # noqa: E402
from blinkgl.render.tensors import TextureReader  # noqa: E402
from render_scenes import mixed_scene  # noqa: E402


def test_a_frame_as_a_tensor_is_what_is_read(gl):
    with Renderer(gl, mixed_scene(48, 36), RenderConfig()) as renderer:
        for frame, names in (
            (renderer.luminance(0), ("",)),
            (renderer.brightness(0), ("",)),
            (renderer.colour(0), ("",)),
        ):
            for name in names:
                read = frame.read(name)
                made = frame.tensor("cpu", name)
                assert made.is_contiguous() or made.ndim == 3
                assert np.array_equal(made.numpy(), read) and made.numpy().dtype == read.dtype
        first = renderer.luminance(0)
        kept, wanted = first.tensor("cpu"), first.read()
        renderer.luminance(10**8)
        assert np.array_equal(kept.numpy(), wanted), "a tensor is the caller's own"
        assert first.moment is not None
        with pytest.raises(GLError, match="no longer on the GPU"):
            first.tensor("cpu")


def test_what_is_not_there_is_said_in_a_line(gl):
    with Renderer(gl, mixed_scene(16, 12), RenderConfig()) as renderer:
        frame = renderer.luminance(0)
        assert frame.transfer("cpu") == "plain: tensors of the processor are asked for"
        with pytest.raises(GLError, match=r"device.*no such device for torch"):
            frame.tensor("cuda:99")
        with pytest.raises(GLError, match=r"device.*no such device for torch"):
            frame.tensor("abacus")
        with pytest.raises(GLError, match="no such output"):
            frame.tensor("cpu", "colour")


class Driver:
    """``cuda.bindings.driver`` as far as it is called; copies what OpenGL holds, from the processor's memory."""

    CUGLDeviceList = SimpleNamespace(CU_GL_DEVICE_LIST_ALL=1)
    CUgraphicsRegisterFlags = SimpleNamespace(CU_GRAPHICS_REGISTER_FLAGS_READ_ONLY=1)
    CUmemorytype = SimpleNamespace(CU_MEMORYTYPE_ARRAY=3, CU_MEMORYTYPE_DEVICE=2)
    CUDA_MEMCPY2D = SimpleNamespace
    CUstream = int

    def __init__(self, target, fails=None, wrong=False):
        self.target, self.fails, self.wrong, self.calls = target, fails, wrong, []
        self.fails_after = 0

    def __getattr__(self, name):
        def call(*arguments):
            self.calls.append(name)
            if name == self.fails and self.calls.count(name) > self.fails_after:
                return (999,)
            return (0, *self.answer(name, arguments))

        return call

    def answer(self, name, arguments):
        if name == "cuGLGetDevices":
            return 1, [0]
        if name == "cuGraphicsGLRegisterImage":
            assert arguments == (self.target.colour[0].glo, 0x0DE1, 1)
        if name == "cuMemcpy2DAsync":
            copy = arguments[0]
            picture = self.target.read(0)
            assert copy.WidthInBytes * copy.Height == picture.nbytes and copy.srcArray == "array"
            ctypes.memmove(copy.dstDevice, picture.ctypes.data, picture.nbytes - (4 if self.wrong else 0))
        return {
            "cuDevicePrimaryCtxRetain": ("context",),
            "cuGraphicsGLRegisterImage": ("resource",),
            "cuGraphicsSubResourceGetMappedArray": ("array",),
        }.get(name, ())


@pytest.fixture
def target(gl):
    with Target(gl, 16, 8, ("RGBA32F",), depth=False) as made:
        made.clear((0.25, 0.5, 1.0, 2.0))
        yield made


def test_cuda_maps_copies_and_lets_go_in_order(gl, target):
    driver = Driver(target)
    reader = TextureReader(gl, target, 0, "cpu", driver)
    assert (reader.way, reader.why) == ("interop", "")
    del driver.calls[:]
    assert np.array_equal(reader.read().numpy(), target.read(0))
    assert [one for one in driver.calls if "Ctx" not in one] == [
        "cuGraphicsMapResources",
        "cuGraphicsSubResourceGetMappedArray",
        "cuMemcpy2DAsync",
        "cuGraphicsUnmapResources",
    ]
    assert driver.calls.count("cuCtxPushCurrent") == driver.calls.count("cuCtxPopCurrent") == 4
    reader.release()
    reader.release()
    assert driver.calls.count("cuGraphicsUnregisterResource") == 1


@pytest.mark.parametrize(
    "fails", ["cuInit", "cuGLGetDevices", "cuGraphicsGLRegisterImage", "cuGraphicsMapResources", "cuMemcpy2DAsync"]
)
def test_what_the_driver_refuses_is_read_another_way(gl, target, fails):
    reader = TextureReader(gl, target, 0, "cpu", Driver(target, fails))
    assert reader.way == "plain" and reader.why == f"{fails}: error 999"
    assert torch.equal(reader.read(), torch.from_numpy(target.read(0)))


def test_other_numbers_are_not_believed(gl, target):
    driver = Driver(target, wrong=True)
    target.clear((0.25, 0.5, 1.0, float("nan")))
    reader = TextureReader(gl, target, 0, "cpu", driver)
    assert reader.why == "CUDA reads other numbers than OpenGL" and "cuGraphicsUnregisterResource" in driver.calls


def test_a_call_that_fails_later_changes_the_way(gl, target):
    driver = Driver(target, "cuMemcpy2DAsync")
    driver.fails_after = 1
    reader = TextureReader(gl, target, 0, "cpu", driver)
    assert reader.way == "interop"
    assert torch.equal(reader.read(), torch.from_numpy(target.read(0)))
    assert reader.way == "plain" and driver.calls[-3:].count("cuGraphicsUnregisterResource") == 1
