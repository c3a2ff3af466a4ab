"""The page to read: one self-contained HTML file in the style of the data-set report."""

from __future__ import annotations

import json

from blinkgl.report.charts import number
from blinkgl.report.markup import data_uri, render


def page(result: dict, picture: bytes) -> str:
    """The HTML text. picture : the PNG of the plot."""
    from blinkgl.trade.run import NAMES, convergence_line

    size = result["sizes"][result["size"]]
    trust = []
    for name, judged in result["sizes"].items():
        line = convergence_line(result, name)
        trust.append((("" if name == "full" else f"{name}: ") + line[0].upper() + line[1:] + ".", judged["converged"]))
    tiles = [
        (len(result["settings"]), "settings measured"),
        (len(result["front"]), "worth choosing"),
        (f"{size['width']}×{size['height']}", "image"),
        (f"{size['clip_s']:g} s", "simulated clip"),
        (number(size["judged_pixels"]), "pixels judged"),
        (result["rounds"], "rounds"),
    ]
    thresholds = ", ".join(
        f"{k} {v:g}"
        for k, v in size["emulator"].items()
        if isinstance(v, float) and k.startswith(("contrast", "threshold_sigma"))
    )
    return render(
        "trade/trade.html",
        title="What accuracy costs",
        result=result,
        settings=result["settings"],
        tiles=tiles,
        trust=trust,
        measures=NAMES,
        picture=data_uri(picture),
        emulator=size["emulator"],
        thresholds=thresholds,
        configuration=json.dumps(result["config"], indent=1, default=str),
    )
