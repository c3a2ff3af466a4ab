"""The page: one time slider, with pictures and the 3-D scene in panels."""

from __future__ import annotations

import base64
import html
import re
import threading
import time
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from blinkgl.errors import BlinkGLError, printable
from blinkgl.io.atomic import write_whole
from blinkgl.io.colour import flow_colour
from blinkgl.io.images import encode_image
from blinkgl.io.records import named
from blinkgl.viewer.server import LocalServer
from blinkgl.viewer.stage import ASPECT, FOV, LAYERS, OFF, ON, Stage
from blinkgl.viewer.views import Picture, SequenceView

SPEEDS = ("1x", "1/2x", "1/5x", "1/10x", "1/20x", "1/50x", "1/100x")
_TICK_S = 0.05
_PICTURES_PX, _CONTROLS_PX = 380, 330
SPACE_WINDOWS = 5
"""A window of events in 3-D is this many times as long as in a picture, which shows its shape."""
SAVED_STEPS, SAVED_S = 40, 12.0
"""Moments in a saved file, and its duration."""


class Page:
    """The content of a server: sequences to choose from, and the chosen one at a time.

    Callbacks of the browser only request a redraw; one thread draws, so that a dragged slider shows its last position
    and not every one on the way."""

    def __init__(self, server: LocalServer):
        self.server = server
        self.folders: dict[str, Path] = {}
        self.sequence: SequenceView | None = None
        self.problem: BlinkGLError | None = None
        self._chosen: str | None = None
        self._changed, self._ended = threading.Event(), False
        self._stale = True
        server.gui.main_panel.dock_right()
        server.gui.main_panel.set_width(_CONTROLS_PX)
        server.gui.set_panel_label("BlinkGL")
        server.gui.add_markdown("Waiting for the first sequence …")

    def add(self, folder: Path) -> None:
        """Add a sequence to choose; the first is shown."""
        folder = named(folder)
        name = printable(folder.name)
        name = name if name not in self.folders else printable(str(folder))
        self.folders[name] = folder
        self._chosen = name if self._chosen is None else self._chosen
        self._stale = True
        self._changed.set()

    # ---- the thread that draws -----------------------------------------------------------------------------------

    def run(self) -> None:
        """Draw until :meth:`end`."""
        last = time.monotonic()
        while not self._ended:
            now = time.monotonic()
            if self.sequence is not None and self._playing:
                self._advance(now - last)
            last = now
            self.draw()
            self._changed.wait(_TICK_S if self.sequence is not None and self._playing else 0.5)

    def end(self) -> None:
        self._ended = True
        self._changed.set()

    def draw(self) -> None:
        """Draw what has changed. The page reports a sequence that cannot be read."""
        if not self._changed.is_set():
            return
        self._changed.clear()
        try:
            if self._stale and self._chosen is not None:
                self._stale = False
                self._open(self._chosen)
            if self.sequence is not None:
                with self.server.atomic():
                    self._show()
        except BlinkGLError as error:
            self.problem, self._playing = error, False
            self.server.gui.add_markdown(f"**cannot be shown**: {as_text(str(error))}")

    def _advance(self, seconds: float) -> None:
        later = self._time.value + 1000 * seconds * _speed(self._speed.value)
        self._time.value = round(self._time.min + (later - self._time.min) % (self._time.max - self._time.min), 2)

    # ---- one sequence --------------------------------------------------------------------------------------------

    def _open(self, name: str) -> None:
        """Build the page of a sequence, unless it exists and only the list has grown."""
        if self.sequence is not None and self.sequence.folder == self.folders[name]:
            if len(self.folders) > 1 and self._choice is None:
                self._add_choice()
            elif self._choice is not None:
                self._choice.options = tuple(self.folders)
            return
        sequence = SequenceView(self.folders[name])
        if self.sequence is not None:
            self.sequence.close()
        self.sequence = sequence
        self.server.scene.reset()
        self.server.gui.reset()
        self.stage = Stage(self.server.scene, sequence)
        self._controls(sequence)
        self._panels(sequence)
        self._look_at("world" if sequence.has_space else "events")

    def _controls(self, sequence: SequenceView) -> None:
        gui = self.server.gui
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_CONTROLS_PX)
        gui.set_panel_label("BlinkGL")
        self._choice: Any = None
        if len(self.folders) > 1:
            self._add_choice()
        gui.add_markdown(_about(sequence))
        start, end = sequence.start_us / 1000, sequence.end_us / 1000
        # 500 to 5,000 steps of a round length.
        step = 10.0 ** np.floor(np.log10((end - start) / 500))
        self._time = gui.add_slider("time, ms", start, end, float(step), start + (end - start) / 2)
        self._playing = False
        self._play = gui.add_button("play")
        self._play.on_click(lambda _: self._toggle())
        self._speed: Any = gui.add_dropdown("speed", SPEEDS, initial_value=SPEEDS[3])
        self._windows, self._layers = [], {}
        # What a sequence does not have gets no control.
        if with_events := [s for s in sequence.sensors if s.event_count]:
            usual = with_events[0].usual_window_us() / 1000
            for label, long in (("window, ms", usual), ("window in 3-D, ms", SPACE_WINDOWS * usual)):
                self._windows.append(gui.add_slider(label, 0.1, max(100.0, long), 0.1, float(long)))
        with gui.add_folder("3-D view"):
            looks = [name for name, there in (("world", sequence.has_space), ("events", with_events)) if there]
            if looks:
                look = gui.add_button_group("show", looks)
                look.on_click(lambda event: self._look_at(event.target.value))
            if sequence.has_space:
                there = [name for name in LAYERS if self.stage.has(name)]
                self._layers = {name: gui.add_checkbox(LAYERS[name], True) for name in there}
        # Only a mark is set here: the page's own thread draws, however fast a slider moves.
        for one in (self._time, *self._windows, *self._layers.values()):
            one.on_update(lambda _: self._changed.set())

    def _toggle(self) -> None:
        self._playing = not self._playing
        self._play.label = "pause" if self._playing else "play"
        self._changed.set()

    def _add_choice(self) -> None:
        self._choice = self.server.gui.add_dropdown(
            "sequence", tuple(self.folders), initial_value=self._chosen, order=-1
        )

        def chosen(_: object) -> None:
            self._chosen, self._stale = self._choice.value, True
            self._changed.set()

        self._choice.on_update(chosen)

    def _panels(self, sequence: SequenceView) -> None:
        """Add the pictures, a tab for each camera and one for each inertial unit."""
        panel = self.server.gui.add_panel()
        panel.dock_left()
        panel.set_width(_PICTURES_PX)
        self._images: dict[str, dict[str, Any]] = {}
        self._tabs = {sensor.name: panel.add_tab(sensor.name) for sensor in sequence.sensors}
        self._curves = []
        for name, unit in sequence.units.items():
            with panel.add_tab(name):
                self._curves += [self._curve(unit, *what) for what in (("rate", "rad/s"), ("acceleration", "m/s²"))]

    def _curve(self, unit: dict[str, np.ndarray], name: str, measure: str) -> tuple[Any, tuple[np.ndarray, ...]]:
        """Return a plot that is filled up to the displayed time, and its complete data."""
        t_ms = unit["t_ns"] / 1e6
        data = (t_ms, *unit[name].T)
        low, high = float(unit[name].min(initial=0)), float(unit[name].max(initial=0))
        series = ({"label": "ms"}, *({"label": a, "stroke": c, "width": 1.5} for a, c in zip("xyz", XYZ)))
        plot = self.server.gui.add_uplot(
            data,
            series,
            title=f"{name}, {measure}",
            scales={
                "x": {"time": False, "range": (float(t_ms[0]), float(t_ms[-1]))},
                "y": {"range": (low - 0.05 * (high - low + 1e-9), high + 0.05 * (high - low + 1e-9))},
            },
            height=220,
        )
        return plot, data

    # ---- a moment ------------------------------------------------------------------------------------------------

    def _show(self) -> None:
        sequence = self.sequence
        assert sequence is not None
        t_us = round(1000 * self._time.value)
        window_us, long_us = [max(1, round(1000 * one.value)) for one in self._windows] or (1, 1)
        pictures = {sensor.name: sensor.pictures(t_us, window_us) for sensor in sequence.sensors}
        for name, panels in pictures.items():
            for one in panels:
                self._picture(name, one)
        layers = [name for name, box in self._layers.items() if box.value]
        self.stage.show(t_us, long_us, pictures, layers)
        for plot, data in self._curves:
            count = max(2, int(np.searchsorted(data[0], t_us / 1000, side="right")))
            plot.data = tuple(column[:count] for column in data)

    def _picture(self, sensor: str, one: Picture) -> None:
        images = self._images.setdefault(sensor, {})
        heading = f"{one.heading} · {one.note}" if one.note else one.heading
        times = max(1, _PICTURES_PX // one.image.shape[1])  # otherwise small pictures would not be enlarged
        image = one.image.repeat(times, axis=0).repeat(times, axis=1)
        if one.heading not in images:
            with self._tabs[sensor]:
                images[one.heading] = self.server.gui.add_image(image, label=heading, jpeg_quality=85)
            return
        images[one.heading].label = heading
        if not np.array_equal(images[one.heading].image, image):
            images[one.heading].image = image

    def _look_at(self, what: str) -> None:
        """Show the world, or the events beside it, and turn every browser's view there."""
        self.stage.world.visible, self.stage.space.visible = what == "world", what == "events"
        eye, at = self.stage.views()[what]
        cameras = [client.camera for client in self.server.get_clients().values()]
        for camera in (self.server.initial_camera, *cameras):
            camera.position, camera.look_at, camera.fov = eye, at, FOV


XYZ = ("#d55e00", "#009e73", "#0072b2")
"""Vermilion, bluish green and blue of Okabe and Ito (2008): red and green are one colour to one man in twelve."""


def _speed(said: str) -> float:
    """Convert "1/10x" to 0.1."""
    whole, _, part = said.rstrip("x").partition("/")
    return float(whole) / float(part or 1)


def as_text(text: str) -> str:
    """Return Markdown that shows text of a file as text: each character but letters and digits as a reference, which
    is never syntax. viser would show HTML as it is, and read and send the file of ``![](file)``. A word joiner, which
    has no width, keeps addresses from becoming links."""
    joined = re.sub("(?=[:.@])", "\u2060", printable(text))
    return "".join(c if c.isalnum() or c == " " else f"&#{ord(c)};" for c in joined)


def _about(sequence: SequenceView) -> str:
    lines = [f"**{as_text(sequence.name)}**, {(sequence.end_us - sequence.start_us) / 1e6:g} s"]
    for sensor in sequence.sensors:
        source = sensor.source
        events = f", {sensor.event_count:,} events" if sensor.event_count else ""
        emulator = f", {as_text(source.manifest['emulator'])}" if source.manifest.get("emulator") else ""
        lines.append(f"{as_text(sensor.name)}: {source.width}x{source.height} px{events}{emulator}")
    return "  \n".join(lines)


def save(folder: Path, out: Path) -> None:
    """Write a sequence as one HTML file that plays without a server: all pictures on the left, the world and the events
    in space on the right, a legend above. Raises AssetError as :class:`SequenceView`, OutputError."""
    sequence, server = SequenceView(named(folder)), LocalServer(0)
    try:
        stage = Stage(server.scene, sequence, pictures=True)
        begins = server.initial_camera
        begins.position, begins.look_at = stage.views()["all"]
        begins.fov = FOV
        windows = [s.usual_window_us() for s in sequence.sensors if s.event_count]
        window_us = windows[0] if windows else 1
        times = np.linspace(sequence.start_us, sequence.end_us, SAVED_STEPS + 1)[1:].astype(np.int64)
        # The scene's changes are recorded as a film, which needs no server to be shown.
        film = server.get_scene_serializer()
        for t_us in times.tolist():
            pictures = {s.name: s.pictures(t_us, window_us) for s in sequence.sensors}
            stage.show(t_us, SPACE_WINDOWS * window_us, pictures)
            film.insert_sleep(SAVED_S / SAVED_STEPS)
        write_whole(out, _framed(sequence, window_us, film.as_html()))
    finally:
        server.stop()
        sequence.close()


_SAVED = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>$name</title>
<style>
body { margin: 0; height: 100vh; display: flex; flex-direction: column; font: 14px/1.4 system-ui, sans-serif }
header { display: flex; flex-wrap: wrap; gap: .2em 1.6em; align-items: center; padding: .5em 1em; color: #333 }
h1 { font-size: 1.15em; margin: 0; color: #000 }
i { display: inline-block; width: .8em; height: .8em; border-radius: 50% }
img { height: 2.6em; vertical-align: middle }
main { flex: 1; min-height: 0; display: flex; justify-content: center; align-items: center }
iframe { border: 0; width: 100%; height: 100%; max-width: calc((100vh - 4em) * $aspect); aspect-ratio: $aspect }
@media (max-aspect-ratio: 16/11) { iframe { height: auto } }
</style>
</head>
<body>
<header>
<h1>$name</h1>
<span>$about; slowed $slowed times</span>
<span><i style="background: rgb$on"></i> ON, brighter <i style="background: rgb$off"></i> OFF, darker; $window ms in the
picture, $long ms in space</span>
<span><img alt="colour wheel" src="data:image/png;base64,$wheel"> flow: hue is direction, saturation speed$full</span>
<span>drag to turn, wheel to zoom; times are of the sequence</span>
</header>
<main><iframe title="pictures, world and events"></iframe></main>
<script id="film" type="text/plain">$film</script>
<script>
document.querySelector("iframe").srcdoc = document.getElementById("film").textContent.replaceAll("<\\\\/", "</");
</script>
</body>
</html>
""")
"""A saved sequence: what it shows, in words, around viser's page."""


def _framed(sequence: SequenceView, window_us: int, film: str) -> str:
    """Return viser's page with title, units and legend around it."""
    duration_s = (sequence.end_us - sequence.start_us) / 1e6
    x, y = np.meshgrid(np.linspace(-1, 1, 61), np.linspace(-1, 1, 61))
    inside = x**2 + y**2 <= 1
    wheel = np.where(inside[..., None], flow_colour(np.stack([x, y], axis=-1).astype(np.float32), 1.0), 255)
    middle_us = (sequence.start_us + sequence.end_us) // 2
    notes = [p.note for s in sequence.sensors for p in s.pictures(middle_us, window_us) if "flow" in p.heading]
    sensors = ", ".join(
        f"{s.name} {s.source.width}x{s.source.height} px" + (f", {s.event_count:,} events" if s.event_count else "")
        for s in sequence.sensors
    )
    return _SAVED.substitute(
        name=html.escape(printable(sequence.name)),
        about=html.escape(printable(f"{duration_s:g} s; {sensors}")),
        slowed=f"{SAVED_S / duration_s:.3g}",
        on=ON,
        off=OFF,
        window=f"{window_us / 1000:g}",
        long=f"{SPACE_WINDOWS * window_us / 1000:g}",
        wheel=base64.b64encode(encode_image(wheel.astype(np.uint8))).decode(),
        full=html.escape(f", {notes[0].partition(', ')[2]}") if notes else "",
        film=film.replace("</", "<\\/"),
        aspect=f"{ASPECT:g}",
    )
