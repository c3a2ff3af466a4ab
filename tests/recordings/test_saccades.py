"""`blinkgl saccade`: light against SciPy's quadrature, events against ESIM's closed form, files by tonic's reader."""

import csv
import json

import cv2
import numpy as np
import pytest
from scipy.integrate import dblquad

from blinkgl.cli import run
from blinkgl.io.formats import open_events
from blinkgl.recordings.saccades import SACCADES, Clips, linear_light, positions, read_path, stills_of
from blinkgl.recordings.simulation import emulator_config

IDEAL = ["--set", "threshold_sigma=0"]


def digits(folder, classes=("a", "b"), each=2, shape=(28, 28)):
    rng = np.random.default_rng(1)
    for name in classes:
        (folder / name).mkdir(parents=True)
        for k in range(each):
            picture = cv2.GaussianBlur(rng.integers(0, 256, shape).astype(np.uint8), (0, 0), 1.5)
            cv2.imwrite(str(folder / name / f"{k}.png"), picture)
    return folder


def tonic_bin(path):
    """tonic.io.read_mnist_file (N-MNIST): 40 bits an event; y = 240 marks that 2^13 us have passed."""
    raw = np.fromfile(path, np.uint8).astype(np.uint32)
    x, y, p = raw[0::5], raw[1::5], (raw[2::5] & 128) >> 7
    t = ((raw[2::5] & 127) << 16) | (raw[3::5] << 8) | raw[4::5]
    for number in np.where(y == 240)[0]:
        t[number:] += 2**13
    events = np.empty(len(x), [("x", "i2"), ("y", "i2"), ("t", "i8"), ("p", "?")])
    events["x"], events["y"], events["t"], events["p"] = x, y, t, p
    return events[y != 240]


def linear(path):
    """IEC 61966-2-1, one code after another."""
    decode = lambda c: c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4
    return np.vectorize(decode)(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) / 255)


def clips(size, path=SACCADES, **values):
    return Clips(emulator_config({"emulator": "esim", "threshold_sigma": 0, **values}), None, size, path, 0, ".npz")


@pytest.mark.parametrize(("shape", "size"), [((28, 28), (34, 34)), ((40, 61), (20, 24))])
def test_light_is_the_mean_over_a_pixels_square(tmp_path, shape, size):
    """Against adaptive quadrature of the picture, its border going on, at a few places of a few frames."""
    file = digits(tmp_path, ("a",), 1, shape) / "a/0.png"
    picture, (height, width) = linear(file), size
    np.testing.assert_allclose(linear_light(file), picture, rtol=1e-6)
    scale = max(shape[0] / (height - 6), shape[1] / (width - 6))  # 7 px of path, of which 1 may leave
    seen = lambda y, x: picture[np.clip(int(np.floor(y)), 0, shape[0] - 1), np.clip(int(np.floor(x)), 0, shape[1] - 1)]
    frames, ways = list(clips(size).frames(linear_light(file))), list(positions(SACCADES))
    for k, row, column in ((0, 0, 0), (17, 9, 12), (100, 15, 4), (len(ways) - 2, height - 1, width - 1)):
        t, x, y = ways[k]
        top = shape[0] / 2 + scale * (row - height / 2 + y)
        left = shape[1] / 2 + scale * (column - width / 2 + x)
        # Cell by cell, inside which the picture is constant and the quadrature exact.
        cuts = [np.unique([a, *np.arange(np.ceil(a), a + scale), a + scale]) for a in (top, left)]
        total = sum(
            dblquad(lambda u, v: seen((y0 + y1) / 2, (x0 + x1) / 2), x0, x1, y0, y1)[0]
            for y0, y1 in zip(cuts[0], cuts[0][1:])
            for x0, x1 in zip(cuts[1], cuts[1][1:])
        )
        assert frames[k].t_ns == round(t * 1e9)
        assert frames[k].luminance[row, column] == pytest.approx(total / scale**2, abs=1e-6)


