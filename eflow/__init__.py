"""Optical flow from events: networks, training, scores. Reads what ``blinkgl.io`` wrote, or
what ``blinkgl.sequence`` renders meanwhile (:mod:`eflow.data.online`); never imports render or scene.

In:    data sets, a YAML of eflow.config.
Out:   a trained network, its scores, files for benchmarks.
Start: train.py; evaluate.py, infer.py, cli.py.
"""
