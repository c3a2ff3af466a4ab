"""The suite for machines with a card: what was measured is kept, what cannot be is said, the wheels are all listed."""

from __future__ import annotations

import argparse
import configparser
import json
import re
from pathlib import Path

import numpy as np
import pytest

from blinkgl.tools import gpu_pieces, gpu_suite
from blinkgl.tools.gpu_suite import LEFT, Rows, kept, main, stamp_of

ROOT = Path(__file__).parents[2]
STAMP = {"build": "tests", "small": True}


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
    assert "torch>=2.6" in config["options.extras_require"]["learn"].split()


def test_rows_are_kept_as_far_as_they_are_whole(tmp_path):
    file = tmp_path / "piece.jsonl"
    rows = Rows(file, STAMP)
    rows.add("a", fps=np.float64(2.5), same=np.True_)
    rows.add("b", fps=3)
    file.write_text(file.read_text() + '{"key": "c", "fp')  # killed here
    again = Rows(file, STAMP)
    assert again.rows == [{"key": "a", "fps": 2.5, "same": True}, {"key": "b", "fps": 3}]
    assert "b" in again and "c" not in again
    again.add("c", fps=4)
    assert [row["key"] for row in kept(file, STAMP)] == ["a", "b", "c"]
    assert kept(file, {**STAMP, "small": False}) == kept(tmp_path / "none.jsonl", STAMP) == []


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("suite")


def test_one_command_again_and_again(folder, monkeypatch, capfd):
    """Minutes that are too few; then all; then nothing is measured twice."""
    command = ["--out", str(folder), "--small", "--only", "doctor"]
    monkeypatch.setattr(gpu_suite, "LEAST_S", 0.0)
    assert main([*command, "--minutes", "0.0002"]) == LEFT
    report = json.loads((folder / "gpu_suite.json").read_text())
    assert report["pieces"]["doctor"]["state"] == "begun" and "minutes were over" in report["pieces"]["doctor"]["said"]
    assert main(command) == 0
    report = json.loads((folder / "gpu_suite.json").read_text())
    doctor = report["pieces"]["doctor"]
    assert doctor["state"] == "done" and report["stamp"] == stamp_of(True)
    assert any(row["key"] == "OpenGL: compute shaders" and row["status"] == "ok" for row in doctor["rows"])
    assert "| OpenGL: renderer | info |" in (folder / "gpu_suite.md").read_text()
    monkeypatch.setattr(gpu_suite, "_run", None)
    assert "left: doctor; the same command again goes on" in capfd.readouterr().out
    assert main(command) == 0 and "left:" not in capfd.readouterr().out


def test_what_a_machine_cannot_do_is_said_and_the_rest_goes_on(folder):
    assert main(["--out", str(folder), "--small", "--only", "kernel", "--backend", "egl", "--device", "97"]) == 0
    piece = json.loads((folder / "gpu_suite.json").read_text())["pieces"]["kernel"]
    assert piece["state"] == "absent" and "nothing draws here: gl.device: no such EGL device" in piece["said"]


def test_no_such_piece(capsys):
    with pytest.raises(SystemExit):
        main(["--only", "doctor,kernels"])
    assert "no piece is called that (got 'kernels'); expected doctor, frames" in capsys.readouterr().err


def test_density_of_the_clips():
    for density in (0.0, 0.07, 1.0):
        clip = gpu_pieces.noise(48, 64, density, 6)
        emulator = gpu_pieces.Esim(48, 64, gpu_pieces.Events.VARIANTS["plain"])
        counts = [len(emulator.step(frame, k * 10**6)) for k, frame in enumerate(clip)][1:]
        assert np.mean(counts) / (48 * 64) == pytest.approx(density, rel=0.1)


@pytest.mark.slow
def test_rows_of_card_and_processor(gl, tmp_path):
    """What is compared, beside something that differs."""
    found = gpu_pieces.Events.compared(gl, gpu_pieces.EsimConfig(), 24, 16, 0.3)
    assert found["numba"] == found["card"] > 100 and found["steps_that_differ"] == 0 and found["same_state"]
    tensors = gpu_pieces.Tensors.measured(gl, 24, 16, 5, "pageable", 0.01)
    assert tensors["same"] and tensors["way"] == "pageable" and tensors["samples_per_s"] > 0
    with gpu_pieces.create_context() as other:
        apart = gpu_pieces.Frames.apart(gl, other, 24, 16, "edges")
    assert apart["largest"] == apart["beyond"] == 0.0 and "llvmpipe" in apart["beside"]
    rows = Rows(tmp_path / "kernel.jsonl", STAMP)
    options = argparse.Namespace(small=True, backend="auto", device=0)
    gpu_pieces.SMALL, before = {"24x16": (24, 16)}, gpu_pieces.SMALL
    try:
        gpu_pieces.Kernel.run(rows, options)
    finally:
        gpu_pieces.SMALL = before
    assert len(rows.rows) == 16 and all(row["stay_steps_per_s"] > 0 for row in rows.rows)
    seen = {row["key"].split()[2]: row["events_per_step"] / (24 * 16) for row in rows.rows if "plain" in row["key"]}
    assert seen["0"] == 0 and seen["0.31"] == pytest.approx(0.31, rel=0.3) and seen["5"] == pytest.approx(5, rel=0.1)
