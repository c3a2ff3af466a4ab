"""The list of files that the type checker leaves out is true: each entry is a file, none is named twice."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
CONFIG = tomllib.loads((ROOT / "pyrefly.toml").read_text(encoding="utf-8"))


def test_every_entry_of_the_type_checkers_lists_matches_a_file():
    excluded = CONFIG["project-excludes"]
    assert len(excluded) == len(set(excluded))
    entries = [*excluded, *(one["matches"] for one in CONFIG["sub-config"])]
    assert [entry for entry in entries if not any(ROOT.glob(entry))] == []


def test_whole_rooms_are_checked():
    left_out = {str(path.relative_to(ROOT)) for entry in CONFIG["project-excludes"] for path in ROOT.glob(entry)}
    rooms = ("events", "render", "timeline", "sequence", "labels", "imaging", "camera", "config", "front", "scene")
    outside = ("eflow/models", "eflow/methods", "eflow/ops", "tools/trade", "tools/shader_debugger")
    for room in (*(f"blinkgl/{room}" for room in rooms), *outside):
        unchecked = [name for name in left_out if name.startswith(f"{room}/")]
        assert not unchecked, unchecked


def test_the_oldest_python_is_one_number():
    floor = re.search(r"python_requires = >=(3\.\d+)", (ROOT / "setup.cfg").read_text(encoding="utf-8"))[1]
    ruff = tomllib.loads((ROOT / "ruff.toml").read_text(encoding="utf-8"))["target-version"]
    assert ruff == "py" + floor.replace(".", "")
    doctor = (ROOT / "blinkgl" / "show" / "doctor.py").read_text(encoding="utf-8")
    assert f"sys.version_info >= ({floor.replace('.', ', ')})" in doctor and f"Python {floor} or newer" in doctor
    assert "python_version" not in (ROOT / "setup.cfg").read_text(encoding="utf-8")
