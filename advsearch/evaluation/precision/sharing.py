"""Parts of references that workers carry out; what is timed stays in the process that asked."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import Any

from advsearch.cluster.executor import Executor
from advsearch.errors import ClusterError
from advsearch.evaluation.precision.points import Array
from advsearch.evaluation.precision.rounds import Parts


@dataclass(frozen=True)
class ReferencePart:
    """A part of a reference.

    Attributes:
        name: of what is measured in one sitting.
        by: what of it, or how it is taken: see `PictureBench.part` and `GradientBench.part_of`.
        spp: samples a pixel.
        seed: of its noise.
    """

    name: str
    by: str
    spp: int
    seed: int


def shared_parts(executor: Executor | None, name: str, by: str, spp: int) -> Parts | None:
    """Return what has workers carry out parts; None where there are no workers.

    It raises ClusterError if every worker dies of one.
    """
    if executor is None:
        return None

    def parts(wanted: Iterator[int]) -> Iterator[tuple[int, Array]]:
        results: Any = executor.results([ReferencePart(name, by, spp, seed)] for seed in wanted)
        with closing(results):
            for done in results:
                if done.lost:
                    raise ClusterError(f"{name}, a part of its reference: {done.lost}; leave `workers` out")
                yield done.items[0].seed, done.value[0]

    return parts
