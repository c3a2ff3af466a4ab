"""Do labels hold what the configuration asks for? Beside what :mod:`.contents` looks at in every label."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from blinkgl.config.sequence import SequenceConfig
from blinkgl.labels import LABELS, Label


def problems_of_asked(folder: Path, manifest: dict[str, Any], config: SequenceConfig) -> list[str]:
    """Of the rows that say how their values hang on ``labels:`` (:meth:`Label.unlike`): their first and last files."""
    if config.frames is not None:
        return []
    problems, time = [], config.time
    for label in LABELS.values():
        form = label.forms[0]
        if type(label).unlike is Label.unlike or form.read is None:
            continue
        files = sorted(name for name in manifest["files"] if form.holds(name))
        for name in dict.fromkeys(files[:1] + files[-1:]):
            t_ns = time.label_times_ns[int(Path(name).stem)]
            wrong = label.unlike(form.read(folder / name), config.labels, time.t0_ns - t_ns, time.t1_ns - t_ns)
            problems += [] if wrong is None else [f"{name}: {wrong}"]
    return problems
