"""A job script has one line, ``eflow train … --resume``: whenever it was stopped, wherever its data are now."""

import errno
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import pytest
import yaml

torch = pytest.importorskip("torch")


from blinkgl.errors import ConfigError  # noqa: E402
from blinkgl.io.images import read_png  # noqa: E402
from eflow import checkpoint as ckpt  # noqa: E402
from eflow.cli import run  # noqa: E402
from eflow.load_config import load_train_config  # noqa: E402
from eflow.train import train  # noqa: E402
from flow_data import blinkgl_set  # noqa: E402
from trainings import config_file, log, tensors  # noqa: E402


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return blinkgl_set(tmp_path_factory.mktemp("train"), sequences=2, labels=2)


def test_one_line_for_a_job_script(tmp_path, data, capsys):
    """--resume begins where there is no run yet, and after a kill before the first checkpoint; what is there of another
    program is not touched; a finished training may get more steps."""
    path, out = config_file(tmp_path, data, steps=3), tmp_path / "run"
    whole = train(load_train_config(path), tmp_path / "whole", quiet=True)
    line = ["train", str(path), "--out", str(out), "--resume"]
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    assert run(line) == 2
    assert "run: holds other files than a training's (got 'notes.txt'); expected" in capsys.readouterr().err
    assert [p.name for p in out.iterdir() if not p.name.startswith(".")] == ["notes.txt"]
    (out / "notes.txt").unlink()
    # As a kill leaves it: rows of steps that no checkpoint has, weights of a validation, half a checkpoint.
    (out / "config.yaml").write_text("model: {}")
    (out / "log.csv").write_text("step,samples,processor_s,wall_s,loss,epe,lr\n1,2,5.0,6.0,1,1,1\n2,4,")
    (out / "log.jsonl").write_text('{"step": 1, "kind": "train"}\n{"step')
    (out / "best.safetensors").write_bytes(b"")
    (out / "checkpoints/.000000001.blinkgl-tmp-0-1-0").mkdir(parents=True)
    assert run(line) == 0
    assert "no checkpoint in" in capsys.readouterr().err
    assert [r["step"] for r in log(out)] == [1, 2, 3] and not (out / "best.safetensors").exists()
    a, b = (tensors(folder) for folder in (whole.checkpoint.parents[1], out))
    assert a.keys() == b.keys() and all(torch.equal(a[key], b[key]) for key in a)
    assert run([*line, "--set", "optim.steps=2"]) == 2 and "optim.steps: differs" in capsys.readouterr().err
    assert run([*line, "--set", "optim.steps=5"]) == 0
    assert [r["step"] for r in log(out)] == [1, 2, 3, 4, 5]


def test_data_that_moved_are_the_same_data(tmp_path, data, recipe):
    """Folders, validation sets, recipes and initial weights may be anywhere; their content is compared."""
    for name in ("a", "b"):
        shutil.copytree(data, tmp_path / name / "set")
        shutil.copy(recipe, tmp_path / name / "recipe.yaml")
    first = train(load_train_config(config_file(tmp_path, data, steps=1)), tmp_path / "first", quiet=True)
    for name in ("a", "b"):
        shutil.copytree(first.checkpoint, tmp_path / name / "weights")

    def config(place):
        options = [
            f"data.train=[{{path: {place}/set}}]",
            f"data.validate_on=[{{path: {place}/set}}, {{recipe: {place}/recipe.yaml, online: true, workers: 0}}]",
            "data.validate_samples=2",
            f"init_from={place}/weights",
        ]
        return load_train_config(config_file(tmp_path, data, steps=6), options)

    go_on = lambda place, **how: train(config(place), tmp_path / "run", quiet=True, stop_after=1, **how)
    go_on(tmp_path / "a")
    shutil.rmtree(tmp_path / "a")
    assert go_on(tmp_path / "b", resume=True).step == 2
    label = min((tmp_path / "b/set").rglob("forward/*.png"))
    other = read_png(label)
    other[..., :2] += 128  # a pixel further
    weights = tmp_path / "b/weights/weights.safetensors"
    another = yaml.safe_dump({**yaml.safe_load(recipe.read_text()), "seed": 77}).encode()
    changes = {
        "data.train.0.path": (label, cv2.imencode(".png", other[..., ::-1])[1].tobytes()),
        "data.validate_on.1.recipe": (tmp_path / "b/recipe.yaml", another),
        "init_from": (tmp_path / "b/weights/ema.safetensors", weights.read_bytes()),
    }
    for key, (file, content) in changes.items():
        before = file.read_bytes()
        file.write_bytes(content)
        with pytest.raises(
            ConfigError, match=f"^{key}: another content than in the run that is resumed .*the same files"
        ):
            go_on(tmp_path / "b", resume=True)
        file.write_bytes(before)
    shutil.rmtree(tmp_path / "b/weights")  # not needed any more
    assert go_on(tmp_path / "b", resume=True).step == 3


def test_a_full_disk_in_the_middle_of_a_checkpoint(tmp_path, data, capsys, monkeypatch):
    """One line, the checkpoint before is whole, and the same line goes on to the same weights."""
    path = config_file(tmp_path, data, steps=3, run__checkpoint_every=1)
    whole = train(load_train_config(path), tmp_path / "whole", quiet=True)
    written, save = [], ckpt.save_file

    def full(tensors, file, metadata):
        written.append(file)
        if len(written) == 5:  # of three files each: the second of the second checkpoint
            Path(file).write_bytes(b"half")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        save(tensors, file, metadata)

    monkeypatch.setattr(ckpt, "save_file", full)
    line = ["train", str(path), "--out", str(tmp_path / "run"), "--resume", "--quiet"]
    assert run(line) == 2
    error = capsys.readouterr().err
    assert "no space left on the device" in error and error.count("\n") == 1
    assert [p.name for p in (tmp_path / "run/checkpoints").iterdir()] == ["000000001"]
    assert run(line) == 0
    a, b = (tensors(folder) for folder in (whole.checkpoint.parents[1], tmp_path / "run"))
    assert a.keys() == b.keys() and all(torch.equal(a[key], b[key]) for key in a)


INSTANTS = {
    "at once": lambda out: True,
    "before the first checkpoint": lambda out: (out / "log.jsonl").exists(),
    "in the middle of a checkpoint": lambda out: any((out / "checkpoints").glob(".*.blinkgl-tmp-*")),
    "after some": lambda out: (out / "checkpoints/000000004").is_dir(),
}


@pytest.mark.slow
@pytest.mark.parametrize("instant", INSTANTS)
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_stopped_whenever(tmp_path, data, number, instant):
    path = config_file(tmp_path, data, steps=12, run__checkpoint_every=2, run__threads=1)
    whole = train(load_train_config(path), tmp_path / "whole", quiet=True)
    out = tmp_path / "run"
    line = ["train", str(path), "--out", str(out), "--resume", "--quiet"]
    default = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)
    words = [sys.executable, "-P", "-m", "eflow.cli", *line]
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True, preexec_fn=default)  # noqa: PLW1509
    while process.poll() is None and not INSTANTS[instant](out):
        pass
    process.send_signal(number)
    said = process.communicate()[1]
    if process.returncode and number != signal.SIGKILL and instant != "at once":
        assert (process.returncode, said) == (128 + number, "interrupted; --resume continues\n")
    assert run(line) == 0
    a, b = (tensors(folder) for folder in (whole.checkpoint.parents[1], out))
    assert a.keys() == b.keys() and all(torch.equal(a[key], b[key]) for key in a)
