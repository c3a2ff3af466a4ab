"""What tests registered goes again, so that others do not meet it."""

from blinkgl.config.rig import RigSensorConfig
from blinkgl.config.sequence import LabelsConfig, SequenceConfig
from blinkgl.labels import LABELS


def forget_label(name: str) -> None:
    """Remove a label that has a key of its own."""
    del LABELS[name], LabelsConfig.model_fields[name]
    for model in (LabelsConfig, RigSensorConfig, SequenceConfig):
        model.model_rebuild(force=True)
