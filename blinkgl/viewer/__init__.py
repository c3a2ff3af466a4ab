"""Sequences in the browser: pictures, events, labels and the 3-D scene, with one time slider.

In:    sequence directories
Out:   a page served only on 127.0.0.1, or one self-contained HTML file
Start: views.py (the data at a time, as arrays), then page.py (controls), stage.py (3-D), server.py
"""
