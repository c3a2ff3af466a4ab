"""Several sequences at once, a frame of each in turn: what a batch on the card wants."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from blinkgl.sequence.items import Item
from blinkgl.sequence.simulate import Simulation


def side_by_side(sequences: Iterable[Simulation], at_once: int) -> Iterator[tuple[int, Item]]:
    """(number of the sequence, what happens in it), each sequence in the order of its time.

    sequences : taken one by one, as there is room for them, so that an iterator may make them then.
    at_once : how many go on together, one event frame of each in turn.
    Where one fails the others are closed. What it raises is raised."""
    coming, running = enumerate(sequences), []
    try:
        while True:
            while len(running) < at_once and (one := next(coming, None)) is not None:
                running.append((*one, iter(one[1])))
            if not running:
                return
            for entry in list(running):
                number, sequence, items = entry
                frames = sequence.frames
                while sequence.frames == frames:
                    item = next(items, None)
                    if item is None:
                        running.remove(entry)
                        break
                    yield number, item
    finally:
        for _, sequence, _ in running:
            sequence.close()
