"""What every room may ask of the machine that BlinkGL runs on.

In:    nothing.
Out:   processor, optional parts, how long kernels have compiled, interrupts, how a command line ends.
Start: command_line.py (``run_app``); cpu.py, extras.py, compiling.py, kernels.py, bench.py, interrupts.py, terminal.py
answer one question each.
"""
