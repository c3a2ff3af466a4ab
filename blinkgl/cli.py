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
) -> int:
    """Generate event + optical-flow sequences from one YAML file. Exit status 3: done, but
    some sequences were set aside."""
    from blinkgl.show import generate as command
    from blinkgl.show.executors import choose_executor

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
    card: Annotated[bool, typer.Option("--card", help="Also DIR/README.md, for data hubs.")] = False,
    licence: Annotated[str | None, typer.Option("--license", help="On the card, e.g. cc-by-4.0.")] = None,
    url: Annotated[str | None, typer.Option("--url", help="On the card: where the data set is found.")] = None,
) -> int:
    """Write one self-contained HTML page about a data set, and its index.jsonl."""
    from blinkgl.show import report as command

    return command.run(folder, out, examples=examples, card=card, licence=licence, url=url)


@app.command()
def export(
    folder: Annotated[str, typer.Argument(metavar="DIR", help="Data set, or one sequence of it.")],
    out: Annotated[str | None, typer.Option("--out", "-o", help="Folder to write, as a whole or not at all.")] = None,
    layout: Annotated[
        str | None,
        typer.Option(
            help="webdataset (shards SPLIT-000000.tar …, the default), dsec, eraft, blinkflow, mvsec, tapvid or "
            "multiflow."
        ),
    ] = None,
    shard_mb: Annotated[float | None, typer.Option("--shard-mb", min=1, help="Size of a shard (default: 512).")] = None,
    seed: Annotated[
        int | None,
        typer.Option(min=0, help="Order of the samples in shards; a reader then only has to shuffle shards."),
    ] = None,
    scene: Annotated[
        str | None,
        typer.Option("--scene", metavar="OUT.glb", help="Instead: one sequence as an animated glTF, for viewers."),
    ] = None,
) -> int:
    """Write a data set as WebDataset shards, one sample per flow label, or as another data set's loaders read it."""
    from blinkgl.show import export as command

    return command.run(folder, out, layout=layout, shard_mb=shard_mb, seed=seed, scene=scene)


@app.command()
def simulate(
    source: Annotated[
        str,
        typer.Argument(
            metavar="INPUT", help="Video, folder of images, .npy or .npz of frames, .aedat4 or .aedat with frames."
        ),
    ],
    out: Annotated[
        str, typer.Option("--out", "-o", help="Event file: .h5 (DSEC), .raw (EVT3), .txt, .csv, .npz, .npy.")
    ],
    emulator: Annotated[str, typer.Option("--emulator", "-e", help="esim, v2e or voltmeter.")] = "esim",
    sensor: Annotated[
        str | None,
        typer.Option(
            "--sensor",
            help="davis240c, davis346, dvxplorer, gen31_vga or imx636, or a sensor file (.yaml): its size, thresholds, "
            "noise and read-out limit.",
        ),
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(
            help="WIDTHxHEIGHT that frames are cropped and scaled to (default: the sensor's, else their own)."
        ),
    ] = None,
    config: Annotated[str | None, typer.Option("--config", help="YAML file of emulator parameters.")] = None,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="key=value", help="Emulator parameter; may be repeated.")
    ] = None,
    fps: Annotated[
        float | None, typer.Option(help="Frames per second (default: the video's, or the time stamps).")
    ] = None,
    timestamps: Annotated[
        str | None, typer.Option(help="File of frame times: µs as integers, or seconds with a point.")
    ] = None,
    gamma: Annotated[
        str | None,
        typer.Option(
            help="srgb, linear or an exponent (default: linear for floats and a recording's frames, for grey images "
            "of the sensor's size what its own frames are, else srgb)."
        ),
    ] = None,
    interpolate: Annotated[str, typer.Option(help="Between frames: linear, or motion (dense-flow warp).")] = "linear",
    max_px: Annotated[float, typer.Option(min=0.01, help="motion: largest displacement per step, px.")] = 1.0,
    keep_noise: Annotated[
        bool, typer.Option("--keep-noise", help="Make events of the frames' own noise, too (default: none).")
    ] = False,
    seed: Annotated[int, typer.Option(help="Seed of the emulator.")] = 0,
    preview: Annotated[str | None, typer.Option(help="Also write a video of frames and events, .mp4.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing output.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no summary.")] = False,
) -> int:
    """Turn any video into events."""
    from blinkgl.show import simulate as command

    return command.run(
        source,
        out,
        emulator=emulator,
        sensor=sensor,
        size=size,
        config=config,
        overrides=overrides or [],
        quiet=quiet,
        fps=fps,
        timestamps=timestamps,
        gamma=gamma,
        interpolate=interpolate,
        max_px=max_px,
        keep_noise=keep_noise,
        seed=seed,
        preview=preview,
        overwrite=overwrite,
    )


