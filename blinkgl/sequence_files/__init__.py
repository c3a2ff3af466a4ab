"""The folder of a generated sequence, or of a rig's: writing, reading and checking.

In:    events, pictures and labels as arrays.
Out:   folders that appear completely or not at all, each with a manifest of checksums; previews; the index of a data
set.
Start: sequence_dir.py (``SequenceWriter``, ``read_manifest``, ``verify_sequence``); rig_dir.py has the list of
sensors and the files about lenses.
"""
