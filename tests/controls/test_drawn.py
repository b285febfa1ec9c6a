"""Values that vary by chance: distributions of torch, scipy and Python, and choices with weights, through the inverse
CDF."""

import json
from collections import Counter
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats
from torch.distributions import Beta, Exponential, Gumbel, Kumaraswamy, LogNormal, Normal, Uniform
from torch.distributions import Laplace as TorchLaplace

from advsearch.attacks.domain import SampleSequence
from advsearch.controls import CameraControl, EnvironmentControl
from advsearch.controls.base import NumberControl
from advsearch.controls.ranges import DistributionRange
from advsearch.distributions import distribution_to_setting
from advsearch.engine.loading import load_scene

MUG = load_scene("mug").description
NORM = {"distribution": "norm", "loc": 30.0, "scale": 10.0}


def azimuths(given: Any, shares: np.ndarray) -> np.ndarray:
    """The azimuths at coordinates, as a search over these conditions has them."""
    bound = CameraControl(azimuth=given).bind(MUG)
    return np.array([float(bound.compute_values(torch.tensor([share]))["azimuth"]) for share in shares.tolist()])


@pytest.mark.parametrize(
    ("given", "setting"),
    [
        (Normal(30.0, 10.0), NORM),
        (stats.norm(30, 10), NORM),
        (stats.norm(loc=30, scale=10), NORM),
        (NORM, NORM),
        (Uniform(0.0, 90.0), {"distribution": "uniform", "loc": 0.0, "scale": 90.0}),
        (stats.truncnorm(-1, 2, scale=9), {"distribution": "truncnorm", "a": -1.0, "b": 2.0, "loc": 0.0, "scale": 9.0}),
        ({"studio": 0.7, "noon": 0.3}, {"choices": ["studio", "noon"], "weights": [0.7, 0.3]}),
        ([0, 90], [0, 90]),
    ],
)
def test_what_a_file_says_of_a_distribution(given: Any, setting: Any) -> None:
    assert distribution_to_setting(given) == setting
    assert json.loads(json.dumps(setting)) == setting


@pytest.mark.parametrize(
    "distribution",
    [
        *(Normal(20.0, 5.0), Uniform(1.0, 3.0), LogNormal(1.0, 0.5), Beta(2.0, 5.0), Exponential(0.5)),
        *(Gumbel(3.0, 1.0), TorchLaplace(1.0, 2.0)),
    ],
    ids=lambda one: type(one).__name__,
)
def test_torchs_distributions_are_scipys_of_other_names(distribution: torch.distributions.Distribution) -> None:
    """Of so many of torch's own samples the two ends and the middle are where the quantiles are."""
    torch.manual_seed(0)
    drawn = distribution.sample((40_000,)).double().numpy()
    spec = CameraControl(azimuth=distribution).specs["azimuth"]
    assert isinstance(spec, DistributionRange)
    for share in (0.1, 0.5, 0.9):
        value = float(
            spec.interpolate(
                torch.tensor(
                    [(share - spec.lower_probability) / (spec.upper_probability - spec.lower_probability)],
                    dtype=torch.float64,
                )
            )
        )
        assert abs((drawn < value).mean() - share) < 0.01


def test_even_draws_of_u_have_the_distribution_and_stay_even() -> None:
    """Sobol points stay a net: what they draw is nearer to the distribution than independent draws could be."""
    points = SampleSequence(1, "sobol", 0).points(0, 512)[:, 0]
    found = azimuths(Normal(30.0, 10.0), points)
    assert stats.kstest(found, stats.norm(30, 10).cdf).statistic < 0.005
    assert abs(found.mean() - 30.0) < 0.1 and abs(found.std() - 10.0) < 0.1


def test_a_function_is_an_inverse_cdf() -> None:
    shares = np.linspace(0.0, 1.0, 9)
    assert azimuths(lambda share: 30.0 + 60.0 * share, shares) == pytest.approx(30.0 + 60.0 * shares, abs=1e-4)
    own = Kumaraswamy(torch.tensor(2.0), torch.tensor(3.0))  # scipy has none, and torch has its icdf
    assert azimuths(own, np.array([0.5])) == pytest.approx(float(own.icdf(torch.tensor(0.5))), abs=1e-4)


def test_an_endless_tail_is_left_out_on_both_sides() -> None:
    """Also where a parameter's bound is far beyond it: 4.75 deviations."""
    spec = CameraControl(exposure=Normal(0.0, 0.5)).specs["exposure"]
    assert isinstance(spec, DistributionRange) and (spec.low, spec.high) == pytest.approx((-2.377, 2.377), abs=1e-3)


def test_derivatives_reach_what_is_drawn() -> None:
    bound = CameraControl(azimuth=Normal(30.0, 10.0)).bind(MUG)
    u = torch.tensor([0.5], requires_grad=True)
    (slope,) = torch.autograd.grad(bound.compute_values(u)["azimuth"], u)
    assert float(slope) == pytest.approx(10.0 * np.sqrt(2.0 * np.pi), rel=1e-2)


@pytest.mark.parametrize(
    ("weights", "counts"),
    [
        ({"studio": 0.7, "noon": 0.3}, {"studio": 7, "noon": 3}),
        ({"studio": 2, "noon": 1}, {"studio": 2, "noon": 1}),
        ({"studio": 1, "noon": 0}, {"studio": 1}),
        ({"studio": np.float32(3.0), "noon": torch.tensor(1.0)}, {"studio": 3, "noon": 1}),
        ({"studio": 0.7123, "noon": 0.2877}, {"studio": 712, "noon": 288}),
    ],
)
def test_weights_are_shares(weights: dict[str, float], counts: dict[str, int]) -> None:
    control = EnvironmentControl(which=weights)
    bound = control.bind(control.prepare(MUG))
    assert isinstance(bound, NumberControl)
    size = sum(counts.values())
    assert bound.groups[0].options == size if len(counts) > 1 else True
    places = (torch.arange(size) + 0.5) / size
    assert Counter(bound.describe(one[None])["environment.which"]["value"] for one in places) == counts
