"""What the commands print.

In: a command's options. Out: one call into the library behind a display, then words and tables for people, and the command's exit status.
Start in generate.py. One module per command of the same name, each with ``run(...) -> status`` and nothing that makes a result; ``terminal.py`` makes every
console of the project.
"""
