"""Injects faults into real runs for as long as one likes, and checks that nothing shows in the end.

    python -m blinkgl.tools.soak [--recipe configs/blinkflow_mini.yaml] [--tiny] [--rounds 3]
                                 [--faults kill-worker,disk-full,…] [--json FILE]

One uninterrupted run in one process is the reference. Then, per round and fault: a run with two workers, the fault at a
random moment, ``--resume`` as often as it takes, ``verify --deep``, and a comparison of every byte outside ``.run``.
Faults strike a run in its middle: when at least a third of its sequences is whole, and others are being written. How
many were whole is said; a run that was over before is done again. ``--tiny``: sequences of a
tenth of a second, for many rounds.

| fault | what happens |
|---|---|
| kill-worker | kill -9 of a worker that is making a sequence |
| hang | SIGSTOP of a worker; the time limit has to notice |
| kill-driver | kill -9 of the driver |
| sigterm, sigint | what batch systems and people send to the driver |
| disk-full | the output lies on a tmpfs that is too small, and is enlarged afterwards (needs the right to mount) |
| corrupt-asset | all mesh files of the pool are overwritten during the run, and restored afterwards |
| ray-worker, ray-node | a Ray worker, one of two Ray nodes on this machine, dies (extra [cluster]) |
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from importlib import resources
from pathlib import Path

from rich.console import Console
from rich.table import Table

from blinkgl.config.sequence import load_run
from blinkgl.dataset.plan import Plan
from blinkgl.dataset.work import RUN_FOLDER
from blinkgl.machine.bench import machine_line
from blinkgl.scene.geometry import primitives

LOCAL = ("kill-worker", "hang", "kill-driver", "sigterm", "sigint", "disk-full", "corrupt-asset")
RAY = ("ray-worker", "ray-node")
MAX_RESUMES = 12
TINY = [
    "camera.width=64",
    "camera.height=48",
    "time.duration=0.1",
    "time.label_rate=20",
    "preview.enabled=false",
    "scene.textures.photographs=false",
    "scene.textures.max_size=64",
    "scene.pool.urdfs=false",
]


class Soak:
    """Where things lie, and how a run is started."""

    def __init__(self, recipe: Path, overrides: list[str], workers: int, scratch: Path, dice: random.Random):
        self.workers, self.scratch, self.dice = workers, scratch, dice
        self.meshes = make_meshes(scratch / "meshes")
        self.recipe = recipe
        self.overrides = [*overrides, f"scene.pool.folders=[{self.meshes}]"]
        self.tasks = Plan.of(load_run(recipe, self.overrides)).tasks
        self.limit_s, self.pace_s = 600.0, 0.5
        self.struck: list[int] = []  # how many sequences were whole at each stroke of this round's fault

    def command(self, out: Path, *more: object) -> list[str]:
        sets = [word for option in self.overrides for word in ("--set", option)]
        return [
            sys.executable,
            "-m",
            "blinkgl.cli",
            "generate",
            str(self.recipe),
            "--out",
            str(out),
            *sets,
            *map(str, more),
        ]

    def start(self, out: Path, *more: object) -> subprocess.Popen:
        return subprocess.Popen(self.command(out, *more), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    def whole(self, out: Path) -> int:
        return sum((out / task.name / "manifest.json").is_file() for task in self.tasks)

    def wait_until_busy(self, driver: subprocess.Popen, out: Path, least: int | None = None) -> bool:
        """At least ``least`` (default: a random number from a third of all on) sequences are whole and another is at
        work, for up to as long as one takes; False when the run was over before. What was
        whole then is appended to ``struck``."""
        count = len(self.tasks)
        target = least if least is not None else self.dice.randint(-(-count // 3), max(-(-count // 3), count - 5))
        while driver.poll() is None:
            if self.whole(out) >= target and any(out.glob("*/.*blinkgl-tmp-*")):
                time.sleep(self.dice.uniform(0, self.pace_s))
                if driver.poll() is not None or not any(out.glob("*/.*blinkgl-tmp-*")):
                    continue
                self.struck.append(self.whole(out))
                return True
            time.sleep(0.005)
        return False

    def resume(self, out: Path) -> int:
        """As often as it takes; how often."""
        for count in range(1, MAX_RESUMES + 1):
            if (
                subprocess.run(
                    self.command(out, "--workers", self.workers, "--resume", "--quiet"), capture_output=True
                ).returncode
                == 0
            ):
                return count
        raise SystemExit(f"not whole after {MAX_RESUMES} resumes: {out}")


Fault = Callable[[Soak, Path], str]


def kill_worker(soak: Soak, out: Path) -> str:
    driver = soak.start(out, "--workers", soak.workers)
    killed, least = 0, None
    while killed < 3 and soak.wait_until_busy(driver, out, least):
        if workers := workers_of(driver.pid):
            os.kill(soak.dice.choice(workers), signal.SIGKILL)
            killed, least = killed + 1, soak.struck[-1] + 1
    driver.communicate()
    return f"{killed} killed, driver's status {driver.returncode}"


def hang(soak: Soak, out: Path) -> str:
    driver = soak.start(out, "--workers", soak.workers, "--time-limit", soak.limit_s)
    stopped = 0
    if soak.wait_until_busy(driver, out) and (workers := workers_of(driver.pid)):
        os.kill(soak.dice.choice(workers), signal.SIGSTOP)
        stopped = 1
    driver.communicate()
    return f"{stopped} stopped, driver's status {driver.returncode}"


def _signalled(number: int) -> Fault:
    def fault(soak: Soak, out: Path) -> str:
        driver = soak.start(out, "--workers", soak.workers)
        busy = soak.wait_until_busy(driver, out)
        workers = workers_of(driver.pid)
        driver.send_signal(number)
        driver.communicate()
        deadline = time.monotonic() + 60
        while any(alive(pid) for pid in workers):
            if time.monotonic() > deadline:
                raise SystemExit(f"workers outlive their driver: {workers}")
            time.sleep(0.05)
        return f"{'at work' if busy else 'too late'}, {soak.whole(out)} whole, status {driver.returncode}"

    return fault


def disk_full(soak: Soak, out: Path) -> str:
    size = max(soak.reference_bytes // soak.dice.randint(2, 6) // 4096 * 4096, 1 << 20)
    subprocess.run(["mount", "-o", f"remount,size={size}", out.parent], check=True)
    done = subprocess.run(soak.command(out, "--workers", soak.workers, "--quiet"), capture_output=True, text=True)
    if any(out.glob("*/.*blinkgl-tmp-*")):
        raise SystemExit("a full disk left temporaries")
    whole = soak.whole(out)
    subprocess.run(["mount", "-o", f"remount,size={4 * soak.reference_bytes + (64 << 20)}", out.parent], check=True)
    return f"{size / 1e6:.1f} MB, {whole} whole, status {done.returncode}"


def corrupt_asset(soak: Soak, out: Path) -> str:
    driver = soak.start(out, "--workers", soak.workers)
    good = {path: path.read_bytes() for path in soak.meshes.iterdir()}
    soak.wait_until_busy(driver, out)
    for path in good:
        path.write_bytes(b"v 0 0 0\nf 1 2 3\n")
    driver.communicate()
    failed = (
        json.loads((out / RUN_FOLDER / "failed.json").read_text())
        if (out / RUN_FOLDER / "failed.json").is_file()
        else {}
    )
    refused = subprocess.run(soak.command(out, "--resume", "--quiet"), capture_output=True, text=True)
    if refused.returncode != 2 or "pools are not those" not in refused.stderr:
        raise SystemExit(f"changed pools were not refused: {refused.stderr}")
    for path, data in good.items():
        path.write_bytes(data)
    return f"{len(failed)} set aside, status {driver.returncode}"


def ray_fault(soak: Soak, out: Path, *, node: bool) -> str:
    """In a process of its own: Ray and its cluster must be gone before the next fault."""
    arguments = json.dumps(
        {
            "recipe": str(soak.recipe),
            "overrides": soak.overrides,
            "out": str(out),
            "node": node,
            "skip": soak.dice.randint(2, 6),
        }
    )
    done = subprocess.run(
        [sys.executable, "-m", "blinkgl.tools.soak", "--ray-child", arguments], capture_output=True, text=True
    )
    if done.returncode:
        raise SystemExit(f"the Ray run failed: {done.stderr[-2000:]}")
    return done.stdout.strip().splitlines()[-1]


FAULTS: dict[str, Fault] = {
    "kill-worker": kill_worker,
    "hang": hang,
    "kill-driver": _signalled(signal.SIGKILL),
    "sigterm": _signalled(signal.SIGTERM),
    "sigint": _signalled(signal.SIGINT),
    "disk-full": disk_full,
    "corrupt-asset": corrupt_asset,
    "ray-worker": lambda soak, out: ray_fault(soak, out, node=False),
    "ray-node": lambda soak, out: ray_fault(soak, out, node=True),
}


def ray_child(recipe: str, overrides: list[str], out: str, node: bool, skip: int) -> None:
    """Two one-CPU nodes on this machine; after ``skip`` progress messages one loses its worker, or is lost itself."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    import ray
    from ray.cluster_utils import Cluster

    from blinkgl.dataset.cluster import RayCluster
    from blinkgl.dataset.run import run_dataset

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    second = cluster.add_node(num_cpus=1)
    ray.init(address=cluster.address, log_to_driver=False, logging_level="ERROR")

    class Display:
        left, failures = skip, 0

        def begin(self, plan, outcome) -> None: ...
        def end(self, outcome) -> None: ...

        def message(self, name, message) -> None:
            self.failures += message["kind"] == "failed"
            if message["kind"] == "progress":
                self.left -= 1
                if self.left == 0 and node:
                    cluster.remove_node(second, allow_graceful=False)
                elif self.left == 0:
                    log = (Path(out) / RUN_FOLDER / "logs" / f"{name}.log").read_text()
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(int(log.rpartition("pid ")[2].split()[0]), signal.SIGKILL)

    display = Display()
    try:
        outcome = run_dataset(load_run(recipe, overrides), out, RayCluster(2), listener=display)
    finally:
        ray.shutdown()
        cluster.shutdown()
    print(f"{display.failures} attempts lost, {len(outcome.made)} made, {len(outcome.set_aside)} set aside")


