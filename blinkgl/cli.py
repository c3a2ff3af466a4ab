"""The ``blinkgl`` command: thin functions over the library, one line per error.

Exit status: 0 done; 1 `shader diff` or `shader check` found something wrong; 2 the user's input or machine
(``error: …`` on stderr, one line); 3 done but for sequences (`trade --suite`: scenes) that were set aside; 130
interrupted. A traceback means a bug in BlinkGL, or ``--debug``. What a command does and prints is
``blinkgl.show.COMMAND.run``, which returns the status; it is imported inside the function, so that ``--help`` answers
at once.
"""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from blinkgl import __version__
from blinkgl.cli_recordings import calibrate, compare, convert, import_, simulate
from blinkgl.machine.command_line import run_app
from blinkgl.shader_debugger.cli import app as shader_app

app = typer.Typer(name="blinkgl", add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
app.add_typer(shader_app)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"blinkgl {__version__}")
        raise typer.Exit


@app.callback()
def _global_options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show the traceback of an error; allowed after the command, too.")
    ] = False,
) -> None:
    """Event-camera and optical-flow data sets by rasterisation."""


# --- commands ---------------------------------------------------------------------------------------------------------


@app.command()
def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Machine-readable output.")] = False,
    backend: Annotated[str, typer.Option(help="OpenGL backend to examine: auto, egl or osmesa.")] = "auto",
    device: Annotated[int, typer.Option(min=0, help="EGL device to examine.")] = 0,
) -> int:
    """Say what this machine offers, what is missing, and the command that mends it. Exit
    status 2 if something required is missing."""
    from blinkgl.show import doctor as command

    return command.run(backend, device, as_json)


@app.command()
def configs() -> int:
    """List the runs that ship: their names stand wherever a command takes a YAML file."""
    from blinkgl.show import configs as command

    return command.run()


