"""The tests on every Python that setup.cfg admits and this machine has, and with the oldest and the newest libraries:
make matrix.

nox -f tools/noxfile.py [-s tests-3.12 | -s oldest | -s newest] [-- tests/io]
"""

from __future__ import annotations

import shutil
from pathlib import Path

import nox

ROOT = Path(__file__).resolve().parents[1]
PYTHONS = ("3.11", "3.12", "3.13")
EXTRAS = ".[dev,physics,view,formats]"
nox.options.error_on_missing_interpreters = False
nox.options.reuse_venv = "yes"
nox.options.envdir = str(ROOT / ".nox")  # not in tools/, where the tests would take it for code


def run_tests(session: nox.Session, *constraints: str) -> None:
    """Install the package as a developer does, and run the tests (or those after ``--``)."""
    session.install(*constraints, "-e", EXTRAS)
    session.run("python", "-m", "pytest", "-q", "-n", "auto", "--maxprocesses", "4", *session.posargs)


@nox.session(python=PYTHONS)
def tests(session: nox.Session) -> None:
    """With the versions of constraints.txt."""
    session.chdir(ROOT)
    run_tests(session, "-c", str(ROOT / "constraints.txt"))


@nox.session(python=PYTHONS[0])
def oldest(session: nox.Session) -> None:
    """With the lower bounds of setup.cfg, and what was current otherwise; the tests' own tools are the newest."""
    session.chdir(ROOT)
    constraints = Path(session.create_tmp()) / "oldest.txt"
    constraints.unlink(missing_ok=True)  # uv would keep the versions of an older one
    if shutil.which("uv") is None:
        session.install("uv")
    resolve = ["uv", "pip", "compile", "--quiet", "--resolution", "lowest-direct", "setup.cfg", "-o", str(constraints)]
    session.run(*resolve, external=True)
    run_tests(session, "-c", str(constraints))


@nox.session(python=PYTHONS[-1])
def newest(session: nox.Session) -> None:
    """With today's libraries, as who installs a wheel gets them."""
    session.chdir(ROOT)
    session.install("--upgrade", "--upgrade-strategy", "eager", "-e", EXTRAS)
    run_tests(session)
