"""Writes configs/quality/*.yaml from a measurement, with the figures they were chosen by, and
keeps the measurement beside them.

    blinkgl trade configs/flying_objects.yaml --out out/trade
    python -m blinkgl.tools.quality_presets out/trade/trade.json 'fast=NAME' 'balanced=NAME' 'accurate=NAME'
                                            'reference=NAME' [--command TEXT]

NAME is a setting of that measurement that is on its front; anything else is refused.
tests/trade/test_presets.py checks the result.
"""

from __future__ import annotations

import argparse
import json
import sys
from importlib import resources
from pathlib import Path

from blinkgl.config.quality import QUALITIES
from blinkgl.config.reader import to_yaml
from blinkgl.config.sequence import apply_overrides
from blinkgl.trade.run import convergence_line

KEPT = (
    "name",
    "sampling",
    "reconstruction",
    "antialiasing",
    "other",
    "size",
    "overrides",
    "wall_s",
    "cpu_s",
    "frames_per_s",
    "triangles",
    "events",
    "reference_events",
    "time_median_us",
    "time_p95_us",
    "shift_median_px",
    "shift_p95_px",
    "missed",
    "extra",
    "wrong",
    "count",
    "voxel",
    "flow_median_px",
    "flow_max_px",
    "on_front",
)


def preset_text(quality: str, row: dict, result: dict) -> str:
    """One preset file."""
    size = result["sizes"][result["size"]]
    tree = apply_overrides({"timeline": {}, "render": {}}, row["overrides"])
    figures = [
        (
            f"{row['name']}: {row['cpu_s']:.1f} processor seconds ({row['wall_s']:.1f} s by the clock) per simulated "
            f"second, {row['frames_per_s']:.0f} frames/s;"
        ),
        (
            f"voxel grids differ from the reference's by {100 * row['voxel']:.1f} %; {100 * row['missed']:.1f} % of "
            f"the events missed, {100 * row['extra']:.1f} % extra,"
        ),
        (
            f"count {100 * row['count']:+.1f} %; event times {row['time_median_us']:.0f} µs (median), "
            f"{row['time_p95_us']:.0f} µs (95 %), i.e. {row['shift_median_px']:.3f} px"
        ),
        (
            f"and {row['shift_p95_px']:.3f} px. {size['width']}x{size['height']}, {result['date']}; whole measurement: "
            "measured.json, docs/trade.md."
        ),
    ]
    return f"# quality: {quality}\n" + "".join(f"# {line}\n" for line in figures) + to_yaml(tree)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("measurement", type=Path)
    parser.add_argument("presets", nargs="+", metavar="QUALITY=NAME")
    parser.add_argument("--command", default="", help="how the measurement was made, for the record")
    options = parser.parse_args()
    result = json.loads(options.measurement.read_text(encoding="utf-8"))
    result["date"] = result["machine"].rsplit(", ", 1)[1]
    chosen = dict(p.split("=", 1) for p in options.presets)
    rows = {r["name"]: r for r in result["settings"]}
    if set(chosen) != set(QUALITIES) or any(name not in result["front"] for name in chosen.values()):
        sys.exit(f"give {', '.join(QUALITIES)}, each one of: " + "; ".join(result["front"]))
    folder = Path(str(resources.files("blinkgl.configs"))) / "quality"
    for quality, name in chosen.items():
        (folder / f"{quality}.yaml").write_text(preset_text(quality, rows[name], result), encoding="utf-8")
    kept = {
        k: result[k]
        for k in (
            "machine",
            "date",
            "sequence",
            "cost",
            "error",
            "size",
            "limit_us",
            "enough",
            "rounds",
            "sizes",
            "front",
        )
    }
    kept |= {
        "command": options.command,
        "convergence": convergence_line(result, result["size"]),
        "settings": [
            {k: round(v, 5) if isinstance(v, float) and abs(v) > 0.01 else v for k, v in r.items() if k in KEPT}
            for r in result["settings"]
        ],
    }
    (folder / "measured.json").write_text(json.dumps(kept, indent=0, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
