"""Distributions of a parameter's values, as settings have them: those of `scipy.stats` by name, such as
`{distribution: norm, loc: 30, scale: 10}`, choices with weights, and functions that only this session has."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from typing import Any

from advsearch.errors import InputError

DISTRIBUTION, CHOICES, WEIGHTS = "distribution", "choices", "weights"

FROM_PYTHON = "from Python"
"""The name of one that no file can hold."""

QUANTILES = (0.05, 0.5, 0.95)
"""Shares at which settings tell one function from another of its name."""


class OwnQuantiles(dict[str, object]):
    """What settings say of an inverse CDF from Python, from shares in [0, 1] to values, which it still has."""

    def __init__(self, name: str, function: Callable[[float], float]) -> None:
        try:
            seen = [float(f"{float(function(share)):.6g}") for share in QUANTILES]
        except Exception as error:  # the user's code may raise anything
            raise InputError(
                f"distribution {name}: expected a function from a share in [0, 1] to a value (an inverse CDF), or an "
                f"object with such an `icdf` or `ppf`; it raised {type(error).__name__}: {error}"
            ) from error
        super().__init__({DISTRIBUTION: FROM_PYTHON, "name": name, "quantiles": seen})
        self.function = function


TORCH: Mapping[str, tuple[str, Callable[[Any], dict[str, Any]]]] = {
    "Normal": ("norm", lambda d: {"loc": d.loc, "scale": d.scale}),
    "Uniform": ("uniform", lambda d: {"loc": d.low, "scale": d.high - d.low}),
    "LogNormal": ("lognorm", lambda d: {"s": d.scale, "scale": d.loc.exp()}),
    "Beta": ("beta", lambda d: {"a": d.concentration1, "b": d.concentration0}),
    "Gamma": ("gamma", lambda d: {"a": d.concentration, "scale": 1.0 / d.rate}),
    "Exponential": ("expon", lambda d: {"scale": 1.0 / d.rate}),
    "Laplace": ("laplace", lambda d: {"loc": d.loc, "scale": d.scale}),
    "Cauchy": ("cauchy", lambda d: {"loc": d.loc, "scale": d.scale}),
    "Gumbel": ("gumbel_r", lambda d: {"loc": d.loc, "scale": d.scale}),
    "HalfNormal": ("halfnorm", lambda d: {"scale": d.scale}),
    "StudentT": ("t", lambda d: {"df": d.df, "loc": d.loc, "scale": d.scale}),
    "Weibull": ("weibull_min", lambda d: {"c": d.concentration, "scale": d.scale}),
}
"""Of `torch.distributions`: what each is called in scipy, and its parameters there."""


def as_setting(given: object) -> object:
    """Return what a file says of a parameter's distribution; anything else as it is.

    Args:
        given: a distribution of torch, a frozen one of scipy, anything else with an `icdf` or a `ppf`, a function from
            a share in [0, 1] to a value (an inverse CDF), or a mapping from choices to their weights.

    Raises:
        InputError: it is of several numbers, or of whole ones, or a function that is no inverse CDF.
    """
    if isinstance(given, Mapping):
        weights = [one.item() if getattr(one, "ndim", 1) == 0 else one for one in given.values()]  # numpy's, torch's
        if not given or given.keys() & {DISTRIBUTION, CHOICES} or not all(map(_is_number, weights)):
            return given
        try:
            return {CHOICES: list(given), WEIGHTS: [float(one) for one in weights]}
        except OverflowError:  # of no float: whoever reads the setting says what it takes
            return given
    kind = type(given)
    if kind.__module__.startswith("torch.distributions") and kind.__name__ in TORCH:
        name, parameters = TORCH[kind.__name__]
        return _named(name, parameters(given))
    family = getattr(given, "dist", given)
    if hasattr(family, "pmf") and hasattr(family, "ppf"):
        raise InputError(
            f"distribution {getattr(family, 'name', kind.__name__)}: expected one of real numbers, got one of whole "
            "ones; give its values as {choices: [...], weights: [...]}"
        )
    if family is not given and _is_scipys(family):
        return _of_scipy(given)
    for method in ("icdf", "ppf"):
        if hasattr(given, method):
            return OwnQuantiles(kind.__name__, _called(given, getattr(given, method)))
    if callable(given) and not isinstance(given, type):
        return OwnQuantiles(str(getattr(given, "__name__", kind.__name__)), given)
    return given


def _is_number(given: object) -> bool:
    return isinstance(given, (int, float)) and not isinstance(given, bool)


def _called(given: object, method: Callable[[Any], Any]) -> Callable[[float], float]:
    if not type(given).__module__.startswith("torch"):
        return method
    torch = sys.modules["torch"]  # it is there: the distribution is one of its own
    return lambda share: float(method(torch.tensor(share, dtype=torch.float64)))


def _is_scipys(family: object) -> bool:
    """Return whether a family is the one that scipy has under its name, which one's own may have too."""
    stats = sys.modules.get("scipy.stats")
    return type(family) is type(getattr(stats, str(getattr(family, "name", "")), NotImplemented))


def _of_scipy(given: Any) -> dict[str, object]:
    shapes, loc, scale = given.dist._parse_args(*given.args, **given.kwds)
    names = [one.strip() for one in (given.dist.shapes or "").split(",") if one.strip()]
    return _named(given.dist.name, {**dict(zip(names, shapes, strict=True)), "loc": loc, "scale": scale})


def _named(name: str, parameters: Mapping[str, Any]) -> dict[str, object]:
    try:
        return {DISTRIBUTION: name, **{key: float(f"{float(one):.12g}") for key, one in parameters.items()}}
    except (TypeError, ValueError, RuntimeError):
        raise InputError(
            f"distribution {name}: expected one of a single number, got parameters of several; give one for each "
            "parameter"
        ) from None
