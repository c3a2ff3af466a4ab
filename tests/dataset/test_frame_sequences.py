"""Frame folders in the way of TartanAir become sequences: their own flow as labels, the
emulator's events between frames."""

import json
import shutil
from pathlib import Path

import cv2
import h5py
import hdf5plugin  # noqa: F401
import numpy as np
import pytest
import yaml

from blinkgl.config.run import RunTemplate, load_run
from blinkgl.dataset.run import run_dataset
from blinkgl.dataset.verify import verify_dataset
from blinkgl.errors import BlinkGLError, ConfigError
from blinkgl.io.flow import read_flow_png
from blinkgl.io.images import read_mask
from blinkgl.sequence_files.sequence_dir import read_manifest

H, W, N, SHIFT = 48, 64, 6, (1.5, 0.5)


@pytest.fixture(scope="module")
def tartan(tmp_path_factory) -> Path:
    """Two trajectories of a texture that slides by SHIFT px per frame; the flow is exact, a stripe is masked."""
    root = tmp_path_factory.mktemp("tartan")
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.random((4 * H, 4 * W)).astype(np.float32), (0, 0), 2)
    texture = (texture - texture.min()) / np.ptp(texture)
    for trajectory in ("P000", "P001"):
        for folder in ("image_left", "flow"):
            (root / trajectory / folder).mkdir(parents=True)
        for k in range(N):
            move = np.float32([[1, 0, k * SHIFT[0] - W], [0, 1, k * SHIFT[1] - H]])
            image = cv2.warpAffine(texture, move, (W, H), flags=cv2.INTER_LINEAR)
            cv2.imwrite(
                str(root / trajectory / f"image_left/{k:06d}_left.png"),
                np.repeat((image * 255).astype(np.uint8)[..., None], 3, axis=2),
            )
        for k in range(N - 1):
            flow = np.broadcast_to(np.float32(SHIFT), (H, W, 2)) * (1 + 0.1 * k)
            mask = np.zeros((H, W), np.uint8)
            mask[:, -2:] = 100
            np.save(root / trajectory / f"flow/{k:06d}_{k + 1:06d}_flow.npy", flow)
            np.save(root / trajectory / f"flow/{k:06d}_{k + 1:06d}_mask.npy", mask)
    return root


def recipe(tmp_path, tartan, **frames):
    path = tmp_path / "recipe.yaml"
    path.write_text(
        yaml.safe_dump(
            {
                "seed": 1,
                "groups": {
                    "tartan": {
                        "output": {"split": "test", "sequences": 2},
                        "events": {"emulator": "esim", "contrast_threshold": {"uniform": [0.1, 0.2]}},
                        "preview": {"enabled": False},
                        "frames": {"folders": [f"{tartan}/P*"], "fps": 10, "max_px": 0.5, **frames},
                    }
                },
            }
        )
    )
    return load_run(path)


def test_conversion(tmp_path, tartan):
    outcome = run_dataset(recipe(tmp_path, tartan), tmp_path / "out")
    assert len(outcome.made) == 2 and not outcome.set_aside
    assert sorted(p.parent.name for p in (tmp_path / "out").glob("*/*/manifest.json")) == [
        "tartan_000000",
        "tartan_000001",
    ]
    folder = tmp_path / "out/test/tartan_000000"
    # Label k is the flow from frame k + 1, which has an interval of events before it; the last frame has no flow.
    assert (folder / "images/timestamps.txt").read_text().split() == ["100000", "200000", "300000", "400000", "500000"]
    lines = (folder / "flow/forward_timestamps.txt").read_text().splitlines()[1:]
    assert lines == [f"{100_000 * (k + 1)}, {100_000 * (k + 2)}" for k in range(4)]
    for k in range(4):
        flow, valid = read_flow_png(folder / f"flow/forward/{k:06d}.png")
        assert valid.all() and np.abs(flow - np.float32(SHIFT) * (1 + 0.1 * (k + 1))).max() <= 0.5 / 128 + 1e-6
        assert read_mask(folder / f"occlusion/forward/{k:06d}.png").sum() == 2 * H
        given = cv2.imread(str(tartan / f"P000/image_left/{k + 1:06d}_left.png"))
        np.testing.assert_array_equal(cv2.imread(str(folder / f"images/{k:06d}.png")), given)
    with h5py.File(folder / "events.h5") as file:
        t = file["events/t"][...]
        assert np.histogram(t, np.arange(6) * 100_000)[0].min() > 200, "events in every interval"
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["frames"] > N and manifest["source"]["images"] == N, "motion interpolation made steps in between"
    assert verify_dataset(tmp_path / "out", deep=2).deep == ["test/tartan_000000", "test/tartan_000001"]
    assert verify_dataset(tmp_path / "out", deep=2).clean
    config = yaml.safe_load((folder / "config.yaml").read_text())
    assert config["frames"]["folders"][0].endswith("P000"), "the sequence's own configuration names its folder"


