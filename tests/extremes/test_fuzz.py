"""Any configuration either is refused with one line or makes a whole sequence: no NaN, no unsorted event, no crash."""

from __future__ import annotations

import tempfile
from pathlib import Path

import cv2
import h5py
import hdf5plugin  # noqa: F401  (registers the Blosc filter for h5py)
import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, event, given, settings

from blinkgl.config.run import RunTemplate
from blinkgl.dataset.generate import generate_sequence
from blinkgl.errors import BlinkGLError
from blinkgl.sequence_files.sequence_dir import verify_sequence
from tests.extremes.configurations import esim, runs, v2e, voltmeter

# No explain phase: it re-runs a failing sequence hundreds of times to say which of its values matter.
COMMON = dict(
    deadline=None,
    suppress_health_check=list(HealthCheck),
    database=None,
    print_blob=False,
    phases=(Phase.explicit, Phase.generate, Phase.shrink),
)


def check_sequence(folder: Path, config) -> int:
    """Reads everything back; returns the number of events."""
    assert verify_sequence(folder) == []
    width, height = config.camera.width, config.camera.height
    with h5py.File(folder / "events.h5") as file:
        x, y, t, p = (file[f"events/{k}"][:] for k in "xytp")
        offset, index = int(file["t_offset"][()]), file["ms_to_idx"][:]
    t = t.astype(np.int64)
    assert (np.diff(t) >= 0).all() and (np.diff(index.astype(np.int64)) >= 0).all()
    assert not len(t) or (
        t.min() >= 0 and offset + t.max() <= config.time.t1_ns // 1000 and x.max() < width and y.max() < height
    )
    assert set(np.unique(p)) <= {0, 1}
    for direction in ("forward", "backward"):
        for k in range(config.time.label_count):
            flow = np.load(folder / f"flow/{direction}_npy/{k:06d}.npy")
            assert flow.shape == (height, width, 3) and np.isfinite(flow).all()
            assert (flow[flow[..., 2] == 0] == 0).all()
    for k in range(config.time.label_count):
        ids = cv2.imread(str(folder / f"ids/{k:06d}.png"), cv2.IMREAD_UNCHANGED)
        depth, normals, velocity = (
            np.load(folder / f"{name}/{k:06d}.npy") for name in ("depth", "normals", "velocity")
        )
        np.testing.assert_array_equal(np.isinf(depth), ids == 0)
        assert (depth > 0).all() and np.isfinite(normals).all() and not np.isnan(velocity).any()
        np.testing.assert_allclose(np.linalg.norm(normals, axis=-1)[ids > 0], 1, atol=1e-3)
    return len(t)


def generate(gl, tree: dict) -> None:
    try:
        config = RunTemplate(tree, Path(".")).sequence(0)
        with tempfile.TemporaryDirectory() as folder:
            report = generate_sequence(config, 0, folder, gl)
            count = check_sequence(report.path, config)
            assert count == report.events
    except BlinkGLError as error:
        assert "\n" not in str(error)
        event(f"refused: {str(error).split(' (got')[0][:60]}")
        return
    event("events" if count else "no events")


@settings(max_examples=25, derandomize=True, **COMMON)
@given(tree=runs(esim))
def test_any_configuration_makes_a_sequence_or_a_message(_gl_session, tree):
    generate(_gl_session, tree)


@settings(max_examples=10, derandomize=True, **COMMON)
@given(tree=runs(v2e | voltmeter))
def test_any_noisy_camera_too(_gl_session, tree):
    generate(_gl_session, tree)


@pytest.mark.slow
@settings(max_examples=500, **COMMON)
@given(tree=runs(esim | v2e | voltmeter))
def test_hundreds_of_configurations(_gl_session, tree):
    generate(_gl_session, tree)
