"""Optional parts: their purpose, and the command that installs them. BlinkGL itself is on no package index, so a remedy
names the packages, never ``blinkgl[extra]``."""

from __future__ import annotations

import os
import re
import shlex
import sys
from importlib.metadata import distributions

EXTRAS = {  # extra of setup.cfg -> (distributions, purpose)
    "cycles": (
        ("bpy",),
        "Blender: blinkgl import; better in an environment of its own, see docs/install.md",
    ),
    "learn": (("torch", "safetensors", "tensorboard"), "training"),
    "onnx": (("onnx", "onnxscript", "onnxruntime"), "networks for programs without torch: eflow export --onnx"),
    "tensors": (("torch",), "events as tensors: TensorEsim, TensorV2e, events.device: cuda"),
    "cluster": (("ray",), "many machines"),
    "pyrender": (("pyrender",), "scenes of pyrender: Scene.from_pyrender; tests compare with its renderer"),
    "physics": (("mujoco",), "scenes in which things fall"),
    "formats": (("rosbags", "dv-processing"), "ROS bags and MCAP; writing AEDAT4"),
    "view": (("viser",), "sequences in the browser: blinkgl view, generate --view"),
    "docs": (("zensical", "mkdocstrings", "towncrier"), "the documentation as a site"),
    "dev": (("pytest", "pytest-xdist", "hypothesis", "build"), "tests and packaging"),
}
_PINNED = {"torch": "torch>=2.6", "bpy": "bpy>=4.5,<4.6", "mujoco": "mujoco>=3.17,<4", "viser": "viser>=1.1,<2"}

TESTED = {
    name: newest
    for name, _, newest in (
        word.partition("==")
        for word in (
            "moderngl==5.13.0 glcontext==3.1.0 numpy==2.4.6 numba==0.68.1 scipy==1.17.1 trimesh==5.2.0 lxml==6.1.3 "
            "mapbox_earcut==2.1.0 python-fcl==0.7.0.11 pillow==13.0.0 tifffile==2026.3.3 imageio==2.38.1 av==18.1.0 "
            "opencv-python-headless==5.0.0.93 scikit-image==0.26.0 h5py==3.16.0 hdf5plugin==7.1.0 aedat==2.3.0 "
            "pydantic==2.14.3 PyYAML==6.0.3 typer==0.29.2 rich==14.3.4 matplotlib==3.11.2 jinja2==3.1.6 torch==2.13.0 "
            "safetensors==0.8.0 tensorboard==2.21.0 ray==2.60.0 mujoco==3.17.0 rosbags==0.11.9 dv-processing==2.0.4 "
            "faery==0.7.1 viser==1.1.1 websockets==16.1.1 "
        ).split()
    )
}
"""The newest versions that the tests have run with, as constraints.txt has them (a wheel comes without it)."""


def python() -> str:
    """Return this interpreter, as typed on the command line here."""
    relative = os.path.relpath(sys.executable)
    return shlex.quote(relative if len(relative) < len(sys.executable) else sys.executable)


def install(*names: str) -> str:
    """Return the command that installs them for this interpreter, in compatible versions."""
    return f"{python()} -m pip install {' '.join(shlex.quote(_PINNED.get(name, name)) for name in names)}"


def newer_than_tested() -> list[str]:
    """Return "av 19.0.2 (tested: 18.1.0)" for every installed library that is newer than those of the tests."""
    here = {one.name: one.version for one in distributions() if one.name in TESTED}
    numbers = lambda text: [int(part) for part in re.findall(r"\d+", text.partition("+")[0])]
    newer = sorted(name for name, version in here.items() if numbers(version) > numbers(TESTED[name]))
    return [f"{name} {here[name]} (tested: {TESTED[name]})" for name in newer]
