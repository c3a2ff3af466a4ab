"""Takes the Dockerfile's steps in a bare Debian, where there is no Docker: its RUN lines in a chroot.

    debootstrap --variant=minbase bookworm out/debian                        # as root; the FROM of the recipe, 200 MB
    python -m blinkgl.tools.recipe --root out/debian --target nvidia
    python -m blinkgl.tools.recipe --root out/debian --run generate /opt/blinkgl/configs/demo.yaml --out out/demo

The first call takes the steps that lead to a target; ``--run`` is what ``docker run`` would start then, as its user, in
its folder and environment. It needs root, is no container (network and processes are the host's), and changes nothing
outside the folder. /proc and /dev are mounted into it in a mount namespace of their own, which ends with the command.
"""

from __future__ import annotations

import argparse
import json
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

INSTRUCTIONS = ("FROM", "ENV", "RUN", "WORKDIR", "COPY", "USER", "ENTRYPOINT", "CMD")


@dataclass(frozen=True)
class Step:
    """One instruction of a Dockerfile; ``text``: what follows it."""

    instruction: str
    text: str


@dataclass
class State:
    """What the steps so far have set."""

    environment: dict[str, str] = field(
        default_factory=lambda: {"PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"}
    )
    folder: str = "/"
    user: str = "root"
    command: list[str] = field(default_factory=list)

    def set(self, step: Step) -> None:
        """ENV, WORKDIR, USER and ENTRYPOINT."""
        if step.instruction == "ENV":
            for pair in shlex.split(step.text):
                name, _, value = pair.partition("=")
                self.environment[name] = re.sub(r"\$\{?(\w+)\}?", lambda m: self.environment.get(m[1], ""), value)
        elif step.instruction == "WORKDIR":
            self.folder = step.text
        elif step.instruction == "USER":
            self.user = step.text
        elif step.instruction == "ENTRYPOINT":
            self.command = json.loads(step.text)


def steps(recipe: str) -> list[Step]:
    """The instructions of a Dockerfile, in order. Raises ValueError for one that is not known here."""
    found = []
    for line in re.sub(r"\\\n", " ", recipe).splitlines():
        if line.strip() and not line.startswith("#"):
            instruction, _, text = line.partition(" ")
            if instruction not in INSTRUCTIONS:
                raise ValueError(f"{instruction} is not among {', '.join(INSTRUCTIONS)}")
            found.append(Step(instruction, text.strip()))
    return found


def stage(recipe: str, target: str) -> tuple[str, list[Step]]:
    """The image that a target begins with, and the steps from there to its end."""
    stages: dict[str, tuple[str, list[Step]]] = {}
    name = ""
    for step in steps(recipe):
        if step.instruction == "FROM":
            base, _, name = step.text.partition(" AS ")
            image, before = stages.get(base, (base, []))
            stages[name] = (image, list(before))
        else:
            stages[name][1].append(step)
    return stages[target]


def inside(root: Path, state: State, command: str) -> int:
    """Exit status of a shell command inside ``root``."""
    change = f"exec chroot --userspec={shlex.quote(state.user)}"
    script = f'mount -t proc proc "$0/proc" && mount --rbind /dev "$0/dev" && {change} "$0" /bin/sh -c "$1"'
    settings = [f"{name}={value}" for name, value in state.environment.items()]
    line = f"cd {shlex.quote(state.folder)} && {command}"
    home = "/root" if state.user == "root" else f"/home/{state.user}"
    return subprocess.run(
        ["unshare", "--mount", "env", "-i", f"HOME={home}", *settings, "sh", "-c", script, str(root), line], check=False
    ).returncode


def copy(context: Path, root: Path, state: State, text: str) -> None:
    """``COPY a b … there``; of a folder its content, as Docker does."""
    *sources, target = shlex.split(text)
    there = root / (target if target.startswith("/") else f"{state.folder}/{target}").lstrip("/")
    for source in (context / name for name in sources):
        if source.is_dir():
            shutil.copytree(source, there, dirs_exist_ok=True, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            there.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, there)


def build(recipe: str, target: str, context: Path, root: Path, certificates: Path | None = None) -> State:
    """Takes the steps of a target in ``root``, a bare system. Raises RuntimeError with the line that failed.

    certificates : those that pip is to believe besides, where a proxy stands before the package index.
    """
    state = State()
    if certificates is not None:
        shutil.copy(certificates, root / "tmp/certificates.crt")
        state.environment["PIP_CERT"] = "/tmp/certificates.crt"  # seen from inside `root`
    for step in stage(recipe, target)[1]:
        if step.instruction == "RUN":
            print(f"RUN {step.text}", flush=True)
            if inside(root, state, step.text):
                raise RuntimeError(f"failed: RUN {step.text}")
        elif step.instruction == "COPY":
            copy(context, root, state, step.text)
        state.set(step)
        if step.instruction == "WORKDIR":
            (root / step.text.lstrip("/")).mkdir(parents=True, exist_ok=True)
    return state


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--root", type=Path, required=True, help="folder of a bare Debian")
    parser.add_argument("--target", default="cpu")
    parser.add_argument(
        "--certificates", type=Path, help="file that pip believes besides, behind a proxy that signs for others"
    )
    parser.add_argument("--run", nargs=argparse.REMAINDER, help="start the built image's command with these arguments")
    arguments = parser.parse_args()
    recipe = Path("Dockerfile").read_text(encoding="utf-8")
    root = arguments.root.resolve()
    if arguments.run is None:
        try:
            build(recipe, arguments.target, Path(), root, arguments.certificates)
        except RuntimeError as error:
            print(error, file=sys.stderr)
            return 1
        return 0
    state = State()
    for step in stage(recipe, arguments.target)[1]:
        state.set(step)
    return inside(root, state, shlex.join([*state.command, *arguments.run]))


if __name__ == "__main__":
    sys.exit(main())
