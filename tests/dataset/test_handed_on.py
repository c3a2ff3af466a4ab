"""Exports and shards hand on what was read and nothing else, whatever the files of a sequence hold."""

from __future__ import annotations

import hashlib
import io
import itertools
import shutil
import tarfile
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml

from blinkgl.dataset.shards import export_shards
from blinkgl.dataset.verify import verify_dataset
from blinkgl.errors import BlinkGLError
from blinkgl.io.dsec import DsecEventReader
from blinkgl.io.images import encode_png
from blinkgl.layouts import export_layout
from blinkgl.layouts.export import LAYOUTS
from runs import forge, generated
from tests.io.test_hdf5_door import packed

SECRET = b"the victim's own secret\n" * 8
WIDTH, HEIGHT = 48, 32
RECIPE = {
    "seed": 3,
    "camera": {"width": WIDTH, "height": HEIGHT},
    "time": {"duration": 0.3, "label_rate": 10},
    "timeline": {"kind": "uniform", "fps": 60},
    "scene": {
        "kind": "random",
        "objects": {"count": 2},
        "pool": {"primitives": ["cuboid"], "variants": 4},
        "textures": {"procedural": ["checks"], "variants": 4, "photographs": False, "max_size": 64},
    },
    "events": {"emulator": "esim"},
    "labels": {"flow": ["forward", "backward", 0.05, 0.1], "images": True, "depth": True, "boxes": True, "ids": True},
    "images": {"exposure_us": 5000},
    "imu": {"rate": 200, "preset": "adis16448"},
    "preview": {"enabled": False},
}  # fmt: skip


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return generated(tmp_path_factory.mktemp("handed"), RECIPE) / "out"


@pytest.fixture
def copy(data, tmp_path) -> Path:
    return Path(shutil.copytree(data, tmp_path / "set"))


def exports(data: Path, out: Path) -> dict[str, list[tuple[str, bytes]] | str]:
    """What each layout, and shards, hand on: names and contents, or the line of the refusal."""
    handed: dict[str, list[tuple[str, bytes]] | str] = {}
    for name in (*LAYOUTS, "webdataset"):
        try:
            if name == "webdataset":
                export_shards(data, out / name)
            else:
                export_layout(data, out / name, name)
        except BlinkGLError as error:
            assert not (out / name).exists() or not any((out / name).iterdir()), "half written"
            handed[name] = str(error)
            continue
        handed[name] = [
            (path.relative_to(out).as_posix(), path.read_bytes()) for path in (out / name).rglob("*") if path.is_file()
        ]
    return handed


def test_what_is_read_is_handed_on(data, tmp_path):
    """Byte for byte what the sequence has, where a layout takes over the same format."""
    handed = exports(data, tmp_path)
    sequence = data / "train/sequence_000000"
    files = dict(handed["dsec"])
    pairs = {
        "events/left/events.h5": "events.h5", "flow/forward/000002.png": "flow/forward/000000.png",
        "images/left/ev_inf/000002.png": "images/000000.png",
        **{f"imu/{name}": f"imu/{name}" for name in ("imu.csv", "ideal.csv", "imu.h5", "imu.yaml")},
    }  # fmt: skip
    for name, of in pairs.items():
        assert files[f"dsec/train/sequence_000000/{name}"] == (sequence / of).read_bytes(), name
    shard = next(content for name, content in handed["webdataset"] if name.endswith(".tar"))
    with tarfile.open(fileobj=io.BytesIO(shard)) as tar:
        members = {name.split(".", 1)[1]: tar.extractfile(name).read() for name in tar.getnames() if "000001." in name}
    for name, of in (("boxes.npz", "boxes/000001.npz"), ("boxes.txt", "boxes_kitti/000001.txt"),
                     ("flow_intervals.h5", "flow/intervals/000001.h5"), ("ids.png", "ids/000001.png")):  # fmt: skip
        assert members[name] == (sequence / of).read_bytes(), name


def _external(path: Path, name: str, secret: Path) -> None:
    with h5py.File(path, "r+") as file:
        shape, dtype = file[name].shape, file[name].dtype
        del file[name]
        size = int(np.prod(shape)) * dtype.itemsize
        file.create_dataset(name, shape, dtype, external=[(str(secret), 0, size)])


def _smuggled(path: Path, _: str, secret: Path) -> None:
    """Beside what is read: a data set whose filter ends processes, and one of somebody's bytes."""
    with h5py.File(path, "r+") as file:
        packed(file, "hidden/pictures", b"\1" * 100, (32024, ()))
        file["hidden/text"] = np.frombuffer(SECRET, np.uint8)


def _random(path: Path, *_: object) -> None:
    path.write_bytes(np.random.default_rng(0).bytes(4000))


def _large(path: Path, *_: object) -> None:
    path.write_bytes(encode_png(np.zeros((1000, 1000, 3), np.uint16 if "flow" in str(path) else np.uint8)))


def _member(path: Path, *_: object) -> None:
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **arrays, more=np.frombuffer(SECRET, np.uint8))