def test_counts_are_those_of_esims_closed_form(tmp_path):
    """A pixel crosses each of its levels, C apart from its first log intensity, as often as its log intensity does."""
    pictures, out = digits(tmp_path / "pictures", ("a",), 1), tmp_path / "out"
    options = ["--classes-from", "folders", "--out", str(out), "--format", "npz", *IDEAL]
    assert run(["saccade", str(pictures), *options]) == 0
    events = open_events(out / "a/0.npz").read()
    light = np.array([f.luminance for f in clips((34, 34)).frames(linear_light(pictures / "a/0.png"))], np.float64)
    level = (np.log(light + 1e-3) - np.log(light[0] + 1e-3)) / 0.2
    expected = np.zeros((2, 34, 34), int)
    for y, x in np.ndindex(34, 34):
        at = 0  # the level of the last event
        for value in level[:, y, x]:
            while value >= at + 1 - 1e-5:
                at, expected[1, y, x] = at + 1, expected[1, y, x] + 1
            while value <= at - 1 + 1e-5:
                at, expected[0, y, x] = at - 1, expected[0, y, x] + 1
    counts = np.zeros_like(expected)
    np.add.at(counts, (events.p, events.y, events.x), 1)
    # A crossing that only touches a level at a frame is decided by the last bit of a float32.
    assert expected.sum() > 4000 and np.abs(counts - expected).sum() <= 1e-3 * expected.sum()
    assert events.t[0] >= 0 and events.t[-1] <= 315_000


def stabilised(t_us, x, y):
    """N-MNIST's authors' stabilize.m: where an event's point of the picture was at the start."""
    first, second = t_us <= 105e3, (t_us > 105e3) & (t_us <= 210e3)
    u, v = t_us / 105e3, (t_us - 105e3) / 105e3
    moved = np.where(first, 3.5 * u, np.where(second, 3.5 + 3.5 * v, 7 - 7 * (t_us - 210e3) / 105e3))
    return x - moved, y - np.where(first, 7 * u, np.where(second, 7 - 7 * v, 0))


def test_the_path_is_what_the_authors_of_n_mnist_undo():
    t, x, y = np.array(list(positions(SACCADES))).T
    assert np.hypot(np.diff(x), np.diff(y)).max() <= 0.1 + 1e-12 and (np.diff(t) > 0).all()
    # A point of the picture is at minus the sensor's place.
    back = np.stack(stabilised(1e6 * t, -x, -y))
    np.testing.assert_allclose(back, np.tile([[-3.5], [-3.5]], len(t)), atol=1e-9)
    assert {0.105, 0.21, 0.315} <= set(np.round(t, 12)), "the corners are frames"


def test_the_events_of_a_dot_come_together_when_its_motion_is_undone(tmp_path):
    picture = np.zeros((28, 28), np.uint8)
    picture[13:15, 13:15] = 255
    (tmp_path / "a").mkdir()
    cv2.imwrite(str(tmp_path / "a/dot.png"), picture)
    assert run(["saccade", str(tmp_path / "a"), "--out", str(tmp_path / "out"), *IDEAL, "--set", "log_eps=0.1"]) == 0
    events = tonic_bin(tmp_path / "out/dot.bin")
    x, y = stabilised(events["t"].astype(float), events["x"].astype(float), events["y"].astype(float))
    assert len(events) > 100 and np.ptp(events["x"]) >= 8 and np.ptp(events["y"]) >= 8
    assert np.ptp(x) <= 4.1 and np.ptp(y) <= 4.1, (np.ptp(x), np.ptp(y))


def test_formats_classes_and_manifest(tmp_path):
    pictures = digits(tmp_path / "pictures")
    made = {}
    for form in ("bin", "npz", "npy"):
        out = tmp_path / form
        options = ["--classes-from", "folders", "--format", form, "--seed", "7", "--workers", "2", "--out", str(out)]
        assert run(["saccade", str(pictures), *options]) == 0
        made[form] = out
        with open(out / "labels.csv", newline="") as file:
            rows = list(csv.DictReader(file))
        assert [(r["file"], r["class"], r["label"]) for r in rows] == [
            (f"{name}/{k}.{form}", name, str(number)) for number, name in enumerate("ab") for k in range(2)
        ]
        about = json.loads((out / "manifest.json").read_text())
        assert (about["seed"], about["classes"], about["clips"]) == (7, ["a", "b"], 4)
        assert about["events"] == sum(int(row["events"]) for row in rows) and about["blinkgl"]
    for name in ("a/0", "b/1"):
        # tonic's transforms take the columns of a structured array by name.
        structured, archive = np.load(made["npy"] / f"{name}.npy"), np.load(made["npz"] / f"{name}.npz")
        of_bin = tonic_bin(made["bin"] / f"{name}.bin")
        assert len(of_bin) > 1000
        for column in "xytp":
            np.testing.assert_array_equal(of_bin[column], structured[column])
            np.testing.assert_array_equal(of_bin[column], archive[column])


