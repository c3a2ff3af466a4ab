"""Generation of sequence directories from a configuration, one or a million.

In:    a ``RunTemplate``, a folder, an executor.
Out:   folders that appear completely or not at all, their cost, their problems.
Start: generate.py (one sequence, readable top to bottom); run.py makes many, verify.py checks the existing ones,
explain.py describes a run in advance.
"""
