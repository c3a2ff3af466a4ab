"""serve: routes and refusals over plain HTTP, live reload, and the page in a real browser."""

from __future__ import annotations

import html
import http.client
import io
import json
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from debugger_scene import HEIGHT, WIDTH, copy_shaders, edit
from PIL import Image

from blinkgl.tools.shader_debugger.filters import filtered_names
from blinkgl.tools.shader_debugger.moments import buffers_of
from blinkgl.tools.shader_debugger.server import LOCAL, DebugServer, host_allowed
from blinkgl.tools.shader_debugger.session import moment, open_subject


@pytest.fixture(scope="module")
def served(config, tmp_path_factory):
    """(server, its folder of shaders)"""
    folder = copy_shaders(tmp_path_factory.mktemp("served"))
    subject = open_subject(config)
    with DebugServer(subject, moment(subject), str(folder)) as server:
        yield server, folder


def buffers(config: str) -> dict:
    """What the page has of this configuration."""
    subject = open_subject(config)
    return buffers_of(subject.scene, filtered_names(subject.config, subject.scene))


def ask(server, path: str, method: str = "GET", host: str | None = None):
    """(status, headers, body). Paths go over the wire as they are."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=600)
    # As it stands, not as http.client likes it.
    connection._encode_request = lambda request: request.encode("utf-8", "surrogateescape")
    connection._validate_path = lambda path: None
    connection.putrequest(method, path, skip_host=True)
    if host != "":
        connection.putheader("Host", host or f"127.0.0.1:{server.port}")
    connection.endheaders()
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, answer.headers, body


def as_json(server, path: str):
    status, _, body = ask(server, path)
    assert status == 200, body
    return json.loads(body)


# ------------------------------------------------------------------------------------------------- routes


def test_page_and_state(served, config):
    server, _ = served
    for path, kind in (("/", "text/html"), ("/app.js", "text/javascript"), ("/style.css", "text/css")):
        status, headers, body = ask(server, path)
        assert status == 200 and headers["Content-Type"].startswith(kind) and len(body) > 500
        assert "default-src 'none'" in headers["Content-Security-Policy"]
        text = body.decode()
        assert "//cdn" not in text and "https://" not in text and "http://" not in text  # works offline
    state = as_json(server, "/state")
    assert (state["width"], state["height"], state["generation"], state["errors"]) == (WIDTH, HEIGHT, 1, [])
    assert [p["name"] for p in state["passes"]] == [*buffers(config)]
    status, _, body = ask(server, "/", "HEAD")
    assert status == 200 and body == b""


def test_every_buffer_as_a_picture_from_both_sides(served, config):
    server, _ = served
    for name in buffers(config):
        for source in ("gpu", "reference"):
            status, headers, body = ask(server, f"/image?pass={name}&source={source}&t=0.1")
            assert status == 200, body
            assert Image.open(io.BytesIO(body)).size == (WIDTH, HEIGHT)
            assert json.loads(headers["X-Legend"])["kind"] in ("bar", "wheel", "ids", "mask", "light", "unit", "uv")


def test_colours_range_and_component(served):
    server, _ = served
    _status, headers, body = ask(server, "/image?pass=flow_forward&component=x&map=gray&low=-10&high=10&t=0.1")
    legend = json.loads(headers["X-Legend"])
    assert (legend["low"], legend["high"], legend["map"]) == (-10.0, 10.0, "gray")
    u = next(row for row in as_json(server, "/probe?t=0.1&x=35&y=40")["buffers"] if row["name"] == "flow_forward")
    shown = np.asarray(Image.open(io.BytesIO(body)))[40, 35, 0]
    assert shown == pytest.approx(255 * (u["gpu"][0] + 10) / 20, abs=1.5)


def test_difference_of_gpu_and_reference_is_small_and_of_two_passes_is_not(served):
    server, _ = served
    _, headers, _ = ask(server, "/difference?a=depth:gpu&b=depth:reference&t=0.2")
    assert json.loads(headers["X-Legend"])["unit"] == "world units"
    _, headers, body = ask(server, "/difference?a=flow_forward:gpu&b=flow_backward:gpu&t=0.1")
    assert json.loads(headers["X-Legend"])["high"] > 5
    status, _, body = ask(server, "/difference?a=flow_forward:gpu&b=depth:gpu&t=0.1")
    assert status == 400 and "components" in json.loads(body)["error"]


@pytest.mark.parametrize(
    "path, words",
    [
        ("/image?pass=nothing", "unknown pass"),
        ("/image?pass=depth&t=99", "outside the sequence"),
        ("/image?pass=depth&t=x", "not a time"),
        ("/image?pass=depth&source=disk", "unknown source"),
        ("/image?pass=depth&map=../x", "unknown colour map"),
        ("/image?pass=depth&low=nan", "not a number"),
        ("/image?pass=velocity&component=w", "no such component"),
        ("/probe?x=1", "not a pixel"),
        ("/probe?x=96&y=0", "outside the image"),
        ("/difference?a=depth", "unknown source"),
        ("/image?pass=depth&t=1e308", "outside the sequence"),
        ("/wait?version=²", "not a version"),
        ("/wait?version=" + "9" * 30, "not a version"),
        ("/probe?x=%C2%B2&y=1", "not a pixel"),
        ("/probe?x=" + "9" * 1900 + "&y=1", "outside the image"),
        ("/image?pass=depth&low=-1e308&high=1e308", "not a number"),
        ("/image?pass=depth&pass=id", "asked twice"),
        ("/image?pass=depth&size=3", "unknown parameter"),
        ("/image?pass=" + "x" * 3000, "too long"),
        ("/difference?a=depth:gpu&b=local:gpu", "components"),
    ],
)
def test_bad_questions_get_400_and_one_line(served, path, words):
    status, headers, body = ask(served[0], path)
    assert status == 400 and headers["Content-Type"] == "application/json"
    error = json.loads(body)["error"]
    assert words in error and "\n" not in error and "Traceback" not in error


@pytest.mark.parametrize(
    "path",
    [
        "/../setup.cfg",
        "/..%2fserver.py",
        "/page/app.js",
        "/%2e%2e/%2e%2e/etc/passwd",
        "/app.js/../../cli.py",
        "//etc/passwd",
        "/index.html",
        "/favicon.ico",
        "/state/",
        "/STATE",
        "/shaders/label.glsl",
        "/app.js%00",
        "/.git/config",
        "/proc/self/environ",
    ],
)
def test_unknown_routes_and_traversal_get_404(served, path):
    status, _, body = ask(served[0], path)
    assert status == 404 and json.loads(body) == {"error": "no such page"}


def test_foreign_hosts_are_refused(served):
    server, _ = served
    for host in (
        "evil.example",
        f"evil.example:{server.port}",
        "127.0.0.1.evil.example",
        f"127.0.0.1:{server.port + 1}",
        "",
        "localhost@evil.example",
        "0.0.0.0",
        "169.254.169.254",
        "[::1",
        "127.0.0.1/x",
        "localhost.",
        "127.1",
    ):
        status, _, body = ask(server, "/state", host=host)
        assert status == 403 and b"passes" not in body, host
    with socket.create_connection(("127.0.0.1", server.port), timeout=600) as wire:  # two of them, the first one local
        wire.sendall(b"GET /state HTTP/1.1\r\nHost: localhost\r\nHost: evil.example\r\n\r\n")
        assert b" 403 " in wire.recv(100)
    for host in (f"localhost:{server.port}", "127.0.0.1", f"[::1]:{server.port}", "LOCALHOST"):
        assert ask(server, "/state", host=host)[0] == 200, host


def test_hosts_of_other_bindings():
    assert host_allowed("box.lan:80", "box.lan", 80) and not host_allowed("other.lan:80", "box.lan", 80)
    assert host_allowed("192.168.1.7:80", "0.0.0.0", 80) and not host_allowed("evil.example:80", "0.0.0.0", 80)
    assert not host_allowed(None, "127.0.0.1", 80) and not host_allowed("a" * 300, "127.0.0.1", 80)
    assert all(host_allowed(f"[{n}]" if ":" in n else n, "127.0.0.1", 80) for n in LOCAL)


def test_a_taken_port_is_one_line_and_2(served, shader, config):
    status, out, err = shader("serve", config, "--port", served[0].port)
    assert (status, out) == (2, "") and err.startswith("error: serve: cannot listen") and err.count("\n") == 1


# ------------------------------------------------------------------------------------------------- reloading


def next_version(server, version: int) -> dict:
    """What the page learns, and within a second of the edit (plus the time this machine takes to draw)."""
    for _ in range(3):
        now = as_json(server, f"/wait?version={version}")
        if now["version"] != version:
            return now
    raise AssertionError("the edit was not noticed")


def depth_at(server) -> float:
    row = next(b for b in as_json(server, "/probe?t=0.1&x=35&y=40")["buffers"] if b["name"] == "depth")
    return row["gpu"]


def test_edits_are_taken_errors_keep_the_last_good_program(served):
    server, folder = served
    label = folder / "include/labels/depth.glsl"
    good = label.read_text()
    state = as_json(server, "/state")
    before = depth_at(server)

    edit(label, "1.0 / INVERSE_DEPTH", "2.0 / INVERSE_DEPTH")
    now = next_version(server, state["version"])
    assert now["errors"] == [] and now["generation"] == state["generation"] + 1
    assert depth_at(server) == pytest.approx(2 * before, rel=1e-6)
    occluded = next(b for b in as_json(server, "/probe?t=0.1&x=35&y=40")["buffers"] if b["name"] == "occluded_forward")
    assert occluded["gpu"] in (True, False)

    edit(label, "2.0 / INVERSE_DEPTH", "2.0 / INVERSE_DEPHT")
    broken = next_version(server, now["version"])
    line = next(i for i, text in enumerate(label.read_text().splitlines(), 1) if "INVERSE_DEPHT" in text)
    error = broken["errors"][0]
    assert broken["generation"] == now["generation"]
    assert (
        error["where"].startswith(f"include/labels/depth.glsl:{line}:")
        and "INVERSE_DEPHT" in error["text"]
        and "^" in error["excerpt"]
    )
    assert depth_at(server) == pytest.approx(2 * before, rel=1e-6)  # the last good program

    vertex = folder / "include/vertex.glsl"
    whole = vertex.read_text()
    edit(vertex, "vec3 position = in_position;", "vec3 position = vec3(0.0);")
    label.write_text(good)
    unused = next_version(server, broken["version"])
    assert unused["generation"] == now["generation"]
    assert "the shader no longer uses 'in_position'" in unused["errors"][0]["text"]

    vertex.write_text(whole)
    mended = next_version(server, unused["version"])
    assert mended["errors"] == [] and mended["generation"] == now["generation"] + 1
    assert depth_at(server) == before


def test_broken_from_the_start_is_one_error(shader, config, tmp_path):
    folder = copy_shaders(tmp_path)
    edit(folder / "luminance.glsl", "luminance = albedo;", "luminance = albedo")
    status, out, err = shader("serve", config, "--shaders", folder, "--port", 0)
    assert status == 2 and out == "" and err.startswith("error: luminance.glsl:")


def test_the_end_does_not_wait_for_long_polls(config):
    """Pages that wait for an edit are answered at once, and their threads are gone."""
    subject = open_subject(config)
    with ThreadPoolExecutor(2) as pages, DebugServer(subject, moment(subject)) as server:
        polls = [pages.submit(ask, server, "/wait?version=1") for _ in range(2)]
        while sum("process_request_thread" in thread.name for thread in threading.enumerate()) < 2:
            time.sleep(0.01)
        server.close()
        assert all(poll.result()[0] == 400 for poll in polls)


@pytest.fixture
def interruptible_children():
    """Where the suite itself runs in a shell's background SIGINT is ignored, and children would inherit that."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible_children")
