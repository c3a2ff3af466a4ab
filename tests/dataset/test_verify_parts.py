"""The parts of verification by themselves: every limit from both sides, every kind of file
that two machines may write differently."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import h5py
import hdf5plugin  # noqa: F401
import numpy as np
import pytest

from blinkgl.dataset.verify import again, between, contents
from blinkgl.dataset.verify.again import differences
from blinkgl.dataset.verify.contents import _check_labels, check_events
from blinkgl.dataset.verify.found import Known, Verification, guarded
from blinkgl.io.flow_png import write_flow_png

WIDTH, HEIGHT, END = 20, 10, 5_000
MANIFEST = {"events": 6, "t_offset_us": 700, "duration_us": END, "width": WIDTH, "height": HEIGHT, "labels": 2}
GOOD = {
    "x": [0, 19, 3, 3, 4, 5],
    "y": [0, 9, 2, 2, 2, 2],
    "t": [0, 999, 1000, 1000, 3500, 5000],
    "p": [0, 1, 0, 1, 1, 0],
}


def table(t, entries: int = 6) -> np.ndarray:
    return np.searchsorted(t, np.arange(entries) * 1000)


def events_file(path: Path, offset: int = 700, ms_to_idx=None, **columns) -> Path:
    columns = {**GOOD, **columns}
    with h5py.File(path, "w") as file:
        for name, dtype in (("x", "u2"), ("y", "u2"), ("t", "i8"), ("p", "i2")):
            file[f"events/{name}"] = np.array(columns[name], dtype)
        file["t_offset"] = np.int64(offset)
        file["ms_to_idx"] = np.asarray(table(columns["t"]) if ms_to_idx is None else ms_to_idx, np.uint64)
    return path


@pytest.mark.parametrize("block", [1, 2, 3, 4, 1 << 20])
@pytest.mark.parametrize(
    "changes, problem",
    [
        ({}, None),
        ({"ms_to_idx": table(GOOD["t"], 7)}, None),
        ({"offset": 701}, "t_offset is 701, manifest says 700"),
        ({"ms_to_idx": table(GOOD["t"], 5)}, "ms_to_idx has 5 entries, 6 are needed"),
        ({"ms_to_idx": table(GOOD["t"], 8)}, "ms_to_idx has 8 entries, 6 are needed"),
        ({"t": [0, 999, 1000, 998, 3500, 5000]}, "times decrease after event 3"),
        ({"t": [0, 999, 1000, 1000, 900, 5000]}, "times decrease after event 4"),
        ({"t": [-1, 999, 1000, 1000, 3500, 5000]}, "times decrease after event 0"),
        ({"t": [0, 999, 1000, 1000, 3500, 5001]}, "last event at 5001 µs, the sequence ends at 5000 µs"),
        ({"x": [0, 20, 3, 3, 4, 5]}, "an event outside 20x10 px"),
        ({"y": [0, 10, 2, 2, 2, 2]}, "an event outside 20x10 px"),
        ({"p": [0, 1, 0, 2, 1, 0]}, "a polarity other than 0 and 1"),
        ({"p": [0, 1, 0, -1, 1, 0]}, "a polarity other than 0 and 1"),
        ({"ms_to_idx": [0, 2, 4, 4, 5, 6]}, "ms_to_idx[5] is 6, expected 5"),
        ({"ms_to_idx": [0, 1, 4, 4, 5, 5]}, "ms_to_idx[1] is 1, expected 2"),
        ({"x": [1, 2, 3], "y": [1, 2, 3], "t": [1, 2, 3], "p": [0, 0, 0]}, "columns of [3] events, manifest says 6"),
    ],
)
def test_events(tmp_path, monkeypatch, block, changes, problem):
    """In blocks of any size: what is wrong, and that it is the only thing said."""
    monkeypatch.setattr(contents, "_BLOCK", block)
    assert check_events(events_file(tmp_path / "events.h5", **changes), MANIFEST) == (
        [f"events.h5: {problem}"] if problem else []
    )


def test_events_of_nothing_and_of_less_than_a_millisecond(tmp_path):
    nothing = {**{k: [] for k in "xytp"}, "ms_to_idx": np.zeros(6)}
    assert check_events(events_file(tmp_path / "a.h5", **nothing), {**MANIFEST, "events": 0}) == []
    for end, entries in ((0, 1), (1, 2), (999, 2), (1000, 2), (1001, 3)):
        assert (
            check_events(
                events_file(tmp_path / "b.h5", **{**nothing, "ms_to_idx": np.zeros(entries)}),
                {**MANIFEST, "events": 0, "duration_us": end},
            )
            == []
        )
        assert (
            "entries"
            in check_events(
                events_file(tmp_path / "b.h5", **{**nothing, "ms_to_idx": np.zeros(entries - 1)}),
                {**MANIFEST, "events": 0, "duration_us": end},
            )[0]
        )


@pytest.mark.parametrize("x", [-1, 5])
def test_columns_that_are_signed(tmp_path, x):
    path = events_file(tmp_path / "e.h5")
    with h5py.File(path, "r+") as file:
        del file["events/x"]
        file["events/x"] = np.array([0, 19, x, 3, 4, 5], np.int32)
    assert check_events(path, MANIFEST) == ([] if x >= 0 else ["events.h5: an event outside 20x10 px"])


# --- labels -----------------------------------------------------------------------------------------------------------


def labels_folder(
    folder: Path,
    images="700\n3200\n5700\n",
    forward="700, 3200\n3200, 5700\n",
    backward="3200, 700\n5700, 3200\n",
    size=(HEIGHT, WIDTH),
) -> dict:
    for name, text in (
        ("images/timestamps.txt", images),
        ("flow/forward_timestamps.txt", "# from, to\n" + forward),
        ("flow/backward_timestamps.txt", backward),
    ):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    for k in range(3):
        cv2.imwrite(str(folder / f"images/{k:06d}.png"), np.zeros((*size, 3), np.uint8))
    for direction in ("forward", "backward"):
        (folder / "flow" / direction).mkdir(exist_ok=True)
        for k in range(2):
            write_flow_png(folder / f"flow/{direction}/{k:06d}.png", np.zeros((*size, 2)), np.ones(size, bool))
    return {**MANIFEST, "files": {p.relative_to(folder).as_posix(): {} for p in folder.rglob("*") if p.is_file()}}


@pytest.mark.parametrize(
    "changes, problems",
    [
        ({}, []),
        ({"images": "700\n5700\n"}, ["images: 3 files, 2 time stamps"]),
        ({"images": "699\n3200\n5700\n"}, ["images/timestamps.txt: times are not in order inside 700 … 5700 µs"]),
        ({"images": "700\n3200\n5701\n"}, ["images/timestamps.txt: times are not in order inside 700 … 5700 µs"]),
        ({"images": "700\n700\n5700\n"}, ["images/timestamps.txt: times are not in order inside 700 … 5700 µs"]),
        ({"images": "700\n5700\n3200\n"}, ["images/timestamps.txt: times are not in order inside 700 … 5700 µs"]),
        ({"images": ""}, ["images: 3 files, 0 time stamps"]),
        ({"forward": "700, 3200\n"}, ["flow/forward: 2 files, 1 time stamps, manifest says 2 labels"]),
        (
            {"forward": "699, 3200\n3200, 5700\n"},
            ["flow/forward_timestamps.txt: an interval leaves the sequence or runs the wrong way"],
        ),
        (
            {"forward": "700, 3200\n3200, 5701\n"},
            ["flow/forward_timestamps.txt: an interval leaves the sequence or runs the wrong way"],
        ),
        (
            {"forward": "3200, 700\n3200, 5700\n"},
            ["flow/forward_timestamps.txt: an interval leaves the sequence or runs the wrong way"],
        ),
        (
            {"backward": "700, 3200\n5700, 3200\n"},
            ["flow/backward_timestamps.txt: an interval leaves the sequence or runs the wrong way"],
        ),
        ({"backward": "700, 700\n5700, 3200\n"}, []),
        (
            {"forward": "700, 700\n3200, 5700\n"},
            ["flow/forward_timestamps.txt: an interval leaves the sequence or runs the wrong way"],
        ),
    ],
)
def test_labels(tmp_path, changes, problems):
    assert _check_labels(tmp_path, labels_folder(tmp_path, **changes)) == problems


def test_labels_of_another_size_and_number(tmp_path):
    manifest = labels_folder(tmp_path)
    for kind, value in {
        "depth": np.ones((HEIGHT, WIDTH)),
        "velocity": np.zeros((HEIGHT, WIDTH, 2)),
        "normals": np.tile([0, 0, 1], (HEIGHT, WIDTH, 1)),
    }.items():
        (tmp_path / kind).mkdir()
        for k in range(3):
            np.save(tmp_path / f"{kind}/{k:06d}.npy", value.astype(np.float32))
        two = {**manifest, "files": {**manifest["files"], f"{kind}/000000.npy": {}, f"{kind}/000001.npy": {}}}
        assert _check_labels(tmp_path, two) == []
        assert _check_labels(tmp_path, {**two, "files": {**two["files"], f"{kind}/000002.npy": {}}}) == [
            f"{kind}: 3 files, manifest says 2 labels"
        ]
    assert _check_labels(tmp_path, {**manifest, "labels": 3}) == [
        f"flow/{direction}: 2 files, 2 time stamps, manifest says 3 labels" for direction in ("forward", "backward")
    ]
    for name in ("images/000000.png", "images/000002.png"):
        cv2.imwrite(str(tmp_path / name), np.zeros((HEIGHT, WIDTH + 1, 3), np.uint8))
        [line] = _check_labels(tmp_path, manifest)
        assert line.startswith(f"{name}: not 20x10 px")
        cv2.imwrite(str(tmp_path / name), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    write_flow_png(
        tmp_path / "flow/backward/000001.png", np.zeros((HEIGHT + 1, WIDTH, 2)), np.ones((HEIGHT + 1, WIDTH), bool)
    )
    [line] = _check_labels(tmp_path, manifest)
    assert line.startswith("flow/backward/000001.png: not 20x10 px")


def test_without_labels_nothing_is_asked(tmp_path):
    assert _check_labels(tmp_path, {**MANIFEST, "files": {"events.h5": {}}}) == []


# --- two machines -----------------------------------------------------------------------------------------------------


def pair(tmp_path, name: str) -> tuple[Path, Path]:
    for side in "ab":
        (tmp_path / side / name).parent.mkdir(parents=True, exist_ok=True)
    return tmp_path / "a", tmp_path / "b"


@pytest.mark.parametrize(
    "moved, share, agree",
    [(0.0, 1.0, True), (2 / 128, 1.0, True), (3 / 128, 1.0, False), (50.0, 0.05, True), (50.0, 0.06, False)],
)
@pytest.mark.parametrize("axis", [0, 1])
def test_flow_agrees_to_two_quanta_in_nearly_all_pixels(tmp_path, moved, share, agree, axis):
    a, b = pair(tmp_path, name := "flow/forward/000003.png")
    flow = np.random.default_rng(0).uniform(-9, 9, (10, 20, 2))
    flow = np.round(flow * 128) / 128
    other = flow.copy()
    other.reshape(-1, 2)[: round(share * 200), axis] += moved
    for root, values in ((a, flow), (b, other)):
        write_flow_png(root / name, values, np.ones((10, 20), bool))
    assert again._agrees(name, a, b) is agree


def test_flow_that_is_valid_elsewhere_or_of_another_size_does_not_agree(tmp_path):
    a, b = pair(tmp_path, name := "flow/backward/12.png")
    flow, valid = np.zeros((10, 20, 2)), np.ones((10, 20), bool)
    write_flow_png(a / name, flow, valid)
    write_flow_png(b / name, flow, np.arange(200).reshape(10, 20) >= 11)
    assert not again._agrees(name, a, b)
    write_flow_png(b / name, np.zeros((10, 21, 2)), np.ones((10, 21), bool))
    assert not again._agrees(name, a, b)


@pytest.mark.parametrize(
    "factor, share, agree", [(1.00009, 1.0, True), (1.0002, 1.0, False), (2.0, 0.05, True), (2.0, 0.06, False)]
)
def test_depth_agrees_to_a_ten_thousandth_in_nearly_all_pixels(tmp_path, factor, share, agree):
    a, b = pair(tmp_path, name := "depth/000000.npy")
    depth = np.random.default_rng(0).uniform(1, 9, (10, 20)).astype(np.float32)
    other = depth.copy()
    other.ravel()[: round(share * 200)] *= np.float32(factor)
    np.save(a / name, depth), np.save(b / name, other)
    assert again._agrees(name, a, b) is agree
    np.save(b / name, depth[:5])
    assert again._agrees(name, a, b) is False


@pytest.mark.parametrize(
    "change, agree",
    [
        (lambda p: p, True),
        (lambda p: {**p, "K": p["K"] * (1 + 1e-11)}, True),
        (lambda p: {**p, "K": p["K"] * (1 + 1e-6)}, False),
        (lambda p: {**p, "times_ns": p["times_ns"] + 1}, False),
        (lambda p: {**p, "more": np.zeros(1)}, False),
        (lambda p: {"K": p["K"]}, False),
        (lambda p: {**p, "times_ns": p["times_ns"][:2]}, False),
        (lambda p: {**p, "K": p["K"][:1]}, False),
    ],
)
def test_poses_agree_to_rounding_and_times_exactly(tmp_path, change, agree):
    a, b = pair(tmp_path, "poses.npz")
    poses = {"K": np.arange(9.0).reshape(3, 3), "times_ns": np.arange(4) * 10**9}
    np.savez(a / "poses.npz", **poses), np.savez(b / "poses.npz", **change(poses))
    assert again._agrees("poses.npz", a, b) is agree


def test_times_never_differ_and_what_a_codec_decides_always_may(tmp_path):
    for name, agree in (
        ("images/timestamps.txt", False),
        ("flow/forward_timestamps.txt", False),
        ("preview.mp4", True),
        ("events.h5", True),
    ):
        a, b = pair(tmp_path, name)
        (a / name).write_text("1"), (b / name).write_text("2")
        assert again._agrees(name, a, b) is agree
    a, b = pair(tmp_path, "images/000000.png")
    for root, grey in ((a, 10), (b, 200)):
        cv2.imwrite(str(root / "images/000000.png"), np.full((4, 5, 3), grey, np.uint8))
    assert again._agrees("images/000000.png", a, b) is True


def test_what_sets_two_machines_apart():
    here = {"blinkgl": "1.0", "versions": {"numpy": "2"}, "opengl": {"renderer": "llvmpipe", "version": "4.5"}}
    assert again._apart(here, dict(here)) == ""
    assert again._apart({**here, "blinkgl": "0.9"}, here) == "made with BlinkGL 0.9, this machine has 1.0"
    assert (
        again._apart({**here, "opengl": {"renderer": "Voodoo", "version": "1"}}, here)
        == "made with opengl Voodoo, 1, this machine has llvmpipe, 4.5"
    )
    assert again._apart({**here, "versions": {"numpy": "1", "numba": "3"}}, here) == (
        "made with numba 3, this machine has None; made with numpy 1, this machine has 2"
    )
    assert between.made_with({"versions": None, "opengl": None}) == {}


def test_files_in_which_folders_differ(tmp_path):
    a, b = pair(tmp_path, "x/file")
    for root in (a, b):
        (root / "x/same").write_text("1")
        (root / "x/file").write_text(root.name)
    (a / "left").write_text(""), (b / "x/right").write_text("")
    assert differences(a, b) == ["left: only in one of them", "x/right: only in one of them", "x/file: differs"]
    assert differences(a, a) == []


@pytest.mark.parametrize(
    "a, b, where",
    [
        ({"a": 1}, {"a": 1}, ""),
        ({"a": 1}, {"a": 2}, "a"),
        ({"a": {"b": [1, 2]}}, {"a": {"b": [1, 3]}}, "a.b"),
        ({"a": {"b": 1}, "c": 1}, {"a": {"b": 1}, "c": 2}, "c"),
        ({"a": 1}, {"a": 1, "b": 0}, "b"),
        ({"b": 1, "a": 1}, {"b": 2, "a": 2}, "a"),
        ({"a": {}}, {"a": 3}, "a"),
    ],
)
def test_where_two_configurations_differ(a, b, where):
    assert between.first_difference(a, b) == where


# --- what lies between sequences --------------------------------------------------------------------------------------


def test_what_belongs_to_no_sequence(tmp_path):
    for name in ("train/a_000000", "train/b_000000", ".run", "train/nothing", "deep/er/empty"):
        (tmp_path / name).mkdir(parents=True)
    for name in ("train/a_000000/events.h5", "index.jsonl", "report.html", ".run/run.json"):
        (tmp_path / name).write_text("")
    folders = [tmp_path / "train/a_000000", tmp_path / "train/b_000000"]
    assert between.strangers(tmp_path, folders) == ["deep: belongs to no sequence"]
    (tmp_path / "deep").rename(tmp_path / "train/.c_000001.blinkgl-tmp-0123456789ab-1-0")
    (tmp_path / "train/index.jsonl").write_text("")
    (tmp_path / "train/nothing/x").write_text("")
    (tmp_path / "link").symlink_to(tmp_path / "train")
    assert between.strangers(tmp_path, folders) == [
        "link: belongs to no sequence",
        "train/.c_000001.blinkgl-tmp-0123456789ab-1-0: left by a run that was cut off",
        "train/index.jsonl: belongs to no sequence",
        "train/nothing: belongs to no sequence",
    ]


def known(
    name: str,
    seed: int,
    sequence: int,
    events: int = 5,
    sha: str = "e",
    poses: str = "p",
    kind: str = "random",
    frames=None,
    **noise,
):
    config = SimpleNamespace(
        frames=frames,
        scene=SimpleNamespace(kind=kind),
        seed=seed,
        events=SimpleNamespace(**noise),
        readout=None,
        sensors=None,
    )
    return name, Known(
        Path(name),
        {
            "files": {"events.h5": {"sha256": sha}, "poses.npz": {"sha256": poses}},
            "events": events,
            "sequence": sequence,
        },
        config,
    )


@pytest.mark.parametrize(
    "first, second, problems, notes",
    [
        (
            known("a", 1, 0),
            known("b", 1, 1),
            {
                "b": [
                    "events.h5: the same as in a, a sequence of another draw",
                    "poses.npz: the same as in a, a sequence of another draw",
                ]
            },
            [],
        ),
        (
            known("a", 1, 0),
            known("b", 1, 1, sha="f"),
            {"b": ["poses.npz: the same as in a, a sequence of another draw"]},
            [],
        ),
        (known("a", 1, 0), known("b", 2, 0, sha="f", poses="q"), {}, []),
        (known("a", 1, 0), known("b", 1, 0), {}, ["b: the same events as a, as their configurations have it"]),
        (known("a", 1, 0, events=0), known("b", 1, 1, events=0, poses="q"), {}, []),
        (
            known("a", 1, 0, kind="explicit"),
            known("b", 1, 1, kind="explicit"),
            {},
            ["b: the same events as a, as their configurations have it"],
        ),
        (
            known("a", 1, 0, kind="explicit", threshold_sigma=0.1),
            known("b", 1, 1, kind="explicit", threshold_sigma=0.1),
            {"b": ["events.h5: the same as in a, a sequence of another draw"]},
            [],
        ),
        (
            known("a", 1, 0, frames="film"),
            known("b", 1, 1, frames="film"),
            {},
            ["b: the same events as a, as their configurations have it"],
        ),
    ],
)
def test_twins(first, second, problems, notes):
    result = Verification()
    assert between.twins(dict([first, second]), result) == problems and result.notes == notes


@pytest.mark.parametrize(
    "key",
    ["threshold_sigma", "threshold_jitter", "leak_rate_hz", "shot_noise_rate_hz", "hot_pixel_fraction", "k3", "k6"],
)
def test_what_makes_two_seeds_differ(key):
    of = lambda **keys: SimpleNamespace(events=SimpleNamespace(**keys), readout=None, sensors=None)
    assert between._noisy(of(**{key: 0.1}))
    assert not between._noisy(of(**{key: 0.0})) and not between._noisy(of())


@pytest.mark.parametrize(("key", "differ"), [("pixels", True), ("latency", True), ("clock", False)])
def test_a_read_out_may_make_two_seeds_differ(key, differ):
    readout = SimpleNamespace(**{"pixels": None, "latency": None, key: object()})
    assert between._noisy(SimpleNamespace(events=SimpleNamespace(), readout=readout, sensors=None)) is differ


def test_a_check_that_stops_is_a_line():
    assert guarded(lambda: 1 / 0) == ["cannot be checked: ZeroDivisionError: division by zero"] and guarded(
        lambda: ["x"]
    ) == ["x"]
