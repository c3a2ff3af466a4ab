"""The page and its server, with viser itself on a free port."""

import asyncio
import contextlib
import json
import re
import shutil
import socket
import subprocess
import threading
import urllib.request
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from blinkgl.cli import run
from blinkgl.config.run import load_run
from blinkgl.dataset.run import run_dataset
from blinkgl.errors import OutputError
from blinkgl.show import generate
from recipes import RIG, SINGLE

viser = pytest.importorskip("viser", reason="the extra [view] is not installed")
websockets = pytest.importorskip("websockets", reason="the extra [view] is not installed")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A data set of a sequence of one camera, and one of a rig's."""
    root = tmp_path_factory.mktemp("made")
    for name, recipe in (("single", SINGLE), ("rig", RIG)):
        (root / f"{name}.yaml").write_text(yaml.safe_dump({**recipe, "output": {"name": name}}))
        run_dataset(load_run(root / f"{name}.yaml"), root / name)
    return SimpleNamespace(root=root, single=root / "single/train/single_000000", rig=root / "rig/train/rig_000000")


def local_server(port):
    from blinkgl.viewer.server import LocalServer

    return LocalServer(port)


@contextlib.contextmanager
def page_of(*folders):
    from blinkgl.viewer.page import Page

    server = local_server(0)
    try:
        page = Page(server)
        for folder in folders:
            page.add(folder)
        page.draw()
        yield page
    finally:
        if page.sequence is not None:
            page.sequence.close()
        server.stop()


def nodes(page, *names):
    return [name for name in names if page.server.scene.get_handle_by_name(name) is not None]


def test_a_camera_its_world_and_its_events_are_in_the_scene(made):
    with page_of(made.single) as page:
        there = ("/world/cameras/camera", "/world/points", "/world/tracks", "/events/camera/ON", "/events/camera/OFF")
        assert nodes(page, *there) == list(there)
        names = [str(n) for n in page.sequence.sensors[0].source.poses["object_names"]]
        assert nodes(page, *(f"/world/boxes/{name}" for name in names)) == [
            f"/world/boxes/{name}" for name in names if name not in ("sky", "ground")
        ]
        assert {*page._images["camera"]} == {p.heading for p in page.sequence.sensors[0].pictures(7_100_000, 1000)}
        assert len(page._curves) == 2
        assert [*page._layers] == ["points", "boxes", "tracks"]


def test_the_slider_moves_everything(made):
    with page_of(made.single) as page:
        sensor = page.sequence.sensors[0]
        frustum = page.server.scene.get_handle_by_name("/world/cameras/camera")
        for t_ms, label in ((7100, 0), (7200, 1)):
            page._time.value = float(t_ms)
            page._changed.set()
            page.draw()
            assert np.allclose(frustum.position, sensor.source.poses["T_world_cam"][label + 1][:3, 3])
            assert page._images["camera"]["depth"].label.startswith(f"depth · {t_ms}.0 ms")
            assert len(page._curves[0][0].data[0]) == (t_ms - 7000) // 10 + 1
        page._layers["points"].value = False
        page._changed.set()
        page.draw()
        assert not page.server.scene.get_handle_by_name("/world/points").visible


def test_play_goes_on_and_round(made):
    with page_of(made.single) as page:
        page._speed.value = "1x"
        page._toggle()
        assert page._play.label == "pause"
        page._time.value = page._time.max - 10
        page._advance(0.05)
        assert page._time.value == pytest.approx(page._time.min + 40)


def test_a_rig_shows_all_its_sensors_and_only_what_they_have(made):
    with page_of(made.rig) as page:
        cameras = [f"/world/cameras/{name}" for name in ("left", "right", "rgb")]
        assert nodes(page, *cameras, "/events/left/ON", "/events/right/ON", "/events/rgb/ON", "/world/tracks") == [
            *cameras, "/events/left/ON", "/events/right/ON",
        ]  # fmt: skip
        assert [*page._images["rgb"]] == ["frame camera"]
        assert [*page._layers] == ["points", "boxes"]


def test_sequences_are_chosen_and_come_while_others_are_shown(made):
    with page_of(made.single) as page:
        assert page._choice is None
        page.add(made.rig)
        page.draw()
        assert page._choice.options == ("single_000000", "rig_000000")
        assert page.sequence.folder == made.single
        page._choice.value = "rig_000000"
        page._chosen, page._stale = page._choice.value, True
        page._changed.set()
        page.draw()
        assert page.sequence.folder == made.rig
        assert nodes(page, "/world/cameras/camera", "/world/cameras/left") == ["/world/cameras/left"]


def test_the_folder_that_one_stands_in_is_shown_by_its_name(made, monkeypatch):
    monkeypatch.chdir(made.single)
    with page_of(Path()) as page:
        assert list(page.folders) == [made.single.name] == [page.sequence.name]


