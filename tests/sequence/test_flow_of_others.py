"""Frames and flow of other data sets, in their own folders and files, and flow that contradicts its images."""

from __future__ import annotations

import cv2
import h5py
import numpy as np
import pytest
import yaml

from blinkgl.config.run import load_run
from blinkgl.errors import AssetError, ConfigError
from blinkgl.io.flow import read_flow
from blinkgl.sequence import GroundTruth, simulate_sequence
from blinkgl.sequence.request import SequenceRequest
from tests.refusals import refusal

H, W, COUNT = 48, 64, 12
MOTION = (3.0, -1.5)
BIG = cv2.GaussianBlur(np.random.default_rng(0).random((200, 300)).astype(np.float32), (0, 0), 2.0)
BIG = cv2.normalize(BIG, None, 20, 235, cv2.NORM_MINMAX)


def picture(k: int) -> np.ndarray:
    """(H, W, 3) uint8: everything moves by MOTION from one frame to the next."""
    x, y = np.meshgrid(np.arange(W, dtype=np.float32), np.arange(H, dtype=np.float32))
    grey = cv2.remap(BIG, x + 120 - MOTION[0] * k, y + 70 - MOTION[1] * k, cv2.INTER_CUBIC)
    return np.repeat(np.clip(np.rint(grey), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def field(factor: float = 1.0) -> np.ndarray:
    return np.broadcast_to(np.float32(MOTION) * np.float32(factor), (H, W, 2)).copy()


def quantised(scale: float):
    """A writer of KITTI's and DSEC's PNGs: R and G are 2^15 + flow * scale, B is 1."""

    def write(path, flow):
        codes = np.rint(flow * scale + 32768).astype(np.uint16)
        cv2.imwrite(str(path), np.dstack([np.ones((H, W), np.uint16), codes[..., 1], codes[..., 0]]))

    return write


def tartanair2(path, flow):
    codes = np.rint(flow * 64 + 32768).astype(np.uint16)
    cv2.imwrite(str(path), np.dstack([codes, np.zeros((H, W), np.uint16)]))  # OpenCV writes the last channel first


def vkitti2(path, flow):
    codes = np.rint((flow / [W - 1, H - 1] + 1) / 2 * 65535).astype(np.uint16)
    cv2.imwrite(str(path), np.dstack([np.full((H, W), 65535, np.uint16), codes[..., 1], codes[..., 0]]))


def flo(path, flow):
    path.write_bytes(b"PIEH" + np.array([W, H], "<i4").tobytes() + flow.astype("<f4").tobytes())


def pfm(path, flow):
    data = np.dstack([flow, np.zeros((H, W), np.float32)])[::-1]
    path.write_bytes(f"PF\n{W} {H}\n-1.0\n".encode() + data.astype("<f4").tobytes())


def flo5(path, flow):
    with h5py.File(path, "w") as file:
        file.create_dataset("flow", data=flow.repeat(2, 0).repeat(2, 1), compression="gzip")


SETS = {
    "tartanair2": ("{}/P001/image_lcam_front/{:06d}_lcam_front.png", "{}/P001/flow_lcam_front/{:06d}_{:06d}_flow.png",
                   tartanair2, "P001"),
    "sintel": ("{}/training/final/alley_1/frame_{:04d}.png", "{}/training/flow/alley_1/frame_{:04d}.flo", flo,
               "training/final/alley_1"),
    "spring": ("{}/train/0001/frame_left/frame_left_{:04d}.png", "{}/train/0001/flow_FW_left/flow_FW_left_{:04d}.flo5",
               flo5, "train/0001"),
    "flyingthings3d": ("{}/frames_cleanpass/TRAIN/A/0000/left/{:04d}.png",
                       "{}/optical_flow/TRAIN/A/0000/into_future/left/OpticalFlowIntoFuture_{:04d}_L.pfm", pfm,
                       "frames_cleanpass/TRAIN/A/0000/left"),
    "virtual_kitti2": ("{}/Scene01/clone/frames/rgb/Camera_0/rgb_{:05d}.jpg",
                       "{}/Scene01/clone/frames/forwardFlow/Camera_0/flow_{:05d}.png", vkitti2, "Scene01/clone/frames"),
}  # fmt: skip


@pytest.mark.parametrize("name", SETS)
def test_a_set_in_its_own_folders(tmp_path, name):
    images, flows, write, folder = SETS[name]
    for k in range(COUNT):
        for pattern, put in (
            (images, lambda p, k=k: cv2.imwrite(str(p), picture(k))),
            (flows, lambda p: write(p, field())),
        ):
            path = tmp_path / pattern.format("set", k + 6, k + 7)
            path.parent.mkdir(parents=True, exist_ok=True)
            if pattern == images or k < COUNT - 1:
                put(path)
    run = load_run(name, [f"frames.folders=[{tmp_path}/set/{folder}]", "frames.max_displacement=null"])
    made = simulate_sequence(SequenceRequest(run.sequence(0), 0, base=tmp_path))
    labels = [item for item in made if isinstance(item, GroundTruth)]
    assert len(labels) == COUNT - 1 and made.events > 1000
    for label in labels[:-1]:
        assert np.abs(label.frame.forward.flow - MOTION).max() < 0.02 and label.frame.forward.valid.all()


def recorded(tmp_path, write, flow, ending="png", **frames):
    for k in range(COUNT):
        for sub in ("images", "flow"):
            (tmp_path / "clip" / sub).mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(tmp_path / f"clip/images/frame{k}.png"), picture(k))
        if k < COUNT - 1:
            write(tmp_path / f"clip/flow/frame{k}.{ending}", flow)
    tree = {
        "folders": ["clip"],
        "images": "images",
        "fps": 20,
        "interpolate": "linear",
        "max_displacement": None,
        **frames,
    }
    (tmp_path / "run.yaml").write_text(yaml.safe_dump({"frames": tree, "labels": {"flow": ["forward"]}}))
    return simulate_sequence(SequenceRequest(load_run(tmp_path / "run.yaml").sequence(0), 0, base=tmp_path))


@pytest.mark.parametrize(
    ("write", "flow", "ending", "said"),
    [
        (quantised(64), field(), "png", "2-fold"),  # KITTI's, read as DSEC's
        (flo, field(-1), "flo", "its negative"),
        (flo, field(2), "flo", "0.5-fold"),
        (flo, field(0.25), "flo", "2-fold"),
        (flo, field()[..., ::-1] * np.float32(4), "flo", "no motion at all|0.5-fold"),
    ],
    ids=["KITTI", "backward", "double", "quarter", "another"],
)
def test_flow_that_contradicts_its_images_stops_the_run(tmp_path, write, flow, ending, said):
    assert "frames.check_flow: false" in refusal(
        AssetError,
        recorded,
        tmp_path,
        write,
        flow,
        ending,
        match=f"the flow contradicts its images: .*({said}).*explains",
    )
    recorded(tmp_path, write, flow, ending, check_flow=False)


@pytest.mark.parametrize("form", ["dsec", "kitti"])
def test_sixteen_bits_are_whose_the_user_says(tmp_path, form):
    made = recorded(tmp_path, quantised(128 if form == "dsec" else 64), field(), flow_format=form)
    labels = [item for item in made if isinstance(item, GroundTruth)]
    assert np.abs(labels[0].frame.forward.flow - MOTION).max() < 0.02


def test_frames_and_flow_are_in_the_order_of_their_numbers(tmp_path):
    """Frames 0 to 11 without padding: by text 10 would follow 1, and the flow would contradict the images."""
    made = recorded(tmp_path, flo, field(), "flo")
    assert [file.name for file in made.files] == [f"frame{k}.png" for k in range(COUNT)]
    cv2.imwrite(str(tmp_path / "clip/images/mask.png"), picture(0))
    list(made := recorded(tmp_path, flo, field(), "flo"))
    assert any("mask.png: left out" in note for note in made.facts()["source"]["notes"])


def test_missing_frames_and_other_clocks_are_named(tmp_path):
    recorded(tmp_path, flo, field(), "flo")
    (tmp_path / "clip/timestamps.txt").write_text("\n".join(f"{k / 25:.3f}" for k in range(COUNT)))
    with pytest.raises(ConfigError, match=r"frames.fps: .*timestamps.txt says other times \(got 20.0\); expected 25"):
        recorded(tmp_path, flo, field(), "flo")
    recorded(tmp_path, flo, field(), "flo", fps=25)
    (tmp_path / "clip/timestamps.txt").unlink()
    for name in ("images/frame4.png", "flow/frame4.flo"):
        (tmp_path / "clip" / name).unlink()
    run = load_run(tmp_path / "run.yaml").sequence(0)
    with pytest.raises(AssetError, match="images: 1 frames are missing .after frame3.png.; expected every frame"):
        simulate_sequence(SequenceRequest(run, 0, base=tmp_path))


def test_forms_are_guessed_by_their_values(tmp_path):
    for name, write in (("kitti", quantised(64)), ("tartanair2", tartanair2), ("vkitti2", vkitti2)):
        write(tmp_path / f"{name}.png", field())
        flow, valid = read_flow(tmp_path / f"{name}.png", name)
        assert np.abs(flow - MOTION).max() < 0.02 and valid.all()


@pytest.mark.parametrize("one_each", [False, True], ids=["a pair", "a frame"])
def test_flow_to_the_frame_before(tmp_path, one_each):
    """By the names (said), or as declared: the label of frame n is the flow that begins there."""
    recorded(tmp_path, flo, field(), "flo")
    folder = (tmp_path / "clip/flow").rename(tmp_path / "clip/flow_backward")
    numbers = range(COUNT) if one_each else range(1, COUNT)
    for path in folder.iterdir():
        path.unlink()
    for n in numbers:
        flo(folder / f"frame{n}.flo", field(-1) * np.float32(1 + n / 100))

    def sequence(labels=("backward",), **frames):
        tree = yaml.safe_load((tmp_path / "run.yaml").read_text())
        tree = {"frames": tree["frames"] | {"flow": "flow_backward", **frames}, "labels": {"flow": list(labels)}}
        (tmp_path / "run.yaml").write_text(yaml.safe_dump(tree))
        return simulate_sequence(SequenceRequest(load_run(tmp_path / "run.yaml").sequence(0), 0, base=tmp_path))

    made = sequence()
    labels = [item for item in made if isinstance(item, GroundTruth)]
    assert any("flow to the frame before, as the names say" in note for note in made.facts()["source"]["notes"])
    for k, label in enumerate(labels[:-1]):
        expected = -np.float32(MOTION) * np.float32(1 + (k + 1) / 100)
        assert np.abs(label.frame.backward.flow - expected).max() < 1e-5 and label.frame.forward is None
        assert (label.backward_ns, label.t_ns) == (k * 50_000_000, (k + 1) * 50_000_000)
    assert len(labels) == COUNT - 1 and made.labels == COUNT - 2
    with pytest.raises(AssetError, match=r"its negative \(frames.flow_direction: backward\?\)"):
        sequence(["forward"], flow_direction="forward")
    with pytest.raises(ConfigError, match=r"labels.flow: the flow of these frames leads backward \(got \['forward'\]"):
        sequence(["forward"], flow_direction="backward")
    if not one_each:
        (folder / "frame5.flo").unlink()
        with pytest.raises(AssetError, match="flow_backward: not one flow file per pair of frames"):
            sequence(flow_direction="auto")


def test_flow_without_a_valid_pixel(tmp_path):
    invalid = lambda path, flow: np.save(path, np.dstack([flow, np.zeros((H, W), np.float32)]))
    with pytest.raises(AssetError, match="frame0.npy: no pixel of the flow is valid"):
        recorded(tmp_path / "b", invalid, field(), "npy")