@pytest.mark.parametrize(
    "frames, error, message",
    [
        ({"folders": ["nowhere*"]}, ConfigError, "frames.folders.0: in group 'tartan': no such folder"),
        ({"folders": []}, ConfigError, "frames.folders: in group 'tartan': no folders of frames"),
        ({"images": "image_right"}, ConfigError, "frames.images: in group 'tartan': no such folder"),
    ],
)
def test_bad_folders_are_found_before_any_work(tmp_path, tartan, frames, error, message):
    with pytest.raises(error) as raised:
        run_dataset(recipe(tmp_path, tartan, **frames), tmp_path / "out")
    assert message in str(raised.value) and not (tmp_path / "out").exists()


def test_too_few_folders(tmp_path, tartan):
    template = recipe(tmp_path, tartan)
    template.tree["groups"]["tartan"]["output"]["sequences"] = 3
    with pytest.raises(ConfigError, match="2 folders are too few for sequence 2"):
        run_dataset(template, tmp_path / "out")


@pytest.mark.parametrize(
    "damage, message",
    [
        (lambda t: [p.unlink() for p in sorted((t / "image_left").iterdir())[2:]], "too few frames"),
        (lambda t: (t / "flow/000001_000002_flow.npy").unlink(), "not one flow file per pair of frames"),
        (
            lambda t: np.save(t / "flow/000002_000003_flow.npy", np.zeros((4, 4, 2), np.float32)),
            "flow and image differ in size",
        ),
        (lambda t: np.save(t / "flow/000002_000003_flow.npy", np.zeros((3, 4, 5), np.float32)), "not a flow field"),
        (lambda t: shutil.rmtree(t / "flow"), "no such folder"),
        (lambda t: (t / "image_left/000003_left.png").write_bytes(b"no image"), "000003_left.png"),
    ],
)
def test_a_folder_that_cannot_be_used_is_set_aside(tmp_path, tartan, damage, message):
    copy = Path(shutil.copytree(tartan, tmp_path / "copy"))
    damage(copy / "P001")
    outcome = run_dataset(recipe(tmp_path, copy), tmp_path / "out")
    assert list(outcome.set_aside) == ["test/tartan_000001"] and message in outcome.set_aside["test/tartan_000001"]
    assert [p.parent.name for p in (tmp_path / "out").rglob("*.h5")] == ["tartan_000000"]


def test_white_of_twelve_bits_in_sixteen_is_asked_for(tmp_path, tartan):
    """What is proposed is the key that reads them, to the events of the same light in 8 bits."""
    deep = shutil.copytree(tartan, tmp_path / "deep")
    for path in deep.rglob("*.png"):
        cv2.imwrite(str(path), (cv2.imread(str(path)).astype(np.uint32) * 4095 // 255).astype(np.uint16))
    with pytest.raises(BlinkGLError, match="no code of white is stated .* 4095 of 12 bits.*white_level in a recipe"):
        run_dataset(recipe(tmp_path, deep), tmp_path / "asked")
    run_dataset(recipe(tmp_path, deep, white_level=4095), tmp_path / "out")
    run_dataset(recipe(tmp_path, tartan), tmp_path / "usual")
    counts = [read_manifest(tmp_path / name / "test/tartan_000000")["events"] for name in ("out", "usual")]
    assert counts[0] == pytest.approx(counts[1], rel=0.02) and counts[1] > 100


def test_an_extension_that_fails_keeps_the_records_of_what_is_there(tmp_path, tartan):
    copy = Path(shutil.copytree(tartan, tmp_path / "copy"))
    (copy / "P001/image_left/000003_left.png").write_bytes(b"no image")
    recipe(tmp_path, copy)
    numbers = [f"groups.tartan.output={{split: test, sequences: 1, first_index: {k}}}" for k in (0, 1)]
    first, second = (load_run(tmp_path / "recipe.yaml", [override]) for override in numbers)
    run_dataset(first, tmp_path / "out")
    before = (tmp_path / "out/index.jsonl").read_bytes(), (tmp_path / "out/.run/costs.jsonl").read_bytes()
    with pytest.raises(BlinkGLError, match="000003_left.png: cannot decode image"):
        run_dataset(second, tmp_path / "out", resume=True)
    after = (tmp_path / "out/index.jsonl").read_bytes(), (tmp_path / "out/.run/costs.jsonl").read_bytes()
    assert after == before and (tmp_path / "out/test/tartan_000000/manifest.json").is_file()
    assert list(json.loads((tmp_path / "out/.run/failed.json").read_text())) == ["test/tartan_000001"]
    # The same failure without an earlier run leaves nothing in the way of another recipe.
    with pytest.raises(BlinkGLError):
        run_dataset(second, tmp_path / "new")
    assert not (tmp_path / "new/.run/run.json").exists()


def test_a_split_and_a_sequence_are_made_again_from_the_folder_of_their_run(tmp_path, tartan, monkeypatch):
    """Relative paths of a recipe start from where it lay, whichever part of the set is verified, and from where."""
    template = recipe(tmp_path, tartan)
    template.tree["groups"]["tartan"]["frames"]["folders"] = ["P*"]
    run_dataset(RunTemplate(template.tree, tartan), tmp_path / "out", num=1)
    monkeypatch.chdir(tmp_path)
    for part in ("out", "out/test", "out/test/tartan_000000"):
        result = verify_dataset(part, deep=1)
        assert result.clean and len(result.deep) == 1, (part, result.problems)
