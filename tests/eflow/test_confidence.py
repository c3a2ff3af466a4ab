"""Disagreement of views as a confidence: on answers that are known, whether it ranks errors, what is written."""

import json

import h5py
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from blinkgl.io.flo import read_flo  # noqa: E402
from blinkgl.io.formats import write_events  # noqa: E402
from eflow import checkpoint as ckpt  # noqa: E402
from eflow.cli import run  # noqa: E402
from eflow.confidence import SHARES, area, disagreement, sparsification  # noqa: E402
from eflow.data.window import Window  # noqa: E402
from eflow.infer import StreamWindow  # noqa: E402
from eflow.models import build_model, model_config  # noqa: E402
from eflow.pictures import BAR  # noqa: E402
from flow_data import SPAN, blinkgl_set, moving_events  # noqa: E402

HEIGHT, WIDTH = 24, 40


@pytest.fixture(scope="module")
def network(tmp_path_factory) -> str:
    torch.manual_seed(0)
    model = build_model(model_config({"name": "ev_flownet", "width": 8}))
    path = tmp_path_factory.mktemp("network") / "net.safetensors"
    ckpt.write_tensors(path, model.state_dict(), ckpt.metadata_of(model))
    return str(path)


def pair(x=None, y=None, n: int = 400) -> StreamWindow:
    rng = np.random.default_rng(3)
    windows = []
    for t0 in (0, SPAN):
        xs = np.full(n, x, np.uint16) if x is not None else rng.integers(0, WIDTH, n).astype(np.uint16)
        ys = np.full(n, y, np.uint16) if y is not None else rng.integers(0, HEIGHT, n).astype(np.uint16)
        t = np.sort(rng.integers(t0, t0 + SPAN, n))
        windows.append(Window(xs, ys, t, rng.integers(0, 2, n).astype(np.uint8), t0, t0 + SPAN))
    return StreamWindow(SPAN, *windows)


def towards_the_events(window: StreamWindow):
    """From the middle of the image to the mean of the events: mirrors as the events do."""
    at = np.array([window.new.x.mean() - (WIDTH - 1) / 2, window.new.y.mean() - (HEIGHT - 1) / 2], np.float32)
    return np.broadcast_to(at, (HEIGHT, WIDTH, 2)).copy(), None


def test_an_answer_that_mirrors_and_needs_few_events_is_not_doubted():
    window = pair(x=30, y=4)
    flow, _ = towards_the_events(window)
    assert np.abs(flow).min() > 5 and disagreement(towards_the_events, window, flow).max() < 1e-5
    scattered = pair()
    doubt = disagreement(towards_the_events, scattered, towards_the_events(scattered)[0])
    assert 0.1 < doubt.min() == doubt.max() < 3, "half of the events have another mean"
    assert np.array_equal(doubt, disagreement(towards_the_events, scattered, towards_the_events(scattered)[0]))


def test_it_is_the_root_of_the_mean_square_of_four_distances():
    answer = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    answer[..., 0], answer[:, :10, 1] = 3, 1  # mirrored: u -> -3 in one view, v in the other
    doubt = disagreement(lambda window: (answer, None), pair(), answer)
    left = answer[:, ::-1] * (-1, 1) - answer
    down = answer[::-1] * (1, -1) - answer
    assert np.allclose(doubt, np.sqrt(((left**2).sum(-1) + (down**2).sum(-1)) / 4)) and doubt.dtype == np.float32


def test_views_halve_the_events_between_them():
    seen = []
    window = pair()
    disagreement(
        lambda w: (seen.append(w), (np.zeros((HEIGHT, WIDTH, 2)), None))[1], window, np.zeros((HEIGHT, WIDTH, 2))
    )
    assert np.array_equal(seen[0].new.x, WIDTH - 1 - window.new.x) and np.array_equal(seen[0].new.y, window.new.y)
    assert np.array_equal(seen[1].old.y, HEIGHT - 1 - window.old.y) and len(seen) == 4
    for name in ("old", "new"):
        parts = [getattr(w, name) for w in seen[2:]]
        assert sum(map(len, parts)) == 400 and all(150 < len(p) < 250 for p in parts)
        assert np.array_equal(np.sort(np.concatenate([p.t for p in parts])), getattr(window, name).t)


