"""A recipe small enough to be made many times, and helpers to look at what came of it."""

import hashlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import yaml

from blinkgl.cli import run
from blinkgl.config.reader import to_yaml
from blinkgl.io.records import sealed
from blinkgl.sequence_files.sequence_dir import digest_of

RECIPE = {
    "seed": 11,
    "camera": {"width": 64, "height": 48},
    "time": {"duration": 0.2, "label_rate": 20},
    "timeline": {"kind": "uniform", "fps": 300},
    "scene": {
        "kind": "random",
        "objects": {"count": 3},
        "pool": {"primitives": ["cuboid", "sphere"], "variants": 12, "test_fraction": 0.3},
        "textures": {
            "procedural": ["checks", "fbm"],
            "variants": 12,
            "photographs": False,
            "max_size": 64,
            "test_fraction": 0.3,
        },
    },
    "labels": {"flow": ["forward"], "ids": True},
    "preview": {"enabled": False},
    "groups": {
        "fly": {
            "output": {"sequences": 4},
            "events": {"emulator": "esim", "contrast_threshold": {"uniform": [0.1, 0.3]}},
        },
        "probe": {"output": {"split": "test", "sequences": 2}, "events": {"emulator": "v2e"}},
    },
}
NAMES = [*(f"train/fly_{i:06d}" for i in range(4)), *(f"test/probe_{i:06d}" for i in range(2))]


def recipe_file(folder: Path, **changes) -> Path:
    path = folder / "recipe.yaml"
    path.write_text(yaml.safe_dump({**RECIPE, **changes}))
    return path


def generated(folder: Path, config: dict | str) -> Path:
    """``folder`` with a run.yaml and, in ``out``, the data set that `generate` makes of it."""
    path = folder / "run.yaml"
    path.write_text(config if isinstance(config, str) else to_yaml(config), encoding="utf-8")
    assert run(["generate", str(path), "--out", str(folder / "out")]) == 0
    return folder


def tree(out: Path) -> dict[str, str]:
    """Hash of every file of a data set but those of ``.run``, temporaries included."""
    return {
        p.relative_to(out).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(out.rglob("*"))
        if p.is_file() and p.relative_to(out).parts[0] != ".run"
    }


def command(*arguments) -> list[str]:
    return [sys.executable, "-m", "blinkgl.cli", "generate", *map(str, arguments)]


def start(*arguments) -> subprocess.Popen:
    return subprocess.Popen(command(*arguments), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def temporaries(out: Path) -> list[Path]:
    return [p for p in out.rglob(".*blinkgl-tmp-*") if p.is_dir()] if out.is_dir() else []


def wait_for(condition, driver: subprocess.Popen | None = None, timeout_s: float = 600.0):
    """The first true value of ``condition()``, which a driver that has ended cannot bring about any more."""
    deadline = time.monotonic() + timeout_s
    while not (value := condition()):
        assert time.monotonic() < deadline, "it did not come to that"
        assert driver is None or driver.poll() is None, f"it ended first: {driver.communicate()[0]}"
        time.sleep(0.005)
    return value


def children(pid: int) -> list[int]:
    """Worker processes of a driver."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
                if int(fields[1]) == pid and b"blinkgl.dataset.worker" in (entry / "cmdline").read_bytes():
                    found.append(int(entry.name))
            except OSError:
                continue
    return sorted(found)


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


def assert_same(out: Path, reference: Path) -> None:
    """The files of both but the index, and no temporary is left."""
    made = tree(out)
    made.pop("index.jsonl")
    assert made == tree(reference) and temporaries(out) == []


class Listener:
    """A display that keeps the messages. At those of a kind (about a sequence, if one is named) it acts, once, or until
    ``act`` no longer returns False."""

    def __init__(self, act, kind: str = "progress", name: str | None = None):
        self.act, self.kind, self.name, self.done, self.messages = act, kind, name, False, []

    def begin(self, plan, outcome) -> None: ...
    def end(self, outcome) -> None: ...

    def message(self, name, message) -> None:
        self.messages.append((name, dict(message)))
        if not self.done and message["kind"] == self.kind and self.name in (None, name):
            self.done = self.act(name, message) is not False

    @property
    def errors(self) -> list[str]:
        return [message["error"] for _, message in self.messages if message["kind"] == "failed"]


def forge(folder: Path, name: str = "", **changes) -> None:
    """Bring the manifest in line with what was done to a file, as a bug in the writer would; change what it says."""
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text())
    if name:
        manifest["files"][name] = digest_of(folder / name)
    path.write_text(sealed({**manifest, **changes}))
