"""Ranges of numbers, and those whose values are drawn by a distribution: u is the share of its probability, so that
whatever draws u evenly (nets of points, banks of light transport) draws values as the distribution has them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeGuard

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from advsearch.distributions import DISTRIBUTION, FROM_PYTHON, OwnQuantiles
from advsearch.errors import InputError, UnknownNameError
from advsearch.scene.settings import Parameter

LARGEST = 1e30  # no quantity of a scene is larger; the square of one that is has no float32

Quantiles = Callable[[NDArray[np.float64]], NDArray[np.float64]]

COMMON = ("norm", "truncnorm", "uniform", "triang", "beta", "lognorm", "expon", "gamma", "vonmises")
"""Names that a message tells."""

TAIL = 1e-6  # probability of an endless tail that is left out

MOST_OUTSIDE = 0.01  # probability outside of a parameter's bounds, where a distribution is cut off, at most

CHECKED = 257  # shares at which a function from Python is looked at

NEAR = 1e-4  # half of the step over which the slope of a quantile is taken


def is_number(given: object) -> TypeGuard[float]:
    """Return whether it is a number that float32 has: not a truth value, not NaN, and at most `LARGEST`."""
    return isinstance(given, (int, float)) and not isinstance(given, bool) and abs(given) <= LARGEST


@dataclass(frozen=True)
class Range:
    """Every value from `low` to `high`."""

    low: float
    high: float


@dataclass(frozen=True)
class DrawnRange(Range):
    """Values from `low` to `high`, the shares `least` to `most` of a distribution: its quantiles, and what it is."""

    quantiles: Quantiles
    least: float
    most: float
    text: str

    def at(self, u: Tensor) -> Tensor:
        """Return the values at coordinates in [0, 1]; differentiable, by the slope of the quantiles."""
        values = self._values(u.detach())
        if u.requires_grad:
            up, down = (u.detach() + NEAR).clamp(max=1.0), (u.detach() - NEAR).clamp(min=0.0)
            values = values + (self._values(up) - self._values(down)) / (up - down) * (u - u.detach())
        return values

    def _values(self, u: Tensor) -> Tensor:
        shares = self.least + (self.most - self.least) * u.double().cpu().numpy()
        return torch.from_numpy(np.clip(self.quantiles(np.asarray(shares)), self.low, self.high)).to(u)

    def coordinate(self, value: float) -> float:
        """Return the coordinate of a value, by bisection."""
        below, above = 0.0, 1.0
        for _ in range(60):
            middle = 0.5 * (below + above)
            share = self.least + (self.most - self.least) * middle
            below, above = (middle, above) if float(self.quantiles(np.asarray(share))) < value else (below, middle)
        return above if above < 1.0 else below


def read_drawn(where: str, parameter: Parameter, given: Mapping[str, object]) -> DrawnRange:
    """Return the spec of a parameter from its distribution, `{distribution: NAME, PARAMETER: NUMBER, ...}`.

    Raises:
        InputError: there is none of that name, it has other parameters, it was a function from Python, or more of it
            than `MOST_OUTSIDE` lies outside of the parameter's bounds.
    """
    if isinstance(given, OwnQuantiles):
        return _own(where, parameter, given)
    name = given[DISTRIBUTION]
    if name == FROM_PYTHON:
        raise InputError(
            f"{where}: its values were drawn by {given.get('name', 'a function')}, which only the Python session that "
            "asked has; pass it again in the same call, with `resume=True` to go on"
        )
    numbers = {key: value for key, value in given.items() if key != DISTRIBUTION}
    from scipy import stats  # takes a quarter of a second, and few runs draw by a distribution

    family = getattr(stats, name, None) if isinstance(name, str) else None
    if not isinstance(family, stats.rv_continuous):
        raise UnknownNameError(
            f"distribution of {where}", str(name), COMMON, "It is one of scipy.stats, of real numbers."
        )
    shown = (f"{key}={value:g}" if is_number(value) else f"{key}={value!r:.20}" for key, value in numbers.items())
    text = f"{name}({', '.join(shown)})"
    try:
        if not all(map(is_number, numbers.values())):
            raise TypeError("expected numbers")
        frozen = family(**numbers)
        sound = np.isfinite(frozen.ppf(0.5))
    except TypeError:
        sound = False
    if not sound:
        shapes = f"{family.shapes}, " if family.shapes else ""
        raise InputError(f"{where}: expected {{distribution: {name}}} with numbers for {shapes}loc, scale, got {text}")
    with np.errstate(all="ignore"):  # far from where it is, some formulas overflow
        least, most = float(frozen.cdf(parameter.low)), float(frozen.cdf(parameter.high))
        outside = least + float(frozen.sf(parameter.high))
        ends = np.isfinite(frozen.ppf(np.array([0.0, 1.0])))
    if outside > MOST_OUTSIDE:
        raise InputError(
            f"{where}: {100.0 * outside:.3g} % of {text} lies outside of {parameter.low:g} to {parameter.high:g} "
            f"({parameter.unit}), and at most {100.0 * MOST_OUTSIDE:g} % is cut off; choose a narrower one, or cut it "
            "yourself (truncnorm)"
        )
    least, most = max(least, 0.0 if ends[0] else TAIL), min(most, 1.0 if ends[1] else 1.0 - TAIL)
    return _between(where, frozen.ppf, least, most, text)


def _own(where: str, parameter: Parameter, given: OwnQuantiles) -> DrawnRange:
    """The spec of a function from Python."""
    name = str(given["name"])

    def quantiles(shares: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array([float(given.function(float(one))) for one in shares.flat]).reshape(shares.shape)

    with np.errstate(all="ignore"):
        ends = np.isfinite(quantiles(np.array([0.0, 1.0])))
    shares = np.linspace(0.0 if ends[0] else TAIL, 1.0 if ends[1] else 1.0 - TAIL, CHECKED)
    values = quantiles(shares)
    wrong = values[~((values >= parameter.low) & (values <= parameter.high))]
    if len(wrong):
        raise InputError(
            f"{where}: expected values from {parameter.low:g} to {parameter.high:g} ({parameter.unit}) of {name}, got "
            f"{wrong[0]:g}"
        )
    if (np.diff(values) < 0.0).any():
        place = int((np.diff(values) < 0.0).argmax())
        raise InputError(
            f"{where}: expected an inverse CDF, whose values rise with the share, got {values[place]:g} and then "
            f"{values[place + 1]:g} of {name}"
        )
    return _between(where, quantiles, float(shares[0]), float(shares[-1]), name)


def _between(where: str, quantiles: Quantiles, least: float, most: float, text: str) -> DrawnRange:
    low, high = (float(one) for one in quantiles(np.array([least, most])))
    if not low < high:
        raise InputError(f"{where}: {text} has only the value {low:g}; write that to fix it")
    return DrawnRange(low, high, quantiles, least, most, text)
