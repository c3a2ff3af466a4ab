"""``blinkgl shader serve``: the page and its few routes, over the standard library's HTTP handler.

Listens on 127.0.0.1 unless told otherwise, answers only GET and HEAD of the routes below, and only when the Host header
is its own address, so that no web site can reach it through a name that resolves to 127.0.0.1 (DNS rebinding). No path
is ever turned into a file name: the page's three files are read by their fixed names.

One thread collects requests, whoever sends them however slowly, and hands them over when their header is there: clients
that say nothing hold no thread. What they can hold is bounded: connections, bytes of header,
seconds, threads, and pages that wait.
"""

from __future__ import annotations

import io
import ipaddress
import json
import select
import selectors
import socket
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler
from importlib import resources
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from blinkgl.errors import BlinkGLError, GLError
from blinkgl.shader_debugger.inspector import Inspector, Worker
from blinkgl.shader_debugger.questions import ROUTES, read_query
from blinkgl.shader_debugger.session import Subject, When

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

PAGE = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/app.js": ("app.js", "text/javascript; charset=utf-8"),
    "/style.css": ("style.css", "text/css; charset=utf-8"),
}
WAIT_S = 20.0  # a long poll's patience
LOOK_S = 0.5  # between two looks at whether the page that waits is still there
HEADER_S = 5.0  # for a whole header
SEND_S = 20.0  # for a whole answer
MOST_HEADER = 16_384  # bytes
MOST_OPEN = 64  # connections whose header is not there yet; the oldest gives way
THREADS = 12  # requests answered at a time
MOST_QUEUED = 64  # more get 503
MOST_WAITING = 8  # of THREADS, pages that wait for an edit; more get 503
LOCAL = ("127.0.0.1", "localhost", "::1")
HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "X-Frame-Options": "DENY",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'",
}


def host_allowed(header: str | None, bound: str, port: int) -> bool:
    """Whether a Host header names this server: a local name or the bound address, with its port if any.

    Bound to every address, any literal IP address will do, but no name."""
    if not header or len(header) > 255:
        return False
    try:
        parts = urlsplit(f"//{header}")
        name, given = (parts.hostname or "").lower(), parts.port
    except ValueError:
        return False
    if parts.username is not None or parts.path or parts.query or parts.fragment or given not in (None, port):
        return False
    if name in LOCAL or name == bound.lower():
        return bool(name)
    if bound in ("0.0.0.0", "::"):
        try:
            ipaddress.ip_address(name)
            return True
        except ValueError:
            return False
    return False