@app.command()
def compare(
    a: Annotated[str, typer.Argument(metavar="A", help="Event file.")],
    b: Annotated[
        str | None, typer.Argument(metavar="B", help="Event file (of any size), or frames (video, folder, .npy).")
    ] = None,
    frames: Annotated[str | None, typer.Option(help="Frames of the scene, for the log-intensity change.")] = None,
    out: Annotated[str | None, typer.Option("--out", "-o", help="Folder for compare.json and compare.png.")] = None,
    fps: Annotated[float | None, typer.Option(help="Frame rate of the frames.")] = None,
    timestamps: Annotated[str | None, typer.Option(help="Frame times.")] = None,
    gamma: Annotated[
        str, typer.Option(help="Of the frames: linear, as a camera's own are, srgb or an exponent.")
    ] = "linear",
    frame_delay_ms: Annotated[float, typer.Option(help="Added to the frame times, ms.")] = 0.0,
    interval_ms: Annotated[float, typer.Option(min=0.001, help="Interval where there are no frames, ms.")] = 20.0,
    zero_time: Annotated[bool, typer.Option("--zero-time", help="Count both from their first event.")] = False,
    judge: Annotated[
        bool, typer.Option("--judge", help="Also say how well a classifier tells A from B, and the halves of each.")
    ] = False,
) -> int:
    """Describe a recording, or compare it with another or with frames: counts, rates,
    intervals, polarity against brightness."""
    from blinkgl.show import compare as command

    return command.run(
        a,
        b,
        out,
        frames=frames,
        fps=fps,
        timestamps=timestamps,
        gamma=gamma,
        frame_delay_ms=frame_delay_ms,
        interval_ms=interval_ms,
        zero_time=zero_time,
        judge=judge,
    )


@app.command()
def calibrate(
    recording: Annotated[str, typer.Argument(metavar="RECORDING", help="Event file of a camera.")],
    out: Annotated[
        str, typer.Option("--out", "-o", help="The sensor file, .yaml; a page goes beside it, .html.")
    ] = "sensor.yaml",
    frames: Annotated[
        str | None,
        typer.Option(help="What the camera saw, of its size (default: the recording's own frames)."),
    ] = None,
    still: Annotated[
        bool, typer.Option("--still", help="No frames: a scene that stands still in constant light. Noise alone.")
    ] = False,
    emulator: Annotated[
        str,
        typer.Option("--emulator", "-e", help="esim, v2e or voltmeter; with --still also pixels: noise beside any."),
    ] = "esim",
    sensor: Annotated[str | None, typer.Option("--sensor", help="A sensor whose values the fit begins with.")] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="key=value", help="Emulator parameter that is not fitted; may be repeated."),
    ] = None,
    fps: Annotated[float | None, typer.Option(help="Frame rate of the frames.")] = None,
    timestamps: Annotated[str | None, typer.Option(help="Frame times.")] = None,
    gamma: Annotated[
        str, typer.Option(help="Of the frames: linear, as a camera's own are, srgb or an exponent.")
    ] = "linear",
    interpolate: Annotated[str, typer.Option(help="Between frames: motion (dense-flow warp) or linear.")] = "motion",
    max_px: Annotated[float, typer.Option(min=0.01, help="motion: largest displacement per step, px.")] = 1.0,
    frame_delay_ms: Annotated[
        float | None, typer.Option(help="Added to the frame times, ms (default: found from both).")
    ] = None,
    starts: Annotated[int, typer.Option(min=1, max=20, help="Of the search.")] = 3,
    seed: Annotated[int, typer.Option(min=0, help="Of the simulations and of the search.")] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing output.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no summary.")] = False,
) -> int:
    """Fit an emulator to a camera's own recording: a sensor file, and a page that says how near it comes."""
    from blinkgl.show import calibrate as command

    return command.run(
        recording,
        frames,
        out,
        still=still,
        emulator=emulator,
        sensor=sensor,
        overrides=overrides or [],
        fps=fps,
        timestamps=timestamps,
        gamma=gamma,
        interpolate=interpolate,
        max_px=max_px,
        frame_delay_ms=frame_delay_ms,
        starts=starts,
        seed=seed,
        overwrite=overwrite,
        quiet=quiet,
    )


