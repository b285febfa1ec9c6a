"""Distributions of a parameter's values as settings.

These are distributions of `scipy.stats` by name, such as `{distribution: norm, loc: 30,
scale: 10}`, choices with weights, and functions that only this Python session has.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any

from advsearch.errors import InputError

DISTRIBUTION = "distribution"
CHOICES = "choices"
WEIGHTS = "weights"
FROM_PYTHON = "from Python"  # the name of a distribution that no file can store
# A function is stored as its values at these probabilities, so that a changed function
# of the same name is noticed.
QUANTILES = (0.05, 0.5, 0.95)


class PythonQuantiles(dict[str, object]):
    """The setting of an inverse CDF from Python, with the function itself.

    Attributes:
        function: function from probabilities in [0, 1] to values.
    """

    def __init__(self, name: str, function: Callable[[float], float]) -> None:
        """Evaluate an inverse CDF at the probabilities `QUANTILES`.

        The values are stored in a file, with six digits.

        Args:
            name: name of the distribution, for the setting and for errors.
            function: inverse CDF: it returns the value below which the distribution has
                a given probability.

        Raises:
            InputError: the function fails.
        """
        quantiles = _evaluate_quantiles(name, function)
        super().__init__(
            {DISTRIBUTION: FROM_PYTHON, "name": name, "quantiles": quantiles}
        )
        self.function = function


def _evaluate_quantiles(name: str, function: Callable[[float], float]) -> list[float]:
    """Return the values of an inverse CDF at `QUANTILES`, with six digits.

    Raises:
        InputError: the function fails; `name` is that of the distribution.
    """
    try:
        return [
            float(f"{float(function(probability)):.6g}") for probability in QUANTILES
        ]
    except Exception as error:  # the user's code may raise anything
        raise InputError(
            f"distribution {name}: expected a function from a probability to a "
            "value (an inverse CDF), or an object with such an `icdf` or `ppf`; it "
            f"raised {type(error).__name__}: {error}"
        ) from error


def _loc_scale(d: Any) -> dict[str, Any]:
    """Return the parameters that a distribution of torch has in common with scipy's."""
    return {"loc": d.loc, "scale": d.scale}


TORCH_DISTRIBUTIONS: Mapping[str, tuple[str, Callable[[Any], dict[str, Any]]]] = {
    **{
        torch_name: (scipy_name, _loc_scale)
        for torch_name, scipy_name in (
            ("Normal", "norm"),
            ("Laplace", "laplace"),
            ("Cauchy", "cauchy"),
        )
    },
    "Gumbel": ("gumbel_r", _loc_scale),
    "Uniform": ("uniform", lambda d: {"loc": d.low, "scale": d.high - d.low}),
    "LogNormal": ("lognorm", lambda d: {"s": d.scale, "scale": d.loc.exp()}),
    "Beta": ("beta", lambda d: {"a": d.concentration1, "b": d.concentration0}),
    "Gamma": ("gamma", lambda d: {"a": d.concentration, "scale": 1.0 / d.rate}),
    "Exponential": ("expon", lambda d: {"scale": 1.0 / d.rate}),
    "HalfNormal": ("halfnorm", lambda d: {"scale": d.scale}),
    "StudentT": ("t", lambda d: {"df": d.df, **_loc_scale(d)}),
    "Weibull": ("weibull_min", lambda d: {"c": d.concentration, "scale": d.scale}),
}
"""For each class of `torch.distributions` its name in scipy, and a function that
returns its parameters there.
"""


def distribution_to_setting(value: object) -> object:
    """Return a parameter's distribution as a setting that a file can hold.

    Args:
        value: a distribution of torch, a frozen one of scipy, another object with an
            `icdf` or a `ppf`, an inverse CDF (a function from a probability to a
            value), or a mapping from choices to their weights. Any other value, also a
            mapping that is a setting already, is returned unchanged.

    Raises:
        InputError: the distribution is of vectors or of integers, or a function is not
            an inverse CDF.
    """
    if isinstance(value, Mapping):
        return _choices_to_setting(value)
    kind = type(value)
    is_of_torch = kind.__module__.startswith("torch.distributions")
    if is_of_torch and kind.__name__ in TORCH_DISTRIBUTIONS:
        name, get_parameters = TORCH_DISTRIBUTIONS[kind.__name__]
        return _make_setting(name, get_parameters(value))
    # A frozen distribution of scipy, such as norm(0, 1), has its family, norm, in
    # `dist`.
    family = getattr(value, "dist", value)
    is_frozen = family is not value
    _check_real_numbers(family, kind)
    if is_frozen and _is_family_of_scipy(family):
        return _frozen_to_setting(value)
    return _inverse_cdf_to_setting(value)


