"""From a configuration to sequence directories, one or a million.

In:    a ``RunTemplate``, a folder, where workers run.
Out:   folders that appear whole or not at all, what they cost, what is wrong with them.
Start: generate.py (one sequence, readable top to bottom); run.py makes many, verify/ looks at what is there,
explain.py says what it would be.
"""

from blinkgl.dataset.generate import SequenceReport, generate_run, generate_sequence

__all__ = ["SequenceReport", "generate_run", "generate_sequence"]
