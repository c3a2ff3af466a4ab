"""Kernels of the networks, each fast path beside a slow, obvious twin it is tested against.

In:    tensors.
Out:   tensors.
Start: warp.py; correlation.py, voxel.py.
"""
