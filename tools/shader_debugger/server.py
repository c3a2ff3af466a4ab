"""``blinkgl shader serve``: the page and its routes, on the standard library's HTTP server, a thread per request.

It listens on 127.0.0.1 by default, answers only GET and HEAD of the routes below, and only when the Host header is its
own address, so that no web site can reach it by a name that resolves to 127.0.0.1 (DNS rebinding). No path becomes a
file name: the page's three files are read by their fixed names.
"""

from __future__ import annotations

import ipaddress
import json
import socket
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from urllib.parse import urlsplit

from blinkgl.errors import BlinkGLError, GLError
from blinkgl.machine.heartbeat import heartbeat
from blinkgl.tools.shader_debugger.inspector import ROUTES, Inspector, Worker, read_query
from blinkgl.tools.shader_debugger.session import Subject, When, open_folder

PAGE = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/app.js": ("app.js", "text/javascript; charset=utf-8"),
    "/style.css": ("style.css", "text/css; charset=utf-8"),
}
WAIT_S = 20.0  # longest time of a long poll
SILENT_S = 20.0  # for a header, or for an answer that the browser does not read
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
    """Return whether a Host header names this server: a local name or the bound address, with its port if any.

    If bound to every address, it accepts any literal IP address, but no name."""
    if not header or len(header) > 255:
        return False
    try:
        parts = urlsplit(f"//{header}")
        name, asked_port = (parts.hostname or "").lower(), parts.port
    except ValueError:
        return False
    if parts.username is not None or parts.path or parts.query or parts.fragment or asked_port not in (None, port):
        return False
    if name in LOCAL or name == bound.lower():
        return bool(name)
    # A literal address cannot be another site's name (DNS rebinding).
    if bound in ("0.0.0.0", "::"):
        try:
            ipaddress.ip_address(name)
            return True
        except ValueError:
            return False
    return False


class _Handler(BaseHTTPRequestHandler):
    """Answers one request and closes the connection."""

    protocol_version = "HTTP/1.1"
    server_version, sys_version = "BlinkGL", ""
    timeout = SILENT_S
    server: _Server  # type: ignore[bad-override-mutable-attribute]

    def do_GET(self) -> None:
        self.close_connection = True
        # A proxy may read two Host headers differently: refuse both.
        hosts = self.headers.get_all("Host") or [None]
        if len(hosts) != 1 or not host_allowed(hosts[0], self.server.bound, self.server.server_port):
            return self._error(403, "this Host is not served here")
        parts = urlsplit(self.path)
        try:
            if parts.path in PAGE:
                name, kind = PAGE[parts.path]
                return self._send(
                    200, resources.files("blinkgl.tools.shader_debugger").joinpath("page", name).read_bytes(), kind
                )
            if parts.path not in ROUTES:
                return self._error(404, "no such page")
            route, query = parts.path[1:], read_query(parts.path, parts.query)
            self._wait(query) if route == "wait" else self._answer(route, query)
        except BlinkGLError as error:
            self._error(400, str(error))
        except OSError:  # a browser that disconnected, or is too slow
            pass
        except Exception as error:  # noqa: BLE001 - said in the answer; the server goes on
            self._error(500, f"{type(error).__name__}: {error}")

    do_HEAD = do_GET

    def _answer(self, route: str, query: dict) -> None:
        """Send the result of the inspector's method of that name for a query: a picture and its legend, or JSON."""
        worker = self.server.worker
        made = worker.call(getattr(worker.inspector, route), query)
        if isinstance(made, tuple):
            png, legend = made
            self._send(200, png, "image/png", {"X-Legend": json.dumps(legend)})
            return
        if route == "state":
            made |= worker.call(worker.inspector.shaders) | {"version": worker.version}
        self._json(made)

    def _wait(self, query: dict) -> None:
        worker = self.server.worker
        now = worker.wait(query["version"], WAIT_S)
        self._json(worker.call(worker.inspector.shaders) | {"version": now})

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

    def log_message(self, format: str, *args: object) -> None:
        """Write no log."""


class _Server(ThreadingHTTPServer):
    """The HTTP server. Raises OSError when it cannot listen."""

    daemon_threads = True
    allow_reuse_address = True
    worker: Worker

    def __init__(self, host: str, port: int):
        self.bound = host
        # Before the socket is created: an address with colons is IPv6.
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        super().__init__((host, port), _Handler)

    def handle_error(self, request: object, client_address: object) -> None:
        """Write nothing: a browser may disconnect at any time."""


class DebugServer:
    """The running page; ``with DebugServer(…) as server: server.url``. Raises GLError when it cannot start."""

    def __init__(
        self,
        subject: Subject,
        when: When,
        shaders: str | None = None,
        host: str = "127.0.0.1",
        port: int = 0,
    ):
        # First, so that a port in use is reported before a scene is built.
        self._server = _listen(host, port)
        try:
            self._server.worker = Worker(Inspector(subject, when, shaders))
        except BaseException:
            self._server.server_close()
            raise
        self._thread = threading.Thread(target=self._server.serve_forever, name="http", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        return self._server.server_port

    @property
    def url(self) -> str:
        host = self._server.bound
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}/"

    def __enter__(self) -> DebugServer:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """End the server; waiting pages are answered first. May be called again."""
        if self._thread.is_alive():
            self._server.shutdown()
            self._thread.join()
            self._server.worker.close()
            self._server.server_close()


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


def serve(subject: Subject, when: When, shaders: str | None, host: str, port: int) -> None:
    """Serve until interrupted."""
    with DebugServer(subject, when, shaders, host, port) as server:
        print(f"{server.url}  (Ctrl-C ends it; watching {open_folder(shaders)})", flush=True)
        if host not in LOCAL:
            print("anybody who reaches this address can look: there is no password", flush=True)
        try:
            heartbeat.rest()
            threading.Event().wait()
        except KeyboardInterrupt:
            print()
