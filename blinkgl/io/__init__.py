"""Files in and out: one module per format, the reader beside the writer. Nothing here knows
about scenes, GL or emulators.

In:    events, pictures and labels as arrays, or files of strangers.
Out:   files that appear whole or not at all, or arrays, or one line that names the file.
Start: formats.py (``open_events``, ``write_events``).
"""
