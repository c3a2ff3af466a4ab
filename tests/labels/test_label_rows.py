"""What each row of labels says of its values and files, by plain arrays. That rows can be added: test_seams.py."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from blinkgl.config.labels import LabelsConfig
from blinkgl.labels import LABELS, Flow, Flows, LabelFrame, LabelRequest, Occlusions, asked_for, grading, label_of
from blinkgl.render.occlusion import flow_and_reach
from blinkgl.types.boxes import Boxes, no_boxes

H, W = 4, 5


def whole(name: str):
    """A value that is right, of (H, W) px."""
    label = LABELS[name]
    if name == "boxes":
        arrays = {key: np.ones((1, *array.shape[1:]), array.dtype) for key, array in no_boxes().items()}
        return Boxes(**arrays, resolution=np.array([W, H]))
    if name == "flow_intervals":
        return Flows(0, np.array([1, 2]), np.ones((2, H, W, 2), np.float32), np.ones((2, H, W), bool))
    if name == "occlusion_intervals":
        return Occlusions(0, np.array([1, 2]), np.ones((2, H, W), bool))
    if name.startswith("flow"):
        return Flow(np.ones((H, W, 2), np.float32), np.ones((H, W), bool))
    channels = 3 if label.channels is None else label.channels
    return np.ones((H, W, channels) if channels else (H, W), np.float32 if label.dtype is None else label.dtype)


# --- configuration ----------------------------------------------------------------------------------------------------


def test_each_is_asked_for_by_its_own_name_in_python():
    """And asks for no other, but for what it cannot be without."""
    for name, label in LABELS.items():
        tree: dict = {"images": False, "flow": [], "occlusion": False}
        label.ask(tree)
        if name.startswith("occlusion"):
            tree["flow"] = [label.towards or 0.5]
        got = set(asked_for(LabelsConfig(**tree)))
        assert got - {f"flow_{label.towards or 'intervals'}"} <= {name} and name in got
    said = {name: label.said for name, label in LABELS.items()}
    assert said["flow_forward"] == "forward" and said["flow_backward"] == "backward" and said["depth"] == "depth"
    assert said["occlusion_forward"] == said["occlusion_backward"] == "occlusion"
    tree = {"flow": ["forward"]}
    LABELS["flow_backward"].ask(tree)
    assert tree == {"flow": ["forward", "backward"]}


def test_a_request_knows_what_has_to_be_drawn():
    request = LabelRequest("occlusion_forward", "images", "depth", "depth")
    assert list(request) == ["images", "depth", "occlusion_forward"] and "depth" in request and "ids" not in request
    assert set(request.buffers) == {"depth", "flow_forward", "ids"} and set(request.there) == {"depth", "ids"}
    assert request == LabelRequest("depth", "images", "occlusion_forward") != LabelRequest("depth")
    assert hash(request) == hash(LabelRequest(*request)) and request != "depth" and not LabelRequest()
    assert list(request.without("depth", "ids")) == ["images", "occlusion_forward"]
    assert LabelRequest("images").buffers == LabelRequest("images").there == ()
    assert repr(request) == "LabelRequest('images', 'depth', 'occlusion_forward')"
    with pytest.raises(KeyError, match="no label 'deep'; there are images, depth"):
        label_of("deep")


def test_a_frame_has_what_was_asked_for_and_none_for_the_rest():
    flow, mask = whole("flow_backward"), np.zeros((H, W), bool)
    frame = LabelFrame(7, {"images": 1, "flow_backward": flow, "occlusion_backward": mask})
    assert frame.t_ns == 7 and frame.colour == frame.images == 1 and frame.depth is frame.forward is None
    assert frame.backward.flow is flow.flow and frame.backward.valid is flow.valid and frame.backward.occluded is mask
    assert set(LABELS) < set(dir(frame)) and "forward" in dir(frame)
    with pytest.raises(AttributeError, match="no label 'fame'"):
        frame.fame  # noqa: B018


# --- files ------------------------------------------------------------------------------------------------------------

FLOW = ("flow/{}/000007.png", "flow/{}_npy/000007.npy", "flow/{}_flo/000007.flo")
FILES = {
    "images": ["images/000007.png"],
    "flow_forward": [name.format("forward") for name in FLOW],
    "flow_backward": [name.format("backward") for name in FLOW],
    "occlusion_forward": ["occlusion/forward/000007.png"],
    "occlusion_backward": ["occlusion/backward/000007.png"],
    "flow_intervals": ["flow/intervals/000007.h5"],
    "occlusion_intervals": ["occlusion/intervals/000007.h5"],
    "semantics": ["semantics/000007.png"],
    "boxes": ["boxes/000007.npz", "boxes_kitti/000007.txt"],
    "depth": ["depth/000007.npy"],
    "disparity": ["disparity/000007.npy"],
    "ids": ["ids/000007.png"],
    "normals": ["normals/000007.npy"],
    "velocity": ["velocity/000007.npy"],
    "scene_flow": ["scene_flow/000007.npy"],
}
"""The layout that docs/ and DSEC's loaders know."""


