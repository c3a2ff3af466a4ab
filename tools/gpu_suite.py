"""Everything that has to be measured on a graphics card, in one command that needs no network.

    python -m blinkgl.tools.gpu_suite --out FOLDER [--small] [--minutes 9] [--only doctor,passes] [--again NAME]

Pieces (``gpu_pieces.py``) are run one after another, each in a process of its own that is ended when the call's minutes
are over. What was measured is kept row by row, so the same command again goes on where the last one stopped; it exits
with status 3 as long as something is left. FOLDER then has ``gpu_suite.json`` (everything) and ``gpu_suite.md`` (the
tables); both are written after every piece. A piece that this machine cannot do (no context on the card, no torch) says
so in a line and the others go on. What was kept of another build of BlinkGL, or of the other size, is measured again.

The page docs/gpu.md says what to carry to a machine without a network; ``gpu_wheels.txt`` is the list.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from blinkgl.dataset.work import environment
from blinkgl.io.atomic import atomic_file
from blinkgl.machine import bench
from blinkgl.tools.gpu_pieces import PIECES, Absent

LEAST_S = 20.0
"""A piece is not begun with less time than that."""
LEFT = 3
"""Exit status: the same command again goes on."""


class Rows:
    """The rows of one piece, on disk as soon as they are there: a line of JSON each, {"key": …, …}."""

    def __init__(self, file: Path, stamp: dict[str, Any]):
        self.file = file
        self.rows = kept(file, stamp)
        with atomic_file(file, overwrite=True) as part:  # without what was half written
            part.write_text("".join(json.dumps(line) + "\n" for line in (stamp, *self.rows)), encoding="utf-8")

    def __contains__(self, key: str) -> bool:
        return any(row["key"] == key for row in self.rows)

    def add(self, key: str, **values: Any) -> None:
        """Keeps a row. Numbers of NumPy become plain ones."""
        row = {"key": key, **{name: getattr(value, "item", lambda v=value: v)() for name, value in values.items()}}
        self.rows.append(row)
        with self.file.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
            file.flush()
            os.fsync(file.fileno())


def kept(file: Path, stamp: dict[str, Any]) -> list[dict[str, Any]]:
    """The rows that a file has, whole lines alone; none where they are of another build or size."""
    try:
        text = file.read_text(encoding="utf-8")
    except OSError:
        return []
    lines = []
    for line in text.splitlines():
        try:
            lines.append(json.loads(line))
        except ValueError:  # the process was ended while it wrote this one
            break
    return lines[1:] if lines and lines[0] == stamp else []


def stamp_of(small: bool) -> dict[str, Any]:
    """What makes kept rows comparable."""
    return {"build": environment(None)["blinkgl"], "small": small}


def one_piece(name: str, out: Path, options: argparse.Namespace) -> int:
    """In a process of its own: the piece's rows that are not there yet."""
    rows = Rows(out / "pieces" / f"{name}.jsonl", stamp_of(options.small))
    try:
        PIECES[name].run(rows, options)
    except Absent as absent:
        print(absent)
        return 4
    return 0


