"""Sequences in the browser: pictures, events, labels and the scene in space, over one time slider.

In:    sequence directories
Out:   a page served on 127.0.0.1 alone, or one self-contained HTML file
Start: views.py (what there is to see at a time, as arrays), then page.py (controls), stage.py (space), server.py
"""
