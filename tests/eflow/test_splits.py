"""What trainings expect: a share held out, frozen statistics, pictures in tensorboard, video with any flow."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from safetensors.torch import load_file  # noqa: E402
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator  # noqa: E402

from blinkgl import cli  # noqa: E402
from blinkgl.errors import AssetError  # noqa: E402
from blinkgl.io.flow import encode_flo  # noqa: E402
from eflow.cli import run  # noqa: E402
from eflow.config import TrainConfig  # noqa: E402
from eflow.data.sources import open_source, parts_of  # noqa: E402
from eflow.models import build_model  # noqa: E402
from eflow.training_data import validate, validation_sets  # noqa: E402
from flow_data import blinkgl_set, mvsec_set  # noqa: E402

FAST = (
    "--set model.width=4 --set data.batch=2 --set data.augment=null --set optim.steps=2 --set run.threads=1 -q".split()
)


def trained(data, out, *options, model="ev_flownet-tiny"):
    """The arguments of a training of two steps."""
    fast = FAST if model.startswith("ev") else FAST[2:]
    return ["train", "--model", model, "--data", str(data), "--out", str(out), *fast, *options]


def names_of(part) -> set[str]:
    return {part[i].name.rpartition("/")[0] for i in range(len(part))}


def test_a_share_is_held_out_by_name(tmp_path):
    """Further sequences move none; together both parts are everything."""
    small, large = (blinkgl_set(tmp_path / f"{n}", n, 1, 32, 32, False, 50) for n in (12, 30))
    before, after = ([names_of(p) for p in parts_of(open_source(d), 0.3, "x")] for d in (small, large))
    for part in range(2):
        assert before[part] and before[part] <= after[part]
    assert not after[0] & after[1] and len(after[0] | after[1]) == 30
    assert 3 <= len(after[1]) <= 15


def test_a_training_validates_on_the_share(tmp_path, capsys):
    data = blinkgl_set(tmp_path / "set", 12, 1, 64, 64, False)
    share = ["--set", "data.validate_on={share: 0.3}", "--set", "run.validate_every=2"]
    assert run(trained(data, tmp_path / "run", *share)) == 0
    rows = [json.loads(line) for line in (tmp_path / "run/log.jsonl").read_text().splitlines()]
    assert rows[-1]["kind"] == "validation" and rows[-1]["set/AEE"] > 0
    assert run([*trained(data, tmp_path / "run", *share, "--resume"), "--set", "optim.steps=3"]) == 0


@pytest.mark.parametrize(
    "options, line",
    [
        (["data.validate_on={share: 0.000001}"], "data.train.0.path: too few sequences for a share (got '1e-06, 2 seq"),
        (
            ["data.validate_on=[{share: 0.3}, {share: 0.2}]"],
            "data.validate_on: a share of what (got [0.3, 0.2]); expec",
        ),
        (["data.train=[{share: 0.3}]"], "data.train.0.share: a share is for validation (got 0.3)"),
        (
            ["data.validate_on={share: 0.3, path: x}"],
            "data.validate_on.0: give a folder (path) or a recipe, or for val",
        ),
        (["optim.freeze_norm=true"], "optim.freeze_norm: this network has no batch norm (got True); expected false"),
    ],
)
def test_what_is_refused(tmp_path, capsys, options, line):
    data = blinkgl_set(tmp_path / "set", 2, 1, 64, 64, False)
    assert run([*trained(data, tmp_path / "run"), *(word for o in options for word in ("--set", o))]) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"error: {line}") and err.count("\n") == 1 and not (tmp_path / "run").exists()


def test_mvsec_is_split_by_recording(tmp_path):
    for name in ("indoor_flying1", "indoor_flying2", "indoor_flying3"):
        mvsec_set(tmp_path, name)
    source = open_source(tmp_path)
    parts = [names_of(part) for part in parts_of(source, 0.6, "x")]
    assert not parts[0] & parts[1] and len(parts[0] | parts[1]) == 3


def test_frozen_batch_norm_keeps_its_statistics(tmp_path):
    data = blinkgl_set(tmp_path / "set", 2, 1, 128, 128, False)
    small = [
        "--set",
        "model.train_iterations=1",
        "--set",
        "optim.ema=0",
        "--set",
        f"data.validate_on=[{{path: {data}}}]",
    ]
    small += ["--set", "run.validate_every=1", "--set", "data.validate_samples=1"]
    moved = {}
    for frozen in ("true", "false"):
        out = tmp_path / frozen
        assert run(trained(data, out, *small, "--set", f"optim.freeze_norm={frozen}", model="eraft-tiny")) == 0
        tensors = load_file(next(out.glob("checkpoints/*/weights.safetensors")))
        means = [v for k, v in tensors.items() if k.endswith("running_mean")]
        moved[frozen] = max(float(v.abs().max()) for v in means)
    assert moved["true"] == 0 < moved["false"]


def test_tensorboard_shows_pictures_and_configuration(tmp_path):
    data = blinkgl_set(tmp_path / "set", 2, 1, 64, 64, False)
    assert run(trained(data, tmp_path / "run", "--set", "run.picture_every=2")) == 0
    board = EventAccumulator(str(tmp_path / "run/tb")).Reload()
    (image,) = board.Images("sample")
    shown = cv2.imdecode(np.frombuffer(image.encoded_image_string, np.uint8), cv2.IMREAD_COLOR)
    assert image.step == 2 and (shown == cv2.imread(str(tmp_path / "run/pictures/000000002.png"))).all()
    text = board.Tensors("configuration/text_summary")[0].tensor_proto.string_val[0].decode()
    assert "name: ev_flownet" in text and "steps: 2" in text
    assert "_hparams_/session_start_info" in board.summary_metadata


def video_set(root: Path, size=(64, 64)) -> Path:
    """A texture that moves by (1, 0) px a frame, through blinkgl simulate, and its flow as .flo over ten frames."""
    rng, (frames, seq) = np.random.default_rng(0), (root / "frames", root / "set/clip")
    frames.mkdir(parents=True)
    texture = cv2.GaussianBlur(rng.integers(0, 255, (64, 128)).astype(np.uint8), (0, 0), 2)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)
    for k in range(31):
        cv2.imwrite(str(frames / f"{k:06d}.png"), texture[:, 40 - k : 104 - k])
    (seq / "flow/forward").mkdir(parents=True)
    events = str(seq / "events.h5")
    assert cli.run(["simulate", str(frames), "--fps", "1000", "--zero-time", "-o", events, "-q"]) == 0
    flow = np.broadcast_to(np.float32([10, 0]), (*size, 2))
    (seq / "flow/forward_timestamps.txt").write_text("# from_us, to_us\n10000, 20000\n20000, 30000\n")
    for k in range(2):
        (seq / f"flow/forward/{k:06d}.flo").write_bytes(encode_flo(flow))
    return root / "set"


def test_events_of_video_with_any_flow(tmp_path):
    data = video_set(tmp_path)
    source = open_source(data)
    assert len(source) == 2
    sample = source[1]
    assert sample.name == "clip/000001" and (sample.new.t0, sample.new.t1) == (20000, 30000)
    assert sample.has_events and (sample.flow == [10, 0]).all() and sample.valid.all()
    assert run(trained(data, tmp_path / "run")) == 0


def test_flow_of_another_size_than_the_video(tmp_path, capsys):
    data = video_set(tmp_path, size=(64, 48))
    assert run(trained(data, tmp_path / "run")) == 2
    line = capsys.readouterr().err
    assert "events.h5: event file, flow and rectification map differ in size (got [(64, 48), (64, 64)])" in line


def test_nan_of_given_flow_is_not_valid(tmp_path):
    data = video_set(tmp_path)
    for path in (data / "clip/flow/forward").iterdir():
        path.unlink()
    flow = np.full((64, 64, 2), 2, np.float32)
    flow[:32] = np.nan
    for k in range(2):
        np.save(data / f"clip/flow/forward/{k:06d}.npy", flow)
    with pytest.raises(AssetError, match=r"000000\.npy: flow is NaN or infinite at pixel \(0, 0\) and marked valid"):
        open_source(data)[0]


def test_validation_sets_of_one_name_have_scores_of_their_own(tmp_path):
    """Folders of one name are called by the one above, too; those listed twice by numbers."""
    places = [blinkgl_set(tmp_path / k, 2, 1, 64, 64, False) / "train" for k in "ab"]
    (tmp_path / "set.v1").symlink_to(places[0])

    def names(train, held) -> list[str]:
        tree = {"model": {"name": "ev_flownet", "width": 4}, "data": {"crop": [64, 64], "train": train}}
        tree["data"]["validate_on"] = held
        config = TrainConfig(**tree)
        model = build_model(config.model)
        sets = validation_sets(config, model)
        scores = validate(model, None, sets, "fp32")
        assert list(scores) == [f"{name}/{kind}" for name, *_ in sets for kind in ("AEE", "zero")]
        return [name for name, *_ in sets]

    a, b, v1 = ({"path": str(p)} for p in (*places, tmp_path / "set.v1"))
    assert names([a], [a]) == ["train"]
    assert names([a], [v1, b, a]) == ["set.v1", "b/train", "a/train"]
    assert names([a], [a, b, a]) == ["a/train#1", "b/train", "a/train#3"]
    assert names([a, b], [{"share": 0.3}]) == ["a/train", "b/train"]