@app.command()
def convert(
    source: Annotated[
        str,
        typer.Argument(
            metavar="IN",
            help="Event file: DSEC/BlinkFlow/MVSEC/Prophesee .h5, EVT2/EVT2.1/EVT3 .raw, .aedat4, .aedat, .es, "
            ".mat, .txt, .csv, .npz, .npy.",
        ),
    ],
    target: Annotated[str, typer.Argument(metavar="OUT", help="Event file; its ending names the format.")],
    size: Annotated[
        str | None, typer.Option(help="WIDTHxHEIGHT, where the file does not say (default: guessed).")
    ] = None,
    zero_time: Annotated[
        bool, typer.Option("--zero-time", help="Shift times so that the first event is at 0.")
    ] = False,
    time_unit: Annotated[
        str,
        typer.Option("--time-unit", help="Of .txt and .csv: s (six decimals), or us (integers; a .csv as faery's)."),
    ] = "s",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing output.")] = False,
) -> int:
    """Convert an event file from one format to another."""
    from blinkgl.show import convert as command

    return command.run(source, target, size=size, zero_time=zero_time, time_unit=time_unit, overwrite=overwrite)


@app.command("import")
def import_(
    source: Annotated[
        str, typer.Argument(metavar="SCENE", help=".blend, .fbx, .usd/.usda/.usdc/.usdz, .dae, .abc or .obj.")
    ],
    out: Annotated[str, typer.Option("--out", "-o", help="The GLB to write.")],
    scene: Annotated[
        str | None, typer.Option("--scene", help="Name of the file's scene (default: the one it was saved in).")
    ] = None,
    frames: Annotated[
        tuple[int, int] | None, typer.Option("--frames", metavar="FIRST LAST", help="Default: the scene's range.")
    ] = None,
    fps: Annotated[
        float | None,
        typer.Option("--fps", help="Frames per second (default: the file's; 24 for USD, Collada and Alembic)."),
    ] = None,
    keys_per_frame: Annotated[
        int,
        typer.Option("--keys-per-frame", min=1, max=64, help="Key frames per frame; between them motion is straight."),
    ] = 1,
    clips: Annotated[
        bool, typer.Option("--clips", help="An animation per action, not one of the scene as it plays.")
    ] = False,
    time_limit: Annotated[
        float, typer.Option("--time-limit", min=1, help="Seconds that Blender may take altogether.")
    ] = 900.0,
    as_json: Annotated[bool, typer.Option("--json", help="Machine-readable output.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing output.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no table.")] = False,
) -> int:
    """Make a GLB of a scene of Blender's or of a format that Blender reads (extra [cycles]), and say what came and what
    could not."""
    from blinkgl.show import import_ as command

    return command.run(
        source,
        out,
        as_json=as_json,
        quiet=quiet,
        scene=scene,
        frames=frames,
        fps=fps,
        keys_per_frame=keys_per_frame,
        clips=clips,
        time_limit_s=time_limit,
        overwrite=overwrite,
    )


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
