"""Load and run the network under test, name its classes, and define sources of models.

Only torch is needed.
"""

from __future__ import annotations

from advsearch.errors import CodeNotAllowedError, find_similar_names
from advsearch.interrupts import INTERRUPTS
from advsearch.models.all_at_once import AllAtOnce
from advsearch.models.features import PARTS, pooled
from advsearch.models.inputs import WithState
from advsearch.models.labels import (
    LabelSet,
    find_label_set,
    find_similar_labels,
    get_patterns,
    is_nothing_name,
    read_labels,
)
from advsearch.models.loading import load_model
from advsearch.models.model import (
    MIN_PROBABILITY,
    PRESETS,
    Model,
    ModelWarning,
    Preprocessing,
    RemoteNetwork,
    Triple,
    copy_sharing_weights,
    warn,
)
from advsearch.models.source import (
    DEFAULT_SIZE,
    QUESTION,
    Purpose,
    Source,
    find_near_names,
    import_library,
    load_weights,
    make_source,
    split_weights,
)
from advsearch.pictures import encode_levels, load_upright
from advsearch.trust.archives import without_unpickling
from advsearch.trust.code import explain_how_to_allow, is_fetch_allowed
from advsearch.trust.foreign_code import get_first_line, translate_errors
from advsearch.trust.network import (
    KEY,
    NoRedirect,
    check_address,
    is_local,
    read_key,
    restrict_connections,
)

__all__ = [
    "DEFAULT_SIZE",
    "INTERRUPTS",
    "KEY",
    "MIN_PROBABILITY",
    "PARTS",
    "PRESETS",
    "QUESTION",
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
    "copy_sharing_weights",
    "encode_levels",
    "explain_how_to_allow",
    "find_label_set",
    "find_near_names",
    "find_similar_labels",
    "find_similar_names",
    "get_first_line",
    "get_patterns",
    "import_library",
    "is_fetch_allowed",
    "is_local",
    "is_nothing_name",
    "load_model",
    "load_upright",
    "load_weights",
    "make_source",
    "pooled",
    "read_key",
    "read_labels",
    "restrict_connections",
    "split_weights",
    "translate_errors",
    "warn",
    "without_unpickling",
]
