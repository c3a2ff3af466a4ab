"""The commands of ``blinkgl`` on one recording, video, event file or scene; those on data sets are in ``cli.py``."""

from __future__ import annotations

from typing import Annotated

import typer

from blinkgl.config.names import shipped_names
from blinkgl.machine import event_options as of_events

SENSORS = shipped_names("sensors")

# What may be declared of frames, in every command that reads them.
Fps = Annotated[float | None, typer.Option(help="Frames per second (default: the file's own times).")]
Timestamps = Annotated[str | None, typer.Option(help="File of frame times, a line each: 'time' or 'time name'.")]
FramesTimeUnit = Annotated[
    str | None,
    typer.Option(
        "--frames-time-unit",
        help="Of --timestamps: s, ms, us, ns, or frames of --fps (default: as its heading or name says).",
    ),
]
Curve = Annotated[
    str | None,
    typer.Option(
        help="Curve of the frames: linear, srgb, pq, hlg or an exponent (default: what the file states; linear for "
        "grey images; srgb for video and colour)."
    ),
]
WhiteLevel = Annotated[
    float | None,
    typer.Option("--white-level", help="Code of white, such as 4095 of 12 bits (default: what the file states, else "
    "the type's largest)."),
]  # fmt: skip
Range = Annotated[
    str | None,
    typer.Option("--range", help="Of the codes: full, or limited, 16 to 235 of 8 bits (default: the file's)."),
]
Background = Annotated[
    str | None, typer.Option(help="Below transparent pixels: black, grey, white or #rrggbb (default: black).")
]


def simulate(
    source: Annotated[
        str,
        typer.Argument(
            metavar="INPUT",
            help="Video, folder of images, TIFF stack, animated GIF, PNG or WebP, .npy or .npz of frames, "
            ".aedat4 or .aedat with frames.",
        ),
    ],
    out: Annotated[
        str,
        typer.Option(
            "--out",
            "-o",
            help="Event file: .h5 (DSEC), .raw (EVT3), .aedat4, .txt, .csv, .npz, .npy, .bin (N-MNIST).",
        ),
    ],
    emulator: Annotated[str, typer.Option("--emulator", "-e", help="esim, v2e or voltmeter.")] = "esim",
    sensor: Annotated[
        str | None,
        typer.Option(
            "--sensor",
            help=f"{', '.join(SENSORS[:-1])} or {SENSORS[-1]}, or a sensor file (.yaml): its size, thresholds, noise "
            "and read-out limit.",
        ),
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(help="Size to crop and scale frames to (default: the sensor's, else their own)."),
    ] = None,
    config: Annotated[str | None, typer.Option("--config", help="YAML file of emulator parameters.")] = None,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="key=value", help="Emulator parameter; may be repeated.")
    ] = None,
    fps: Fps = None,
    timestamps: Timestamps = None,
    time_unit: Annotated[
        str | None,
        typer.Option(
            "--time-unit",
            help="Of --timestamps: s, ms, us, ns, or frames of --fps (default: as its heading or name says).",
        ),
    ] = None,
    zero_time: Annotated[bool, typer.Option("--zero-time", help="Count times from the first frame.")] = False,
    gamma: Annotated[
        str | None,
        typer.Option(
            help="srgb, linear, pq, hlg or an exponent (default: what the file states; linear for floats and a "
            "recording's frames; the sensor's for grey images of its size; else srgb)."
        ),
    ] = None,
    white_level: WhiteLevel = None,
    range_: Range = None,
    background: Background = None,
    stream: of_events.Stream = None,
    damaged: Annotated[str, typer.Option("--damaged", help="refuse, or keep the frames that are whole.")] = "refuse",
    interpolate: Annotated[str, typer.Option(help="Between frames: linear, or motion (dense-flow warp).")] = "linear",
    max_px: Annotated[float, typer.Option(min=0.01, help="motion: largest displacement per step, px.")] = 1.0,
    keep_noise: Annotated[bool, typer.Option("--keep-noise", help="Make events of the frames' noise, too.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the emulator.")] = 0,
    preview: Annotated[str | None, typer.Option(help="Also write a video of frames and events, .mp4.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing output.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print no progress and no summary.")] = False,
) -> int:
    """Convert any video into events."""
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
        declared=dict(
            fps=fps,
            timestamps=timestamps,
            time_unit=time_unit,
            zero_time=zero_time,
            white_level=white_level,
            range=range_,
            background=background,
            stream=stream,
            damaged=damaged,
        ),
        frames=dict(gamma=gamma, interpolate=interpolate, max_px=max_px, keep_noise=keep_noise),
        seed=seed,
        preview=preview,
        overwrite=overwrite,
    )


