"""Independent random streams, all derived from one root seed (docs/design.md, "Seeds").

A stream is named, so that the primal, gradient, search, baseline and verification seeds of a run never meet, whatever
their number. `numpy.random.SeedSequence` does the mixing.
"""

from __future__ import annotations

import zlib

import numpy as np


def stream(root: int, name: str, index: int = 0) -> int:
    """Return the seed number `index` of the stream `name` under the root seed.

    Args:
        root: the run's root seed, at least 0.
        name: the stream, e.g. ``"primal"``, ``"gradient"``, ``"verification"``.
        index: position in the stream, at least 0.

    Returns:
        An integer in [0, 2**32), the same for the same arguments on every machine.
    """
    sequence = np.random.SeedSequence([root, zlib.crc32(name.encode()), index])
    return int(sequence.generate_state(1, dtype=np.uint32)[0])
