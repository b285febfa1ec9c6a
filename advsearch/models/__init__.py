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
    "connecting",
    "copy_sharing_weights",
    "find_label_set",
    "find_near_names",
    "find_similar_labels",
    "first_line",
    "foreign",
    "get_patterns",
    "how_to_allow",
    "import_library",
    "is_local",
    "is_nothing_name",
    "load_model",
    "load_weights",
    "make_source",
    "may_fetch",
    "png_of",
    "pooled",
    "read_key",
    "read_labels",
    "resembling",
    "split_weights",
    "upright",
    "warn",
    "without_unpickling",
]
