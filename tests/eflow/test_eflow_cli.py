"""``eflow evaluate``, ``predict``, ``submit`` from the command line, on tiny
files, with an untrained network."""

import json
import re
import zipfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from shared_data import shared  # noqa: E402

import eflow  # noqa: E402
from blinkgl.io.dsec import DsecEventWriter  # noqa: E402
from blinkgl.io.flow import read_flow_png  # noqa: E402
from blinkgl.io.formats import write_events  # noqa: E402
from blinkgl.types.events import Events  # noqa: E402
from eflow import checkpoint as ckpt, infer, submit  # noqa: E402
from eflow.choice import chosen  # noqa: E402
from eflow.cli import run  # noqa: E402
from eflow.cli_arguments import WindowsAsked  # noqa: E402
from eflow.data.window import StreamWindow  # noqa: E402
from eflow.metrics import frame_metrics  # noqa: E402
from eflow.models import build_model, model_config  # noqa: E402
from eflow.writers import BAR, Answer, flow_video  # noqa: E402
from flow_data import SPAN, blinkflow_set, blinkgl_set, dsec_set, moving_events, mvsec_set  # noqa: E402


def weights(folder: Path, **tree) -> Path:
    torch.manual_seed(0)
    model = build_model(model_config(tree))
    path = folder / f"{tree['name']}.safetensors"
    ckpt.write_tensors(path, model.state_dict(), ckpt.metadata_of(model))
    return path


@pytest.fixture(scope="module")
def network(tmp_path_factory) -> str:
    return str(weights(tmp_path_factory.mktemp("weights"), name="ev_flownet", width=8))


@pytest.fixture(scope="module")
def refined(tmp_path_factory) -> str:
    return str(weights(tmp_path_factory.mktemp("refined"), name="eflowformer", layers=1, iterations=2))


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return blinkgl_set(tmp_path_factory.mktemp("set"))