IN_THE_MIDDLE = {"kill-worker", "hang", "kill-driver", "sigterm", "sigint", "corrupt-asset"}
"""Faults at a moment of our choosing. (A disk is full when it is, and Ray's faults count progress messages.)"""


def strike(soak: Soak, fault: str, out: Path) -> str:
    """The fault, on a run that was in its middle; what happened."""
    for _ in range(10):
        soak.struck.clear()
        what = FAULTS[fault](soak, out)
        if fault not in IN_THE_MIDDLE or soak.struck:
            return what
        shutil.rmtree(out)
    raise SystemExit(f"{fault}: ten runs were over before the fault; longer sequences, or more of them")


# ---- the frame -------------------------------------------------------------------------------------------------------


def make_meshes(folder: Path) -> Path:
    """A dozen mesh files, so that there are files that can rot."""
    folder.mkdir(parents=True)
    for k in range(12):
        mesh = primitives.torus(radius=0.4, tube=0.04 + 0.01 * k, segments=24, tube_segments=12)
        lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in mesh.vertices] + [
            f"f {a + 1} {b + 1} {c + 1}" for a, b, c in mesh.faces
        ]
        (folder / f"ring{k}.obj").write_text("\n".join(lines) + "\n")
    return folder


def tree(out: Path) -> dict[str, str]:
    return {
        p.relative_to(out).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(out.rglob("*"))
        if p.is_file() and p.relative_to(out).parts[0] != RUN_FOLDER
    }


