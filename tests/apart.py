"""Commands in another process, which starts once for all of them."""

import json
import os
import subprocess
import sys
from pathlib import Path

RUNNER = """
import contextlib, importlib, io, json, sys, traceback
answers = []
for program, *words in json.loads(sys.argv[1]):
    with contextlib.redirect_stdout(io.StringIO()) as said, contextlib.redirect_stderr(said):
        try:
            status = exec(*words) or 0 if program == "-c" else importlib.import_module(f"{program}.cli").run(words)
        except BaseException:
            traceback.print_exc()
            status = 1
    answers.append((status, said.getvalue()))
print(json.dumps(answers))
"""


def run_apart(commands: list[list[str]], folder: Path, **environment: str) -> list[tuple[int, str]]:
    """Run the commands ("blinkgl" or "eflow" and its words, or "-c" and a program) in ``folder``, one after the other;
    return the status of each and all that it printed."""
    line = [sys.executable, "-c", RUNNER, json.dumps(commands)]
    done = subprocess.run(line, cwd=folder, env={**os.environ, **environment}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)