EVENTS, FLOW, IMAGE = "events.h5", "flow/forward/000000.png", "images/000000.png"
CASES = [
    (EVENTS, _external, "events/x"),
    (EVENTS, _smuggled, ""),
    (EVENTS, _random, ""),
    (FLOW, _random, ""),
    (FLOW, _large, ""),
    ("flow/backward/000000.png", _large, ""),
    (IMAGE, _random, ""),
    (IMAGE, _large, ""),
    ("ids/000000.png", _large, ""),
    ("frame_camera/images/000000.png", _large, ""),
    ("boxes/000000.npz", _member, ""),
    ("boxes_kitti/000000.txt", _random, ""),
    ("flow/intervals/000000.h5", _external, "to_us"),
    ("flow/intervals/000000.h5", _smuggled, ""),
    ("imu/imu.h5", _external, "rate"),
    ("imu/imu.h5", _smuggled, ""),
    ("imu/imu.yaml", lambda path, *_: path.write_text(path.read_text() + "bait: !!python/name:os.system\n"), ""),
    ("imu/imu.yaml", lambda path, *_: path.write_text(path.read_text() + "bait: the victim's own secret\n"), ""),
    ("imu/imu.csv", lambda path, *_: path.write_bytes(SECRET), ""),
    ("imu/more.txt", lambda path, *_: path.write_bytes(SECRET), ""),
]


@pytest.mark.parametrize("name, change, inner", CASES)
def test_nothing_unread_is_handed_on(data, copy, tmp_path, name, change, inner):
    sequence, secret = copy / "train/sequence_000000", tmp_path / "secret"
    secret.write_bytes(SECRET * 1000)
    whole = {digest(path.read_bytes()) for path in data.rglob("*") if path.is_file()}
    change(sequence / name, inner, secret)
    forge(sequence, name)
    altered = {digest(path.read_bytes()) for path in copy.rglob("*") if path.is_file()} - whole
    for layout, handed in exports(copy, tmp_path / "out").items():
        if isinstance(handed, str):
            assert "\n" not in handed and len(handed) < 800, layout
            continue
        contents = itertools.chain.from_iterable(map(unpacked, handed))
        for path, content in contents:
            assert SECRET[:20] not in content, (layout, path)
            assert digest(content) not in altered, (layout, path, "was copied as it is")
            if content[:4] == b"\x89HDF":
                with h5py.File(io.BytesIO(content)) as file:
                    file.visititems(lambda name, held: None if isinstance(held, h5py.Group) else held[:1])


def unpacked(file: tuple[str, bytes]) -> list[tuple[str, bytes]]:
    if not file[0].endswith(".tar"):
        return [file]
    with tarfile.open(fileobj=io.BytesIO(file[1])) as tar:
        return [(name, tar.extractfile(name).read()) for name in tar.getnames()]


def digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda e: e["events/x"].__setitem__(3, 60_000), "event 3 is outside the sensor"),
        (lambda e: e["events/p"].__setitem__(3, 2), "p of event 3 (got 2)"),
        (lambda e: e["events/t"].__setitem__(3, 4_000_000_000), "event times decrease at event 4"),
        (lambda e: e["events/t"].__setitem__(-1, 4_000_000_000), "µs; the sequence: 0 to 400000"),
        (lambda e: [e[f"events/{k}"].resize((50,)) for k in "xytp"], "events.h5: holds 50 events, manifest.json says "),
        (lambda e: e["events/y"].resize((50,)), "event columns differ in length"),
    ],
)
def test_verify_reads_all_events(copy, change, message):
    sequence = copy / "train/sequence_000000"
    assert verify_dataset(copy).clean
    with h5py.File(sequence / "events.h5", "r+") as file:
        change(file)
    forge(sequence, "events.h5")
    lines = verify_dataset(copy).problems["train/sequence_000000"]
    assert len(lines) == 1 and message in lines[0]


def test_verify_names_links_and_filters_of_events(copy, tmp_path):
    sequence = copy / "train/sequence_000000"
    (tmp_path / "secret").write_bytes(SECRET * 1000)
    _external(sequence / "events.h5", "events/x", tmp_path / "secret")
    forge(sequence, "events.h5")
    assert (
        "'events/x' is a data set with external storage, which refers to other files; refused"
        in (verify_dataset(copy).problems["train/sequence_000000"][0])
    )


def test_events_of_a_rig_are_read_too(tmp_path):
    recipe = {key: value for key, value in RECIPE.items() if key not in ("camera", "imu", "images", "labels")}
    one = {"camera": RECIPE["camera"], "events": {}}
    recipe |= {"labels": {"flow": ["forward"]}, "sensors": [{"name": "a", **one}, {"name": "b", **one}]}
    data = generated(tmp_path, recipe) / "out"
    assert verify_dataset(data).clean
    sequence = data / "train/sequence_000000"
    with h5py.File(sequence / "b/events.h5", "r+") as file:
        file["events/p"][0] = 7
    forge(sequence / "b", "events.h5")
    forge(sequence, "b/events.h5")
    forge(sequence, "b/manifest.json")
    assert any(
        "b/" in line and "p of event 0 (got 7)" in line
        for line in verify_dataset(data).problems[sequence.parent.name + "/" + sequence.name]
    )


def test_an_unknown_compression_is_a_line(copy, tmp_path):
    sequence = copy / "train/sequence_000000"
    text = yaml.safe_load((sequence / "config.yaml").read_text())
    text["output"]["compression"] = "sz3"
    (sequence / "config.yaml").write_text(yaml.safe_dump(text))
    forge(sequence, "config.yaml")
    with pytest.raises(BlinkGLError, match="unknown compression .got 'sz3'.; expected zstd, lz4, gzip"):
        export_layout(copy, tmp_path / "out", "dsec")
    with DsecEventReader(sequence / "events.h5") as reader:
        assert reader.count
