"""The ``blinkgl shader`` commands. Each command imports what it needs when it runs, so that this module is light."""

from __future__ import annotations

import json as _json
from typing import Annotated

import typer

from blinkgl.machine.help import App

app = App(
    name="shader",
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Inspect what every pass wrote at a pixel, and why.",
)

Config = Annotated[str, typer.Argument(help="YAML file, or the name of a shipped one (blinkgl configs).")]
Seed = Annotated[int | None, typer.Option("--seed", help="Seed of the run (default: the file's).")]
Sequence = Annotated[
    int | None, typer.Option("--sequence", "-n", min=0, help="Number of the sequence (default: the run's first).")
]
Time = Annotated[
    float | None, typer.Option("--time", "-t", help="Time on the sequence's clock, s (default: the first label).")
]
Shaders = Annotated[str | None, typer.Option("--shaders", help="Use an edited copy of the shaders/ folder.")]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", metavar="a.b=c", help="Override a value; may be repeated.")
]


def _load(files: list[str] | None) -> list[str] | None:
    from blinkgl.machine.plugins import load_plugins

    load_plugins(files or ())
    return files


Plugin = Annotated[
    list[str] | None,
    typer.Option(
        "--plugin",
        callback=_load,
        is_eager=True,
        metavar="FILE",
        help="Python file with passes or labels of your own (docs/extending.md); may be repeated.",
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Machine-readable output.")]
DIFFERENT = 1  # exit status of `diff` above the tolerance, and of `check` with an error


def _opened(config, seed, sequence, overrides, time):
    """Return the subject, and the moment in it."""
    from blinkgl.tools.shader_debugger.session import moment, open_subject

    subject = open_subject(config, seed=seed, sequence=sequence, overrides=overrides or [])
    return subject, moment(subject, time)


@app.command()
def passes(
    config: Config,
    out: Annotated[str, typer.Option("--out", "-o", help="Folder for the pictures and arrays.")],
    seed: Seed = None,
    sequence: Sequence = None,
    time: Time = None,
    shaders: Shaders = None,
    plugin: Plugin = None,
    overrides: Overrides = None,
    names: Annotated[list[str] | None, typer.Option("--pass", help="Only this buffer; may be repeated.")] = None,
) -> None:
    """Write every buffer at one time as PNG and .npy. A contact sheet shows all of them."""
    from blinkgl.tools.shader_debugger.commands import write_passes

    subject, when = _opened(config, seed, sequence, overrides, time)
    paths = write_passes(subject, when, out, names, shaders)
    typer.echo(f"{len(paths)} files in {out}; look at {paths[-1]}")


@app.command()
def probe(
    config: Config,
    pixel: Annotated[str, typer.Option("--pixel", "-p", metavar="X,Y", help="(0, 0) is the top-left pixel.")],
    time: Time = None,
    seed: Seed = None,
    sequence: Sequence = None,
    shaders: Shaders = None,
    plugin: Plugin = None,
    overrides: Overrides = None,
    json: Json = False,
) -> None:
    """Print every buffer at a pixel beside the float64 reference. It also prints the point's position, and why it is
    invalid or occluded."""
    from blinkgl.tools.shader_debugger.commands import run_probe

    subject, when = _opened(config, seed, sequence, overrides, time)
    typer.echo(run_probe(subject, when, pixel, shaders, json))


@app.command()
def diff(
    config: Config,
    time: Time = None,
    seed: Seed = None,
    sequence: Sequence = None,
    shaders: Shaders = None,
    plugin: Plugin = None,
    overrides: Overrides = None,
    names: Annotated[list[str] | None, typer.Option("--pass", help="Only this buffer; may be repeated.")] = None,
    tolerance: Annotated[
        list[str] | None,
        typer.Option(
            "--tolerance", metavar="[BUFFER=]X", help="Allowed error in the buffer's unit (default: per buffer)."
        ),
    ] = None,
    out: Annotated[
        str | None, typer.Option("--out", "-o", help="Also write diff.png and the error arrays into this folder.")
    ] = None,
    json: Json = False,
) -> None:
    """Compare whole images with the float64 reference. Exit status 1 when a buffer exceeds its tolerance."""
    from blinkgl.tools.shader_debugger import commands

    subject, when = _opened(config, seed, sequence, overrides, time)
    result, reports = commands.run_diff(subject, when, names, tolerance or [], shaders, out)
    typer.echo(commands.diff_json(result, reports) if json else commands.diff_text(result, reports))
    # Exit status for scripts: 0 means that all compared buffers agree.
    if not result["passed"]:
        raise typer.Exit(DIFFERENT)


@app.command()
def check(
    files: Annotated[
        list[str] | None,
        typer.Argument(help="Shader files; an include means all files that include it (default: all)."),
    ] = None,
    shaders: Shaders = None,
    plugin: Plugin = None,
    backend: Annotated[str, typer.Option(help="OpenGL backend: auto, egl or osmesa.")] = "auto",
    device: Annotated[int, typer.Option(min=0, help="EGL device.")] = 0,
    json: Json = False,
) -> None:
    """Compile every shader in every variant that can be needed. Exit status 1 on an error."""
    from blinkgl.tools.shader_debugger import check as checking

    result = checking.check(files or [], shaders, backend, device)
    typer.echo(_json.dumps(result.as_dict()) if json else checking.as_text(result))
    if result.errors:
        raise typer.Exit(DIFFERENT)


@app.command()
def show(
    program: Annotated[str, typer.Argument(help="File in the shader folder, such as label.glsl.")],
    define: Annotated[
        list[str] | None,
        typer.Option("--define", "-D", metavar="NAME[=VALUE]", help="Preprocessor define; may be repeated."),
    ] = None,
    stage: Annotated[str, typer.Option(help="vertex, geometry, fragment, or both for all.")] = "both",
    numbers: Annotated[bool, typer.Option("--numbers", help="Print file and line before each line.")] = False,
    shaders: Shaders = None,
    plugin: Plugin = None,
) -> None:
    """Print a program's source as the compiler reads it. Includes and defines are expanded."""
    from blinkgl.tools.shader_debugger.check import show_source

    typer.echo(show_source(program, define or [], stage, numbers, shaders), nl=False)


@app.command()
def serve(
    config: Config,
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Port; 0: any free one.")] = 8765,
    host: Annotated[
        str, typer.Option("--host", help="Address to listen on; any but 127.0.0.1 allows access from other machines.")
    ] = "127.0.0.1",
    time: Time = None,
    seed: Seed = None,
    sequence: Sequence = None,
    shaders: Shaders = None,
    plugin: Plugin = None,
    overrides: Overrides = None,
) -> None:
    """Serve a local page on which passes are inspected. Shaders reload when saved. Ctrl-C ends it."""
    from blinkgl.tools.shader_debugger.server import serve as run_server

    subject, when = _opened(config, seed, sequence, overrides, time)
    run_server(subject, when, shaders, host, port)
