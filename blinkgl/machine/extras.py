"""Optional parts: their purpose, and the command that installs them. BlinkGL itself is on no package index, so a remedy
names the packages, never ``blinkgl[extra]``."""

from __future__ import annotations

import os
import shlex
import sys

EXTRAS = {  # extra of setup.cfg -> (distributions, purpose)
    "cycles": (
        ("bpy",),
        "Blender: blinkgl import; better in an environment of its own, see docs/install.md",
    ),
    "learn": (("torch", "safetensors", "tensorboard"), "training"),
    "tensors": (("torch",), "events as tensors: TensorEsim, TensorV2e, events.device: cuda"),
    "cluster": (("ray",), "many machines"),
    "physics": (("mujoco",), "scenes in which things fall"),
    "formats": (("rosbags", "dv-processing"), "ROS bags and MCAP; writing AEDAT4"),
    "view": (("viser",), "sequences in the browser: blinkgl view, generate --view"),
    "docs": (("zensical", "mkdocstrings", "towncrier"), "the documentation as a site"),
    "dev": (("pytest", "pytest-xdist", "hypothesis", "build"), "tests and packaging"),
}
_PINNED = {"torch": "torch>=2.6", "bpy": "bpy>=4.5,<4.6", "mujoco": "mujoco>=3.17,<4", "viser": "viser>=1.1,<2"}


def python() -> str:
    """Return this interpreter, as typed on the command line here."""
    relative = os.path.relpath(sys.executable)
    return shlex.quote(relative if len(relative) < len(sys.executable) else sys.executable)


def install(*distributions: str) -> str:
    """Return the command that installs them for this interpreter, in compatible versions."""
    return f"{python()} -m pip install {' '.join(shlex.quote(_PINNED.get(name, name)) for name in distributions)}"
