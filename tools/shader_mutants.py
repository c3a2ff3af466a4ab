"""Mutants of the shaders that light a scene, judged by the shader debugger: does ``blinkgl shader diff`` see a wrong
line? And of the one that filters silhouettes, judged by its slow twin (edges_twin.py).

    python -m blinkgl.tools.shader_mutants CONFIG [--files lights shadows …] [--count 100] [--seed 1]
    python -m blinkgl.tools.shader_mutants CONFIG [CONFIG …] --files edges [--count 100] [--seed 1] [--at SECONDS]

Small edits of one line (as in ``mutate.py``) of shaders/include/NAME.glsl, in the lines that are compiled for the
configuration's first label; each is drawn, and dies where a term of the light, a shadow map or the result is over its
tolerance, does not compile, or cannot be drawn. Survivors are printed. ``tests/tools/lit.yaml`` has all terms.

Of edges.glsl every line is mutated, and a mutant dies where a picture of one of the configurations differs from the
twin's by more than a thousandth of its mean. ``configs/trade/{thin,deforming,small_objects,grazing}.yaml`` have wires,
folds, tangles, seams and a horizon; ``tests/render/test_edges.py -k twin`` has what these have not. What is listed in
``tools/mutants_equivalent.txt`` is not tried.
"""

from __future__ import annotations

import argparse
import random
import shutil
import tempfile
from pathlib import Path

import numpy as np

from blinkgl.config.sequence import load_run
from blinkgl.errors import BlinkGLError
from blinkgl.gl import GLContext, ShaderLoader, create_context
from blinkgl.gl.shader import STAGES, expand, shader_folder
from blinkgl.render.antialiasing import samples_of
from blinkgl.render.contours import Lines
from blinkgl.render.passes import Edged, Luminance, Pass
from blinkgl.render.passes.edged import SKY
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import sequence_scene
from blinkgl.tools.edges_twin import filtered, read_both
from blinkgl.tools.mutate import Mutant, excuses, mutants_of
from blinkgl.tools.shader_debugger import compare, moments
from blinkgl.tools.shader_debugger.preprocess import active_lines
from blinkgl.tools.shader_debugger.session import moment, open_folder, open_renderer, open_subject

FILES = ("light", "lights", "shadows", "surface")
JUDGED = (*moments.LOOKUPS[3:], "")


class Asked(ShaderLoader):
    """Remembers every variant that it compiled."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.asked: set[tuple[str, tuple]] = set()

    def program(self, name, defines=None):
        self.asked.add((name, tuple(sorted((defines or {}).items()))))
        return super().program(name, defines)

    def lines(self) -> set[tuple[str, int]]:
        """(file, line) of all that was compiled."""
        found = set()
        for name, defines in self.asked:
            for stage in STAGES:
                source = expand(name, stage, dict(defines), self.folder)
                found |= {source.locate(number) for number, _ in active_lines(source.text)}
        return found


class Judge:
    """Of one moment of a configuration. compiled : (file, line) of its programs."""

    def __init__(self, renderer, subject, when):
        self.renderer, self.when, self.log_eps = renderer, when, subject.log_eps
        self.right = moments.GpuMoment(renderer, when, subject.log_eps)
        self.comparison = compare.Comparison(self.right, moments.open_reference(subject, when, renderer.maps))
        self.names = [
            name
            for name in self.comparison.names()
            if name in moments.MAPS or moments.lookup_of(name)[1] in JUDGED[:-1] or name in ("luminance", "colour")
        ]
        loader = Asked(renderer.gl.ctx, renderer.gl.shaders.folder)
        if wrong := self.wrong(loader):
            raise BlinkGLError(f"already wrong without a mutant: {', '.join(wrong)}")
        self.compiled = loader.lines()

    def wrong(self, loader: ShaderLoader) -> list[str]:
        """Buffers that are over their tolerance with these shaders, up to the first pass that has one."""
        gpu = moments.GpuMoment(self.renderer, self.when, self.log_eps)
        gpu.keep(self.right, ("part", "triangle", "local"))
        comparison = self.comparison.of(gpu)
        ours = self.renderer.gl.shaders
        self.renderer.use_shaders(loader)
        try:
            found: list[str] = []
            for of in ("shadow_map", "luminance", "colour"):
                found += [n for n in self.names if n.startswith(of) and not comparison.report(n).passed]
                if found:
                    break
            return found
        finally:
            self.renderer.use_shaders(ours)


class EdgesJudge:
    """Of frames of several configurations at a time, s, 120 x 90 px. compiled : (file, line) of what was drawn."""

    def __init__(self, gl: GLContext, configs: list[str], at: float):
        self.gl = gl
        self.drawn: list[tuple[str, Renderer, Pass, int, np.ndarray, float]] = []
        loader = Asked(gl.ctx, gl.shaders.folder)
        for path in configs:
            config = load_run(path, ["camera.width=120", "camera.height=90"]).sequence(0)
            render = config.render.model_copy(update={"antialiasing": "edges"})
            renderer, t_ns = Renderer(gl, sequence_scene(config, 0), render, whole=True), round(at * 1e9)
            self.renderer = renderer
            pass_ = Luminance(False, samples_of("edges"))
            picture, depths = read_both(renderer.draw(pass_, t_ns))
            moment = renderer.moment(t_ns)
            items = [item for item in moment.visible if item.layer != SKY]
            pixels, crossings = Lines().in_pixels(moment, items, renderer.width, renderer.height)
            pixel = 2 / (renderer.width * abs(moment.view.projection[0, 0]))
            true = filtered(picture, depths, pixels, crossings, pixel)
            self.drawn.append((Path(path).stem, renderer, Edged(pass_), t_ns, true, 1e-3 * float(picture.mean())))
        if wrong := self.wrong(loader):
            raise BlinkGLError(f"already wrong without a mutant: {', '.join(wrong)}")
        self.compiled = loader.lines()

    def wrong(self, loader: ShaderLoader) -> list[str]:
        """The first configuration whose picture is not the twin's, with these shaders; [] where all are."""
        ours, self.gl.shaders = self.gl.shaders, loader
        try:
            for name, renderer, pass_, t_ns, true, tolerance in self.drawn:
                renderer._painter.strokes.forget()  # noqa: SLF001 - the others' programs are not what is tried
                if not np.abs(renderer.draw(pass_, t_ns).read() - true).max() <= tolerance:
                    return [name]
            return []
        finally:
            self.gl.shaders = ours
            for _, renderer, *_ in self.drawn:
                renderer._painter.strokes.forget()  # noqa: SLF001


