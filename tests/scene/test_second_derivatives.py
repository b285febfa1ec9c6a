"""Own operations of torch: those that are exact any number of times are, and no other is differentiated twice."""

import ast
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
import torch
from scipy.sparse import linalg
from torch import Tensor

import advsearch
from advsearch.controls.geometry import _Solve
from advsearch.scene.color import LINEAR_LIMIT, linear_to_srgb
from advsearch.scene.formation import ImageFormation
from advsearch.scene.mitsuba_backend.transport import PathVertices
from advsearch.scene.transport.matrix import CELL_SIZE, TextureTransport

ROUNDED = 2e-3
"""Shares of a transport matrix have 16 bits, each way by itself."""


def solved() -> Callable[[Tensor], Tensor]:
    matrix = scipy.sparse.diags([[4.0] * 5, [-1.0] * 4, [-1.0] * 4], [0, 1, -1]).tocsc()
    return lambda x: _Solve.apply(x.reshape(5, 2), linalg.splu(matrix))  # type: ignore[no-untyped-call]


def sparse() -> Callable[[Tensor], Tensor]:
    from advsearch.predictors.surface_light.arrangement import multiply_sparse

    matrix = scipy.sparse.random(7, 5, 0.5, "csr", random_state=0)
    return lambda x: multiply_sparse(matrix, x.reshape(5, 2))


def transport() -> Callable[[Tensor], Tensor]:
    """Of two texels, beside each other, four pixels see some."""
    made, shape = TextureTransport((2, 2), (CELL_SIZE, CELL_SIZE)), (CELL_SIZE, CELL_SIZE, 3)
    places = torch.tensor([[0.1, 0.3], [0.2, 0.3], [0.3, 0.3], [0.3, 0.4]])
    weight = torch.arange(1.0, 13.0).reshape(4, 3) / 6.0
    made.add_pass(
        [PathVertices(torch.arange(4), places, weight, torch.tensor([True, True, False, True]))], pass_weight=1.0
    )
    made.finish()
    spread = torch.randn(10, *shape, generator=torch.Generator().manual_seed(1)) / CELL_SIZE
    return lambda x: made(torch.einsum("n,nhwc->hwc", x.float(), spread)).double()


OPERATIONS = {"_Solve": [solved], "LinearMap": [sparse, transport]}
"""Not linear: the tests at the end have them."""


IN_AN_ISLAND = pytest.param(sparse, marks=pytest.mark.island("advsearch.predictors.surface_light"))


@pytest.mark.parametrize("made", [solved, IN_AN_ISLAND, transport])
def test_an_exact_operation_is_differentiated_any_number_of_times(made: Any) -> None:
    """As the dense matrix of the same numbers is: of the sum of cubes, three times."""
    operation = made()
    dense = torch.stack([operation(one).detach().flatten() for one in torch.eye(10, dtype=torch.float64)], dim=1)
    x = torch.from_numpy(np.random.default_rng(0).normal(size=10)).requires_grad_()
    found = []

    def by_operation(at: Tensor) -> Tensor:
        return operation(at).flatten()  # type: ignore[no-any-return]

    def by_matrix(at: Tensor) -> Tensor:
        return dense @ at

    for of in (by_operation, by_matrix):
        value, derivatives = of(x).pow(3).sum(), list[Tensor]()
        for _ in range(3):
            (slope,) = torch.autograd.grad(value, x, create_graph=True)
            derivatives.append(slope.detach())
            value = (slope * torch.arange(1.0, 11.0)).sum()
        found.append(torch.stack(derivatives))
    size = found[1].abs().amax(dim=1, keepdim=True)
    assert bool((size > 0.0).all())
    torch.testing.assert_close(found[0] / size, found[1] / size, rtol=0.0, atol=ROUNDED)


def test_a_shown_picture_is_the_encoded_one() -> None:
    """Picture and derivative bit for bit, below black, above white and at the bend too; and a second derivative."""
    formation, generator = ImageFormation(gain=1.37), torch.Generator().manual_seed(0)
    radiance = torch.rand(8, 8, 3, generator=generator) - 0.1
    radiance[0, :5, 0] = torch.tensor([0.0, 1.0 / 1.37, LINEAR_LIMIT / 1.37, math.inf, -1.0])
    cotangent, found = torch.randn(8, 8, 3, generator=generator), []
    for shown in (formation.map_to_display, lambda one: linear_to_srgb(one * 1.37)):
        at = radiance.clone().requires_grad_()
        picture = shown(at)
        picture.backward(cotangent)
        assert at.grad is not None
        found.append((picture.detach(), at.grad))
    assert torch.equal(found[0][0], found[1][0]) and torch.equal(found[0][1], found[1][1])
    assert torch.autograd.gradgradcheck(
        formation.map_to_display, torch.linspace(0.02, 0.6, 9).double().requires_grad_()
    )


ONCE = {"_Radiance", "_Differences", "_OnceDifferentiable"}


CURVES = {"_SrgbDisplay", "_Recomputed"}


def test_every_operation_is_one_of_these() -> None:
    """A new one is exact, and is tested above, or refuses a second derivative."""
    found = set()
    for file in Path(advsearch.__file__).parent.rglob("*.py"):
        text = file.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)) if "autograd.Function" in text else ():
            if isinstance(node, ast.ClassDef) and re.search(r"\bFunction\b", " ".join(map(ast.unparse, node.bases))):
                found.add(node.name)
    assert found == ONCE | OPERATIONS.keys() | CURVES
