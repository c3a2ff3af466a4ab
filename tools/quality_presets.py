"""Writes configs/quality/*.yaml from a run of the suite, with the figures they were chosen by, and keeps the
measurement beside them.

    blinkgl trade --suite --out out/suite
    python -m blinkgl.tools.quality_presets out/suite/suite.json 'fast=NAME' 'balanced=NAME' 'accurate=NAME'
                                            'reference=NAME' [--command TEXT]

NAME is a setting of the suite. What the choice does not hold to (nothing beats it in three quarters of the scenes, and
nowhere else by more than a tenth; `fast` is nowhere worse than 2 px without filtering) is printed, and written into
its file. tests/tools/trade/test_suite.py checks the result.
"""

from __future__ import annotations

import argparse
import json
import sys
from importlib import resources
from pathlib import Path

from blinkgl.config.quality import QUALITIES
from blinkgl.config.reader import apply_overrides, to_yaml
from blinkgl.tools.trade.settings import excess, suite_design
from blinkgl.tools.trade.suite import meaning

KEPT = (
    "name",
    "wall_s",
    "cpu_s",
    "frames_per_s",
    "reference_events",
    "time_median_us",
    "time_p95_us",
    "missed",
    "extra",
    "count",
    "voxel",
    "trusted",
    "on_front",
)


def rows_of(name: str, result: dict) -> list[tuple[str, dict, float]]:
    """(scene, row, by how much it is beaten there) of every scene where the setting's row counts."""
    counted = []
    for scene, measured in result["scenes"].items():
        rows = [r for r in measured.get("settings", ()) if r["trusted"]]
        counted += [(scene, r, excess(r, rows, result["cost"], result["error"])) for r in rows if r["name"] == name]
    return counted


def preset_text(quality: str, name: str, result: dict) -> str:
    """One preset file."""
    overrides = {s.name: s.overrides for s in suite_design()}[name]
    tree = apply_overrides({"timeline": {}, "render": {}}, overrides)
    counted = rows_of(name, result)
    free = sum(e <= 0 for *_, e in counted)
    lines = [
        f"quality: {quality}",
        f"{name}. Nothing beats it in {free} of {len(counted)} scenes of the suite, {result['date']}",
        "(docs/trade.md; measured.json). Processor seconds per simulated second at 240x180 px, missed and extra",
        "events, median error of event times, difference of voxel grids, by how much another setting is better in cost",
        "and error both:",
    ]
    for scene, r, e in counted:
        lines.append(
            f"  {scene:15} {r['cpu_s']:6.2f} s  {100 * r['missed']:5.1f} / {100 * r['extra']:5.1f} %  "
            f"{r['time_median_us']:5.0f} µs  {100 * r['voxel']:6.1f} %  {'-' if e <= 0 else f'{100 * e:.0f} %'}"
        )
    without = [scene for scene in result["scenes"] if scene not in {s for s, *_ in counted}]
    if without:
        lines.append(f"No row that counts (the reference moved by more than a tenth of it): {', '.join(without)}.")
    return "".join(f"# {line}\n" for line in lines) + to_yaml(tree)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("measurement", type=Path)
    parser.add_argument("presets", nargs="+", metavar="QUALITY=NAME")
    parser.add_argument("--command", default="", help="how the measurement was made, for the record")
    options = parser.parse_args()
    result = json.loads(options.measurement.read_text(encoding="utf-8"))
    machines = dict.fromkeys(s["machine"] for s in result["scenes"].values() if "machine" in s)
    result["date"] = next(iter(machines)).rsplit(", ", 1)[1]
    chosen = dict(p.split("=", 1) for p in options.presets)
    known = {s.name: s for s in suite_design()}
    if set(chosen) != set(QUALITIES) or any(name not in known for name in chosen.values()):
        sys.exit(f"give {', '.join(QUALITIES)}, each one of: " + "; ".join(known))
    folder = Path(str(resources.files("blinkgl.configs"))) / "quality"
    kept = {
        "machine": next(iter(machines)),
        "date": result["date"],
        "command": options.command,
        "cost": result["cost"],
        "error": result["error"],
        "presets": chosen,
        "settings": {name: meaning(known[name].overrides) for name in result["asked"]["settings"]},
        "scenes": {
            name: {
                "what": scene["what"],
                "converged": scene["converged"],
                "reference": scene["reference"],
                "clip_s": scene["clip_s"],
                "settings": [{k: _short(v) for k, v in r.items() if k in KEPT} for r in scene["settings"]],
            }
            for name, scene in result["scenes"].items()
            if "settings" in scene
        },
    }
    text = json.dumps(kept, indent=0, ensure_ascii=False) + "\n"
    (folder / "measured.json").write_text(text, encoding="utf-8")
    for quality, name in chosen.items():
        counted = rows_of(name, kept)
        beaten = [f"{scene} by {100 * e:.0f} %" for scene, _, e in counted if e > 0]
        print(f"{quality}: {name}: not beaten in {len(counted) - len(beaten)} of {len(counted)}; {', '.join(beaten)}")
        (folder / f"{quality}.yaml").write_text(preset_text(quality, name, kept), encoding="utf-8")


def _short(value: object) -> object:
    return float(f"{value:.4g}") if isinstance(value, float) else value


if __name__ == "__main__":
    main()
