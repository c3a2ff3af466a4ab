"""What Blender runs for ``blinkgl import``: opens a file, makes it into what glTF can say, exports it.

    python blinkgl/blender/inside FOLDER        FOLDER/job.json in; FOLDER/scene.glb out

Programs of Blender's side: they need nothing but ``bpy`` and NumPy and import nothing of BlinkGL (Blender is GPL).
job.json: source (absolute path), shown (as the user wrote it), scene (name or null), frames ([first, last] or null),
fps (or null), keys_per_frame, clips, bake {size, seconds}. ``blinkgl.blender.importing`` writes it.

Standard output carries one JSON object per line: ``{"blender"}``, ``{"doing"}`` as it goes on, ``{"report"}`` when
scene.glb is whole, or ``{"error", "where", "accepted"}``. What Blender itself prints goes to standard error.
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
    """Exit status: 0, or 1 when a line says what is wrong."""
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
    import pipeline
    from said import Refused

    job = json.loads((folder / "job.json").read_text())
    say(blender=bpy.app.version_string)
    try:
        say(report=pipeline.run(job, folder / "scene.glb", lambda doing: say(doing=doing)))
    except Refused as problem:
        say(error=problem.problem, where=problem.where or job["shown"], accepted=problem.accepted)
        return 1
    except Exception as problem:  # noqa: BLE001 - one line for the user, whatever Blender makes of the file
        traceback.print_exc()
        text = " ".join(str(problem).split())[:300]
        say(error=f"Blender cannot import it ({type(problem).__name__}: {text})", where=job["shown"], accepted=None)
        return 1
    return 0


def end_with_the_parent() -> None:
    """Blender must not outlive a driver that was killed (Linux; elsewhere it does, until it is done)."""
    try:
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
    except (OSError, AttributeError):
        pass


if __name__ == "__main__":
    status = main(Path(sys.argv[1]))
    sys.stderr.flush()
    os._exit(status)  # not through Blender's own end, which now and then waits for itself for ever
