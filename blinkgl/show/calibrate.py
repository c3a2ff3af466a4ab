"""``blinkgl calibrate``: a progress bar, then the fitted values and their accuracy; a sensor file and a page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TimeElapsedColumn
from rich.table import Table

from blinkgl.config.reader import to_short_yaml
from blinkgl.errors import ConfigError, OutputError
from blinkgl.io.atomic import atomic_file, output_errors
from blinkgl.io.frames import Declared
from blinkgl.machine.terminal import plain_column, plain_console, say
from blinkgl.recordings.calibration import calibrate
from blinkgl.recordings.clip import FrameReading
from blinkgl.recordings.decoding import Codes
from blinkgl.recordings.pixel_noise import fit_pixels
from blinkgl.report import pixel_noise
from blinkgl.report.calibration import page, parameters, rows
from blinkgl.show.simulate import emulator_options

PIXELS = "pixels"
"""Used instead of an emulator's name: the noise of single pixels, which is added to any emulator."""


def run(
    recording: str,
    frames: str | None,
    out: str,
    *,
    emulator: str,
    sensor: str | None = None,
    overrides: Sequence[str] = (),
    overwrite: bool = False,
    quiet: bool = False,
    **options: Any,
) -> int:
    """Fit an emulator and write the sensor file ``out`` and a page of the same name that ends in .html; both or
    neither. ``options``: of :func:`~blinkgl.recordings.calibration.calibrate` and of its FrameReading."""
    target = Path(out)
    if target.suffix.lower() not in (".yaml", ".yml"):
        raise OutputError("not the name of a sensor file", where=out, accepted="a name that ends in .yaml")
    beside = target.with_suffix(".html")
    for path in (target, beside):
        if path.exists() and not overwrite:  # before the fit, not after it
            raise OutputError("output file exists", where=str(path), accepted="a new name, or --overwrite")
    if emulator == PIXELS:
        return _pixels(recording, frames, target, sensor, overrides, overwrite, quiet, options)
    gamma, *said = (options.pop(key) for key in ("gamma", "interpolate", "max_px", "frame_delay_ms"))
    reading = FrameReading(Codes(gamma), *said)
    options["declared"] = Declared(**options.pop("declared"))
    base = emulator_options(emulator, None, overrides, sensor)["emulator"]
    fixed = [item.partition("=")[0].strip() for item in overrides]
    console = plain_console(quiet=quiet)
    bar = _bar(console, quiet)
    with bar:
        task = bar.add_task("reading", total=1.0)
        progress = lambda what, done: bar.update(task, description=what, completed=done)
        result = calibrate(
            recording,
            frames,
            reading,
            emulator=base,
            fixed=fixed,
            progress=progress,
            **options,
        )
    text = to_short_yaml(result.sensor())
    _write(target, text, page(result, text), overwrite)
    heads = ("", "recorded", "before", "fitted", "recorded, other half", "before", "fitted")
    judged = [(quantity, *cells) for quantity, cells in rows(result)]
    _table(console, f"{result.config.emulator} beside {Path(recording).name}", heads, judged)
    _table(console, "parameters", ("key", "before", "fitted", ""), parameters(result))
    for note in result.notes:
        say(console, note)
    for warning in result.warnings:
        say(plain_console(stderr=True), f"note: {warning}")
    say(console, f"written: {target}, {beside}")
    return 0


def _pixels(
    recording: str,
    frames: str | None,
    target: Path,
    sensor: str | None,
    overrides: Sequence[str],
    overwrite: bool,
    quiet: bool,
    options: dict[str, Any],
) -> int:
    """Fit the noise of single pixels instead of an emulator."""
    if not options["still"] or frames is not None:
        raise ConfigError(
            "the noise of single pixels is measured in a static scene",
            where="--emulator",
            value=PIXELS,
            accepted="--still",
        )
    for option, value in (("--sensor", sensor), ("--set", overrides)):
        if value:
            raise ConfigError("this is an option of emulators", where=option, accepted=f"none with --emulator {PIXELS}")
    console = plain_console(quiet=quiet)
    with _bar(console, quiet) as bar:
        task = bar.add_task("reading", total=1.0)
        progress = lambda what, done: bar.update(task, description=what, completed=done)
        result, said = fit_pixels(recording, options["events"], seed=options["seed"], progress=progress)
    for line in said:
        say(plain_console(stderr=True), f"note: {line}")
    text = to_short_yaml(result.sensor())
    _write(target, text, pixel_noise.page(result, text), overwrite)
    title = f"noise of single pixels beside {Path(recording).name}, other half"
    _table(console, title, ("", "recorded", "fitted"), pixel_noise.rows(result))
    _table(console, "parameters", ("key", "fitted", ""), pixel_noise.parameters(result))
    say(console, f"written: {target}, {target.with_suffix('.html')}")
    return 0


def _table(console: Console, title: str, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    table = Table(title=title, title_justify="left")
    for head in heads:
        table.add_column(head)
    for row in rows:
        table.add_row(*row)
    console.print(table, highlight=False)


def _bar(console: Console, quiet: bool) -> Progress:
    return Progress(
        plain_column("{task.description}"),
        BarColumn(),
        TimeElapsedColumn(),
        console=console,
        transient=True,
        disable=quiet or not console.is_terminal,
    )


def _write(target: Path, sensor: str, page_: str, overwrite: bool) -> None:
    """Write the sensor file and the page beside it; both or neither."""
    beside = target.with_suffix(".html")
    with atomic_file(beside, overwrite=overwrite) as html, atomic_file(target, overwrite=overwrite) as file:
        with output_errors(target):
            html.write_text(page_, encoding="utf-8")
            file.write_text(sensor, encoding="utf-8")