def test_the_command_says_where_and_ends_on_interrupt(config):
    child = subprocess.Popen(
        [sys.executable, "-m", "blinkgl.cli", "shader", "serve", config, "--port", "0"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        line = child.stdout.readline()
        assert line.startswith("http://127.0.0.1:") and "Ctrl-C" in line, (child.kill(), child.communicate())
        host, port = line.split()[0].removeprefix("http://").rstrip("/").split(":")
        connection = http.client.HTTPConnection(host, int(port), timeout=600)
        connection.request("GET", "/state")
        assert json.load(connection.getresponse())["width"] == WIDTH
        connection.close()
        child.send_signal(signal.SIGINT)
        _out, err = child.communicate(timeout=600)
    finally:
        child.kill()
    assert child.returncode == 0 and err == ""


# ------------------------------------------------------------------------------------------------- the page


def page_of(server, *settings: str) -> str:
    """The page as Chromium has it when nothing is loading any more."""
    flags = ("--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=60000", "--dump-dom")
    command = ["chromium", *flags, f"{server.url}#{'&'.join(('still', *settings))}"]
    return subprocess.run(command, capture_output=True, text=True, timeout=600).stdout


@pytest.mark.skipif(shutil.which("chromium") is None, reason="no chromium (Debian: apt-get install chromium)")
def test_the_page_in_chromium(served, shader, config):
    """Values of a pixel are those of the command line; a verdict on good shaders, and on broken ones."""
    server, folder = served
    page = page_of(server, "fault", "t=0.3", "x=40", "y=45")
    assert 'data-ready="yes"' in page and 'data-shown="0.3"' in page and "all 29 buffers agree" in page
    status, out, _ = shader("probe", config, "--shaders", folder, "--time", 0.3, "--pixel", "40,45")
    assert status == 0
    for name, info in buffers(config).items():
        if name in ("triangle", "local"):
            continue
        line = next(row[3:] for row in out.splitlines() if row[3:].startswith(f"{info.title} "))
        for side in ("gpu", "reference"):
            value = html.unescape(re.search(rf'data-{side}="{name}"[^>]*>([^<]+)<', page)[1])
            assert f" {value} " in line, (name, side, value, line)
    good = (folder / "include/albedo.glsl").read_text()
    version = as_json(server, "/state")["version"]
    edit(folder / "include/albedo.glsl", "return texture(albedo, uv).C", "return texture(albedo, uv, 1.0).C")
    next_version(server, version)
    page = page_of(server, "fault")
    (folder / "include/albedo.glsl").write_text(good)
    assert "level of luminance" in page and "a mip bias of +1" in page
