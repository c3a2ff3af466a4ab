"""``labels:``, whose keys come from the table of labels (:mod:`blinkgl.labels`): a label that is
registered has its key here from then on."""

from __future__ import annotations

from blinkgl.config.base import Growing


class LabelsConfig(Growing):
    """What is written at label times. A pass that nobody asks for is not compiled, allocated or run."""
