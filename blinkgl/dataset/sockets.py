"""Which TCP sockets a process and its descendants listen on, as the kernel says (Linux: /proc)."""

from __future__ import annotations

import contextlib
import ipaddress
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

_LISTEN = "0A"


@dataclass(frozen=True)
class Listening:
    """A listening socket: who, and on which address of this machine ("0.0.0.0" and "::" are all of them)."""

    process: str
    address: str
    port: int

    @property
    def loopback(self) -> bool:
        """Whether only this machine can reach it. IPv4 addresses in IPv6 clothes
        (::ffff:127.0.0.1) count as what they are."""
        address = ipaddress.ip_address(self.address)
        return (getattr(address, "ipv4_mapped", None) or address).is_loopback

    def __str__(self) -> str:
        return f"{self.process} on {self.address} port {self.port}"


def listening(pid: int) -> list[Listening]:
    """The listening TCP sockets, IPv4 and IPv6, of ``pid`` and all its descendants. Processes
    of other users are not seen into."""
    sockets = {}
    for table in ("tcp", "tcp6"):
        with contextlib.suppress(OSError):  # a kernel without IPv6
            for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
                fields = line.split()
                if fields[3] == _LISTEN:
                    address, _, port = fields[1].partition(":")
                    sockets[fields[9]] = (_address(address), int(port, 16))
    found = []
    for process in descendants(pid):
        own = set(_open_files(process))
        found += [Listening(_name(process), *sockets[inode]) for inode in sockets if f"socket:[{inode}]" in own]
    return found


def _open_files(pid: int) -> Iterator[str]:
    with contextlib.suppress(OSError):  # it ended meanwhile
        for descriptor in os.listdir(f"/proc/{pid}/fd"):
            with contextlib.suppress(OSError):  # closed meanwhile; of ourselves, the one that was open for the list
                yield os.readlink(f"/proc/{pid}/fd/{descriptor}")


def _name(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/comm").read_text().strip()
    except OSError:
        return f"process {pid}"


def descendants(pid: int) -> list[int]:
    """``pid``, its children, theirs and so on."""
    children: dict[int, list[int]] = {}
    for entry in os.listdir("/proc"):
        if entry.isdigit():
            with contextlib.suppress(OSError, IndexError, ValueError):
                parent = int(Path(f"/proc/{entry}/stat").read_text().rpartition(")")[2].split()[1])
                children.setdefault(parent, []).append(int(entry))
    found = [pid]
    for process in found:  # grows while we walk
        found += children.get(process, [])
    return found


def _address(text: str) -> str:
    """ "0100007F" -> "127.0.0.1": the kernel prints words of four bytes in its own byte
    order, which is little-endian here."""
    data = b"".join(bytes.fromhex(text[k : k + 8])[::-1] for k in range(0, len(text), 8))
    return str(ipaddress.ip_address(data))
