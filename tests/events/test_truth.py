"""Which surface made an event, by hand: two frames of three pixels, and what an event between them is given."""

import numpy as np

from blinkgl.events import Events
from blinkgl.events.truth import Surfaces, SurfaceTruth

MS = 1_000_000


def shown(*pixels):
    """(id, depth, speed) of a picture of one row."""
    ids, depth, speed = (np.array([part]) for part in zip(*pixels))
    return Surfaces(
        ids.astype(np.uint32), depth.astype(np.float32), np.stack([speed, 0 * speed], -1).astype(np.float32)
    )


def events(*rows):
    """(x, t µs)"""
    x, t = (np.array(part) for part in zip(*rows))
    return Events(x.astype(np.uint16), np.zeros(len(x), np.uint16), t.astype(np.int64), np.ones(len(x), np.uint8))


NOTHING, WALL, BOX = (0, np.inf, 0), (1, 5, 1), (2, 3, 20)


def test_the_nearer_in_time_where_nothing_passes_else_the_nearer_surface():
    truth = SurfaceTruth()
    truth.see(0, shown(WALL, WALL, BOX, NOTHING))
    truth.see(10 * MS, shown((1, 5.1, 2), BOX, WALL, (2, 3, 7)))
    given = truth.of(events((0, 4000), (0, 6000), (1, 1000), (1, 9000), (2, 1000), (2, 9000), (3, 100)), 10 * MS)
    assert given["instance"].tolist() == [1, 1, 2, 2, 2, 2, 2]
    assert given["velocity"][:, 0].tolist() == [1, 2, 20, 20, 20, 20, 7]
    assert np.allclose(given["depth"], [5, 5.1, 3, 3, 3, 3, 3])


def test_a_pixel_that_sees_its_neighbours_asks_them():
    frames = shown(WALL, BOX), shown(WALL, BOX)
    for reach, whose in ((0, 1), (1, 2)):
        truth = SurfaceTruth(reach)
        truth.see(0, frames[0])
        truth.see(10 * MS, frames[1])
        assert truth.of(events((0, 5000)), 10 * MS)["instance"][0] == whose


def test_what_a_pixel_remembers_is_still_that_of_what_left():
    truth, memory_s = SurfaceTruth(), np.full((1, 1), 0.015)
    for ms, pixel in ((0, BOX), (10, WALL), (20, WALL), (30, WALL)):
        truth.see(ms * MS, shown(pixel), memory_s)
        if ms == 20:
            assert truth.of(events((0, 15_000)), 20 * MS)["instance"][0] == 2
    assert truth.of(events((0, 24_000), (0, 26_000)), 30 * MS)["instance"].tolist() == [2, 1]
