"""Penultimate features of every kind of network that can be loaded, beside the same numbers worked out by hand."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from advsearch.attacks.objectives import get_objective
from advsearch.models import Model, Preprocessing, load_model
from advsearch.models.features import features_of

SIZE = 12


pytestmark = pytest.mark.usefixtures("one_thread")


def images(count: int = 3) -> Tensor:
    return torch.rand(count, SIZE, SIZE, 3, generator=torch.Generator().manual_seed(0))


def trunk() -> list[nn.Module]:
    """From pictures to 7 features."""
    return [nn.Conv2d(3, 5, 3, stride=2), nn.SiLU(), nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(5, 7), nn.SiLU()]


def sequential(*last: nn.Module) -> nn.Sequential:
    torch.manual_seed(0)
    return nn.Sequential(*trunk(), *(last or (nn.Linear(7, 4),))).eval()


def by_hand(network: nn.Sequential, layers: int) -> Tensor:
    """What the first layers of a network answer."""
    with torch.no_grad():
        found: Tensor = network[:layers](images().permute(0, 3, 1, 2))
        return found


def load(network: Any) -> Model:
    return load_model(network, input_size=SIZE)


def exported(network: nn.Module, folder: Path, lower: Callable[[Any], Any] = lambda program: program) -> Path:
    """Export with a free batch size and store."""
    path = folder / "network.pt2"
    batch = torch.export.Dim("batch", min=1, max=16)
    program = torch.export.export(network, (torch.rand(2, 3, SIZE, SIZE),), dynamic_shapes=({0: batch},))
    torch.export.save(lower(program), path)
    return path


def test_a_module_gives_the_input_of_its_last_linear_layer() -> None:
    network = sequential()
    features = features_of(load(network))
    assert torch.allclose(features(images()), by_hand(network, -1), atol=1e-6)
    assert (features.size, features.penultimate) == (7, True)
    assert features.source_description == "the input of 6 (Linear), 7 numbers"


@pytest.mark.medium
@pytest.mark.parametrize("lower", [lambda p: p, lambda p: p.run_decompositions()], ids=["linear", "addmm"])
@pytest.mark.filterwarnings("ignore::FutureWarning")
def test_an_exported_program_gives_what_its_module_gave(tmp_path: Path, lower: Callable[[Any], Any]) -> None:
    network = sequential()
    features = features_of(load_model(exported(network, tmp_path, lower)))
    assert features.penultimate and features.source_description.startswith("the input of the operator ")
    assert torch.allclose(features(images()), by_hand(network, -1), atol=1e-6)


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
@pytest.mark.parametrize("kind", ["module", "program", "script", "function"])
def test_the_gradient_is_that_of_a_central_difference_and_batches_agree(kind: str, tmp_path: Path) -> None:
    network: Any = sequential()
    if kind == "program":
        model = load_model(exported(network, tmp_path))
    elif kind == "script":
        model = load(torch.jit.trace(network, torch.rand(1, 3, SIZE, SIZE)))
    elif kind == "function":
        model = Model(lambda x: network(x), "f", tuple("abcd"), Preprocessing((SIZE, SIZE)), batch_limits=(1, 2))
    else:
        model = load(network)
    features = features_of(model)
    assert torch.allclose(features(images()), torch.cat([features(one) for one in images()]), atol=1e-6)
    assert features(images()).dtype == torch.float32 and features(images()[0]).shape == (1, features.size)

    objective = get_objective("feature_distance", features=features, clean=images()[0])
    leaf = images()[1:2].clone().requires_grad_()
    (gradient,) = torch.autograd.grad(objective(torch.zeros(1, 4), leaf, (0,)).sum(), leaf)
    direction = gradient / gradient.norm()
    with torch.no_grad():
        ends = [objective(torch.zeros(1, 4), leaf + step * direction, (0,)) for step in (1e-2, -1e-2)]
    assert float(ends[0] - ends[1]) / 2e-2 == pytest.approx(float(gradient.norm()), rel=1e-2)
