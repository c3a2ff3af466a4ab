"""The work of ``passes``, ``probe`` and ``diff``, without the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from blinkgl.errors import OutputError
from blinkgl.io import pictures
from blinkgl.io.atomic import output_errors, write_whole
from blinkgl.io.images import encode_npy
from blinkgl.render.passes.own import OWN
from blinkgl.tools.shader_debugger.compare import (
    BufferReport,
    Comparison,
    as_text as verdict_text,
    parse_tolerances,
    verdict,
)
from blinkgl.tools.shader_debugger.filters import FILTERED, filtered_names
from blinkgl.tools.shader_debugger.moments import (
    MAPS,
    PASSES,
    GpuMoment,
    ReferenceMoment,
    buffers_of,
    check_pass,
    lookup_of,
    open_reference,
)
from blinkgl.tools.shader_debugger.probe import as_text, probe
from blinkgl.tools.shader_debugger.quantities import QUANTITIES
from blinkgl.tools.shader_debugger.session import Subject, When, check_pixel, open_renderer


def write_passes(
    subject: Subject, when: When, out: str, names: list[str] | None = None, shaders: str | None = None
) -> list[Path]:
    """Write every buffer as NAME.png (labelled) and NAME.npy, and contact_sheet.png, to the
    folder ``out``. Returns the paths.

    Anti-aliased as configured: these are the arrays that generation uses. Raises BlinkGLError."""
    from blinkgl.tools.shader_debugger import picture

    there = buffers_of(subject.scene)
    names = [check_pass(name, there) for name in names] if names else list(there)
    paths, tiles = [], []
    caption = (
        f"{Path(subject.path).name}, sequence {subject.index}, seed {subject.config.seed}, t = {when.t_ns * 1e-9:.6g} s"
    )
    with open_renderer(subject, shaders, as_configured=True) as renderer:
        # No folder is created for a run that cannot draw.
        folder = _folder(out)
        gpu = GpuMoment(renderer, when)
        for name in names:
            info, array = PASSES[name], gpu[name]
            write_whole(folder / f"{name}.npy", encode_npy(array))
            rgb, legend = pictures.picture(info.kind, array, hit=_meaningful(gpu, info))
            picture.save_labelled(folder / f"{name}.png", info, rgb, legend, f"{caption}, {renderer.gl.renderer}")
            paths += [folder / f"{name}.npy", folder / f"{name}.png"]
            tiles.append((info, rgb, legend))
        picture.save_contact_sheet(folder / "contact_sheet.png", tiles, f"{caption}   ·   {renderer.gl.renderer}")
    return [*paths, folder / "contact_sheet.png"]


def _meaningful(moment, info) -> np.ndarray | None:
    """Return where a buffer's values are meaningful: where a surface is visible, or where the flow is valid."""
    if info.name in MAPS:
        return moment[info.name] > 0
    if info.name.startswith("flow_"):
        return moment[info.name.replace("flow", "valid")]
    everywhere = info.name in ("luminance", *FILTERED, *OWN)  # the background has values, too
    if lookup_of(info.name)[1] in ("uv", "level"):
        return (
            moment["texture_size"][..., 0] > 1
            if isinstance(moment, ReferenceMoment)
            else moment[f"{info.name.rpartition('_')[0]}_count"] > 0
        )
    return moment["id"] != 0 if info.kind in ("scalar", "depth", "signed", "motion") and not everywhere else None


def _folder(out: str) -> Path:
    folder = Path(out)
    if folder.exists() and not folder.is_dir():
        raise OutputError("is a file", where=str(folder), accepted="a folder")
    with output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    return folder


def run_probe(subject: Subject, when: When, pixel: str, shaders: str | None = None, as_json: bool = False) -> str:
    """Return the output of ``blinkgl shader probe``."""
    x, y = check_pixel(subject.scene, pixel)
    with open_renderer(subject, shaders) as renderer:
        answer = probe(GpuMoment(renderer, when), open_reference(subject, when, renderer.maps), x, y)
    return json.dumps(_finite(answer)) if as_json else as_text(answer)


