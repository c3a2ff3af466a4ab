"""The folder of a generated sequence, or of a rig's: what is written into it, and how it is read and checked.

In:    events, pictures and labels as arrays.
Out:   folders that appear whole or not at all, each with a manifest of checksums; previews; the index of a data set.
Start: sequence_dir.py (``SequenceWriter``, ``read_manifest``, ``verify_sequence``); rig_dir.py is the same of a rig.
"""
