"""The networks at equal processor time: what they make of data like their training's, of other data, of recordings.

    python -m blinkgl.tools.network_tables --out out/networks --recordings ../shared/data/events
    python -m blinkgl.tools.network_tables --out out/networks --stop-after 9     # in pieces: repeat until it exits 0
    python -m blinkgl.tools.network_tables --out out/networks --show             # the tables of what is there

Every network of the `tiny` sizes learns on the flying objects of ``smoke_data.yaml`` for as many processor minutes of
one thread (``optim.clock: processor``), loading included, so that what else the machine does makes no difference to who
wins. Each is then scored on

| subset | what it is |
|---|---|
| seen | a part of the windows that it was trained on |
| objects | flying objects that it was not: other objects, textures and motions |
| converted | 20 Hz frames of a camera among things that stand still, made into events (as BlinkFlow's E-Tartan) |
| custom | scenes made by hand whose bodies deform, fall and collide (as E-Blender) |
| a burst | of the Event Camera Dataset with the flow of its gyroscope; with ``--recordings`` |

and ``--few`` networks learn again on ``--sequences`` sequences alone: what is memory and what is knowledge. Errors are
AEE in px, on bursts a share of zero flow's at pixels with events. Seeds go round all networks before the next seed
begins. What is done is kept and not done again. The result is OUT/tables.md and OUT/networks.json.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.config.reader import to_yaml
from blinkgl.errors import BlinkGLError
from blinkgl.machine.bench import machine_line
from blinkgl.tools.compare_networks import Steps, begun, log
from blinkgl.tools.data_statistics import TEST

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
REFINED = {"iterations": 6, "train_iterations": 3}
"""Of networks that refine: three refinements with gradients after up to three without."""
NETWORKS: dict[str, tuple[dict[str, Any], float]] = {
    "ev_flownet": ({"input": "voxel"}, 2e-3),
    "spike_flownet": ({}, 1e-3),
    "ste_flownet": ({}, 1e-3),
    "eraft": (REFINED, 1e-3),
    "eflowformer": (REFINED, 1e-3),
}
"""Settings of the model and peak learning rate, by name."""
CUSTOM = ("flexible", "scenes/flags", "scenes/dancers", "scenes/falling_dice", "scenes/crossing", "scenes/aquarium")
SMALL = ("camera.width=128", "camera.height=128", "labels={images: false, flow: [forward, backward]}")
SENSOR = {"emulator": "esim", "contrast_threshold": {"uniform": [0.15, 0.5]}}
"""That of the training's data, so that a subset differs by what is seen and not by who looks."""
SET_ASIDE = 3
"""Exit status of `generate`: done, but for some sequences; films that do not qualify are not converted."""
SUBSETS = ("seen", "objects", "converted", "custom")
SEEN = 128