def test_a_damaged_sequence_is_said_on_the_page_and_the_others_stay(made, tmp_path):
    damaged = shutil.copytree(made.single, tmp_path / "damaged")
    with page_of(damaged, made.rig) as page:
        assert page.sequence is not None
        (damaged / "depth/000000.npy").write_bytes(b"")
        page.sequence.sensors[0]._known.clear()
        page._time.value = 7100.0
        page._changed.set()
        page.draw()
        assert "depth" in str(page.problem)


def test_a_run_hands_on_what_it_has_finished(made):
    seen = []
    page = SimpleNamespace(add=seen.append)
    display = SimpleNamespace(**dict.fromkeys(("begin", "message", "end"), lambda *a: seen.append(a)))
    watched = generate.Watched(page, made.root / "single", display)
    watched.begin("plan", "outcome")
    watched.message("train/x", {"kind": "progress"})
    watched.message("train/x", {"kind": "done"})
    assert seen == [
        ("plan", "outcome"), made.single, ("train/x", {"kind": "progress"}), ("train/x", {"kind": "done"}),
        made.root / "single/train/x",
    ]  # fmt: skip


# ---- this machine alone ----------------------------------------------------------------------------------------------


def test_it_listens_on_this_machine_alone_and_shares_nothing(made, monkeypatch):
    monkeypatch.setattr("viser._tunnel.ViserTunnel.__init__", lambda *a: pytest.fail("a tunnel"))
    with page_of(made.single) as page:
        assert page.server.get_host() == "127.0.0.1"
        assert page.server.request_share_url() is None
        listening = re.findall(r"^\s*\d+: (\w+):(\w+) \w+:\w+ 0A", Path("/proc/net/tcp").read_text(), re.M)
        assert [a for a, port in listening if int(port, 16) == page.server.get_port()] == ["0100007F"]
        from viser._messages import ThemeConfigurationMessage as Theme

        sent = page.server._websock_server._broadcast_buffer.message_from_id.values()
        assert [m.show_share_button for m in sent if isinstance(m, Theme)][-1] is False


def test_other_web_sites_cannot_connect():
    server = local_server(0)
    address = f"ws://127.0.0.1:{server.get_port()}"

    async def connects(origin):
        try:
            async with websockets.connect(address, origin=origin, subprotocols=["viser-v0"]):
                return True
        except websockets.exceptions.InvalidStatus:
            return False

    try:
        assert asyncio.run(connects(server.url))
        assert not asyncio.run(connects("http://evil.example"))
        assert not asyncio.run(connects(f"http://evil.example:{server.get_port()}"))
        assert not asyncio.run(connects("http://127.0.0.1.evil.example"))
        with urllib.request.urlopen(server.url) as page:
            assert b"<title>" in page.read()
    finally:
        server.stop()


def asked(port: int, head: str, connection: str = "close") -> bytes:
    """All that the server sends for raw lines of a request."""
    with socket.create_connection(("127.0.0.1", port), timeout=60) as wire:
        wire.sendall(f"{head}\r\nConnection: {connection}\r\n\r\n".encode())
        data = b""
        while part := wire.recv(1 << 16):
            data += part
    return data


@pytest.mark.parametrize(
    "path",
    ["/../../setup.cfg", "/..%2f..%2fetc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd", "/assets/../../x",
     "/.git/config", "/index.html%00.js", "/\\..\\..\\etc\\passwd"],
)  # fmt: skip
def test_only_the_page_is_served(made, path):
    with page_of(made.single) as page:
        port = page.server.get_port()
        assert b" 404 " in asked(port, f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}").split(b"\r\n")[0]


def test_a_rebound_name_gets_the_empty_page_and_nothing_of_a_sequence(made):
    """A web site whose name leads to this machine has its own origin: it gets viser's page, but no connection."""
    upgrade = "Upgrade: websocket\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13"
    with page_of(made.single) as page:
        port = page.server.get_port()
        assert made.single.name.encode() not in asked(port, f"GET / HTTP/1.1\r\nHost: evil.example:{port}")
        for origin in (
            f"http://evil.example:{port}",
            "null",
            "http://localhost:99999999",
            "file://",
            "https://localhost:1",
        ):
            head = f"GET / HTTP/1.1\r\nHost: evil.example:{port}\r\nOrigin: {origin}\r\n{upgrade}"
            assert b" 403 " in asked(port, head, "Upgrade").split(b"\r\n")[0], origin
        twice = f"GET / HTTP/1.1\r\nHost: x\r\nOrigin: http://localhost:1\r\nOrigin: http://evil.example\r\n{upgrade}"
        assert b" 400 " in asked(port, twice, "Upgrade").split(b"\r\n")[0]


