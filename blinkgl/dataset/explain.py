"""``blinkgl explain CONFIG``: what a run models, what it leaves out and why, and its likely cost.

The scene of one sequence is built, or its recorded frames are listed; for its cost it and the next ones are made, or
begun, in a temporary folder.
"""

from __future__ import annotations

import platform
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median

from blinkgl.config.images import ImagesConfig
from blinkgl.config.over_time import imu_count, track_times
from blinkgl.config.quality import DEFAULT, load_quality, measured_presets
from blinkgl.config.run import RunTemplate
from blinkgl.config.scene import lights_change
from blinkgl.config.sequence import RenderConfig, SequenceConfig
from blinkgl.config.timeline import DisplacementTimeline
from blinkgl.dataset.rehearsal import Cost, mean_cost, rehearsals
from blinkgl.gl import create_context
from blinkgl.imaging import FrameCamera
from blinkgl.labels import LABELS, LabelRequest, asked_for
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import sequence_scene
from blinkgl.scene.lights import is_coloured, lamps_of
from blinkgl.scene.types import Light, Scene
from blinkgl.sequence import SequenceRequest, simulate_sequence
from blinkgl.sequence.recorded import RECORDED, RecordedSequence
from blinkgl.sequence.rendered import nothing_in_view

# ---------------------------------------------------------------------------------------------------------------------
# Time steps and filters of a configuration compared with the default preset.

COMPARED = {
    "timeline": (
        "kind",
        "fps",
        "max_px",
        "percentile",
        "max_fraction_of_threshold",
    ),
    "render": ("antialiasing", "mip_bias", "anisotropy"),
}


def quality_in_words(config: SequenceConfig) -> str:
    """Return one line for ``explain``."""
    preset = load_quality(DEFAULT)
    usual = {
        "timeline": {**DisplacementTimeline().model_dump(), **preset["timeline"]},
        "render": {**RenderConfig().model_dump(), **preset["render"]},
    }
    mine = {"timeline": config.timeline.model_dump(), "render": config.render.model_dump()}
    kind, other = mine["timeline"]["kind"], usual["timeline"]["kind"]
    if kind != other:
        apart = [f"timeline: {kind} (not {other})"]
    else:
        apart = _apart("timeline", mine["timeline"], usual["timeline"])
    apart += _apart("render", mine["render"], usual["render"])
    if not apart:
        return f"{DEFAULT}, the default"
    named = "" if config.quality in (None, DEFAULT) else f"{config.quality}; "
    return f"{named}not {DEFAULT}: {', '.join(apart)}"


def error_in_words(config: SequenceConfig) -> str:
    """Return the error that the suite of ``trade`` measured for these settings, for ``explain``."""
    measured = measured_presets()
    mine = {"timeline": config.timeline.model_dump(), "render": config.render.model_dump()}
    for name, setting in measured["settings"].items():
        same = [mine[table].get(key) == setting[table].get(key) for table, keys in COMPARED.items() for key in keys]
        if all(same) and mine["timeline"]["kind"] == setting["timeline"]["kind"]:
            rows = [row for scene in measured["scenes"].values() for row in scene["settings"] if row["name"] == name]
            error, missed, extra = ([100 * row[key] for row in rows] for key in (measured["error"], "missed", "extra"))
            return (
                f"{median(missed):.0f} % missed, {median(extra):.0f} % extra, voxel grids {median(error):.0f} % apart "
                f"({min(error):.0f} to {max(error):.0f} %): medians of {len(rows)} scenes, docs/trade.md; "
                "blinkgl trade measures it for your scene"
            )
    return "not measured for these settings; blinkgl trade measures it for your scene"


def _apart(table: str, mine: Mapping[str, object], usual: Mapping[str, object]) -> list[str]:
    return [
        f"{table}.{key} {_plain(mine[key])} (not {_plain(usual[key])})"
        for key in COMPARED[table]
        if key in mine and mine[key] != usual.get(key)
    ]


