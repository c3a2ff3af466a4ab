"""``blinkgl calibrate``: a progress bar, then the fitted values and their accuracy; a sensor file and a page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.progress import BarColumn, Progress, TimeElapsedColumn
from rich.table import Table

from blinkgl.config.reader import to_short_yaml
from blinkgl.errors import ConfigError, OutputError
from blinkgl.io.atomic import atomic_file, output_errors, refuse_file
from blinkgl.io.reading import Declared
from blinkgl.machine.terminal import plain_column, plain_console, say
from blinkgl.recordings.calibration import Calibration, calibrate
from blinkgl.recordings.clip import FrameReading
from blinkgl.recordings.decoding import Codes
from blinkgl.recordings.pixel_noise import PixelFit, fit_pixels
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
    **options: object,
) -> int:
    """Fit an emulator and write the sensor file ``out`` and a page of the same name that ends in .html; both or
    neither. ``options``: of :func:`~blinkgl.recordings.calibration.calibrate` and of its FrameReading."""
    target = Path(out)
    if target.suffix.lower() not in (".yaml", ".yml"):
        raise OutputError("not the name of a sensor file", where=out, accepted="a name that ends in .yaml")
    beside = target.with_suffix(".html")
    for path in (target, beside):
        refuse_file(path, overwrite)
    console = plain_console(quiet=quiet)
    columns = plain_column("{task.description}"), BarColumn(), TimeElapsedColumn()
    with Progress(*columns, console=console, transient=True, disable=quiet or not console.is_terminal) as bar:
        task = bar.add_task("reading", total=1.0)
        progress = lambda what, done: bar.update(task, description=what, completed=done)
        fit = _pixels if emulator == PIXELS else _emulator
        fitted = fit(recording, frames, emulator, sensor, overrides, progress=progress, **options)
    text = to_short_yaml(fitted.result.sensor())
    with atomic_file(beside, overwrite=overwrite) as html, atomic_file(target, overwrite=overwrite) as file:
        with output_errors(target):
            html.write_text(fitted.page(fitted.result, text), encoding="utf-8")
            file.write_text(text, encoding="utf-8")
    for title, heads, cells in fitted.tables:
        table = Table(*heads, title=title, title_justify="left")
        for row in cells:
            table.add_row(*row)
        console.print(table, highlight=False)
    for note in fitted.notes:
        say(console, note)
    for warning in fitted.warnings:
        say(plain_console(stderr=True), f"note: {warning}")
    say(console, f"written: {target}, {beside}")
    return 0


class _Fitted(NamedTuple):
    """A fit, and how it is shown.   page : makes the page of a result and its sensor file.   tables : title, heads,
    rows."""

    result: Calibration | PixelFit
    page: Callable[..., str]
    tables: Sequence[tuple[str, Sequence[str], Sequence[Sequence[str]]]]
    notes: list[str]
    warnings: list[str]


def _emulator(
    recording: str, frames: str | None, emulator: str, sensor: str | None, overrides: Sequence[str], **options: Any
) -> _Fitted:
    gamma, *reading = (options.pop(key) for key in ("gamma", "interpolate", "max_px", "frame_delay_ms"))
    options["declared"] = Declared(**options.pop("declared"))
    base, _ = emulator_options(emulator, None, overrides, sensor)
    fixed = [item.partition("=")[0].strip() for item in overrides]
    result = calibrate(recording, frames, FrameReading(Codes(gamma), *reading), emulator=base, fixed=fixed, **options)
    heads = ("", "recorded", "before", "fitted", "recorded, other half", "before", "fitted")
    judged = [(quantity, *cells) for quantity, cells in rows(result)]
    tables = [
        (f"{result.config.emulator} beside {Path(recording).name}", heads, judged),
        ("parameters", ("key", "before", "fitted", ""), parameters(result)),
    ]
    return _Fitted(result, page, tables, result.notes, result.warnings)


def _pixels(
    recording: str,
    frames: str | None,
    emulator: str,
    sensor: str | None,
    overrides: Sequence[str],
    *,
    progress: Callable[[str, float], None],
    **options: Any,
) -> _Fitted:
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
    result, warnings = fit_pixels(recording, options["events"], seed=options["seed"], progress=progress)
    tables = [
        (
            f"noise of single pixels beside {Path(recording).name}, other half",
            ("", "recorded", "fitted"),
            pixel_noise.rows(result),
        ),
        ("parameters", ("key", "fitted", ""), pixel_noise.parameters(result)),
    ]
    return _Fitted(result, pixel_noise.page, tables, [], warnings)