def positive(text: str) -> int:
    """A number of things, for argparse."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text}: at least 1")
    return value


def settings(*values: str) -> list[str]:
    return [word for value in values for word in ("--set", value)]


def data(steps: Steps, out: Path, test: int) -> dict[str, Path]:
    """Folders of sequences by name: ``train`` and the subsets but ``seen``. test : sequences that are filmed for
    `converted`, and eight times those of each custom scene."""

    def once(recipe: Path, folder: str, *options: str) -> None:
        made = out / f"{folder}.done"
        if not made.exists():
            again = ["--resume"] if (out / folder).exists() else []
            options = ("--out", str(out / folder), *options, *again, "--quiet")
            steps.run("blinkgl.cli", "generate", str(recipe), *options, fine=(0, SET_ASIDE))
            made.touch()

    smoke = CONFIGS / "eflow" / "smoke_data.yaml"
    once(smoke, "objects")
    still = (
        "scene.object_motion={kind: static}",
        "scene.objects.flying=0.3",
        "time.label_rate=20",
    )
    only = ("groups.smoke.enabled=false", "groups.short.enabled=false", f"groups.smoke_test.output.sequences={test}")
    once(smoke, "film", *settings("seed=81", "labels.images=true", "render.image_antialiasing=ssaa2", *only, *still))
    recipe = {
        "seed": 82,
        "output": {"split": "test", "name": "converted", "sequences": test},
        "events": SENSOR,
        "frames": {
            "folders": [str(out.resolve() / "film" / "test" / "*")],
            "images": "images",
            "flow": "flow/forward",
            "fps": 20,
            "qualify": {"tolerated": 0.2},
        },
        "preview": {"enabled": False},
    }
    (out / "converted.yaml").write_text(to_yaml(recipe), encoding="utf-8")
    once(out / "converted.yaml", "converted")
    for name in CUSTOM:
        changes = settings(*SMALL, f"events={json.dumps(SENSOR)}", "output.split=test", "preview.enabled=false")
        once(CONFIGS / f"{name}.yaml", f"custom/{Path(name).name}", "--num", str(max(1, test // 8)), *changes)
    return {
        "train": out / "objects" / "train",
        "objects": out / "objects" / "test",
        "converted": out / "converted" / "test",
        "custom": out / "custom",
    }


def few(source: Path, out: Path, count: int) -> Path:
    """A folder of ``count`` sequences of another, evenly spaced: the same files under other names."""
    if not out.exists():
        fresh = out.with_suffix(".new")
        shutil.rmtree(fresh, ignore_errors=True)
        every = sorted(source.iterdir())
        for sequence in every[:: max(1, len(every) // count)][:count]:
            shutil.copytree(sequence, fresh / sequence.name, copy_function=os.link)
        fresh.rename(out)
    return out


def runs_of(a: argparse.Namespace, row: str) -> Path:
    """The folder of a row's runs."""
    return a.out / "runs" / row.replace(", ", "_").replace(" ", "_")


def trained(steps: Steps, a: argparse.Namespace, row: str, seed: int, sequences: Path, test: Path) -> Path:
    """The run of a row of the table and a seed."""
    name = row.partition(",")[0]
    run = runs_of(a, row) / f"seed{seed}"
    model, rate = NETWORKS[name]
    sets = {
        "seed": seed,
        "model": {"name": name, "size": "tiny", **model},
        "data.train": [{"path": str(sequences.resolve())}],
        "data.validate_on": [{"path": str(test.resolve())}],
        "data.workers": 0,
        "data.empty": "skip",
        "optim.clock": "processor",
        "optim.minutes": a.minutes,
        "optim.steps": 10**6,
        "optim.lr": rate,
        "optim.ema": 0.99,  # of a short training
        "run.validate_every": 10**6,
        "run.picture_every": 10**6,
        "run.checkpoint_every": 100,
    }
    if not (run / "trained").exists():
        options = settings(*(f"{key}={json.dumps(value)}" for key, value in sets.items()))
        again = ["--resume"] if run.exists() else []
        steps.run("eflow.cli", "train", str(a.training), "--out", str(run), *options, *again)
        (run / "trained").touch()
    return run


def judged(steps: Steps, a: argparse.Namespace, run: Path, folders: dict[str, Path]) -> dict[str, Any]:
    """AEE of a run by subset, with zero flow's and the affine field's beside it; its steps and processor seconds."""
    kept = run / "judged.json"
    found = json.loads(kept.read_text(encoding="utf-8")) if kept.exists() else {}
    for subset, folder in folders.items():
        if subset in found:
            continue
        score = run / f"score_{subset}"
        if not (score / "results.json").exists():
            limit = ["--limit", str(SEEN)] if subset == "seen" else []
            options = ["--out", str(score), "--pictures", "0", "--empty", "skip", *limit]
            steps.run("eflow.cli", "evaluate", str(run), str(folder), *options)
        result = json.loads((score / "results.json").read_text(encoding="utf-8"))
        found[subset] = {method: scores["total"]["AEE"] for method, scores in result["methods"].items()}
        found["parameters"] = result["parameters"]
        kept.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    last = log(run, "train")[-1]
    found |= {"steps": last["step"], "processor_s": last["processor_s"]}
    if a.recordings is not None and "bursts" not in found:
        from blinkgl.tools.real_recordings import burst  # it compiles what a table of old results does not need

        found["bursts"] = {
            folder.name: burst(folder, [str(run)])[str(run)]["of_zero_events"]
            for folder in sorted((a.recordings / TEST).iterdir())
        }
    kept.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return found


