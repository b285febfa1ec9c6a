"""One rule against heavy-tailed gradients: what is far out of the usual is cut to the edge of it.

A gradient through a renderer has finite mean and, at times, no useful variance: one path in ten thousand may outweigh
all others. Averages then follow the outliers. Clipping (Zhang et al. 2020, Why are adaptive methods good for attention
models?) bounds them at the price of a bias, which the stability suite measures.
"""

from __future__ import annotations

import torch
from torch import Tensor

from advsearch.attacks.domain import Domain
from advsearch.attacks.policies.base import NO_COUNTS, Counts

CLIP = 3.0
"""What exceeds the median so many times is out of the usual."""

MEMORY = 15
"""Latest gradients whose lengths say what is usual."""

CLIP_L2 = 10.0
"""The same of single numbers in an l2 block, whose true gradient may well be uneven: its direction is at stake."""

FEWEST = 8
"""Fewer numbers than this have no median to speak of."""


def clipped(domain: Domain, gradient: Tensor, lengths: tuple[float, ...]) -> tuple[Tensor, tuple[float, ...], Counts]:
    """Return a gradient without outliers, the lengths of the latest gradients, and what was an outlier.

    - In a ball of at least `FEWEST` numbers, each is cut to so many medians of those that are not zero: `CLIP` in an
      l-infinity ball, where the step follows the signs, so that this changes how gradients are averaged and no single
      step; `CLIP_L2` in an l2 ball.
    - A gradient that is longer than `CLIP` times the median of the last `MEMORY` is shortened to that.
    - In a domain that is `exact` or `drawn` nothing is an outlier.

    Args:
        domain: whose blocks count.
        gradient: (d,) float32, finite.
        lengths: of the gradients before, the latest last.
    """
    if domain.exact or domain.drawn:
        return gradient, lengths, NO_COUNTS
    out, cut, shortened = gradient, False, False
    for block, part in domain.parts():
        if block.norm != "box" and block.size >= FEWEST:
            sizes = out[part].abs()
            some = sizes[sizes > 0]
            if some.numel():
                limit = (CLIP if block.norm == "linf" else CLIP_L2) * float(some.median())
                if float(sizes.amax()) > limit:
                    out, cut = out.clone() if out is gradient else out, True
                    out[part] = out[part].clamp(-limit, limit)
    length = float(torch.linalg.vector_norm(out))
    lengths = (*lengths, length)[-MEMORY:]
    usual = sorted(lengths)[len(lengths) // 2]
    if length > CLIP * usual > 0.0:
        shortened = True
        out = out * (CLIP * usual / length)
    return out, lengths, Counts(int(cut), int(shortened))
