"""Runs the tests against each wrong line of tests/mutants.txt: all of them must fail.

    python -m blinkgl.tools.mutants [--only TEXT]        # in a clone of its own, with .venv; about half an hour

Files are changed in place, one at a time, and put back. Exit status 1: a wrong line that no test sees.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path

LIST = Path("tests/mutants.txt")
LIMIT_S = 900


def mutants() -> list[tuple[Path, str, str, list[str]]]:
    """(file, what stands there, what is put in its place, tests). Raises ValueError: the text is not there once."""
    found = []
    for line in LIST.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            name, there, instead, tests = line.split(" | ")
            if Path(name).read_text(encoding="utf-8").count(there) != 1:
                raise ValueError(f"{LIST}: {name}: '{there}' does not stand there once")
            found.append((Path(name), there, instead, tests.split()))
    return found


def outcome(file: Path, there: str, instead: str, tests: list[str]) -> str:
    """The test that fails, "time" when the tests did not end, or "" when all pass."""
    right = file.read_text(encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-xq", "-p", "no:cacheprovider", "--tb=no", "-m", "not slow", *tests]
    try:
        file.write_text(right.replace(there, instead), encoding="utf-8")
        run = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    except subprocess.TimeoutExpired:
        return "time"
    finally:
        file.write_text(right, encoding="utf-8")
    failed = [line.split()[1] for line in run.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return (failed or [f"exit status {run.returncode}"])[0] if run.returncode else ""


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--only", default="", help="part of a line of the list")
    only = parser.parse_args(arguments).only
    if subprocess.run(["git", "status", "--porcelain", "-uno"], capture_output=True, text=True, check=True).stdout:
        raise SystemExit("error: the tree has changes; commit them, or work in a clone")
    lived = 0
    for file, there, instead, tests in mutants():
        if only in f"{file} {there}":
            began = time.monotonic()
            died = outcome(file, there, instead, tests)
            lived += not died
            print(
                f"{'dies' if died else 'LIVES'}  {time.monotonic() - began:4.0f} s  {file}: {instead}  {died}",
                flush=True,
            )
    print(f"{lived} live")
    return int(lived > 0)


if __name__ == "__main__":
    raise SystemExit(main())
