"""Frames as tensors: the numbers that are read."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.config.sequence import RenderConfig
from blinkgl.errors import GLError
from blinkgl.render.renderer import Renderer
from render_scenes import mixed_scene


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
        with pytest.raises(GLError, match="no longer on the card"):
            first.tensor("cpu")


def test_what_is_not_there_is_said_in_a_line(gl):
    with Renderer(gl, mixed_scene(16, 12), RenderConfig()) as renderer:
        frame = renderer.luminance(0)
        with pytest.raises(GLError, match=r"device.*no such device for torch"):
            frame.tensor("cuda:99")
        with pytest.raises(GLError, match=r"device.*no such device for torch"):
            frame.tensor("abacus")
        with pytest.raises(GLError, match="no such output"):
            frame.tensor("cpu", "colour")