def judged(judge: Judge | EdgesJudge, folder: Path, mutant: Mutant) -> str:
    """What tells a mutant: a buffer, or "not drawn"; "" when it lives. folder : a copy of the shaders."""
    path = folder / mutant.path.removeprefix("shaders/")
    source = path.read_text()
    path.write_text(mutant.apply(source))
    try:
        wrong = judge.wrong(ShaderLoader(judge.renderer.gl.ctx, open_folder(str(folder))))
        return wrong[0] if wrong else ""
    except Exception:  # noqa: BLE001 - a shader that does not compile, or a uniform that no longer fits
        return "not drawn"
    finally:
        path.write_text(source)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("configs", nargs="+", metavar="CONFIG")
    parser.add_argument("--files", nargs="*", default=list(FILES))
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--at", type=float, default=0.01, help="s; of the frames that edges are judged in")
    options = parser.parse_args()
    if options.files == ["edges"]:
        with create_context() as gl:
            tried(EdgesJudge(gl, options.configs, options.at), ["edges.glsl"], options)
        return
    subject = open_subject(options.configs[0])
    with open_renderer(subject) as renderer:
        judge = Judge(renderer, subject, moment(subject))
        tried(judge, [f"include/{file}.glsl" for file in options.files], options)


def tried(judge: Judge | EdgesJudge, files: list[str], options: argparse.Namespace) -> None:
    """Tries mutants of these files of shaders/, and prints what lives and what tells the others."""
    with tempfile.TemporaryDirectory(prefix="blinkgl-mutants-") as name:
        folder = Path(name) / "shaders"
        shutil.copytree(Path(str(shader_folder())), folder)
        mutants = [
            mutant
            for file in files
            for mutant in mutants_of(f"shaders/{file}", (folder / file).read_text(encoding="utf-8"))
            if (file, mutant.line) in judge.compiled
        ]
        excused = excuses(mutants)
        mutants = [mutant for mutant in mutants if mutant.name not in excused]
        chosen = random.Random(options.seed).sample(mutants, min(options.count, len(mutants)))
        told: dict[str, int] = {}
        for mutant in sorted(chosen, key=lambda m: (m.path, m.line, m.column)):
            by = judged(judge, folder, mutant)
            told[by] = told.get(by, 0) + 1
            if not by:
                print(f"lives: {mutant.name}", flush=True)
    dead = len(chosen) - told.pop("", 0)
    print(f"{dead} of {len(chosen)} died ({len(mutants)} in compiled lines, {len(excused)} are equivalent); told by:")
    for by, count in sorted(told.items(), key=lambda pair: -pair[1]):
        print(f"  {count:4} {by}")


if __name__ == "__main__":
    main()
