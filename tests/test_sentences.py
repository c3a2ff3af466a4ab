"""What users are told when something is wrong: the form of every sentence in the sources, and the exact words that the
commands print for a hundred mistakes, as a golden file that a person reads as a text (``BLINKGL_UPDATE_GOLDEN=1`` makes
``tests/golden/commands.txt`` again).
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import pytest
from pinned import only_with_pinned
from sentences import sentences

from blinkgl import cli

GOLDEN = Path(__file__).parent / "golden" / "commands.txt"

BASE = "camera: {width: 32, height: 24}\n"
FILES = {
    "good.yaml": BASE,
    "unknown_key.yaml": BASE + "evnts: {emulator: esim}\n",
    "brackets.yaml": BASE + "'[bold]red[/bold]': 1\n",
    "tabs.yaml": "camera:\n\twidth: 3\n",
    "list.yaml": "- 1\n- 2\n",
    "type.yaml": "camera: {width: wide}\n",
    "negative.yaml": "camera: {width: -3}\n",
    "fraction.yaml": "camera: {width: 3.5}\n",
    "both.yaml": "camera: {fov: 60, focal: 300}\n",
    "kind.yaml": "timeline: {kind: sometimes}\n",
    "flow.yaml": "labels: {flow: both}\n",
    "interval.yaml": "labels: {flow: [1/100, 1/0]}\n",
    "far_interval.yaml": "labels: {flow: [0.1, 5]}\ntime: {duration: 2}\n",
    "emulator.yaml": "events: {emulator: magic}\n",
    "curve.yaml": "events: {emulator: v2e}\ntimeline: {kind: uniform, reconstruction: pchip}\n",
    "sensor.yaml": "sensor: davis1000\n",
    "quality.yaml": "quality: superb\n",
    "empty_range.yaml": "events: {contrast_threshold: {uniform: [0.3, 0.1]}}\n",
    "bad_range.yaml": "events: {contrast_threshold: {uniform: 0.3}}\n",
    "weights.yaml": "events: {contrast_threshold: {weighted: [1, 2]}}\n",
    "seed.yaml": "seed: -1\n",
    "inline.yaml": "scene: {kind: explicit, objects: [{primitive: cuboid}]}\n",
    "name.yaml": "scene: {kind: explicit, camera: {position: [-3, 0, 0]}, meshes: {a: {primitive: cuboid}}, "
    "objects: [{mesh: b}]}\n",
    "texture.yaml": "scene: {kind: explicit, camera: {position: [-3, 0, 0]}, meshes: {a: {primitive: cuboid}}, "
    "materials: {m: {texture: missing.png}}, objects: [{mesh: a, material: m}]}\n",
    "primitive.yaml": "scene: {kind: explicit, camera: {position: [-3, 0, 0]}, meshes: {a: {primitive: dodecahedron}}, "
    "objects: [{mesh: a}]}\n",
    "parameter.yaml": "scene: {kind: explicit, camera: {position: [-3, 0, 0]}, meshes: {a: {primitive: sphere, "
    "parameters: {sides: 3}}}, objects: [{mesh: a}]}\n",
    "mesh.yaml": "scene: {kind: explicit, camera: {position: [-3, 0, 0]}, meshes: {a: {file: broken.obj}}, "
    "objects: [{mesh: a}]}\n",
    "glb.yaml": "scene: {kind: file, path: broken.glb}\n",
    "keyframes.yaml": "scene: {kind: explicit, camera: {position: [-3, 0, 0]}, meshes: {a: {primitive: cuboid}}, "
    "objects: [{mesh: a, keyframes: [{time: 1}, {time: 0}]}]}\n",
    "turn.yaml": "scene: {kind: explicit, camera: {position: [-3, 0, 0]}, meshes: {a: {primitive: cuboid}}, "
    "objects: [{mesh: a, keyframes: [{time: 0}, {time: 1, euler: [0, 0, 40000]}]}]}\n",
    "corner.yaml": "timeline: {min_step_us: {uniform: [100, 900]}, max_step_us: {uniform: [500, 2000]}}\n",
    "long.yaml": "time: {duration: 5000}\n",
    "bomb.yaml": "".join(
        f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" if k else "a0: &a0 [1]\n" for k in range(10)
    ),
    "pool.yaml": "scene: {kind: random, pool: {folders: [nowhere]}}\n",
    "frames.yaml": "frames: {folders: [nowhere], fps: 30}\n",
    "broken.obj": "v 0 0 0\nf 1 2 3\n",
    "broken.h5": "this is no HDF5\n",
    "broken.glb": "glTF but not really\n",
    "broken.raw": "% evt 9.0\n",
    "words.txt": "not\nevents\n",
    "outside.csv": "t[s],x,y,p\n0.001,500,2,1\n",
    "notes.md": "# notes\n",
}
COMMANDS = [
    "",
    "generate missing.yaml --out out",
    "generate unknown_key.yaml --out out",
    "generate brackets.yaml --out out",
    "generate tabs.yaml --out out",
    "generate list.yaml --out out",
    "generate type.yaml --out out",
    "generate negative.yaml --out out",
    "generate fraction.yaml --out out",
    "generate both.yaml --out out",
    "generate kind.yaml --out out",
    "generate flow.yaml --out out",
    "generate interval.yaml --out out",
    "generate far_interval.yaml --out out",
    "generate emulator.yaml --out out",
    "generate curve.yaml --out out",
    "generate sensor.yaml --out out",
    "generate quality.yaml --out out",
    "generate empty_range.yaml --out out",
    "generate bad_range.yaml --out out",
    "generate weights.yaml --out out",
    "generate seed.yaml --out out",
    "generate inline.yaml --out out",
    "generate name.yaml --out out",
    "generate texture.yaml --out out",
    "generate primitive.yaml --out out",
    "generate parameter.yaml --out out",
    "generate mesh.yaml --out out",
    "generate glb.yaml --out out",
    "generate keyframes.yaml --out out",
    "generate turn.yaml --out out",
    "generate corner.yaml --out out",
    "generate long.yaml --out out",
    "generate bomb.yaml --out out",
    "generate pool.yaml --out out",
    "generate frames.yaml --out out",
    "generate good.yaml --out notes.md",
    "generate good.yaml --out out --set camera.width",
    "generate good.yaml --out out --set camera.width=[1,2]",
    "generate good.yaml --out out --set camera.width.x=3",
    "generate good.yaml --out out --executor slurm",
    "generate good.yaml --out out --devices 0,one",
    "generate good.yaml --out out --address 10.0.0.1:6379",
    "explain missing.yaml",
    "explain kind.yaml",
    "verify nowhere",
    "verify notes.md",
    "report nowhere",
    "export nowhere --out shards",
    "simulate missing.mp4 --out events.h5",
    "simulate notes.md --out events.h5",
    "simulate pictures --out events.h5",
    "simulate pictures --out events.xyz --fps 100",
    "simulate pictures --out events.h5 --fps 100 --sensor davis1000",
    "simulate pictures --out events.h5 --fps 100 --emulator magic",
    "simulate pictures --out events.h5 --fps 100 --gamma wide",
    "convert missing.h5 events.raw",
    "convert broken.h5 events.raw",
    "convert broken.raw events.h5",
    "convert words.txt events.h5",
    "convert outside.csv events.h5 --size 240x180",
    "convert outside.csv events.h5 --size big",
    "convert notes.md events.h5",
    "compare missing.h5 broken.h5",
    "trade missing.yaml --out trade",
    "trade frames.yaml --out trade",
    "generat good.yaml --out out",
    "generate",
    "generate good.yaml",
    "generate pictures --out out",
    "generate words.txt --out out",
    "generate good.yaml --out out --num 0",
    "generate good.yaml --out out --num many",
    "generate good.yaml --out out --workers 0",
    "generate good.yaml --out out --wokers 2",
    "generate good.yaml --out out --set camera.widht=3",
    "generate good.yaml --out out --set =3",
    "generate good.yaml --out out --seed -1",
    "verify",
    "verify pictures",
    "report pictures",
    "export pictures",
    "export pictures --out out --layout dsek",
    "simulate pictures --fps 0 --out events.h5",
    "simulate pictures --fps 100",
    "simulate pictures --fps 100 --out events.mp4",
    "simulate pictures --fps 100 --out events.h5 --set contrast=3",
    "simulate pictures --fps 100 --out events.h5 --size 640",
    "simulate pictures --fps 100 --out events.h5 --interpolate cubic",
    "simulate pictures --fps 100 --out events.h5 --max-px 0",
    "simulate words.txt --out events.h5",
    "convert words.txt",
    "convert words.txt events.aedat4",
    "convert words.txt words.txt",
    "compare notes.md",
    "compare words.txt --interval-ms 0",
    "calibrate missing.txt --out mine.yaml",
    "calibrate words.txt --still --frames pictures --out mine.yaml",
    "doctor everything",
    "import notes.md --out scene.glb",
    "shader",
    "shader show nothing.glsl",
    "shader probe good.yaml --time 0.3 --pixel middle",
    "shader probe good.yaml --time 900 --pixel 1,1",
    "shader diff good.yaml --time 0.3 --tolerance much --out diff",
    "shader passes good.yaml --time 0.3 --shaders nowhere --out passes",
    "",
][1:-1]
EFLOW_COMMANDS = [
    "",
    "train missing.yaml --out run",
    "train unknown_key.yaml --out run",
    "evaluate nowhere nowhere --out scores",
    "predict nowhere broken.h5 --out flow",
    "submit nowhere nowhere --out submission.zip",
    "models nowhere",
    "pack nowhere --name contrast-affine --card missing.yaml --out packed",
    "pack nowhere --name good --card missing.yaml --out packed",
    "",
][1:-1]


LONGEST = 240
FORM = {
    "two sentences, or none": r"[.!]$|\. [A-Z]",
    "two lines, or double spaces": r"\n|  ",
    "no word of a person": r"(?i)\b(invalid|illegal|please|sorry|oops|unable to|failed to|you|we)\b",
    "said twice": r"expected (expected|should|must)|; expected [^;]*; expected",
    "an empty part": r": \(got|: ;|expected $|\(got …\)\S*\(got",
}
"""What is wrong with a sentence that matches."""
PROPER = ("Blender", "Ray", "MuJoCo", "PyAV", "HDF5", "OpenGL", "EGL", "NumPy", "Renderer", "PNG")


def test_every_sentence_has_the_form():
    """WHERE: problem (got VALUE); expected WHAT, or a command: one line, no sentence, which begins in lower case."""
    wrong, count = [], 0
    for path, lines in sentences().items():
        for line in lines:
            count += 1
            wrong += [f"{path}: {what}: {line}" for what, pattern in FORM.items() if re.search(pattern, line)]
            problem = line.partition(": ")[2] if re.match(r"[^ ]+: ", line) else line
            capital = re.match(r"[A-Z][a-z]+ ", problem) and not problem.startswith(PROPER)
            wrong += [f"{path}: a capital: {line}"] * bool(capital)
            wrong += [f"{path}: {len(line)} characters: {line}"] * (len(line) > LONGEST)
    assert count > 800 and not wrong, "\n".join(wrong)


def test_the_form_is_seen():
    for line in ("Invalid value.", "x: ; expected a number", "a: b (got …); expected expected c", "a: please do"):
        assert any(re.search(pattern, line) for pattern in FORM.values()), line


def _said(run, capsys, words: str, folder: Path) -> str:
    status = run(words.split())
    captured = capsys.readouterr()
    text = captured.err.replace(str(folder), "…").strip()
    leftovers = sorted(p.name for p in folder.iterdir() if p.name not in FILES and p.name != "pictures")
    for name in leftovers:
        text += f"\n  (left behind: {name})"
    return f"$ {words}\n{text}\n[{status}]"


def test_commands_say_what_is_wrong(tmp_path, monkeypatch, capsys):
    pytest.importorskip("torch")  # the commands of eflow are among them
    only_with_pinned("typer", "click", "rich")
    import cv2

    monkeypatch.chdir(tmp_path)
    for name, content in FILES.items():
        (tmp_path / name).write_text(content)
    (tmp_path / "pictures").mkdir()
    for k in range(3):
        cv2.imwrite(str(tmp_path / "pictures" / f"{k}.png"), np.full((24, 32), 50 * k, np.uint8))
    said = [_said(cli.run, capsys, words, tmp_path) for words in COMMANDS]
    try:
        from eflow import cli as eflow_cli
    except ImportError:
        eflow_cli = None
    if eflow_cli is not None:
        from eflow import shipped

        monkeypatch.setattr(shipped, "FOLDER", tmp_path / "none")  # messages name what is shipped
        said += ["eflow " + _said(eflow_cli.run, capsys, words, tmp_path) for words in EFLOW_COMMANDS]
    for entry in said:
        assert "Traceback" not in entry and "left behind" not in entry, entry
        assert entry.endswith("[2]"), f"exit status 2: {entry}"
        lines = entry.split("\n")[1:-1]
        assert lines and (lines[0].startswith("error: ") or "Usage" in lines[0]), entry
    text = "\n\n".join(said) + "\n"
    if os.environ.get("BLINKGL_UPDATE_GOLDEN"):
        GOLDEN.write_text(text)
    golden = GOLDEN.read_text()
    if eflow_cli is None:
        golden = golden.split("eflow $")[0].rstrip() + "\n"
    assert text == golden, f"BLINKGL_UPDATE_GOLDEN=1 writes {GOLDEN.name} anew: read what has changed"
