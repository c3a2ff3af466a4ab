"""Samples that are rendered while they are used: a recipe in, no file kept.

In:    a recipe (``RunTemplate``), what a sample is, worker processes.
Out:   samples without end, each once, the same ones whoever renders them.
Start: stream.py (``SampleStream``); maker.py renders, cuts.py cuts samples out of a sequence, samples.py is what they
are, loader.py has them in batches for torch.
"""