def workers_of(pid: int) -> list[int]:
    found = []
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError, ValueError, IndexError):
            if entry.name.isdigit() and int((entry / "stat").read_text().rpartition(")")[2].split()[1]) == pid:
                if b"blinkgl.dataset.worker" in (entry / "cmdline").read_bytes():
                    found.append(int(entry.name))
    return sorted(found)


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@contextlib.contextmanager
def output_folder(soak: Soak, fault: str) -> Iterator[Path | None]:
    """None: this machine does not let us."""
    folder = Path(tempfile.mkdtemp(dir=soak.scratch))
    mounted = (
        fault == "disk-full"
        and subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", folder], capture_output=True).returncode
        == 0
    )
    try:
        yield None if fault == "disk-full" and not mounted else folder / "out"
    finally:
        if mounted:
            subprocess.run(["umount", folder], check=True)
        shutil.rmtree(folder, ignore_errors=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recipe", default=str(resources.files("blinkgl.configs").joinpath("blinkflow_mini.yaml")))
    parser.add_argument("--set", action="append", default=[], dest="overrides", metavar="a.b=c")
    parser.add_argument("--faults", default=",".join(LOCAL + RAY))
    parser.add_argument("--tiny", action="store_true", help="sequences of a tenth of a second")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0, help="of the moments at which faults strike")
    parser.add_argument("--json", help="results go here, too")
    parser.add_argument("--ray-child", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.ray_child:
        ray_child(**json.loads(arguments.ray_child))
        return
    faults = arguments.faults.split(",")
    if unknown := set(faults) - set(FAULTS):
        raise SystemExit(f"unknown faults {sorted(unknown)}; known: {', '.join(FAULTS)}")
    console, results = Console(), []
    console.print(machine_line(), highlight=False)
    with tempfile.TemporaryDirectory(prefix="blinkgl-soak-") as scratch:
        soak = Soak(
            Path(arguments.recipe),
            (TINY if arguments.tiny else []) + arguments.overrides,
            arguments.workers,
            Path(scratch).resolve(),
            random.Random(arguments.seed),
        )
        reference = Path(scratch) / "reference"
        started = time.monotonic()
        subprocess.run(soak.command(reference, "--quiet"), check=True)
        elapsed = time.monotonic() - started
        expected = tree(reference)
        soak.reference_bytes = sum(p.stat().st_size for p in reference.rglob("*") if p.is_file())
        costs = [
            json.loads(line)["total_s"] for line in (reference / RUN_FOLDER / "costs.jsonl").read_text().splitlines()
        ]
        soak.limit_s, soak.pace_s = max(10.0, 8 * max(costs)), sum(costs) / len(costs)
        console.print(
            f"reference: {len(soak.tasks)} sequences, {soak.reference_bytes / 1e6:.1f} MB, {elapsed:.0f} s; time "
            f"limit {soak.limit_s:.0f} s",
            highlight=False,
        )
        for round_number in range(arguments.rounds):
            for fault in faults:
                with output_folder(soak, fault) as out:
                    if out is None:
                        results.append(
                            {"round": round_number, "fault": fault, "what": "skipped: not allowed to mount", "ok": None}
                        )
                        continue
                    started = time.monotonic()
                    what = strike(soak, fault, out)
                    resumes = soak.resume(out)
                    verified = subprocess.run(
                        [
                            sys.executable,
                            "-m",
                            "blinkgl.cli",
                            "verify",
                            str(out),
                            "--deep",
                            "--sample",
                            "2",
                            "--seed",
                            str(round_number),
                        ],
                        capture_output=True,
                        text=True,
                    )
                    same = tree(out) == expected
                    struck = ", ".join(map(str, soak.struck))
                    results.append(
                        {
                            "round": round_number,
                            "fault": fault,
                            "struck at": f"{struck} of {len(soak.tasks)}" if struck else "",
                            "what": what,
                            "resumes": resumes,
                            "identical": same,
                            "verified": verified.returncode == 0,
                            "seconds": round(time.monotonic() - started, 1),
                            "ok": same and verified.returncode == 0,
                        }
                    )
                    console.print(f"{results[-1]}", highlight=False, soft_wrap=True)
    table = Table("fault", "round", "whole when struck", "what happened", "resumes", "identical", "verify --deep", "s")
    for r in results:
        table.add_row(
            r["fault"],
            str(r["round"]),
            r.get("struck at", ""),
            r["what"],
            *(str(r.get(k, "")) for k in ("resumes", "identical", "verified", "seconds")),
        )
    console.print(table)
    if arguments.json:
        Path(arguments.json).write_text(json.dumps({"machine": machine_line(), "results": results}, indent=1) + "\n")
    if any(r["ok"] is False for r in results):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
