"""The tables of docs/trade.md from a run of the suite.

    blinkgl trade --suite --out out/suite
    python -m blinkgl.tools.trade_tables out/suite/suite.json                     # prints them
    python -m blinkgl.tools.trade_tables out/suite/suite.json --page docs/trade.md   # puts them into the page

A table of the page is the one with the same first line; sentences about the figures are printed and have to be put
right by hand. ``configs/quality/measured.json`` will do for a measurement, less the table of the scenes.
tests/trade/test_tables.py compares the page with it.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import re
import sys
from pathlib import Path

from blinkgl.trade.pareto import excess

NOISE = 0.05
"""By which settings that draw the same frames differ in processor time."""
BEFORE, ASKED = "displacement 0.5 px, linear, none", "displacement 1 px, linear, ssaa2, mip bias -1"
"""The default until 2026-11-22; what `balanced` was until then, at whose error costs are compared."""
DEFAULT = "displacement 1 px, linear, edges, mip bias -1"
STEPS = (4, 2, 1.5, 1, 0.5)


def rows_of(scene: dict) -> dict[str, dict]:
    """Name -> row of a scene."""
    return {row["name"]: row for row in scene.get("settings", ())}


def cell(row: dict | None, result: dict, cost: bool = True) -> str:
    """The error and, with ``cost``, the cost of a row: bold where nothing beats it, in brackets where it does not
    count."""
    if row is None:
        return ""
    text = f"{100 * row[result['error']]:.0f} %" + (f" / {row[result['cost']]:.1f} s" if cost else "")
    if not row["trusted"]:
        return f"({text})"
    return f"**{text}**" if cost and row["on_front"] else text


def table(head: list[str], rows: list[list[str]]) -> list[str]:
    """Lines of a table in Markdown."""
    line = lambda cells: "| " + " | ".join(cells) + " |"
    return [line(head), "|" + "---|" * len(head), *(line(row) for row in rows)]


def scenes_table(result: dict) -> list[str]:
    """What is hard in each scene, and its reference; empty where the measurement does not say how long the clips
    are."""
    rows = []
    for name, scene in result["scenes"].items():
        if "clip_s" not in scene:
            return []
        settings = scene["settings"]
        finest = re.search(r"(\d+x\d+) samples a pixel, (\S+ px)", scene["reference"])
        moved = [float(x) for x in re.findall(r"(\d\S*) %(?=,|$)", scene["reference"].partition("judged: ")[2])]
        converged = "yes" if scene["converged"] else f"no: {max(moved):.0f} %" if moved else "not checked"
        rows.append([
            name, scene["what"].rstrip("."), f"{1e3 * scene['clip_s']:.0f} ms",
            f"{settings[0]['reference_events']:,}", f"{finest[1]}, {finest[2]}" if finest else "", converged,
            f"{sum(r['trusted'] for r in settings)} of {len(settings)}",
        ])  # fmt: skip
    return table(["scene", "what is hard", "clip", "events", "reference", "converged", "rows that count"], rows)


def presets_table(result: dict) -> list[str]:
    """Error and cost of the presets and of what they replaced."""
    presets = result["presets"]
    columns = {
        "before: 0.5 px, none": BEFORE,
        "2 px, none, -1": "displacement 2 px, linear, none, mip bias -1",
        "`fast`": presets["fast"],
        "before: 1 px, ssaa2, -1": ASKED,
        "**`balanced`**": presets["balanced"],
        "`accurate`": presets["accurate"],
        "`reference`": presets["reference"],
    }
    return table(
        ["scene", *columns],
        [
            [name, *(cell(rows_of(scene).get(setting), result) for setting in columns.values())]
            for name, scene in result["scenes"].items()
        ],
    )


def frames_table(result: dict) -> list[str]:
    """Where more frames help."""
    columns = {
        f"{filter_} {px:g} px": f"displacement {px:g} px, linear, {filter_}"
        for filter_ in ("none", "edges")
        for px in (2, 1, 0.5, 0.25)
    }
    return table(
        ["scene", *columns],
        [
            [name, *(cell(rows_of(scene).get(setting), result, cost=False) for setting in columns.values())]
            for name, scene in result["scenes"].items()
        ],
    )


def steps_table(result: dict) -> list[str]:
    """Ways to choose times, all with ``edges``."""
    columns = {f"{px:g} px": f"displacement {px:g} px" for px in STEPS}
    columns |= {f"{c} C": f"brightness {c} C" for c in (4, 2, 1)}
    columns |= {f"budget {px} px": f"budget {px} px" for px in (0.1, 0.05)}
    return table(
        ["scene", *columns],
        [
            [
                name,
                *(cell(rows_of(scene).get(f"{s}, linear, edges, mip bias -1"), result) for s in columns.values()),
            ]
            for name, scene in result["scenes"].items()
        ],
    )


def standing_table(result: dict) -> list[str]:
    """How often nothing beats each preset."""
    rows = []
    for quality, setting in result["presets"].items():
        beaten = {}
        for name, scene in result["scenes"].items():
            counted = [r for r in scene["settings"] if r["trusted"]]
            mine = next((r for r in counted if r["name"] == setting), None)
            if mine is not None:
                beaten[name] = excess(mine, counted, result["cost"], result["error"])
        over = {name: e for name, e in beaten.items() if e > NOISE}
        title = f"**{quality}**" if setting == DEFAULT else quality
        rows.append([
            title, setting, f"{len(beaten) - len(over)} of {len(beaten)} scenes",
            ", ".join(f"{name} {100 * e:.0f} %" for name, e in over.items()) or "-",
        ])  # fmt: skip
    return table(["quality", "setting", "nothing beats it in", "elsewhere beaten by"], rows)


def price_at(scene: dict, result: dict) -> float | None:
    """Cost of `edges` at the error of 1 px with `ssaa2`, in parts of its cost: on the line through the steps of
    :data:`STEPS`, straight in logarithms. None where that error is not reached, or a row that is needed does not
    count."""
    rows, cost, error = rows_of(scene), result["cost"], result["error"]
    asked = rows.get(ASKED)
    line = [rows.get(f"displacement {px:g} px, linear, edges, mip bias -1") for px in STEPS]
    points = [r for r in line if r is not None and r["trusted"]]
    if asked is None or not asked["trusted"] or not points:
        return None
    if points[0][error] <= asked[error]:
        return points[0][cost] / asked[cost]
    for coarse, fine in itertools.pairwise(points):
        if fine[error] <= asked[error] < coarse[error]:
            part = math.log(coarse[error] / asked[error]) / math.log(coarse[error] / fine[error])
            return coarse[cost] * (fine[cost] / coarse[cost]) ** part / asked[cost]
    return None


def mean(values: list[float]) -> float:
    """Geometric; not a number for none."""
    return math.exp(sum(map(math.log, values)) / len(values)) if values else math.nan


def beside(result: dict, mine: str, other: str, key: str) -> dict[str, float]:
    """Scene -> one setting's error or cost in parts of another's, where both count."""
    found = {}
    for name, scene in result["scenes"].items():
        rows = rows_of(scene)
        if all(n in rows and rows[n]["trusted"] for n in (mine, other)):
            found[name] = rows[mine][key] / rows[other][key]
    return found


def sentences(result: dict) -> list[str]:
    """What the page says of the figures besides."""
    said = []
    for title, other in (("the default that was (0.5 px, none)", BEFORE), ("1 px, ssaa2, -1", ASKED)):
        errors, costs = (list(beside(result, DEFAULT, other, result[k]).values()) for k in ("error", "cost"))
        if errors:
            said.append(
                f"1 px, edges, -1 beside {title}, {len(errors)} scenes: error {mean(errors):.2f} times "
                f"({min(errors):.2f} to {max(errors):.2f}), cost {mean(costs):.2f} times ({min(costs):.2f} to "
                f"{max(costs):.2f})"
            )
    prices = {name: price_at(scene, result) for name, scene in result["scenes"].items()}
    said.append(
        "at the error of 1 px, ssaa2, -1 edges cost, in parts of its: "
        + "; ".join(f"{name} {'never, or not judged' if p is None else f'{p:.2f}'}" for name, p in prices.items())
    )
    ratios = beside(result, DEFAULT, ASKED, result["cost"])
    said.append("cost at the same step beside ssaa2: " + "; ".join(f"{n} {r:.2f}" for n, r in ratios.items()))
    return said


def tables(result: dict) -> list[list[str]]:
    """All of the page's."""
    made = (make(result) for make in (scenes_table, presets_table, frames_table, steps_table, standing_table))
    return [lines for lines in made if lines]