def test_evaluate_writes_table_json_and_pictures(network, data, tmp_path, capsys):
    out = tmp_path / "scores"
    assert run(["evaluate", network, str(data), "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "network" in text and "zero flow" in text and "median of" in text and "AEE px" in text
    result = json.loads((out / "results.json").read_text())
    zero = result["methods"]["zero flow"]
    # two sequences of constant flow (4, -2) and (5, -2): zero flow errs by their lengths, the frame's median not at all
    lengths = [np.hypot(4, 2), np.hypot(5, 2)]
    assert [s["AEE"] for s in zero["scenes"].values()] == pytest.approx(lengths, abs=0.01)
    assert zero["total"]["AEE"] == pytest.approx(np.mean(lengths), abs=0.01) and zero["total"]["frames"] == 6
    assert result["methods"]["median of the frame"]["total"]["AEE"] < 1e-6
    assert 0.2 < result["methods"]["median of the set"]["total"]["AEE"] < 1
    assert 0 < result["methods"]["network"]["total"]["AEE"] < 20 and result["samples"] == 6
    pictures = sorted((out / "pictures").glob("*.png"))
    assert len(pictures) == 6 and cv2.imread(str(pictures[0])).shape == (128 + BAR, 4 * 144 + 12, 3)
    assert run(["evaluate", network, str(data), "--out", str(out)]) == 2  # nothing is overwritten
    assert "output folder exists" in capsys.readouterr().err


@pytest.mark.parametrize("make", [dsec_set, blinkflow_set, mvsec_set], ids=["dsec", "blinkflow", "mvsec"])
def test_evaluate_other_data_sets(network, make, tmp_path, capsys):
    assert run(["evaluate", network, str(make(tmp_path)), "--limit", "1"]) == 0
    assert "1 samples" in capsys.readouterr().out


def test_a_video_of_the_flow(network, tmp_path, capsys):
    write_events(tmp_path / "e.h5", moving_events(130, 145, 0, 4 * SPAN, n=8000), 130, 145)
    video = tmp_path / "flow.mp4"
    assert run(["predict", network, str(tmp_path / "e.h5"), "--window-ms", "70", "--video", str(video)]) == 0
    assert f"written: {video}" in capsys.readouterr().out
    shown = cv2.VideoCapture(str(video))
    frames = [frame for ok, frame in iter(shown.read, (False, None)) if ok]
    assert len(frames) == 5 and frames[0].shape[:2] == (2 * (130 + BAR), 2 * (2 * 145 + 4))
    assert run(["predict", network, str(tmp_path / "e.h5"), "--video", str(video)]) == 2
    assert "output file exists" in capsys.readouterr().err
    with pytest.raises(ZeroDivisionError), flow_video(tmp_path / "half.mp4", 130, 145, 10) as half:
        window = StreamWindow.of(Events.empty(), 0, 10, 20)
        half.add(Answer(window, np.ones((130, 145, 2), np.float32), np.zeros((2, 130, 145), np.float32)))
        1 / 0  # noqa: B018
    assert sorted(p.name for p in tmp_path.iterdir()) == ["e.h5", "flow.mp4"]


def test_a_window_as_long_as_things_need_to_move_by_five_pixels(tmp_path, capsys):
    """Points at a known velocity, found again by contrast."""
    speed = 800.0
    span = round(1e6 * 5 / speed)
    events = moving_events(64, 72, 0, 4 * span, (speed * 0.8, -speed * 0.6), n=2000)
    write_events(tmp_path / "e.h5", events, 64, 72)
    command = ["predict", "contrast-translation", str(tmp_path / "e.h5"), "--window-ms", "auto"]
    assert run(command) == 0
    found = float(re.search(r"windows of (\S+) ms", capsys.readouterr().out).group(1))
    assert 0.7 * span < 1000 * found < 1.4 * span
    assert run([*command[:-1], "soon"]) == 2
    assert "--window-ms: not a window length (got 'soon'); expected milliseconds, or auto" in capsys.readouterr().err


def test_windows_do_not_outgrow_a_network(tmp_path):
    """A network whose flow stays below 3 px however long the window is: not the longest window, but the last one with
    which its flow grew."""
    events = moving_events(64, 72, 0, 900_000, (0, 0), n=9000)
    write_events(tmp_path / "e.h5", events, 64, 72)
    file = infer.open_sized(tmp_path / "e.h5")
    says = lambda most: lambda w: (np.full((64, 72, 2), [min(4e-5 * (w.new.t1 - w.new.t0), most), 0]), None)
    assert infer.likely_span(file, says(3.0), ("new",))[0] == 75_000  # 1.2 px in 30 ms, 3 px in 75 ms, and in more
    assert infer.likely_span(file, says(9.0), ("new",))[0] == pytest.approx(125_000, rel=0.01)


def test_windows_of_a_recording_that_hardly_moves_are_as_long_as_it_allows(network, tmp_path, capsys):
    """All of it for a network that reads one window, half of it for a pair; and a line says so."""
    events = moving_events(130, 145, 0, 90_000, (0, 0), n=4000)
    write_events(tmp_path / "e.h5", events, 130, 145)
    file = infer.open_sized(tmp_path / "e.h5")
    still = lambda window: (np.zeros((130, 145, 2)), None)
    length = int(events.t[-1]) + 1 - int(events.t[0])
    assert infer.likely_span(file, still, ("new",)) == (length, length)
    assert infer.likely_span(file, still) == (length // 2, length // 2)
    one, two = (list(infer.windows(file, 30_000, reads=reads)) for reads in (("new",), ("old", "new")))
    assert one[0].t_us == int(events.t[0]) and [w.t_us for w in one[1:]] == [w.t_us for w in two]
    command = ["predict", "contrast-translation", str(tmp_path / "e.h5"), "--window-ms", "auto"]
    assert run(command) == 0
    assert "the longest window of this recording: motion in it is below 5 px" in capsys.readouterr().out
    assert run(["predict", network, str(tmp_path / "e.h5"), "--whole", "--no-refine"]) == 0


def test_another_motion_by_contrast_maximisation_is_said(monkeypatch, tmp_path, capsys):
    speed = 800.0
    write_events(tmp_path / "e.h5", moving_events(64, 72, 0, 25_000, (speed, 0), n=4000), 64, 72)
    wrong = lambda self, window: (np.full((64, 72, 2), (-5.0, 3.0), np.float32), np.zeros((2, 64, 72), np.float32))
    monkeypatch.setattr(infer.Predictor, "__call__", wrong)
    assert run(["predict", "contrast-translation", str(tmp_path / "e.h5"), "--window-ms", "auto"]) == 0
    out = capsys.readouterr().out
    assert "makes the events in the middle no sharper" in out
    assert re.search(r"contrast maximisation finds a motion of \(\d.* this flow \(-5.0, 3.0\)", out)


def test_from_eflow_import_load_model(network):
    assert eflow.load_model(network).config.name == "ev_flownet" and eflow.Predictor.__name__ == "Predictor"
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        eflow.nothing  # noqa: B018


def test_warm_start_runs(refined, tmp_path, capsys):
    write_events(tmp_path / "e.h5", moving_events(128, 144, 0, 3 * SPAN, n=9000), 128, 144)
    outputs = []
    for flag in ([], ["--warm-start"]):
        assert run(["predict", refined, str(tmp_path / "e.h5"), "--window-ms", "70", *flag]) == 0
        outputs.append(capsys.readouterr().out.splitlines())
    assert outputs[0][0] == outputs[1][0] and outputs[0][1:] != outputs[1][1:]


def test_scoring_starts_warm_where_samples_follow(refined, network, tmp_path, capsys):
    """Windows of 100 ms, one behind the other: in each sequence all but the first, and another result."""
    data, results = str(blinkgl_set(tmp_path / "data", sequences=2, labels=3)), []
    for flag in ([], ["--warm-start"]):
        out = tmp_path / f"scores{len(flag)}"
        assert run(["evaluate", refined, data, "--out", str(out), *flag]) == 0
        results.append(json.loads((out / "results.json").read_text()))
    assert "warm" not in results[0] and results[1]["warm"] == 4
    assert "4 samples follow the one before" in capsys.readouterr().out
    assert results[0]["methods"]["network"] != results[1]["methods"]["network"]
    assert run(["evaluate", network, data, "--warm-start"]) == 2
    assert "--warm-start: this network has no iterations (got 'ev_flownet')" in capsys.readouterr().err


def test_views_in_scores_and_submissions(network, data, tmp_path, monkeypatch, capsys):
    """One view unless more are asked for."""
    score = lambda name: json.loads((tmp_path / name / "results.json").read_text())["methods"]["network"]
    for name, options in (("none", []), ("1", ["--views", "1"]), ("4", ["--views", "4"])):
        assert run(["evaluate", network, str(data), "--out", str(tmp_path / name), *options]) == 0
    assert score("none") == score("1") != score("4")
    monkeypatch.setitem(submit.BENCHMARKS, "dsec", replace(submit.BENCHMARKS["dsec"], sequences=("thun_01_a",)))
    root, flows = dsec_set(tmp_path / "test", ("thun_01_a",), labels=1, test=True), []
    for views in ("1", "4"):
        out = tmp_path / f"{views}.zip"
        assert run(["submit", network, str(root), "--out", str(out), "--views", views]) == 0
        with zipfile.ZipFile(out) as archive:
            flows.append(archive.read("thun_01_a/000002.png"))
    assert flows[0] != flows[1]
    for command in (
        ["evaluate", network, str(data)],
        ["submit", network, str(root), "--out", str(tmp_path / "no.zip")],
    ):
        assert run([*command, "--views", "2"]) == 2
        assert "--views: unknown choice (got '2'); expected 1, 4, 8" in capsys.readouterr().err
    assert not (tmp_path / "no.zip").exists()


@pytest.mark.parametrize("text", ["5", "9-3", "a-b", "1-2-3", "-1-4"])
def test_ranges_of_frames(network, tmp_path, text, capsys):
    assert run(["evaluate", network, str(tmp_path), f"--frames={text}"]) == 2
    assert f"--frames: not a range of frames (got '{text}'); expected FIRST-LAST" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("start_us", "arguments", "line"),
    [
        (0, ["FILE", "--window-ms", "90"], "network: real_bodies"),
        (0, ["auto", "FILE", "--window-ms", "auto"], "network: real_bodies"),
        (0, ["FILE", "--whole"], "network: real_bodies"),
        (
            100_000,
            ["FILE", "--window-ms", "90"],
            "network: real_small, since there is no pair of windows with events (real_bodies needs two)",
        ),
    ],
)
def test_the_network_of_two_windows_is_taken_where_there_are_two(start_us, arguments, line, tmp_path, capsys):
    """The last file's events fill one window, which has none before it."""
    file = str(tmp_path / "e.h5")
    write_events(file, moving_events(128, 128, start_us, 2 * SPAN, velocity=(60.0, 10.0), n=30_000), 128, 128)
    assert run(["predict", *(file if word == "FILE" else word for word in arguments)]) == 0
    assert capsys.readouterr().out.splitlines()[0] == line


def test_the_choice_reads_short_windows_of_a_long_recording(tmp_path, monkeypatch):
    """Where the length of windows is still to be found."""
    write_events(tmp_path / "e.h5", moving_events(128, 128, 0, 4 * SPAN, n=30_000), 128, 128)
    read, windows = [], infer.windows
    monkeypatch.setattr(
        infer, "windows", lambda file, span_us, **more: read.append(span_us) or windows(file, span_us, **more)
    )
    with infer.open_sized(tmp_path / "e.h5") as file:
        assert chosen(file, WindowsAsked(window_ms="auto")) == ("real_bodies", "real_bodies")
    assert set(read) == {30_000}


def test_flow_without_events_nearby_is_written_as_not_valid(network, tmp_path):
    events = moving_events(128, 144, 0, 3 * SPAN, n=9000)
    write_events(tmp_path / "e.h5", events.part(events.x < 60), 128, 144)
    out = tmp_path / "flow"
    assert run(["predict", network, str(tmp_path / "e.h5"), "--out", str(out), "--npy", "--at-events"]) == 0
    _, valid = read_flow_png(out / "000000.png")
    assert valid[:, :60].mean() > 0.5 and not valid[:, 63:].any()
    assert (np.isfinite(np.load(out / "npy/000000.npy")).all(-1) == valid).all()


@pytest.mark.parametrize(("burst", "limit"), [("boxes_rotation", 0.15), ("shapes_rotation", 0.1)])
def test_a_rotating_camera_by_contrast(burst, limit, tmp_path):
    """On recordings, without a network: what trained ones have to come near."""
    folder, out = shared(f"data/events/ecd_rotation/{burst}"), tmp_path / "flow"
    focal = (folder / "calib.txt").read_text().split()[0]
    command = ["predict", "contrast-rotation", str(folder / "events.txt"), "--size", "240x180", "--whole"]
    assert run([*command, "--focal", focal, "--out", str(out), "--npy"]) == 0
    truth = np.moveaxis(np.load(folder / "flow.npy")[0], 0, -1)
    scores = frame_metrics(np.load(out / "npy/000000.npy"), truth, np.isfinite(truth).all(-1))
    known = truth[np.isfinite(truth).all(-1)]
    assert scores["AEE"] < limit * np.hypot(*known.T).mean() and scores["cosine"] > 0.99


def test_methods_stand_where_a_checkpoint_does(data, tmp_path, capsys):
    out = tmp_path / "scores"
    assert run(["evaluate", "contrast-translation", str(data), "--out", str(out), "--limit", "2"]) == 0
    text = capsys.readouterr().out
    assert "contrast-translation: 2 samples" in text and "affine of" in text
    result = json.loads((out / "results.json").read_text())
    assert result["model"] == {"name": "contrast-translation"} and result["parameters"] == 0
    assert result["methods"]["network"]["total"]["AEE"] < 0.5, "points carried along at one velocity"
    assert result["methods"]["affine of the frame"]["total"]["AEE"] < 1e-5
    assert len(list((out / "pictures").glob("*.png"))) == 2
    write_events(tmp_path / "e.h5", moving_events(128, 144, 0, 3 * SPAN), 128, 144)
    assert run(["predict", "contrast-affine", str(tmp_path / "e.h5"), "--out", str(tmp_path / "flow"), "--npy"]) == 0
    assert "FWL" in capsys.readouterr().out
    assert np.load(tmp_path / "flow/npy/000000.npy").shape == (128, 144, 2)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (
            ["contrast-rotation", "E"],
            "error: --focal: a rotation's flow depends on the lens; expected its focal length",
        ),
        (
            ["contrast-affine", "E", "--iterations", "3"],
            "error: --iterations: contrast-affine is not a network (got 3)",
        ),
        (["contrast-affine", "E", "--warm-start"], "error: --warm-start: contrast-affine is not a network (got True)"),
        (["contrast-affine", "E", "--views", "4"], "error: --views: contrast-affine is not a network (got 4)"),
        (["contrast-affine", "E", "--refine"], "error: --refine: contrast-affine is not a network (got True)"),
        (["NETWORK", "E", "--views", "3"], "error: --views: unknown choice (got '3'); expected 1, 4, 8"),
        (["NETWORK", "E", "--focal", "200"], "error: --focal: only a rotation uses it (got 200.0); expected contrast-"),
        (
            ["contrast-affine", "E", "--focal", "200"],
            "error: --focal: only a rotation uses it (got 200.0); expected con",
        ),
        (
            ["NETWORK", "E", "--whole"],
            "error: --end-ms: the whole file has no limits (got 200.0); expected --window-ms",
        ),
        (["NETWORK", "E", "--npy"], "error: --npy: no folder to write to; expected --out FOLDER"),
        (["NETWORK", "E", "--at-events"], "error: --at-events: no folder to write to; expected --out FOLDER"),
        (["NETWORK", "E", "--at", ".5"], "error: --at: nothing is written (got '.5'); expected --out or --video"),
    ],
)
def test_methods_refuse_what_they_cannot(network, arguments, says, tmp_path, capsys):
    write_events(tmp_path / "e.h5", moving_events(128, 144, 0, 3 * SPAN), 128, 144)
    files = {"E": str(tmp_path / "e.h5"), "NETWORK": network}
    assert run(["predict", *(files.get(a, a) for a in arguments), "--window-ms", "80", "--end-ms", "200"]) == 2
    assert says in " ".join(capsys.readouterr().err.split())


