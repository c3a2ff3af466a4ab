"""The ``blinkgl`` command: thin functions over the library; each error is one line.

Exit status: 0 success; 1 `shader diff` or `shader check` found a problem; 2 an error of the user's input or machine
(``error: …`` on stderr, one line); 3 success except for sequences (`trade --suite`: scenes) that were set
aside; 130 interrupted. A traceback means a bug in BlinkGL, or ``--debug``. ``blinkgl.show.COMMAND.run`` does the work,
prints the output and returns the status; it is imported inside the function, so that ``--help`` is fast.
"""

from __future__ import annotations

from typing import Annotated

import typer

from blinkgl.cli_examples import BLINKGL
from blinkgl.cli_recordings import calibrate, compare, convert, import_, saccade, simulate
from blinkgl.machine.command_line import new_app, run_app, safe_main
from blinkgl.tools.shader_debugger.cli import app as shader_app

app = new_app("blinkgl", "Event-camera and optical-flow data sets by rasterisation.", BLINKGL)
app.add_typer(shader_app)


# --- commands ---------------------------------------------------------------------------------------------------------


@app.command()
def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Machine-readable output.")] = False,
    backend: Annotated[str, typer.Option(help="OpenGL backend to examine: auto, egl or osmesa.")] = "auto",
    device: Annotated[int, typer.Option(min=0, help="EGL device to examine.")] = 0,
    compile_all: Annotated[
        bool,
        typer.Option("--compile", help="First compile the kernels of all common commands."),
    ] = False,
) -> int:
    """Report what this machine offers and what is missing. It names the commands that install
    missing parts. Exit status 2 if something required is missing."""
    from blinkgl.show import doctor as command

    return command.run(backend, device, as_json, compile_all)


@app.command()
def configs() -> int:
    """List the shipped runs. Every command that takes a YAML file also takes their names."""
    from blinkgl.show import configs as command

    return command.run()


