"""Configuration: the YAML keys a user may write, and their validation.

In:    YAML text from an untrusted user, key=value overrides, a seed.
Out:   frozen, validated models of plain values (``SequenceConfig``), or a one-line error that names the key.
Start: sequence.py (``load_run``). reader.py alone parses YAML, base.py defines the models, and each other module
configures one other room.
"""
