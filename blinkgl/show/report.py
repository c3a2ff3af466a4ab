"""``blinkgl report``: where the page is, and the card."""

from __future__ import annotations

from blinkgl.errors import ConfigError
from blinkgl.machine.terminal import plain_console, say
from blinkgl.report import write_report
from blinkgl.report.card import write_card


def run(
    folder: str,
    out: str | None = None,
    *,
    examples: int = 6,
    card: bool = False,
    licence: str | None = None,
    url: str | None = None,
) -> int:
    """Arguments: of :func:`~blinkgl.report.write_report` and, with ``card``, of
    :func:`~blinkgl.report.card.write_card`. Raises ConfigError: a licence or address without a card."""
    for name, value in (("--license", licence), ("--url", url)):
        if value is not None and not card:
            raise ConfigError("is said on the card", where=name, value=value, accepted="it with --card")
    console = plain_console()
    if card:
        say(console, f"written to {write_card(folder, licence=licence, url=url)}")
    say(console, f"written to {write_report(folder, out, examples=examples)}")
    return 0