@app.command()
def generate(
    config: Annotated[str, typer.Argument(help="YAML file, or the name of a shipped one (blinkgl configs).")],
    out: Annotated[
        str, typer.Option("--out", "-o", help="Folder for the data set; sequences go to OUT/SPLIT/NAME_000000 ….")
    ],
    num: Annotated[
        int | None,
        typer.Option(
            "--num",
            "-n",
            min=1,
            help="Sequences of the run, over its groups by their shares (default: output.sequences).",
        ),
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Seed of the run (default: the file's).")] = None,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="a.b=c", help="Override a value; may be repeated.")
    ] = None,
    both_sides: Annotated[
        bool | None,
        typer.Option(
            "--both-sides/--one-side",
            help="Draw faces of files from both sides, or from the front only (default: as the file says).",
        ),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print no progress and no summary.")] = False,
    workers: Annotated[
        int | None,
        typer.Option("--workers", "-w", min=1, help="Processes that generate sequences (default: only this one)."),
    ] = None,
    executor: Annotated[str, typer.Option(help="Where workers run: local, or ray (extra [cluster]).")] = "local",
    address: Annotated[
        str | None,
        typer.Option(help="ray: address of a running cluster (default: RAY_ADDRESS, else a new one on 127.0.0.1)."),
    ] = None,
    gpus: Annotated[float, typer.Option(min=0, help="ray: GPUs per worker; a fraction shares a GPU.")] = 0.0,
    devices: Annotated[
        str | None,
        typer.Option(help="local: EGL devices of the workers, e.g. 0,1 (default: all GPUs)."),
    ] = None,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Begin or continue a run: generate what is not complete."),
    ] = False,
    mixed: Annotated[
        bool,
        typer.Option("--mixed", help="Continue although recipe, assets or software have changed since the run began."),
    ] = False,
    time_limit: Annotated[
        float,
        typer.Option(min=0, help="Time limit of one attempt at a sequence, s; 0: none. Needs --workers."),
    ] = 3600.0,
    view: Annotated[
        bool, typer.Option("--view", help="Show each complete sequence in the browser (extra [view]).")
    ] = False,
    layout: Annotated[
        str | None, typer.Option(help="When all are complete, also write them as OUT-LAYOUT (blinkgl export --layout).")
    ] = None,
) -> int:
    """Generate sequences of events and optical flow from a YAML file. Exit status 3: done, but some sequences were set
    aside."""
    from blinkgl.show import generate as command
    from blinkgl.show.generate import choose_executor

    chosen = choose_executor(executor, workers, address=address, gpus=gpus, devices=devices)
    return command.run(
        config,
        out,
        num=num,
        seed=seed,
        overrides=[
            *(overrides or []),
            *([] if both_sides is None else [f"scene.both_sides={str(both_sides).lower()}"]),
        ],
        quiet=quiet,
        executor=chosen,
        resume=resume,
        mixed=mixed,
        time_limit_s=time_limit,
        view=view,
        layout=layout,
    )


@app.command()
def view(
    sequences: Annotated[list[str], typer.Argument(metavar="SEQUENCE", help="Folders of sequences or data sets.")],
    port: Annotated[int | None, typer.Option(help="Port on 127.0.0.1 (default: the first free one from 8080).")] = None,
    save: Annotated[
        str | None,
        typer.Option("--save", metavar="FILE.html", help="Save one sequence as a file for any browser instead."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing output.")] = False,
) -> int:
    """View sequences in the browser (extra [view]). Ctrl-C ends it."""
    from blinkgl.show import view as command

    return command.run(sequences, port=port, save=save, overwrite=overwrite)


@app.command()
def verify(
    folder: Annotated[str, typer.Argument(metavar="DIR", help="Data set, split or sequence.")],
    deep: Annotated[
        bool, typer.Option("--deep", help="Also generate a sample of sequences again and compare them bit by bit.")
    ] = False,
    sample: Annotated[int, typer.Option(min=1, help="Number of sequences that --deep generates again.")] = 3,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the sample.")] = 0,
    base: Annotated[
        str | None, typer.Option(help="Folder for the recipe's relative paths (default: as recorded).")
    ] = None,
) -> int:
    """Check the files and contents of a data set. Exit status 2 when something is wrong; the last line lists what
    could not be compared."""
    from blinkgl.show import verify as command

    return command.run(folder, deep=sample if deep else 0, seed=seed, base=base)


@app.command()
def drop(
    folder: Annotated[str, typer.Argument(metavar="OUT", help="Data set.")],
    sequences: Annotated[
        list[str] | None, typer.Argument(metavar="SEQUENCE", help="SPLIT/NAME_000000, or folders of sequences.")
    ] = None,
    where: Annotated[
        list[str] | None,
        typer.Option(
            "--where",
            metavar="'KEY < VALUE'",
            help="Sequences whose line in index.jsonl meets the condition (all, if repeated).",
        ),
    ] = None,
    undo: Annotated[bool, typer.Option("--undo", help="Undo: generate --resume makes them again.")] = False,
) -> int:
    """Take sequences out of a data set on purpose. Their folders are deleted; other commands no longer expect them."""
    from blinkgl.show import drop as command

    return command.run(folder, sequences or [], where=where or [], undo=undo)


@app.command()
def explain(
    config: Annotated[str, typer.Argument(help="YAML file, or the name of a shipped one (blinkgl configs).")],
    sequence: Annotated[
        int | None, typer.Option("--sequence", min=0, help="Number of the sequence (default: the first).")
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Seed of the run (default: the file's).")] = None,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="a.b=c", help="Override a value; may be repeated.")
    ] = None,
) -> int:
    """Report what a run models, what it leaves out, and its cost. Writes nothing."""
    from blinkgl.show import explain as command

    return command.run(config, sequence=sequence, seed=seed, overrides=overrides or [])


@app.command()
def trade(
    config: Annotated[
        str | None,
        typer.Argument(
            help="YAML file, or the name of a shipped one (blinkgl configs). With --suite: a folder of your scenes."
        ),
    ] = None,
    out: Annotated[
        str,
        typer.Option(
            "--out", "-o", help="Folder for trade.json, trade.csv, pareto.png and trade.html (--suite: suite.*)."
        ),
    ] = "trade",
    suite: Annotated[
        bool,
        typer.Option("--suite", help="Measure the shipped scenes instead of one."),
    ] = False,
    scene: Annotated[
        list[str] | None,
        typer.Option("--scene", metavar="TEXT", help="--suite: only scenes whose name contains this; may be repeated."),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Fewer settings, fewer pixels, a shorter clip: takes minutes.")
    ] = False,
    only: Annotated[
        list[str] | None,
        typer.Option("--only", metavar="TEXT", help="Only settings whose name contains this; may be repeated."),
    ] = None,
    skip: Annotated[
        list[str] | None,
        typer.Option("--skip", metavar="TEXT", help="Leave out settings whose name contains this; may be repeated."),
    ] = None,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="a.b=c", help="Override a value; may be repeated.")
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Seed of the run (default: the file's).")] = None,
    sequence: Annotated[
        int | None, typer.Option("--sequence", min=0, help="Number of the sequence (default: the first).")
    ] = None,
    clip: Annotated[
        float | None, typer.Option(min=1e-4, help="Simulated time, s (default: one label interval; --quick: 0.05).")
    ] = None,
    limit_ms: Annotated[float, typer.Option(min=0.001, help="Largest time difference of matching events, ms.")] = 10.0,
    rounds: Annotated[int | None, typer.Option(min=1, help="Timed rounds over all settings (default: 3).")] = None,
    minutes: Annotated[
        float | None,
        typer.Option(min=0.1, help="Start no further rounds or finer references after about this time."),
    ] = None,
    cost: Annotated[
        str | None,
        typer.Option(help="Cost axis of the front: wall (default), or cpu on a busy machine (--suite: cpu)."),
    ] = None,
    reference_set: Annotated[
        list[str] | None,
        typer.Option(
            metavar="scene.a=b",
            help="Reference with an effect that the settings leave out; may be repeated.",
        ),
    ] = None,
) -> int:
    """Measure the cost of accuracy of a scene. Settings are timed and compared with a converged reference."""
    from blinkgl.tools.trade import command

    if suite:
        from blinkgl.tools.trade import suite_command

        return suite_command.run(
            config,
            out,
            overrides=overrides or [],
            only=only or [],
            skip=skip or [],
            scenes=scene or [],
            limit_ms=limit_ms,
            rounds=rounds,
            cost=cost or "cpu",
            others={
                "--quick": quick,
                "--seed": seed is not None,
                "--sequence": sequence is not None,
                "--clip": clip is not None,
                "--minutes": minutes is not None,
                "--reference-set": bool(reference_set),
            },
        )
    return command.run(
        config,
        out,
        suite_options=["--scene"] if scene else [],
        overrides=overrides or [],
        quick=quick,
        only=only or [],
        skip=skip or [],
        sequence=sequence,
        clip=clip,
        limit_ms=limit_ms,
        rounds=rounds,
        minutes=minutes,
        cost=cost or "wall",
        reference_set=reference_set,
        seed=seed,
    )


@app.command()
def report(
    folder: Annotated[str, typer.Argument(metavar="DIR", help="Data set.")],
    out: Annotated[str | None, typer.Option("--out", "-o", help="Output page (default: DIR/report.html).")] = None,
    examples: Annotated[int, typer.Option(min=0, max=100, help="Number of sequences shown in pictures.")] = 6,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing --out.")] = False,
) -> int:
    """Write one self-contained HTML page about a data set. Without --out it also writes the set's index.jsonl."""
    from blinkgl.show import report as command

    return command.run(folder, out, examples=examples, overwrite=overwrite)


@app.command()
def export(
    folder: Annotated[str, typer.Argument(metavar="DIR", help="Data set, or one of its sequences.")],
    out: Annotated[str, typer.Option("--out", "-o", help="Output folder, written completely or not at all.")],
    layout: Annotated[
        str | None,
        typer.Option(
            help="webdataset (the default), dsec, eraft, blinkflow, mvsec, tapvid, "
            "multiflow, eventkubric, rosbag, nerf or intervals."
        ),
    ] = None,
    shard_mb: Annotated[
        float | None, typer.Option("--shard-mb", min=1, help="Size of a shard, MB (default: 512).")
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(min=0, help="Seed of the samples' order in shards."),
    ] = None,
) -> int:
    """Write a data set for the loaders of other programs. The default is WebDataset shards, one sample per flow
    label."""
    from blinkgl.show import export as command

    return command.run(folder, out, layout=layout, shard_mb=shard_mb, seed=seed)


for _command in (simulate, saccade, compare, calibrate, convert):
    app.command()(_command)
app.command("import")(import_)


# --- frame ------------------------------------------------------------------------------------------------------------


GONE = {
    "qualify": "blinkgl explain CONFIG, or generate: frames are checked when they are converted",
    "trade --reference": "--reference-set: scenes are no longer path-traced",
    "trade --resume": "--scene for some of its scenes: a suite is measured in one run",
    "simulate --factor": "--max-px: --factor belonged to --interpolate cubic, which was removed",
    "calibrate --flicker": "--frames or --still: a scene is no longer guessed",
    "calibrate --edge": "--frames or --still: a scene is no longer guessed",
    "convert --format": "a file name whose ending gives the format: .raw is EVT3, .h5 DSEC's layout",
    "import --texture-size": "colours baked in Blender",
    "import --bake-seconds": "colours baked in Blender",
    "export --scene": "the sequence's config.yaml and poses.npz: scenes are no longer exported as glTF",
    "report --card": "report.html and index.jsonl: write the page of a data hub yourself",
    "shader time": "your driver's profiler, or blinkgl trade: passes are no longer timed",
    "shader show --active": "all lines, as the compiler reads them",
}
"""Commands and options of earlier versions, and what to use instead."""


def run(arguments: list[str]) -> int:
    """Run one command line (without the program name); returns the exit status and raises nothing a user can cause."""
    return run_app(app, arguments, "blinkgl", "BlinkGL", GONE, resumes="generate")


def main() -> None:
    """The console script."""
    safe_main(run)


if __name__ == "__main__":
    main()