# --- values -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", LABELS)
def test_a_value_of_another_shape_or_kind_is_refused(name):
    label, value = LABELS[name], whole(name)
    assert label.wrong(value, H, W) is None
    for height, width in ((W, H), (H + 1, W), (H, W - 1)):
        assert f"not {width}x{height} px" in label.wrong(value, height, width)
    if name.endswith("_intervals") or name == "boxes":
        return
    if name.startswith("flow"):
        assert label.wrong(Flow(value.flow[..., :1], value.valid), H, W) and label.wrong(
            Flow(value.flow, value.flow), H, W
        )
        return
    more = np.ones((H, W, 4), value.dtype)
    assert f"{more.shape} {more.dtype} and not (4, 5" in label.wrong(more, H, W)
    other = value.astype(complex)
    assert (label.wrong(other, H, W) is None) == (label.dtype is None)
    if value.dtype.kind == "f" and label.dtype is not None:
        assert label.wrong(value > 0, H, W).endswith(" float32") and label.wrong(value.astype(np.float64), H, W) is None
    if name == "images":
        assert label.wrong(value[..., 0], H, W) is None and label.wrong(value[..., :2], H, W)


def buffers(**raw):
    return SimpleNamespace(
        raw=lambda name: raw[name],
        value=lambda name: LABELS[name].finish(buffers(**raw)),
        flow=lambda name: Flow(*flow_and_reach(raw[name])),
    )


def test_what_the_shader_writes_becomes_the_value():
    raw = np.zeros((1, 4, 4), np.float32)
    raw[0, :, :2], raw[0, :, 2], raw[0, :, 3] = (3, -4), (1, 0, -1, 2), (1, 1, 1, 0)
    flow = LABELS["flow_forward"].finish(buffers(flow_forward=raw))
    assert flow.valid.tolist() == [[True, False, False, False]], "hit, and in front of the camera then"
    assert flow.flow[0].tolist() == [[3, -4], [0, 0], [0, 0], [0, 0]] and flow.flow.dtype == np.float32
    depth = LABELS["depth"].finish(buffers(depth=np.array([[0, -1, 2]], np.float32)))
    assert depth.tolist() == [[np.inf, np.inf, 2]] and depth.dtype == np.float32
    normals = LABELS["normals"].finish(buffers(normals=raw))
    assert np.array_equal(normals, raw[..., :3]) and normals.flags.c_contiguous
    assert LABELS["ids"].finish(buffers(ids=raw)) is raw


# --- how far from the reference ---------------------------------------------------------------------------------------


