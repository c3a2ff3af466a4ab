"""Recorded frames as a sequence: which files belong together, what is refused, what each item says."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from blinkgl.config.frames import FramesConfig
from blinkgl.config.run import load_run
from blinkgl.errors import AssetError, ConfigError
from blinkgl.sequence import GroundTruth, simulate_sequence
from blinkgl.sequence.recorded import matching_folders
from blinkgl.sequence.request import SequenceRequest
from tests.refusals import refusal

H, W, N, FPS = 6, 8, 5, 20


@pytest.fixture
def clip(tmp_path) -> Path:
    """Five colour frames that get brighter, each with an opaque alpha; flow (k, -k) from frame k; k pixels masked."""
    folder = tmp_path / "clip"
    for name in ("image_left", "flow"):
        (folder / name).mkdir(parents=True)
    for k in range(N):
        image = np.full((H, W, 4), 40 * (k + 1), np.uint8)
        image[..., 0], image[..., 3] = 9, 255
        cv2.imwrite(str(folder / f"image_left/{k}.png"), image)
        if k < N - 1:
            np.save(folder / f"flow/{k}_flow.npy", np.full((H, W, 2), (k, -k), np.float32))
            mask = np.zeros((H, W), np.uint8)
            mask.flat[:k] = 100
            np.save(folder / f"flow/{k}_mask.npy", mask)
    (folder / "image_left/.hidden.png").write_bytes(b"")
    (folder / "image_left/notes.txt").write_text("not an image")
    (folder / "image_left/5.png").mkdir()
    return folder


def opened(clip: Path, index: int = 0, folders=("clip",), tree=None, **wanted):
    path = clip.parent / "run.yaml"
    frames = wanted.pop("frames", {})
    path.write_text(
        yaml.safe_dump(
            {
                "frames": {
                    "folders": list(folders),
                    "fps": FPS,
                    "interpolate": "linear",
                    "max_displacement": None,
                    **frames,
                },
                "events": {"emulator": "esim", "contrast_threshold": 0.1},
                **(tree or {}),
            }
        )
    )
    return simulate_sequence(SequenceRequest(load_run(path).sequence(0), index, base=clip.parent, **wanted))


def truths(sequence) -> list[GroundTruth]:
    return [item for item in sequence if isinstance(item, GroundTruth)]


@pytest.mark.parametrize("first, count, used", [(0, None, 5), (1, None, 4), (0, 3, 3), (2, 3, 3), (1, 4, 4)])
def test_a_label_is_of_the_frame_after_its_interval(clip, first, count, used):
    sequence = opened(clip, frames={"first": first, "count": count})
    assert (sequence.height, sequence.width, sequence.t0_ns, sequence.t1_ns) == (H, W, 0, (used - 1) * 50_000_000)
    labels = truths(sequence)
    assert [t.k for t in labels] == list(range(used - 1)) and sequence.labels == used - 2 and sequence.frames == used
    for k, truth in enumerate(labels):
        number = first + k + 1
        assert (
            truth.t_ns == (k + 1) * 50_000_000 and truth.T_world_cam is truth.T_world_obj is truth.backward_ns is None
        )
        assert truth.frame.images.shape == (H, W, 3) and truth.frame.images[0, 0].tolist() == [
            40 * (number + 1)
        ] * 2 + [9]
        if k == used - 2:
            assert truth.forward_ns is truth.frame.forward is None
            continue
        assert truth.forward_ns == (k + 2) * 50_000_000 and truth.frame.forward.valid.all()
        assert (truth.frame.forward.flow == (number, -number)).all()
        assert np.flatnonzero(truth.frame.forward.occluded).tolist() == list(range(number))
    facts = sequence.facts()
    notes = facts["source"].pop("notes")
    assert notes[0] == ".hidden.png: hidden, so left out"
    assert notes[1] == "integer codes taken as sRGB (--gamma linear for a camera's raw frames)"
    assert facts == {
        "source": {
            "folder": "clip",
            "images": used,
            "first": f"{first}.png",
            "last": f"{first + used - 1}.png",
        }
    }
    assert sequence.poses() == {} and sequence.triangles == 0


@pytest.mark.parametrize("fps", [20, 29.97, 30, 1000 / 3])
def test_times_of_frames_do_not_drift(clip, fps):
    sequence = opened(clip, frames={"fps": fps}, events=False)
    assert [t.t_ns for t in sequence] == [round(k / fps * 1e9) for k in range(1, N)]
    assert sequence.frames == 0 and sequence.losses == (0, 0, 0) and sequence.events == 0 and sequence.camera is None


@pytest.mark.parametrize("given", [{"window_ns": (0, 1)}, {"scene": object()}, {"renderer": object()}])
def test_nothing_is_drawn_of_them(clip, given):
    refusal(ConfigError, opened, clip, match="frames: recorded frames are not drawn", **given)


@pytest.mark.parametrize(
    "gone, frames, said",
    [
        ("3_flow", {}, "3 flow files, 4 masks'.; expected at least 4 for 5 frames"),
        ("3_mask", {}, "4 flow files, 3 masks'.; expected at least 4 for 5 frames"),
        ("3_flow", {"first": 2}, "1 flow files, 4 masks"),
        ("3_mask", {"first": 2}, "2 flow files, 3 masks"),
        ("3_flow", {"count": 4}, None),
        ("3_mask", {"count": 4}, None),
        ("3_mask", {"first": 1, "count": 3}, None),
        ("1_flow", {"count": 4}, "2_flow.npy: the files do not match the frames.*go with 1.png"),
        ("1_mask", {"count": 4}, "2_mask.npy: the files do not match the frames"),
        ("0_flow", {"count": 4}, "1_flow.npy: the files do not match the frames"),
    ],
)
def test_a_flow_file_for_every_pair_that_is_used(clip, gone, frames, said):
    (clip / f"flow/{gone}.npy").unlink()
    if said:
        refusal(AssetError, opened, clip, frames=frames, match=said)
    else:
        number = frames.get("first", 0) + 1
        assert truths(opened(clip, frames=frames))[0].frame.forward.flow[0, 0, 0] == number


def test_frames_too_far_apart_are_refused(clip):
    """The last pair's flow is (3, -3) everywhere."""
    assert len(opened(clip, frames={"max_displacement": 4.3}).files) == 5
    with pytest.raises(
        AssetError, match=r"3.png: too far from the next frame .*got '4.24 px'.; expected at most 4.2 px"
    ):
        opened(clip, frames={"max_displacement": 4.2})