def test_submit_dsec(network, tmp_path, monkeypatch, capsys):
    names = ("thun_01_a", "thun_01_b")
    monkeypatch.setitem(submit.BENCHMARKS, "dsec", replace(submit.BENCHMARKS["dsec"], sequences=names))
    root, out = dsec_set(tmp_path / "test", names, labels=1, test=True), tmp_path / "sub.zip"
    assert run(["submit", network, str(root), "--out", str(out)]) == 0, capsys.readouterr().err
    assert capsys.readouterr().out == f"written and checked: {out}, 2 files\n"
    with zipfile.ZipFile(out) as archive:
        assert sorted(archive.namelist()) == [f"{n}/{i:06d}.png" for n in names for i in (2,)]
        image = cv2.imdecode(np.frombuffer(archive.read(f"{names[0]}/000002.png"), np.uint8), cv2.IMREAD_UNCHANGED)
    assert image.dtype == np.uint16 and image.shape == (480, 640, 3) and not image[..., 0].any()
    flow = (image[..., :0:-1].astype(float) - 2**15) / 128
    assert 0 < np.abs(flow).max() < 256
    assert run(["submit", network, str(root), "--out", str(out)]) == 2  # not overwritten
    offset = 49_000_000_000
    with DsecEventWriter(root / names[1] / "events/left/events.h5", 480, 640, offset) as writer:
        writer.append(moving_events(480, 640, offset, offset + SPAN, n=100))  # and none in the new window
    assert run(["submit", network, str(root), "--out", str(tmp_path / "silent.zip")]) == 0
    assert "1 of 2 flows are zero: a window without events, or nothing moves\n" in capsys.readouterr().out