MARKUP = "<img src=x onerror=alert(1)>![a](b)"


def test_markup_in_names_is_text(made, tmp_path):
    """On the live page, where viser shows Markdown and HTML as such, and in a saved one."""
    folder = tmp_path / "train" / MARKUP
    shutil.copytree(made.single, folder)
    with page_of(folder) as page:
        texts = [str(vars(sent)) for sent in page.server._websock_server._broadcast_buffer.message_from_id.values()
                 if "Markdown" in type(sent).__name__ or "Html" in type(sent).__name__]  # fmt: skip
        assert texts and all("<img" not in text and "![" not in text for text in texts)
        assert any("&#60;img" in text for text in texts)
    assert run(["view", str(folder), "--save", str(tmp_path / "page.html")]) == 0
    assert "<img src=x" not in (tmp_path / "page.html").read_text()


def test_a_port_in_use_is_refused():
    server = local_server(0)
    try:
        with pytest.raises(OutputError, match=r"--port: cannot be listened on: address already in use"):
            local_server(server.get_port())
    finally:
        server.stop()


# ---- the command -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["/nowhere"], "no such folder"),
        (["{root}/single", "--port", "70000"], "--port: no port (got 70000); expected 0 to 65535"),
        (["{root}/single", "--save", "x.png"], "--save: not the name of a page (got 'x.png')"),
        (["{root}/single", "{root}/rig", "--save", "x.html"], "--save: a file shows one sequence (got 2)"),
        (["{root}/single", "--save", "x.html", "--port", "1"], "--port: this is an option of the server"),
        (["{root}/single", "--save", "{root}/single.html"], "output file exists"),
        (["{root}/empty"], "the folder has no sequence"),
    ],
)
def test_bad_input_is_refused_in_one_line(made, arguments, said, capsys):
    (made.root / "single.html").touch()
    (made.root / "empty").mkdir(exist_ok=True)
    assert run(["view", *(a.format(root=made.root) for a in arguments)]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("arguments", [["view", "x"], ["generate", "demo", "--out", "{tmp}/never", "--view"]])
def test_without_viser_it_says_how_to_install_it(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert run([a.format(tmp=tmp_path) for a in arguments]) == 2
    assert "viser, which shows sequences, is not installed" in (said := capsys.readouterr().err)
    assert "pip install 'viser>=1.1,<2'" in said
    assert not (tmp_path / "never").exists()


def test_a_saved_page_is_whole_and_asks_nobody(made, tmp_path, capsys):
    out = tmp_path / "rig.html"
    assert run(["view", str(made.root / "rig"), "--save", str(out)]) == 0
    text = out.read_text()
    assert "__VISER_EMBED_DATA__=" in text
    words = ("<title>", "ON, brighter", "hue is direction", "ms in space", "full colour", " px, ", " events")
    assert [word for word in words if word not in text] == [], "title, units and legend"
    assert text.count("</script>") == 2, "viser's own page is inside, as text"
    assert not re.search(r"<(?:script|link|img|iframe)[^>]+(?:src|href)=[\"']?(?:https?:)?//", text)
    assert str(out) in capsys.readouterr().out
    assert [path.name for path in tmp_path.iterdir()] == ["rig.html"]


@pytest.mark.slow
@pytest.mark.parametrize("saved", [False, True])
def test_a_browser_shows_it_and_asks_this_machine_alone(made, tmp_path, saved):
    """Headless Chromium draws the page; its log of the network names no other host."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium")
    if saved:
        assert run(["view", str(made.single), "--save", str(tmp_path / "x.html")]) == 0
    with page_of(made.single) as page:
        thread = threading.Thread(target=page.run, daemon=True)
        thread.start()
        address = f"file://{tmp_path}/x.html" if saved else page.server.url
        subprocess.run(
            [
                browser, "--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader",
                "--enable-unsafe-swiftshader", "--disable-background-networking", "--disable-component-update",
                "--disable-sync", "--no-first-run", f"--user-data-dir={tmp_path}/profile",
                "--virtual-time-budget=8000", f"--log-net-log={tmp_path}/net.json",
                f"--screenshot={tmp_path}/shot.png", address,
            ],
            check=True, capture_output=True, timeout=600,
        )  # fmt: skip
        page.end()
        thread.join()
    import cv2

    shot = cv2.imread(str(tmp_path / "shot.png"))
    assert len(np.unique(shot.reshape(-1, 3), axis=0)) > 500
    log = json.loads((tmp_path / "net.json").read_text())["events"]
    asked = [event["params"] for event in log if "initiator" in event.get("params", ())]
    # What Chromium asks its makers for by itself has no page as its origin.
    assert {one["url"] for one in asked if one["initiator"] != "not an origin"} == (
        set() if saved else {f"ws{page.server.url.removeprefix('http')}/"}
    )
