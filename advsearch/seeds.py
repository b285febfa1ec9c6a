"""Independent random streams, all derived from one root seed (docs/design.md, "Seeds").

A stream is named, so that the primal, gradient, search, baseline and verification seeds
of a run never meet, whatever their number. `numpy.random.SeedSequence` does the mixing.
"""

from __future__ import annotations

import zlib

import numpy as np


def stream(root: int, name: str, index: int = 0) -> int:
    """Return a seed of a named stream under a root seed, in [0, 2**32).

    It is the same for the same arguments on every machine.

    Args:
        root: root seed, at least 0.
        name: name of the stream, such as "primal", "gradient" or "verification".
        index: index of the seed in the stream, at least 0.
    """
    sequence = np.random.SeedSequence([root, zlib.crc32(name.encode()), index])
    return int(sequence.generate_state(1, dtype=np.uint32)[0])
