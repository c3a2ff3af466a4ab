"""One picture of all scenes of the suite: what each looks like, what its settings cost and how wrong they are."""

from __future__ import annotations

import io
import math
from pathlib import Path

from blinkgl.trade.plot import COLOURS, COSTS

MARKED = {"fast": "F", "balanced": "B", "accurate": "A", "reference": "R"}


def fronts(result: dict, folder: Path) -> bytes:
    """PNG bytes. folder : where the pictures of the scenes are."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    scenes = {name: scene for name, scene in result["scenes"].items() if scene.get("settings")}
    columns = min(3, len(scenes))
    rows = math.ceil(len(scenes) / columns)
    figure = Figure(figsize=(6.2 * columns, 4.6 * rows + 1.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax, (name, scene) in zip(axes, scenes.items()):
        _panel(ax, name, scene, result, folder)
    for ax in axes[len(scenes) :]:
        ax.axis("off")
    missing = f"   PARTIAL: without {', '.join(result['missing'])}" if result["missing"] else ""
    figure.suptitle(
        "What accuracy costs, scene by scene. Each dot is one way to draw the clip: left is cheaper, down is better.\n"
        f"Nothing lies below and left of the line; presets of `quality:` are marked by their first letter.{missing}",
        fontsize=14,
    )
    figure.supylabel(
        "error of the events (difference of voxel grids, relative); both scales are logarithmic", fontsize=12
    )
    _legend(figure, scenes)
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=80, metadata={"Software": None})
    return out.getvalue()


def _panel(ax, name: str, scene: dict, result: dict, folder: Path) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    cost = result["cost"]
    letters = {setting: MARKED.get(quality, quality[0].upper()) for quality, setting in result["presets"].items()}
    for row in scene["settings"]:
        if not (row["voxel"] and math.isfinite(row["voxel"])):
            continue
        colour = COLOURS.get(_antialiasing(row["name"]), "0.5")
        letter = letters.get(row["name"])
        ax.plot(
            row[cost],
            100 * row["voxel"],
            "o",
            color=colour if row["trusted"] else "none",
            mec="black" if letter else colour if not row["trusted"] else "white",
            mew=1.6 if letter else 0.8,
            ms=15 if letter else 6,
            zorder=5 if letter else 3,
        )
        if letter:
            text = "white" if row["trusted"] else "black"
            ax.annotate(
                letter, (row[cost], 100 * row["voxel"]), ha="center", va="center", color=text, fontsize=9, zorder=6
            )
    best = sorted((r for r in scene["settings"] if r["on_front"]), key=lambda r: r[cost])
    ax.step([r[cost] for r in best], [100 * r["voxel"] for r in best], where="post", color="0.25", lw=1.3, zorder=2)
    ax.set(xscale="log", yscale="log", xlabel=COSTS[cost])
    for axis, text in ((ax.xaxis, lambda v, _: f"{v:g}"), (ax.yaxis, lambda v, _: f"{v:g} %")):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(FuncFormatter(text))
        axis.set_minor_formatter(NullFormatter())
    ax.grid(alpha=0.25)
    ax.spines[["top", "right"]].set_visible(False)
    low, high = ax.get_ylim()
    ax.set_ylim(low, high * (high / low) ** 0.55)  # room for the picture
    title = scene["what"].split(":")[0].split(". ")[0] or name
    ax.set_title(title[0].upper() + title[1:], fontsize=12, loc="left")
    picture = folder / f"{name}.png"
    if picture.is_file():
        from matplotlib.image import imread

        inset = ax.inset_axes((0.66, 0.63, 0.34, 0.37))
        inset.imshow(imread(picture))
        inset.set(xticks=[], yticks=[])


def _antialiasing(name: str) -> str:
    """Of a setting's name."""
    return next((part for part in name.split(", ") if part in COLOURS), "")


def _legend(figure, scenes: dict) -> None:
    from matplotlib.lines import Line2D

    used = {_antialiasing(row["name"]) for scene in scenes.values() for row in scene["settings"]}
    dot = lambda colour, **more: Line2D([], [], marker="o", ls="", ms=9, **({"color": colour} | more))
    handles = [dot(c, label=f"anti-aliasing: {part}") for part, c in COLOURS.items() if part in used]
    handles.append(dot("none", mec="0.4", label="hollow: more exact than the reference can judge to a tenth; not used"))
    figure.legend(handles=handles, loc="outside lower center", ncols=math.ceil(len(handles) / 2), fontsize=11)
