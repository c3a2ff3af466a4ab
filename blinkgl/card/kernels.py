"""Running compute shaders: buffers bound by number, uniforms set at every run, prefix sums."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import moderngl

from blinkgl.card.arith import includes
from blinkgl.errors import GLError
from blinkgl.gl.shader import MADE

if TYPE_CHECKING:
    from blinkgl.gl import GLContext

MADE.append(includes)
WORD, BLOCK_WORDS, LOCAL, PIXELS_PER_GROUP = 32, 32, 64, 256
"""As in shaders/include/events.glsl: pixels of a word of marks, words of a block, invocations of a group."""
PART, DIGIT_BITS = 64, 4
DIGITS = 2**DIGIT_BITS
"""As in shaders/compute/events_sort.glsl: events that an invocation sorts, and bits of a digit."""
HEAD_BYTES, PIXELS_AT, CHUNKS_AT, PARTS_AT, DIGITS_AT = 80, 0, 12, 48, 60
"""Size of the head of a list, and where in it the triples for indirect dispatches stand."""
EVENTS, CUT, UNUSABLE = 7, 8, 10
"""Words of the head: events, those that were cut, whether the frame has a value that cannot be used."""


class Rounding(NamedTuple):
    """What is computed in whole numbers, because a card's own is not that of IEEE 754: sums and products of floats,
    their quotients and roots, all of doubles. See :mod:`blinkgl.card.proof`."""

    soft_float: bool = False
    soft_division: bool = False
    soft_double: bool = False

    @property
    def defines(self) -> dict[str, int]:
        return {name.upper(): 1 for name, soft in self._asdict().items() if soft}


IEEE = Rounding()


class Kernels:
    """Compute programs of one context."""

    def __init__(self, gl: GLContext, rounding: Rounding = IEEE):
        self.gl = gl
        self._soft = rounding.defines
        self._uniforms: dict[moderngl.ComputeShader, dict[str, moderngl.Uniform]] = {}
        self._lanes = 64 if gl.is_software else 1024  # of the one group that adds up sums

    def run(
        self,
        name: str,
        defines: Mapping[str, Any],
        buffers: Mapping[int, moderngl.Buffer],
        values: Mapping[str, Any],
        *,
        items: int = 0,
        local: int = LOCAL,
        indirect: tuple[moderngl.Buffer, int] | None = None,
    ) -> None:
        """``items`` invocations in groups of ``local``, or as many groups as the three words at an offset of a buffer
        say. buffers : by binding.   values : of uniforms; those that the variant does not have are left out."""
        kernel = self.gl.kernel(name, {**defines, **self._soft})
        for binding, buffer in buffers.items():
            buffer.bind_to_storage_buffer(binding)
        uniforms = self._uniforms.get(kernel)
        if uniforms is None:
            members = {key: kernel[key] for key in kernel}
            uniforms = {key: one for key, one in members.items() if isinstance(one, moderngl.Uniform)}
            self._uniforms[kernel] = uniforms
        for key, uniform in uniforms.items():
            if key in values:
                uniform.value = values[key]
        if indirect is not None:
            kernel.run_indirect(*indirect)
        else:
            kernel.run(-(-items // local))
        self.gl.ctx.memory_barrier()

    def prefix_of_bits(
        self, head: moderngl.Buffer, words: moderngl.Buffer, sums: moderngl.Buffer, offsets: moderngl.Buffer, count: int
    ) -> None:
        """``offsets``: how many bits are set before each word; ``sums``: before each block of 32 words, and at the end
        all, which the head is told. count : of words, a multiple of 32."""
        chunks = count // BLOCK_WORDS
        buffers, values = {0: head, 1: words, 2: sums}, {"chunks_given": chunks}
        self.run("compute/prefix.glsl", {"BITS": 1, "SUMS": 1}, buffers, values, items=chunks)
        self.run("compute/prefix.glsl", {"BITS": 1, "SCAN": 1, "LANES": self._lanes}, buffers, values, items=1)
        self.run("compute/prefix.glsl", {"BITS": 1, "OFFSETS": 1}, {**buffers, 3: offsets}, values, items=chunks)

    def prefix_of_counts(
        self,
        head: moderngl.Buffer,
        counts: moderngl.Buffer,
        sums: moderngl.Buffer,
        offsets: moderngl.Buffer,
        capacity: int,
    ) -> None:
        """``offsets``: the sum of ``counts`` before each; the head says how many there are, and is told the total.
        capacity : events that there is room for."""
        self._prefix_of_numbers({}, head, counts, sums, offsets, CHUNKS_AT, {"capacity": capacity})

    def _prefix_of_numbers(
        self,
        defines: Mapping[str, Any],
        head: moderngl.Buffer,
        numbers: moderngl.Buffer,
        sums: moderngl.Buffer,
        offsets: moderngl.Buffer,
        at: int,
        values: Mapping[str, Any],
    ) -> None:
        buffers = {0: head, 1: numbers, 2: sums}
        self.run("compute/prefix.glsl", {**defines, "SUMS": 1}, buffers, {}, indirect=(head, at))
        self.run("compute/prefix.glsl", {**defines, "SCAN": 1, "LANES": self._lanes}, buffers, values, items=1)
        self.run("compute/prefix.glsl", {**defines, "OFFSETS": 1}, {**buffers, 3: offsets}, {}, indirect=(head, at))

    def sort(self, head: moderngl.Buffer, events: moderngl.Buffer, room: SortRoom, bits: int) -> moderngl.Buffer:
        """The packed events that the head counts, by time, equal times in the order in which they are: in ``events`` or
        in the room's other buffer, which is returned. bits : of the largest time.   room : for as many."""
        capacity = events.size // 8
        given, taken = events, room.other
        for low in range(0, bits, DIGIT_BITS):
            values = {"shift": low + 1, "capacity": capacity}
            parts = (head, PARTS_AT)
            buffers = {0: head, 1: given, 2: room.digits}
            self.run("compute/events_sort.glsl", {"DIGITS": 1}, buffers, values, indirect=parts)
            self._prefix_of_numbers({"PARTS": 1}, head, room.digits, room.sums, room.places, DIGITS_AT, {})
            buffers = {0: head, 1: given, 2: room.places, 3: taken}
            self.run("compute/events_sort.glsl", {"SCATTER": 1}, buffers, values, indirect=parts)
            given, taken = taken, given
        return given


class SortRoom:
    """What sorting ``capacity`` events on the card takes beside them: 11 bytes each."""

    def __init__(self, gl: GLContext, capacity: int):
        self.capacity = capacity
        numbers = 4 * DIGITS * 2 * -(-capacity // (2 * PART))
        self.other = gl.ctx.buffer(reserve=8 * capacity)
        self.digits, self.places = (gl.ctx.buffer(reserve=numbers) for _ in range(2))
        self.sums = gl.ctx.buffer(reserve=numbers // 32 + 4)

    def release(self) -> None:
        for buffer in (self.other, self.digits, self.places, self.sums):
            buffer.release()


def refuse_without_compute(gl: GLContext) -> None:
    """Raises GLError, one line, where this OpenGL has no compute shaders that can do the work."""
    if gl.ctx.version_code < 430:
        raise GLError(
            "no compute shaders",
            where="events.device",
            value=f"OpenGL {gl.version} of {gl.renderer}",
            accepted="OpenGL 4.3, or events.device: cpu",
        )
