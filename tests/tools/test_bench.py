"""The benchmark program: two checkouts take turns, each with its own packages."""

import json
from pathlib import Path

from blinkgl.tools import bench

ROOT = Path(__file__).parents[2]


def test_two_checkouts_in_turns(tmp_path, capsys):
    target = tmp_path / "figures.json"
    arguments = ["voxels", "--rounds", "2", "--warm-up", "1", "--load", "1"]
    bench.main([*arguments, "--against", str(ROOT), "--json", str(target)])
    report = json.loads(target.read_text())
    assert report["what"] == "voxels" and set(report["rows"]) == {"integer pixels", "rectified"}
    for of in report["rows"].values():
        assert set(of) == {"this", "against"}
        assert all(0 < r["fastest_ms"] <= r["wall_ms"] and r["cpu_ms"] > 0 for r in of.values())
    assert capsys.readouterr().out.count("this / against") == 2


def test_every_row_is_described(capsys):
    bench.main([])
    text = capsys.readouterr().out
    assert all(what in text and function.__doc__ for what, function in bench.WHATS.items())
