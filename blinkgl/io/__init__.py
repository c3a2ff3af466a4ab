"""Input and output of files: one module per format, the reader beside the writer, independent of scenes, GL and
emulators.

In:    events, pictures and labels as arrays, or files from untrusted users.
Out:   files that appear completely or not at all, or arrays, or a one-line error that names the file.
Start: formats.py (``open_events``, ``write_events``).
"""
