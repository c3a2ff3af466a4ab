"""What the commands print.

In: a command's arguments. Out: a library call behind a display, then words, tables and files for people; no result is made here.
Start in generate.py; one module per command, and terminal.py, which makes every console of the project.
"""