def test_submit_refuses_an_incomplete_test_set(network, tmp_path, capsys):
    root = dsec_set(tmp_path / "test", ("thun_01_a",), test=True)
    assert run(["submit", network, str(root), "--out", str(tmp_path / "sub.zip")]) == 2
    assert "missing interlaken_00_b" in capsys.readouterr().err and not (tmp_path / "sub.zip").exists()
    assert run(["submit", network, str(blinkgl_set(tmp_path / "b", 1, 1)), "--out", str(tmp_path / "sub.zip")]) == 2
    assert "not a benchmark's test set (got 'blinkgl'); expected dsec, blinkflow" in capsys.readouterr().err


def test_submission_check_finds_what_is_wrong(tmp_path):
    from blinkgl.errors import OutputError

    good = submit._dsec_png(np.zeros((4, 6, 2), np.float32), "x")
    bad = cv2.imencode(".png", np.zeros((4, 6, 3), np.uint8))[1].tobytes()

    def zipped(**files) -> Path:
        with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
            for name, content in files.items():
                archive.writestr(f"{name}.png", content)
        return tmp_path / "a.zip"

    dsec, sizes = submit.BENCHMARKS["dsec"], {"a.png": (4, 6), "b.png": (4, 6)}
    submit.check_archive(zipped(a=good, b=good), dsec, sizes)
    for path, message in (
        (lambda: zipped(a=good), "does not match the test set"),
        (lambda: zipped(a=good, b=bad), "wrong image"),
        (lambda: zipped(a=good, b=b"junk"), "wrong image"),
    ):
        with pytest.raises(OutputError, match=message):
            submit.check_archive(path(), dsec, sizes)
    with pytest.raises(OutputError, match="cannot hold"):
        submit._dsec_png(np.full((4, 6, 2), np.nan, np.float32), "x")


