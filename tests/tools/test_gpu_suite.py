"""The suite for machines with a card runs whole on the processor; the wheels that it needs are all listed."""

from __future__ import annotations

import configparser
import json
import re
from pathlib import Path

import pytest

pytest.importorskip("torch")

from blinkgl.tools import gpu_suite

ROOT = Path(__file__).parents[2]


def names_of(text: str) -> set[str]:
    return {re.split(r"[><=;\[ ]", line.strip())[0].lower() for line in text.splitlines() if line.strip()}


def test_the_list_of_wheels_is_whole():
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    wanted = names_of(config["options"]["install_requires"]) | names_of(config["options.extras_require"]["learn"])
    lines = (ROOT / "tools" / "gpu_wheels.txt").read_text().splitlines()
    carried = [line for line in lines if not line.startswith("#")]
    there = {name.lower() for line in lines if line.startswith("# there: ") for name in line.split()[2:]}
    assert wanted <= names_of("\n".join(carried)) | there and not names_of("\n".join(carried)) & there
    pinned = {line.split(";")[0].strip() for line in (ROOT / "constraints.txt").read_text().splitlines()}
    assert set(carried) <= pinned


def test_every_piece_runs_here(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(gpu_suite, "DENSITIES", (0.1,))
    monkeypatch.setattr(gpu_suite, "SIZES", ((1, 1, 2), (3, 7, 4), (16, 20, 3)))
    status = gpu_suite.main(["--out", str(tmp_path), "--small", "--device", "cpu", "--events", "1000"])
    report = json.loads((tmp_path / "gpu_suite.json").read_text())
    states = {piece["state"] for piece in report["pieces"].values()}
    assert status == 0 and states == {"done"} and list(report["pieces"]) == list(gpu_suite.PIECES)
    rows = {name: {row[""]: row for row in piece["rows"]} for name, piece in report["pieces"].items()}
    assert rows["events"]["all, 1 turns"]["events, all the same"] > 10_000
    assert set(rows["events"]) > set(gpu_suite.VARIANTS)
    assert len(rows["kernel"]) == 3
    for row in rows["kernel"].values():  # the events that the row's name says, over and over
        # The thresholds differ by pixel, and pixels walk out of the clip's range (in numba
        # alike): the first steps have more events, so how many fit decides the mean.
        assert 0.5 < 1e6 * row["Mev/s"] / row["frames/s"] / (0.1 * 48 * 64) < 1.6
    assert all(row["frames go by"].startswith("plain") for row in rows["end_to_end"].values())
    page = (tmp_path / "gpu_suite.md").read_text()
    assert "| OpenGL: renderer | info |" in page and page in capsys.readouterr().out
