"""The page of tasks: its commands and programs run one after the other, as they stand there, on small data."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import trimesh

from blinkgl import cli

PAGE = Path(__file__).parents[2] / "docs" / "tasks.md"
NOT_HERE = {
    "blinkgl import scene.blend --out scene.glb": "needs bpy: tests/blender",
}
SHORT = {"eflow train": "--set optim.steps=1 --set data.batch=1 --set data.workers=0 --set data.validate_on=[]"}
RECIPE = """
seed: 1
camera: {width: 64, height: 48}
time: {duration: 0.2, label_rate: 20}
scene: {kind: random, objects: {count: 3}, pool: {}}
labels: {flow: [forward], images: true, depth: true}
output: {name: mine, sequences: 2}
"""


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE.read_text("utf-8"), re.S | re.M)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with everything that the page names."""
    folder = tmp_path_factory.mktemp("tasks")
    (folder / "my.yaml").write_text(RECIPE)
    y, x = np.mgrid[:48, :64]
    frames = [np.uint8(127 + 100 * np.sin(0.4 * (x - 2 * k) + 0.1 * y)) for k in range(10)]
    iio.imwrite(
        folder / "clip.mp4", [np.repeat(f[..., None], 3, 2) for f in frames], fps=50, plugin="pyav", codec="libx264"
    )
    (folder / "frames").mkdir()
    for k, frame in enumerate(frames):
        iio.imwrite(folder / "frames" / f"{k:04d}.png", frame)
    for kind in ("cat", "dog"):
        (folder / "pictures" / kind).mkdir(parents=True)
        iio.imwrite(folder / "pictures" / kind / "1.png", frames[0])
    (folder / "times.txt").write_text("".join(f"{0.02 * k:.3f}\n" for k in range(10)))
    trimesh.creation.box((0.5, 0.5, 0.5)).export(folder / "part.glb")
    return folder


def test_it_has_forty_tasks():
    assert len(re.findall(r"^\*\*", PAGE.read_text("utf-8"), re.M)) >= 40


@pytest.mark.parametrize("program", blocks("python"), ids=lambda text: text.splitlines()[-1][:40])
def test_a_program_runs(program, place, monkeypatch):
    monkeypatch.chdir(place)
    names: dict = {}
    exec(program, names)
    if "recording" in names:
        assert len(names["recording"].events) > 100
    if "events" in names:
        # 3 mm at 100 Hz: the pattern goes to and fro, so both polarities come in every half period.
        t = names["events"].t
        assert len(t) > 1000 and np.ptp(np.histogram(t, bins=8)[0]) < len(t) / 4


def test_the_commands_run_one_after_the_other(place, monkeypatch, capsys):
    monkeypatch.chdir(place)
    for line in (line for block in blocks("sh") for line in block.splitlines()):
        if line in NOT_HERE:
            continue
        program, *arguments = shlex.split(line)
        if program == "eflow":
            run = pytest.importorskip("eflow.cli").run
            arguments += shlex.split(SHORT.get(" ".join((program, arguments[0])), ""))
        else:
            run = cli.run
        assert run(arguments) == 0, (line, capsys.readouterr().err)
        capsys.readouterr()
    assert Path("out/mine/train/mine_000000/events.h5").is_file() and Path("out/as_dsec").is_dir()
    shutil.rmtree("out")
