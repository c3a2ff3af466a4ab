"""``blinkgl view``: print the page's address, or the file that was written."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from blinkgl.errors import ConfigError, OutputError
from blinkgl.io.atomic import refuse_file
from blinkgl.machine.extras import EXTRAS, install
from blinkgl.machine.heartbeat import heartbeat
from blinkgl.machine.terminal import plain_console, say


def run(sequences: Sequence[str], *, port: int | None = None, save: str | None = None, overwrite: bool = False) -> int:
    """Serve the sequences until interrupted, or write one of them as a file. Raises ConfigError: no viser, more than
    one sequence for a file; AssetError: no sequence; OutputError: a port in use, a file that exists."""
    check_extra("view")
    from blinkgl.viewer.views import sequences_in

    folders = [folder for path in sequences for folder in sequences_in(path)]
    console = plain_console()
    if save is not None:
        return _save(console, folders, Path(save), port, overwrite)
    from blinkgl.viewer.page import Page
    from blinkgl.viewer.server import LocalServer

    # The port is taken first: who waits for a large set wants to know at once that it is not free.
    server = LocalServer(port)
    try:
        page = Page(server)
        for folder in folders:
            page.add(folder)
        page.draw()
        if page.sequence is None and page.problem is not None:
            raise page.problem
        say(console, f"{server.url}  (open it in a browser; Ctrl-C ends it)")
        heartbeat.rest()
        page.run()
    except KeyboardInterrupt:
        say(console, "")
    finally:
        server.stop()
    return 0


def _save(console: Console, folders: list[Path], out: Path, port: int | None, overwrite: bool) -> int:
    if port is not None:
        raise ConfigError("this is an option of the server", where="--port", value=port, accepted="it without --save")
    if out.suffix.lower() not in (".html", ".htm"):
        raise OutputError("not the name of a page", where="--save", value=str(out), accepted="NAME.html")
    if len(folders) != 1:
        raise ConfigError(
            "a file shows one sequence", where="--save", value=len(folders), accepted=f"one, such as {folders[0]}"
        )
    refuse_file(out, overwrite)
    from blinkgl.viewer.page import save

    with console.status("drawing"):
        save(folders[0], out)
    say(console, f"written to {out}: it opens in a browser, without a server and without the data")
    return 0


def check_extra(option: str) -> None:
    """Raise ConfigError where the extra [view] is missing."""
    if importlib.util.find_spec("viser") is None:
        raise ConfigError(
            "viser, which shows sequences, is not installed",
            where=option,
            accepted=f"run {install(*EXTRAS['view'][0])}",
        )
