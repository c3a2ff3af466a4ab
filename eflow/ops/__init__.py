"""Kernels of the networks. Each fast path has a slow, obvious reference, and tests compare the two.

In:    tensors.
Out:   tensors.
Start: resample.py; correlation.py, voxel.py.
"""
