"""Samples that are rendered while they are trained on: a recipe in, no file kept.

    with open_online(SourceConfig(recipe="configs/eflow/real_data.yaml", online=True, workers=2), seed=0) as source:
        sample = source[0]              # waits until it is there

Worker processes (:class:`~blinkgl.dataset.executor.Local`'s, each with an OpenGL context of its own and one thread)
render sequences and cut several windows out of each, of lengths of their own. What comes of it lies for a moment in a
spool folder in memory, from where the training process, or its loader processes, take it.

*Reproducible*: sample n is item ``n % samples`` of slot ``n // samples``, after the slots' samples have been mixed
block by block; a slot is a pure function of (recipe, seed, number of the slot), whoever makes it, and always has as
many samples. Where a sequence fails, or gives too few, others of the same slot fill it up, in a fixed order. No sample
comes twice. *Back-pressure*: slots are ordered up to a block ahead of what has been taken, and no further.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from blinkgl.config.reader import parse_yaml, to_yaml
from blinkgl.config.recipe import Group, derived_seed
from blinkgl.config.sequence import RunTemplate, SequenceConfig, load_run
from blinkgl.dataset.executor import Executor, Inline, Local
from blinkgl.dataset.plan import Plan, sequence_name
from blinkgl.dataset.work import Maker, Message, failed
from blinkgl.errors import BlinkGLError, ConfigError, EventDataError, may_pass
from blinkgl.events.types import Events
from blinkgl.sequence import simulate_sequence
from eflow.config import SourceConfig
from eflow.data.pool import read_window, write_window
from eflow.data.window import RawSample, Window

MIX = 8
"""Slots whose samples are mixed: a batch then has samples of different sequences."""
TRIES = 8
"""Sequences of a slot that are tried before it is given up."""
_APART = 1_000_000  # between numbers of a slot's sequences
_LEAST_PX = 0.3  # shorter flow counts as so long where density is asked for
_CANDIDATES = 6  # windows drawn for each that is wanted
_ATTEMPTS = 3  # at a slot whose worker died
_SLOT_S = 900.0  # longest for a slot
_FREE_FAILURES, _FAILURE_SHARE = 10, 0.5
_SPOOL_FREE = 2**30
_ERROR = "error"


@dataclass(frozen=True)
class StreamJob:
    """What is rendered, in plain data.

    recipe : YAML text, its seed already the stream's.   base : folder that its paths start from.
    samples : windows of a slot.   window_us : shortest and longest window, µs, drawn log-uniformly for each; None: the
    recipe's label interval.   min_events : fewest events in each of a sample's two windows.
    max_flow : longest median of the flow in a sample, px.   min_density : fewest events per pixel of the new window and
    px of its mean flow.   split : which groups.   seed : of windows and their order.
    out : the spool folder."""

    out: str
    base: str
    recipe: str
    samples: int = 8
    window_us: tuple[int, int] | None = None
    min_events: int = 1
    max_flow: float = 400.0
    min_density: float = 0.0
    split: str = "train"
    seed: int = 0
    maker: ClassVar[str] = "eflow.data.online:WindowMaker"

    def plan(self) -> Plan:
        """Raises ConfigError: a bad recipe, or one without groups of the split."""
        return _plan(self.recipe, self.base, self.split)

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


@lru_cache(maxsize=8)
def _plan(recipe: str, base: str, split: str) -> Plan:
    tree = parse_yaml(recipe, "recipe")
    of_split = [g for g in RunTemplate(tree, Path(base)).groups if g.enabled and _split_of(g) == split]
    if not of_split:
        raise ConfigError(f"the recipe has nothing of split '{split}'", where="output.split")
    if "groups" in tree:
        names = {group.name for group in of_split}
        for name, group in tree["groups"].items():
            group["enabled"] = name in names
    plan = Plan.of(RunTemplate(tree, Path(base)))
    for group in plan.used:
        config = group.template.check()
        if config.frames is not None:
            raise ConfigError("recorded frames are not rendered", where="frames", accepted="blinkgl generate, and path")
        if "forward" not in config.labels.flow:
            raise ConfigError("no flow to learn from", where="labels.flow", value=list(config.labels.flow))
    return plan


def _split_of(group: Group) -> str:
    return group.template.check().output.split


class WindowMaker(Maker):
    """Makes slots: ``samples`` files each in the spool folder. The "done" says how many sequences that took
    ("sequences"), how many of them failed ("failures"), and with what ("last")."""

    job: StreamJob

    @classmethod
    def of(cls, job: Mapping[str, Any], device: int | None) -> WindowMaker:
        window = job["window_us"]
        return cls(StreamJob(**{**job, "window_us": None if window is None else tuple(window)}), device)

    def __init__(self, job: StreamJob, device: int | None = None):
        super().__init__(job, device)
        self._driver = os.getppid()

    def __exit__(self, *_: object) -> None:
        super().__exit__()
        if os.getppid() != self._driver:  # it was killed, and nobody else tidies up
            shutil.rmtree(self.job.out, ignore_errors=True)

    def make(self, number: int, attempt: int, tell: Any) -> Message:
        """The slot of this number. Only KeyboardInterrupt and SystemExit get out."""
        began, made, failures, last, tried = time.process_time(), 0, 0, "", 0
        for tried in range(1, TRIES + 1):
            index = number + (tried - 1) * _APART
            group = self._group(number, tried)
            try:
                config = group.template.sequence(index)
                found = self._windows(config, index, number, tried, self.job.samples - made)
                name = sequence_name(config.output, index).split("/")[1]
                for sample in found:
                    write_window(_file(Path(self.job.out), number, made), sample, name)
                    made += 1
            except Exception as error:  # noqa: BLE001 - whatever it is, the next sequence goes on
                message = failed(number, error)
                if may_pass(error) or message["stop"]:
                    return message  # the machine's trouble: somebody else tries the same again
                failures, last = failures + 1, f"{name_of(group, index)}: {message['error']}"
            if made == self.job.samples:
                break
            last = last or f"{name_of(group, index)}: too few windows with {self.job.min_events} events"
        report = {
            "task": number,
            "sequences": tried,
            "failures": failures,
            "last": last,
            "cpu_s": time.process_time() - began,
        }
        if made == self.job.samples:
            return {"kind": "done", **report}
        error = f"{tried} sequences gave {made} of {self.job.samples} samples; the first that gave too few: {last}"
        return {"kind": "failed", "error": error, "expected": True, "final": True, "stop": False, **report}

    def _group(self, slot: int, tried: int) -> Group:
        """By the groups' numbers of sequences. (By dice, not in turn: what ``shares`` deals out goes in turn.)"""
        used = self.plan.used
        counts = np.array([self.plan.counts[group.name] for group in used], float)
        return used[int(self._dice(slot, tried, 0).choice(len(used), p=counts / counts.sum()))]

    def _dice(self, slot: int, tried: int, what: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence(self.job.seed, spawn_key=(4, slot, tried, what)))

    def _windows(self, config: SequenceConfig, index: int, slot: int, tried: int, wanted: int) -> Iterator[RawSample]:
        """Up to ``wanted`` windows of a sequence that have something to say."""
        job = self.job
        with simulate_sequence(config, index, self.gl, base=Path(job.base), labels=False) as sequence:
            events = sequence.gather()
            spans = drawn_spans(
                self._dice(slot, tried, 1),
                -(-sequence.t0_ns // 1000),
                sequence.t1_ns // 1000,
                _CANDIDATES * wanted,
                job.window_us or (config.time.interval_ns // 1000,) * 2,
            )
            for t, span in spans:
                old, new = (_window(events, t0, t0 + span) for t0 in (t - span, t))
                if min(len(old), len(new)) < job.min_events:
                    continue
                truth = sequence.truth(t * 1000, span * 1000).frame
                forward, backward = truth.forward, truth.backward
                lengths = np.hypot(*forward.flow[forward.valid][::7].T)
                if not len(lengths) or np.median(lengths) > job.max_flow:
                    continue
                if len(new) < job.min_density * forward.valid.size * max(float(lengths.mean()), _LEAST_PX):
                    continue
                yield RawSample(
                    old,
                    new,
                    sequence.height,
                    sequence.width,
                    name="",
                    scene="",
                    flow=forward.flow,
                    valid=forward.valid,
                    backward=None if backward is None else backward.flow,
                    backward_valid=None if backward is None else backward.valid,
                )
                wanted -= 1
                if wanted == 0:
                    return


def name_of(group: Group, index: int) -> str:
    """ "davis240_000017"."""
    return f"{group.name or 'sequence'}_{index:06d}"


def drawn_spans(
    rng: np.random.Generator, t0_us: int, t1_us: int, count: int, window_us: tuple[int, int]
) -> list[tuple[int, int]]:
    """``count`` times (t, span), µs, with [t - span, t + span) inside [t0, t1]: lengths log-uniform in ``window_us``,
    as far as the sequence is long enough, places uniform.

    Raises ConfigError: a sequence that is shorter than two of the shortest."""
    longest = min(window_us[1], (t1_us - t0_us) // 2)
    if longest < window_us[0]:
        raise ConfigError(
            f"a sequence of {(t1_us - t0_us) / 1000:g} ms holds no two windows of {window_us[0] / 1000:g} ms",
            where="time.duration",
            accepted="a longer one, or shorter window_ms",
        )
    spans = np.rint(np.exp(rng.uniform(np.log(window_us[0]), np.log(longest), count))).astype(np.int64)
    spans = np.clip(spans, window_us[0], longest)
    times = t0_us + spans + np.floor(rng.random(count) * (t1_us - t0_us - 2 * spans + 1)).astype(np.int64)
    return [(int(t), int(span)) for t, span in zip(times, spans, strict=True)]


def _window(events: Events, t0: int, t1: int) -> Window:
    e = events.window(t0, t1)
    return Window(e.x, e.y, e.t, e.p, t0, t1)


# ---- the spool -------------------------------------------------------------------------------------------------------


def _file(spool: Path, slot: int, item: int) -> Path:
    return spool / f"{slot:09d}_{item:03d}.npz"


@dataclass
class StreamStats:
    """slots, samples, sequences, failures : made so far.   cpu_s : processor seconds of the workers for them.
    replaced : workers that died.   waited_s : wall seconds that :meth:`OnlineSource.__getitem__` has waited in this
    process."""

    slots: int = 0
    samples: int = 0
    sequences: int = 0
    failures: int = 0
    replaced: int = 0
    cpu_s: float = 0.0
    waited_s: float = 0.0


class OnlineSource:
    """A :class:`~eflow.data.sources.Source` without an end. Sample n is the same whoever asks, and is there once:
    :meth:`taken` says what nobody will ask for again.

    workers : rendering processes; 0 renders in this process, when a sample is asked for. (A copy in a loader process
    reads what the owner's workers make.)   first : sample that is asked for first, when a run is resumed.
    block : samples that are mixed with each other.   stats : :class:`StreamStats`.
    Raises BlinkGLError: a recipe that cannot be rendered here. ``source[n]`` raises ConfigError: one that gives no
    samples; EventDataError: after :meth:`close`."""

    endless = True

    def __init__(self, job: StreamJob, workers: int = 1, first: int = 0, ahead: int = 1):
        plan = job.plan()
        configs = [group.template.check() for group in plan.used]
        self.has_backward = all("backward" in config.labels.flow for config in configs)
        self.block = MIX * job.samples
        self.stats = StreamStats()
        self._spool = Path(_spool_folder())
        self.job = StreamJob(**{**job.to_dict(), "out": str(self._spool)})
        self._owner, self._ahead, self._workers = os.getpid(), ahead, workers
        self.first = first
        self._base = first // self.block * MIX  # first slot that is still wanted
        self._next, self._stop, self._thread = self._base, False, None
        self._executor: Executor | None = None
        try:
            self._executor = Inline() if workers == 0 else Local(workers, cores=workers)
            self._executor.open(self.job)
        except BaseException:
            self.close()
            raise
        if workers:
            self._thread = threading.Thread(target=self._drive, name="online", daemon=True)
            self._thread.start()

    def __getstate__(self) -> dict[str, Any]:
        """A reader of the spool, without the workers."""
        return {**self.__dict__, "_executor": None, "_thread": None}

    def __len__(self) -> int:
        raise TypeError("an online source has no end")

    def __getitem__(self, n: int) -> RawSample:
        return read_window(self.path(n))

    def path(self, n: int) -> Path:
        """The file of sample n (:mod:`eflow.data.pool`), when it is there; until :meth:`taken` says otherwise."""
        slot, item = self._place(n)
        path = _file(self._spool, slot, item)
        began = time.monotonic()
        while not path.is_file():
            self._explain(slot)
            if not self._workers and self._executor is not None:
                self._make(slot)
            else:
                time.sleep(0.003)
            self.stats.waited_s += time.monotonic() - began
            began = time.monotonic()
        return path

    def _place(self, n: int) -> tuple[int, int]:
        """Slot and item of sample n: the samples of a block, shuffled."""
        block, place = divmod(n, self.block)
        mixed = int(_order(self.job.seed, block, self.block)[place])
        return block * MIX + mixed // self.job.samples, mixed % self.job.samples

    def _explain(self, slot: int) -> None:
        try:
            said = (self._spool / _ERROR).read_text(encoding="utf-8")
        except OSError:
            if not self._spool.is_dir():
                raise EventDataError("the online source is closed", where=f"slot {slot}") from None
            if slot < self._base and os.getpid() == self._owner:
                raise EventDataError("this sample was taken", where=f"slot {slot}") from None
            return
        raise ConfigError(said, where="recipe")

    def taken(self, n: int) -> None:
        """Samples before n have been used: what lies there is deleted, and more is rendered."""
        base = n // self.block * MIX
        for slot in range(self._base, base):
            for item in range(self.job.samples):
                _file(self._spool, slot, item).unlink(missing_ok=True)
        self._base = max(base, self._base)

    def close(self) -> None:
        """Ends the workers and leaves nothing behind. Harmless when repeated, and in a reader."""
        if os.getpid() != self._owner:
            return
        self._stop = True
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        elif self._executor is not None:
            self._executor.close()
        self._executor = None
        shutil.rmtree(self._spool, ignore_errors=True)

    def __enter__(self) -> OnlineSource:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- the owner's side --

    def _drive(self) -> None:
        """Keeps the workers at slots up to a block ahead; the only thread that talks to them."""
        executor, again = self._executor, []
        running: dict[int, tuple[int, float]] = {}  # slot -> attempt, since when
        try:
            while not self._stop:
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
        except BlinkGLError as error:
            self._give_up(str(error))
        except Exception as error:  # noqa: BLE001 - whoever waits for samples has to hear of it
            self._give_up(f"{type(error).__name__}: {error}")
        finally:
            with suppress(Exception):
                executor.close()

    def _make(self, slot: int) -> None:
        self._executor.submit(slot, _ATTEMPTS)
        for message in self._executor.poll(0.0):
            self._counted(message, _ATTEMPTS)

    def _counted(self, message: Message, attempt: int) -> bool:
        """Takes note of a slot's end; whether it has to be tried again."""
        stats = self.stats
        stats.sequences += message.get("sequences", 0)
        stats.failures += message.get("failures", 0)
        stats.cpu_s += message.get("cpu_s", 0.0)
        if message["kind"] == "done":
            stats.slots, stats.samples = stats.slots + 1, stats.samples + self.job.samples
            if stats.failures > _FREE_FAILURES + _FAILURE_SHARE * stats.sequences:
                self._give_up(f"{stats.failures} of {stats.sequences} sequences failed, the last: {message['last']}")
            return False
        died = "expected" not in message
        stats.replaced += died
        if not message["final"] and not message["stop"] and attempt < _ATTEMPTS:
            return True
        self._give_up(message["error"] + (f" ({attempt} times)" if died else ""))
        return False

    def _give_up(self, said: str) -> None:
        self._stop = True
        temporary = self._spool / (_ERROR + ".tmp")
        with suppress(OSError):
            temporary.write_text(said, encoding="utf-8")
            os.replace(temporary, self._spool / _ERROR)


@lru_cache(maxsize=4)
def _order(seed: int, block: int, size: int) -> np.ndarray:
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(5, block))).permutation(size)


def _spool_folder() -> str:
    """In memory where there is room, else where temporary files go."""
    shared = Path("/dev/shm")
    with suppress(OSError):
        if os.access(shared, os.W_OK) and shutil.disk_usage(shared).free > _SPOOL_FREE:
            return tempfile.mkdtemp(prefix="eflow-online-", dir=shared)
    return tempfile.mkdtemp(prefix="eflow-online-")


def stream_seed(recipe_seed: int, seed: int) -> int:
    """The recipe's seed in a stream of training seed ``seed``: other sequences than ``blinkgl generate`` makes of the
    recipe, unless it is told ``--seed`` of this."""
    return derived_seed(recipe_seed, f"online/{seed}")


def open_online(s: SourceConfig, seed: int, *, split: str = "train", first: int = 0, batch: int = 1) -> OnlineSource:
    """The source that ``{recipe: FILE, online: true, …}`` of an eflow configuration asks for.

    first : sample that is asked for first.   batch : samples that are asked for together.
    Raises BlinkGLError: a recipe that is bad, or cannot be rendered here."""
    template = load_run(s.recipe, s.set)
    template = load_run(s.recipe, s.set, seed=stream_seed(template.seed, seed))
    job = StreamJob(
        "",
        str(template.base.resolve()),
        to_yaml(template.tree),
        s.samples,
        None if s.window_ms is None else (round(1000 * s.window_ms[0]), round(1000 * s.window_ms[1])),
        s.min_events,
        s.max_flow,
        s.min_density,
        split,
        seed,
    )
    try:
        return OnlineSource(job, s.workers, first, ahead=1 + batch // (MIX * s.samples))
    except ConfigError as error:
        where = f"{s.recipe}: {error.where}" if error.where else s.recipe
        raise ConfigError(error.problem, where=where, value=error.value, accepted=error.accepted) from None


class Held:
    """A few samples in memory, as a :class:`~eflow.data.sources.Source`."""

    def __init__(self, samples: list[RawSample]):
        self._samples = samples
        self.has_backward = all(sample.backward is not None for sample in samples)

    def __len__(self) -> int:
        return len(self._samples)

    def __getitem__(self, index: int) -> RawSample:
        return self._samples[index]


def held(s: SourceConfig, count: int, seed: int = 0) -> Held:
    """``count`` samples of an online source's split "test", rendered now. Raises as :func:`open_online`."""
    with open_online(s, seed, split="test") as source:
        return Held([source[n] for n in range(count)])
