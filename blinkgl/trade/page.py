"""The page to read: one self-contained HTML file in the style of the data-set report."""

from __future__ import annotations

import base64
import json
from html import escape
from importlib import resources

from blinkgl.report.charts import number

_STYLE = """table.settings td, table.settings th { padding: 3px 9px 3px 0; text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; font-weight: 400 }
table.settings th { white-space: normal; min-width: 52px; color: var(--dim); vertical-align: bottom; border-bottom: 1px solid var(--line) } table.settings td:first-child, table.settings th:first-child { text-align: left }
table.settings tr.best td { font-weight: 600 } table.settings tr.best td:first-child::before { content: "● "; color: var(--mark) }
.wide { overflow-x: auto } img.plot { width: 100%; background: #fff; border-radius: 6px } pre { overflow-x: auto; font-size: 12.5px } dt { font-weight: 600; margin-top: 8px } dd { margin: 0 0 0 16px }"""


def page(result: dict, picture: bytes) -> str:
    """The HTML text. picture : the PNG of the plot."""
    style = resources.files("blinkgl.report").joinpath("style.css").read_text(encoding="utf-8") + _STYLE
    size = result["sizes"][result["size"]]
    title = "What accuracy costs"
    sections = [_overview(result, size), _plot(picture), _front(result), _all(result), _reference(result), _terms(result, size), _origin(result)]
    return (f"<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'><title>{title}</title>"
            f"<style>{style}</style><main><h1>{title}</h1>" + "".join(sections) + "</main></html>\n")


def _overview(result: dict, size: dict) -> str:
    rows = result["settings"]
    tiles = [("settings measured", len(rows)), ("worth choosing", len(result["front"])), ("image", f"{size['width']}×{size['height']}"),
             ("simulated clip", f"{size['clip_s']:g} s"), ("pixels judged", number(size["judged_pixels"])), ("rounds", result["rounds"])]
    cells = "".join(f"<div><b>{value}</b><span>{label}</span></div>" for label, value in tiles)
    trust = "".join(f"<p class={'dim' if s['converged'] else 'bad'}>{escape(_sentence(result, name))}</p>" for name, s in result["sizes"].items())
    return ("<p>A simulated event camera draws frames and finds, pixel by pixel, when the brightness has changed enough for an event. Frames that "
            "are further apart, or drawn with fewer samples per pixel, are cheaper and give wronger events. This page says how much of one buys how much of "
            f"the other, for one scene on one machine.</p><div class=tiles>{cells}</div>{trust}")


def _sentence(result: dict, name: str) -> str:
    from blinkgl.trade.run import convergence_line

    line = convergence_line(result, name)
    return ("" if name == "full" else f"{name}: ") + line[0].upper() + line[1:] + "."


def _plot(picture: bytes) -> str:
    data = base64.b64encode(picture).decode()
    return ("<h2>The picture</h2><p>Every mark is a setting. Left is cheaper, down is better, both axes are logarithmic. The marks with a black rim are "
            "those that no other setting beats in both; the rest have no reason to be chosen, unless another error matters more to you (the two small "
            f"pictures).</p><img class=plot alt='cost against error of all settings' src='data:image/png;base64,{data}'>")


def _front(result: dict) -> str:
    best = sorted((r for r in result["settings"] if r["on_front"]), key=lambda r: r[result["cost"]])
    lines = "".join(f"<dt>{escape(r['name'])}</dt><dd>{_cost(result, r)}; voxel grids differ by {100 * r['voxel']:.1f} %, {100 * r['missed']:.1f} % of the "
                    f"events missed and {100 * r['extra']:.1f} % invented, half of the rest within {r['time_median_us']:.0f} µs. In the YAML: "
                    f"<code>{escape('; '.join(r['overrides']))}</code></dd>" for r in best)
    return f"<h2>Settings that nothing beats, cheapest first</h2><dl>{lines}</dl>"


def _cost(result: dict, r: dict) -> str:
    return f"{r[result['cost']]:.2f} s {'of processor time ' if result['cost'] == 'cpu_s' else ''}per simulated second"


