"""What of a recipe is it that helps on recordings? A network for each thing left out, on simulated data and recordings.

    python -m blinkgl.tools.ablation --out out/ablation --recordings ../shared/data/events
    python -m blinkgl.tools.ablation --out out/ablation --minutes 9      # in pieces: repeat until it exits 0
    python -m blinkgl.tools.ablation --out out/ablation --start real_small      # from a trained network on
    python -m blinkgl.tools.ablation --out out/ablation --show           # the table of what is there

Every arm is ``real_data.yaml`` and ``real.yaml`` with something changed (:data:`ARMS`). Its windows are rendered once
and shared by its seeds; all arms have as many windows and steps. All are judged on the same windows: those of the whole
recipe's test groups, and, with ``--recordings``, the two bursts with known flow. Error: AEE as a share of zero flow's,
at pixels with events on the bursts. ``again`` is the whole recipe with other windows: what chance alone does. Short
trainings from nothing differ more by their seed, by when they begin to learn, than by what they learn from; with
``--start`` all go on from one network that has learnt already (`init_from`), and the table says what a trained network
loses without something, which is less than what it would never have learnt. Seeds go round all arms before the next
seed begins, so that a run that is stopped has whole rounds. What is done is kept and not done again; other
``--windows``, ``--steps`` or ``--start`` want another ``--out``.

The result is OUT/table.md and OUT/ablation.json. An interval is Student's, 95 %, of the difference to ``all`` seed by
seed, given from two seeds on.
"""

from __future__ import annotations

import argparse
import copy
import json
import shutil
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from blinkgl.config.reader import read_table, to_yaml
from blinkgl.errors import BlinkGLError, ConfigError
from blinkgl.machine.bench import machine_line
from blinkgl.tools.compare_networks import Steps, begun, log
from blinkgl.tools.data_statistics import TEST

CONFIGS = Path(__file__).resolve().parents[1] / "configs" / "eflow"
WINDOWS = ("--window-ms", "5-100")
KEPT = ("--max-flow", "16", "--min-density", "0.008")
NO_NOISE = {"leak_rate_hz": 0.0, "shot_noise_rate_hz": 0.0, "hot_pixel_fraction": 0.0}


@dataclass(frozen=True)
class Arm:
    """about : what is different, for the table.   recipe, training : values by dotted path, laid over the recipe's and
    the training's; a table replaces the one that is there.   windows : options of `eflow render`.
    emulators : only these, with their shares.   every : laid over each emulator's settings.
    draw : the seed that its windows are drawn with; the recipe's own if None."""

    about: str
    recipe: dict[str, Any] = field(default_factory=dict)
    training: dict[str, Any] = field(default_factory=dict)
    windows: tuple[str, ...] = WINDOWS
    emulators: tuple[str, ...] = ("esim", "v2e", "voltmeter")
    every: dict[str, Any] = field(default_factory=dict)
    draw: int | None = None


ARMS: dict[str, Arm] = {
    "all": Arm("the recipe as it is"),
    "again": Arm("the recipe as it is, other windows", draw=1),
    "esim": Arm("ESIM alone", emulators=("esim",)),
    "thresholds": Arm("every threshold 0.2", every={"contrast_threshold": 0.2, "contrast_threshold_off": 0.2}),
    "noise": Arm(
        "no leak, shot noise, hot pixels; none added while training",
        every=NO_NOISE,
        training={"data.augment.hot_probability": 0, "data.augment.noise_probability": 0},
    ),
    "motion": Arm(
        "six way-points a sequence, no pauses, no shake",
        {
            f"scene.{who}_motion.{key}": value
            for who in ("object", "camera")
            for key, value in {"waypoints_per_s": None, "waypoints": 6, "pauses": 0.0, "smoothness": 0.5}.items()
        }
        | {"scene.camera_motion.shake": 0},
    ),
    "windows": Arm("every window as long as the label interval (10 to 50 ms)", windows=()),
    "antialiasing": Arm("event frames without anti-aliasing", {"render.antialiasing": "none"}),
    "light": Arm("with hard shadows (they are off in the recipe)", {"scene.light.shadows": "hard"}),
    "photographs": Arm("procedural textures alone", {"scene.textures.photographs": False}),
    "dropping": Arm("no events dropped while training", training={"data.augment.drop_probability": 0}),
    "length": Arm("no price on lengths", training={"optim.loss": {"l1": 1}}),
    "consensus": Arm("no affine field inside the network", training={"model.consensus": False}),
}
TELLS = ("simulated", "boxes_rotation", "shapes_rotation")


