"""How samples are spread over a pixel: Mitsuba's samplers, and the counts that they take."""

from __future__ import annotations

import math

SAMPLERS = ("independent", "multijitter")
"""Samplers of a run's image formation; `advsearch precision` compares more."""
SAMPLER = "multijitter"
"""The one that is taken where nobody asks: its pictures are as good with a third of the samples."""
PRIMES = (2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47, 53, 59, 61, 67, 71, 73, 79, 83, 89, 97, 101)


def next_count(sampler: str, samples: float) -> int:
    """Return the number of samples that a sampler takes when it is asked for at least so many.

    Independent samples come in any number; stratified ones in squares, multi-jittered ones in products of two near
    numbers, orthogonal arrays in squares of primes, the low-discrepancy sequence in powers of four.
    """
    whole = max(1, math.ceil(samples - 1e-9))
    root = math.isqrt(whole - 1) + 1
    if sampler == "stratified":
        return root**2
    if sampler == "multijitter":
        wide = max(1, math.isqrt(whole))
        return wide * math.ceil(whole / wide)
    if sampler == "orthogonal":
        return next((prime for prime in PRIMES if prime >= root), PRIMES[-1]) ** 2
    if sampler == "ldsampler":
        return int(4 ** math.ceil(math.log(max(4, whole), 4) - 1e-9))
    return whole