def test_submit_blinkflow(network, tmp_path):
    root, out = blinkflow_set(tmp_path / "set", labels=2), tmp_path / "sub.zip"
    assert run(["submit", network, str(root), "--out", str(out)]) == 0
    with zipfile.ZipFile(out) as archive:
        assert sorted(archive.namelist()) == ["scene_a/seq_0/100_200.flo"]
        data = archive.read("scene_a/seq_0/100_200.flo")
    assert int.from_bytes(data[:4], "little") == 2502002 and len(data) == 12 + 8 * 120 * 160
    assert submit.decode(data).shape == (19200, 2)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["SET", "--refine"], "--refine: contrast-affine is not a network (got True)"),
        (["SET", "--dt", "4"], "dt: only for MVSEC (got 4); expected a data set in the layout of MVSEC"),
        (["r.yaml", "--dt", "4"], "dt: only for MVSEC (got 4)"),
        (["r.yaml", "--protocol", "e-raft"], "protocol: only for MVSEC (got 'e-raft')"),
        (["r.yaml", "--frames", "1-2"], "frames: only for MVSEC (got '1-2')"),
        (["r.yaml", "--dense"], "dense: only for MVSEC (got True)"),
    ],
)
def test_scoring_refuses_options_that_it_would_not_use(data, words, says, capsys):
    assert run(["evaluate", "contrast-affine", *(str(data) if word == "SET" else word for word in words)]) == 2
    assert capsys.readouterr().err.startswith(f"error: {says}")