class _Handler(BaseHTTPRequestHandler):
    """Answers one request, whose header has been read, and closes the connection."""

    protocol_version = "HTTP/1.1"
    server_version, sys_version = "BlinkGL", ""
    timeout = SEND_S
    server: _Server

    def __init__(self, header: bytes, connection: socket.socket, address, server: _Server):
        self._header = header
        super().__init__(connection, address, server)

    def setup(self) -> None:
        super().setup()
        self.rfile.close()
        self.rfile = io.BytesIO(self._header)

    def do_GET(self) -> None:
        self.close_connection = True
        hosts = self.headers.get_all("Host") or [None]
        if len(hosts) != 1 or not host_allowed(hosts[0], self.server.bound, self.server.address[1]):
            return self._error(403, "this Host is not served here")
        parts = urlsplit(self.path)
        try:
            if parts.path in PAGE:
                name, kind = PAGE[parts.path]
                return self._send(200, resources.files(__package__).joinpath("page", name).read_bytes(), kind)
            if parts.path not in ROUTES:
                return self._error(404, "no such page")
            getattr(self, "_" + parts.path[1:])(read_query(parts.path, parts.query))
        except BlinkGLError as error:
            self._error(400, str(error))
        except OSError:  # a browser that left in the middle, or takes for ever
            pass
        except Exception as error:  # noqa: BLE001 - said in the answer; the server goes on
            self._error(500, f"{type(error).__name__}: {error}")

    do_HEAD = do_GET

    def _state(self, query: dict) -> None:
        worker = self.server.worker
        self._json(
            worker.call(worker.inspector.state) | worker.call(worker.inspector.shaders) | {"version": worker.version}
        )

    def _image(self, query: dict) -> None:
        self._picture(self.server.worker.inspector.image, query)

    def _difference(self, query: dict) -> None:
        self._picture(self.server.worker.inspector.difference, query)

    def _picture(self, make, query: dict) -> None:
        png, legend = self.server.worker.call(make, query)
        self._send(200, png, "image/png", {"X-Legend": json.dumps(legend)})

    def _probe(self, query: dict) -> None:
        worker = self.server.worker
        self._json(worker.call(worker.inspector.probe, query))

    def _verdict(self, query: dict) -> None:
        worker = self.server.worker
        self._json(worker.call(worker.inspector.verdict, query))

    def _wait(self, query: dict) -> None:
        worker = self.server.worker
        if not self.server.waiting.acquire(blocking=False):
            self._error(503, f"{MOST_WAITING} pages wait already")
            return
        try:
            until = time.monotonic() + WAIT_S
            while (now := worker.wait(query["version"], LOOK_S)) == query["version"] and time.monotonic() < until:
                if self._left():
                    return
        finally:
            self.server.waiting.release()
        self._json(worker.call(worker.inspector.shaders) | {"version": now})

    def _left(self) -> bool:
        """Whether the browser has closed the connection: a page that was reloaded waits no more."""
        look = select.poll()  # select() takes no descriptors above 1023
        look.register(self.connection, select.POLLIN)
        return bool(look.poll(0)) and self.connection.recv(1, socket.MSG_PEEK) == b""

    def _json(self, value) -> None:
        self._send(200, json.dumps(value).encode(), "application/json")

    def _error(self, status: int, text: str) -> None:
        self._send(status, json.dumps({"error": text}).encode(), "application/json")

    def _send(self, status: int, body: bytes, kind: str, more: dict[str, str] | None = None) -> None:
        self.send_response(status)
        for name, value in {"Content-Type": kind, "Content-Length": str(len(body)), **HEADERS, **(more or {})}.items():
            self.send_header(name, value)
        self.send_header("Connection", "close")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def log_message(self, *arguments) -> None:
        """Quiet."""


@dataclass
class _Arriving:
    """A connection whose header is on its way."""

    connection: socket.socket
    address: tuple
    until: float
    header: bytearray = field(default_factory=bytearray)


