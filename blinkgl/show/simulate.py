"""``blinkgl simulate``: a progress bar, then counts of events made and lost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TimeElapsedColumn, TimeRemainingColumn

from blinkgl.config.draw import middle
from blinkgl.config.events import EmulatorConfig
from blinkgl.config.expansion import expanded
from blinkgl.config.reader import parse_yaml, read_table
from blinkgl.config.sensor import SensorConfig
from blinkgl.errors import ConfigError
from blinkgl.io.reading import Declared, parsed_size
from blinkgl.machine.compiling import announced_compiling
from blinkgl.machine.terminal import causes_line, plain_column, plain_console, say
from blinkgl.recordings.decoding import Codes
from blinkgl.recordings.simulation import FrameUse, SimulationReport, file_to_events, own_frames, with_sensor

FAR_PX = 2.0
"""px between frames above which linear interpolation gives a warning: at 2 px it loses up to 20 % of the events."""


def emulator_options(
    name: str, config: str | None, overrides: Sequence[str], sensor: str | None = None
) -> tuple[EmulatorConfig, SensorConfig | None]:
    """Return the emulator of a name, an optional YAML file (which may name the emulator itself) and ``key=value``
    overrides, with the values of an optional sensor as defaults, and that sensor."""
    table = {"emulator": name, **(read_table(config, "emulator parameters, key: value") if config is not None else {})}
    for item in overrides:
        key, equals, value = item.partition("=")
        if not equals:
            raise ConfigError("not key=value", where="--set", value=item)
        table[key.strip()] = parse_yaml(value, f"--set {key.strip()}")
    if "recipe" in table:  # a video is one camera: the middle of the recipe's distributions
        table = middle(expanded({"events": table}, Path.cwd())["events"])
    return with_sensor(table, sensor)


def run(
    source: str,
    target: str,
    *,
    emulator: str,
    sensor: str | None = None,
    config: str | None = None,
    overrides: Sequence[str] = (),
    size: str | None = None,
    quiet: bool = False,
    frames: Mapping[str, Any] | None = None,
    declared: Mapping[str, Any] | None = None,
    **options: Any,
) -> int:
    """Convert a file. ``size``: "WIDTHxHEIGHT" instead of the sensor's.   ``frames``: gamma, interpolate, max_px and
    keep_noise, see :class:`~blinkgl.recordings.simulation.FrameUse`.   ``declared``: of the frames, as of
    :class:`~blinkgl.io.reading.Declared`.   ``options``: of :func:`~blinkgl.recordings.simulation.file_to_events`."""
    options["emulator"], camera = emulator_options(emulator, config, overrides, sensor)
    use = dict(frames or {})
    options["use"] = FrameUse(Codes(use.pop("gamma", None), own=own_frames(camera)), **use)
    options["declared"] = Declared(**(declared or {}))
    if camera is not None:
        options |= {"readout": camera.readout, "size": (camera.height, camera.width)}
    if size is not None:
        options["size"] = parsed_size(size)
    console = plain_console(quiet=quiet)
    if camera is not None and not camera.threshold_known:
        say(console, f"the thresholds of {sensor} are not known: they are the emulator's defaults")
    bar = Progress(
        plain_column("{task.description}"),
        BarColumn(),
        plain_column("{task.fields[detail]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=quiet or not console.is_terminal,
    )
    with announced_compiling(lambda text: say(console, text)), bar:
        task = bar.add_task(Path(target).name, total=None, detail="")

        def progress(report, fraction) -> None:
            bar.update(
                task,
                total=1.0 if fraction is not None else None,
                completed=fraction or 0.0,
                detail=f"{report.frames} frames, {report.events / 1e6:.2f} M events",
            )

        report = file_to_events(source, target, progress=progress, **options)
    _told(console, target, report)
    return 0


def _told(console: Console, target: str, report: SimulationReport) -> None:
    """Print counts of events made and lost, one line each."""
    rate = report.events / report.duration_s if report.duration_s else 0.0
    say(
        console,
        f"{target}: {report.events:,} events in {report.duration_s:.6g} s ({rate / 1e6:.3g} M/s, "
        f"{100 * report.on / max(report.events, 1):.1f} % ON) from {report.frames} frames, {report.steps} emulator "
        "steps",
    )
    if report.fitting is not None:
        warning = "warning: " if report.fitting.loses_much else ""
        say(console, f"{warning}{report.fitting} (--size WIDTHxHEIGHT for another)")
    for note in report.notes:
        say(console, note)
    if report.noise is not None:
        say(console, f"{report.noise}; changes that it explains make no events (--keep-noise: they do)")
    for caveat in report.caveats:
        say(console, f"warning: {caveat}")
    if report.guessed_over_px > FAR_PX:
        say(
            console,
            f"warning: things move up to {report.guessed_over_px:.0f} px between frames, and the "
            "motion in between is guessed: --interpolate motion, or a faster video",
        )
    if report.displacement is not None:
        say(console, str(report.displacement))
    elif report.steps > report.frames:
        say(console, f"{report.steps - report.frames} of the frames were interpolated, not recorded")
    if report.causes:
        say(console, causes_line(report.causes, report.duration_s))
    if report.lost:
        say(console, f"{report.lost:,} events were lost in the sensor's read-out")
    if report.late:
        say(console, f"{report.late:,} events had not left the sensor's read-out when the frames ended")
    if report.saturated:
        say(console, f"warning: {report.saturated:,} events were cut by max_events_per_step")
