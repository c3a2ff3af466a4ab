"""viser's server, for this machine only: it listens on 127.0.0.1, serves only its own pages, and shares nothing."""

from __future__ import annotations

import contextlib
import functools
import io
import re
import socket
from collections.abc import Iterator
from typing import Any

import viser
import websockets.asyncio.server

from blinkgl.errors import ConfigError, OutputError

HOST = "127.0.0.1"
PORT = 8080
_OWN_PAGES = re.compile(r"http://(127\.0\.0\.1|localhost):\d{1,5}")


class LocalServer(viser.ViserServer):
    """A :class:`viser.ViserServer` without its tunnel, its prints and visitors from other web sites.

    port : None takes the first free one from :data:`PORT`; 0 any. Raises OutputError: the port is in use; ConfigError:
    it is not a port."""

    def __init__(self, port: int | None = None):
        if port is not None and not 0 <= port <= 65535:
            raise ConfigError("no port", where="--port", value=port, accepted="0 to 65535")
        if port:
            _check_free(port)
        with _quiet(), _only_own_pages():
            super().__init__(host=HOST, port=PORT if port is None else port, verbose=False)
        self.gui.configure_theme(show_logo=False, show_share_button=False)

    @property
    def url(self) -> str:
        return f"http://{HOST}:{self.get_port()}"

    def request_share_url(self, verbose: bool = True) -> None:
        """Do nothing: a request by viser's protocol opens no tunnel to its makers' host."""

    def stop(self) -> None:
        with _quiet():
            super().stop()


def _check_free(port: int) -> None:
    """Raise OutputError for a port in use; viser itself would take the next one."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            problem = f"cannot be listened on: {(error.strerror or str(error)).lower()}"
            raise OutputError(problem, where="--port", value=port, accepted="another, or none for a free one") from None


def _quiet() -> contextlib.AbstractContextManager:
    return contextlib.redirect_stdout(io.StringIO())


@contextlib.contextmanager
def _only_own_pages() -> Iterator[None]:
    """Accept, while a server starts, only websockets of pages from this machine. viser has no option for it, so any web
    site open in the same browser could connect and read what is shown."""
    serve = websockets.asyncio.server.serve
    own: Any = functools.partial(serve, origins=[_OWN_PAGES, None])
    websockets.asyncio.server.serve = own
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve
