"""The ``eflow`` command: thin functions over the library. An error is one line; exit codes are those of ``blinkgl``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from blinkgl.errors import ConfigError
from blinkgl.machine.command_line import new_app, run_app, safe_main
from blinkgl.machine.interrupts import STOPS, interruptible
from eflow.cli_arguments import (
    Answer,
    Answering,
    Dataset,
    Declared,
    Dense,
    Frames,
    Network,
    Outputs,
    Overrides,
    Protocol,
    Quiet,
    Refine,
    Refined,
    Sampling,
    Views,
    WarmStart,
    WindowMs,
    WindowsAsked,
    answerer,
    check_outputs,
    grouped,
    network_of,
    one_of,
    ranges_of,
    rendered,
    windows_of,
)
from eflow.cli_examples import EFLOW
from eflow.methods.table import METHODS

app = new_app("eflow", "Train, evaluate and run event-flow networks.", EFLOW)


@app.command()
def train(
    config: Annotated[
        str | None, typer.Argument(help="YAML file, see configs/eflow/. Without a file, give --model and --data.")
    ] = None,
    out: Annotated[
        str | None,
        typer.Option("--out", "-o", help="New run folder, or an existing one with --resume.", show_default=False),
    ] = None,
    model: Annotated[str | None, typer.Option("--model", "-m", help="Network and size, e.g. ev_flownet-tiny.")] = None,
    data: Annotated[
        list[str] | None,
        typer.Option("--data", help="Folder, or recipe (.yaml) to render during training; may be repeated."),
    ] = None,
    minutes: Annotated[
        float | None, typer.Option(min=1e-3, help="Length of the training; the learning rate falls towards its end.")
    ] = None,
    overrides: Overrides = None,
    print_config: Annotated[
        bool, typer.Option("--print-config", help="Print the complete configuration as YAML and exit.")
    ] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue from the newest checkpoint in the run folder, or begin.")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Train a network. Ctrl-C and SIGTERM end after the step, with a checkpoint and exit status 130 or 143."""
    from eflow.load_config import load_train_config
    from eflow.models import preset
    from eflow.train import as_yaml, train as run_training

    changes = overrides or []
    if config is None and not (model or any(o.startswith("model") for o in changes)):
        raise ConfigError("no network to train", accepted="a YAML file, or --model, e.g. ev_flownet-tiny, and --data")
    if config is None and not (data or any(o.startswith("data.train") for o in changes)):
        raise ConfigError("nothing to train on", accepted="a YAML file, or --data, a folder or a recipe")
    tree = None if model is None else preset(model)
    whole = load_train_config(config, changes, model=tree, data=data or (), minutes=minutes)
    if print_config:
        typer.echo(as_yaml(whole), nl=False)
        return
    if out is None:
        raise ConfigError("no run folder", where="--out", accepted="a new folder, or an existing one with --resume")
    result = run_training(whole, out, resume=resume, quiet=quiet)
    if result.reason == "signal":
        raise KeyboardInterrupt
    if not quiet:
        print(f"{result.reason} at step {result.step}: {result.checkpoint}", file=sys.stderr)


@app.command()
@grouped
def render(
    recipe: Annotated[str, typer.Argument(help="YAML file of `blinkgl generate`.")],
    out: Annotated[str, typer.Option("--out", "-o", help="New folder of windows, to train on or to evaluate with.")],
    sampling: Sampling,
    samples: Annotated[int, typer.Option("--samples", "-n", min=1, help="Number of windows.")] = 1000,
    split: Annotated[str, typer.Option(help="Which groups to render: train or test.")] = "train",
    seed: Annotated[int, typer.Option(min=0, help="Each seed gives other windows.")] = 0,
    overrides: Overrides = None,
    workers: Annotated[int, typer.Option("--workers", "-w", min=0, help="Rendering processes.")] = 1,
    quiet: Quiet = False,
) -> None:
    """Render windows of a recipe into a folder for trainings. Ctrl-C keeps the finished windows."""
    from blinkgl.sequence_files.sequence_dir import refuse_existing
    from eflow.data.online import open_online
    from eflow.data.pool import render_pool
    from eflow.progress import Counting

    one_of("--split", split, ("train", "test"))
    source = windows_of(recipe, sampling, set=tuple(overrides or ()), workers=workers)
    about = {"recipe": Path(recipe).name, "split": split, "seed": seed, "per_sequence": sampling.per_sequence}
    about |= {key: getattr(source, key) for key in ("set", "window_ms", "min_events", "max_flow", "min_density")}
    refuse_existing(Path(out))  # before any worker starts
    with interruptible(*STOPS), open_online(source, seed, split=split) as online:
        done = render_pool(online.stream, samples, out, about=about, progress=Counting(samples, "windows", not quiet))
    if not quiet:
        print(f"{done} windows in {out}", file=sys.stderr)


@app.command()
@grouped
def evaluate(
    checkpoint: Answer,
    dataset: Dataset,
    options: Answering,
    out: Annotated[str | None, typer.Option("--out", "-o", help="New folder for results.json and pictures.")] = None,
    window_ms: WindowMs = None,
    dt: Annotated[int, typer.Option(help="MVSEC: 1 or 4 images.")] = 1,
    protocol: Protocol = "all",
    frames: Frames = None,
    dense: Dense = False,
    limit: Annotated[int | None, typer.Option(min=1, help="Score only this many samples, evenly spaced.")] = None,
    refine: Refined = False,
) -> None:
    """Score a network or a method on a data set. Zero flow and global motions fitted to the truth are scored beside it.
    Samples with an empty window are left out and counted."""
    from blinkgl.machine.terminal import plain_console
    from eflow.data.sources import open_source, refuse_of_mvsec
    from eflow.evaluate import evaluate as score, show

    model = answerer(checkpoint, options, refine=refine)
    console = plain_console(stderr=True)
    of_mvsec = {"dt": dt, "protocol": protocol, "frames": ranges_of(frames), "dense": dense}
    if dataset.endswith((".yaml", ".yml")):
        refuse_of_mvsec(**of_mvsec)
        with console.status("rendering"):
            source = rendered(dataset, window_ms, limit)
    elif window_ms is not None:
        raise ConfigError("needs a recipe", where="--window-ms", value=window_ms, accepted="a dataset FILE.yaml")
    else:
        source = open_source(dataset, **of_mvsec)
    with console.status("evaluating") as status:
        result = score(
            model,
            source,
            out,
            limit=limit,
            refine=refine,
            warm_start=options.warm_start,
            views=options.views or 1,
            progress=lambda i, n, aee: status.update(f"{i}/{n} samples, AEE {aee:.3f} px"),
        )
    show(result)
    if out:
        typer.echo(f"written: {out}/results.json")


@app.command()
@grouped
def predict(
    names: Annotated[
        list[str],
        typer.Argument(
            metavar="[NETWORK] EVENTS",
            help="A network or method, as of evaluate, and an event file. Without a network (or with auto): "
            "real_bodies, or real_small where there is no window before another.",
        ),
    ],
    outputs: Outputs,
    asked: WindowsAsked,
    declared: Declared,
    options: Answering,
    refine: Refine = None,
) -> None:
    """Compute the flow of any event file. Networks do this, and methods without training.

    FWL (flow warp loss) says how much sharper the events become when the flow moves them back to the window's start;
    above 1 the flow helps."""
    from blinkgl.types.events import Events
    from eflow import infer
    from eflow.choice import AUTO, chosen
    from eflow.flow_of_file import show_flows

    check_outputs(asked, outputs)
    if len(names) > 2:
        raise ConfigError("more than a network and a file", value=names, accepted="eflow predict [NETWORK] EVENTS")
    name, events = [AUTO, *names][-2:]
    chooses = name == AUTO and not Path(AUTO).exists()
    model = None if chooses else answerer(name, options, refine=refine is True)
    file = infer.open_sized(events, declared.reading())
    height, width = infer.sensor_of(file)
    for line in infer.doubts(next(iter(file.chunks()), Events.empty()), height, width):
        typer.echo(f"{events}: {line}", err=True)
    if model is None:
        name, why = chosen(file, asked)
        typer.echo(f"network: {why}")
        model = answerer(name, options)
    views = options.views or infer.default_views(name)
    predictor = infer.Predictor(
        model, height, width, warm_start=options.warm_start, refine=refine is not False, views=views
    )
    show_flows(file, predictor, asked, outputs, typer.echo)
    for line in file.notes:
        typer.echo(f"{events}: {line}", err=True)


@app.command()
def submit(
    checkpoint: Network,
    dataset: Annotated[str, typer.Argument(help="The test set of DSEC or BlinkFlow; its layout says which.")],
    out: Annotated[str, typer.Option("--out", "-o", help="New zip file.")],
    warm_start: WarmStart = False,
    views: Views = None,
) -> None:
    """Write the submission file of a benchmark and check it."""
    from blinkgl.machine.terminal import plain_console
    from eflow.submit import submit as write_submission

    model = network_of(checkpoint, warm_start=warm_start)
    with plain_console(stderr=True).status("predicting") as status:
        progress = lambda i, n: status.update(f"{i}/{n} flows")
        count, still = write_submission(model, dataset, out, warm_start=warm_start, views=views or 1, progress=progress)
    typer.echo(f"written and checked: {out}, {count} files")
    if still:
        typer.echo(f"{still} of {count} flows are zero: a window without events, or nothing moves")


@app.command("import")
def import_(
    checkpoint: Annotated[str, typer.Argument(help="E-RAFT's dsec.tar, mvsec_20.tar ….")],
    out: Annotated[str, typer.Option("--out", "-o", help="New .safetensors file.")],
) -> None:
    """Convert a published checkpoint of E-RAFT. Only tensors are read. The file also stores E-RAFT's padding, border
    and time bins."""
    from eflow.models import parameters_of
    from eflow.published import import_published

    model = import_published(checkpoint, out)
    typer.echo(f"written: {out}, {parameters_of(model) / 1e6:.2f} M parameters")


