"""WebDataset shards, read back with tarfile alone and by webdataset itself, and compared with the sequences."""

import io
import itertools
import json
import shutil
import tarfile

import cv2
import numpy as np
import pytest

from blinkgl.cli import run
from blinkgl.config.run import load_run
from blinkgl.dataset.run import run_dataset
from blinkgl.dataset.shards import export_shards
from blinkgl.errors import AssetError, OutputError
from blinkgl.io.dsec import DsecEventReader
from blinkgl.layouts import export_layout
from runs import recipe_file


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    labels = {"flow": ["forward"], "float_flow": ["npy"], "ids": True, "depth": True}
    run_dataset(load_run(recipe_file(folder, labels=labels), ["groups.fly.output.sequences=2"]), folder / "out")
    return folder / "out"


def members(folder, split):
    found = []
    for shard in sorted(folder.glob(f"{split}-*.tar")):
        with tarfile.open(shard) as tar:
            assert all(m.uid == 0 and m.mtime == 0 and m.isfile() for m in tar)
            found += [(m.name, tar.extractfile(m).read()) for m in tar]
    return found


def test_shards_hold_every_label_once(data, tmp_path):
    assert run(["export", str(data), "--out", str(tmp_path / "a"), "--shard-mb", "1"]) == 0
    for split, name in (("train", "fly"), ("test", "probe")):
        files = members(tmp_path / "a", split)
        keys = [n.partition(".")[0] for n, _ in files]
        assert set(keys) == {f"{name}_{s:06d}_{k:06d}" for s in range(2) for k in range(4)}
        assert len({n for n, _ in files}) == len(files)
        changes = sum(a != b for a, b in itertools.pairwise(keys))
        assert changes == 7, "a sample's files stand together"
        assert keys[:: len(files) // 8] != sorted(keys[:: len(files) // 8]), "labels are mixed"
        contents = dict(files)
        for key in set(keys):
            about = json.loads(contents[f"{key}.json"])
            folder = data / split / about["sequence"]
            assert contents[f"{key}.flow.png"] == (folder / f"flow/forward/{about['label']:06d}.png").read_bytes()
            assert cv2.imdecode(np.frombuffer(contents[f"{key}.image.png"], np.uint8), 1).shape == (48, 64, 3)
            for ending, file in (("ids.png", "ids/{:06d}.png"), ("depth.npy", "depth/{:06d}.npy"),
                                 ("flow.npy", "flow/forward_npy/{:06d}.npy")):  # fmt: skip
                assert contents[f"{key}.{ending}"] == (folder / file.format(about["label"])).read_bytes()
            with np.load(folder / "poses.npz") as poses:
                assert poses["t_ns"][about["label"] + 1] // 1000 == about["from_us"] and about["near"] == poses["near"]
                np.testing.assert_array_equal(about["K"], poses["K"])
                np.testing.assert_array_equal(about["T_world_cam"], poses["T_world_cam"][about["label"] + 1])
            span = about["to_us"] - about["from_us"]
            with DsecEventReader(folder / "events.h5") as reader:
                for window, start in (("old", about["from_us"] - span), ("new", about["from_us"])):
                    with np.load(io.BytesIO(contents[f"{key}.{window}.npz"]), allow_pickle=False) as given:
                        expected = reader.slice(start, start + span)
                        for column in "xytp":
                            np.testing.assert_array_equal(given[column], getattr(expected, column))


def test_webdataset_reads_them(data, tmp_path):
    webdataset = pytest.importorskip("webdataset")
    export_shards(data, tmp_path / "a", shard_bytes=60_000)
    written = members(tmp_path / "a", "train")
    paths = [str(p) for p in sorted((tmp_path / "a").glob("train-*.tar"))]
    samples = list(webdataset.WebDataset(paths, shardshuffle=False))
    assert len(paths) > 1 and [s["__key__"] for s in samples] == list(
        dict.fromkeys(name.partition(".")[0] for name, _ in written)
    )
    assert {f"{s['__key__']}.{ending}": s[ending] for s in samples for ending in s if ending[0] != "_"} == dict(written)


def test_bad_input(data, tmp_path, monkeypatch):
    with pytest.raises(AssetError, match="no flow labels"):
        export_shards(tmp_path, tmp_path / "x")
    export_shards(data / "train", tmp_path / "a")
    with pytest.raises(OutputError, match="output folder exists"):
        export_shards(data, tmp_path / "a")
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    with pytest.raises(OutputError, match=r"^\.: not the name of a folder; expected a new folder name"):
        export_shards(data, ".")


def test_a_groups_class_is_in_its_manifests_and_shards_alone(tmp_path, capsys):
    groups = ["groups.fly.output={sequences: 1, label: 'cup, red'}", "groups.probe.output.sequences=1"]
    run_dataset(load_run(recipe_file(tmp_path), groups), tmp_path / "out")
    assert run(["verify", str(tmp_path / "out")]) == 0
    assert run(["export", str(tmp_path / "out"), "--out", str(tmp_path / "shards")]) == 0
    for split, name, label in (("train", "fly", "cup, red"), ("test", "probe", None)):
        manifest = tmp_path / f"out/{split}/{name}_000000/manifest.json"
        assert json.loads(manifest.read_text()).get("class") == label
        texts = [json.loads(data) for member, data in members(tmp_path / "shards", split) if member.endswith(".json")]
        assert len(texts) == 4 and {about.get("class") for about in texts} == {label}
    manifest.write_text(manifest.read_text().replace('"split"', '"class": "other", "split"', 1))
    capsys.readouterr()
    assert run(["verify", str(tmp_path / "out")]) == 2
    assert "class is other, config.yaml says None" in capsys.readouterr().out


def test_names_of_any_length_and_sequences_of_one_name(data, tmp_path):
    """A USTAR header has room for 100 bytes; a key is of one sequence."""
    name = "n" * 100 + "_000000"
    for folder in (f"a/{name}", "b/fly_000000", "c/fly_000000"):
        shutil.copytree(data / "train/fly_000000", tmp_path / folder)
    export_shards(tmp_path / "a", tmp_path / "long")
    export_shards(tmp_path / "b", tmp_path / "usual")
    long, usual = (members(tmp_path / folder, "train") for folder in ("long", "usual"))
    renamed = {n.replace("fly_000000", name): content for n, content in usual if not n.endswith(".json")}
    assert {n: content for n, content in long if not n.endswith(".json")} == renamed
    (tmp_path / "both").mkdir()
    for part in "bc":
        (tmp_path / part).rename(tmp_path / "both" / part)
    with pytest.raises(OutputError, match=r"b/fly_000000: two sequences would have the same keys .*c/fly_000000"):
        export_shards(tmp_path / "both", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_folder_that_one_stands_in_has_its_name(data, tmp_path, monkeypatch):
    monkeypatch.chdir(data / "train/fly_000001")
    export_shards(".", tmp_path / "shards")
    assert {name.partition(".")[0] for name, _ in members(tmp_path / "shards", "train")} == {
        f"fly_000001_{k:06d}" for k in range(4)
    }
    export_layout(".", tmp_path / "dsec", "dsec")
    assert [path.name for path in (tmp_path / "dsec/train").iterdir()] == ["fly_000001"]
