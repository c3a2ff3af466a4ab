"""Event windows and ground truth.

In:    folders of BlinkGL, DSEC, MVSEC or BlinkFlow, or a recipe to render.
Out:   batches of tensors, in an order that a resumed run repeats.
Start: sources.py (files); representation.py (events to tensors), window.py, dataset.py.
"""
