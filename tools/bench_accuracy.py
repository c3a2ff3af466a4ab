"""How exact the rasterised ground truth is: every label against the float64 ray-cast reference.

    python -m blinkgl.tools.bench_accuracy [CONFIG] [--sequences N] [--set a.b=c …] [--json FILE]

For N sequences of a configuration (default: flying_objects.yaml, 3), one label in the middle of each: instance ids,
depth, forward and backward flow and velocity off the one-pixel silhouette band of either image, and how many pixels
differ in it; occlusion masks wherever both see the same object, edges included.
"""

from __future__ import annotations

import argparse
import json
from importlib import resources

import numpy as np
from rich.console import Console
from rich.table import Column, Table

from blinkgl.config.run import load_run
from blinkgl.gl import create_context
from blinkgl.labels import LabelRequest
from blinkgl.machine import bench
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import sequence_scene
from blinkgl.tools.shader_debugger import reference

REQUEST = LabelRequest(
    "depth", "ids", "velocity", "flow_forward", "flow_backward", "occlusion_forward", "occlusion_backward"
)


def compare(gl, template, index: int) -> dict[str, float]:
    """Errors of one label of one sequence; pixels are counted in the whole image."""
    config = template.sequence(index)
    scene = sequence_scene(config, index, template.base)
    times = config.time.label_times_ns
    now, interval = times[len(times) // 2 - 1], config.time.interval_ns
    with Renderer(gl, scene, config.render) as renderer:
        ours = renderer.labels(now, REQUEST, now + interval, now - interval)
        triangles = renderer.triangles
    exact = reference.render(scene, now, forward_ns=now + interval, backward_ns=now - interval)
    # Of either image: through a crack between faces that do not quite meet, one of them may see what lies behind.
    band = reference.silhouette_band(exact.instance, exact.depth) | reference.silhouette_band(ours.ids, ours.depth)
    same = (ours.ids == exact.instance) & (exact.instance > 0)
    inside = same & ~band
    norm = lambda v: np.hypot(v[..., 0], v[..., 1])
    result: dict[str, float] = {
        "sequence": index,
        "triangles": triangles,
        "pixels": int(same.size),
        "band": int(band.sum()),
        "ids_wrong": int(((ours.ids != exact.instance) & ~band).sum()),
        "ids_wrong_in_band": int(((ours.ids != exact.instance) & band).sum()),
    }
    depth = np.abs(ours.depth - exact.depth)[inside] / exact.depth[inside]
    result.update(depth_median=float(np.median(depth)), depth_max=float(depth.max()))
    speed = norm(exact.velocity)[inside]
    velocity = norm(ours.velocity - exact.velocity)[inside] / np.maximum(speed, 1e-3)
    result.update(velocity_median=float(np.median(velocity)), velocity_max=float(velocity.max()))
    for name in ("forward", "backward"):
        mine, theirs = getattr(ours, name), getattr(exact, name)
        both, seen = inside & mine.valid & theirs.valid, same & mine.valid & theirs.valid
        error = norm(mine.flow - theirs.flow)[both]
        result.update(
            {
                f"{name}_median": float(np.median(error)),
                f"{name}_max": float(error.max()),
                f"{name}_largest_flow": float(norm(theirs.flow)[both].max()),
                f"{name}_valid_differs": int(((mine.valid != theirs.valid) & inside).sum()),
                f"{name}_occlusion_differs": int(((mine.occluded != theirs.occluded) & seen).sum()),
                f"{name}_occluded": int((theirs.occluded & ~theirs.outside)[seen].sum()),
            }
        )
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", nargs="?", default=str(resources.files("blinkgl.configs") / "flying_objects.yaml"))
    parser.add_argument("--sequences", type=int, default=3)
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="a.b=c")
    parser.add_argument("--json", metavar="FILE")
    options = parser.parse_args()
    console = Console()
    template = load_run(options.config, options.overrides)
    with create_context() as gl:
        console.print(bench.machine_line(gl.renderer), highlight=False, soft_wrap=True)
        rows = [compare(gl, template, i) for i in range(options.sequences)]
    console.width = max(console.width, 110)
    columns = (Column(name, justify="right") for name in ("sequence", *(str(r["sequence"]) for r in rows)))
    title = "labels against the float64 reference, off the one-pixel silhouette band"
    table = Table(*columns, title=title, title_justify="left")
    line = lambda title, text: table.add_row(title, *(text(r) for r in rows))
    line("triangles", lambda r: f"{r['triangles']:,}")
    line("ids that differ (in the band)", lambda r: f"{r['ids_wrong']} ({r['ids_wrong_in_band']} of {r['band']:,})")
    line("depth, relative: median / max", lambda r: f"{r['depth_median']:.1e} / {r['depth_max']:.1e}")
    line("velocity, relative: median / max", lambda r: f"{r['velocity_median']:.1e} / {r['velocity_max']:.1e}")
    for name in ("forward", "backward"):
        line(f"{name} flow, px: median / max", lambda r: f"{r[name + '_median']:.1e} / {r[name + '_max']:.1e}")
        line("  of flows up to, px", lambda r: f"{r[name + '_largest_flow']:.0f}")
        line(
            f"{name} occlusion that differs",
            lambda r: f"{r[name + '_occlusion_differs']} of {r[name + '_occluded']:,} hidden by something",
        )
    console.print(table)
    if options.json:
        with open(options.json, "w", encoding="utf-8") as file:
            json.dump({"machine": bench.machine_line(), "sequences": rows}, file, indent=1)


if __name__ == "__main__":
    main()
