"""Information about the machine, for every room.

In:    nothing.
Out:   CPU, optional parts, compilation times of kernels, interrupts, the exit of a command line.
Start: command_line.py (``run_app``); cpu.py, extras.py, compiling.py, kernels.py, bench.py, closing.py, interrupts.py
and terminal.py each have one purpose.
"""
