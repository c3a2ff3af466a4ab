"""The program that Blender runs for ``blinkgl import``: opens a file and exports it by Blender's exporter of glTF.

    python convert.py FOLDER        FOLDER/job.json in; FOLDER/scene.glb out

It needs only ``bpy`` and NumPy and imports nothing of BlinkGL, since Blender is GPL.
job.json: source (absolute path), shown (as the user wrote it), scene (name or null), frames ([first, last] or null),
fps (or null), keys_per_frame, clips, bake_mb. ``blinkgl.blender.importing`` writes it.

Standard output has one JSON object per line: ``{"blender"}``, ``{"doing"}`` for progress, ``{"compare", "finest"}``
(present and largest number of key frames per frame) when scene.glb and seen.npz are to be compared, after which a line
of standard input has ``{"differs", "denser"}``; ``{"report"}`` when scene.glb is complete, or ``{"error", "where",
"accepted"}``. Blender's own output goes to standard error.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import sys
import traceback
from pathlib import Path


def main(folder: Path) -> int:
    """Return the exit status: 0, or 1 when a line reports an error."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # Blender and its libraries print to standard output from C
    sys.stdout = sys.stderr
    end_with_the_parent()

    def say(**words: object) -> None:
        answers.write(json.dumps(words) + "\n")

    try:
        import bpy
    except ImportError as problem:
        say(error=f"bpy cannot be imported by Python {sys.version_info.major}.{sys.version_info.minor}: {problem}")
        return 1
    from exporting import Refused, cause, run

    job = json.loads((folder / "job.json").read_text())
    say(blender=bpy.app.version_string)
    try:
        say(report=run(job, folder / "scene.glb", say))
    except Refused as problem:
        say(error=problem.problem, where=job["shown"], accepted=problem.accepted)
        return 1
    except Exception as problem:  # noqa: BLE001 - one line for the user, whatever Blender makes of the file
        traceback.print_exc()
        say(
            error=f"Blender cannot import it ({type(problem).__name__}: {cause(problem)})",
            where=job["shown"],
            accepted=None,
        )
        return 1
    return 0


def end_with_the_parent() -> None:
    """End this process when its parent is killed (on Linux only; elsewhere it continues until it is done)."""
    try:
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
    except (OSError, AttributeError):
        pass


if __name__ == "__main__":
    status = main(Path(sys.argv[1]))
    sys.stderr.flush()
    os._exit(status)  # not by Blender's own exit, which sometimes never returns
