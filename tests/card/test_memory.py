"""Buffers that do not fit on a card: said before anything is made, with what would."""

from __future__ import annotations

import pytest

from blinkgl.card import CardEsim, Voxels, memory
from blinkgl.errors import GLError


def test_more_than_is_free_is_refused_before_anything_is_made(gl, monkeypatch):
    monkeypatch.setattr(memory, "free_bytes", lambda gl: 2**20)
    made = []
    monkeypatch.setattr("blinkgl.card.room.refuse_if_out_of_memory", lambda *_: made.append(1))
    with pytest.raises(GLError) as caught:
        CardEsim(480, 640, gl=gl)
    said = str(caught.value)
    assert said.startswith("events.device: 640x480 pixels take more memory than this card has free (got '17 MiB')")
    assert said.endswith("expected at most 1 MiB, or pictures of 150x113 px, or events.device: cpu")
    assert not made and "\n" not in said
    card = CardEsim(113, 150, gl=gl)  # what it said would fit
    assert made
    with pytest.raises(GLError, match=r"^events\.device: 256 planes of 150x113 take more .*or pictures of 35x27 px"):
        Voxels(card, 256)
    card.release()


def test_the_driver_may_have_no_room_all_the_same(gl, monkeypatch):
    real = gl.ctx
    monkeypatch.setattr(gl, "ctx", type("ctx", (), {"error": "GL_OUT_OF_MEMORY"}))
    with pytest.raises(GLError, match=r"^events\.device: no memory left on the card for 9x9 pixels; expected less, or"):
        memory.refuse_if_out_of_memory(gl, "9x9 pixels")
    monkeypatch.setattr(gl, "ctx", real)
    memory.refuse_if_out_of_memory(gl, "9x9 pixels")


@pytest.mark.parametrize("extension", ["GL_NVX_gpu_memory_info", "GL_ATI_meminfo", "none"])
def test_what_drivers_say(extension):
    def function(name, *_):
        assert name == "glGetIntegerv"

        def answer(what, to):
            to[0] = {0x9049: 1000, 0x87FC: 2000}[what]

        return answer

    gl = type("gl", (), {"ctx": type("ctx", (), {"extensions": {extension}}), "function": staticmethod(function)})
    wanted = {"GL_NVX_gpu_memory_info": 1_024_000, "GL_ATI_meminfo": 2_048_000, "none": None}
    assert memory.free_bytes(gl) == wanted[extension]
