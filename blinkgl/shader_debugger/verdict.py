"""Where the fault is: the first buffer that is wrong, in the order in which a pass makes them, object by object."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from blinkgl.shader_debugger.compare import BufferReport
from blinkgl.shader_debugger.quantities import QUANTITIES


def verdict(reports: list[BufferReport], unused: Iterable[tuple[str, str]] = (), left_out: Iterable[str] = ()) -> dict:
    """Plain data (JSON).

    passed : every buffer is within its tolerance, and nothing is unused.
    unused : sorted (program, name) of uniforms and attributes that a run sets and that the programs do not use.
    not_graded : one line, which pixels and which buffers (``left_out``) nothing is said of.
    first : {buffer, title, source, objects, suspicions} of the first that is not.
    objects : per object that is over a tolerance, in the order of ``first``: object, first (buffer), x, y (the worst
    pixel there), over_tolerance and pixels (of that buffer), then (the other buffers that are
    wrong), suspicion ("" when none fits)."""
    order = list(QUANTITIES)
    failed = sorted((r for r in reports if not r.passed), key=lambda r: order.index(r.quantity.name))
    rows: dict[str, dict] = {}
    for report in failed:
        # Each object by the first buffer that is wrong on it, the others behind.
        for one in report.objects:
            if not one["over_tolerance"]:
                continue
            name = report.quantity.name
            row = rows.setdefault(
                one["object"],
                {
                    "object": one["object"],
                    "first": name,
                    "x": one["x"],
                    "y": one["y"],
                    "pixels": one["pixels"],
                    "over_tolerance": one["over_tolerance"],
                    "then": [],
                    "suspicion": next(iter(report.suspicions), ""),
                },
            )
            if row["first"] != name:
                row["then"].append(name)
    first = None
    if failed:
        top = failed[0].quantity
        first = {
            "buffer": top.name,
            "title": top.title,
            "source": top.source,
            "suspicions": failed[0].suspicions,
            "objects": [row["object"] for row in rows.values() if row["first"] == top.name],
        }
    gone = sorted(unused)
    return {
        "passed": not failed and not gone,
        "unused": gone,
        "not_graded": _not_graded(reports, list(left_out)),
        "first": first,
        "objects": list(rows.values()),
    }


def _not_graded(reports: list[BufferReport], left_out: list[str]) -> str:
    """One line: how many pixels most buffers leave out, and those that leave out more."""
    counts = {report.quantity.name: (int((~report.graded).sum()), report.graded.size) for report in reports}
    # What most buffers leave out are silhouettes; those that leave out more are named.
    shares = [count / size for count, size in counts.values()]
    # A hundredth more are pixels on the sides of triangles.
    usual = float(np.median(shares)) + 0.01
    most = max((one for one in counts.values() if one[0] <= usual * one[1]), key=lambda one: one[0] / one[1])
    line = f"not graded: up to {most[0]} of {most[1]} px of a buffer"
    more = [f"{name} {count} of {size}" for name, (count, size) in counts.items() if count > usual * size]
    whole = [f"{name} not at all (anisotropic filtering is the driver's own)" for name in left_out]
    return "; ".join([line, *more, *whole])


def as_text(found: dict) -> list[str]:
    """Lines."""
    lines = [f"{program}: the shader does not use '{name}' any more" for program, name in found["unused"]]
    first = found["first"]
    if first is None:
        return lines
    lines += [
        f"The first that is wrong: {first['title']} ({first['source']})"
        + (f", on {', '.join(first['objects'])}" if first["objects"] else "")
    ]
    lines += [f"  it looks as if: {text}" for text in first["suspicions"]]
    lines += ["", f"  {'object':<16} {'first wrong':<22} {'over':>7} {'of px':>7}  {'worst at':<12} then also; why"]
    for row in found["objects"]:
        place = f"({row['x']}, {row['y']})"
        more = ", ".join(row["then"]) or "nothing"
        lines.append(
            f"  {row['object']:<16} {QUANTITIES[row['first']].title:<22} {row['over_tolerance']:>7} "
            f"{row['pixels']:>7}  {place:<12} {more}"
            + (f"; {row['suspicion']}" if row["suspicion"] and row["suspicion"] not in first["suspicions"] else "")
        )
    return lines
