"""Samples that are rendered while they are used: a recipe in, no file kept.

In:    a recipe (``RunTemplate``), the kind of sample, worker processes.
Out:   endless samples, each once, independent of which worker renders them.
Start: stream.py (``SampleStream``); maker.py renders, cuts.py cuts samples out of a sequence, samples.py defines them,
loader.py makes batches for torch.
"""
