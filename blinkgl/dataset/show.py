"""What ``blinkgl generate`` shows: progress while it runs, a table when it is done."""

from __future__ import annotations

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from blinkgl.config.sequence import load_run
from blinkgl.dataset.generate import SequenceReport, generate_run

STAGES = ("scene", "render", "read-back", "timeline", "events", "write", "preview")


def generate_with_progress(config: str, out: str, *, num: int | None = None, seed: int | None = None,
                           overrides: list[str] = (), quiet: bool = False) -> list[SequenceReport]:
    """:func:`generate_run` behind a progress display. Raises what it raises."""
    template = load_run(config, overrides, seed=seed)
    if quiet:
        return list(generate_run(template, out, num))
    console = Console()
    reports: list[SequenceReport] = []
    bar = Progress(TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:>3.0f}%"),
                   TextColumn("{task.fields[detail]}"), TimeElapsedColumn(), TimeRemainingColumn(),
                   console=console, transient=True, disable=not console.is_terminal)
    with bar:
        task = bar.add_task("preparing", total=1.0, detail="")

        def progress(report: SequenceReport, fraction: float) -> None:
            detail = f"{report.frames} frames, {report.events / 1e6:.2f} M events" if fraction < 1 else "labels, files"
            bar.update(task, description=report.path.name, completed=fraction, detail=detail)

        for report in generate_run(template, out, num, progress):
            reports.append(report)
            if not console.is_terminal or len(reports) > 1:
                console.print(_line(report), highlight=False, soft_wrap=True)
            bar.reset(task)
    show_table(console, reports)
    return reports


def _line(report: SequenceReport) -> str:
    return (f"{report.path}: {report.frames} frames, {report.events / 1e6:.2f} M events, {report.labels} labels, "
            f"{report.total_s:.1f} s ({report.total_s / report.simulated_s:.1f} s per simulated second)")


def summary(reports: list[SequenceReport]) -> dict[str, float]:
    """Totals of a run: counts, wall seconds per stage, and the rates the table shows."""
    total = sum(r.total_s for r in reports)
    simulated = sum(r.simulated_s for r in reports)
    stages = {name: sum(r.seconds.get(name, 0.0) for r in reports) for name in STAGES}
    stages["other"] = max(0.0, total - sum(stages.values()))
    events = sum(r.events for r in reports)
    return {"sequences": len(reports), "frames": sum(r.frames for r in reports), "events": events,
            "labels": sum(r.labels for r in reports), "simulated_s": simulated, "total_s": total,
            "seconds_per_simulated_second": total / simulated, "events_per_second": events / total,
            **{f"{name}_s": seconds for name, seconds in stages.items()}}


def show_table(console: Console, reports: list[SequenceReport]) -> None:
    """The final table: what was made, how fast, and where the time went."""
    s = summary(reports)
    table = Table(title=f"{s['sequences']} sequence{'s' if s['sequences'] != 1 else ''}, {s['simulated_s']:g} simulated seconds",
                  title_justify="left", show_header=False)
    table.add_row("event frames", f"{s['frames']:,}")
    table.add_row("events", f"{s['events'] / 1e6:.2f} M")
    table.add_row("labels", f"{s['labels']:,}")
    table.add_row("wall time", f"{s['total_s']:.1f} s")
    table.add_row("per simulated second", f"{s['seconds_per_simulated_second']:.2f} s")
    table.add_row("rate", f"{s['events_per_second'] / 1e6:.2f} M events/s")
    table.add_section()
    for name in (*STAGES, "other"):
        seconds = s[f"{name}_s"]
        table.add_row(name, f"{seconds:.2f} s  {100 * seconds / s['total_s']:4.0f} %")
    console.print(table)
    folder = reports[0].path
    console.print(f"look at {folder / 'preview.mp4'}" if (folder / "preview.mp4").exists() else f"written to {folder}",
                  highlight=False, soft_wrap=True)
