"""Plain values that every room may import: events, boxes. Nothing but NumPy is imported here.

In:    arrays.
Out:   frozen classes that say what each array is.
Start: events.py (``Events``).
"""
