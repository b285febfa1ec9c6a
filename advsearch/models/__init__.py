"""The network under test: loading it, asking it, naming its classes. Torch only."""

from __future__ import annotations

from advsearch.models.labels import LabelSet, find_label_set, matching_labels, read_labels
from advsearch.models.loading import load_model
from advsearch.models.model import Model, ModelWarning, Preprocessing

__all__ = [
    "LabelSet", "Model", "ModelWarning", "Preprocessing", "find_label_set", "load_model", "matching_labels",
    "read_labels",
]  # fmt: skip
