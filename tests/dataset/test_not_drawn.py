"""What files ask for and is not drawn is said once by the run, by explain, and by every manifest."""

import json

import pytest
import yaml
from rich.console import Console

from blinkgl.config.run import load_run
from blinkgl.dataset.executor import Local
from blinkgl.dataset.explain import explain
from blinkgl.show.generate import MAX_NOTES, Display, run
from tests.scene.gltf_files import GltfBuilder, triangle

LINE = "card.glb asks for what is not drawn: alpha BLEND (drawn opaque); occlusion maps"
SMALL = {
    "camera": {"width": 32, "height": 24},
    "time": {"duration": 0.05, "label_rate": 20},
    "timeline": {"kind": "uniform", "fps": 100},
    "output": {"sequences": 3},
    "preview": {"enabled": False},
    "labels": {"flow": []},
}
EXPLICIT = {
    "kind": "explicit",
    "meshes": {"card": {"file": "assets/card.glb"}},
    "objects": [{"mesh": "card"}, {"mesh": "card"}],
    "camera": {"position": [-3, 0, 1]},
}
RANDOM = {
    "kind": "random",
    "objects": {"count": 3},
    "pool": {"primitives": [], "folders": ["assets"], "keep_materials": True, "test_fraction": 0},
    "textures": {"procedural": ["checks"], "variants": 2, "photographs": False, "max_size": 16, "test_fraction": 0},
}


def recipe(tmp_path, scene):
    builder = GltfBuilder()
    builder.tree["materials"] = [{"alphaMode": "BLEND", "occlusionTexture": {"index": 0}}]
    builder.node(mesh=triangle(builder, material=0))
    (tmp_path / "assets").mkdir()
    (tmp_path / "assets/card.glb").write_bytes(builder.glb())
    (tmp_path / "run.yaml").write_text(yaml.safe_dump({**SMALL, "scene": scene}))
    return tmp_path / "run.yaml"


@pytest.mark.parametrize(
    "scene, workers",
    [
        (EXPLICIT, None),
        (RANDOM, None),
        pytest.param(EXPLICIT, 2, marks=pytest.mark.slow),
    ],
)
def test_a_run_says_it_once(tmp_path, capsys, scene, workers):
    path = recipe(tmp_path, scene)
    assert run(str(path), str(tmp_path / "out"), executor=workers and Local(workers)) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if line.startswith("note: ")]
    assert said == ["note: " + LINE]
    manifests = sorted((tmp_path / "out").glob("*/*/manifest.json"))
    assert len(manifests) == 3
    for manifest in manifests:
        assert json.loads(manifest.read_text())["not_drawn"] == [LINE]
    assert explain(load_run(path)).scene["not drawn"] == LINE


def test_many_files_are_not_a_screenful(tmp_path, capsys):
    """Messages of any number of workers arrive in any order; a line is printed once, and not more than so many."""
    display = Display(Console(width=200), tmp_path)
    for _ in range(2):
        for k in range(MAX_NOTES + 10):
            display._note([f"{k}.glb asks for what is not drawn: lights"])
    said = capsys.readouterr().out.splitlines()
    assert len(said) == MAX_NOTES + 1 and len(set(said)) == len(said)
    assert said[-1] == "note: more files ask for what is not drawn; the manifests name them under not_drawn"
