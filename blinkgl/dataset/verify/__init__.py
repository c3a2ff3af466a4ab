"""Is a data set whole and right? Files against manifests, names and manifests against configurations, and a sample
against itself made anew, bit by bit.

A sequence's problems are lines of text; none means none found. What could not be looked at is counted and said: nothing
is passed over in silence. Whatever stands in a record, looking at it ends, and ends with a line.

In:    a folder of sequences, or one sequence.
Out:   a ``Verification``.
Start: sequence.py looks at one folder: config_checks.py says what its configuration asks for; cross_checks.py at what
lies between folders; reproduce.py makes some anew.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from blinkgl.dataset.run_folder import RunFolder
from blinkgl.dataset.verify.cross_checks import against_run, index, strangers, twins
from blinkgl.dataset.verify.problems import Known, Verification, guarded
from blinkgl.dataset.verify.reproduce import made_again
from blinkgl.dataset.verify.sequence import look
from blinkgl.dataset.work import RUN_FOLDER
from blinkgl.errors import AssetError
from blinkgl.io.records import shown
from blinkgl.sequence_files.index import made_folders, sequence_folders
from blinkgl.sequence_files.sequence_dir import MANIFEST

__all__ = ["Verification", "verify_dataset"]


def verify_dataset(
    root: str | Path,
    *,
    deep: int = 0,
    seed: int = 0,
    base: str | Path | None = None,
    progress: Callable[[int, str], None] | None = None,
) -> Verification:
    """Every sequence below ``root``, and what lies between them.

    deep : so many sequences, drawn with ``seed``, are generated again and compared bit by bit.
    base : folder that the recipe's relative paths start from; default: as the run's record says.
    Raises AssetError when ``root`` holds no sequence at all."""
    root = Path(root)
    if not root.is_dir():
        raise AssetError("no such data set", where=str(root), accepted="a folder of sequences")
    result = Verification()
    folders = list(made_folders(root))
    if not folders and not (root / RUN_FOLDER).is_dir():
        raise AssetError("no sequence found", where=str(root), accepted="a folder that 'blinkgl generate' wrote")
    known: dict[str, Known] = {}
    for number, folder in enumerate(folders):
        name = folder.relative_to(root).as_posix()
        if progress:
            progress(number, shown(name))
        problems, found = look(folder, name)
        result.add(name, problems)
        if found is not None:
            known[name] = found
    result.sequences = len(folders)
    if not (root / MANIFEST).is_file():
        result.add(".", guarded(lambda: strangers(root, folders)))
        result.add(".", guarded(lambda: index(root, list(sequence_folders(root)))))
        for name, lines in twins(known, result).items():
            result.add(name, lines)
        result.add(".", guarded(lambda: against_run(root, folders, known, result)))
        result.add(".", guarded(RunFolder(root).altered))
    sound = [name for name in known if name not in result.problems]
    if deep and sound:
        chosen = sorted(np.random.default_rng(seed).permutation(len(sound))[:deep])
        made_again(root, {sound[i]: known[sound[i]] for i in chosen}, result, base, progress)
    return result