def test_one_flow_of_a_whole_file_has_the_times_of_all_of_it(refined, monkeypatch, tmp_path, capsys):
    """A network of two windows says the motion of the second half, here 1.5 px, which is short for it."""
    events = moving_events(128, 144, 0, 2 * SPAN)
    write_events(tmp_path / "e.h5", events, 128, 144)
    half = lambda self, window: (np.full((128, 144, 2), (1.5, 0), np.float32), np.zeros((2, 128, 144), np.float32))
    monkeypatch.setattr(infer.Predictor, "__call__", half)
    out = tmp_path / "flow"
    assert run(["predict", refined, str(tmp_path / "e.h5"), "--whole", "--at", ".5,1", "--out", str(out), "--npy"]) == 0
    first, last = int(events.t[0]), int(events.t[-1])
    ends = [first + round((last + 1 - first) / 2), last + 1]
    assert (out / "timestamps.txt").read_text().splitlines()[1:] == [f"{first}, {end}" for end in ends]
    assert [np.load(out / f"npy/00000{k}.npy")[9, 9, 0] for k in (0, 1)] == pytest.approx([1.5, 3], rel=1e-4)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"t {first} us") and "  1 of 1 flows are below 2 px" in lines[1]


def test_flow_beyond_dsecs_range_is_counted(network, monkeypatch, tmp_path, capsys):
    flow = np.zeros((64, 72, 2), np.float32)
    flow[3, :5], flow[4, :2] = (256, 0), (0, -256)  # -256 is the last that the PNG holds
    monkeypatch.setattr(infer.Predictor, "__call__", lambda *_: (flow, np.zeros((2, 64, 72), np.float32)))
    write_events(tmp_path / "e.h5", moving_events(64, 72, 0, 3 * SPAN), 64, 72)
    command = ["predict", network, str(tmp_path / "e.h5"), "--window-ms", "140", "--out", str(tmp_path / "flow")]
    assert run(command) == 0
    assert "  10 flows beyond ±256 px are not valid in the PNGs" in capsys.readouterr().out, "five in two windows"