def test_a_clip_depends_on_the_seed_and_its_number_alone(tmp_path):
    pictures = digits(tmp_path / "pictures")
    for name, options in {"one": [], "two": ["--workers", "2"], "other": ["--seed", "1"]}.items():
        out = ["--out", str(tmp_path / name), *options]
        assert run(["saccade", str(pictures), "--classes-from", "folders", *out]) == 0
    data = {name: (tmp_path / name / "b/1.bin").read_bytes() for name in ("one", "two", "other")}
    assert data["one"] == data["two"] != data["other"]


def test_sensor_path_and_mixed_sizes(tmp_path, capsys):
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for k, side in enumerate((30, 50)):
        cv2.imwrite(str(pictures / f"{k}.png"), np.tile(np.linspace(20, 230, side), (side, 1)).astype(np.uint8))
    way = tmp_path / "points.csv"
    way.write_text("t,x,y\n0,0,0\n0.05,4,0\n")
    out = ["--path", str(way), "--size", "24x16", "--out", str(tmp_path / "out"), "-e", "v2e"]
    assert run(["saccade", str(pictures), *out]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "pictures of 2 sizes, 30x30 to 50x50: each is scaled to the sensor" in lines
    assert lines[-1].startswith(f"{tmp_path}/out: 2 clips of 24x16 px, ")
    assert run(["saccade", str(pictures), "--sensor", "dvxplorer", "--out", str(tmp_path / "large")]) == 2
    assert "a sensor larger than .bin holds" in capsys.readouterr().err and not (tmp_path / "large").exists()


@pytest.mark.parametrize(
    ("options", "content", "message"),
    [
        ([], {}, "{in}: no pictures; expected pictures, or --classes-from folders"),
        (["--classes-from", "folders"], {"a.png": b""}, "{in}: no pictures; expected a folder of one folder"),
        ([], {"a.png": b"not one"}, "{in}/a.png: cannot decode image"),
        ([], {"a.png": None, "a.bmp": None}, "{in}/a.bmp: two pictures would give clips of one name"),
        (
            ["--path", "{way}"],
            {"a.png": None, "../way": b"t,x,y\n0,0,0\n"},
            "--path {way}: not a path (got 't,x,y, 1 po",
        ),
        (["--path", "{way}"], {"../way": b"t,x,y\n0,0,0\n0,1,1\n"}, "--path {way}: times do not increase"),
        (["--path", "{way}"], {"../way": b"t,x,y\n0,0,0\n1,x,1\n"}, "--path {way}: x is no number"),
        (["--path", "{way}"], {"../way": b"t,x,y\n0,0,0\n1,34,1\n"}, "--path: the path is wider than the sensor"),
        (
            ["--path", "{way}"],
            {"a.png": None, "../way": b"t,x,y\n8,0,0\n9,9,9\n"},
            "a time that 23 bits of .bin cannot",
        ),
        (["--format", "aedat"], {}, "--format: unknown value (got 'aedat'); expected bin, npz, npy"),
        (["--size", "34"], {}, "--size: not a size"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(tmp_path, capsys, options, content, message):
    folder, way = tmp_path / "in", tmp_path / "way"
    folder.mkdir()
    grey = np.random.default_rng(0).integers(0, 255, (28, 28)).astype(np.uint8)
    for name, data in content.items():
        (folder / name).write_bytes(cv2.imencode(name[-4:], grey)[1].tobytes() if data is None else data)
    words = {"{in}": str(folder), "{way}": str(way)}
    for word, value in words.items():
        options, message = [option.replace(word, value) for option in options], message.replace(word, value)
    assert run(["saccade", str(folder), "--out", str(tmp_path / "out"), *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert not (tmp_path / "out").exists() and not list(tmp_path.glob(".out*"))


def test_hidden_files_and_folders_are_no_pictures_and_no_classes(tmp_path):
    for place in ("cat/a.png", "dog/b.png", ".ipynb_checkpoints/a.png", "dog/._b.png"):
        (tmp_path / place).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / place), np.zeros((4, 4), np.uint8))
    found = [(one.label, one.number, one.file.name) for one in stills_of(tmp_path, classes=True)]
    assert found == [("cat", 0, "a.png"), ("dog", 1, "b.png")]


def test_a_path_of_a_spreadsheet_begins_with_a_mark(tmp_path):
    (tmp_path / "p.csv").write_text("t,x,y\n0,0,0\n1,2,3\n", encoding="utf-8-sig")
    assert read_path(tmp_path / "p.csv").tolist() == [[0, 0, 0], [1, 2, 3]]
