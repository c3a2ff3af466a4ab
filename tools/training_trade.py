"""What is accuracy of events worth for a network that is trained on them?

    python -m blinkgl.tools.training_trade --work out/training --minutes 5 --steps 1600 > page.md

Each arm (a quality, an emulator, textures, motion) gets the same processor time for its data, so that cheaper ones have
more sequences; a network of the same size is trained for the same number of steps on each, with several seeds, and
judged on test sets of ``quality: reference`` by three emulators, whose textures and objects no training has, and with
``--recordings`` on the recorded bursts whose flow is known. Every stage continues what is there already. The page has
means over seeds and the half-width of their 95 % interval (Student's t).
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from importlib import resources
from pathlib import Path

import numpy as np
from scipy import stats

from blinkgl.tools.real_recordings import burst
from eflow.checkpoint import load_model
from eflow.data.sources import open_source
from eflow.evaluate import evaluate

RECIPES = resources.files("blinkgl.configs") / "eflow"
RECIPE, NETWORK = str(RECIPES / "training_trade_data.yaml"), str(RECIPES / "smoke.yaml")
V2E = {
    "emulator": "v2e",
    "contrast_threshold": {"uniform": [0.15, 0.5]},
    "threshold_sigma": {"uniform": [0.01, 0.05]},
    "cutoff_hz": {"log_uniform": [50, 500]},
    "leak_rate_hz": {"log_uniform": [0.01, 0.2]},
    "shot_noise_rate_hz": {"log_uniform": [0.001, 2.0]},
}
QUIET = {**V2E, "leak_rate_hz": 0.0, "shot_noise_rate_hz": 0.0, "threshold_sigma": 0.0}
ESIM = {"emulator": "esim", "contrast_threshold": {"uniform": [0.15, 0.5]}}
VOLTMETER = {"emulator": "voltmeter", "preset": {"choice": ["DVS346", "DVS240"]}, "k1": {"uniform": [4.0, 5.5]}}
MIX = {"shares": [{"share": 0.34, "value": ESIM}, {"share": 0.33, "value": V2E}, {"share": 0.33, "value": VOLTMETER}]}
ARMS: dict[str, dict[str, object]] = {
    "fast": {"quality": "fast"},
    "balanced": {"quality": "balanced"},
    "accurate": {"quality": "accurate"},
    "null": {"quality": None},
    "v2e": {"quality": "fast", "events": V2E},
    "v2e without noise": {"quality": "fast", "events": QUIET},
    "voltmeter": {"quality": "fast", "events": VOLTMETER},
    "mix": {"quality": "fast", "events": MIX},
    "procedural": {"quality": "fast", "scene.textures.photographs": False},
    "camera alone": {"quality": "fast", "scene.object_motion.static_share": 1.0},
    "bodies alone": {"quality": "fast", "scene.camera_motion.speed": 0.0, "scene.camera_motion.rotation_rate": 0.0},
}
"""Changes of the recipe; those of emulators, textures and motion are made with ``fast``, which costs least."""
TESTS = {"ESIM": ESIM, "V2E": V2E, "Voltmeter": VOLTMETER}
PILOT = 8
"""Sequences whose cost says how many there will be."""


def overrides(changes: dict[str, object]) -> list[str]:
    """Return the changes as ``--set`` of a command."""
    return [word for key, value in changes.items() for word in ("--set", f"{key}={json.dumps(value)}")]


def run(*words: str) -> float:
    """Run ``python -m MODULE …`` at low priority and return its processor seconds. Raises CalledProcessError."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-P", "-m", *words], check=True, stdout=subprocess.DEVNULL, preexec_fn=_step_back)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _step_back() -> None:
    os.nice(10)


def make_data(work: Path, arms: list[str], minutes: float) -> dict[str, dict[str, float]]:
    """Generate each arm's data for ``minutes`` of processor time; return sequences and seconds by arm."""
    kept = work / "data.json"
    facts: dict[str, dict[str, float]] = json.loads(kept.read_text()) if kept.is_file() else {}
    for arm in arms:
        words = ["generate", RECIPE, "--out", str(work / arm / "data"), "-q", "--resume", *overrides(ARMS[arm])]
        count, spent = facts.get(arm, {}).get("sequences", 0), facts.get(arm, {}).get("seconds", 0.0)
        pace = spent / count if count else 60 * minutes / PILOT
        # Starting and compiling count, too; so the pace of what came last says how many more there will be.
        while (more := int((60 * minutes - spent) / pace)) > 0:
            more = min(more, max(PILOT, 2 * count))
            seconds = run("blinkgl", *words, "--num", str(count + more))
            spent, count, pace = spent + seconds, count + more, seconds / more
            facts[arm] = {"sequences": count, "seconds": spent}
            kept.write_text(json.dumps(facts, indent=1))
        print(f"{arm}: {count} sequences, {spent:.0f} s of processor", file=sys.stderr)
    return facts


