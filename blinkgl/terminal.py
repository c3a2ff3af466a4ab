"""What is printed for people. Rich reads words in square brackets as its markup and drops them: "(extra [cluster])" becomes "(extra )",
a path "run[1]" loses its end. Every console and progress column of the project is made here, and takes text as it stands."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.progress import TextColumn


def plain_console(**options: Any) -> Console:
    """``rich.console.Console`` whose strings, in tables too, are no markup. For style pass a ``rich.text.Text`` or ``style=``."""
    return Console(markup=False, **options)


def plain_column(text: str) -> TextColumn:
    """``rich.progress.TextColumn`` whose fields are no markup."""
    return TextColumn(text, markup=False)
