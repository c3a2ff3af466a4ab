"""The wheel and the editable install are complete: command, shaders, configs, outside the repository too.

Both go into fresh virtual environments that see this one's packages (through a .pth, which does not activate this one's
editable install), so nothing is fetched; but for the slow test, whose environment is empty.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import blinkgl

REPOSITORY = Path(__file__).resolve().parent.parent
PACKAGES = {
    "blinkgl": "blinkgl",
    "eflow": "eflow",
    "shaders": "blinkgl/shaders",
    "configs": "blinkgl/configs",
    "tools/shader_debugger": "blinkgl/tools/shader_debugger",
    "tools/trade": "blinkgl/tools/trade",
}
URL = "https://here.invalid/blinkgl"
NETWORK = ("model.safetensors", "card.yaml")

PROBE = """
import json, sys
from importlib import metadata, resources
import blinkgl, eflow
from blinkgl.gl import create_context
shaders, configs = resources.files("blinkgl.shaders"), resources.files("blinkgl.configs")
names = sorted(entry.name for entry in shaders.iterdir() if entry.name.endswith(".glsl"))
yamls = sorted(entry.name for entry in configs.iterdir() if entry.name.endswith(".yaml"))
print(json.dumps({
    "file": blinkgl.__file__, "version": metadata.version("blinkgl"),
    "shaders": {name: (shaders / name).read_text() for name in names},
    "configs": {name: (configs / name).read_text() for name in yamls},
}))
"""


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A copy of what a build reads: building in the repository would leave files there, and
    two test processes collide."""
    copy = tmp_path_factory.mktemp("source")
    for name in ("setup.cfg", "setup.py", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(REPOSITORY / name, copy)
    for name in (*PACKAGES, "docs", "tools"):
        shutil.copytree(
            REPOSITORY / name,
            copy / name,
            dirs_exist_ok=True,
            ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"),
        )
    return copy


FRAME = """
import sys
from blinkgl.config.run import load_run
from blinkgl.gl import create_context
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import sequence_scene
template = load_run(sys.argv[1], ["quality=null"])
config = template.sequence(0)
with create_context() as gl, Renderer(gl, sequence_scene(config, 0, template.base), config.render) as renderer:
    print("drawn" if renderer.luminance(0).read().std() > 0.01 else "nothing")
"""
"""Whose shaders include others."""


def run(*command: str | Path, cwd: Path, compiled: bool = False) -> str:
    environment = {"BLINKGL_URL": URL} | {
        key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
    }
    if not compiled:  # which takes half a minute, and is not what is looked at
        environment["NUMBA_DISABLE_JIT"] = "1"
    done = subprocess.run(
        [str(c) for c in command], cwd=cwd, env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def fresh_environment(folder: Path) -> Path:
    """A virtual environment without pip that can import this one's dependencies but not its
    blinkgl; returns its bin/."""
    run(sys.executable, "-m", "venv", "--without-pip", folder, cwd=folder.parent)
    site = next(folder.glob("lib/python*/site-packages"))
    seen = [path for path in sys.path if path.endswith("site-packages") and Path(path).is_dir()]
    (site / "dependencies.pth").write_text("\n".join(seen) + "\n")
    return folder / "bin"


def expected_files() -> set[str]:
    """Where every Python file, shader and config of the repository has to be in a wheel."""
    found = set()
    for here, there in PACKAGES.items():
        for path in (REPOSITORY / here).rglob("*"):
            if (
                path.suffix in (".py", ".typed", ".glsl", ".yaml", ".html", ".js", ".css", ".safetensors")
                and "__pycache__" not in path.parts
            ):
                found.add(f"{there}/{path.relative_to(REPOSITORY / here).as_posix()}")
    return found


def check_resources(bin_: Path, root: Path, elsewhere: Path) -> dict:
    """The installed command and resources are there, in a folder that has nothing to do with the repository."""
    probe = json.loads(run(bin_ / "python", "-c", PROBE, cwd=elsewhere))
    assert Path(probe["file"]).is_relative_to(root)
    for folder in ("shaders", "configs"):
        suffix = {"shaders": "*.glsl", "configs": "*.yaml"}[folder]
        assert probe[folder] == {path.name: path.read_text() for path in (REPOSITORY / folder).glob(suffix)}
    assert probe["shaders"]
    below = run(bin_ / "blinkgl", "--help", cwd=elsewhere).split("page below\n")[1].strip()
    assert (Path(below) / "docs" / "install.md").is_file()
    assert run(bin_ / "blinkgl", "--version", cwd=elsewhere) == f"blinkgl {probe['version']}\n"
    return probe


def check_installation(bin_: Path, root: Path, elsewhere: Path) -> None:
    """They are there, and draw a frame of the demonstration from where they were installed. Kernels are interpreted
    (`run`): to compile them anew would take a minute and a half."""
    check_resources(bin_, root, elsewhere)
    demo = root / next(root.glob("lib/python*/site-packages/blinkgl/configs/demo.yaml"))
    assert run(bin_ / "python", "-c", FRAME, demo, cwd=elsewhere) == "drawn\n"


def test_wheel(source, tmp_path):
    pytest.importorskip("build")
    for name in NETWORK:  # whatever is shipped
        (source / "eflow" / "weights" / "toy").mkdir(parents=True, exist_ok=True)
        (source / "eflow" / "weights" / "toy" / name).write_bytes(b"")
    # The sdist, and the wheel from what is in it.
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", tmp_path / "dist", source, cwd=tmp_path)
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    assert wheel.name == f"blinkgl-{blinkgl.__version__}-py3-none-any.whl"
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        (metadata,) = (archive.read(name).decode() for name in names if name.endswith("METADATA"))
    for line in ("Author: The BlinkGL authors", "License: MIT", f"Project-URL: Source, {URL}\n", "Classifier: Typing"):
        assert line in metadata
    relative = re.findall(r"\]\((?!https?:|#)[^)]*", metadata)
    assert not relative and f"({URL}/raw/HEAD/docs/images/moving.webp)" in metadata
    missing = (expected_files() | {f"eflow/weights/toy/{name}" for name in NETWORK}) - names
    assert not missing, f"not in the wheel (packages and package_data in setup.cfg): {sorted(missing)}"
    assert not [name for name in names if name.startswith(("tests/", "docs/"))]
    assert {f"blinkgl/docs/{page.name}" for page in (REPOSITORY / "docs").glob("*.md")} <= names, "messages name them"
    programs = [name for name in names if name.startswith("blinkgl/tools/") and name.count("/") == 2]
    assert programs == ["blinkgl/tools/__init__.py"], "what only developers run"
    assert any(name.endswith("LICENSE") for name in names)
    bin_ = fresh_environment(tmp_path / "venv")
    run(
        sys.executable,
        "-m",
        "pip",
        "--python",
        bin_ / "python",
        "install",
        "--no-deps",
        "--no-index",
        wheel,
        cwd=tmp_path,
    )
    check_installation(bin_, tmp_path / "venv", tmp_path)


@pytest.mark.slow
def test_wheel_in_an_empty_environment_runs_the_demo(source, tmp_path):
    """Everything comes from the wheel and from the package index, at the versions of constraints.txt."""
    run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", tmp_path / "dist", source, cwd=tmp_path)
    (wheel,) = (tmp_path / "dist").iterdir()
    run(sys.executable, "-m", "venv", tmp_path / "venv", cwd=tmp_path)
    bin_ = tmp_path / "venv" / "bin"
    command = [bin_ / "pip", "install", "-q", "-c", REPOSITORY / "constraints.txt", wheel]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1200)
    if done.returncode and re.search(
        r"No matching distribution|Could not find|Connection|Temporary failure", done.stderr
    ):
        pytest.skip(f"the package index cannot be reached: {done.stderr.splitlines()[-1]}")
    assert done.returncode == 0, done.stderr
    check_installation(bin_, tmp_path / "venv", tmp_path)
    assert json.loads(run(bin_ / "blinkgl", "doctor", "--json", cwd=tmp_path, compiled=True))["ok"]
    short = ("--out", tmp_path / "demo", "--set", "time.duration=0.3")
    run(bin_ / "blinkgl", "generate", "demo", *short, cwd=tmp_path, compiled=True)
    assert "1 sequence" in run(bin_ / "blinkgl", "verify", tmp_path / "demo", cwd=tmp_path)
    made = tmp_path / "demo/train/demo_000000"
    assert {"events.h5", "flow", "images", "manifest.json", "preview.mp4"} <= {path.name for path in made.iterdir()}


def test_constraints_pin_what_setup_cfg_asks_for():
    """Every direct dependency has a pin, and the pin satisfies the lower bound."""
    import configparser

    from packaging.requirements import Requirement

    def key(name: str) -> str:
        return re.sub(r"[-_.]+", "-", name).lower()

    pins = {}
    for line in (REPOSITORY / "constraints.txt").read_text().splitlines():
        if line.strip() and not line.startswith("#"):
            requirement = Requirement(line)
            pins[key(requirement.name)] = next(iter(requirement.specifier)).version
            assert [s.operator for s in requirement.specifier] == ["=="], line
            assert requirement.url is None
    parser = configparser.ConfigParser()
    parser.read(REPOSITORY / "setup.cfg")
    wanted = parser["options"]["install_requires"].split("\n")
    for extra in ("dev", "docs", "learn", "onnx"):
        wanted += parser["options.extras_require"][extra].split("\n")
    for line in filter(None, wanted):
        requirement = Requirement(line)
        assert key(requirement.name) in pins, f"{line} has no pin"
        assert requirement.specifier.contains(pins[key(requirement.name)]), line


def test_the_container_copies_what_its_context_has_and_installs_what_setup_does():
    lines = (REPOSITORY / "Dockerfile").read_text().splitlines()
    kept = {line[1:] for line in (REPOSITORY / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    copied = {source for line in lines if line.startswith("COPY") for source in line.split()[1:-1]}
    assert copied == kept and all((REPOSITORY / source).exists() for source in copied)
    (apt,) = (line for line in lines if "apt-get install" in line)
    installed = set(apt.split("--no-install-recommends ")[1].split(" && ")[0].split())
    setup = (REPOSITORY / "tools/setup.sh").read_text()
    assert installed == set(re.findall(r"\b(?:python3|python3-venv|lib(?:egl|gl|os)[\w-]*)\b(?= |\")", setup))
