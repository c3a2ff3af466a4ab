"""What the code host reads: workflows run targets that exist, on the Pythons that the project is for."""

import re
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
