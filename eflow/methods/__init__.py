"""Flow by optimisation: methods without training, for the same commands as networks.

In:    the events of two windows.
Out:   flow.
Start: table.py; contrast.py is contrast maximisation.
"""

from __future__ import annotations

from eflow.methods.table import METHODS, Method, make_method

__all__ = ["METHODS", "Method", "make_method"]