def put(text: str, new: list[list[str]]) -> str:
    """A page with these tables in the places of those with the same first line; ValueError where one is not there."""
    lines = text.split("\n")
    for made in new:
        if made[0] not in lines:
            raise ValueError(f"no table begins with {made[0]}")
        first = lines.index(made[0])
        last = first
        while last < len(lines) and lines[last].startswith("|"):
            last += 1
        lines[first:last] = made
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("measurement", type=Path)
    parser.add_argument("--page", type=Path, help="put the tables into this page")
    options = parser.parse_args()
    result = json.loads(options.measurement.read_text(encoding="utf-8"))
    left_out = [name for name, scene in result["scenes"].items() if "settings" not in scene]
    result["scenes"] = {name: scene for name, scene in result["scenes"].items() if "settings" in scene}
    if not result["scenes"] or len(result["presets"]) < 4:
        sys.exit("no scene was measured, or not with all presets: the whole suite is needed")
    if options.page is not None:
        page = put(options.page.read_text(encoding="utf-8"), tables(result))
        options.page.write_text(page, encoding="utf-8")
    else:
        print("\n\n".join("\n".join(lines) for lines in tables(result)))
    print(*(f"- {line}" for line in sentences(result)), sep="\n")
    if left_out:
        print(f"not measured: {', '.join(left_out)}")


if __name__ == "__main__":
    main()
