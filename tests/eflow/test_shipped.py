"""Networks that come with the package: a folder of weights and a card, called by name; packing; what is refused."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

torch = pytest.importorskip("torch")

from shared_data import shared  # noqa: E402

from blinkgl.errors import AssetError, ConfigError, OutputError  # noqa: E402
from blinkgl.io.formats import write_events  # noqa: E402
from blinkgl.recordings.simulation import emulator_config, frames_to_events  # noqa: E402
from blinkgl.tools import real_recordings as rr  # noqa: E402
from blinkgl.types.events import Events  # noqa: E402
from eflow import checkpoint as ckpt, packing, shipped  # noqa: E402
from eflow.cli import run  # noqa: E402
from eflow.data.window import StreamWindow, Window  # noqa: E402
from eflow.infer import Predictor, largest_change  # noqa: E402
from eflow.methods.iwe import flow_warp_loss  # noqa: E402
from eflow.models import build_model, model_config  # noqa: E402
from flow_data import SPAN, blinkgl_set, moving_events  # noqa: E402

CARD = {
    "about": "flow of a texture that a test made up",
    "data": "none",
    "training": "0 s",
    "scores": {"simulated test, AEE of zero flow": 1.02, "real bursts": "never tried"},
    "limits": ["it was not trained", "nor will it be"],
    "commands": ["pytest tests/eflow/test_shipped.py"],
}


def weights(path: Path, scale: float = 1.0, **tree) -> Path:
    torch.manual_seed(0)
    model = build_model(model_config({"name": "ev_flownet", "width": 8, **tree}))
    tensors = {k: v * scale if v.is_floating_point() else v for k, v in model.state_dict().items()}
    ckpt.write_tensors(path, tensors, ckpt.metadata_of(model))
    return path


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    """A network, a card and a run folder whose averaged weights differ from the last ones."""
    root = tmp_path_factory.mktemp("source")
    (root / "card.yaml").write_text(yaml.safe_dump(CARD))
    weights(root / "net.safetensors")
    step = root / "run" / "checkpoints" / "000000010"
    step.mkdir(parents=True)
    weights(step / "weights.safetensors", 0.9)
    weights(step / "ema.safetensors")
    return root


@pytest.fixture
def list_of(monkeypatch, tmp_path):
    """An own folder in the place of the package's."""
    monkeypatch.setattr(shipped, "FOLDER", tmp_path / "weights")
    return tmp_path / "weights"


def packed(source: Path, out: Path, *options: str, name: str = "toy_net") -> int:
    return run(
        ["pack", str(source / "run"), "--name", name, "--card", str(source / "card.yaml"), "-o", str(out), *options]
    )