def put(tree: dict[str, Any], path: str, value: Any) -> None:
    """Sets ``tree["a"]["b"]`` for "a.b"; tables on the way are made."""
    *way, last = path.split(".")
    for key in way:
        tree = tree.setdefault(key, {})
    tree[last] = copy.deepcopy(value)


def recipe_of(arm: Arm, base: dict[str, Any]) -> dict[str, Any]:
    """The recipe of an arm: ``base``, a whole recipe's tree, with what the arm changes, in every group."""
    tree = copy.deepcopy(base)
    for path, value in arm.recipe.items():
        put(tree, path, value)
    kept = [one for one in tree["events"]["shares"] if one["value"]["emulator"] in arm.emulators]
    whole = sum(one["share"] for one in kept)
    for one in kept:
        one["share"] /= whole
        known = {key: value for key, value in arm.every.items() if key in one["value"]}
        one["value"] = {**one["value"], **known}
    tree["events"]["shares"] = kept
    return tree


def rendered(steps: Steps, out: Path, recipe: Path, count: int, windows: tuple[str, ...], *more: str) -> Path:
    """The folder of windows of a recipe. Whole or not there: what is stopped keeps what it has, which is too few."""
    if not out.exists():
        options = ["-n", str(count), "--per-sequence", "10", *windows, *KEPT, *more, "--quiet"]
        fresh = out.with_suffix(".new")
        shutil.rmtree(fresh, ignore_errors=True)
        steps.run("eflow.cli", "render", str(recipe), "--out", str(fresh), *options)
        fresh.rename(out)
    return out


