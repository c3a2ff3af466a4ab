"""``blinkgl shader check`` and ``show``: compile every program, and report each error with its place."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import moderngl

from blinkgl.errors import ConfigError
from blinkgl.gl import create_context
from blinkgl.gl.shader import GEOMETRY, STAGES, ShaderError, ShaderSource, expand, link, stages_of
from blinkgl.render.draw_items import MORE, Kind
from blinkgl.render.lighting import EXAMPLES
from blinkgl.render.passes import PASSES, Pass, ScenePass
from blinkgl.render.passes.own import own_passes, own_programs
from blinkgl.scene.shapes.table import DEFORMERS, define_of
from blinkgl.tools.shader_debugger.diagnostics import Diagnostic, diagnose
from blinkgl.tools.shader_debugger.session import DEBUG_PROGRAM, LOOKUPS, Inspection, files_of, open_folder

# ---------------------------------------------------------------------------------------------------------------------
# Every program in every variant that a pass uses for some configuration and scene.

SURFACES = (("TINTED", "EMISSIVE"), ("EMISSIVE", "EMISSION_MAP"), ("GLOSSY",), ("BUMPED",), MORE)
"""Material features besides a base colour: each of MORE alone, where it is possible, and all of them."""
KINDS = [Kind(textured, lit, both) for textured, lit, both in product((False, True), repeat=3)]


def kinds() -> list[Kind]:
    """Return all kinds of material, and one kind for each shape that changes with time."""
    shapes = {
        (("DEFORM", 1), (define_of(deformer.glsl), 1), ("SHAPE_ROWS", 64), *sorted(sizes.items())): None
        for deformer in DEFORMERS.values()
        for sizes in deformer.examples
    }
    # Each material feature alone, and all of them on a shape that changes.
    surfaces = [Kind(True, False, False, masked=True, more=("TINTED",), rgb=True)]
    for rgb in (False, True):
        surfaces += [Kind(True, True, False, rgb=rgb, more=more) for more in SURFACES]
    bent = next(iter(shapes))
    surfaces.append(Kind(True, True, True, bent, True, more=MORE))
    return [*KINDS, *(Kind(True, True, True, shape) for shape in shapes), *surfaces]


def lookups(program: str) -> list[dict[str, object]]:
    """Return the defines of the variants in which a production program shows its texture lookups."""
    return _variant_defines(program, (type(pass_) for pass_ in LOOKUPS.values()))


def variants(program: str) -> list[dict[str, object]] | None:
    """Return the defines of every variant of a program file, without :func:`lookups`; None for a file that no pass
    uses."""
    return _variant_defines(program, dict.fromkeys((*PASSES, Inspection, *own_passes()))) or None


def _lights(pass_: Pass, kind: Kind | None) -> list[dict[str, object]]:
    """Return no defines for the plain light, and an example of each feature of light; one of them for shapes."""
    if kind is None or not (kind.lit and pass_.lit):
        return [{}]
    if kind.more:
        three = {"RGB": 1} if (kind.rgb if pass_.one_channel else "GLOSSY" in kind.more) else {}
        lights = [light | three for light in (EXAMPLES[0], EXAMPLES[-1])]
        return lights if kind.whole else [{}, *lights]
    if kind.shape:
        return [{}, EXAMPLES[-1]]
    rgb = (kind.textured or not pass_.one_channel) and not kind.two_sided
    coloured = [light | {"RGB": 1} for light in EXAMPLES if "LIGHTS" in light] if rgb else []
    return [{}, *EXAMPLES, *coloured]


def _variant_defines(program: str, passes: Iterable[type[Pass]]) -> list[dict[str, object]]:
    variants: dict[tuple, dict[str, object]] = {}
    for one in passes:
        for pass_ in one.every_kind() if one.program == program else ():
            for kind in kinds() if isinstance(pass_, ScenePass) else [None]:
                plain = pass_.defines(kind) | (kind.defines(pass_.lit) if kind is not None else {})
                # Fog does not depend on the material: the simplest and the most complex stand for all.
                foggy = pass_.lit and kind in (KINDS[0], KINDS[-1])
                for more in (*_lights(pass_, kind), *([{"FOG": 1}] if foggy else [])):
                    defines = plain | more
                    variants.setdefault(tuple(sorted(defines.items())), defines)
    return list(variants.values())


@dataclass
class Finding:
    """A message about some variants of a program. examples : defines of the first of them."""

    diagnostic: Diagnostic
    program: str
    count: int = 0
    example: dict = field(default_factory=dict)


@dataclass
class Result:
    """The result of a check. renderer : the compiler.   programs : name -> number of variants.   findings : by program
    and message."""

    renderer: str = ""
    seconds: float = 0.0
    programs: dict[str, int] = field(default_factory=dict)
    findings: dict[tuple[str, Diagnostic], Finding] = field(default_factory=dict)

    @property
    def errors(self) -> list[Finding]:
        """Return each error once, in order of occurrence."""
        return list(self.findings.values())

    def as_dict(self) -> dict:
        return {
            "renderer": self.renderer,
            "seconds": self.seconds,
            "programs": self.programs,
            "errors": [
                asdict(f.diagnostic) | {"program": f.program, "variants": f.count, "example": f.example}
                for f in self.errors
            ],
        }


def check(files: list[str], shaders: str | None = None, backend: str = "auto", device: int = 0) -> Result:
    """Compile every variant of every program, or of the programs that use ``files``.

    Raises ConfigError for a file that is no shader, GLError without OpenGL or without a readable folder."""
    folder, names = _programs(files, shaders)
    result = Result()
    started = time.perf_counter()
    with create_context(backend, device) as gl:
        result.renderer = gl.renderer
        for name in names:
            check_program(gl.ctx, folder, name, result)
    result.seconds = time.perf_counter() - started
    return result


def check_program(ctx: moderngl.Context, folder: Any, name: str, result: Result) -> None:
    """Add every variant of one program to ``result``."""
    # Programs that no pass uses are the user's own: they are compiled unchanged.
    wanted = variants(name)
    wanted = [{}] if wanted is None else wanted + lookups(name)  # [{}]: the user's own program, unchanged
    result.programs[name] = len(wanted)
    for defines in wanted:
        sources: dict[str, ShaderSource] = {}
        try:
            for stage in stages_of(defines):
                sources[stage] = expand(name, stage, defines, folder)
            program = link(ctx, sources)
        except ShaderError as error:
            # An undefined name in an include is reported by every stage that includes it.
            for diagnostic in dict.fromkeys(diagnose(error, sources, folder)):
                if diagnostic.kind == "error":
                    finding = result.findings.setdefault((name, diagnostic), Finding(diagnostic, name, example=defines))
                    finding.count += 1
            continue
        program.release()


def _programs(files: list[str], shaders: str | None):
    """Return the folder, and the program files to compile."""
    folder = open_folder(shaders)
    of_plugins = {str(path.resolve()): str(path) for path in own_programs()}
    if not files:
        return folder, [*(path.name for path in files_of(folder) if path.parent == folder), *of_plugins.values()]
    chosen = [of_plugins[full] for text in files if (full := str(Path(text).resolve())) in of_plugins]
    files = [text for text in files if str(Path(text).resolve()) not in of_plugins]
    if files and shaders is None:  # files of another folder select that folder
        first = Path(files[0]).resolve()
        # An include is below include/, at any depth; a program is in the folder itself.
        home = next((folder.parent for folder in first.parents if folder.name == "include"), first.parent)
        if first.is_file() and home != folder.resolve():
            if not (home / DEBUG_PROGRAM).is_file():
                accepted = "a file of a shaders/ folder, or one of a pass that --plugin FILE.py registers"
                raise ConfigError("no pass uses it", where="check", value=files[0], accepted=accepted)
            folder = open_folder(str(home))
    known = files_of(folder)
    programs = [path.name for path in known if path.parent == folder]
    for text in files:
        path = next(
            (
                p
                for p in known
                if p.resolve() == Path(text).resolve() or str(p.relative_to(folder)) == text or p.name == text
            ),
            None,
        )
        if path is None:
            raise ConfigError(
                "no such shader",
                where="check",
                value=text,
                accepted="one of " + ", ".join(str(p.relative_to(folder)) for p in known),
            )
        # For an include, compile all programs that contain it.
        wanted = (
            [path.name]
            if path.parent == folder
            else [name for name in programs if _includes(folder, name, path.relative_to(folder).as_posix())]
        )
        chosen += [name for name in wanted if name not in chosen]
    return folder, chosen


def _includes(folder, program: str, include: str) -> bool:
    try:
        return include in expand(program, "fragment", {}, folder).files
    except ShaderError:
        return True  # error in its own includes: compile it, to report that


def as_text(result: Result) -> str:
    """Return the check as text."""
    total = sum(result.programs.values())
    lines = []
    for finding in result.errors:
        d = finding.diagnostic
        lines += [
            f"{d.where}: {d.kind}: {d.text}" + (f" [{d.stage} stage]" if d.stage else ""),
            d.excerpt,
            (
                f"         in {finding.count} of {result.programs[finding.program]} variants of {finding.program}, "
                f"first {_defines(finding.example)}"
            ),
            "",
        ]
    lines += [f"{name:<18} {count:>4} variants" for name, count in result.programs.items()]
    verdict = (
        f"{len(result.errors)} error{'s' if len(result.errors) != 1 else ''}"
        if result.errors
        else "all compile and link"
    )
    lines.append(f"{verdict}; {total} variants in {result.seconds:.1f} s on {result.renderer}")
    return "\n".join(lines)


def _defines(defines: dict) -> str:
    return " ".join(f"{key}={value}" for key, value in defines.items()) or "without defines"


# ------------------------------------------------------------------------------------------------- show


def show_source(program: str, defines: list[str], stage: str, numbers: bool, shaders: str | None) -> str:
    """Return the output of ``blinkgl shader show``. Raises ConfigError, ShaderError."""
    table = {name: value or "1" for name, _, value in (text.partition("=") for text in defines)}
    if stage not in (*STAGES, GEOMETRY, "both"):
        raise ConfigError(
            "unknown stage", where="--stage", value=stage, accepted="vertex, geometry, fragment, or both for all"
        )
    folder = open_folder(shaders)
    out = []
    for one in stages_of(table) if stage == "both" else (stage,):
        source = expand(program, one, table, folder)
        if stage == "both":
            out.append(f"// ---- {one} stage of {program}\n")
        for number, line in enumerate(source.text.split("\n")[:-1], 1):
            file, own = source.locate(number)
            out.append((f"{f'{file}:{own}' if file else '-':<28} | " if numbers else "") + line + "\n")
    return "".join(out)