def test_pack_then_call_by_name(source, list_of, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert packed(source, list_of) == 0, capsys.readouterr().err
    assert sorted(p.name for p in list_of.rglob("*")) == ["card.yaml", "model.safetensors", "toy_net"]
    card = shipped.card_of("toy_net")
    assert (card.network, card.stored, card.rounding_px) == ("ev_flownet", "fp32", 0.0)
    assert card.parameters == sum(p.numel() for p in ckpt.load_model("toy_net").parameters())
    wanted = ckpt.load_model(source / "net.safetensors").state_dict()  # the averaged weights
    assert all(torch.equal(v, wanted[k]) for k, v in ckpt.load_model("toy_net").state_dict().items())

    blinkgl_set(tmp_path / "data", sequences=1, labels=1)
    write_events(tmp_path / "e.npz", moving_events(64, 80, 0, 3 * SPAN), 64, 80)
    for words in (
        ["evaluate", "toy_net", "data"],
        ["predict", "toy_net", "e.npz", "--out", "flow"],
        ["predict", str(list_of / "toy_net"), "e.npz"],  # the folder itself
    ):
        assert run(words) == 0, capsys.readouterr().err
    capsys.readouterr()
    assert run(["models"]) == 0 and run(["models", "toy_net"]) == 0
    text = capsys.readouterr().out
    for said in ("toy_net", "ev_flownet base, 0.2", "zero flow: 1.02", "again     pytest tests", card.sha256):
        assert said in text, text
    assert text.count("nor will it be") == 1, "limits are in the card, not in the list"


def test_an_empty_list_works(list_of, capsys):
    assert run(["models"]) == 0 and "no trained network" in capsys.readouterr().out
    assert run(["models", "toy_net"]) == 2 and "no network comes with this version" in capsys.readouterr().err
    with pytest.raises(AssetError, match="no such checkpoint.*a run folder$"):
        ckpt.load_model("toy_net")


def test_an_unknown_name_lists_the_known(source, list_of, capsys):
    packed(source, list_of)
    with pytest.raises(AssetError, match=r"did you mean toy_net\?.*comes with the package: toy_net"):
        ckpt.load_model("toynet")
    with pytest.raises(ConfigError, match=r"did you mean toy_net\?.*toy_net"):
        shipped.card_of("toy_nett")


def test_weights_that_are_not_the_cards(source, list_of):
    packed(source, list_of)
    path = list_of / "toy_net" / shipped.WEIGHTS
    path.write_bytes(path.read_bytes()[:-4] + b"\0\0\0\1")
    with pytest.raises(AssetError, match="checksum of the weights differs from that of the card"):
        ckpt.load_model("toy_net")
    path.unlink()
    with pytest.raises(AssetError, match=r"model\.safetensors: cannot be read"):
        ckpt.load_model("toy_net")


@pytest.mark.parametrize(
    "name, change, message",
    [
        ("Toy Net", {}, "--name: not a valid name"),
        ("contrast-affine", {}, "--name: not a valid name"),
        ("eraft", {}, "--name: not a valid name"),
        ("toy", {"scores": {}}, "card.yaml.*scores"),
        ("toy", {"commands": None}, "card.yaml.*commands"),
        ("toy", {"sha256": "0" * 64}, "card.yaml.*sha256.*unknown key"),
    ],
)
def test_what_cannot_be_packed(source, tmp_path, name, change, message):
    card = tmp_path / "card.yaml"
    card.write_text(yaml.safe_dump({**CARD, **change}))
    with pytest.raises(ConfigError, match=message):
        packing.pack(source / "run", name, card, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_too_large(source, tmp_path):
    with pytest.raises(AssetError, match=r"too large to come with the package .*7\.\d MB in float16.*at most 5 MB$"):
        packing.pack(weights(tmp_path / "l.safetensors", width=32), "l", source / "card.yaml", tmp_path / "out")
    packing.pack(source / "run", "twice", source / "card.yaml", tmp_path / "ok")
    with pytest.raises(OutputError, match="exists"):
        packing.pack(source / "run", "twice", source / "card.yaml", tmp_path / "ok")
    assert not (tmp_path / "out").exists() and [p.name for p in (tmp_path / "ok").iterdir()] == ["twice"]


def test_large_weights_are_rounded(source, tmp_path):
    """Above 5 MB weights are stored in half precision, and the card says what that changes."""
    wide = weights(tmp_path / "wide.safetensors", width=24)
    folder, card = packing.pack(wide, "wide", source / "card.yaml", tmp_path / "out")
    assert card.stored == "fp16" and card.bytes <= shipped.LARGEST < 4 * card.parameters
    stored, exact = ckpt.load_model(folder), ckpt.load_model(wide)
    for (name, mine), its in zip(stored.state_dict().items(), exact.state_dict().values(), strict=True):
        assert mine.dtype == torch.float32 and torch.equal(mine, its.half().float()), name
    assert 0 < card.rounding_px == largest_change(exact, stored)


@pytest.mark.parametrize("name", shipped.names())
def test_what_ships_is_whole(name):
    card, model = shipped.card_of(name), ckpt.load_model(name)
    assert card.name == name and card.bytes <= shipped.LARGEST
    assert card.bytes == (shipped.FOLDER / name / shipped.WEIGHTS).stat().st_size
    assert card.parameters == sum(p.numel() for p in model.parameters()) and card.network == model.config.name


@pytest.mark.parametrize("name", shipped.names())
def test_what_ships_sees_what_a_camera_saw(name):
    """A pan over an office: the network's flow is the way, and nearly as long, as the translation that makes the events
    sharpest, and sharpens them, too. A network that expects bodies with their own motions has more doubt."""
    least = {"real_small": 0.95, "real_bodies": 0.93}[name]
    pytest.importorskip("scipy")
    path = shared("data/events/evbench_davis240/seq_0001_e.mat")
    events, height, width = rr.looked_at(path)
    pair = rr.cut(events, int(events.t[len(events) // 2]), 100_000)
    flow = rr.answer_of(f"{name}+refined", height, width)(pair)  # as eflow predict gives it
    found = rr.answer_of("contrast-translation", height, width)(pair)
    mine = flow[pair.new.y, pair.new.x].astype(float)
    size = np.hypot(*mine.T)
    assert (mine @ found[0, 0] / np.maximum(size * np.hypot(*found[0, 0]), 1e-9)).mean() > least
    assert 0.75 < size.mean() / np.hypot(*found[0, 0]) < 1.3
    assert flow_warp_loss(pair.new, flow) > 1.0


def burst(name: str):
    """Events, flow, the pixels to judge at, and the times of a burst with known flow."""
    folder = shared(f"data/events/ecd_rotation/{name}")
    events, height, width = rr.read(folder / "events.txt")
    truth = rr.Burst.read(folder).truth
    hit = np.zeros((height, width), bool)
    hit[events.y, events.x] = True
    return events, truth, hit & np.isfinite(truth).all(-1), (int(events.t[0]), int(events.t[-1]) + 1)


def as_one(events: Events, t0: int, t1: int) -> StreamWindow:
    nothing = (getattr(events, k)[:0] for k in "xytp")
    return StreamWindow(t0, Window(*nothing, 2 * t0 - t1, t0), Window(events.x, events.y, events.t, events.p, t0, t1))


@pytest.mark.parametrize("name", ["boxes_rotation", "shapes_rotation"])
@pytest.mark.parametrize("size", [(294, 220), (394, 296), (640, 480)])
def test_real_small_in_a_larger_sensor(name, size):
    """A burst in the middle of a sensor that is silent elsewhere is as right as by itself, but for 1.3 times."""
    events, truth, judged, (t0, t1) = burst(name)
    (height, width), (wide, high) = truth.shape[:2], size
    left, top = (wide - width) // 2, (high - height) // 2
    inside = Events(events.x + np.uint16(left), events.y + np.uint16(top), events.t, events.p)
    error = lambda flow: np.hypot(*(flow[judged] - truth[judged]).T).mean()
    network = ckpt.load_model("real_small")
    own = Predictor(network, height, width, refine=True)(as_one(events, t0, t1))[0]
    flow = Predictor(network, high, wide, refine=True)(as_one(inside, t0, t1))[0]
    flow = flow[top : top + height, left : left + width]
    assert error(flow) < 1.3 * error(own)


@pytest.mark.parametrize("name", ["boxes_rotation", "shapes_rotation"])
def test_sharpening_of_sparse_events_does_no_harm(name):
    """Of 10 and 5 % of the events: with it as right as without, but for a twentieth (three draws)."""
    events, truth, judged, (t0, t1) = burst(name)
    error = lambda flow: np.hypot(*(flow[judged] - truth[judged]).T).mean()
    network = ckpt.load_model("real_small")
    answers = [Predictor(network, *truth.shape[:2], refine=refine) for refine in (True, False)]
    for share in (0.1, 0.05):
        errors = []
        for draw in range(3):
            window = as_one(events.part(np.random.default_rng(draw).random(len(events)) < share), t0, t1)
            errors.append([error(answer(window)[0]) for answer in answers])
        with_it, without = np.mean(errors, axis=0)
        assert with_it < 1.05 * without


@pytest.mark.parametrize("name", ["boxes_rotation", "shapes_rotation"])
def test_the_mean_over_views_is_nearer_the_truth(name):
    """By a seventh at least, of a burst's second half; a network's own flow, not refined."""
    events, truth, judged, (t0, t1) = burst(name)
    middle, network = (t0 + t1) // 2, ckpt.load_model("real_bodies")
    pair, whole = rr.cut(events, middle, t1 - middle), (t1 - t0) / (t1 - middle)
    flows = [Predictor(network, *truth.shape[:2], views=views)(pair)[0] * whole for views in (1, 4, 8)]
    one, four, eight = (np.hypot(*(flow[judged] - truth[judged]).T).mean() for flow in flows)
    assert max(four, eight) < 0.86 * one


def test_real_bodies_sees_two_motions():
    """The middle half of an image moves to the right, its sides to the left, which no affine field can say: the network
    leaves less than a third of the best one's error, and half of what the network for moving cameras leaves."""
    image = np.random.default_rng(3).random((160, 160)).astype(np.float32)
    image = cv2.GaussianBlur(image, (0, 0), 2.0)
    image = (image - image.min()) / np.ptp(image) * 0.9 + 0.05
    moved = lambda x: cv2.warpAffine(image, np.float32([[1, 0, x - 16], [0, 1, -16]]), (128, 128))
    from_middle = np.abs(np.arange(128) - 63.5)
    frames = [np.where(from_middle < 32, moved(0.5 * k), moved(-0.5 * k)) for k in range(21)]
    esim = emulator_config({"emulator": "esim", "contrast_threshold": 0.2})
    events = Events.concatenate([*frames_to_events(frames, fps=500.0, emulator=esim, gamma="linear")])
    pair = rr.cut(events, 20_000, 20_000)  # ten frames of half a pixel each
    truth = np.zeros((128, 128, 2))
    truth[..., 0] = np.where(from_middle < 32, 5.0, -5.0)
    inside = np.abs(from_middle - 32) > 8  # what appears at the border of two motions belongs to neither
    error = lambda field: np.hypot(*(field - truth)[:, inside].reshape(-1, 2).T).mean()
    bodies, cameras = (error(rr.answer_of(name, 128, 128)(pair)) for name in ("real_bodies", "real_small"))
    assert bodies < error(rr.best_of(truth, np.ones((128, 128), bool))["best affine"]) / 3
    assert bodies < 0.6 * cameras