def _inverse_cdf_to_setting(value: object) -> object:
    """Return an object with an inverse CDF, or such a function, as a setting.

    Any other value is returned unchanged.
    """
    kind = type(value)
    inverse_cdf = getattr(value, "icdf", None) or getattr(value, "ppf", None)
    if inverse_cdf and kind.__module__.startswith("torch"):
        return PythonQuantiles(kind.__name__, partial(_evaluate_in_torch, inverse_cdf))
    if inverse_cdf:
        return PythonQuantiles(kind.__name__, inverse_cdf)
    if callable(value) and not isinstance(value, type):
        return PythonQuantiles(str(getattr(value, "__name__", kind.__name__)), value)
    return value


def _check_real_numbers(family: object, kind: type) -> None:
    """Check that a distribution is not one of integers.

    Args:
        family: the distribution, or its family in scipy.
        kind: class of the distribution, for the message.

    Raises:
        InputError: it is one of integers.
    """
    # In scipy only distributions of integers have a probability mass function.
    is_of_integers = hasattr(family, "pmf") and hasattr(family, "ppf")
    if is_of_integers:
        raise InputError(
            f"distribution {getattr(family, 'name', kind.__name__)}: expected one of "
            "real numbers, got one of whole ones; give its values as {choices: [...], "
            "weights: [...]}"
        )


def _evaluate_in_torch(inverse_cdf: Callable[[Any], Any], probability: float) -> float:
    """Return the value of an inverse CDF that takes and returns tensors of torch."""
    # This module does not import torch, which is slow. The function belongs to an
    # object of torch, so it is imported already.
    torch = sys.modules["torch"]
    return float(inverse_cdf(torch.tensor(probability, dtype=torch.float64)))


def _choices_to_setting(value: Mapping[Any, Any]) -> object:
    """Return choices and their weights, such as {"red": 2, "blue": 1}, as a setting.

    A mapping whose values are not all numbers, or which is a setting already, is
    returned unchanged.
    """
    # Weights may be scalars of numpy or torch, which have 0 dimensions. Numbers of
    # Python have no `ndim`.
    weights = [w.item() if getattr(w, "ndim", 1) == 0 else w for w in value.values()]
    are_numbers = all(
        isinstance(w, (int, float)) and not isinstance(w, bool) for w in weights
    )
    is_setting = bool(value.keys() & {DISTRIBUTION, CHOICES})
    if value and are_numbers and not is_setting:
        # An integer too large for a float raises OverflowError. Then the mapping is
        # returned unchanged, and the check of the setting reports it.
        with suppress(OverflowError):
            return {CHOICES: list(value), WEIGHTS: list(map(float, weights))}
    return value


def _is_family_of_scipy(family: Any) -> bool:
    """Return whether a family of distributions, such as `norm`, is one of scipy's.

    A user's family may have the same name, but has another class.
    """
    name = str(getattr(family, "name", ""))
    # the default has a type that no family has
    family_of_scipy = getattr(sys.modules.get("scipy.stats"), name, NotImplemented)
    return type(family) is type(family_of_scipy)


def _frozen_to_setting(frozen: Any) -> dict[str, object]:
    """Return a frozen distribution of scipy as a setting."""
    family = frozen.dist
    # Parameters may have been passed by position or by name. scipy sorts them: first
    # the shape parameters, such as `a` and `b` of the beta distribution.
    shape_values, loc, scale = family._parse_args(*frozen.args, **frozen.kwds)
    # their names in the same order, such as "a, b"; None if there are none
    shape_names = [
        name.strip() for name in (family.shapes or "").split(",") if name.strip()
    ]
    parameters = dict(zip(shape_names, shape_values, strict=True))
    return _make_setting(family.name, {**parameters, "loc": loc, "scale": scale})


def _make_setting(name: str, parameters: Mapping[str, Any]) -> dict[str, object]:
    """Return the setting for a distribution of scipy with its parameters.

    Args:
        name: name of the family in scipy, such as "norm".
        parameters: parameters by name; they are rounded to twelve digits.

    Raises:
        InputError: a parameter is not a single number.
    """
    try:
        return {
            DISTRIBUTION: name,
            **{key: float(f"{float(value):.12g}") for key, value in parameters.items()},
        }
    except (TypeError, ValueError, RuntimeError):
        raise InputError(
            f"distribution {name}: expected one of a single number, got parameters of "
            "several; give one for each parameter"
        ) from None
