"""``blinkgl import``: prints what was converted, what was not, and YAML to play it."""

from __future__ import annotations

import json
import math
import os
from typing import Any

from rich.progress import Progress, SpinnerColumn, TimeElapsedColumn

from blinkgl.config.reader import to_short_yaml
from blinkgl.machine.terminal import plain_column, plain_console, say
from blinkgl.types.trees import Tree

_LONGER_SIDE = 640  # px, typical of an event camera
_MOST = 12  # things in a line


def run(source: str, target: str, *, as_json: bool = False, quiet: bool = False, **options: Any) -> int:
    """``options``: of :func:`~blinkgl.blender.importing.import_scene`."""
    from blinkgl.blender.importing import import_scene

    console = plain_console(quiet=quiet)
    with Progress(
        SpinnerColumn(),
        plain_column("{task.description}"),
        TimeElapsedColumn(),
        console=console,
        transient=True,
        disable=quiet or as_json or not console.is_terminal,
    ) as bar:
        task = bar.add_task("starting Blender")
        came = import_scene(source, target, progress=lambda doing: bar.update(task, description=doing), **options)
    if as_json:
        say(plain_console(), json.dumps(came.as_dict(), indent=2))
        return 0
    size = os.path.getsize(target)
    say(console, f"{target}: {size / 1e6:.1f} MB, from {os.path.basename(source)} by Blender {came.blender}")
    say(console, "  " + ", ".join(f"{count:,} {kind}" for kind, count in came.counts.items() if count))
    taken = f"baked, since glTF cannot express it ({came.baked_mb:.1f} of {options['bake_mb']:g} MB)"
    for what, lines, between in (
        (taken, [f"'{name}'" for name in came.baked], ", "),
        ("wrong", came.wrong, "; "),
        ("missing or different", (*came.left_out, *came.omissions), "; "),
    ):
        if lines:
            more = f"{between}and {len(lines) - _MOST} more (--json has all)" if len(lines) > _MOST else ""
            say(console, f"{what}: {between.join(lines[:_MOST])}{more}")
    say(console, "to play it:")
    for line in _recipe(target, came).splitlines():
        say(console, f"  {line}")
    return 0


def _recipe(target: str, came: Any) -> str:
    """Return the YAML that plays the imported file, as far as the file determines it."""
    if not came.counts["meshes"]:
        return f"scene.objects: {{mesh: …, animation: {{file: {target}}}}}    (a clip, for a figure with these joints)"
    scene: Tree = {"kind": "file", "path": target}
    if came.cameras:
        scene |= {"camera": came.camera or came.cameras[0], "intrinsics": "file"}
    else:
        scene["pose"] = {"position": [-5, 0, 1.5], "look_at": [0, 0, 1]}
    recipe: Tree = {"scene": scene}
    if came.duration_s:
        # Labels need an interval before the first and one after the last.
        rate = next(k * 10**n for n in range(1, 9) for k in (1, 2, 5) if k * 10**n * came.duration_s >= 4)
        # Rounded first: 0.3 s at 10 Hz are three intervals. A duration is a whole number of them.
        intervals = math.floor(round(came.duration_s * rate, 6)) - 2
        recipe["time"] = {"duration": intervals / rate, "label_rate": rate}
    if came.cameras:
        less = max(max(came.size) / _LONGER_SIDE, 1)
        recipe = {"camera": {"width": round(came.size[0] / less), "height": round(came.size[1] / less)}, **recipe}
    return to_short_yaml(recipe)
