"""Samples that are rendered while they are used, in order.

Worker processes (:class:`~blinkgl.dataset.executor.Local`'s, each with its own OpenGL context and one thread) render
sequences and cut several samples out of each. The samples are kept briefly in a spool folder in memory, from which this
process, or loader processes that it started, take them.

*Reproducible*: sample n is item ``n % samples`` of slot ``n // samples``, after the slots' samples have been mixed
block by block; a slot is a pure function of (recipe, seed, number of the slot) and always has the same number of
samples. Where a sequence fails, or gives too few, others of the same slot complete it, in a fixed order. No sample is
repeated. *Back-pressure*: slots are requested up to a block ahead of what has been taken, and no further.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from blinkgl.config.reader import to_yaml
from blinkgl.config.run import RunTemplate
from blinkgl.dataset.executor import Executor, Inline, Local, StartError, several_cards
from blinkgl.dataset.messages import Message
from blinkgl.errors import BlinkGLError, ConfigError, EventDataError
from blinkgl.machine.closing import Closing
from blinkgl.online.cuts import Sample
from blinkgl.online.job import MIX, StreamJob, flow_labels
from blinkgl.online.maker import sample_file
from blinkgl.online.samples import read_sample

_ATTEMPTS = 3  # attempts at a slot whose worker died
_SLOT_S = 900.0  # time limit of a slot
_FREE_FAILURES, _FAILURE_SHARE = 10, 0.5
_SPOOL_FREE = 2**30
_ERROR = "error"
_GONE = ".gone"  # instead of .npz: this sample was taken
_BASE = "base"  # first slot that is still needed, for takers in other processes


@dataclass
class StreamStats:
    """Statistics. slots, samples, sequences, failures : made so far.   cpu_s : CPU seconds of the workers for them.
    replaced : workers that died.   waited_s : wall seconds that :meth:`SampleStream.take` has waited in this process,
    of ``open_s`` wall seconds since the stream was opened."""

    slots: int = 0
    samples: int = 0
    sequences: int = 0
    failures: int = 0
    replaced: int = 0
    cpu_s: float = 0.0
    waited_s: float = 0.0
    opened: float = 0.0

    @property
    def open_s(self) -> float:
        return time.monotonic() - self.opened


class SampleStream(Closing):
    """Endless samples. Sample n does not depend on who requests it; :meth:`take` returns it once.

    workers : rendering processes; 0 renders in this process, when a sample is requested. (A copy in a loader process
    takes what the owner's workers make.)   first : sample that is taken first, when a run is resumed.
    ahead : blocks that are rendered in advance.   card : index (modulo their number) of the graphics card of all
    workers; None: each on another.   block : samples that are mixed with each other.
    stats : :class:`StreamStats`.   spool : folder where samples are kept briefly.
    Raises BlinkGLError: a recipe that cannot be rendered here. :meth:`take` raises ConfigError: one that gives no
    samples;
    EventDataError: a sample that was taken, and after :meth:`close`."""

    def __init__(self, job: StreamJob, workers: int = 1, first: int = 0, ahead: int = 1, card: int | None = None):
        plan = job.plan()
        self.has_backward = all("backward" in flow_labels(group) for group in plan.used)
        self.block = MIX * job.samples
        self.stats = StreamStats(opened=time.monotonic())
        self.first = first
        self.spool = Path(_spool_folder())
        self.job = replace(job, out=str(self.spool))
        self._owner, self._ahead, self._workers = os.getpid(), ahead, workers
        self._base = first // self.block * MIX  # first slot that is still needed
        self._next, self._stop, self._thread = self._base, False, None
        self._executor: Executor | None = None
        try:
            # The samples of the block that come before the first one count as taken.
            for n in range(first // self.block * self.block, first):
                self._mark(*self._place(n))
            cards = several_cards(self.job) if workers and card is not None else None
            one = [cards[card % len(cards)]] if cards and card is not None else None
            self._executor = Inline() if workers == 0 else Local(workers, one, cores=workers)
            self._executor.open(self.job)
        except StartError as error:
            reason = _why(error)
            self.close()
            raise ConfigError(reason, where="workers") from error
        except BaseException:
            self.close()
            raise
        if workers:
            self._thread = threading.Thread(target=self._drive, name="online", daemon=True)
            self._thread.start()

    @classmethod
    def of(cls, template: RunTemplate, job: StreamJob, **how: Any) -> SampleStream:
        """Return the stream of a recipe: ``job`` with ``template`` filled in. Raises as the class."""
        text = to_yaml(template.tree)
        return cls(replace(job, base=str(template.base.resolve()), recipe=text), **how)

    def __getstate__(self) -> dict[str, object]:
        """Return a taker from the spool, without the workers."""
        return {**self.__dict__, "_executor": None, "_thread": None}

    def take(self, n: int) -> Sample:
        """Wait for sample n and return it; it is removed."""
        sample = self.peek(n)
        self.drop(n)
        return sample

    def peek(self, n: int) -> Sample:
        """Wait for sample n and return it; it stays."""
        return read_sample(self._wait(n))

    def drop(self, n: int) -> None:
        """Remove sample n, which was peeked at."""
        self._mark(*self._place(n))

    def move(self, n: int, to: Path) -> None:
        """Move sample n to the file ``to``, which must not exist; as :meth:`take`. Raises OSError."""
        shutil.copyfile(self._wait(n), to)
        self.drop(n)

    def _wait(self, n: int) -> Path:
        slot, item = self._place(n)
        path = sample_file(self.spool, slot, item)
        began = time.monotonic()
        while self._refused(slot, path) or not path.is_file():
            if not self._workers:
                if os.getpid() != self._owner or self._executor is None:
                    raise EventDataError(
                        "loader processes do not render", where="workers", value=0, accepted="1 or more"
                    )
                self._make(slot)
            else:
                time.sleep(0.003)
            self.stats.waited_s += time.monotonic() - began
            began = time.monotonic()
        return path

    def _place(self, n: int) -> tuple[int, int]:
        """Return slot and item of sample n: the samples of a block, shuffled."""
        # Samples of MIX slots are shuffled together, so that neighbours in a batch are of different sequences.
        block, place = divmod(n, self.block)
        mixed = int(_order(self.job.seed, self.job.block_of_all(block), self.block)[place])
        return block * MIX + mixed // self.job.samples, mixed % self.job.samples

    def _mark(self, slot: int, item: int) -> None:
        path = sample_file(self.spool, slot, item)
        # The mark comes first: a missing sample without a mark would be awaited for ever.
        path.with_suffix(_GONE).touch()
        path.unlink(missing_ok=True)
        # With a thread it is the thread that advances, and other processes only leave marks.
        if self._thread is None and os.getpid() == self._owner:
            self._advance()

    def _refused(self, slot: int, path: Path) -> bool:
        """Raise the error that prevents the sample; else return False."""
        mine = os.getpid() == self._owner
        if path.with_suffix(_GONE).exists() or slot < (self._base if mine else self._told_base()):
            raise EventDataError("this sample was taken", where=f"slot {slot}")
        try:
            message = (self.spool / _ERROR).read_text(encoding="utf-8")
        except OSError:
            if not self.spool.is_dir():
                raise EventDataError("the online source is closed", where=f"slot {slot}") from None
            return False
        if path.is_file():  # earlier samples are valid
            return False
        where, _, message = message.partition("\n")
        raise ConfigError(message, where=where)

    def _told_base(self) -> int:
        with suppress(OSError, ValueError):
            return int((self.spool / _BASE).read_text())
        return 0

    def close(self) -> None:
        """End the workers and remove the spool. May be called repeatedly, and in a taker."""
        if os.getpid() != self._owner:
            return
        self._stop = True
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        elif self._executor is not None:
            self._executor.close()
        self._executor = None
        shutil.rmtree(self.spool, ignore_errors=True)

    # -- the owner's side --

    def _advance(self) -> None:
        """Drop the blocks of which all samples were taken; more may be rendered then."""
        while True:
            if not all(mark.exists() for mark in self._marks()):
                return
            marks = list(self._marks())
            self._base += MIX
            (self.spool / _BASE).write_text(
                str(self._base)
            )  # before the marks are removed: later requests must be refused
            for mark in marks:
                mark.unlink()

    def _marks(self) -> Iterator[Path]:
        """Yield the marks of the first needed block, when all was taken."""
        for slot in range(self._base, self._base + MIX):
            for item in range(self.job.samples):
                yield sample_file(self.spool, slot, item).with_suffix(_GONE)

    def _drive(self) -> None:
        """Keep the workers busy with slots up to a block ahead; the only thread that communicates with them."""
        executor, again = cast(Executor, self._executor), []
        running: dict[int, tuple[int, float]] = {}  # slot -> attempt, since when
        try:
            while not self._stop:
                self._advance()
                # At most ``ahead`` blocks beyond the one that is being taken, which bounds the files on disk.
                while executor.free() and (again or self._next < self._base + MIX * (1 + self._ahead)):
                    slot, attempt = again.pop() if again else (self._next, 1)
                    self._next = max(self._next, slot + 1)
                    running[slot] = attempt, time.monotonic()
                    executor.submit(slot, attempt)
                for message in executor.poll(0.05):
                    if message["kind"] in ("done", "failed"):
                        slot = message["task"]
                        attempt, _ = running.pop(slot)
                        if self._counted(message, attempt):
                            again.append((slot, attempt + 1))
                for slot, (_, since) in running.items():
                    if time.monotonic() - since > _SLOT_S:
                        executor.kill(slot, f"a slot took longer than {_SLOT_S:.0f} s")
        except StartError as error:
            self._give_up(_why(error), where="workers")
        except BlinkGLError as error:
            self._give_up(str(error))
        except Exception as error:  # noqa: BLE001 - whoever waits for samples has to hear of it
            self._give_up(f"{type(error).__name__}: {error}")
        finally:
            with suppress(Exception):
                executor.close()

    def _make(self, slot: int) -> None:
        executor = cast(Executor, self._executor)
        for attempt in range(1, _ATTEMPTS + 1):
            executor.submit(slot, attempt)
            (message,) = executor.poll(0.0)
            if not self._counted(message, attempt):
                return

    def _counted(self, message: Message, attempt: int) -> bool:
        """Record a slot's end; return whether it must be tried again."""
        stats = self.stats
        stats.sequences += message.get("sequences", 0)
        stats.failures += message.get("failures", 0)
        stats.cpu_s += message.get("cpu_s", 0.0)
        if message["kind"] == "done":
            stats.slots, stats.samples = stats.slots + 1, stats.samples + self.job.samples
            # A share of few sequences says little, so the first failures are free.
            if stats.failures > _FREE_FAILURES + _FAILURE_SHARE * stats.sequences:
                self._give_up(f"{stats.failures} of {stats.sequences} sequences failed, the last: {message['last']}")
            return False
        died = "expected" not in message
        stats.replaced += died
        if not message["final"] and not message["stop"] and attempt < _ATTEMPTS:
            return True
        self._give_up(message["error"] + (f" ({attempt} times)" if died else ""))
        return False

    def _give_up(self, said: str, where: str = "recipe") -> None:
        """Leave the reason for all takers: the cause, and a line on it."""
        self._stop = True
        temporary = self.spool / (_ERROR + ".tmp")
        with suppress(OSError):
            temporary.write_text(f"{where}\n{said}", encoding="utf-8")
            # Takers see the whole text or none.
            os.replace(temporary, self.spool / _ERROR)


def _why(error: StartError) -> str:
    """Return the problem, and the last line that the workers wrote: their log is deleted with the stream."""
    try:
        lines = error.log.read_text(encoding="utf-8", errors="replace").split("\n")
    except OSError:
        lines = []
    last = next((line.strip() for line in reversed(lines) if line.strip()), "")
    return error.problem + (f"; the last that it wrote: {last}" if last else "")


@lru_cache(maxsize=4)
def _order(seed: int, block: int, size: int) -> np.ndarray:
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(5, block))).permutation(size)


