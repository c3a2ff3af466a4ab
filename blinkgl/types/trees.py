"""The name of what a YAML or JSON file holds before it is checked."""

from __future__ import annotations

from typing import Any

Tree = dict[str, Any]
"""A table of a YAML or JSON file: keys, and values of the file's types (numbers, text, lists, tables), unchecked."""
