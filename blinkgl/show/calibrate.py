"""``blinkgl calibrate``: a bar while it runs, then what was fitted and how near it came; a sensor file and a page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.progress import BarColumn, Progress, TimeElapsedColumn
from rich.table import Table

from blinkgl.config.reader import to_short_yaml
from blinkgl.errors import ConfigError, OutputError
from blinkgl.io.atomic import atomic_file, output_errors
from blinkgl.recordings.calibration import calibrate
from blinkgl.recordings.clip import Flicker
from blinkgl.report.calibration import page, parameters, rows
from blinkgl.show.simulate import emulator_options
from blinkgl.show.terminal import plain_column, plain_console, say


def run(
    recording: str,
    frames: str | None,
    out: str,
    *,
    emulator: str,
    flicker: str | None = None,
    sensor: str | None = None,
    overrides: Sequence[str] = (),
    overwrite: bool = False,
    quiet: bool = False,
    **options: Any,
) -> int:
    """``options``: of :func:`~blinkgl.recordings.calibration.calibrate`. Writes the sensor file ``out`` and, beside it,
    a page of the same name that ends in .html; both or neither."""
    target = Path(out)
    if target.suffix.lower() not in (".yaml", ".yml"):
        raise OutputError("not the name of a sensor file", where=out, accepted="a name that ends in .yaml")
    beside = target.with_suffix(".html")
    for path in (target, beside):
        if path.exists() and not overwrite:  # before the work, not after it
            raise OutputError("output file exists", where=str(path), accepted="a new name, or --overwrite")
    base = emulator_options(emulator, None, overrides, sensor)["emulator"]
    fixed = [item.partition("=")[0].strip() for item in overrides]
    console = plain_console(quiet=quiet)
    bar = Progress(
        plain_column("{task.description}"),
        BarColumn(),
        TimeElapsedColumn(),
        console=console,
        transient=True,
        disable=quiet or not console.is_terminal,
    )
    with bar:
        task = bar.add_task("reading", total=1.0)
        progress = lambda what, done: bar.update(task, description=what, completed=done)
        result = calibrate(
            recording,
            frames,
            emulator=base,
            fixed=fixed,
            flicker=None if flicker is None else _flicker(flicker),
            progress=progress,
            **options,
        )
    text = to_short_yaml(result.sensor())
    with atomic_file(beside, overwrite=overwrite) as html, atomic_file(target, overwrite=overwrite) as file:
        with output_errors(target):
            html.write_text(page(result, text), encoding="utf-8")
            file.write_text(text, encoding="utf-8")
    judged = Table(title=f"{result.config.emulator} beside {Path(recording).name}", title_justify="left")
    for head in ("", "recorded", "before", "fitted", "recorded, other half", "before", "fitted"):
        judged.add_column(head)
    for quantity, cells in rows(result):
        judged.add_row(quantity, *cells)
    console.print(judged, highlight=False)
    found = Table(title="parameters", title_justify="left")
    for head in ("key", "before", "fitted", ""):
        found.add_column(head)
    for row in parameters(result):
        found.add_row(*row)
    console.print(found, highlight=False)
    for note in result.notes:
        say(console, note)
    say(console, f"written: {target}, {beside}")
    return 0


def _flicker(text: str) -> Flicker:
    hz, comma, contrast = text.partition(",")
    try:
        found = Flicker(float(hz), float(contrast))
    except ValueError:
        found = Flicker(0.0, 0.0)
    if not (comma and 0.01 <= found.hz <= 1e4 and 0 < found.contrast < 1):
        raise ConfigError(
            "not a frequency and a contrast",
            where="--flicker",
            value=text,
            accepted="HZ,CONTRAST: 0.01 to 10,000 Hz, and (brightest - darkest)/(brightest + darkest) between 0 and 1",
        )
    return found
