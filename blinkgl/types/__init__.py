"""Plain values that every room may import: events, boxes, poses, what was made last. Only NumPy is imported here.

In:    arrays.
Out:   frozen classes that define each array.
Start: events.py (``Events``).
"""
