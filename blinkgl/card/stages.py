"""The ten dispatches of a step, over the buffers of one emulator or of a batch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from blinkgl.card.kernels import PIXELS_AT, Kernels

if TYPE_CHECKING:
    import moderngl

    from blinkgl.card.room import Room


def is_long(interval: tuple[int, int]) -> bool:
    """Whether times in it, ns, need more than 31 bits."""
    return interval[1] - interval[0] >= 2**31


class Stages:
    """Of one room.   spread : thresholds of each pixel.   jitter, refractory : as the configuration asks."""

    def __init__(self, kernels: Kernels, room: Room, *, spread: bool, jitter: bool, refractory: bool):
        self._kernels, self._room, self._spread, self._more = kernels, room, spread, jitter or refractory
        variants = (("SPREAD", spread), ("JITTER", jitter), ("REFRACTORY", refractory))
        self._batch = {"BATCH": 1, "TILES": room.tiles} if room.tiles else {}
        self._defines = {**self._batch, **{name: 1 for name, there in variants if there}}

    def fire(self, values: Mapping[str, Any], *, checked: bool, long: bool) -> None:
        """Marks, lists, fires, and emits as far as there is room.

        values : of uniforms.   checked : looks for values that cannot be used: then nothing fires, and the head says
        so.   long : an interval :func:`is_long`."""
        room, kernels = self._room, self._kernels
        marks = {0: room["now"], 1: room["levels"], 2: room["marks"], 3: room["listed"]}
        kernels.run(
            "compute/events_mark.glsl",
            {**self._batch, **({"CHECKED": 1} if checked else {})},
            {**marks, **({4: room["before"]} if self._batch else {})},
            values,
            items=room.words,
        )
        kernels.prefix_of_bits(room["listed"], room["marks"], room["sums"], room["places"], room.words)
        kernels.run(
            "compute/events_list.glsl",
            self._batch,
            {0: room["marks"], 1: room["places"], 2: room["sums"], 3: room["listed"]},
            values,
            items=room.words,
        )
        more = {7: room["more"]} if self._more else {}
        self._run({}, {4: room["now"], 5: room["before"], 6: room["levels"], **more}, values, long)
        self.emit(values, long=long)

    def emit(self, values: Mapping[str, Any], *, long: bool) -> None:
        """The events, from the records, with what the head says of them."""
        room = self._room
        self._kernels.prefix_of_counts(room["listed"], room["counts"], room["sums"], room["places"], room.capacity)
        values = {**values, "capacity": room.capacity}
        self._run({"EMIT": 1}, {4: room["places"], 5: room["packed"]}, values, long)

    def _run(
        self, defines: Mapping[str, int], buffers: Mapping[int, moderngl.Buffer], values: Mapping[str, Any], long: bool
    ) -> None:
        room = self._room
        common = {0: room["listed"], 1: room["records"], 2: room["counts"]}
        if self._spread:
            common[3] = room["thresholds"]
        self._kernels.run(
            "compute/events_fire.glsl",
            {**self._defines, **({"LONG": 1} if long else {}), **defines},
            {**common, **buffers},
            values,
            indirect=(room["listed"], PIXELS_AT),
        )