def _run(name: str, out: Path, arguments: list[str], seconds: float) -> dict[str, Any]:
    """One piece in a process of its own, with everything that it starts."""
    began = time.monotonic()
    log = out / "pieces" / f"{name}.log"
    with log.open("w", encoding="utf-8") as file:
        process = subprocess.Popen(
            [sys.executable, "-m", "blinkgl.tools.gpu_suite", "--out", str(out), "--piece", name, *arguments],
            stdout=file,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            status = process.wait(seconds)
        except subprocess.TimeoutExpired:
            status = None
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
    lines = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    said = " ".join(lines[-1].split())[:300] if lines else ""
    if status is None:
        state, said = "begun", "its minutes were over"
    elif status == 0:
        state, said = "done", ""
    elif status == 4:
        state = "absent"
    else:
        state, said = "failed", said or f"ended with status {status}"
    return {"state": state, "said": said, "seconds": round(time.monotonic() - began, 1)}


def table(rows: list[dict[str, Any]]) -> list[str]:
    """Lines of a Markdown table."""
    columns = list(dict.fromkeys(name for row in rows for name in row if name != "key"))
    show = lambda v: "" if v is None else f"{v:,.4g}" if isinstance(v, float) else str(v).replace("|", "/")
    return [
        "| " + " | ".join(["", *columns]) + " |",
        "|---" * (len(columns) + 1) + "|",
        *("| " + " | ".join([row["key"], *(show(row.get(name)) for name in columns)]) + " |" for row in rows),
    ]


def write(out: Path, report: dict[str, Any], stamp: dict[str, Any]) -> None:
    """``gpu_suite.json`` and ``gpu_suite.md``, whole."""
    for name, piece in report["pieces"].items():
        piece["rows"] = kept(out / "pieces" / f"{name}.jsonl", stamp)
    lines = [f"# {report['machine']}", "", f"BlinkGL {stamp['build']}{', small sizes' if stamp['small'] else ''}"]
    for name, piece in report["pieces"].items():
        lines += ["", f"## {name}: {PIECES[name].title}", ""]
        if piece["state"] != "done":
            lines += [f"{piece['state']}: {piece['said']}", ""]
        lines += table(piece["rows"]) if piece["rows"] else []
    for name, text in (("gpu_suite.json", json.dumps(report, indent=1)), ("gpu_suite.md", "\n".join(lines))):
        with atomic_file(out / name, overwrite=True) as part:
            part.write_text(text + "\n", encoding="utf-8")


def parsed(arguments: list[str] | None) -> argparse.Namespace:
    """Of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/gpu_suite"), help="keeps what is measured")
    parser.add_argument("--minutes", type=float, default=9.0, help="of this call; the next one goes on")
    parser.add_argument("--small", action="store_true", help="small pictures and few of them: does everything run?")
    parser.add_argument("--only", default="", help="pieces, with commas between: " + ", ".join(PIECES))
    parser.add_argument("--again", default="", help="pieces that are measured anew")
    parser.add_argument("--backend", default="auto", help="of the context: auto, egl, osmesa")
    parser.add_argument("--device", type=int, default=0, help="EGL device, as blinkgl doctor numbers them")
    parser.add_argument("--piece", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    for name in [*_names(options.only), *_names(options.again)]:
        if name not in PIECES:
            parser.error(f"--only, --again: no piece is called that (got {name!r}); expected " + ", ".join(PIECES))
    return options


def _names(text: str) -> list[str]:
    return [name for name in text.split(",") if name]


def main(arguments: list[str] | None = None) -> int:
    """See the module. 0: everything is measured, or cannot be here; 1: something failed; 3: something is left."""
    options, began = parsed(arguments), time.monotonic()
    out = options.out
    (out / "pieces").mkdir(parents=True, exist_ok=True)
    if options.piece:
        return one_piece(options.piece, out, options)
    stamp = stamp_of(options.small)
    try:
        before = json.loads((out / "gpu_suite.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        before = {}
    known = before["pieces"] if before.get("stamp") == stamp else {}
    report = {"machine": bench.machine_line(), "stamp": stamp, "pieces": known}
    passed_on = ["--backend", options.backend, "--device", str(options.device), *(["--small"] * options.small)]
    for name in _names(options.again):
        known.pop(name, None)
        (out / "pieces" / f"{name}.jsonl").unlink(missing_ok=True)
    for name in _names(options.only) or list(PIECES):
        left = 60 * options.minutes - (time.monotonic() - began)
        if known.get(name, {}).get("state") == "done" or left < LEAST_S:
            continue
        print(f"{name} …", flush=True)
        known[name] = _run(name, out, passed_on, left)
        report["pieces"] = {name: known[name] for name in PIECES if name in known}
        write(out, report, stamp)
        rows = known[name]["rows"]
        print(f"{name}: {known[name]['state']}, {len(rows)} rows, {known[name]['seconds']} s  {known[name]['said']}")
    write(out, report, stamp)
    print((out / "gpu_suite.md").read_text(encoding="utf-8"))
    states = {name: known.get(name, {}).get("state", "begun") for name in _names(options.only) or PIECES}
    if left_over := [name for name, state in states.items() if state == "begun"]:
        print(f"left: {', '.join(left_over)}; the same command again goes on")
        return LEFT
    return int("failed" in states.values())


if __name__ == "__main__":
    sys.exit(main())
