"""What a run's folder says of a run that may not go on, and what it keeps."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from blinkgl.dataset.run_folder import RunFolder
from blinkgl.errors import OutputError

ENVIRONMENT = {"numpy": "2.0", "opengl": "llvmpipe, 4.5"}


def plan(identity: dict[str, str], base: str = "."):
    return SimpleNamespace(
        identity=identity,
        template=SimpleNamespace(base=Path(base)),
        recipe_text=lambda: "seed: 1\n",
        tasks=SimpleNamespace(splits=["test", "train"], number=lambda name: None),
    )


def begun(out: Path, identity=None, assets=None, environment=None) -> RunFolder:
    folder = RunFolder(out)
    (out / ".run").mkdir(parents=True, exist_ok=True)
    folder.begin(plan(identity or {"": "a"}), assets or {}, environment or ENVIRONMENT, 3)
    return folder


@pytest.mark.parametrize(
    "before, now, said",
    [
        ({"a": "1"}, {"a": "2"}, "a (changed)"),
        ({"a": "1", "b": "1"}, {"b": "1"}, "a (gone)"),
        ({"b": "1"}, {"a": "1", "b": "1"}, "a (new)"),
        ({"a": "1", "b": "1", "c": "1"}, {"b": "2", "c": "2", "d": "1"}, "a (gone), b (changed), c (changed) …"),
        ({"a": "1", "b": "1"}, {"b": "2", "c": "2"}, "a (gone), b (changed), c (new)"),
        (
            {"x": "1", **{f"f{k}": "1" for k in range(5)}},
            {f"f{k}": "2" for k in range(5)},
            "f0 (changed), f1 (changed), f2 (changed) …",
        ),
    ],
)
def test_files_that_are_not_those_the_run_began_with(tmp_path, before, now, said):
    """The first three by name, each with what became of it; dots where there are more."""
    folder = begun(tmp_path / "out", assets=before)
    folder.check(plan({"": "a"}), before, False)
    folder.check(plan({"": "a"}), now, True)
    with pytest.raises(OutputError) as caught:
        folder.check(plan({"": "a"}), now, False)
    assert f"the pools are not those the run began with: {said}; expected" in str(caught.value) or str(
        caught.value
    ).split("began with: ")[1].startswith(said + ";")


def test_another_installation(tmp_path):
    folder = begun(tmp_path / "out")
    folder.check_environment(ENVIRONMENT, False)
    folder.check_environment({**ENVIRONMENT, "numba": "1"}, False)
    folder.check_environment({**ENVIRONMENT, "numpy": "1.0"}, True)
    with pytest.raises(
        OutputError,
        match=r"the run began with another installation: numpy 2.0, now 1.0; opengl llvmpipe, 4.5, now Voodoo",
    ):
        folder.check_environment({"numpy": "1.0", "opengl": "Voodoo"}, False)


def test_what_lies_at_a_sequences_name(tmp_path):
    folder = begun(tmp_path)
    (tmp_path / "train/empty").mkdir(parents=True)
    (tmp_path / "train/file").write_text("x")
    (tmp_path / "train/link").symlink_to(tmp_path / "train/empty")
    (tmp_path / "train/odd").mkdir()
    (tmp_path / "train/odd/x").write_text("")
    assert [folder.state(f"train/{name}") for name in ("nothing", "empty", "file", "link")] == [
        None,
        None,
        "not a folder",
        "not a folder",
    ]
    assert "manifest" in folder.state("train/odd")
    assert [folder.occupied(f"train/{name}") for name in ("nothing", "empty", "file", "link", "odd")] == [
        False,
        False,
        True,
        False,
        True,
    ]
    for k in range(3):
        folder.put_away("train/odd")
        assert (tmp_path / f".run/damaged/train/odd-{k}/x").exists() and not (tmp_path / "train/odd").exists()
        (tmp_path / "train/odd").mkdir()
        (tmp_path / "train/odd/x").write_text("")
