"""What BlinkGL plays beside what Blender saw, without Blender: ``golden/unsaid.glb`` and ``golden/unsaid.npz`` are
scene.glb and seen.npz of ``blinkgl import unsaid.blend`` (build_scenes.py) by Blender 4.5.15."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from blinkgl.blender.comparing import compare

GOLDEN = Path(__file__).parents[1] / "golden"


def test_baked_nodes_play_as_blender_saw_them():
    """Morph targets, rigid nodes, a cut in visibility and a camera, at whole and half frames."""
    differs, denser, omissions = compare(GOLDEN / "unsaid.glb", GOLDEN / "unsaid.npz")
    assert (differs, denser, omissions) == ({}, 1, ())


@pytest.mark.parametrize(
    "name, change, words",
    [
        ("Spin", lambda points, t: points + 0.01 * (t > 0.1)[:, None, None], (0.01, 7 / 15)),
        ("Comes", lambda points, t: np.where((t > 0.15)[:, None, None], np.nan, points), (1.0, 6 / 15)),
        ("Thick", lambda points, t: points + 3e-4, (1.5e-4, 8 / 15)),
        ("Eye", lambda points, t: points + 0.02, (0.0162, 1.0)),
    ],
)
def test_a_difference_is_named_with_how_much_and_how_long(tmp_path, name, change, words):
    table = dict(np.load(GOLDEN / "unsaid.npz"))
    which = [k for k, (obj, _) in enumerate(json.loads(str(table["things"]))) if obj == name]
    table[f"arr_{which[0]}"] = change(table[f"arr_{which[0]}"], table["times"])
    np.savez(tmp_path / "seen.npz", **table)
    differs, _, _ = compare(GOLDEN / "unsaid.glb", tmp_path / "seen.npz")
    assert list(differs) == [name] and differs[name] == pytest.approx(words, rel=0.3)


@pytest.mark.parametrize(("finest", "answer"), [(8, ([], 2)), (2, ([], 2)), (1, (["Thick"], 1))])
def test_what_more_key_frames_would_mend_is_baked_alone_where_there_can_be_no_more(tmp_path, finest, answer):
    table = dict(np.load(GOLDEN / "unsaid.npz"))
    which = [k for k, (obj, _) in enumerate(json.loads(str(table["things"]))) if obj == "Thick"]
    table[f"arr_{which[0]}"] = table[f"arr_{which[0]}"] + 4e-3 * ~table["whole"][:, None, None]
    np.savez(tmp_path / "seen.npz", **table)
    differs, denser, _ = compare(GOLDEN / "unsaid.glb", tmp_path / "seen.npz", 1, finest)
    assert (list(differs), denser) == answer


def test_changing_faces_and_what_is_too_many_are_named(tmp_path):
    table = dict(np.load(GOLDEN / "unsaid.npz"))
    objs = json.loads(str(table["things"]))
    table["things"] = json.dumps([(("Other" if name == "Ring" else name), name == "Spots") for name, _ in objs])
    np.savez(tmp_path / "seen.npz", **table)
    assert set(compare(GOLDEN / "unsaid.glb", tmp_path / "seen.npz")[0]) == {"Spots", "Other", "Ring"}