def saccade(
    pictures: Annotated[str, typer.Argument(metavar="PICTURES", help="Folder of still pictures.")],
    out: Annotated[str, typer.Option("--out", "-o", help="Folder for the clips, written completely or not at all.")],
    classes_from: Annotated[
        str | None, typer.Option("--classes-from", help="folders: each folder in PICTURES is a class.")
    ] = None,
    path: Annotated[
        str | None,
        typer.Option(help="CSV of the sensor's way, t,x,y in s and px, +y down (default: N-MNIST's saccades)."),
    ] = None,
    size: Annotated[
        str | None, typer.Option(help="WIDTHxHEIGHT of the sensor (default: that of --sensor, else 34x34).")
    ] = None,
    form: Annotated[str, typer.Option("--format", help="bin (N-MNIST's), npz, or npy (one structured array).")] = "bin",
    emulator: Annotated[str, typer.Option("--emulator", "-e", help="esim, v2e or voltmeter.")] = "esim",
    sensor: Annotated[
        str | None, typer.Option("--sensor", help="A shipped sensor, or a sensor file (.yaml), as of simulate.")
    ] = None,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="key=value", help="Emulator parameter; may be repeated.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the run.")] = 0,
    workers: Annotated[int, typer.Option("--workers", "-w", min=1, help="Processes that make clips.")] = 1,
) -> int:
    """Make event clips of still pictures, with classes. The sensor moves over each picture; no OpenGL is needed."""
    from blinkgl.show import saccade as command

    return command.run(
        pictures,
        out,
        classes_from=classes_from,
        path=path,
        size=size,
        form=form,
        emulator=emulator,
        sensor=sensor,
        overrides=overrides or [],
        seed=seed,
        workers=workers,
    )


def compare(
    a: Annotated[str, typer.Argument(metavar="A", help="Event file.")],
    b: Annotated[
        str | None, typer.Argument(metavar="B", help="Event file (any size), or frames (video, folder, .npy).")
    ] = None,
    frames: Annotated[str | None, typer.Option(help="Frames of the scene, to measure log-intensity changes.")] = None,
    out: Annotated[str | None, typer.Option("--out", "-o", help="Folder for compare.json and compare.png.")] = None,
    fps: Fps = None,
    timestamps: Timestamps = None,
    frames_time_unit: FramesTimeUnit = None,
    gamma: Curve = None,
    white_level: WhiteLevel = None,
    range_: Range = None,
    background: Background = None,
    frame_delay_ms: Annotated[float, typer.Option(help="Offset added to the frame times, ms.")] = 0.0,
    interval_ms: Annotated[float, typer.Option(min=0.001, help="Interval without frames, ms.")] = 20.0,
    zero_time: Annotated[
        bool, typer.Option("--zero-time", help="Start both at their first event, and frames at the first.")
    ] = False,
    size: Annotated[str | None, typer.Option(help="WIDTHxHEIGHT of both, if the files do not give it.")] = None,
    time_unit: of_events.TimeUnit = None,
    origin: of_events.Origin = None,
    columns: of_events.Columns = None,
    polarity: of_events.Polarity = None,
    stream: of_events.Stream = None,
    damaged: of_events.Damaged = "refuse",
    sort: of_events.Sort = False,
) -> int:
    """Describe a recording, or compare it with events or frames."""
    from blinkgl.io.reading import Declared, EventReading
    from blinkgl.show import compare as command

    return command.run(
        a,
        b,
        out,
        frames=frames,
        declared=Declared(
            fps=fps,
            timestamps=timestamps,
            time_unit=frames_time_unit,
            white_level=white_level,
            range=range_,
            background=background,
            damaged=damaged,
        ),
        gamma=gamma,
        frame_delay_ms=frame_delay_ms,
        interval_ms=interval_ms,
        zero_time=zero_time,
        reading=EventReading.of(time_unit, size, origin, columns, polarity, stream, damaged, sort),
    )


