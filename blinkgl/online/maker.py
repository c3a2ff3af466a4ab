"""Rendering of slots: the work of a stream's worker process."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.config.run import Group
from blinkgl.dataset.messages import Message
from blinkgl.dataset.plan import sequence_name
from blinkgl.dataset.work import Maker, failed
from blinkgl.errors import may_pass
from blinkgl.online.cuts import CUTS
from blinkgl.online.job import StreamJob
from blinkgl.sequence import SequenceRequest, simulate_sequence

TRIES = 8
"""Largest number of unusable sequences of a slot."""
_APART = 1_000_000  # between numbers of a slot's sequences


class SlotMaker(Maker):
    """Makes slots: ``samples`` files each in the spool folder. The "done" reports the number of sequences
    ("sequences"), how many failed ("failures"), and the last error ("last")."""

    job: StreamJob  # type: ignore[bad-override-mutable-attribute]

    @classmethod
    def of(cls, job: Mapping[str, Any], device: int | None) -> SlotMaker:
        window = job["window_us"]
        keys: dict[str, Any] = {**job, "window_us": None if window is None else tuple(window)}
        return cls(StreamJob(**keys), device)

    def __init__(self, job: StreamJob, device: int | None = None):
        super().__init__(job, device)
        self._driver = os.getppid()

    def __exit__(self, *_: object) -> None:
        super().__exit__()
        if os.getppid() != self._driver:  # it was killed, and nobody else removes the files
            shutil.rmtree(self.job.out, ignore_errors=True)

    def make(self, number: int, attempt: int, tell: Any) -> Message:
        """Make this process's slot of this number. Only KeyboardInterrupt and SystemExit are raised."""
        job, began, made, failures, barren, tried = self.job, time.process_time(), 0, 0, 0, 0
        first = last = ""
        slot = job.slot_of_all(number)
        while made < job.samples and barren < TRIES:
            # Later tries take sequences whose numbers no slot begins with.
            tried, before = tried + 1, made
            index = slot + (tried - 1) * _APART
            group = self._group(slot, tried)
            name, why = sequence_name(group.template.check().output, index).split("/")[1], ""
            try:
                self.renew()
                config = group.template.sequence(index)
                asked = SequenceRequest(config, index, Path(job.base), labels=False)
                with simulate_sequence(asked, self.gl) as sequence:
                    wanted, dice = job.samples - made, self._dice(slot, tried, 1)
                    for sample in islice(CUTS[job.kind](sequence.alone, job, name, wanted, dice), wanted):
                        sample.write(sample_file(Path(job.out), number, made))
                        made += 1
            except Exception as error:  # noqa: BLE001 - whatever it is, the next sequence goes on
                message = failed(number, error)
                if may_pass(error) or message["stop"]:
                    return message  # an error of the machine: another worker tries the same again
                failures, why = failures + 1, message["error"]
                last = f"{name}: {why}"
            if made == before:
                barren += 1
                first = first or f"{name}: {why or f'no window as asked for, with {job.min_events} events'}"
        report = {
            "task": number,
            "sequences": tried,
            "failures": failures,
            "last": last,
            "cpu_s": time.process_time() - began,
        }
        if made == job.samples:
            return {"kind": "done", **report}
        error = f"{tried} sequences gave {made} of {job.samples} samples; the first that gave none: {first}"
        return {"kind": "failed", "error": error, "expected": True, "final": True, "stop": False, **report}

    def _group(self, slot: int, tried: int) -> Group:
        """Return a group, drawn by the groups' numbers of sequences. (Random, not in turn, because ``shares`` assigns
        values in turn.)"""
        used = self.plan.used
        counts = np.array([self.plan.counts[group.name] for group in used], float)
        return used[int(self._dice(slot, tried, 0).choice(len(used), p=counts / counts.sum()))]

    def _dice(self, slot: int, tried: int, what: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence(self.job.seed, spawn_key=(4, slot, tried, what)))


def sample_file(spool: Path, slot: int, item: int) -> Path:
    """Return the path of a sample in the spool folder."""
    return spool / f"{slot:09d}_{item:03d}.npz"
