"""Mutants of the shaders that light a scene, judged by the shader debugger: does ``blinkgl shader diff`` see a wrong
line?

    python -m blinkgl.tools.shader_mutants CONFIG [--files lights shadows …] [--count 100] [--seed 1]

Small edits of one line (as in ``mutate.py``) of shaders/include/NAME.glsl, in the lines that are compiled for the
configuration's first label; each is drawn, and dies where a term of the light, a shadow map or the result is over its
tolerance, does not compile, or cannot be drawn. Survivors are printed. ``tests/tools/lit.yaml`` has all terms.
"""

from __future__ import annotations

import argparse
import random
import shutil
import tempfile
from pathlib import Path

from blinkgl.errors import BlinkGLError
from blinkgl.gl import ShaderLoader
from blinkgl.gl.shader import STAGES, expand, shader_folder
from blinkgl.tools.mutate import Mutant, mutants_of
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


def judged(judge: Judge, folder: Path, mutant: Mutant) -> str:
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
    parser.add_argument("config")
    parser.add_argument("--files", nargs="*", default=list(FILES))
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    subject = open_subject(options.config)
    with open_renderer(subject) as renderer, tempfile.TemporaryDirectory(prefix="blinkgl-mutants-") as name:
        judge = Judge(renderer, subject, moment(subject))
        folder = Path(name) / "shaders"
        shutil.copytree(Path(str(shader_folder())), folder)
        mutants = [
            mutant
            for file in options.files
            for mutant in mutants_of(
                f"shaders/include/{file}.glsl", (folder / "include" / f"{file}.glsl").read_text(encoding="utf-8")
            )
            if (f"include/{file}.glsl", mutant.line) in judge.compiled
        ]
        chosen = random.Random(options.seed).sample(mutants, min(options.count, len(mutants)))
        told: dict[str, int] = {}
        for mutant in sorted(chosen, key=lambda m: (m.path, m.line, m.column)):
            by = judged(judge, folder, mutant)
            told[by] = told.get(by, 0) + 1
            if not by:
                print(f"lives: {mutant.name}", flush=True)
    dead = len(chosen) - told.pop("", 0)
    print(f"{dead} of {len(chosen)} died ({len(mutants)} in compiled lines); told by:")
    for by, count in sorted(told.items(), key=lambda pair: -pair[1]):
        print(f"  {count:4} {by}")


if __name__ == "__main__":
    main()