@app.command()
def export(
    checkpoint: Network,
    onnx: Annotated[str | None, typer.Option(help="New file of ONNX.", show_default=False)] = None,
    torchscript: Annotated[str | None, typer.Option(help="New file of TorchScript.", show_default=False)] = None,
    size: Annotated[str, typer.Option(metavar="WxH", help="Sensor size; the file takes no other.")] = "640x480",
) -> None:
    """Write a network as a file for programs without this package. Its flow is compared with the network's before it
    is written."""
    from blinkgl.io.reading import parsed_size
    from eflow.export import export as write_export

    outs = {kind: out for kind, out in (("onnx", onnx), ("torchscript", torchscript)) if out is not None}
    if not outs:
        raise ConfigError("no file to write", accepted="--onnx OUT or --torchscript OUT")
    model, sides = network_of(checkpoint), parsed_size(size)
    assert sides is not None
    for kind, out in outs.items():
        difference = write_export(model, out, kind, *sides)
        typer.echo(
            f"written and checked: {out}, reads {', '.join(model.reads)}, differs by {difference:.1g} px at most"
        )


@app.command()
def models(
    name: Annotated[str | None, typer.Argument(help="Show only this network, with its whole card.")] = None,
) -> None:
    """List the trained networks that come with the package. Their names can replace a checkpoint."""
    from eflow import shipped

    cards = [shipped.card_of(n) for n in ([name] if name is not None else shipped.names())]
    for card in cards:
        for line in shipped.lines(card, whole=name is not None):
            typer.echo(line)
    if not cards:
        typer.echo("no trained network comes with this version; eflow train makes one")
    if name is None:
        typer.echo(f"without training: {', '.join(METHODS)}")


@app.command()
def pack(
    checkpoint: Network,
    name: Annotated[str, typer.Option(help="Name of the network.")],
    card: Annotated[str, typer.Option(help="YAML: about, data, training, scores, limits, commands (docs/eflow.md).")],
    out: Annotated[
        str,
        typer.Option("--out", "-o", help="Parent of the new folder; networks in eflow/weights ship with the package."),
    ],
) -> None:
    """Pack a checkpoint as a network that can come with the package. It has weights (5 MB at most; larger ones in half
    precision) and a card."""
    from eflow import shipped
    from eflow.packing import pack as write_pack

    folder, full = write_pack(checkpoint, name, card, out)
    typer.echo(f"written: {folder}")
    for line in shipped.lines(full):
        typer.echo(line)


_LAST_WEIGHTS = "the file weights.safetensors of a checkpoint in place of its folder"
_DEVICE = "nothing: a GPU is used if there is one; CUDA_VISIBLE_DEVICES= hides it"
_PRECISION = "nothing: flow is computed in single precision"
GONE = {
    "bench": "python -m blinkgl.tools.bench networks",
    "evaluate --by-density": "sets of several densities, evaluated one by one",
    "evaluate --confidence": "nothing: no network here estimates its confidence",
    "evaluate --device": _DEVICE,
    "evaluate --empty": "nothing: samples with an empty window are left out and counted",
    "evaluate --format": "nothing: the layout is recognised by its files",
    "evaluate --ground-truth": "--protocol, which says it",
    "evaluate --pictures": "nothing: --out writes twelve",
    "evaluate --precision": _PRECISION,
    "evaluate --raw": _LAST_WEIGHTS,
    "predict --confidence": "nothing: no network here estimates its confidence",
    "predict --device": _DEVICE,
    "predict --empty": "nothing: windows without events have zero flow and are counted",
    "predict --flo": "--npy",
    "predict --h5": "--npy",
    "predict --precision": _PRECISION,
    "predict --raw": _LAST_WEIGHTS,
    "predict --truth": "eflow evaluate, or --npy and your own comparison",
    "submit --benchmark": "nothing: the layout of the test set says it",
    "submit --device": _DEVICE,
    "submit --full": "nothing: one pixel per 4x4 cell is written, the benchmark's smaller form",
    "submit --precision": _PRECISION,
    "import --bins": "E-RAFT's published weights: RAFT's own are no longer read",
    "models --json": "the card of each network, eflow/weights/NAME/card.yaml",
    "pack --raw": _LAST_WEIGHTS,
    "pack --store": "nothing: weights are stored in single precision",
}
"""Commands and options of earlier versions, and what to use instead."""


def run(arguments: list[str]) -> int:
    """Run one command line (without the program name) and return the exit status; errors of users do not raise."""
    return run_app(app, arguments, "eflow", "eflow", GONE, resumes="train")


def main() -> None:
    """The console script."""
    safe_main(run)


if __name__ == "__main__":
    main()
