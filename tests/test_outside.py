"""What the code host reads: workflows run targets that exist, on the Pythons that the project is for."""

import re
import subprocess
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_a_workflow_runs_what_there_is(path):
    jobs = yaml.safe_load(path.read_text(encoding="utf-8"))["jobs"]
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M))
    for job in jobs.values():
        matrix = job.get("strategy", {}).get("matrix", {})
        for step in job["steps"]:
            for target in re.findall(r"make (\S.*)$", step.get("run", ""), re.M):
                wanted = matrix["what"] if "matrix.what" in target else target.split()
                assert set(wanted) <= targets


def test_pushes_are_tested_on_every_python_of_the_matrix():
    tests = yaml.safe_load((ROOT / ".github/workflows/tests.yml").read_text(encoding="utf-8"))["jobs"]["test"]
    wanted = re.search(r"^PYTHONS = \((.*)\)$", (ROOT / "tools" / "noxfile.py").read_text(encoding="utf-8"), re.M)[1]
    assert tests["strategy"]["matrix"]["python"] == re.findall(r"3\.\d+", wanted)


def test_forms_ask_for_what_helps():
    for path in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"):
        form = yaml.safe_load(path.read_text(encoding="utf-8"))
        assert {"name", "description", "body"} <= form.keys() and any(
            part.get("validations", {}).get("required") for part in form["body"]
        )


NAMED = re.compile(
    r"(?<![\w/.-])((?:blinkgl|eflow|tools|tests|shaders|configs|docs)/[\w/.-]+\.(?:py|glsl|md|yaml|toml))"
)
ELSEWHERE = {
    "configs/blinkflow_v1.yaml": "BlinkSim's",
    "tests/blender/played.py": "its commit is named beside it",
    "shaders/include/deform/shear.glsl": "a plug-in's, in a test",
    "shaders/include/labels/position.glsl": "a plug-in's, in a test",
}


def test_files_that_are_named_exist():
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True).stdout.split()
    if not tracked:
        pytest.skip("not a git checkout")
    known, gone = set(tracked), []
    for name in tracked:
        if not name.endswith((".py", ".glsl", ".md", ".yaml", ".toml", ".cfg")) or name == "CHANGELOG.md":
            continue
        for number, line in enumerate((ROOT / name).read_text(encoding="utf-8").splitlines(), 1):
            for named in NAMED.findall(line):
                below = "/".join([named.split("/")[0], *named.split("/")[2:]])
                if not {named, below} & known and "NAME" not in named and named not in ELSEWHERE:
                    gone.append(f"{name}:{number}: {named}")
    assert gone == []


def test_modules_that_docstrings_name_exist():
    gone = []
    for room in ("blinkgl", "eflow"):
        for path in (ROOT / room).rglob("*.py"):
            for module in re.findall(r":mod:`~?((?:blinkgl|eflow)[\w.]*)`", path.read_text(encoding="utf-8")):
                place = ROOT / module.replace(".", "/")
                tool = ROOT / module.replace("blinkgl.tools", "tools", 1).replace(".", "/")
                if not any(p.is_dir() or p.with_suffix(".py").is_file() for p in (place, tool)):
                    gone.append(f"{path.relative_to(ROOT)}: {module}")
    assert gone == []


PROGRAM = re.compile(r"""-m(?:",\s*"|[ ])((?:blinkgl|eflow)(?:\.\w+)*)""")
"""``python -m MODULE`` of a shell, a page or a list of words."""


def test_modules_that_are_run_are_programs():
    """Python runs a module that is no program without a word, and its status is 0."""
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True).stdout.split()
    if not tracked:
        pytest.skip("not a git checkout")
    texts = {name: (ROOT / name).read_bytes().decode("utf-8", "replace") for name in tracked if (ROOT / name).is_file()}
    named = {module for text in texts.values() for module in PROGRAM.findall(text)}
    assert {"blinkgl", "blinkgl.cli", "eflow.cli", "blinkgl.dataset.worker", "blinkgl.tools.bench"} <= named
    files = {
        module: [f"{place}{end}" for end in (".py", "/__main__.py")]
        for module in named
        for place in [re.sub(r"^blinkgl/(tools/|tools$)", r"\1", module.replace(".", "/"))]
    }
    assert not {
        module
        for module, places in files.items()
        if not any('if __name__ == "__main__":' in texts.get(place, "") for place in places)
    }
