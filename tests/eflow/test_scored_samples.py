"""Which samples are trained on and scored: the same for every network, and none that says nothing."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from blinkgl.errors import BlinkGLError, ConfigError, EventDataError  # noqa: E402
from blinkgl.io.flow import write_flow_png  # noqa: E402
from eflow import checkpoint as ckpt  # noqa: E402
from eflow.data.dataset import FlowDataset, Key  # noqa: E402
from eflow.data.sources import open_source  # noqa: E402
from eflow.evaluate import evaluate  # noqa: E402
from eflow.load_config import load_train_config  # noqa: E402
from eflow.models import build_model, model_config  # noqa: E402
from eflow.train import train  # noqa: E402
from flow_data import blinkgl_set  # noqa: E402

ONE = {"name": "ev_flownet", "input": "voxel", "bins": 5, "width": 8}
TWO = {"name": "eraft", "size": "tiny", "iterations": 1}


class Emptied:
    """A source of which some samples have no events in one window."""

    has_backward, name = False, "emptied"

    def __init__(self, source, old=(), new=()):
        self.source, self.empty = source, {"old": old, "new": new}

    def __len__(self):
        return len(self.source)

    def __getitem__(self, index):
        sample = self.source[index]
        nothing = np.zeros(0, bool)
        gone = {k: getattr(sample, k).take(np.flatnonzero(nothing)) for k, at in self.empty.items() if index in at}
        return replace(sample, **gone)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return blinkgl_set(tmp_path_factory.mktemp("scored"), sequences=2, labels=3)


def network(tree):
    torch.manual_seed(0)
    return build_model(model_config(tree)).eval()


def test_networks_are_scored_on_the_same_samples(folder):
    """Zero flow's error is that of the four samples with both windows, whatever a network reads."""
    source = Emptied(open_source(folder), old=[0], new=[4])
    results = [evaluate(network(tree), source) for tree in (ONE, TWO)]
    speeds = [np.hypot(*source[i].flow[source[i].valid].T).mean() for i in (1, 2, 3, 5)]
    for result in results:
        assert (result["samples"], result["left_out"]) == (4, 2)
        scenes = result["methods"]["zero flow"]["scenes"].values()
        assert sum(s["AEE"] * s["frames"] for s in scenes) == pytest.approx(sum(speeds), rel=1e-6)
    with pytest.raises(EventDataError, match="no events in the new window .*use data.empty=skip to leave"):
        FlowDataset([source], network(ONE).representation)[4]


def test_training_takes_the_next_sample_with_events_and_a_valid_pixel(folder):
    class Blind(Emptied):
        def __getitem__(self, index):
            sample = super().__getitem__(index)
            sample.valid[:] = index not in self.blind
            return sample

    blind = Blind(open_source(folder), new=[1])
    blind.blind = [2]
    data = FlowDataset([blind], network(ONE).representation, empty="skip")
    assert data[Key(0, 0, 0, 1)]["name"] == blind[3].name
    blind.blind = range(6)
    with pytest.raises(EventDataError, match="no events, or no valid pixel, in 6 samples up to this one"):
        data[Key(0, 0, 0, 1)]


def config(folder, out, **changes):
    sets = [f"data.{key}=[{{path: {path}}}]" for key, path in {"train": folder, **changes}.items()]
    said = [*sets, "data.batch=4", "optim.steps=4", "optim.lr=1e-3", "run.validate_every=1", "run.log_every=1"]
    return load_train_config(None, said, model=ONE)


@pytest.mark.parametrize("which", ["train", "validate_on"])
def test_data_are_checked_before_the_run_folder_is_made(folder, tmp_path, which):
    shutil.copytree(folder, tmp_path / "blind")
    for path in (tmp_path / "blind").rglob("flow/forward/*.png"):
        write_flow_png(path, np.zeros((128, 144, 2), np.float32), np.zeros((128, 144), bool))
    sets = {"train": tmp_path / "blind"} if which == "train" else {"train": folder, which: tmp_path / "blind"}
    with pytest.raises(BlinkGLError, match="no valid pixel|no sample has events and a valid ground-truth pixel"):
        train(config(sets.pop("train"), tmp_path, **sets), tmp_path / "run", quiet=True)
    assert not (tmp_path / "run").exists()


def test_the_best_weights_are_kept(folder, tmp_path):
    """Of every validation's scores in the log, the file has the lowest, also when a training goes on."""
    said = config(folder, tmp_path, validate_on=folder)
    train(said, tmp_path / "run", quiet=True, stop_after=2)
    train(said, tmp_path / "run", quiet=True, resume=True)
    lines = [json.loads(line) for line in (tmp_path / "run/log.jsonl").read_text().splitlines()]
    name = folder.name
    shares = [one[f"{name}/AEE"] / one[f"{name}/zero"] for one in lines if f"{name}/AEE" in one]
    best = ckpt.read_tensors(tmp_path / "run/best.safetensors")[1]
    assert len(shares) == 4 and float(best["score"]) == pytest.approx(min(shares), rel=1e-6)
    ckpt.load_model(tmp_path / "run/best.safetensors")


def test_a_batch_in_parts_has_the_gradient_of_the_whole(folder, tmp_path):
    """Valid pixels are counted over the whole batch, so parts with few of them do not weigh more."""
    runs = {}
    for parts in (1, 2, 4):
        said = config(folder, tmp_path)
        said = said.model_copy(update={"optim": said.optim.model_copy(update={"accumulate": parts})})
        train(said, tmp_path / str(parts), quiet=True, stop_after=1)
        rows = [json.loads(line) for line in (tmp_path / str(parts) / "log.jsonl").read_text().splitlines()]
        runs[parts] = next((row["loss"], row["epe"], row["grad_norm"]) for row in rows if "grad_norm" in row)
    assert runs[2] == pytest.approx(runs[1], rel=1e-4) and runs[4] == pytest.approx(runs[1], rel=1e-4)
    said = said.model_copy(update={"optim": said.optim.model_copy(update={"accumulate": 3})})
    with pytest.raises(ConfigError, match="data.batch: not a multiple of .*expected a multiple of 3"):
        train(said, tmp_path / "3", quiet=True)


def test_a_script_without_a_guard_is_a_line(folder, tmp_path):
    """Its loader process imports the script, which would train again."""
    script = tmp_path / "script.py"
    script.write_text(
        "from eflow.load_config import load_train_config\nfrom eflow.train import train\n"
        f"c = load_train_config(None, ['data.batch=2', 'data.workers=1', 'optim.steps=2'], model={ONE},\n"
        f"    data=[{str(folder)!r}])\ntrain(c, 'out', quiet=True)\n"
    )
    ended = subprocess.run([sys.executable, str(script)], cwd=tmp_path, capture_output=True, text=True, timeout=600)
    assert ended.returncode == 1 and "if __name__ == '__main__':" in ended.stderr.splitlines()[-1]
    assert ended.stderr.count("Traceback") == 1 and not (tmp_path / "out").exists()