def _spool_folder() -> str:
    """Return a folder in memory where there is room, else for temporary files."""
    shared = Path("/dev/shm")
    with suppress(OSError):
        if os.access(shared, os.W_OK) and shutil.disk_usage(shared).free > _SPOOL_FREE:
            return tempfile.mkdtemp(prefix="blinkgl-online-", dir=shared)
    return tempfile.mkdtemp(prefix="blinkgl-online-")


# ---------------------------------------------------------------------------------------------------------------------
# This process among those of a distributed training, from `torchrun` or Ray Train.


class Share(NamedTuple):
    """Share of a process. rank, world : its number, and the number of processes.   local : its number on this machine;
    None: unknown."""

    rank: int = 0
    world: int = 1
    local: int | None = None


def share_of_process(environment: Mapping[str, str] = os.environ) -> Share:
    """Return the share from Ray Train's context, where that has been imported and this is one of its workers, else from
    ``RANK``, ``WORLD_SIZE`` and ``LOCAL_RANK``, else a single process. Nothing is imported.

    Raises ConfigError: variables that are not numbers, or inconsistent."""
    return _of_ray() or _of_environment(environment)


def _of_ray() -> Share | None:
    train = sys.modules.get("ray.train")
    try:
        context = cast(Any, train).get_context()
        ranks = context.get_world_rank(), context.get_world_size(), context.get_local_rank()
    except (AttributeError, RuntimeError):  # not imported; not one of its workers, in some versions
        return None
    return None if ranks[0] is None or ranks[1] is None else Share(*ranks)


def _of_environment(environment: Mapping[str, str]) -> Share:
    if "RANK" not in environment or "WORLD_SIZE" not in environment:
        return Share()
    rank, world = (_number(environment, name) for name in ("RANK", "WORLD_SIZE"))
    local = _number(environment, "LOCAL_RANK") if "LOCAL_RANK" in environment else None
    if rank >= world:
        raise ConfigError("not the number of a process", where="RANK", value=rank, accepted=f"0 to {world - 1}")
    return Share(rank, world, local)


def _number(environment: Mapping[str, str], name: str) -> int:
    text = environment[name]
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise ConfigError("not a number of processes", where=name, value=text, accepted="a whole number")
    return int(text)
