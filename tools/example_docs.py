"""Writes docs/examples.md: every script of examples/ with what it printed, and the pictures it made.

    python -m blinkgl.tools.example_docs

A test runs the examples and fails when the page shows another program, or another output apart from numbers.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
import re
import sys
import tempfile
from pathlib import Path
from types import ModuleType

from PIL import Image

ROOT = Path("examples")
PAGE = Path("docs/examples.md")
PICTURES = {
    "scene_in_python": (
        "scene.png",
        "example_scene.png",
        "a checked ball, a red ring and a box with a photograph on a brick floor",
    ),
    "living_scene": (
        "living.png",
        "example_living.png",
        "a dancer, someone who walks, a fish, a flag and a tower that bends",
    ),
    "rig_in_python": (
        "views.png",
        "example_rig.png",
        "a floor of bricks, a ball and a box, as the left eye, the right eye and the fisheye camera see them",
    ),
    "frame_with_labels": ("labels.png", "example_labels.png", "image, depth, instance ids and flow of one frame"),
    "own_label": ("position.png", "example_own_label.png", "a frame, and a map of where its surfaces are"),
    "events_over_frame": ("events.png", "example_events.png", "a frame, and the events that follow it drawn over it"),
    "event_tensors": ("tensors.png", "example_tensors.png", "a time surface and the five bins of a voxel grid"),
}
"""Of an example: the picture it makes, its name in docs/images, and what it shows."""
ORDER = (
    "scene_in_python",
    "living_scene",
    "star_field",
    "star_tracker",
    "optical_marker",
    "frame_with_labels",
    "own_label",
    "own_trajectory",
    "rig_in_python",
    "video_to_events",
    "events_over_frame",
    "moving_picture",
    "event_tensors",
    "tensor_environments",
    "tensor_gym",
    "dataset_from_yaml",
    "torch_dataloader",
    "online_windows",
    "online_training",
    "compare_recordings",
    "convert_formats",
    "sensors",
)

HEADER = """# Examples

Each is a program in `examples/`, with its output and a check (`test_final`) that the tests run. Copy one and change it:

```
python examples/scene_in_python.py        # writes below out/examples/
```

This page is made by `python -m blinkgl.tools.example_docs`; do not edit. `examples/demo.ipynb` and
`examples/flow.ipynb` (a network estimates flow) are notebooks.
"""


def load(name: str, root: Path = ROOT) -> ModuleType:
    """The example as a module."""
    spec = importlib.util.spec_from_file_location(f"example_{name}", root / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run(name: str, out: Path, root: Path = ROOT) -> str:
    """Runs an example and its check; returns what it printed."""
    module = load(name, root)
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        module.main(out)
    module.test_final(out)
    return printed.getvalue()


def cells(notebook: Path) -> list[str]:
    """The code cells of a notebook, in order."""
    return [
        "".join(cell["source"])
        for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]
        if cell["cell_type"] == "code"
    ]


def section(name: str, output: str, root: Path = ROOT) -> str:
    """The example's part of the page."""
    source = (root / f"{name}.py").read_text(encoding="utf-8")
    docstring = re.match(r'"""(.*?)"""', source, re.S)
    assert docstring is not None
    title = docstring[1].strip()
    picture = f"\n![{PICTURES[name][2]}](images/{PICTURES[name][1]})\n" if name in PICTURES else ""
    return (
        f'## {name}\n\n{title}\n\n``` {{.python title="examples/{name}.py"}}\n--8<-- "examples/{name}.py"\n```\n'
        f"\n```\n{output.rstrip()}\n```\n{picture}"
    )


def without_numbers(text: str) -> str:
    """Text in which numbers, and the spaces that line them up, do not count: they may differ between machines."""
    return re.sub(r"[ \t]+", " ", re.sub(r"[-+−]?\d[\d,.]*", "#", text)).strip()


def main() -> int:
    parts = [HEADER]
    with tempfile.TemporaryDirectory() as folder:
        for name in ORDER:
            out = Path(folder) / name
            parts.append(section(name, run(name, out)))
            if name in PICTURES:
                with Image.open(out / PICTURES[name][0]) as picture:  # 256 colours: half the bytes, and nobody sees it
                    picture.convert("RGB").quantize(256).save(PAGE.parent / "images" / PICTURES[name][1], optimize=True)
    load("moving_picture").main(PAGE.parent / "images", duration=1.6)  # README's
    PAGE.write_text("\n".join(parts), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