def test_a_silent_window(network, tmp_path, capsys):
    events = moving_events(64, 64, 0, SPAN)
    late = moving_events(64, 64, 3 * SPAN, 4 * SPAN)
    write_events(tmp_path / "e.npz", Events.concatenate([events, late]), 64, 64)
    assert run(["predict", network, str(tmp_path / "e.npz")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert ["mean speed 0.000 px" in line for line in lines if line.startswith("t ")] == [False, True, True]
    assert "  2 of 3 flows are zero: too few events, or nothing moves" in lines
    few = tmp_path / "few.h5"
    write_events(few, moving_events(128, 144, 0, 3 * SPAN, n=12), 128, 144)
    assert run(["predict", "contrast-affine", str(few), "--window-ms", "80", "--end-ms", "200"]) == 0
    assert "1 of 1 flows are zero: too few events" in capsys.readouterr().out


@pytest.mark.parametrize(
    "name, options, said",
    [
        ("none", [], "holds no events"),
        ("none", ["--whole"], "fewer than two events"),
        ("one", [], "shorter than a window of 100 ms"),
        ("one", ["--whole"], "fewer than two events"),
        ("one", ["--window-ms", "auto"], "no events at a quarter, half and three quarters of the recording"),
        ("jump", ["--window-ms", "auto"], "no events at a quarter, half and three quarters"),
        ("jump", ["--no-refine"], "event times jump by 3.6e+09 s; expected --end-ms before"),
        ("pixel", [], None),
        ("pixel", ["--whole"], None),
        ("pixel", ["--window-ms", "auto"], None),
    ],
)
def test_recordings_with_little_in_them(network, tmp_path, capsys, name, options, said):
    """Each gives flow, or one line and exit status 2."""
    some = moving_events(64, 72, 0, 90_000, n=400)  # so few that no line is said of their rate
    later = Events(some.x, some.y, some.t + 3600 * 10**12, some.p)
    made = {
        "none": some.part(slice(0, 0)),
        "one": some.part(slice(0, 1)),
        "jump": Events.concatenate([some, later]),
        "pixel": Events(np.full_like(some.x, 5), np.full_like(some.y, 6), some.t * 2, some.p),
    }[name]
    write_events(tmp_path / "e.npz", made, 64, 72)
    assert run(["predict", network, str(tmp_path / "e.npz"), *options]) == (0 if said is None else 2)
    printed = capsys.readouterr()
    if said is None:
        assert "mean speed" in printed.out
    else:
        assert said in printed.err and printed.err.startswith("error: ") and printed.err.count("\n") == 1


def test_flow_at_times_within_a_window(network, tmp_path, capsys):
    """One PNG for each share of each window; the whole one is what it is without --at."""
    write_events(tmp_path / "e.h5", moving_events(128, 144, 0, 3 * SPAN, n=9000), 128, 144)
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    for out, at in ((whole, []), (parts, ["--at", ".25,1"])):
        assert run(["predict", network, str(tmp_path / "e.h5"), "--out", str(out), "--npy", *at]) == 0
    lines = (parts / "timestamps.txt").read_text().splitlines()[1:]
    starts = [int(line.split(",")[0]) for line in (whole / "timestamps.txt").read_text().splitlines()[1:]]
    assert lines == [f"{t}, {t + end}" for t in starts for end in (SPAN // 4, SPAN)]
    flows = [np.load(parts / f"npy/{k:06d}.npy") for k in range(len(lines))]
    for k in range(len(starts)):
        assert (flows[2 * k + 1] == np.load(whole / f"npy/{k:06d}.npy")).all()
    assert flows[0] == pytest.approx(flows[1] / 4)  # no window before it
    for at in ("x", "0", "0.5,1.2", ""):
        assert run(["predict", network, str(tmp_path / "e.h5"), "--at", at]) == 2
        assert f"--at: not shares of a window (got '{at}'); expected numbers above 0" in capsys.readouterr().err


def test_within_a_window_acceleration_is_constant():
    """A translation v s + a s²/2, whose flow over the window before is v - a/2, over this one v + a/2."""
    v, a = np.float32([3, -1]), np.float32([2, 0.5])
    field = lambda w: np.broadcast_to(w, (16, 24, 2)).astype(np.float32)
    for share in (0.25, 0.5, 0.75, 1):
        flow = infer.within(field(v + a / 2), field(v - a / 2), share)
        inside = flow[4:-4, 4:-4]
        assert inside == pytest.approx(np.broadcast_to(v * share + a * share**2 / 2, inside.shape), abs=1e-5)