@pytest.mark.parametrize("what, shape", [("flow", (H, W + 1, 2)), ("flow", (W, H, 2)), ("mask", (H + 1, W))])
def test_labels_of_another_size_are_named(clip, what, shape):
    np.save(clip / f"flow/2_{what}.npy", np.zeros(shape, np.float32 if what == "flow" else np.uint8))
    refusal(AssetError, list, opened(clip), match=rf"2_{what}.npy: {what} and image differ in size")


def test_one_folder_serves_every_sequence_and_several_one_each(clip):
    for k in (0, 7):
        assert opened(clip, k).folder == clip
    other = clip.parent / "other"
    (other / "image_left").mkdir(parents=True)
    for k in range(3):
        cv2.imwrite(str(other / f"image_left/{k}.png"), np.full((4, 4), k, np.uint8))
    both = {"folders": ("clip", "o*er"), "frames": {"flow": None}}
    assert [opened(clip, k, **both).folder.name for k in (0, 1)] == ["clip", "other"]
    assert opened(clip, 1, **both).config.frames.folders == ("other",), "its own configuration names its own folder"
    assert opened(clip, 1, **both).height == 4
    refusal(ConfigError, opened, clip, 2, match="2 folders are too few for sequence 2", **both)
    with pytest.raises(ConfigError, match=r"frames.folders.1: no such folder \(got 'no\*'\)"):
        opened(clip, 0, folders=("clip", "no*"))
    refusal(ConfigError, opened, clip, 0, folders=(), match="no folders of frames")


@pytest.mark.parametrize("place", ["set[1]", "a*b", "plain"])
def test_brackets_and_stars_in_the_name_of_a_place_are_no_pattern(tmp_path, place):
    for name in ("seq[2]", "seq3", "other"):
        (tmp_path / place / name / "image_left").mkdir(parents=True)
    found = lambda *patterns: [p.name for p in matching_folders(FramesConfig(folders=patterns), tmp_path / place)]
    assert found("seq[2]") == ["seq[2]"] and found("seq*") == ["seq3", "seq[2]"] and found("seq[[]2]") == ["seq[2]"]
    with pytest.raises(ConfigError, match="no such folder"):
        found("nothing*")
