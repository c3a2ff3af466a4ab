"""The room of the YAML: what a person may write, and whether it makes sense.

In:    text of a stranger, key=value overrides, a seed.
Out:   frozen, validated models of plain values (``SequenceConfig``), or one line that names the key.
Start: sequence.py (``load_run``); reader.py alone knows YAML, base.py puts errors into
words, one module per other room.
"""
