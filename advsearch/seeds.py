"""Derive independent random streams from one root seed (docs/design.md, "Seeds").

Each stream has a name, so that the seeds of a run for search, gradients, baselines and
verification are independent, whatever their number. `numpy.random.SeedSequence` mixes
the root seed, the name and an index.
"""

from __future__ import annotations

import zlib

import numpy as np


def derive_seed(root: int, name: str, index: int = 0) -> int:
    """Return a seed of a named stream under a root seed, in [0, 2**32).

    It is the same for the same arguments on every machine.

    Args:
        root: root seed, at least 0.
        name: name of the stream, such as "primal", "gradient" or "verification".
        index: index of the seed in the stream, at least 0.
    """
    sequence = np.random.SeedSequence([root, zlib.crc32(name.encode()), index])
    return int(sequence.generate_state(1, dtype=np.uint32)[0])