def _all(result: dict) -> str:
    head = ("setting", "wall s / s", "processor s / s", "frames / s", "triangles / frame", "time error µs, median", "95 %", "shift px, median", "95 %", "missed",
            "extra", "events, relative", "voxel grid", "flow px, median", "max")
    body = []
    for r in sorted(result["settings"], key=lambda r: (r["size"], r[result["cost"]])):
        percent = lambda v: "–" if v is None else f"{100 * v:.1f} %"
        cells = [escape(r["name"]), f"{r['wall_s']:.2f}", f"{r['cpu_s']:.2f}", f"{r['frames_per_s']:.0f}", f"{r['triangles']:,.0f}", f"{r['time_median_us']:.0f}",
                 f"{r['time_p95_us']:.0f}", f"{r['shift_median_px']:.3f}", f"{r['shift_p95_px']:.3f}", percent(r["missed"]), percent(r["extra"]),
                 f"{100 * r['count']:+.1f} %", percent(r["voxel"]), f"{r['flow_median_px']:.1e}", f"{r['flow_max_px']:.1e}"]
        body.append(f"<tr{' class=best' if r['on_front'] else ''}>" + "".join(f"<td>{c}</td>" for c in cells) + "</tr>")
    return ("<h2>All settings</h2><div class=wide><table class=settings><tr>" + "".join(f"<th>{h}</th>" for h in head) + "</tr>" + "".join(body) + "</table></div>")


def _reference(result: dict) -> str:
    from blinkgl.trade.run import NAMES

    how = ("path-traced by Blender's Cycles (samples are paths), with shadows and inter-reflection, which the settings leave out"
           if result.get("reference") == "cycles" else "drawn much more finely")
    parts = [(f"<h2>The reference</h2><p>Judged by the same scene {how}. It is made finer and finer; each step is judged by the next one "
              f"as if it were a setting. It is good enough when that error is below {100 * result['enough']:.0f} % of the smallest error of any setting, in all four measures.</p>")]
    for name, size in result["sizes"].items():
        head = "<tr><th>samples a pixel</th><th>px between frames</th><th>frames</th><th>seconds</th>" + "".join(f"<th>moved by, of the smallest error: {NAMES[k]}</th>" for k in NAMES) + "</tr>"
        rows = "".join(f"<tr><td>{lv['scale']}×{lv['scale']}</td><td>{lv['max_px']:g}</td><td>{lv['frames']}</td><td>{lv['seconds']:.0f}</td>"
                       + "".join(f"<td>{100 * lv['ratio'][k]:.1f} %</td>" if lv["ratio"] else "<td>–</td>" for k in NAMES) + "</tr>" for lv in size["levels"])
        label = "" if name == "full" else f"<h3>{escape(name)}</h3>"
        parts.append(f"{label}<div class=wide><table class=settings>{head}{rows}</table></div>")
    return "".join(parts)


def _terms(result: dict, size: dict) -> str:
    terms = {
        "wall s / s, processor s / s": "Seconds of clock, and of all processor cores together, per simulated second: drawing, read-back and event kernel, warm, median of "
                                       "interleaved rounds. Files are not written.",
        "time error": f"Every event of the reference is matched with at most one of the same pixel and polarity, at most {result['limit_us'] / 1000:g} ms away, so "
                      "that the sum of the distances and of a fine for every event left alone is smallest. The error is the distance.",
        "shift": "The time error times the image speed at that pixel: how far the edge was from where it should have been.",
        "missed, extra": "Events of the reference without a partner, and events without one in the reference, both relative to the reference's count.",
        "voxel grid": "Events are summed into 15 time slices as for a network; the length of the difference of the two grids relative to the reference's.",
        "flow": "Optical-flow labels against float64 ray casting into the scene with all its triangles, off silhouettes.",
        "displacement, uniform, brightness, budget": "How frame times are chosen: so that nothing moves further, at a fixed rate, so that no pixel changes more, to an error.",
        "linear, pchip, hermite": "The curve that brightness is taken to follow between frames.",
        "none, msaa4, taps4, ssaa2, ssaa4": "Samples per pixel: one; 4 at silhouettes; 4 of textures; 2×2 and 4×4 of everything.",
        "mip bias, lod, textures": "Sharper mip maps; meshes decimated until their triangles are not far below a pixel; smaller textures.",
    }
    what = ", ".join(f"{k} {v:g}" for k, v in size["emulator"].items() if isinstance(v, float) and k.startswith(("contrast", "threshold_sigma")))
    return ("<h2>Words</h2><dl>" + "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in terms.items())
            + f"</dl><p class=dim>Events by {escape(size['emulator']['emulator'].upper())} without noise, {escape(what)}: noise would drown the errors asked for here.</p>")


def _origin(result: dict) -> str:
    return (f"<h2>Where this comes from</h2><p class=dim>{escape(result['machine'])}. Sequence {result['sequence']}; {result['seconds']:.0f} s in all. "
            f"The same numbers are in trade.json and trade.csv.</p><pre>{escape(json.dumps(result['config'], indent=1, default=str))}</pre>")
