"""The benchmark program: two checkouts take turns, each with its own packages."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np

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


def test_a_checkout_has_its_own_shaders():
    program = "import sys; sys.path.insert(0, sys.argv[1]); import blinkgl.shaders as s; print(s.__path__)"
    with bench.checkout(ROOT) as folder:
        done = subprocess.run([sys.executable, "-c", program, folder], capture_output=True, text=True, check=True)
        assert folder in done.stdout


def test_milliseconds_are_of_a_unit():
    found = bench.timed(lambda: {"units": 4, "draw": 0.2})
    assert set(found) == {"", ": draw"} and found[": draw"][0] == 50.0 and np.isnan(found[": draw"][1])


def test_every_row_is_described(capsys):
    bench.main([])
    text = capsys.readouterr().out
    assert all(what in text and function.__doc__ for what, function in bench.WHATS.items())
