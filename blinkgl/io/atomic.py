"""Output that appears completely or not at all: written under a hidden name beside the final one, synced, then renamed.

A temporary's name holds a hash of this machine's boot, its PID namespace, and the writer's pid, so that a later run can
recognise leftovers of dead writers (kill -9, power loss) without touching those of a live process, another container,
or another machine on a shared disk.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import itertools
import os
import re
import shutil
import socket
import struct
import sys
from collections.abc import Iterator
from pathlib import Path

from blinkgl.errors import BlinkGLError, OutputError
from blinkgl.machine.posix import fcntl

_serial = itertools.count()
_PATTERN = re.compile(r"^\..+\.blinkgl-tmp-([0-9a-f]{12})-(\d+)-\d+(\..*)?$")


@contextlib.contextmanager
def output_errors(where: str | os.PathLike) -> Iterator[None]:
    """Convert an ``OSError`` of writing ``where`` (also HDF5's, whose errno is only in its text) to an
    :class:`OutputError` of one line."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        # HDF5 raises a RuntimeError where it closes a file.
        if not isinstance(error, OSError) and "errno = " not in str(error):
            raise
        raise OutputError(f"cannot write: {_reason(error)}", where=str(where)) from error


def _reason(error: Exception) -> str:
    code = getattr(error, "errno", None)
    if code is None and (number := re.search(r"errno = (\d+)", str(error))):
        code = int(number.group(1))
    # NumPy's tofile and HDF5 say it in words only.
    if code == errno.ENOSPC or re.search(r"no(t enough free)? space|requested and \d+ written", str(error), re.I):
        return "no space left on the device"
    return os.strerror(code).lower() if code else " ".join(str(error).split())


def machine_token() -> str:
    """Return 12 hex digits for this boot of this machine and this PID namespace: where a pid is meaningful."""
    parts = [socket.gethostname()]
    for read in (lambda: Path("/proc/sys/kernel/random/boot_id").read_text(), lambda: os.readlink("/proc/self/ns/pid")):
        with contextlib.suppress(OSError):
            parts.append(read())
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:12]


def temporary_beside(final: Path) -> Path:
    """Return a new hidden name in ``final``'s folder (hence on its file system) with its suffix, because writers such
    as ffmpeg depend on the ending."""
    behind = f".blinkgl-tmp-{machine_token()}-{os.getpid()}-{next(_serial)}{final.suffix}"
    # File systems take 255 bytes; of a longer name the end is left out.
    name = final.name.encode()[: 254 - len(behind.encode())].decode(errors="ignore")
    return final.with_name(f".{name}{behind}")


def is_temporary(name: str) -> bool:
    """Return whether a file or folder of this name is being written, or was when its writer died."""
    return _PATTERN.match(name) is not None


def remove_stale(folder: Path) -> list[Path]:
    """Delete temporaries in ``folder`` whose writer ran on this boot of this machine and is dead. Everything else, even
    if it looks similar, is kept."""
    removed = []
    token = machine_token()
    for path in folder.iterdir() if folder.is_dir() else ():
        match = _PATTERN.match(path.name)
        if not match or match.group(1) != token or _alive(int(match.group(2))) or path.is_symlink():
            continue
        with contextlib.suppress(OSError):  # of another user, in a folder where only owners may delete
            _remove(path)
            removed.append(path)
    return removed


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        # A process of another user, which this one may not signal.
        return True
    return True


def fsync(path: Path) -> None:
    """Flush a file or a directory entry to the disk."""
    if os.name == "nt":  # Windows cannot open folders; it flushes what it can
        return
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    except OSError as error:
        # Some network and FUSE file systems cannot sync a directory; the rename is still atomic there.
        if error.errno not in (errno.EINVAL, errno.ENOTSUP) or not path.is_dir():
            raise
    finally:
        os.close(fd)


@contextlib.contextmanager
def atomic_file(final: str | os.PathLike, *, overwrite: bool = True) -> Iterator[Path]:
    """``with atomic_file("out.h5") as path:`` write to ``path``; it is renamed to ``out.h5`` on success and deleted on
    any exception. The parent folder is made.

    Raises
    ------
    OutputError : the file exists and ``overwrite`` is False, it is a folder, or it cannot be written.
    """
    final = Path(final)
    if final.is_dir():
        raise OutputError("is a folder", where=str(final), accepted="a file name")
    refuse_file(final, overwrite)
    with _appearing(final) as temporary:
        yield temporary
        with output_errors(final):
            # The content reaches the disk before the name does: a power cut leaves the old file or the whole new one.
            fsync(temporary)
            os.replace(temporary, final)
            fsync(final.parent)


def write_whole(final: str | os.PathLike, data: str | bytes) -> None:
    """Write ``data``, text as UTF-8, to a file that appears completely or not at all. Raises OutputError as
    :func:`atomic_file`."""
    with atomic_file(final, overwrite=True) as temporary, output_errors(final):
        temporary.write_bytes(data.encode() if isinstance(data, str) else data)


@contextlib.contextmanager
def _appearing(final: Path) -> Iterator[Path]:
    """Give a hidden name beside ``final``, whose folder is made. What is there is deleted on any exception, and one
    that names it names ``final`` instead."""
    with output_errors(final):
        make_folders(final.parent)
        remove_stale(final.parent)
    temporary = temporary_beside(final)
    try:
        yield temporary  # the format's own writer converts its errors; reading errors of the body are not handled here
    except BaseException as error:
        with contextlib.suppress(OSError):
            _remove(temporary)
        if not isinstance(error, BlinkGLError) or str(temporary) not in (error.where or ""):
            raise
        raise type(error)(
            error.problem,
            where=(error.where or "").replace(str(temporary), str(final)),
            value=error.value,
            accepted=error.accepted,
        ) from error


