"""From a configuration to sequence directories."""

from blinkgl.dataset.generate import SequenceReport, generate_run, generate_sequence

__all__ = ["SequenceReport", "generate_run", "generate_sequence"]
