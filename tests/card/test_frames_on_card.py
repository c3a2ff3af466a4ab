"""Frames that never leave the card: textures into the event kernel, the events of arrays."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.card import CardEsim
from blinkgl.config.events import EsimConfig
from blinkgl.errors import EventDataError
from blinkgl.events import Esim
from blinkgl.gl import create_context
from tests.events.clips import assert_same, random_clip, run


def textures(gl, clip):
    return [gl.ctx.texture(frame.shape[::-1], 1, frame.tobytes(), dtype="f4") for frame in clip]


@pytest.mark.parametrize("size", [(37, 45), (1, 1), (5, 70), (64, 64)])
def test_a_texture_is_as_good_as_an_array(gl, size):
    clip, times = random_clip(5, frames=6, height=size[0] + 6, width=size[1])
    clip = np.ascontiguousarray(clip[:, 6:])
    clip[2, 0, 0] = -0.0  # counts as zero
    frames = textures(gl, clip)
    config = EsimConfig(threshold_sigma=0.03)
    card = CardEsim(*size, config, 2, gl=gl)
    mixed = CardEsim(*size, config, 2, gl=gl)
    wanted = run(Esim(*size, config, 2), clip, times)
    assert_same(run(card, frames, times), wanted)
    assert_same(run(mixed, [frames[k] if k % 2 else clip[k] for k in range(6)], times), wanted)
    for name, array in card.state_dict().items():
        np.testing.assert_array_equal(mixed.state_dict()[name], array, err_msg=name)
    for thing in (card, mixed, *frames):
        thing.release()


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0, 2.0**31])
def test_a_bad_value_in_a_texture_leaves_the_state_alone(gl, value):
    """The same words as for an array, in the first frame and in a later one; the next good frame goes on."""
    clip, times = random_clip(1, frames=5)
    bad = clip[2].copy()
    bad[3, 4] = value
    good, (wrong,) = textures(gl, clip), textures(gl, [bad])
    card, fast = CardEsim(37, 45, None, 2, gl=gl), Esim(37, 45, None, 2)
    for k in range(2):
        said = []
        for emulator, frame in ((card, wrong), (fast, bad)):
            with pytest.raises(EventDataError) as caught:
                emulator.step(frame, int(times[k]))
            said.append((str(caught.value), caught.value.pixel))
        assert said[0] == said[1] and "pixel x=4, y=3" in said[0][0]
        assert_same(card.step(good[k], int(times[k])), fast.step(clip[k], int(times[k])))
    assert_same(run(card, good[2:], times[2:]), run(fast, clip[2:], times[2:]))
    for thing in (card, wrong, *good):
        thing.release()


def test_what_is_no_frame_of_this_card(gl):
    card = CardEsim(8, 8, gl=gl)
    said = r"^frame 0: not a frame of this card .*{}.*; expected a texture of one 32-bit float"
    for components, dtype, got in ((2, "f4", "2 x f4"), (1, "f2", "1 x f2")):
        texture = gl.ctx.texture((8, 8), components, dtype=dtype)
        with pytest.raises(EventDataError, match=said.format(got)):
            card.step(texture, 0)
        texture.release()
    small = gl.ctx.texture((9, 8), 1, dtype="f4")
    with pytest.raises(EventDataError, match=r"frame size changed.*\(8, 9\)"):
        card.step(small, 0)
    small.release()
    with create_context() as other:
        theirs = other.ctx.texture((8, 8), 1, dtype="f4")
        with pytest.raises(EventDataError, match=said.format("of another context")):
            card.step(theirs, 0)
    gl.make_current()
    card.release()
