"""What `printable` takes from an objective."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from small_models import easy

import advsearch
from advsearch.engine.print_terms import off_print, variation
from advsearch.errors import InputError

SHORT: dict[str, Any] = {
    "controls": {"texture": {"epsilon": 0.3}}, "steps": 30, "trials": 6, "verify_spp": 4, "spp": 2, "denoise": "none",
    "baseline": False, "measure": "no",
}  # fmt: skip


def test_one_colour_is_smooth_and_the_set_is_printable() -> None:
    flat = torch.full((4, 4, 3), 0.3)
    assert float(variation(flat)) == 0.0 and float(off_print(flat)) == pytest.approx(0.0, abs=1e-6)
    assert float(off_print(torch.ones(2, 2, 3))) == pytest.approx(0.1 * 3**0.5)
    board = torch.tensor([[0.0, 1.0], [0.0, 1.0]])[..., None].expand(2, 2, 3)
    assert float(variation(board)) == pytest.approx(0.5)  # half of the pixels have a neighbour of another colour


def test_answers_are_nearer_to_ink() -> None:
    with_terms = advsearch.attack("mug", easy(), printable=True, **SHORT)
    without = advsearch.attack("mug", easy(), **SHORT)
    found = with_terms.summary.printability
    assert found is not None and found.answer is not None and without.summary.printability is None
    plain = without.artifacts["texture"]
    cost = found.answer.variation + found.answer.off_print
    assert cost < 0.6 * float(variation(plain) + off_print(plain))
    assert found.answer.off_print < 0.3 * float(off_print(plain))
    assert with_terms.found and without.found
    clean = with_terms.artifacts["texture-original"]
    assert found.clean.variation == pytest.approx(float(variation(clean)), rel=1e-4)


def test_only_colours_are_printed() -> None:
    with pytest.raises(InputError, match="printable: expected a search over the colours of a texture or a patch"):
        advsearch.attack("mug", easy(), printable=True, **{**SHORT, "controls": ("pose",)})
