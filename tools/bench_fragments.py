"""What cheaper fragments would save and what they would cost in events: tried, and not what BlinkGL draws.

    python -m blinkgl.tools.bench_fragments [flying_objects dense_texture grazing] [--frames 30]

The luminance pass of `antialiasing: edges` at mip bias -1, of clips of configs/trade, frames 1 px apart: as it is, with
the nearest mip level in the place of two (dithered from pixel to pixel, too), with textures of whole floats (as it
was), and without any light in the fragment, which is the wrong picture and bounds what light out of the fragment could
save. All take turns frame by frame, so that a busy machine slows them alike; processor milliseconds a frame, read-back
included. Events (ESIM) and frames are judged against 6 x 6 times finer ones. `--threshold 0.02`: small ones, which
see more.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

import moderngl
import numpy as np

from blinkgl.config.events import EsimConfig
from blinkgl.config.sequence import RenderConfig, load_run
from blinkgl.gl import GLContext, ShaderLoader, create_context
from blinkgl.gl.shader import shader_folder
from blinkgl.machine import bench
from blinkgl.render import resources
from blinkgl.scene.build import sequence_scene
from blinkgl.tools.bench_filtering import Judged, displacement_frames
from blinkgl.trade.matching import match_events

EDGES = RenderConfig(antialiasing="edges", mip_bias=-1.0)
FINER, LIMIT_US, ROUNDS = 6, 10_000, 3
_LEVEL = "row), 1e-30));\n"
_NOISE = "    level += fract(52.9829189 * fract(dot(gl_FragCoord.xy, vec2(0.06711056, 0.00583715)))) - 0.5;\n"
EDITS = {
    "dithered": [(_LEVEL, _LEVEL + _NOISE)],
    "unlit": [("#if defined(LIT) && !defined(LIT_AT_CORNERS)", "#if 0"), ("#ifdef LIT\n", "#if 0\n")],
}
"""Of luminance.glsl."""
VARIANTS = {
    "as it is": (),
    "nearest level": ("nearest",),
    "nearest level, dithered": ("nearest", "dithered"),
    "whole floats": ("whole",),
    "nearest level, whole floats": ("nearest", "whole"),
    "without light": ("unlit",),
}


@contextmanager
def made_so(how: tuple[str, ...]):
    """Textures that are uploaded meanwhile are of this kind."""
    minified = moderngl.LINEAR_MIPMAP_NEAREST if "nearest" in how else moderngl.LINEAR_MIPMAP_LINEAR
    stored = (lambda image: image) if "whole" in how else resources.half_floats
    with patch.object(resources, "half_floats", stored), patch.object(moderngl, "LINEAR_MIPMAP_LINEAR", minified):
        yield


def shaders_of(how: tuple[str, ...], folder: Path) -> Path:
    """A copy of the shaders with the edits of a variant. Raises ValueError where luminance.glsl is another."""
    copy = folder / "_".join(("shaders", *how))
    shutil.copytree(Path(str(shader_folder())), copy)
    path = copy / "luminance.glsl"
    source = path.read_text(encoding="utf-8")
    for before, after in (edit for name in how for edit in EDITS.get(name, ())):
        if before not in source:
            raise ValueError(f"luminance.glsl has changed: no {before!r}")
        source = source.replace(before, after)
    path.write_text(source, encoding="utf-8")
    return copy


def compared(gl: GLContext, clip: str, frames: int, threshold: float, folder: Path) -> dict[str, dict]:
    """variant -> cpu_ms, rms and flicker of the logarithm, missed and extra (shares of the reference's), late (us)."""
    config = load_run(f"configs/trade/{clip}.yaml").sequence(0)
    scene = sequence_scene(config, 0)
    times, esim, ours = (
        displacement_frames(gl, scene, 1.0, frames),
        EsimConfig(contrast_threshold=threshold),
        gl.shaders,
    )
    reference = Judged(gl, scene, EDGES, esim, FINER)
    tried: dict[str, tuple[Judged, ShaderLoader]] = {}
    for name, how in VARIANTS.items():
        gl.shaders = loader = ShaderLoader(gl.ctx, shaders_of(how, folder))
        with made_so(how):
            tried[name] = Judged(gl, scene, EDGES, esim), loader
            tried[name][0].renderer.luminance(times[0]).read()
    names, off, cpu = list(VARIANTS), {name: [] for name in VARIANTS}, {name: [] for name in VARIANTS}
    for k, t_ns in enumerate(times):
        gl.shaders = ours
        true = np.log(reference.step(t_ns) + 1e-3)
        for name in names[k % len(names) :] + names[: k % len(names)]:
            one, gl.shaders = tried[name]
            off[name].append(np.log(one.step(t_ns) + 1e-3) - true)
    for k, t_ns in enumerate(ROUNDS * times):
        for name in names[k % len(names) :] + names[: k % len(names)]:
            one, gl.shaders = tried[name]
            started = time.process_time()
            one.renderer.luminance(t_ns).read(out=one.frame)
            cpu[name].append(time.process_time() - started)
    gl.shaders = ours
    out = {}
    for name, (one, _) in tried.items():
        matching = match_events(reference.events, one.events, *one.shape, LIMIT_US)
        error = np.stack(off[name])
        out[name] = {
            "cpu_ms": 1e3 * float(np.median(cpu[name])),
            "rms": float(np.sqrt(np.mean(error**2))),
            "flicker": float(np.sqrt(np.mean(np.diff(error, axis=0) ** 2))),
            "missed": float((~matching.matched).mean()),
            "extra": matching.extra / len(reference.events),
            "late": float(np.median(np.abs(matching.dt_us[matching.matched]))),
        }
        one.renderer.release()
    reference.renderer.release()
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", nargs="*", default=["flying_objects", "dense_texture", "grazing"])
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--threshold", type=float, default=0.2)
    options = parser.parse_args()
    with create_context() as gl:
        print(bench.machine_line(gl.renderer))
        for clip in options.clips:
            with tempfile.TemporaryDirectory(prefix="blinkgl-fragments-") as folder:
                rows = compared(gl, clip, options.frames, options.threshold, Path(folder))
            for name, r in rows.items():
                print(
                    f"{clip:<16} {name:<28} {r['cpu_ms']:6.2f} ms, {r['cpu_ms'] / rows['as it is']['cpu_ms']:.2f};"
                    f" frames {r['rms']:.4f}, flicker {r['flicker']:.4f}; events missed {100 * r['missed']:.1f} %,"
                    f" extra {100 * r['extra']:.1f} %, {r['late']:.0f} us",
                    flush=True,
                )


if __name__ == "__main__":
    main()
