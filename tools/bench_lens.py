"""What a lens costs: processor time of event frames and of labels with a pin-hole camera, radtan and equidistant, in
turns; and how far its labels are from float64 rays.

    python -m blinkgl.tools.bench_lens [--size 346x260] [--rounds 5]
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from blinkgl.camera.drawing import seen_through
from blinkgl.config.sequence import load_run
from blinkgl.gl import create_context
from blinkgl.labels import LabelRequest
from blinkgl.render import reference
from blinkgl.render.antialiasing import samples_of
from blinkgl.render.passes import Luminance
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import sequence_scene

LENSES = {
    "pinhole": [],
    "radtan": ["camera.lens=radtan", "camera.distortion=[-0.37, 0.19, 1.0e-4, -2.0e-4]"],
    "equidistant": ["camera.lens=equidistant", "camera.distortion=[-0.02, 0.005, 0, 0]", "camera.fov=80"],
}
LABELS = LabelRequest("depth", "ids", "flow_forward", "occlusion_forward")
SPAN = 50_000_000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", default="346x260")
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    width, height = options.size.split("x")
    run = Path(__file__).resolve().parent.parent / "configs" / "flying_objects.yaml"
    size = [f"camera.width={width}", f"camera.height={height}"]
    with create_context() as gl:
        renderers = {}
        for name, lens in LENSES.items():
            config = load_run(run, [*size, "scene.objects.count=20", *lens]).sequence(2)
            renderers[name] = Renderer(gl, sequence_scene(config, 2, run.parent), config.render)
        finer = Luminance(samples=samples_of("ssaa2"))
        passes = {
            "event frame": lambda r, t: r.luminance(t).view(),
            "event frame, ssaa2": lambda r, t: r.draw(r.seen(finer, smooth=True), t).view(),
            "small velocity": lambda r, t: r.velocity_of_movers(t, 4).read(),
            "labels": lambda r, t: r.labels(t, LABELS, t + SPAN),
        }
        spent = {name: {what: [] for what in passes} for name in renderers}
        for k in range(options.rounds + 1):
            for name, renderer in renderers.items():
                for what, draw in passes.items():
                    started = time.process_time()
                    draw(renderer, 200_000_000 + 10_000_000 * k)
                    if k:  # the first compiles
                        spent[name][what].append(time.process_time() - started)
        for name, renderer in renderers.items():
            camera = renderer.scene.camera
            flat = seen_through(camera)
            print(f"{name:12} drawn {flat.width}x{flat.height}", end="")
            for what, times in spent[name].items():
                base = np.median(spent["pinhole"][what])
                print(f"  {what} {1e3 * np.median(times):.1f} ms ({np.median(times) / base:.2f}x)", end="")
            print()
            _errors(renderer)


def _errors(renderer: Renderer) -> None:
    t = 230_000_000
    frame, true = renderer.labels(t, LABELS, t + SPAN), reference.render(renderer.scene, t, forward_ns=t + SPAN)
    inner = ~reference.silhouette_band(true.instance, true.depth, 2) & true.hit
    both = inner & frame.forward.valid & true.forward.valid
    flow = np.abs(frame.forward.flow - true.forward.flow)[both].max(axis=-1)
    depth = np.abs(frame.depth / np.where(true.hit, true.depth, 1.0) - 1.0)[inner]
    wrong, hidden = frame.ids != true.instance, frame.forward.occluded != true.forward.occluded
    most = np.abs(true.forward.flow[both]).max()
    off = f"off silhouettes, {100 * inner.mean():.0f} % of the pixels"
    print(
        f"{'':12} {off}: flow median {np.median(flow):.1e}, 99 % {np.quantile(flow, 0.99):.1e}, largest "
        f"{flow.max():.1e} px, over 1e-3 px in {100 * (flow > 1e-3).mean():.2f} % (flow up to {most:.0f} px); "
        f"depth 99 % {np.quantile(depth, 0.99):.1e}; wrong ids {wrong[inner].sum()}, of all pixels "
        f"{100 * wrong.mean():.2f} %; masks that differ {100 * hidden[both].mean():.3f} %"
    )


if __name__ == "__main__":
    main()