def run_diff(
    subject: Subject,
    when: When,
    names: list[str] | None,
    tolerances: list[str],
    shaders: str | None = None,
    out: str | None = None,
) -> tuple[dict, list[BufferReport]]:
    """Compare the named buffers (default: all possible ones); with ``out`` also write diff.png and
    NAME_error.npy there. Returns the result of :func:`verdict.verdict`, and the reports."""
    # Names are checked before drawing.
    if names:
        there = buffers_of(subject.scene, filtered_names(subject.config, subject.scene))
        names = [check_pass(name, [known for known in QUANTITIES if known in there]) for name in names]
    with open_renderer(subject, shaders) as renderer:
        comparison = Comparison(GpuMoment(renderer, when), open_reference(subject, when, renderer.maps))
        names = names or comparison.names()
        limits = parse_tolerances(tolerances, names)
        reports = [comparison.report(name, limits.get(name)) for name in names]
        result = verdict(reports, renderer.unused, comparison.left_out())
    if out is not None:
        from blinkgl.tools.shader_debugger import picture

        folder = _folder(out)
        for report in reports:
            write_whole(folder / f"{report.quantity.name}_error.npy", encode_npy(report.errors))
        title = (
            f"GPU against the float64 reference: {Path(subject.path).name}, sequence {subject.index}, t = "
            f"{when.t_ns * 1e-9:.6g} s"
        )
        picture.save_errors(folder / "diff.png", reports, title + "   (log scale; silhouettes and shared edges greyed)")
    return result, reports


def diff_json(result: dict, reports: list[BufferReport]) -> str:
    """Return the output of ``diff --json``."""
    return json.dumps(_finite(result | {"buffers": [r.summary() for r in reports]}))


def _finite(value):
    """Return inf and nan as text, because JSON has neither."""
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(v) for v in value]
    if isinstance(value, float) and not np.isfinite(value):
        return str(value)
    return value


def diff_text(result: dict, reports: list[BufferReport]) -> str:
    """Return the verdict, the table, then histogram, suspicions and the worst pixel of each object, for each failed
    buffer or for a single one."""
    lines = [*verdict_text(result), ""] if not result["passed"] else []
    lines.append(
        f"{'':5}{'buffer':<18} {'value':>9} {'tolerance':>9}  {'unit':<24} {'pixels':>8} {'median':>8} {'99 %':>8} "
        f"{'max':>8}   silhouette band: over / pixels"
    )
    summaries = [report.summary() for report in reports]
    for s in summaries:
        e, b = s["off_silhouettes"], s["silhouette_band"]
        lines.append(
            f"{'ok' if s['passed'] else 'FAIL':5}{s['buffer']:<18} {s['value']:>9.2g} {s['tolerance']:>9.2g}  "
            f"{s['unit']:<24} {e['pixels']:>8} {e['median']:>8.1e} {e['p99']:>8.1e} {e['max']:>8.1e}   "
            f"{b['over_tolerance']} / {b['pixels']}"
        )
    notes: dict[str, list[str]] = {}
    for s in summaries:
        if s["note"]:
            notes.setdefault(s["note"], []).append(s["buffer"])
    lines += ["" for _ in notes][:1] + [f"{', '.join(names)}: {note}" for note, names in notes.items()]
    for s in summaries:
        if s["passed"] and len(summaries) > 1:
            continue
        lines += [
            "",
            f"{s['buffer']}: {s['off_silhouettes']['over_tolerance']} of {s['off_silhouettes']['pixels']} graded "
            "pixels " + (f"over {s['tolerance']:g} {s['unit']}" if s["statistic"] == "max" else "differ"),
        ]
        lines += [f"  it looks as if: {text}" for text in s["suspicions"]]
        top = max([1, *s["histogram"].values()])
        # Logarithmic; otherwise one wrong pixel would have no bar beside ten thousand right ones.
        bars = {
            name: max(1, round(40 * np.log1p(count) / np.log1p(top))) for name, count in s["histogram"].items() if count
        }
        lines += [f"  {name:>6} {s['histogram'][name]:>8} {'#' * bar}" for name, bar in bars.items()]
        lines += [
            f"  {o['object']}: {o['over_tolerance']} of {o['pixels']} px, median {o['median']:.2g}; worst ({o['x']}, "
            f"{o['y']}): error {o['error']:.3g}, GPU {_short(o['gpu'])}, reference {_short(o['reference'])}"
            + (f", triangle {o['triangle']}" if o["triangle"] >= 0 else "")
            for o in s["objects"]
            if o["over_tolerance"]
        ]
    failed = [s for s in summaries if not s["passed"]]
    if failed:
        w = next(iter(result["objects"]), None)
        closer = f"; look closer with: probe --pixel {w['x']},{w['y']}" if w else ""
        summary = f"{len(failed)} of {len(summaries)} buffers are over their tolerance{closer}"
    else:
        whole = f"all {len(summaries)} buffers agree" if len(summaries) > 1 else "agrees"
        summary = f"{whole} with the reference"
    lines += ["", f"{summary}; {result['not_graded']}"]
    return "\n".join(lines)


def _short(v) -> str:
    return (
        "(" + ", ".join(f"{x:.5g}" for x in v) + ")"
        if isinstance(v, list)
        else (str(v) if isinstance(v, (bool, int)) else f"{v:.6g}")
    )
