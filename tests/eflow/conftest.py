"""torch on one thread: test processes run side by side, and tiny networks only wait at each other's barriers."""

import importlib.util

if importlib.util.find_spec("torch") is not None:
    import torch

    torch.set_num_threads(1)
