"""The curve of a training run, from its log.jsonl.

    python -m blinkgl.tools.plot_training out/smoke --out curve.png [--scores out/smoke_scores]

End-point error of the training batches (thin: as logged; thick: mean of the last ten lines), of the validation set with
the averaged weights, and of zero flow there. --scores: a folder of ``eflow evaluate``; adds the
constant-median baselines of that set.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

SMOOTH = 10


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scores", type=Path)
    parser.add_argument("--title")
    a = parser.parse_args()
    lines = [json.loads(line) for line in (a.run / "log.jsonl").read_text(encoding="utf-8").splitlines()]
    train, validation = ([line for line in lines if line["kind"] == kind] for kind in ("train", "validation"))

    figure, axes = plt.subplots(figsize=(7, 3.6), layout="constrained")
    steps, epe = np.array([[line["step"], line["epe"]] for line in train]).T
    mean = np.convolve(epe, np.ones(SMOOTH) / SMOOTH, "valid") if len(epe) >= SMOOTH else epe
    axes.plot(steps, epe, color="tab:blue", alpha=0.25, linewidth=0.8)
    axes.plot(steps[-len(mean) :], mean, color="tab:blue", label="training batches")
    top = 2.2 * np.median(epe)
    for key in sorted(k for line in validation[:1] for k in line if k.endswith("/AEE")):
        name = key.removesuffix("/AEE")
        at = [line["step"] for line in validation]
        axes.plot(at, [line[key] for line in validation], "o-", color="tab:red", label=f"{name}: network")
        zero = [line[f"{name}/zero"] for line in validation]
        axes.plot(at, zero, "--", color="0.4", label=f"{name}: zero flow")
        top = max(top, 1.3 * max(zero))  # what the network is compared with is in the picture
    if a.scores:
        methods = json.loads((a.scores / "results.json").read_text(encoding="utf-8"))["methods"]
        for style, name in ((":", "median of the set"), ("-.", "median of the frame")):
            axes.axhline(methods[name]["total"]["AEE"], linestyle=style, color="0.6", label=name)
            top = max(top, 1.3 * methods[name]["total"]["AEE"])
    axes.set(xlabel="step", ylabel="end-point error, px", title=a.title, ylim=(0, top), xlim=(0, steps[-1]))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, ncols=2)
    figure.savefig(a.out, dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    main()