def _plain(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class Pass:
    """One kind of drawing or computation; ``count`` in the whole sequence."""

    name: str
    why: str
    count: int


@dataclass
class Explanation:
    """What a run models, leaves out and costs, in words and numbers."""

    scene: dict[str, str] = field(default_factory=dict)
    passes: list[Pass] = field(default_factory=list)
    left_out: list[tuple[str, str]] = field(default_factory=list)
    frames: int = 0
    seconds: float = 0.0
    """Wall time of a sequence in a process that has made one before."""
    processor_s: float = 0.0
    """Its processor time, which hardly depends on what else the machine does."""
    bytes: int = 0
    seconds_per_simulated_second: float = 0.0
    """Processor time."""
    sequences: int = 1
    """Sequences of the run or group, which take ``run_seconds`` in one process."""
    run_seconds: float = 0.0
    machine: str = ""

    stages: dict[str, float] = field(default_factory=dict)
    """Seconds by stage, of the sequence that is explained."""

    def add(self, name: str, why: str, count: int) -> None:
        self.passes.append(Pass(name, why, count))

    def leave_out(self, *parts: tuple[str, object, str]) -> None:
        """List those parts, (name, whether it is there, why not), that are not there."""
        self.left_out += [(name, why) for name, there, why in parts if not there]


def explain(template: RunTemplate, sequence: int | None = None) -> Explanation:
    """Explain one sequence (default: the first), of a recipe its first group's. Raises the errors of generating it."""
    if "groups" in template.tree:
        used = [group for group in template.groups if group.enabled]
        result = explain(used[0].template, sequence)
        result.scene = {"group": f"{used[0].name}, the first of {len(used)}", **result.scene}
        return result
    config = template.sequence(template.sequence(0).output.first_index if sequence is None else sequence)
    index = config.output.first_index if sequence is None else sequence
    if config.frames is not None:
        result = Explanation(machine=platform.processor() or platform.machine())
        costs = rehearsals(template, index, 1, None)
        return _priced(result, costs, config, _explain_frames(config, index, template.base, costs[0], result))
    with create_context(config.gl.backend, config.gl.device) as gl:
        costs = rehearsals(template, index, config.output.sequences, gl)  # first: with empty caches, as a run begins
        scene, result = sequence_scene(config, index, template.base), Explanation(machine=gl.renderer)
        cameras = list(config.cameras())
        # Each camera with events draws the same number of event frames.
        sharing = max(sum(events for *_, events in cameras), 1)
        frames = costs[0].frames // sharing
        rate = costs[0].events / sharing * 1e9 / (scene.t1_ns - scene.t0_ns)
        told = []
        for number, name, own, events in cameras:
            # The preview is the rig's: a sensor's own configuration has none.
            whole, seen = own.model_copy(update={"preview": config.preview}), scene.seen_by(number)
            with Renderer(gl, seen, config.render) as renderer:
                one = Explanation(scene=_describe(renderer.scene, renderer, config), frames=frames)
                if events:
                    _passes(whole, seen, renderer, rate, one)
                else:
                    _frames_alone(own, seen, renderer, one)
                _left_out(whole, seen, one)
            told.append((name, one))
        units = [one for one in config.sensors or () if not one.sees]
        _join(result, told, units)
        for unit in units:
            _over_time(config.model_copy(update={"imu": unit.imu, "tracks": None}), scene, result, f"{unit.name}: ")
        # What only making it shows, such as motion too fast for the shortest step.
        if notes := [line for line in costs[0].notes if line not in (*scene.log, *scene.omissions)]:
            result.scene["when made"] = "; ".join(notes)
        return _priced(result, costs, config, (scene.t1_ns - scene.t0_ns) * 1e-9)


def _priced(result: Explanation, costs: list[Cost], config: SequenceConfig, duration: float) -> Explanation:
    """Return ``result`` with the cost of its sequence of ``duration`` s, and of its run."""
    result.seconds, result.processor_s, result.bytes = mean_cost(costs)
    result.seconds_per_simulated_second, result.stages = result.processor_s / duration, costs[0].stages
    result.sequences = config.output.sequences
    result.run_seconds = costs[0].seconds + (result.sequences - 1) * result.seconds
    return result


def _join(result: Explanation, told: list[tuple[str, Explanation]], units: Sequence[object]) -> None:
    """Add the explanations of a sequence's cameras, by name: what is said of all once, the rest with the name.

    units : the rig's inertial units, which stand alone."""
    scenes, absent = ([*one.scene.items()] for _, one in told), (one.left_out for _, one in told)
    of_all, out_of_all = _shared([*scenes]), _shared([*absent])
    result.scene |= of_all
    result.left_out += [(what, why) for what, why in out_of_all if not (units and what == "inertial unit")]
    for name, one in told:
        prefix = f"{name}: " if name else ""
        result.scene |= {prefix + key: value for key, value in one.scene.items() if (key, value) not in of_all}
        result.left_out += [(prefix + what, why) for what, why in one.left_out if (what, why) not in out_of_all]
        result.passes += [replace(p, name=prefix + p.name) for p in one.passes]
        result.frames = max(result.frames, one.frames)


def _shared(rows: Sequence[list[tuple[str, str]]]) -> list[tuple[str, str]]:
    return [row for row in rows[0] if all(row in others for others in rows)]


def _explain_frames(config: SequenceConfig, index: int, base: Path, cost: Cost, result: Explanation) -> float:
    """Explain a sequence of recorded frames, of which nothing is rendered; return its duration, s."""
    frames, probe = config.frames, simulate_sequence(SequenceRequest(config, index, base, labels=False)).alone
    assert frames is not None and isinstance(probe, RecordedSequence)
    files, flows, masks, way = probe.files, probe.flow.files, probe.flow.masks, probe.flow.direction
    duration = (len(files) - 1) / frames.fps
    between = {
        "linear": "no frames in between",
        "motion": f"at most {frames.max_px:g} px per step, dense-flow warp",
    }[frames.interpolate]
    result.scene = {
        "frames": f"{len(files)} of {probe.folder}, {probe.width}x{probe.height}, {frames.fps:g} Hz: {duration:.6g} s",
        "images": f"{files[0].name} … {files[-1].name}, {frames.gamma}",
        "flow": f"{len(flows)} files, {len(masks)} masks of occluded pixels" if flows else "none: no flow labels",
        "not used": "camera, time, timeline, scene and render: nothing is rendered",
    }
    result.frames, rate = cost.frames, cost.events / duration
    words = f"{between}; {config.events.emulator}; about {rate / 1e6:.1f} M events per simulated second"
    result.add("frames and event kernel", words, result.frames)
    request = asked_for(config.labels)
    result.leave_out(
        ("images", "images" in request, "labels.images: false"),
        (f"{way} flow", flows and f"flow_{way}" in request, "frames.flow: null, or not in labels.flow"),
        (
            "occlusion masks",
            masks and f"occlusion_{way}" in request,
            "no mask files, labels.occlusion: false, or no flow",
        ),
        ("preview", config.preview.enabled, "preview.enabled: false"),
        ("the sensor's read-out", config.readout is not None, "readout: null (no event is late or lost)"),
    )
    brought = {LABELS[name].heading for name in RECORDED}
    headings = [*(label.heading for label in LABELS.values()), "what made each event"]
    others = dict.fromkeys(heading for heading in headings if heading not in brought)
    result.left_out.append((", ".join(others), "recorded frames bring none"))
    return duration


def _living(scene: Scene) -> dict[str, str]:
    """Return rows on deforming and falling objects, if any."""
    kinds = Counter(type(p.mesh.deformer).__name__.lower() for o in scene.objects for p in o.parts if p.mesh.deformer)
    rows = {}
    if kinds:
        rows["change shape"] = ", ".join(f"{n} by {kind}" for kind, n in sorted(kinds.items()))
    if (falling := scene.dynamics) is not None:
        rows["fall"] = (
            f"{falling.bodies} by {falling.engine} {falling.version}, {falling.steps:,} steps, "
            f"{len(falling.impacts_ns)} impacts"
        )
    return rows


def _describe(scene: Scene, renderer: Renderer, config: SequenceConfig) -> dict[str, str]:
    moving = sum(not o.is_static for o in scene.objects)
    parts = [p for o in scene.objects for p in o.parts]
    textures = {id(p.material.texture): p.material.texture for p in parts if p.material.texture is not None}
    pixels = sum(t.image.shape[0] * t.image.shape[1] for t in textures.values())
    kinds = {
        category: sum(o.category == category for o in scene.objects) for category in ("object", "ground", "wall", "sky")
    }
    lit = sum(not p.material.unlit for p in parts)
    return {
        "bodies": ", ".join(f"{n} {k}{'s' if n > 1 and k != 'sky' else ''}" for k, n in kinds.items() if n)
        + f"; {moving} move",
        **_living(scene),
        "camera": f"{scene.camera.summary}, " + ("still" if scene.camera_path.is_static else "moving"),
        "triangles": f"{renderer.triangles:,}",
        "textures": f"{len(textures)}, {pixels / 1e6:.1f} Mpx",
        "light": f"{_shining(scene.light)} on {lit} of {len(parts)} parts, the others unlit"
        if lit
        else "none: every surface is unlit",
        **({"light over time": ", ".join(scene.waveforms)} if scene.waveforms else {}),
        **_fog(scene),
        "quality": quality_in_words(config),
        **({"anti-aliasing": f"{renderer.antialiasing}: {renderer.crowded}"} if renderer.crowded else {}),
        "error of the events": error_in_words(config),
        "notes": "; ".join(scene.log + nothing_in_view(scene)) or "–",
        **({"not drawn": "; ".join(scene.omissions)} if scene.omissions else {}),
    }


def _fog(scene: Scene) -> dict[str, str]:
    if scene.fog is None:
        return {}
    return {"fog": f"{scene.fog.density:g} per unit, radiance {scene.fog.radiance:g}, in event frames and images"}


def _shining(light: Light) -> str:
    """Return the lights in words."""
    if light.plain:
        return "sun and sky"
    count: Counter[str] = Counter(lamp.kind for lamp in lamps_of(light))
    words = {"sun": "sun", "point": "point light", "spot": "spot light"}
    names = [f"{count[kind]} {word}{'s' * (count[kind] > 1)}" for kind, word in words.items() if count[kind]]
    if light.sky:
        names.append("sky")
    if light.quadric is not None:
        names.append("panorama")
    if light.shadows != "off":
        names.append(f"{light.shadows} shadows")
    return ", ".join(names or ["nothing"]) + (", coloured" if is_coloured(light) else "")


def _passes(config: SequenceConfig, scene: Scene, renderer: Renderer, rate: float, result: Explanation) -> None:
    """Add every kind of drawing and computation. rate : events per simulated second."""
    result.add("event frames", f"timeline: {config.timeline.kind}", result.frames)
    if config.timeline.kind != "uniform":
        name, why = "speeds", "of surfaces, decide the step; nothing is drawn"
        if config.timeline.kind == "brightness":
            name = "brightness, and velocity of edges"
            why = f"decide the step; every {config.timeline.sample_every}. pixel; displacement misses fewer events"
        result.add(name, why, int(1.1 * result.frames))  # a step is sometimes shortened
    _pictures(config, (scene.t1_ns - scene.t0_ns) * 1e-9, result)
    _over_time(config, scene, result)
    if config.images is not None:
        result.passes.append(_frame_camera(config.images, renderer, scene))
    if (optics := config.optics) is not None:
        parts = [name for name in ("psf", "lens", "bayer") if getattr(optics, name) is not None]
        points = f", {optics.lens_points} points of the lens in each frame" if optics.lens else ""
        result.add("optics", ", ".join(parts) + points, result.frames)
    words = f"{config.events.emulator}; about {rate / 1e6:.1f} M events per simulated second"
    result.add("event kernel", words, result.frames)


def _pictures(config: SequenceConfig, duration: float, result: Explanation) -> None:
    """Add images, labels, the truth of events and the preview."""
    request, labels = asked_for(config.labels), config.time.label_count
    if "images" in request:
        why = f"images at {config.time.label_rate:g} Hz, anti-aliasing {config.render.image_antialiasing}"
        result.add("colour", why, labels + 1)
    request = request.without(*(name for name in request if LABELS[name].anti_aliased))
    if request:
        result.add("labels", ", ".join(request) + _over_intervals(request, config), labels)
    if config.labels.events:
        why = "surfaces at every event frame"
        if config.frames is None and lights_change(config.scene):
            why += ", and it again for each light that changed"
        result.add("what made each event", f"{why} (labels.events)", result.frames)
    if config.preview.enabled:
        pictures = int(duration * config.preview.rate) + 1
        result.add("preview", f"{config.preview.rate:g} pictures per simulated second", pictures)


def _frames_alone(config: SequenceConfig, scene: Scene, renderer: Renderer, result: Explanation) -> None:
    """Add what a camera without events draws."""
    _pictures(config, 0.0, result)
    _over_time(config, scene, result)
    if config.images is not None:
        result.passes.append(_frame_camera(config.images, renderer, scene))


def _over_time(config: SequenceConfig, scene: Scene, result: Explanation, prefix: str = "") -> None:
    """Add the inertial unit and the point tracks."""
    if config.imu is not None:
        count = imu_count(config.imu.rate, scene.t0_ns, scene.t1_ns)
        words = f"{count} measurements at {config.imu.rate:g} Hz, {'noisy and ' if config.imu.noisy else ''}ideal"
        result.add(f"{prefix}inertial unit", words, count)
    if config.tracks is not None:
        ends = config.time.label_times_ns[0], config.time.t1_ns, config.time.interval_ns
        moments = track_times(config.tracks.rate, *ends)
        words = f"at most {config.tracks.points} points ({config.tracks.choose}) at {len(moments)} times, float64"
        result.add("point tracks", words, len(moments))


def _over_intervals(request: LabelRequest, config: SequenceConfig) -> str:
    """Return how many of the labels lead to all times of the intervals in ``labels.flow``; "" where none do."""
    if not request.each:
        return ""
    intervals, time = request.intervals_ns, config.time
    whole = sum(
        len(request.within(time.t0_ns - t, time.t1_ns - t).intervals_ns) == len(intervals)
        for t in time.label_times_ns[: time.label_count]
    )
    seconds = ", ".join(f"{ns * 1e-9:.6g}" for ns in intervals)
    return f" (flow over {seconds} s: all of them inside the sequence for {whole} of {time.label_count} labels)"


def _frame_camera(images: ImagesConfig, renderer: Renderer, scene: Scene) -> Pass:
    """Return the pass of its images."""
    camera = FrameCamera(renderer, images, 0, (scene.t0_ns, scene.t1_ns))
    shutter = f"rows {images.row_us:g} µs apart" if images.row_us else "all rows at once"
    words = [f"{len(camera)} images, exposed {images.exposure_us:g} µs, {shutter}"]
    words += [
        name
        for name, on in (
            ("automatic exposure", images.auto_exposure is not None),
            ("lens", images.lens is not None),
            ("photon noise", images.photon_noise),
            ("read noise", images.read_noise > 0),
            ("vignetting", images.vignetting > 0),
            (f"filters {images.bayer}", images.bayer is not None),
            ("beside them " + " and ".join(images.pictures[1:]), len(images.pictures) > 1),
        )
        if on
    ]
    return Pass("frame camera", ", ".join(words), len(camera))


def _left_out(config: SequenceConfig, scene: Scene, result: Explanation) -> None:
    images, render, timeline = config.images, config.render, config.timeline.kind
    there = {LABELS[name].heading for name in asked_for(config.labels)}
    labels = {label.heading: label.off or f"labels.{label.name}: false" for label in LABELS.values()}
    result.leave_out(
        *((heading, heading in there, why) for heading, why in labels.items()),
        ("preview", config.preview.enabled, "preview.enabled: false"),
        ("inertial unit", config.imu is not None, "imu: null"),
        ("point tracks", config.tracks is not None, "tracks: null"),
        ("what made each event", config.labels.events, "labels.events: false"),
        ("light over time", bool(scene.waveforms), "no over_time: lamps and emission are constant"),
        ("optics of the event camera", config.optics is not None, "optics: null (in focus, no point spread)"),
        ("the sensor's read-out", config.readout is not None, "readout: null (no event is late or lost)"),
        ("frame camera: motion blur, noise, lens", images is not None, "images: null"),
    )
    if images is not None:
        result.leave_out(
            ("frame camera: rolling shutter", images.row_us > 0, "images.row_us: 0"),
            ("frame camera: noise", images.noisy, "images.photon_noise: false, images.read_noise: 0"),
            ("frame camera: defocus", images.lens is not None, "images.lens: null"),
            ("frame camera: automatic exposure", images.auto_exposure is not None, "images.auto_exposure: null"),
        )
    filters = render.antialiasing
    lit = any(not p.material.unlit for o in scene.objects for p in o.parts)
    zero = [name for name, value in config.events.model_dump().items() if value in (0, 0.0, False) and name != "seed"]
    shadows = config.scene.light.shadows != "off"
    result.leave_out(
        (
            "anti-aliasing of event frames",
            filters != "none",
            "render.antialiasing: none (mip-maps filter textures; edges are not filtered)",
        ),
        (
            "anti-aliasing of silhouettes",
            filters != "taps4",
            "render.antialiasing: taps4 (textures are super-sampled; edges are not filtered)",
        ),
        ("anisotropic filtering", render.anisotropy != 1, "render.anisotropy: 1"),
        ("light", lit, "every material is unlit: no normals in the vertex stream, no light in the shader"),
        ("fog", scene.fog is not None, "scene.fog: null"),
        ("velocity pass", timeline == "brightness", f"timeline: {timeline} needs none"),
        *(
            (f"{config.events.emulator}: {name}", False, f"events.{name}: {getattr(config.events, name)}".lower())
            for name in zero
        ),
        ("shadows", shadows, "scene.light.shadows: off"),
        (
            "the motion of shadows in rates of change",
            not shadows or timeline != "brightness",
            "dL/dt is that of the lit share of a surface: no edge is in it",
        ),
        ("inter-reflection", False, "BlinkGL does not model it"),
    )