def calibrate(
    recording: Annotated[str, typer.Argument(metavar="RECORDING", help="Event file of a camera.")],
    out: Annotated[
        str,
        typer.Option("--out", "-o", help="Output sensor file, .yaml; the page has the same name, .html."),
    ] = "sensor.yaml",
    frames: Annotated[
        str | None,
        typer.Option(help="Frames of the scene at the camera's size (default: the recording's own)."),
    ] = None,
    still: Annotated[
        bool, typer.Option("--still", help="No frames: a static scene in constant light. Fits only noise.")
    ] = False,
    emulator: Annotated[
        str,
        typer.Option(
            "--emulator", "-e", help="esim, v2e or voltmeter; with --still also pixels: noise for any emulator."
        ),
    ] = "esim",
    sensor: Annotated[str | None, typer.Option("--sensor", help="Sensor with the initial values of the fit.")] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="key=value", help="Emulator parameter to keep fixed; may be repeated."),
    ] = None,
    fps: Fps = None,
    timestamps: Timestamps = None,
    frames_time_unit: FramesTimeUnit = None,
    gamma: Curve = None,
    white_level: WhiteLevel = None,
    range_: Range = None,
    background: Background = None,
    interpolate: Annotated[str, typer.Option(help="Between frames: motion (dense-flow warp) or linear.")] = "motion",
    max_px: Annotated[float, typer.Option(min=0.01, help="motion: largest displacement per step, px.")] = 1.0,
    frame_delay_ms: Annotated[
        float | None, typer.Option(help="Offset added to the frame times, ms (default: estimated).")
    ] = None,
    zero_time: Annotated[
        bool, typer.Option("--zero-time", help="Count events from the first, and frames from the first.")
    ] = False,
    size: Annotated[str | None, typer.Option(help="WIDTHxHEIGHT, if the recording does not give it.")] = None,
    time_unit: of_events.TimeUnit = None,
    origin: of_events.Origin = None,
    columns: of_events.Columns = None,
    polarity: of_events.Polarity = None,
    stream: of_events.Stream = None,
    damaged: of_events.Damaged = "refuse",
    sort: of_events.Sort = False,
    starts: Annotated[int, typer.Option(min=1, max=20, help="Starting points of the search.")] = 3,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the simulations and the search.")] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing output.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print no progress and no summary.")] = False,
) -> int:
    """Fit an emulator to a camera's recording. It writes a sensor file and a page about the fit."""
    from blinkgl.io.reading import EventReading
    from blinkgl.show import calibrate as command

    return command.run(
        recording,
        frames,
        out,
        still=still,
        emulator=emulator,
        sensor=sensor,
        overrides=overrides or [],
        declared=dict(
            fps=fps,
            timestamps=timestamps,
            time_unit=frames_time_unit,
            zero_time=zero_time,
            white_level=white_level,
            range=range_,
            background=background,
            damaged=damaged,
        ),
        gamma=gamma,
        interpolate=interpolate,
        max_px=max_px,
        frame_delay_ms=frame_delay_ms,
        starts=starts,
        seed=seed,
        overwrite=overwrite,
        quiet=quiet,
        events=EventReading.of(time_unit, size, origin, columns, polarity, stream, damaged, sort),
    )


def convert(
    source: Annotated[
        str,
        typer.Argument(metavar="IN", help="Event file, of any format of docs/formats.md."),
    ],
    target: Annotated[
        str | None, typer.Argument(metavar="OUT", help="Event file; its ending selects the format.")
    ] = None,
    look: Annotated[
        bool, typer.Option("--look", help="Print what IN states, what is missing, its first rows; write nothing.")
    ] = False,
    size: Annotated[str | None, typer.Option(help="WIDTHxHEIGHT, if the file does not give it.")] = None,
    zero_time: Annotated[
        bool, typer.Option("--zero-time", help="Shift times so that the first event is at 0.")
    ] = False,
    time_unit: of_events.TimeUnit = None,
    origin: of_events.Origin = None,
    columns: of_events.Columns = None,
    polarity: of_events.Polarity = None,
    stream: of_events.Stream = None,
    damaged: of_events.Damaged = "refuse",
    sort: of_events.Sort = False,
    write_unit: Annotated[
        str,
        typer.Option("--write-unit", help="Times of a .txt or .csv OUT: s (six decimals), or us (integers)."),
    ] = "s",
    triggers: Annotated[
        str | None, typer.Option("--triggers", metavar="FILE", help="Also write the triggers of IN, .csv.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing output.")] = False,
) -> int:
    """Convert an event file from one format to another."""
    from blinkgl.io.reading import EventReading
    from blinkgl.show import convert as command

    return command.run(
        source,
        target,
        reading=EventReading.of(time_unit, size, origin, columns, polarity, stream, damaged, sort),
        zero_time=zero_time,
        write_unit=write_unit,
        overwrite=overwrite,
        triggers=triggers,
        look=look,
    )


def import_(
    source: Annotated[
        str, typer.Argument(metavar="SCENE", help=".blend, .fbx, .usd/.usda/.usdc/.usdz, .dae, .abc or .obj.")
    ],
    out: Annotated[str, typer.Option("--out", "-o", help="Output GLB.")],
    scene: Annotated[
        str | None, typer.Option("--scene", help="Name of the file's scene (default: the active one).")
    ] = None,
    frames: Annotated[
        tuple[int, int] | None,
        typer.Option("--frames", metavar="FIRST LAST", help="Range of frames (default: the scene's)."),
    ] = None,
    fps: Annotated[
        float | None,
        typer.Option("--fps", help="Frames per second (default: the file's; 24 for Collada)."),
    ] = None,
    keys_per_frame: Annotated[
        int,
        typer.Option(
            "--keys-per-frame", min=1, max=64, help="Fewest key frames per frame; between them motion is linear."
        ),
    ] = 1,
    bake_mb: Annotated[float, typer.Option("--bake-mb", min=1, help="Most megabytes of baked shapes.")] = 256.0,
    clips: Annotated[
        bool, typer.Option("--clips", help="One animation per action instead of one for the scene; no baking.")
    ] = False,
    time_limit: Annotated[float, typer.Option("--time-limit", min=1, help="Time limit of Blender, s.")] = 900.0,
    as_json: Annotated[bool, typer.Option("--json", help="Machine-readable output.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing output.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print no progress and no summary.")] = False,
) -> int:
    """Convert a scene of Blender or a format it reads to GLB. It needs the extra [cycles]."""
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
        bake_mb=bake_mb,
        clips=clips,
        time_limit_s=time_limit,
        overwrite=overwrite,
    )