def make_tests(work: Path, count: int) -> None:
    """Generate the test sets."""
    for name, events in TESTS.items():
        if len([*(work / "test" / name / "test").glob("*")]) == count:
            continue
        changes: dict[str, object] = {"output.split": "test", "quality": "reference", "seed": 81, "events": events}
        words = ["--out", str(work / "test" / name), "-q", "--num", str(count), "--resume"]
        run("blinkgl", "generate", RECIPE, *words, *overrides(changes))


def train_one(work: Path, arm: str, seed: int, steps: int) -> None:
    """Train the network of smoke.yaml on an arm's data, if it is not there."""
    out = work / arm / f"seed{seed}"
    if (out / "done").is_file():
        return
    source = {"path": str((work / arm / "data" / "train").absolute())}
    changes: dict[str, object] = {"data.train": [source], "data.validate_on": [], "data.workers": 0, "seed": seed}
    changes["data.empty"] = "skip"  # a still camera has windows without events
    changes |= {"optim.minutes": None, "optim.steps": steps}
    changes |= {"run.validate_every": steps, "run.picture_every": 10 * steps}
    run("eflow.cli", "train", NETWORK, "--out", str(out), "-q", "--resume", *overrides(changes))
    (out / "done").touch()


def judge(work: Path, arm: str, seed: int, recordings: Path | None) -> dict[str, float]:
    """Return a network's error as a share of zero flow's by test set, and of the bursts."""
    kept = work / arm / f"seed{seed}" / "judged.json"
    if kept.is_file():
        return json.loads(kept.read_text())
    network, scores = str(work / arm / f"seed{seed}"), {}
    model = load_model(network)
    for name in TESTS:
        methods = evaluate(model, open_source(work / "test" / name / "test"))["methods"]
        scores[name] = methods["network"]["total"]["AEE"] / methods["zero flow"]["total"]["AEE"]
    for folder in sorted(recordings.rglob("flow.npy")) if recordings else ():
        row = burst(folder.parent, [network])
        scores[f"burst {folder.parent.name}"] = row[network]["of_zero_events"]
    kept.write_text(json.dumps(scores, indent=1))
    return scores


def page(facts: dict[str, dict[str, float]], judged: dict[str, list[dict[str, float]]], options: str) -> str:
    """Return the table as Markdown."""
    columns = list(next(iter(judged.values()))[0])
    lines = [f"Made by `python -m blinkgl.tools.training_trade {options}`.", ""]
    lines += [f"|data|sequences|{'|'.join(columns)}|", f"|---|---|{'---|' * len(columns)}"]
    for arm, rows in judged.items():
        cells = []
        for column in columns:
            values = np.array([row[column] for row in rows])
            half = stats.t.ppf(0.975, len(values) - 1) * stats.sem(values) if len(values) > 1 else np.nan
            cells.append(f"{values.mean():.3f} ± {half:.3f}")
        lines.append(f"|{arm}|{facts[arm]['sequences']:.0f}|{'|'.join(cells)}|")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder for data, networks and scores")
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=list(ARMS))
    parser.add_argument("--minutes", type=float, default=40.0, help="processor time of each arm's data")
    parser.add_argument("--steps", type=int, default=5000, help="of each training, of four samples")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=1, help="trainings at once")
    parser.add_argument("--tests", type=int, default=16, help="sequences of each test set")
    parser.add_argument("--recordings", type=Path, help="folder with bursts and their flow.npy")
    parser.add_argument("--data-only", action="store_true", help="generate, and train later")
    given = parser.parse_args()
    given.work.mkdir(parents=True, exist_ok=True)
    facts = make_data(given.work, given.arms, given.minutes)
    make_tests(given.work, given.tests)
    if given.data_only:
        return
    runs = [(arm, seed) for seed in range(given.seeds) for arm in given.arms]
    with ThreadPoolExecutor(given.jobs) as pool:
        for _ in pool.map(lambda one: train_one(given.work, one[0], one[1], given.steps), runs):
            pass
    judged = {a: [judge(given.work, a, s, given.recordings) for s in range(given.seeds)] for a in given.arms}
    chosen = f"--minutes {given.minutes:g} --steps {given.steps} --seeds {given.seeds} --tests {given.tests}"
    print(page(facts, judged, f"{chosen} --recordings RECORDINGS" if given.recordings else chosen), end="")


if __name__ == "__main__":
    main()
