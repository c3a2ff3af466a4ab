"""What ``blinkgl simulate``, ``compare`` and ``convert`` show around the library calls."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from rich.progress import BarColumn, Progress, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from blinkgl.config.reader import parse_yaml, read_table
from blinkgl.errors import ConfigError
from blinkgl.show.terminal import plain_column, plain_console


def emulator_options(name: str, config: str | None, overrides: list[str], sensor: str | None = None) -> dict[str, Any]:
    """``emulator`` and ``readout`` of :func:`blinkgl.simulate` from an emulator's name, an optional YAML mapping (it may name
    the emulator itself), ``key=value`` overrides, and an optional sensor whose values hold where nothing else is said."""
    data: dict[str, Any] = {}
    if config is not None:
        data = read_table(config, "emulator parameters, key: value")
    data = {"emulator": name, **data}
    for item in overrides:
        key, equals, value = item.partition("=")
        if not equals:
            raise ConfigError("not key=value", where="--set", value=item)
        data[key.strip()] = parse_yaml(value, f"--set {key.strip()}")
    if sensor is None:
        return {"emulator": data, "readout": None}
    from blinkgl.config.sensor import load_sensor
    from blinkgl.recordings.simulation import emulator_config

    camera = load_sensor(sensor)
    return {"emulator": emulator_config({**camera.values(data["emulator"]), **data}), "readout": camera.readout}


def simulate(source: str, target: str, quiet: bool = False, **options) -> None:
    """:func:`blinkgl.recordings.simulation.simulate_file` with a progress bar and a summary."""
    from blinkgl.machine.compiling import compiled_s, compiling_line
    from blinkgl.recordings.simulation import simulate_file

    console = plain_console(quiet=quiet)
    bar = Progress(plain_column("{task.description}"), BarColumn(), plain_column("{task.fields[detail]}"), TimeElapsedColumn(),
                   TimeRemainingColumn(), console=console, transient=True, disable=quiet or not console.is_terminal)
    with bar:
        task = bar.add_task(Path(target).name, total=None, detail="")

        def progress(report, fraction) -> None:
            bar.update(task, total=1.0 if fraction is not None else None, completed=fraction or 0.0,
                       detail=f"{report.frames} frames, {report.events / 1e6:.2f} M events")

        report = simulate_file(source, target, progress=progress, **options)
    rate = report.events / report.duration_s if report.duration_s else 0.0
    say = lambda text: console.print(text, highlight=False, soft_wrap=True, markup=False)
    say(f"{target}: {report.events:,} events in {report.duration_s:.6g} s ({rate / 1e6:.3g} M/s, "
        f"{100 * report.on / max(report.events, 1):.1f} % ON) from {report.frames} frames, {report.steps} emulator steps")
    if report.displacement is not None:
        say(str(report.displacement))
    elif report.steps > report.frames:
        say(f"{report.steps - report.frames} of the frames were interpolated, not recorded")
    if line := compiling_line(compiled_s()):
        say(line)
    if report.lost:
        say(f"{report.lost:,} events were lost in the sensor's read-out")
    if report.late:
        say(f"{report.late:,} events had not left the sensor's read-out when the frames ended")
    if report.saturated:
        say(f"warning: {report.saturated:,} events were cut by max_events_per_step")


def compare(a: str, b: str | None, out: str | None = None, **options) -> None:
    """:func:`blinkgl.recordings.comparison.compare` as a table; with ``out`` also compare.json and compare.png in that folder."""
    from blinkgl.io.atomic import atomic_file
    from blinkgl.recordings.comparison import BLUR_PX, compare as run, plot

    result = run(a, b, **options)
    console = plain_console()
    intervals = len(result.edges_us) - 1
    table = Table(title=f"{result.duration_s:.6g} s from {result.edges_us[0] / 1e6:.6f} s in {intervals} interval{'s' * (intervals > 1)}; "
                        f"mean (min … max) over them; polarity sums blurred by {BLUR_PX:g} px", title_justify="left")
    table.add_column("")
    table.add_column(f"A {Path(result.a.name).name}")
    if result.b:
        table.add_column(f"B {Path(result.b.name).name}")
    for quantity, first, second in result.rows():
        table.add_row(*((quantity, first, second) if result.b else (quantity, first)))
    console.print(table, highlight=False)
    if out is not None:
        with atomic_file(os.path.join(out, "compare.json")) as path:
            path.write_text(json.dumps(result.to_dict(), indent=1) + "\n", encoding="utf-8")
        plot(result, os.path.join(out, "compare.png"))
        console.print(f"written to {out}: compare.json, compare.png", highlight=False, soft_wrap=True)


def convert(source: str, target: str, *, size: str | None = None, **options) -> None:
    """:func:`blinkgl.io.formats.convert` and one line about it. size : "WIDTHxHEIGHT"."""
    from blinkgl.io.formats import convert as run

    known = None
    if size is not None:
        width, cross, height = size.lower().partition("x")
        if not (cross and width.isdigit() and height.isdigit() and 0 < int(width) <= 65536 and 0 < int(height) <= 65536):
            raise ConfigError("not a size", where="--size", value=size, accepted="WIDTHxHEIGHT, e.g. 640x480")
        known = (int(height), int(width))
    file, count = run(source, target, size=known, **options)
    print(f"{target}: {count:,} events, {file.width}x{file.height}, from {file.format}")  # noqa: T201
