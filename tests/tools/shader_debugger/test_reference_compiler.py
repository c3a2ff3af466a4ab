"""Khronos' reference compiler accepts every variant of every program: it is stricter than Mesa, and no driver may be as
lenient."""

import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor

import pytest

from blinkgl.gl.shader import expand, normalised, shader_folder, stages_of
from blinkgl.tools.shader_debugger.check import lookups, variants

COMPILER = "glslangValidator"
ENDINGS = {"vertex": "vert", "geometry": "geom", "fragment": "frag"}


def complaints(folder, number: int, program: str, defines: dict) -> str:
    """What the compiler says of a variant whose stages are compiled and linked; "" if nothing."""
    files = []
    for stage in stages_of(defines):
        files.append(folder / f"{number}.{ENDINGS[stage]}")
        files[-1].write_text(expand(program, stage, defines).text)
    done = subprocess.run([COMPILER, "-l", *map(str, files)], capture_output=True, text=True, check=False)
    said = "" if done.returncode == 0 else done.stdout + done.stderr
    return said and f"{program} {dict(normalised(defines))}:\n{said}"


@pytest.mark.slow
def test_every_variant_of_every_program(tmp_path):
    if shutil.which(COMPILER) is None:
        pytest.skip(f"no {COMPILER} (Debian's glslang-tools)")
    wanted = []
    for path in shader_folder().iterdir():
        if path.name.endswith(".glsl"):
            wanted += [(path.name, defines) for defines in (variants(path.name) or [{}]) + lookups(path.name)]
    assert len(wanted) > 800
    with ThreadPoolExecutor(2) as pool:
        said = pool.map(lambda one: complaints(tmp_path, one[0], *one[1]), enumerate(wanted))
        assert not [text for text in said if text][:3]


def test_a_mistake_is_found(tmp_path):
    """A varying of another type in the next stage, found when the stages are linked."""
    if shutil.which(COMPILER) is None:
        pytest.skip(f"no {COMPILER} (Debian's glslang-tools)")
    mistaken = tmp_path / "mistaken.glsl"
    mistaken.write_text(
        "#ifdef VERTEX_SHADER\nout vec2 uv;\nvoid main() { uv = vec2(0); gl_Position = vec4(0); }\n#endif\n"
        "#ifdef FRAGMENT_SHADER\nin vec3 uv;\nout vec4 colour;\nvoid main() { colour = vec4(uv, 1); }\n#endif\n"
    )
    assert "uv" in complaints(tmp_path, 0, str(mistaken), {})