def spread(values: list[float], digits: int = 2) -> str:
    """The mean, and the least and largest of several."""
    if not values:
        return "–"
    mean = f"{np.mean(values):.{digits}f}"
    return mean if len(values) == 1 else f"{mean} ({min(values):.{digits}f}–{max(values):.{digits}f})"


def table(found: dict[str, dict[str, dict[str, Any]]]) -> str:
    """Markdown. found : by row and seed what :func:`judged` gives. In brackets the best and the worst seed."""
    runs = [run for seeds in found.values() for run in seeds.values()]
    bursts = sorted({name for run in runs for name in run.get("bursts", {})})
    heads = ["", "seeds", "M parameters", "steps", *SUBSETS, *(f"{name}, of zero" for name in bursts), "processor s"]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for row, seeds in found.items():
        its = list(seeds.values())
        cells = [row, str(len(its)), f"{its[0]['parameters'] / 1e6:.2f}", f"{np.mean([r['steps'] for r in its]):.0f}"]
        cells += [spread([r[subset]["network"] for r in its]) for subset in SUBSETS]
        cells += [spread([r["bursts"][name] for r in its if "bursts" in r]) for name in bursts]
        cells.append(f"{np.mean([r['processor_s'] for r in its]):.0f}")
        lines.append("| " + " | ".join(cells) + " |")
    for method in [method for method in runs[0]["objects"] if method != "network"]:
        cells = [
            method,
            "",
            "",
            "",
            *(f"{runs[0][subset][method]:.2f}" for subset in SUBSETS),
            *("" for _ in bursts),
            "",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def rows(a: argparse.Namespace) -> list[str]:
    return [*a.networks, *(f"{name}, {a.sequences} sequences" for name in a.few)]


def run(a: argparse.Namespace) -> None:
    """Generates, trains and judges what is not there yet."""
    begun(a.out, {"minutes": a.minutes, "test": a.test, "sequences": a.sequences})
    steps = Steps(a.stop_after)
    folders = data(steps, a.out, a.test)
    train = folders.pop("train")
    for seed in a.seeds:
        for row in rows(a):
            source = few(train, a.out / f"few_{a.sequences}", a.sequences) if "," in row else train
            judged(steps, a, trained(steps, a, row, seed, source, folders["objects"]), {"seen": source, **folders})


def collected(a: argparse.Namespace) -> dict[str, dict[str, dict[str, Any]]]:
    """What is there, by row and seed."""
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for row in rows(a):
        for path in sorted(runs_of(a, row).glob("seed*/judged.json")):
            its = json.loads(path.read_text(encoding="utf-8"))
            if all(subset in its for subset in SUBSETS):
                found.setdefault(row, {})[path.parent.name] = its
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--networks", nargs="+", choices=list(NETWORKS), default=list(NETWORKS))
    parser.add_argument("--few", nargs="*", choices=list(NETWORKS), default=["ev_flownet"])
    parser.add_argument("--sequences", type=positive, default=12, help="that --few learn on")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--minutes", type=float, default=10.0, help="processor minutes of each training")
    parser.add_argument("--test", type=positive, default=16, help="sequences that are filmed for `converted`")
    parser.add_argument("--recordings", type=Path, help=f"the folder that holds {TEST}")
    parser.add_argument("--training", type=Path, default=CONFIGS / "eflow" / "smoke.yaml")
    parser.add_argument(
        "--stop-after", type=float, metavar="MINUTES", help="stop in time with exit status 75; the same command goes on"
    )
    parser.add_argument("--show", action="store_true", help="the tables of what is there, nothing else")
    a = parser.parse_args()
    if not a.show:
        run(a)
    found = collected(a)
    if not found:
        sys.exit(f"nothing is done below {a.out}")
    tree = {"machine": machine_line(), "minutes": a.minutes, "runs": found}
    (a.out / "networks.json").write_text(json.dumps(tree, indent=1) + "\n", encoding="utf-8")
    (a.out / "tables.md").write_text(table(found) + "\n", encoding="utf-8")
    print(table(found))


if __name__ == "__main__":
    try:
        main()
    except BlinkGLError as error:
        sys.exit(f"error: {error}")