def test_sparsification_by_hand():
    error, valid = np.array([[4.0, 1.0], [3.0, 99.0]]), np.array([[True, True], [True, False]])
    curves = sparsification(error, np.array([[9.0, 2.0], [1.0, 0.0]]), valid)
    at = lambda name, share: curves[name][np.flatnonzero(np.isclose(SHARES, share))[0]]
    assert at("doubt", 0) == at("best", 0) == at("chance", 0.5) == pytest.approx(8 / 3)
    assert at("doubt", 0.5) == pytest.approx(2) and at("best", 0.5) == pytest.approx(2)  # two pixels are kept
    assert at("doubt", 0.95) == 3 and at("best", 0.95) == 1
    rng = np.random.default_rng(0)
    error, valid = rng.exponential(2, (80, 90)), rng.random((80, 90)) < 0.8
    of = lambda doubt: area(sparsification(error, doubt, valid))
    assert of(error) == pytest.approx(0) and of(np.ones_like(error)) == pytest.approx(1)
    assert of(rng.random(error.shape)) == pytest.approx(1, abs=0.05) and of(-error) > 1.5
    assert 0.1 < of(error + rng.normal(0, 2, error.shape)) < 0.8
    assert sparsification(error, error, np.zeros_like(valid)) is None


def test_predict_writes_it_with_every_file_of_flow(network, tmp_path, capsys):
    write_events(tmp_path / "e.npz", moving_events(64, 80, 0, 3 * SPAN, n=3000), 64, 80)
    words = [
        "predict",
        network,
        str(tmp_path / "e.npz"),
        "--window-ms",
        "90",
        "--out",
        str(tmp_path / "flow"),
    ]
    video = ["--video", str(tmp_path / "flow.mp4")]
    assert run([*words, "--confidence", "--npy", "--flo", "--h5", *video]) == 0, capsys.readouterr().err
    assert "disagreement" in capsys.readouterr().out
    out = tmp_path / "flow"
    with h5py.File(out / "flow.h5") as file:
        assert sorted(file) == ["disagreement", "flow", "from_us", "to_us"] and file["flow"].shape == (2, 64, 80, 2)
        assert np.diff(file["from_us"][:]) == 90_000 and (file["to_us"][:] - file["from_us"][:] == 90_000).all()
        for k in range(2):
            exact = np.load(out / "npy" / f"{k:06d}.npy")
            assert np.array_equal(file["flow"][k], exact)
            assert np.array_equal(read_flo(out / "flo" / f"{k:06d}.flo")[0], exact)
            doubt = np.load(out / "disagreement" / f"{k:06d}.npy")
            assert np.array_equal(file["disagreement"][k], doubt) and doubt.dtype == np.float32 and doubt.max() > 0
    import cv2

    assert cv2.imread(str(out / "pictures" / "000000.png")).shape == (64 + BAR, 3 * 84 - 4, 3)
    frame = cv2.VideoCapture(str(tmp_path / "flow.mp4")).read()[1]
    assert frame.shape[:2] == (2 * (64 + BAR), 2 * (3 * 84 - 4))
    assert run(words) == 2 and run([*words[:-1], str(tmp_path / "plain"), "--h5"]) == 0
    with h5py.File(tmp_path / "plain" / "flow.h5") as file:
        assert "disagreement" not in file
    assert sorted(p.name for p in (tmp_path / "plain").iterdir()) == [
        "000000.png", "000001.png", "flow.h5", "pictures", "timestamps.txt",
    ]  # fmt: skip


def test_nothing_is_left_of_a_prediction_that_fails(network, tmp_path, capsys):
    from blinkgl.types.events import Events

    pieces = [moving_events(64, 80, 0, 2 * SPAN), moving_events(64, 80, 6 * SPAN, 7 * SPAN)]
    write_events(tmp_path / "e.npz", Events.concatenate(pieces), 64, 80)
    words = ["predict", network, str(tmp_path / "e.npz"), "--window-ms", "90", "--h5", "--out"]
    assert run([*words, str(tmp_path / "flow")]) == 2
    assert [p.name for p in tmp_path.iterdir()] == ["e.npz"], capsys.readouterr().err


def test_evaluate_says_whether_it_knows_where_the_errors_are(network, tmp_path, capsys):
    data = blinkgl_set(tmp_path / "data", sequences=1, labels=1)
    words = [
        "evaluate",
        network,
        str(data),
        "--pictures",
        "0",
        "--confidence",
        "--out",
        str(tmp_path / "s"),
    ]
    assert run(words) == 0, capsys.readouterr().err
    assert "of the area of chance" in capsys.readouterr().out
    judged = json.loads((tmp_path / "s" / "results.json").read_text())["confidence"]
    assert set(judged) == {"area", "area_in_a_sample", "left_out", "doubt", "best", "chance"}
    assert len(judged["doubt"]) == len(SHARES) and judged["area"] == pytest.approx(judged["area_in_a_sample"], abs=0.2)
    assert judged["doubt"][0] == pytest.approx(judged["best"][0]) == pytest.approx(judged["chance"][-1])
