"""Exports are opened by the published loaders' own code, where it is: BLINKGL_LOADERS is a folder with checkouts named
bflow, DSEC, E-RAFT, ETAP, co-tracker, Spike-FlowNet, EventNeRF and rpg_timelens (github.com: uzh-rpg/bflow,
uzh-rpg/DSEC, uzh-rpg/E-RAFT, tub-rip/ETAP, facebookresearch/co-tracker, chan8972/Spike-FlowNet, r00tman/EventNeRF,
uzh-rpg/rpg_timelens). BlinkFlow's loader is not public any more.

Each loader runs in a process of its own, because their packages share names. Replaced are only what an installation
without a network lacks: imageio's FreeImage plug-in reads PNG files by OpenCV, and packages that draw are empty."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]
SCENE = {
    "kind": "random",
    "objects": {"count": 3},
    "pool": {"primitives": ["cuboid"], "variants": 8, "test_fraction": 0.5},
    "textures": {
        "procedural": ["checks", "fbm"],
        "variants": 8,
        "photographs": False,
        "max_size": 64,
        "test_fraction": 0.5,
    },
}
BASE = {
    "seed": 5,
    "timeline": {"kind": "uniform", "fps": 60},
    "scene": SCENE,
    "events": {"emulator": "esim", "contrast_threshold": 0.2},
    "preview": {"enabled": False},
}
PRELUDE = """
import importlib.abc, importlib.machinery, sys, types
import cv2, hdf5plugin, imageio, numpy as np
sys.path.insert(0, sys.argv[1])
imageio.imread = lambda path, format=None: cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1].copy()
class Absent(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    # Stands for packages that draw, augment or train.
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("torchvision", "pytorch_lightning", "wandb", "kornia", "pandas", "mediapy"):
            return importlib.machinery.ModuleSpec(name, self, is_package=True)
    def create_module(self, spec):
        module = types.ModuleType(spec.name)
        def made(name):
            if name.startswith("__"):
                raise AttributeError(name)
            return type(name, (), {"__init__": lambda self, *a, **k: None})
        module.__getattr__, module.__path__ = made, []
        return module
    def exec_module(self, module):
        pass
sys.meta_path.append(Absent())
out = sys.argv[2]
"""


def checkout(name: str) -> Path:
    """The loader's folder; skips the calling test, saying so, where it is not."""
    folder = os.environ.get("BLINKGL_LOADERS")
    if not folder or not (Path(folder) / name).is_dir():
        pytest.skip(f"no checkout of {name} (set BLINKGL_LOADERS to a folder with it)")
    pytest.importorskip("torch")
    return Path(folder) / name


def loaded(name: str, data: Path, code: str) -> str:
    """What the loader's code prints."""
    done = subprocess.run(
        [sys.executable, "-c", PRELUDE + textwrap.dedent(code), str(checkout(name)), str(data)],
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.fixture(scope="module")
def export(tmp_path_factory):
    """A function: (layout, recipe, splits) -> folder of the export."""
    import yaml

    from blinkgl.config.run import load_run
    from blinkgl.dataset.run import run_dataset
    from blinkgl.layouts import export_layout

    def made(layout: str, recipe: dict, splits=("train",)) -> Path:
        folder = tmp_path_factory.mktemp(layout)
        for split in splits:
            (folder / "r.yaml").write_text(
                yaml.safe_dump({**BASE, **recipe, "output": {"split": split, "name": f"{split}_a"}})
            )
            run_dataset(load_run(folder / "r.yaml"), folder / "data", num=1, mixed=True)
        export_layout(folder / "data", folder / "out", layout)
        return folder / "out"

    return made


DSEC = {
    "camera": {"width": 640, "height": 480},
    "time": {"duration": 0.3, "label_rate": 10, "start": 7.0},
    "labels": {"flow": ["forward", "backward"]},
}


def test_bflows_dsec_provider(export):
    checkout("bflow")
    out = export("dsec", DSEC)
    said = loaded(
        "bflow",
        out,
        """
        from data.dsec.provider import DatasetProvider
        import data.dsec.subsequence.twostep as twostep, data.utils.generic as generic
        # Its load_flow takes OpenCV's BGR for RGB; that of DSEC's own scripts is the other order.
        twostep.load_flow = lambda p: generic._flow_16bit_to_float(cv2.imread(str(p), -1)[..., ::-1])
        options = dict(path=out, load_voxel_grid=True, extended_voxel_grid=True, normalize_voxel_grid=False)
        data = DatasetProvider(options, 15).get_train_dataset()
        for k in range(len(data)):
            sample = {key.name: value for key, value in data[k].items()}
            print(sample["FILE_INDEX"], tuple(sample["EV_REPR"].shape), int(sample["FLOW_VALID"].sum()) > 0)
        """,
    )
    rows = said.splitlines()
    assert [row.split()[0] for row in rows] == ["2", "4", "6"] and all(row.endswith("True") for row in rows), said


def test_dsecs_own_provider(export):
    checkout("DSEC")
    out = export("dsec", {**DSEC, "rig": "stereo", "labels": {"flow": ["forward"], "disparity": True}})
    said = loaded(
        "DSEC",
        out,
        """
        sys.path.insert(0, sys.argv[1] + "/scripts")
        from pathlib import Path
        from dataset.provider import DatasetProvider
        data = DatasetProvider(Path(out)).get_train_dataset()
        for k in range(len(data)):
            sample = data[k]
            print(sample["file_index"], sample["disparity_gt"].shape, float(sample["disparity_gt"].max()) > 0)
        """,
    )
    assert [row.split()[0] for row in said.splitlines()] == ["2", "4", "6"] and "False" not in said, said


def test_erafts_loader(export):
    checkout("E-RAFT")
    out = export("eraft", DSEC, ("train", "test"))
    said = loaded(
        "E-RAFT",
        out,
        """
        from pathlib import Path
        from loader.loader_dsec import DatasetProvider
        from utils.dsec_utils import RepresentationType
        for kind in ("standard", "warm_start"):
            data = DatasetProvider(Path(out), RepresentationType.VOXEL, type=kind).get_test_dataset()
            for k in range(len(data)):
                sample = data[k]
                sample = sample if isinstance(sample, dict) else sample[0]
                print(kind, sample["file_index"], bool(sample["save_submission"]), sample["event_volume_new"].shape)
        """,
    )
    rows = [row.split()[:3] for row in said.splitlines() if row.startswith(("standard", "warm"))]
    assert rows[:3] == [["standard", str(k), "True"] for k in (2, 4, 6)], said
    assert {row[0] for row in rows} == {"standard", "warm_start"}


def test_bflows_multiflow_provider(export):
    checkout("bflow")
    recipe = {
        "camera": {"width": 512, "height": 384},
        "time": {"duration": 1, "label_rate": 2, "start": 0.5},
        "labels": {"flow": [0.1, 0.2, 0.3, 0.4, 0.5], "images": True},
    }
    out = export("multiflow", recipe, ("train", "test"))
    said = loaded(
        "bflow",
        out,
        """
        import imageio.v2
        imageio.v2.imread = imageio.imread
        from data.multiflow2d.provider import DatasetProvider
        options = dict(path=out, load_voxel_grid=False, normalize_voxel_grid=False, extended_voxel_grid=True,
                       flow_every_n_ms=100, downsample=False, photo_augm=False)
        provider = DatasetProvider(options, 41)
        for data in (provider.get_train_dataset(), provider.get_val_dataset()):
            sample = {key.name: value for key, value in data[0].items()}
            print(len(data), len(sample["FLOW"]), [tuple(f.shape) for f in sample["FLOW"]][:1])
        """,
    )
    assert [row.split()[1] for row in said.splitlines()] == ["5", "5"], said


def test_etaps_scripts_and_loader(export):
    checkout("ETAP")
    recipe = {
        "camera": {"width": 512, "height": 512},
        "time": {"duration": 2, "label_rate": 47.5},
        "labels": {"images": True},
        "tracks": {"points": 64},
    }
    out = export("eventkubric", recipe)
    said = loaded(
        "ETAP",
        out,
        """
        from pathlib import Path
        sys.path.insert(0, sys.argv[1] + "/scripts")
        import prepare_event_representations as prepare
        sample = sorted(Path(out).glob("*/*"))[0]
        config = dict(representation_name="event_stack", image_shape=(512, 512), num_stacks=10, channel_overlap=True,
                      interpolation="bilinear")
        converter = prepare.EventRepresentationFactory.create(config)
        prepare.process_event_kubric_example(
            converter, str(sample.parent), sample.name, "event_stack_x", 20000, 24, "event_stack", config, False, False
        )
        from src.data.modules.event_kubric import EventKubricDataset
        data = EventKubricDataset(sample.parent, 24, 16, preprocessed_name="event_stack_x")
        got = data[0]
        print(len(data), tuple(got.voxels.shape), tuple(got.rgbs.shape), float(got.voxels.abs().sum()) > 0)
        """,
    )
    assert "1 (24, 10, 512, 512) (24, 3, 512, 512)" in said and said.rstrip().endswith("True"), said


def test_cotrackers_loader_of_tap_vid(export):
    checkout("co-tracker")
    recipe = {
        "camera": {"width": 96, "height": 64},
        "time": {"duration": 0.5, "label_rate": 20},
        "labels": {"images": True},
        "tracks": {"points": 40},
    }
    path = next(export("tapvid", recipe).rglob("*.pkl"))
    said = loaded(
        "co-tracker",
        path,
        """
        from cotracker.datasets.tap_vid_datasets import TapVidDataset
        data = TapVidDataset(out, resize_to=None)
        got = data[0]
        visible = got.trajectory[got.visibility]
        print(len(data), tuple(got.video.shape), tuple(got.trajectory.shape), tuple(got.query_points.shape))
        print(float(visible.min()) >= -1, float(visible[:, 0].max()) <= 96, float(visible[:, 1].max()) <= 64)
        """,
    )
    assert "1 (11, 3, 64, 96) (11, 40, 2)" in said and "False" not in said, said


def test_spike_flownets_encoding_of_mvsec(export, tmp_path):
    """Its encoder counts the events of every image's interval, its test takes flow_dist of the ground truth."""
    checkout("Spike-FlowNet")
    recipe = {
        "camera": {"width": 346, "height": 260},
        "time": {"duration": 0.2, "label_rate": 20},
        "labels": {"flow": ["forward"], "images": True},
    }
    out = export("mvsec", recipe)
    said = loaded(
        "Spike-FlowNet",
        out,
        f"""
        import glob, os, runpy, h5py
        path = glob.glob(out + "/train/*_data.hdf5")[0]
        sys.argv = ["x", "--save-dir", "{tmp_path}", "--save-env", "made", "--data-path", path]
        h5py.File(path)  # the encoder closes its own before it reads
        runpy.run_path("{checkout("Spike-FlowNet")}/encoding/split_coding.py")
        counts = [np.load(f).sum() for f in sorted(glob.glob("{tmp_path}/made/count_data/*.npy"))]
        label = h5py.File(path.replace("_data", "_gt"))["davis"]["left"]
        print(len(counts), min(counts[1:]) > 0, label["flow_dist"].shape, len(label["flow_dist_ts"]))
        """,
    )
    assert said.rstrip().splitlines()[-1].endswith("True (4, 2, 260, 346) 4"), said


RADIANCE = {
    "camera": {"width": 346, "height": 260},
    "time": {"duration": 0.4, "label_rate": 20},
    "labels": {"images": True},
}


def test_eventnerfs_loader(export):
    checkout("EventNeRF")
    said = loaded(
        "EventNeRF",
        next(export("nerf", RADIANCE).glob("*/*")),
        """
        import data_loader_split
        from nerf_sample_ray_split import CameraManager
        cameras = CameraManager()
        views = data_loader_split.load_event_data_split(out, "eventnerf", "train", cameras)
        views[0].update_rays(cameras)
        print(len(views), tuple(views[0].rays_d.shape), min(np.abs(view.event_frame).sum() for view in views) > 0)
        """,
    )
    # The first two views of nine only begin windows.
    assert said.rstrip().endswith("7 (89960, 3) True"), said


def test_timelens_storage(export):
    checkout("rpg_timelens")
    said = loaded(
        "rpg_timelens",
        next(path for path in export("intervals", RADIANCE).glob("*/*") if path.is_dir()),
        """
        from timelens.common.hybrid_storage import HybridStorage
        storage = HybridStorage.from_folders(out + "/events_aligned", out + "/images", "*.npz", "*.png")
        times = list(storage.make_boundary_timestamps_iterator(0))
        t = storage._events._features[:, 2]
        inside = times[0] <= t.min() and t.max() < times[-1]
        print(len(times), storage.get_image_size(), storage._events.is_self_consistent() and inside)
        """,
    )
    assert said.rstrip().endswith("9 (260, 346) True"), said


LENSES = {"radtan": [-0.2, 0.05, 0.001, -0.002], "equidistant": [-0.02, 0.01, -0.004, 0.0005]}
SMALL = {
    "camera": {"width": 160, "height": 120, "focal": 110},
    "time": {"duration": 0.4, "label_rate": 20},
    "labels": {"images": True},
    "images": {"rate": 20, "exposure_us": 5000},
}
RAYS = """
import sys
from pathlib import Path
import numpy as np, torch
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
kept = dict(orientation_method="none", center_method="none", auto_scale_poses=False, load_3D_points=False)
xy, names, o, d = np.random.default_rng(0).uniform(3, (157, 117), (200, 2)), [], [], []
for split in ("train", "val", "test"):
    made = NerfstudioDataParserConfig(data=Path(sys.argv[1]), **kept).setup().get_dataparser_outputs(split)
    for k, path in enumerate(made.image_filenames):
        rays = made.cameras.generate_rays(k, coords=torch.tensor(xy[:, ::-1].copy(), dtype=torch.float32))
        names.append(path.stem), o.append(rays.origins.numpy()), d.append(rays.directions.numpy())
np.savez(sys.argv[2], xy=xy, names=names, o=o, d=d)
"""


@pytest.mark.parametrize("lens", LENSES)
def test_nerfstudios_parser_and_cameras(export, tmp_path, lens):
    """BLINKGL_NERFSTUDIO is a Python that has nerfstudio. Points on its rays are seen where it asked for them: OpenCV's
    projection with the frame camera's poses in the middles of the exposures."""
    python = os.environ.get("BLINKGL_NERFSTUDIO")
    if not python:
        pytest.skip("no nerfstudio (set BLINKGL_NERFSTUDIO to a Python that has it)")
    import cv2
    import numpy as np

    camera = {**SMALL["camera"], "lens": lens, "distortion": LENSES[lens]}
    out = next(export("nerf", {**SMALL, "camera": camera}).glob("*/*"))
    subprocess.run([python, "-c", RAYS, str(out), str(tmp_path / "rays.npz")], check=True, capture_output=True)
    with np.load(tmp_path / "rays.npz") as made:
        xy, names, o, d = (made[key] for key in ("xy", "names", "o", "d"))
    with np.load(next((out.parents[2] / "data").glob("*/*/frame_camera/poses.npz"))) as poses:
        T_world_cam = poses["T_world_cam"][:, 1]
    K = np.array([[110, 0, 79.5], [0, 110, 59.5], [0, 0, 1.0]])
    assert sorted(names) == [f"{k:06d}" for k in range(len(T_world_cam))]
    for name, origin, direction in zip(names, o, d, strict=True):
        T_cam_world = np.linalg.inv(T_world_cam[int(name)])
        seen = (origin + 5 * direction) @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
        project = cv2.projectPoints if lens == "radtan" else cv2.fisheye.projectPoints
        px, _ = project(seen[:, None], np.zeros(3), np.zeros(3), K, np.array(LENSES[lens]))
        px = px.reshape(-1, 1, 2)
        assert np.abs(px[:, 0] - (xy - 0.5)).max() < 1e-3