@app.command()
def generate(
    config: Annotated[str, typer.Argument(help="YAML file, or the name of one that ships (blinkgl configs).")],
    out: Annotated[
        str, typer.Option("--out", "-o", help="Folder for the data set; sequences go to OUT/SPLIT/NAME_000000 ….")
    ],
    num: Annotated[
        int | None, typer.Option("--num", "-n", min=1, help="Number of sequences (default: output.sequences).")
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Seed of the run (default: the file's).")] = None,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="a.b=c", help="Override a value; may be repeated.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no table.")] = False,
    workers: Annotated[
        int | None,
        typer.Option("--workers", "-w", min=1, help="Processes to make sequences in (default: this one alone)."),
    ] = None,
    executor: Annotated[str, typer.Option(help="Where workers run: local, or ray (extra [cluster]).")] = "local",
    address: Annotated[
        str | None,
        typer.Option(
            help="ray: address of a running cluster (default: RAY_ADDRESS, else one of its own on 127.0.0.1)."
        ),
    ] = None,
    gpus: Annotated[float, typer.Option(min=0, help="ray: GPUs per worker; a fraction shares one.")] = 0.0,
    devices: Annotated[
        str | None, typer.Option(help="local: EGL devices dealt out to the workers, e.g. 0,1 (default: all cards).")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a run: make only what is not whole.")] = False,
    mixed: Annotated[
        bool,
        typer.Option("--mixed", help="Go on although recipe, assets or software have changed since the run began."),
    ] = False,
    time_limit: Annotated[
        float,
        typer.Option(min=0, help="Seconds that one attempt at a sequence may take; 0: no limit. Needs --workers."),
    ] = 3600.0,
    view: Annotated[
        bool, typer.Option("--view", help="Show each sequence in the browser when it is whole (extra [view]).")
    ] = False,
    layout: Annotated[
        str | None, typer.Option(help="When all are whole, write them as OUT-LAYOUT, too (blinkgl export --layout).")
    ] = None,
) -> int:
    """Generate event + optical-flow sequences from one YAML file. Exit status 3: done, but
    some sequences were set aside."""
    from blinkgl.show import generate as command
    from blinkgl.show.generate import choose_executor

    chosen = choose_executor(executor, workers, address=address, gpus=gpus, devices=devices)
    return command.run(
        config,
        out,
        num=num,
        seed=seed,
        overrides=overrides or [],
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
    sequences: Annotated[
        list[str], typer.Argument(metavar="SEQUENCE", help="Folders of sequences, or of data sets of them.")
    ],
    port: Annotated[int | None, typer.Option(help="Of 127.0.0.1 (default: the first free one from 8080 on).")] = None,
    save: Annotated[
        str | None, typer.Option("--save", metavar="FILE.html", help="Instead: one sequence as a file for any browser.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing output.")] = False,
) -> int:
    """Look at sequences in the browser: frames, events, labels and the scene in space (extra [view]). Ctrl-C ends
    it."""
    from blinkgl.show import view as command

    return command.run(sequences, port=port, save=save, overwrite=overwrite)


@app.command()
def verify(
    folder: Annotated[str, typer.Argument(metavar="DIR", help="Data set, split or sequence.")],
    deep: Annotated[
        bool, typer.Option("--deep", help="Also generate a sample of sequences again and compare bit by bit.")
    ] = False,
    sample: Annotated[int, typer.Option(min=1, help="How many sequences --deep makes again.")] = 3,
    seed: Annotated[int, typer.Option(min=0, help="Which ones.")] = 0,
    base: Annotated[
        str | None, typer.Option(help="Folder the recipe's relative paths start from (default: as the run recorded).")
    ] = None,
) -> int:
    """Check a data set: names, manifests, checksums, contents, what the recipe draws. Exit status 2 when something is
    wrong; what could not be compared is noted, and said in the last line."""
    from blinkgl.show import verify as command

    return command.run(folder, deep=sample if deep else 0, seed=seed, base=base)


@app.command()
def explain(
    config: Annotated[str, typer.Argument(help="YAML file, or the name of one that ships (blinkgl configs).")],
    sequence: Annotated[
        int | None, typer.Option("--sequence", min=0, help="Which sequence (default: the first).")
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Seed of the run (default: the file's).")] = None,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="a.b=c", help="Override a value; may be repeated.")
    ] = None,
) -> int:
    """Say what a run will model, what it leaves out and why, and what it will cost. Writes nothing."""
    from blinkgl.show import explain as command

    return command.run(config, sequence=sequence, seed=seed, overrides=overrides or [])


@app.command()
def trade(
    config: Annotated[
        str | None,
        typer.Argument(
            help="YAML file, or the name of one that ships (blinkgl configs). With --suite: a folder of your scenes."
        ),
    ] = None,
    out: Annotated[
        str,
        typer.Option(
            "--out", "-o", help="Folder for trade.json, trade.csv, pareto.png and trade.html (--suite: suite.*)."
        ),
    ] = "trade",
    suite: Annotated[
        bool, typer.Option("--suite", help="The shipped scenes, each hard in another way, in place of one.")
    ] = False,
    scene: Annotated[
        list[str] | None,
        typer.Option("--scene", metavar="TEXT", help="--suite: only scenes whose name contains this; may be repeated."),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Fewer settings, fewer pixels, a shorter clip: minutes.")
    ] = False,
    only: Annotated[
        list[str] | None,
        typer.Option("--only", metavar="TEXT", help="Only settings whose name contains this; may be repeated."),
    ] = None,
    skip: Annotated[
        list[str] | None,
        typer.Option("--skip", metavar="TEXT", help="No settings whose name contains this; may be repeated."),
    ] = None,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="a.b=c", help="Override a value; may be repeated.")
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Seed of the run (default: the file's).")] = None,
    sequence: Annotated[
        int | None, typer.Option("--sequence", min=0, help="Which sequence (default: the first).")
    ] = None,
    clip: Annotated[
        float | None, typer.Option(min=1e-4, help="Simulated seconds (default: one label interval; --quick: 0.05).")
    ] = None,
    limit_ms: Annotated[
        float, typer.Option(min=0.001, help="Events further apart than this are not the same event.")
    ] = 10.0,
    rounds: Annotated[int | None, typer.Option(min=1, help="Timed rounds over all settings (default: 3).")] = None,
    minutes: Annotated[
        float | None,
        typer.Option(min=0.1, help="Give up on further rounds and finer references after about this long."),
    ] = None,
    cost: Annotated[
        str | None,
        typer.Option(help="What the front is drawn over: wall (default), or cpu on a busy machine (--suite: cpu)."),
    ] = None,
    reference_set: Annotated[
        list[str] | None,
        typer.Option(
            metavar="scene.a=b",
            help="Judge by a scene that has more: an effect that the settings leave out, such as "
            "scene.light.shadows=soft; may be repeated.",
        ),
    ] = None,
) -> int:
    """Measure what accuracy costs: settings timed and judged against a converged reference,
    as a table, a plot and a page."""
    from blinkgl.show import trade as command

    if suite:
        from blinkgl.show import suite as suite_command

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
    out: Annotated[str | None, typer.Option("--out", "-o", help="The page (default: DIR/report.html).")] = None,
    examples: Annotated[int, typer.Option(min=0, max=100, help="Sequences shown in pictures.")] = 6,
) -> int:
    """Write one self-contained HTML page about a data set, and its index.jsonl."""
    from blinkgl.show import report as command

    return command.run(folder, out, examples=examples)


@app.command()
def export(
    folder: Annotated[str, typer.Argument(metavar="DIR", help="Data set, or one sequence of it.")],
    out: Annotated[str, typer.Option("--out", "-o", help="Folder to write, as a whole or not at all.")],
    layout: Annotated[
        str | None,
        typer.Option(
            help="webdataset (shards SPLIT-000000.tar …, the default), dsec, eraft, blinkflow, mvsec, tapvid, "
            "multiflow or eventkubric."
        ),
    ] = None,
    shard_mb: Annotated[float | None, typer.Option("--shard-mb", min=1, help="Size of a shard (default: 512).")] = None,
    seed: Annotated[
        int | None,
        typer.Option(min=0, help="Order of the samples in shards; a reader then only has to shuffle shards."),
    ] = None,
) -> int:
    """Write a data set as WebDataset shards, one sample per flow label, or as another data set's loaders read it."""
    from blinkgl.show import export as command

    return command.run(folder, out, layout=layout, shard_mb=shard_mb, seed=seed)


for _command in (simulate, compare, calibrate, convert):
    app.command()(_command)
app.command("import")(import_)


# --- frame ------------------------------------------------------------------------------------------------------------


GONE = {
    "qualify": "blinkgl explain CONFIG, or generate: frames are checked where they are converted",
    "trade --reference": "--reference-set: scenes are no longer path-traced",
    "trade --resume": "--scene for some of its scenes: a suite is measured in one go",
    "simulate --factor": "--max-px: it was of --interpolate cubic, which is gone",
    "calibrate --flicker": "--frames or --still: no scene is guessed without frames",
    "calibrate --edge": "--frames or --still: no scene is guessed without frames",
    "convert --format": "an ending that names the format: .raw is EVT3, .h5 DSEC's layout",
    "import --texture-size": "colours baked in Blender",
    "import --bake-seconds": "colours baked in Blender",
    "export --scene": "the sequence's config.yaml and poses.npz: scenes are no longer written as glTF",
    "report --card": "report.html and index.jsonl: the page of a data hub is yours to write",
    "shader time": "your driver's profiler, or blinkgl trade: passes are no longer timed",
    "shader show --active": "all lines, as the compiler gets them",
}
"""What earlier versions had, and what to do instead."""


def run(arguments: list[str]) -> int:
    """Run one command line (without the program name); returns the exit status and raises nothing a user can cause."""
    return run_app(app, arguments, "blinkgl", "BlinkGL", GONE)


def main() -> None:
    """The console script."""
    sys.exit(run(sys.argv[1:]))


if __name__ == "__main__":
    main()