def _remove(path: Path) -> None:
    shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)


@contextlib.contextmanager
def atomic_folder(final: str | os.PathLike, *, overwrite: bool = False) -> Iterator[Path]:
    """``with atomic_folder("out") as folder:`` write below ``folder``; it is renamed to ``out`` on success and deleted
    on any exception. The parent folder is made.

    Raises
    ------
    OutputError : ``final`` exists (and is not an empty folder) and ``overwrite`` is False, or cannot be written.
    """
    final = Path(final)
    if not overwrite:
        refuse_existing(final)
    if final.name in ("", ".."):  # the current folder cannot be replaced
        raise OutputError("not the name of a folder", where=str(final), accepted="a new folder name")
    with _appearing(final) as temporary:
        with output_errors(final):
            temporary.mkdir()
        yield temporary
        with output_errors(final):
            for path in sorted(temporary.rglob("*"), reverse=True):  # what a folder holds comes before the folder
                fsync(path)
            fsync(temporary)
            # os.rename puts no folder in the place of one that holds files, as os.replace does for a file.
            if overwrite:
                shutil.rmtree(final, ignore_errors=True)
            refuse_existing(final)
            os.rename(temporary, final)
            fsync(final.parent)


LOCK = Path(".run/lock")
"""The file, below a folder, that the one run that writes into the folder has locked. It goes with the run."""


@contextlib.contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Hold ``folder``, which exists, for one run that writes into it, also over NFS: a file that is open for writing is
    locked. The lock ends with the process; what a dead one leaves locks nothing. Where there are no locks, a line says
    so. Raises OutputError: another run has it, not writable."""
    if fcntl is None:
        yield
        return
    path, handle = folder / LOCK, None
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError("cannot be written", where=str(folder), accepted="a folder with write permission")
    with output_errors(folder):
        while handle is None:
            make_folders(path.parent)
            handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
            if not _lock(handle, folder):
                # The run goes on, and whoever started it decides.
                sys.stderr.write(f"note: {folder}: this file system has no locks; start no other run here\n")
            if not is_still(path, handle):  # a run that ended removed it between our opening and our locking it
                os.close(handle)
                handle = None
    try:
        with contextlib.suppress(OSError):  # a full disk: the line is for the message alone
            os.truncate(handle, 0)
            os.write(handle, f"process {os.getpid()} of {socket.gethostname()}".encode())
        yield
    finally:
        # Removed while it is still locked: a run that has opened it meanwhile sees that it is gone and makes another.
        if is_still(path, handle):
            path.unlink(missing_ok=True)
            with contextlib.suppress(OSError):  # a refused run leaves nothing; records stay
                path.parent.rmdir()
        os.close(handle)


def _lock(handle: int, folder: Path) -> bool:
    """Lock an open file; return False where neither kind of lock exists. Raises OutputError: another run has it."""
    assert fcntl is not None
    # fcntl's lock of the open file, which NFS sends to its server, and flock: over NFS they are the same, so that the
    # first that exists is taken alone. struct flock: type, whence, start, length (0: to the end), pid.
    whole = struct.pack("hhqqi", fcntl.F_WRLCK, os.SEEK_SET, 0, 0, 0)
    by_fcntl = lambda: fcntl.fcntl(handle, fcntl.F_OFD_SETLK, whole)
    by_flock = lambda: fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    for take in (by_fcntl, by_flock):
        try:
            take()
            return True
        except (BlockingIOError, PermissionError):
            who = os.pread(handle, 200, 0).decode(errors="replace")
            os.close(handle)
            raise OutputError(
                "another run uses this folder",
                where=str(folder),
                value=who or None,
                accepted="another --out, or --resume after it has ended",
            ) from None
        except OSError:
            continue
    return False


def is_still(path: Path, handle: int) -> bool:
    """Return whether the open file or folder is the one at ``path``: not deleted, moved or replaced."""
    try:
        now, held = os.stat(path, follow_symlinks=False), os.fstat(handle)
    except OSError:
        return False
    return (now.st_dev, now.st_ino) == (held.st_dev, held.st_ino)


def make_folders(folder: Path) -> list[Path]:
    """Make a folder and its missing parents, each synced into its own parent: they outlast a power cut. Return those
    that were made, innermost first. Raises OSError."""
    missing = [place for place in (folder, *folder.parents) if not place.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for place in missing:
        with contextlib.suppress(PermissionError):  # a folder of others that may be entered and not read
            fsync(place.parent)
    return missing


def refuse_file(final: Path, overwrite: bool) -> None:
    """Raise OutputError when ``final`` exists, unless it may be overwritten: said before long work, not after it."""
    if final.exists() and not overwrite:
        raise OutputError("output file exists", where=str(final), accepted="a new name, or --overwrite")


def refuse_existing(final: str | os.PathLike) -> None:
    """Raise OutputError unless ``final`` is free (absent, or an empty folder)."""
    final = Path(final)
    if final.is_dir() and not any(final.iterdir()):
        return
    if final.exists() or final.is_symlink():
        raise OutputError(
            "output folder exists" if final.is_dir() else "output path is a file",
            where=str(final),
            accepted="a new folder name",
        )