def trained(steps: Steps, a: argparse.Namespace, name: str, seed: int, pool: Path) -> Path:
    """The run of an arm and a seed."""
    run = a.out / name / f"seed{seed}"
    sets = {
        "seed": seed,
        "data.train": [{"path": str(pool.resolve())}],
        "data.validate_on": [{"path": str((a.out / "test").resolve())}],
        "optim.minutes": None,
        "optim.steps": a.steps,
        "run.validate_every": a.steps,
        "run.checkpoint_every": max(1, a.steps // 4),
        "run.picture_every": a.steps,
        "init_from": a.start,
        **ARMS[name].training,
    }
    done = max((int(p.name) for p in (run / "checkpoints").glob("*") if p.name.isdigit()), default=0)
    if done < a.steps:
        options = [x for key, value in sets.items() for x in ("--set", f"{key}={json.dumps(value)}")]
        steps.run("eflow.cli", "train", str(a.training), "--out", str(run), *options, *(["--resume"] if done else []))
    return run


def judged(steps: Steps, a: argparse.Namespace, run: Path) -> dict[str, float]:
    """AEE of a run as shares of zero flow's, by :data:`TELLS`, and the processor seconds that its training took."""
    kept = run / "judged.json"
    found = json.loads(kept.read_text(encoding="utf-8")) if kept.exists() else {}
    if "simulated" not in found:
        score = run.parent / f"{run.name}_score"
        if not (score / "results.json").exists():
            steps.run("eflow.cli", "evaluate", str(run), str(a.out / "test"), "--out", str(score), "--pictures", "0")
        result = json.loads((score / "results.json").read_text(encoding="utf-8"))
        aee = {method: scores["total"]["AEE"] for method, scores in result["methods"].items()}
        found["simulated"] = aee["network"] / aee["zero flow"]
        found["processor_s"] = log(run, "train")[-1]["processor_s"]
    if a.recordings is not None and TELLS[1] not in found:
        from blinkgl.tools.real_recordings import burst  # it compiles what a table of old results does not need

        for folder in sorted((a.recordings / TEST).iterdir()):
            found[folder.name] = burst(folder, [str(run)])[str(run)]["of_zero_events"]
    kept.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return found


def difference(ours: dict[str, dict[str, float]], base: dict[str, dict[str, float]], tell: str) -> tuple[float, float]:
    """(mean, half of its 95 % interval) of an arm's error less that of ``all``, over the seeds that both have. NaN
    where there are none, and for the interval of one."""
    pairs = [ours[s][tell] - base[s][tell] for s in ours if tell in ours[s] and tell in base.get(s, {})]
    if not pairs:
        return float("nan"), float("nan")
    n = len(pairs)
    half = float(stats.t.ppf(0.975, n - 1) * np.std(pairs, ddof=1) / np.sqrt(n)) if n > 1 else float("nan")
    return float(np.mean(pairs)), half


def table(found: dict[str, dict[str, dict[str, float]]]) -> str:
    """Markdown. found : by arm and seed what :func:`judged` gives."""
    tells = [tell for tell in TELLS if any(tell in row for runs in found.values() for row in runs.values())]
    heads = ["without, or instead", "seeds", *tells, "processor s"]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    base = found.get("all", {})
    for name, runs in found.items():
        cells = [ARMS[name].about, str(len(runs))]
        for tell in tells:
            values = [row[tell] for row in runs.values() if tell in row]
            cell = f"{np.mean(values):.3f}" if values else "–"
            mean, half = difference(runs, base, tell)
            if name != "all" and np.isfinite(mean):
                cell += f" ({mean:+.3f}" + (f" ± {half:.3f})" if np.isfinite(half) else ")")
            cells.append(cell)
        cells.append(f"{np.mean([row['processor_s'] for row in runs.values()]):.0f}")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def collected(out: Path) -> dict[str, dict[str, dict[str, float]]]:
    """What is there, by arm and seed."""
    found: dict[str, dict[str, dict[str, float]]] = {}
    for name in ARMS:
        for path in sorted((out / name).glob("seed*/judged.json")):
            found.setdefault(name, {})[path.parent.name] = json.loads(path.read_text(encoding="utf-8"))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument(
        "--arms", nargs="+", choices=list(ARMS), metavar="ARM", help=f"{', '.join(ARMS)}; all that --start allows"
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--windows", type=int, default=2000, help="of each arm")
    parser.add_argument("--test", type=int, default=400, help="windows that are judged on")
    parser.add_argument("--steps", type=int, default=2000, help="of training, 4 windows each")
    parser.add_argument("--start", metavar="NETWORK", help="that every training starts from: a run or a shipped name")
    parser.add_argument("--recordings", type=Path, help=f"the folder that holds {TEST}")
    parser.add_argument("--recipe", type=Path, default=CONFIGS / "real_data.yaml")
    parser.add_argument("--training", type=Path, default=CONFIGS / "real.yaml")
    parser.add_argument("--minutes", type=float, help="stop in time with exit status 75; the same command goes on")
    parser.add_argument("--show", action="store_true", help="the table of what is there, nothing else")
    a = parser.parse_args()
    if not a.show:
        run(a)
    found = collected(a.out)
    if not found:
        sys.exit(f"nothing is done below {a.out}")
    tree = {"machine": machine_line(), "arms": {name: ARMS[name].about for name in found}, "runs": found}
    (a.out / "ablation.json").write_text(json.dumps(tree, indent=1) + "\n", encoding="utf-8")
    (a.out / "table.md").write_text(table(found) + "\n", encoding="utf-8")
    print(table(found))


def run(a: argparse.Namespace) -> None:
    """Renders, trains and judges what is not there yet."""
    allowed = [name for name in ARMS if a.start is None or "model.consensus" not in ARMS[name].training]
    arms = a.arms or allowed
    if set(arms) - set(allowed):
        raise ConfigError(
            "an arm with another network cannot start from this one",
            where="--arms",
            value=", ".join(arms),
            accepted=", ".join(allowed),
        )
    begun(a.out, {"windows": a.windows, "test": a.test, "steps": a.steps, "start": a.start})
    steps, base = Steps(a.minutes), read_table(a.recipe)
    rendered(steps, a.out / "test", a.recipe, a.test, WINDOWS, "--split", "test", "--seed", "99")
    pools: dict[str, Path] = {}
    for seed in a.seeds:
        for name in arms:
            arm = ARMS[name]
            text = to_yaml(recipe_of(arm, base))
            draw = () if arm.draw is None else ("--seed", str(arm.draw))
            key = " ".join([text, *arm.windows, *draw])
            if key not in pools:  # arms that change the training alone share the windows
                folder = a.out / name
                folder.mkdir(exist_ok=True)
                (folder / "recipe.yaml").write_text(text, encoding="utf-8")
                options = (folder / "windows", folder / "recipe.yaml", a.windows, arm.windows, *draw)
                pools[key] = rendered(steps, *options)
            judged(steps, a, trained(steps, a, name, seed, pools[key]))


if __name__ == "__main__":
    try:
        main()
    except BlinkGLError as error:
        sys.exit(f"error: {error}")