class _Server:
    """Collects headers in one thread, :meth:`run`, and has a few others answer. Raises
    OSError when it cannot listen."""

    worker: Worker

    def __init__(self, host: str, port: int):
        self.bound = host
        self.socket = socket.create_server(
            (host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET, backlog=128
        )
        self.socket.setblocking(False)
        self.address = self.socket.getsockname()
        self.waiting = threading.BoundedSemaphore(MOST_WAITING)
        self._places = threading.BoundedSemaphore(THREADS + MOST_QUEUED)
        self._pool = ThreadPoolExecutor(THREADS, thread_name_prefix="http")
        self._selector = selectors.DefaultSelector()
        self._wake, self._woken = socket.socketpair()
        self._selector.register(self.socket, selectors.EVENT_READ)
        self._selector.register(self._woken, selectors.EVENT_READ)
        self._arriving: dict[socket.socket, _Arriving] = {}  # oldest first

    def run(self) -> None:
        """Until :meth:`stop`."""
        while True:
            soonest = min((one.until for one in self._arriving.values()), default=None)
            for key, _ in self._selector.select(None if soonest is None else max(0.0, soonest - time.monotonic())):
                if key.fileobj is self._woken:
                    return
                if key.fileobj is self.socket:
                    self._accept()
                elif key.fileobj in self._arriving:
                    self._receive(self._arriving[key.fileobj])
            now = time.monotonic()
            for one in [one for one in self._arriving.values() if one.until <= now]:
                self._forget(one).close()

    def stop(self) -> None:
        """Ends :meth:`run`. Safe in any thread."""
        self._wake.send(b".")

    def close(self) -> None:
        """After :meth:`run` has ended and the worker has been closed: waits for the answers that are being written."""
        self._pool.shutdown(cancel_futures=True)
        for one in list(self._arriving.values()):
            self._forget(one).close()
        self._selector.close()
        for end in (self.socket, self._wake, self._woken):
            end.close()

    def _accept(self) -> None:
        try:
            connection, address = self.socket.accept()
        except OSError:  # gone again, or out of descriptors
            return
        connection.setblocking(False)
        if len(self._arriving) >= MOST_OPEN:
            self._forget(next(iter(self._arriving.values()))).close()
        self._arriving[connection] = _Arriving(connection, address, time.monotonic() + HEADER_S)
        self._selector.register(connection, selectors.EVENT_READ)

    def _receive(self, one: _Arriving) -> None:
        try:
            data = one.connection.recv(65_536)
        except BlockingIOError:
            return
        except OSError:
            self._forget(one).close()
            return
        one.header += data
        if not data:
            self._forget(one).close()
        elif len(one.header) > MOST_HEADER:
            _refuse(self._forget(one), "431 Request Header Fields Too Large")
        elif b"\r\n\r\n" in one.header or b"\n\n" in one.header:
            connection = self._forget(one)
            if not self._places.acquire(blocking=False):
                _refuse(connection, "503 Service Unavailable")
                return
            self._pool.submit(self._answer, bytes(one.header), connection, one.address)

    def _forget(self, one: _Arriving) -> socket.socket:
        self._selector.unregister(one.connection)
        return self._arriving.pop(one.connection).connection

    def _answer(self, header: bytes, connection: socket.socket, address: tuple) -> None:
        try:
            with connection:
                _Handler(header, connection, address, self)
        except OSError:
            pass  # a browser that leaves in the middle is no news
        finally:
            self._places.release()


def _refuse(connection: socket.socket, status: str) -> None:
    """Says so, if the connection takes it at once, and closes."""
    with connection:
        try:
            connection.send(f"HTTP/1.1 {status}\r\nContent-Length: 0\r\nConnection: close\r\n\r\n".encode())
        except OSError:
            pass


class DebugServer:
    """The running page; ``with DebugServer(…) as server: server.url``. Raises GLError when it cannot start."""

    def __init__(
        self,
        subject: Subject,
        when: When,
        shaders: str | None = None,
        host: str = "127.0.0.1",
        port: int = 0,
        step_us: float | None = None,
    ):
        self._server = _listen(host, port)
        try:
            self._server.worker = Worker(Inspector(subject, when, shaders, step_us))
        except BaseException:
            self._server.close()
            raise
        self._thread = threading.Thread(target=self._server.run, name="http", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        return self._server.address[1]

    @property
    def url(self) -> str:
        host = self._server.bound
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}/"

    @property
    def folder(self) -> Traversable:
        """Where the shaders are read."""
        return self._server.worker.inspector.folder

    def __enter__(self) -> DebugServer:
        return self

    def __exit__(self, *exc: object) -> None:
        self._server.stop()
        self._thread.join()
        self._server.worker.close()
        self._server.close()


def _listen(host: str, port: int) -> _Server:
    try:
        return _Server(host, port)
    except OSError as error:
        raise GLError(
            f"cannot listen: {error.strerror or error}",
            where="serve",
            value=f"{host}:{port}",
            accepted="a free port of this machine; 0 takes any",
        ) from None


def serve(
    subject: Subject, when: When, shaders: str | None, host: str, port: int, step_us: float | None = None
) -> None:
    """Serves until interrupted."""
    with DebugServer(subject, when, shaders, host, port, step_us) as server:
        folder = server.folder
        print(f"{server.url}  (Ctrl-C ends it; watching {getattr(folder, 'path', folder)})", flush=True)
        if host not in LOCAL:
            print("anybody who reaches this address can look: there is no password", flush=True)
        try:
            threading.Event().wait()
        except KeyboardInterrupt:
            print()
