"""Files in and out: one module per format, the reader beside the writer.

Nothing here knows about scenes, GL or emulators. Event files of any supported format are opened with
:func:`blinkgl.io.formats.open_events` and written with :func:`blinkgl.io.formats.write_events`; a generated
sequence is written by :class:`blinkgl.io.sequence_dir.SequenceWriter`.
"""
