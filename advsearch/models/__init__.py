"""The network under test: loading it, asking it, naming its classes; and what a source
of models needs. Torch only.
"""

from __future__ import annotations

from advsearch.errors import CodeNotAllowedError, resembling
from advsearch.interrupts import INTERRUPTS
from advsearch.models.all_at_once import AllAtOnce
from advsearch.models.features import PARTS, pooled
from advsearch.models.inputs import WithState
from advsearch.models.labels import (
    LabelSet,
    find_label_set,
    matching_labels,
    names_nothing,
    patterns,
    read_labels,
)
from advsearch.models.loading import load_model
from advsearch.models.model import (
    PRESETS,
    SMALLEST_PROBABILITY,
    Model,
    ModelWarning,
    Preprocessing,
    RemoteNetwork,
    Triple,
    sharing_copy,
    warn,
)
from advsearch.models.source import (
    QUESTION,
    SIDE,
    Purpose,
    Source,
    library,
    load_weights,
    near_names,
    source_of,
    split_weights,
)
from advsearch.pictures import png_of, upright
from advsearch.trust.archives import without_unpickling
from advsearch.trust.code import how_to_allow, may_fetch
from advsearch.trust.foreign_code import first_line, foreign
from advsearch.trust.network import (
    KEY,
    NoRedirect,
    check_address,
    connecting,
    is_local,
    read_key,
)

__all__ = [
    "INTERRUPTS",
    "KEY",
    "PARTS",
    "PRESETS",
    "QUESTION",
    "SIDE",
    "SMALLEST_PROBABILITY",
    "AllAtOnce",
    "CodeNotAllowedError",
    "LabelSet",
    "Model",
    "ModelWarning",
    "NoRedirect",
    "Preprocessing",
    "Purpose",
    "RemoteNetwork",
    "Source",
    "Triple",
    "WithState",
    "check_address",
    "connecting",
    "find_label_set",
    "first_line",
    "foreign",
    "how_to_allow",
    "is_local",
    "library",
    "load_model",
    "load_weights",
    "matching_labels",
    "may_fetch",
    "names_nothing",
    "near_names",
    "patterns",
    "png_of",
    "pooled",
    "read_key",
    "read_labels",
    "resembling",
    "sharing_copy",
    "source_of",
    "split_weights",
    "upright",
    "warn",
    "without_unpickling",
]
