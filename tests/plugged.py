"""What tests registered goes again, so that others do not meet it."""

from blinkgl.config.labels import LabelsConfig
from blinkgl.labels import LABELS


def forget_label(name: str) -> None:
    """Remove a label that has a key of its own."""
    del LABELS[name]
    LabelsConfig.added.remove(name)
