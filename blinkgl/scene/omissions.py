"""What a file asks for and BlinkGL does not draw: a loader collects it, a run says it, in one line per file."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class Omissions:
    """Of one file, in the order met.

    name : the file's name without its folder: the line goes into manifests, which know no machine.
    """

    name: str
    found: dict[str, None] = field(default_factory=dict)

    def add(self, what: str) -> None:
        """``what``: a few words from the file's own world, with what is done instead: "alpha BLEND (drawn opaque)"."""
        self.found[what] = None

    def lines(self) -> tuple[str, ...]:
        """The one line, or nothing."""
        return (f"{self.name} asks for what is not drawn: " + "; ".join(self.found),) if self.found else ()
