"""Two networks on equal terms, from nothing to a table: generate, train both for the same steps, evaluate, time.

    python -m blinkgl.tools.compare_networks --out out/h100              # half an hour on one large GPU
    python -m blinkgl.tools.compare_networks --out out/h100 --minutes 9  # in pieces: repeat until it exits 0

What is done is kept and not done again: the data set goes on with ``--resume``, training from its newest checkpoint,
and whatever has a result is left alone. With --minutes it stops in time with exit status 75 and the same command goes
on. Every step is a command that could be typed; it is printed before it runs. The result is
OUT/table.md and OUT/comparison.json.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.config.reader import read_table
from blinkgl.errors import ConfigError
from eflow.bench import PRESETS
from eflow.config import load_train_config

AGAIN = 75
"""Exit status for "not finished, run again" (sysexits' EX_TEMPFAIL)."""
MODELS = {
    name: json.dumps(tree | ({"input": "voxel"} if tree["name"] == "ev_flownet" else {}))
    for name, tree in PRESETS.items()
}
SHOWN = ("AEE", "outlier", "1PE", "AE2D", "AE3D")


class Steps:
    """Runs commands one after the other until the time is up."""

    def __init__(self, minutes: float | None):
        self.end = None if minutes is None else time.monotonic() + 60 * minutes

    def left(self) -> float | None:
        """Minutes; None without a limit. Leaves the program when there are none."""
        if self.end is None:
            return None
        left = (self.end - time.monotonic()) / 60
        if left < 0.25:
            self.again()
        return left

    def again(self) -> None:
        print("out of time; the same command goes on from here", flush=True)
        sys.exit(AGAIN)

    def run(self, module: str, *arguments: str, timed: bool = False, fine: tuple[int, ...] = (0,)) -> None:
        """``timed``: the command stops by itself. Others are stopped by SIGTERM when the time is
        up (all of them leave no half results). ``fine``: exit statuses to go on after."""
        left = self.left()
        print("$", module.partition(".")[0], *arguments, flush=True)
        process = subprocess.Popen([sys.executable, "-m", module, *arguments])
        try:
            status = process.wait(None if left is None or timed else 60 * left)
        except subprocess.TimeoutExpired:
            process.terminate()
            process.wait()
            self.again()
        except BaseException:
            process.terminate()
            process.wait()
            raise
        if status not in fine:
            sys.exit(status)


def log(run: Path, kind: str) -> list[dict]:
    """Lines of a run's log."""
    lines = (json.loads(line) for line in (run / "log.jsonl").read_text(encoding="utf-8").splitlines())
    return [line for line in lines if line["kind"] == kind]


def begun(out: Path, wanted: dict[str, Any]) -> None:
    """Makes ``out`` and notes there what was asked for: results of other numbers must not stand in one table.
    ConfigError if it was begun with others."""
    out.mkdir(parents=True, exist_ok=True)
    asked = out / "asked.json"
    before = json.loads(asked.read_text(encoding="utf-8")) if asked.exists() else wanted
    if before != wanted:
        raise ConfigError(
            "begun with other numbers", where=str(out), value=wanted, accepted=f"{before} or another --out"
        )
    asked.write_text(json.dumps(wanted) + "\n", encoding="utf-8")


def train(steps: Steps, a: argparse.Namespace, name: str, data: Path, overrides: list[str]) -> Path:
    """Trains to the last step, or leaves the program for another time."""
    run = a.out / name
    sets = [
        f"model={MODELS[name]}",
        f"data.train=[{{path: {data / 'train'}}}]",
        f"data.validate_on=[{{path: {data / 'test'}}}]",
        *overrides,
    ]
    wanted = load_train_config(a.config, sets).optim.steps
    done = max((int(p.name) for p in (run / "checkpoints").glob("*") if p.name.isdigit()), default=0)
    if done < wanted:
        limit = steps.left()
        sets.append(f"run.time_limit={'null' if limit is None else f'{0.9 * limit:.3f}'}")
        options = [x for s in sets for x in ("--set", s)] + (["--resume"] if done else [])
        steps.run("eflow.cli", "train", str(a.config), "--out", str(run), *options, timed=True)
        done = max(int(p.name) for p in (run / "checkpoints").glob("*") if p.name.isdigit())
        if done < wanted:
            steps.again()
    return run


def table(rows: list[dict], zero: dict[str, float]) -> str:
    """Markdown."""
    head = [
        "",
        "M parameters",
        "steps",
        "AEE px",
        "outlier %",
        "1PE %",
        "AE2D deg",
        "AE3D deg",
        "forward ms",
        "training step ms",
        "training samples/s",
        "peak MiB forward",
        "training",
    ]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for r in rows:
        cells = [
            r["name"],
            f"{r['parameters'] / 1e6:.2f}",
            str(r["steps"]),
            *(f"{r['scores'][k]:.3f}" for k in SHOWN),
            f"{r['forward']['ms']:.0f}",
            f"{r['training']['ms']:.0f}",
            f"{r['samples_per_s']:.1f}",
            f"{r['forward']['peak_mib']:.0f}",
            f"{r['training']['peak_mib']:.0f}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    lines.append("| zero flow | | | " + " | ".join(f"{zero[k]:.3f}" for k in SHOWN) + " | | | | | |")
    return "\n".join(lines) + "\n"


def main() -> None:
    configs = Path(str(resources.files("blinkgl.configs"))) / "eflow"
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for everything")
    parser.add_argument("--config", type=Path, default=configs / "h100_30min.yaml")
    parser.add_argument("--data", type=Path, default=configs / "h100_data.yaml")
    parser.add_argument("--models", nargs="+", default=["eflowformer", "eraft"], choices=list(MODELS))
    parser.add_argument(
        "--set", action="append", default=[], metavar="a.b=c", help="override of the training configuration"
    )
    parser.add_argument("--data-set", action="append", default=[], metavar="a.b=c", help="override of the data recipe")
    parser.add_argument("--minutes", type=float, help="stop within this time, to be run again")
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--bench-size", default="640x480")
    a = parser.parse_args()
    a.out = a.out.resolve()
    steps, data = Steps(a.minutes), a.out / "data"
    began = time.monotonic()

    generate = ["generate", str(a.data), "--out", str(data), "--workers", str(a.workers), "--quiet"]
    steps.run(
        "blinkgl.cli",
        *generate,
        *(x for s in a.data_set for x in ("--set", s)),
        *(["--resume"] if data.exists() else []),
    )
    runs = {name: train(steps, a, name, data, a.set) for name in a.models}
    rows = []
    for name, run in runs.items():
        config = read_table(run / "config.yaml")
        precision, scores, bench = config["run"]["precision"], a.out / f"{name}_scores", a.out / f"{name}_bench.json"
        if not (scores / "results.json").is_file():
            steps.run(
                "eflow.cli",
                "evaluate",
                str(run),
                str(data / "test"),
                "--out",
                str(scores),
                "--empty",
                "skip",
                "--precision",
                precision,
            )
        if not bench.is_file():
            steps.run(
                "eflow.cli", "bench", "-m", name, "--size", a.bench_size, "--precision", precision, "--json", str(bench)
            )
        result = json.loads((scores / "results.json").read_text(encoding="utf-8"))
        timed = json.loads(bench.read_text(encoding="utf-8"))["rows"]
        trained = log(run, "train")
        if error := next((r["error"] for r in timed if "error" in r), None):
            bench.unlink()
            sys.exit(f"error: {bench}: {error}")
        rows.append(
            {
                "name": name,
                "parameters": result["parameters"],
                "steps": trained[-1]["step"],
                "scores": result["methods"]["network"]["total"],
                "samples_per_s": float(np.median([line["samples_per_s"] for line in trained])),
                "forward": next(r for r in timed if r["mode"] == "forward"),
                "training": next(r for r in timed if r["mode"] == "train"),
                "zero": result["methods"]["zero flow"]["total"],
                "device": result["device"],
            }
        )
    if len({r["steps"] for r in rows}) > 1:
        sys.exit(f"error: steps differ ({', '.join(str(r['steps']) for r in rows)}): no comparison on equal terms")
    text = table(rows, rows[0]["zero"])
    (a.out / "table.md").write_text(text, encoding="utf-8")
    (a.out / "comparison.json").write_text(
        json.dumps(
            {"rows": rows, "machine": rows[0]["forward"]["machine"], "seconds": time.monotonic() - began}, indent=1
        )
        + "\n"
    )
    print(rows[0]["forward"]["machine"], f"time and memory at {a.bench_size}, batch 1", sep="; ")
    print(text)


if __name__ == "__main__":
    main()
