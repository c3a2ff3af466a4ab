"""``blinkgl saccade``: prints what was made of how many pictures."""

from __future__ import annotations

import csv
import functools
import json
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from blinkgl.errors import ConfigError
from blinkgl.io.atomic import atomic_folder, output_errors
from blinkgl.io.reading import parsed_size
from blinkgl.machine.compiling import announced_compiling
from blinkgl.machine.terminal import plain_console, say
from blinkgl.recordings.saccades import ENDINGS, SACCADES, Clips, Still, read_path, stills_of
from blinkgl.show.simulate import emulator_options
from blinkgl.version import __version__

_CHUNK = 32
"""Clips that a process makes at a time."""


def run(
    pictures: str,
    out: str,
    *,
    classes_from: str | None,
    path: str | None,
    size: str | None,
    form: str,
    emulator: str,
    sensor: str | None,
    overrides: Sequence[str],
    seed: int,
    workers: int,
) -> int:
    """Make the clips and print their number; return 0.   ``form``: one of ENDINGS. Raises BlinkGLError."""
    options = (("--format", form, list(ENDINGS)), ("--classes-from", classes_from, [None, "folders"]))
    for option, value, known in options:
        if value not in known:
            raise ConfigError("unknown value", where=option, value=value, accepted=", ".join(filter(None, known)))
    config, camera = emulator_options(emulator, None, overrides, sensor)
    height, width = parsed_size(size) or ((camera.height, camera.width) if camera is not None else (34, 34))
    points = SACCADES if path is None else read_path(path)
    readout = None if camera is None else camera.readout
    clips = Clips(config, readout, (height, width), points, seed, ENDINGS[form])
    stills = stills_of(Path(pictures), classes_from == "folders")
    console = plain_console()
    with atomic_folder(out) as folder, announced_compiling(lambda text: say(console, text)):
        for place in {folder / still.label for still in stills}:
            place.mkdir(exist_ok=True)
        tasks = [(k, still.file, folder / still.target(clips.ending)) for k, still in enumerate(stills)]
        with console.status("making clips"):
            if workers == 1:
                made = [clips.write(*task) for task in tasks]
            else:
                with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
                    made = list(pool.map(functools.partial(_write, clips), tasks, chunksize=_CHUNK))
        with output_errors(folder):
            _write_records(folder, clips, stills, [count for count, _ in made])
    shapes = sorted({shape for _, shape in made})
    if len(shapes) > 1:
        (h0, w0), (h1, w1) = shapes[0], shapes[-1]
        say(console, f"pictures of {len(shapes)} sizes, {w0}x{h0} to {w1}x{h1}: each is scaled to the sensor")
    say(console, f"{out}: {len(stills):,} clips of {width}x{height} px, {sum(count for count, _ in made):,} events")
    return 0


def _write_records(folder: Path, clips: Clips, stills: Sequence[Still], events: Sequence[int]) -> None:
    """Write labels.csv and manifest.json."""
    with open(folder / "labels.csv", "w", encoding="utf-8", newline="") as table:
        writer = csv.writer(table, lineterminator="\n")
        writer.writerow(["file", "class", "label", "events"])
        writer.writerows([s.target(clips.ending), s.label, s.number, count] for s, count in zip(stills, events))
    about = {
        "format": "blinkgl-saccades",
        "blinkgl": __version__,
        "seed": clips.seed,
        "emulator": clips.emulator.model_dump(mode="json"),
        "readout": None if clips.readout is None else clips.readout.model_dump(mode="json"),
        "size": [*clips.size[::-1]],
        "path": clips.path.tolist(),
        "classes": sorted({still.label for still in stills} - {""}),
        "clips": len(stills),
        "events": sum(events),
    }
    (folder / "manifest.json").write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")


def _write(clips: Clips, task: tuple[int, Path, Path]) -> tuple[int, tuple[int, int]]:
    return clips.write(*task)
