"""The tables of docs/trade.md are those of the measurement that is kept, and the tool that writes them puts them
there."""

from __future__ import annotations

from pathlib import Path

import pytest

from blinkgl.config.quality import measured
from blinkgl.tools import trade_tables

PAGE = Path(__file__).parents[2] / "docs" / "trade.md"


def row(name: str, cost: float, error: float, trusted: bool = True, front: bool = False) -> dict:
    return {
        "name": name,
        "cpu_s": cost,
        "voxel": error,
        "trusted": trusted,
        "on_front": front,
        "reference_events": 1200,
    }


EDGES = "displacement {} px, linear, edges, mip bias -1"
SCENE = {
    "what": "What is hard.",
    "clip_s": 0.02,
    "converged": False,
    "reference": "the reference did NOT converge to a tenth (10 %) within the limits: 32x32 samples a pixel, 0.0625 px "
    "between frames (9 frames); from the level before it moved by, in parts of the smallest error judged: median time "
    "2.9 %, 95 % time 11 %, missed and extra 6.4 %, voxel grid 23 %",
    "settings": [
        row(trade_tables.BEFORE, 4, 0.8),
        row(trade_tables.ASKED, 4, 0.4, front=True),
        row(EDGES.format(2), 1, 0.8),
        row(EDGES.format(1), 2, 0.2, front=True),
        row("displacement 1 px, pchip, ssaa4, mip bias -1", 8, 0.1, trusted=False),
    ],
}
RESULT = {
    "cost": "cpu_s",
    "error": "voxel",
    "presets": {
        "fast": EDGES.format(2),
        "balanced": EDGES.format(1),
        "accurate": "displacement 1 px, pchip, ssaa4, mip bias -1",
        "reference": "displacement 0.5 px, linear, ssaa4, mip bias -1",
    },
    "scenes": {"one": SCENE},
}


def test_the_page_is_of_the_measurement_that_is_kept():
    text = PAGE.read_text(encoding="utf-8")
    made = trade_tables.tables(measured())
    assert len(made) >= 4
    for lines in made:
        assert "\n".join(lines) in text


def test_tables_by_hand():
    scenes, presets, frames, steps, standing = trade_tables.tables(RESULT)
    assert scenes[2] == "| one | What is hard | 20 ms | 1,200 | 32x32, 0.0625 px | no: 23 % | 4 of 5 |"
    assert (
        presets[2]
        == "| one | 80 % / 4.0 s |  | 80 % / 1.0 s | **40 % / 4.0 s** | **20 % / 2.0 s** | (10 % / 8.0 s) |  |"
    )
    assert frames[2].startswith("| one |  |  | 80 % |  |") and steps[2].startswith(
        "| one |  | 80 % / 1.0 s |  | **20 %"
    )
    assert standing[2] == f"| fast | {EDGES.format(2)} | 1 of 1 scenes | - |"
    assert standing[4].endswith("| 0 of 0 scenes | - |"), "a row that does not count is not judged"


def test_the_price_at_another_one_s_error():
    """Half way in the logarithm of the error between 2 and 1 px is half way in that of the cost."""
    assert trade_tables.price_at(SCENE, RESULT) == pytest.approx(2**0.5 / 4)
    worse = {**SCENE, "settings": [row(trade_tables.ASKED, 4, 0.1), row(EDGES.format(1), 2, 0.2)]}
    assert trade_tables.price_at(worse, RESULT) is None
    text = "\n".join(trade_tables.sentences(RESULT))
    assert "one 0.35" in text and "error 0.25 times (0.25 to 0.25), cost 0.50 times" in text


def test_tables_are_put_where_they_were():
    page = "before\n\n| a | b |\n|---|---|\n| 1 | 2 |\n| 3 | 4 |\n\nafter\n"
    assert trade_tables.put(page, [["| a | b |", "|---|---|", "| 5 | 6 |"]]) == (
        "before\n\n| a | b |\n|---|---|\n| 5 | 6 |\n\nafter\n"
    )
    with pytest.raises(ValueError, match="no table begins with"):
        trade_tables.put(page, [["| c |"]])
