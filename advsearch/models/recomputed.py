"""A part of a network's work that is done again for its gradient, so that nothing is kept of it meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_flatten, tree_unflatten


class _Recomputed(torch.autograd.Function):
    """`torch.utils.checkpoint` does the same, but not under `autograd.grad`, or not with `mend_batch_norms`."""

    @staticmethod
    def forward(ctx: Any, ask: Callable[[Tensor], Any], structure: list[Any], images: Tensor) -> tuple[Tensor, ...]:
        tensors, form = tree_flatten(ask(images))  # autograd is off in here
        structure.append(form)
        ctx.ask = ask
        ctx.save_for_backward(images)
        ctx.mark_non_differentiable(*(one for one in tensors if not one.is_floating_point()))
        return tuple(tensors)

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor | None) -> tuple[None, None, Tensor]:
        (images,), again = ctx.saved_tensors, torch.is_grad_enabled()  # again: it is to be differentiated once more
        with torch.enable_grad():
            images = images if again else images.detach().requires_grad_()
            tensors, _ = tree_flatten(ctx.ask(images))
        pairs = [pair for pair in zip(tensors, slopes, strict=True) if pair[0].requires_grad and pair[1] is not None]
        if not pairs:
            return None, None, torch.zeros_like(images)
        outputs, given = zip(*pairs, strict=True)
        (slope,) = torch.autograd.grad(outputs, images, given, create_graph=again, allow_unused=True)
        return None, None, torch.zeros_like(images) if slope is None else slope


def recomputed(ask: Callable[[Tensor], Any], images: Tensor) -> Any:
    """Return what `ask` returns of images: tensors, in lists and mappings. Its gradient asks a second time, and takes
    the memory of one part instead of that of all (Chen et al. 2016, *Training Deep Nets with Sublinear Memory Cost*,
    section 3)."""
    structure: list[Any] = []
    tensors = _Recomputed.apply(ask, structure, images)  # type: ignore[no-untyped-call]
    return tree_unflatten(list(tensors), structure[0])
