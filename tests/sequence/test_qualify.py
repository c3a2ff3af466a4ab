"""Folders of frames are measured before they are converted: which qualify, why the others do not, and what is said of
folders that bring less."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from blinkgl.cli import run
from blinkgl.config.frames import FramesConfig, QualifyConfig
from blinkgl.config.run import load_run
from blinkgl.dataset.explain import explain
from blinkgl.dataset.run import run_dataset
from blinkgl.dataset.verify import verify_dataset
from blinkgl.errors import AssetError, EventDataError
from blinkgl.sequence.qualify import MEASURES, verdict

H, W, N = 48, 64, 5
NONE = dict.fromkeys(MEASURES)
"""No limit of any measure."""
STRICT = NONE | {"displacement": 3.0, "uncovered": 0.1, "residual": 0.1, "thin": 0.01, "astray": 0.2, "left_out": 0.9}


def folder(path: Path, *, px: float = 1.0, bar_px: int = 0, bar: int = 3, size: tuple[int, int] = (H, W)) -> Path:
    """A smooth texture that slides by ``px`` a frame, and before it a dark bar, ``bar`` px wide, that moves by
    ``bar_px``; flow there and back, and masks beside the flow."""
    height, width = size
    for name in ("image_left", "flow", "back", "bare"):
        (path / name).mkdir(parents=True)
    texture = cv2.GaussianBlur(np.random.default_rng(1).random((height, 4 * width)).astype(np.float32), (0, 0), 2.5)
    texture = 0.2 + 0.6 * (texture - texture.min()) / np.ptp(texture)
    for k in range(N):
        move = np.float32([[1, 0, k * px - width], [0, 1, 0]])
        image = cv2.warpAffine(texture, move, (width, height), flags=cv2.INTER_LINEAR)
        if bar_px:
            image[:, 8 + k * bar_px : 8 + k * bar_px + bar] = 0.02
        cv2.imwrite(str(path / f"image_left/{k:06d}.png"), np.round(image * 255).astype(np.uint8))
    for k in range(N - 1):
        for name, sign, at in (("flow", 1, k), ("back", -1, k + 1)):
            flow = np.zeros((height, width, 2), np.float32)
            flow[..., 0] = sign * px
            if bar_px:
                flow[:, 8 + at * bar_px : 8 + at * bar_px + bar, 0] = sign * bar_px
            np.save(path / name / f"{k:06d}.npy", flow)
        shutil.copy(path / f"flow/{k:06d}.npy", path / "bare")
        mask = np.zeros((height, width), np.uint8)
        mask[:, -2:] = 1
        np.save(path / f"flow/{k:06d}_mask.npy", mask)
    return path


def config(**more) -> FramesConfig:
    return FramesConfig.model_validate({"qualify": STRICT, **more})


def recipe(path: Path, *folders: Path, **frames):
    tree = {
        "output": {"split": "test", "name": "tartan", "sequences": len(folders)},
        "events": {"emulator": "esim"},
        "preview": {"enabled": False},
        "frames": {"folders": [str(f) for f in folders], "fps": 10, "qualify": STRICT, **frames},
    }
    path.write_text(yaml.safe_dump(tree))
    return load_run(path)


def test_a_folder_that_moves_evenly_qualifies(tmp_path):
    found = verdict(config(backward="back"), folder(tmp_path / "P000"))
    assert found.qualifies and found.refusal() is None and not found.excesses and not found.absent
    assert [(p.number, p.first, p.second) for p in found.pairs] == [
        (k, f"{k:06d}.png", f"{k + 1:06d}.png") for k in range(N - 1)
    ]
    for pair in found.pairs:
        assert pair.values["displacement"] == 1 and pair.values["thin"] == 0 and pair.values["residual"] < 0.01
        assert pair.values["hidden"] == pair.values["uncovered"] == 1 / W
        assert pair.values["astray"] < 0.1 and pair.values["left_out"] < 0.5
    assert found.worst["displacement"] == 1
    assert found.facts() == {
        "pairs": N - 1,
        "beyond_limits": 0,
        "largest": {name: float(f"{value:.4g}") for name, value in found.worst.items()},
        "limits": QualifyConfig(**STRICT).model_dump(),
    }


def test_a_refusal_names_the_pair_the_measure_the_value_and_the_limit(tmp_path):
    where = folder(tmp_path / "P001", bar_px=6)
    found = verdict(config(qualify={**NONE, "thin": 0.01}), where)
    assert not found.qualifies and found.refused == N - 1
    assert {(e.measure, e.limit) for e in found.excesses} == {("thin", 0.01)}
    assert str(found.refusal()) == (
        f"{where}: 000000.png to 000001.png: cannot be interpolated: thin things move on their own: thin 4.69 %; "
        "beyond a limit: 4 of 4 pairs; expected at most 1 % (frames.qualify.thin), or frames.qualify: null to convert "
        "them all the same"
    )


def test_the_pair_that_is_named_is_the_one_farthest_beyond(tmp_path):
    where = folder(tmp_path / "P000")
    flow = np.load(where / "flow/000002.npy")
    np.save(where / "flow/000002.npy", 5 * flow)
    found = verdict(config(qualify={**NONE, "displacement": 3}), where)
    assert found.refused == 1 and "000002.png to 000003.png" in str(found.refusal())
    assert "displacement 5 px; expected at most 3 px" in str(found.refusal())
    for share, qualifies in ((0.25, True), (0.2, False)):
        limits = {**NONE, "displacement": 3, "tolerated": share}
        assert verdict(config(qualify=limits), where).qualifies == qualifies


def test_a_limit_of_nothing_and_a_value_of_nothing(tmp_path):
    found = verdict(config(qualify={**NONE, "thin": 0, "displacement": 0}), folder(tmp_path / "P000"))
    assert {e.measure for e in found.excesses} == {"displacement"}


def test_what_a_folder_does_not_bring_is_left_out_and_said(tmp_path):
    where = folder(tmp_path / "P000")
    every = {"displacement", "uncovered", "residual", "thin", "contradicted", "astray", "fine", "left_out"}
    for more, there, why in (
        ({"flow": "bare"}, every, {"hidden": "neither backward flow nor masks"}),
        ({}, every | {"hidden"}, {}),
        (
            {"flow": None},
            {"displacement", "contradicted", "fine", "left_out"},
            dict.fromkeys(("hidden", "uncovered", "residual", "thin", "astray"), "no flow"),
        ),
        (
            {"interpolate": "linear"},
            every - {"contradicted", "astray"} | {"hidden"},
            dict.fromkeys(("contradicted", "astray"), "the interpolation follows no flow"),
        ),
    ):
        found = verdict(config(**more), where)
        assert set(found.pairs[0].values) == there and found.absent == why, more
    masked = verdict(config(), where).pairs[0].values
    assert masked["hidden"] == 2 / W, "the masks' two columns"
    own = verdict(config(flow=None), where).pairs[0].values
    assert own["displacement"] == pytest.approx(1, abs=0.3), "of the flow that the interpolation finds"


def test_frames_too_small_for_dense_flow_are_measured_by_their_own(tmp_path):
    where = folder(tmp_path / "P000", size=(12, 40))
    assert set(verdict(config(), where).absent) == {"contradicted", "astray"}
    assert set(verdict(config(flow=None), where).pairs[0].values) == {"fine", "left_out"}


def test_the_guess_that_is_tried_is_the_interpolations(tmp_path):
    """A dense-flow warp guesses a texture that slides by 4 px; the mean of logs does not."""
    where = folder(tmp_path / "P000", px=4)
    warped, mean = (verdict(config(interpolate=kind), where).worst["left_out"] for kind in ("motion", "linear"))
    assert warped < 0.6 * mean


def test_still_frames_qualify(tmp_path):
    found = verdict(config(), folder(tmp_path / "P000", px=0))
    assert found.qualifies and found.worst["left_out"] == 0


def test_pixels_without_a_number_are_not_judged(tmp_path):
    where = folder(tmp_path / "P000")
    flow = np.load(where / "flow/000001.npy")
    flow[:20, 10:40] = np.nan
    np.save(where / "flow/000001.npy", flow)
    assert verdict(config(), where).pairs[1].values["displacement"] == 1
    np.save(where / "flow/000001.npy", np.full_like(flow, np.nan))
    with pytest.raises(AssetError, match=r"000001.npy: no valid vector in it; expected finite numbers, px"):
        verdict(config(), where)


@pytest.mark.parametrize(
    "damage, more, error, message",
    [
        (
            lambda p: np.save(p / "flow/000002.npy", np.zeros((4, 4, 2), np.float32)),
            {},
            AssetError,
            r"000002.npy: flow and image differ in size \(got \(4, 4\)\); expected \(48, 64\)",
        ),
        (
            lambda p: (p / "back/000002.npy").write_bytes((p / "back/000002.npy").read_bytes()[:200]),
            {"backward": "back"},
            AssetError,
            r"000002.npy: ",
        ),
        (
            lambda p: np.save(p / "back/000001.npy", np.zeros((H, W + 1, 2), np.float32)),
            {"backward": "back"},
            AssetError,
            r"back/000001.npy: flow and image differ in size",
        ),
        (
            lambda p: (p / "back/000001.npy").unlink(),
            {"backward": "back"},
            AssetError,
            r"back: not one flow file per pair of frames \(got '3 flow files, 0 masks'\); expected at least 4",
        ),
        (lambda p: shutil.rmtree(p / "back"), {"backward": "back"}, AssetError, r"back: no such folder"),
        (
            lambda p: [f.unlink() for f in sorted((p / "image_left").iterdir())[1:]],
            {},
            AssetError,
            r"image_left: too few frames \(got 1\); expected at least 3",
        ),
        (
            lambda p: cv2.imwrite(str(p / "image_left/000003.png"), np.zeros((H, W + 2), np.uint8)),
            {"flow": None},
            EventDataError,
            r"000003.png: frame size changed \(got \(48, 66\)\)",
        ),
        (
            lambda p: (p / "flow/000000.npy").write_bytes(b"no array"),
            {},
            AssetError,
            r"flow/000000.npy: ",
        ),
    ],
)  # fmt: skip
def test_folders_that_cannot_be_measured(tmp_path, damage, more, error, message):
    where = folder(tmp_path / "P000")
    damage(where)
    with pytest.raises(error, match=message):
        verdict(config(**more), where)


def test_light_that_is_no_number_is_refused(tmp_path):
    where = folder(tmp_path / "P000")
    shutil.rmtree(where / "image_left")
    (where / "image_left").mkdir()
    for k in range(N):
        image = np.full((H, W), 0.5, np.float32)
        image[7, 5] = np.nan if k == 2 else 0.5
        header = f"Pf\n{W} {H}\n-1\n".encode()
        (where / f"image_left/{k:06d}.pfm").write_bytes(header + image[::-1].tobytes())
    with pytest.raises((AssetError, EventDataError), match="000002.pfm"):
        verdict(config(gamma="linear"), where)


# ---- a run -----------------------------------------------------------------------------------------------------------


def test_what_does_not_qualify_is_set_aside_and_the_rest_is_made(tmp_path):
    good, bad = folder(tmp_path / "P000"), folder(tmp_path / "P001", bar_px=6)
    outcome = run_dataset(recipe(tmp_path / "r.yaml", good, bad), tmp_path / "out")
    assert len(outcome.made) == 1 and list(outcome.set_aside) == ["test/tartan_000001"]
    assert "000000.png to 000001.png: cannot be interpolated: thin" in outcome.set_aside["test/tartan_000001"]
    failed = json.loads((tmp_path / "out/.run/failed.json").read_text())
    assert failed == outcome.set_aside
    manifest = json.loads((tmp_path / "out/test/tartan_000000/manifest.json").read_text())
    assert manifest["qualified"]["largest"]["displacement"] == 1 and manifest["qualified"]["limits"]["thin"] == 0.01
    checked = verify_dataset(tmp_path / "out", deep=1)
    assert checked.deep == ["test/tartan_000000"] and list(checked.problems) == ["test/tartan_000001"]
    assert checked.problems["test/tartan_000001"][0].startswith("set aside: ")
    again = run_dataset(
        recipe(tmp_path / "s.yaml", bad, qualify=None), tmp_path / "all"
    )  # nobody asks: converted all the same
    assert len(again.made) == 1
    manifest = json.loads((tmp_path / "all/test/tartan_000000/manifest.json").read_text())
    assert "qualified" not in manifest


def test_explain_says_whether_it_qualifies(tmp_path):
    good, bad = folder(tmp_path / "P000"), folder(tmp_path / "P001", bar_px=6)
    template = recipe(tmp_path / "r.yaml", good, bad)
    assert explain(template, 0).scene["qualify"].startswith("yes; largest of 4 pairs: displacement 1 px, hidden ")
    said = explain(template, 1).scene["qualify"]
    assert said.startswith("no: ") and "thin 4.69 %" in said
    bare = explain(recipe(tmp_path / "b.yaml", good, flow="bare")).scene["qualify"]
    assert bare.endswith("; not measured: hidden (neither backward flow nor masks)")
    assert explain(recipe(tmp_path / "s.yaml", bad, qualify=None)).scene["qualify"].startswith("not looked at")


def test_the_command_that_is_gone_says_what_to_do(capsys):
    assert run(["qualify", "P000", "--pairs"]) == 2
    assert capsys.readouterr().err == (
        "error: qualify: frames are checked where they are converted; expected blinkgl explain CONFIG or generate\n"
    )