def test_errors_are_of_the_label_s_own_kind():
    inf = np.inf
    drawn, true = np.array([[1, inf, inf, 5]]), np.array([[1.5, inf, 2, inf]])
    assert grading.absolute(drawn, true, 1).tolist() == [[0.5, 0, inf, inf]]
    assert grading.relative(drawn, true, 1).tolist() == [[pytest.approx(1 / 3), 0, inf, 1]]
    assert grading.different(drawn, true, 1).tolist() == [[1, 0, 1, 1]]
    vectors = np.array([[[3.0, 4, 0], [inf, 0, 0]]])
    assert grading.absolute(vectors, np.array([[[0.0, 0, 0], [inf, 0, 0]]]), 1).tolist() == [[5, 0]]
    for at, expected in ((0, 5), (60, 5), (100, 5), (200, 2.5), (1000, 0.5)):
        true = np.array([[[float(at), 0]]])
        assert grading.motion(true + [3, 4], true, 1)[0, 0] == pytest.approx(expected)
        assert grading.motion_per_interval((true + [3, 4]) * 20, true * 20, 0.05)[0, 0] == pytest.approx(expected)
    assert grading.length(np.array([[-2.0]])).tolist() == [[2]] and grading.length(np.array([[[3, 4]]])).tolist() == [
        [5]
    ]


def test_what_the_reference_says():
    """0 or inf where nothing is hit, normals in the camera's axes."""
    hit = np.array([[True, False]])
    turn = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    pose = np.eye(4)
    pose[:3, :3] = turn
    scene = SimpleNamespace(
        camera_path=SimpleNamespace(pose=lambda t: pose if t == 9 else None),
        camera=SimpleNamespace(rays=lambda xy: np.array([[0.0, 0, 1], [0, 0, 1]])),
    )
    ways = Flow(np.ones((1, 2, 2)), hit, ~hit)
    frame = SimpleNamespace(
        t_ns=9,
        hit=hit,
        normal=np.ones((1, 2, 3)) * (0, 0, -1) @ turn.T,
        xy=np.zeros((1, 2, 2)),
        velocity=np.ones((1, 2, 2)),
        depth=3,
        instance=4,
        forward=ways,
    )
    says = lambda name, which=0: LABELS[name].views[which].reference(scene, frame)
    assert says("normals").tolist() == [[[0, 0, -1], [0, 0, 0]]]
    assert says("velocity").tolist() == [[[1, 1], [0, 0]]] and says("depth") == 3 and says("ids") == 4
    assert says("flow_forward").tolist() == [[[1, 1], [0, 0]]] and says("flow_forward", 1) is hit
    assert np.array_equal(says("occlusion_forward"), ~hit)


def test_a_label_that_shows_itself_in_its_own_way_needs_no_reference():
    """Then whoever asks for one all the same is told."""
    with pytest.raises(NotImplementedError):
        LABELS["images"].reference(None, None)
    assert LABELS["images"].views == ()


def test_disparity_is_f_b_over_z_of_any_sign_of_b():
    """Without another eye it is 0, and 0 where nothing is hit."""
    depth = np.array([[0.0, 2.0, 4.0]], np.float32)

    def of(baseline):
        scene = SimpleNamespace(
            camera=SimpleNamespace(disparity=lambda z, b: 80.0 * b / z), sensors=[SimpleNamespace(baseline=baseline)]
        )
        drawn = SimpleNamespace(scene=scene, raw=lambda name: depth)
        return LABELS["disparity"].finish(drawn), LABELS["disparity"].reference(scene, SimpleNamespace(depth=depth))

    for baseline in (0.1, -0.1):
        drawn, true = of(baseline)
        assert drawn.dtype == np.float32 and drawn.tolist() == [[0, 4, 2]] and true.tolist() == [[0, 4, 2]]
    assert not of(None)[0].any()


@pytest.mark.parametrize("name", ["flow_intervals", "occlusion_intervals"])
def test_intervals_come_back_from_their_file(name, tmp_path):
    """Their time, too, which the file has in whole µs."""
    (form,) = LABELS[name].forms
    value = replace(whole(name), t_ns=7_000_000)
    (tmp_path / "one.h5").write_bytes(form.encode(value))
    back = form.read(tmp_path / "one.h5")
    assert back.t_ns == value.t_ns
    for key in ("interval_ns", *LABELS[name].arrays):
        np.testing.assert_array_equal(getattr(back, key), getattr(value, key))


def test_a_shipped_label_has_its_key_in_the_configuration():
    """A key that registration adds is in no documentation."""
    for name in LabelsConfig.added:
        module = type(LABELS[name]).__module__ if name in LABELS else ""
        assert not module.startswith("blinkgl."), f"give LabelsConfig a field {name}, blinkgl/config/labels.py"
