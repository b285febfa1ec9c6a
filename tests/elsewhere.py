"""A device that is not the CPU, on any machine: its tensors lie on the CPU but refuse to meet others.

PyTorch knows it as `meta`; an operation between one of its tensors and one on the CPU fails, as it does with an
accelerator. Values can be read (`float`, `tolist`, `cpu`), arrays cannot be shared (`numpy`).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

ELSEWHERE = torch.device("meta")


class Away(Tensor):
    """A tensor on the device; `held` has its values on the CPU."""

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> Away:
        made = Tensor._make_wrapper_subclass(
            cls,
            held.size(),
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            device=ELSEWHERE,
        )
        made.held = held
        return made

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:  # type: ignore[override]
        return carried_out(func, args, kwargs or {})


def carried_out(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """Do an operation with the values, and put what comes out on the device of what went in.

    Raises:
        RuntimeError: tensors of both devices went in.
    """
    given = [one for one in tree_leaves((args, kwargs)) if isinstance(one, Tensor)]
    away = [isinstance(one, Away) for one in given]
    moves = func.overloadpacket in (torch.ops.aten._to_copy, torch.ops.aten.copy_)
    if any(away) and not all(away) and not moves:
        raise RuntimeError(f"{func}: expected all tensors on one device, got {[str(one.device) for one in given]}")
    named = kwargs.get("device")
    on_device = any(away) if named is None else torch.device(named) == ELSEWHERE
    if named is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    plain = tree_map(lambda one: one.held if isinstance(one, Away) else one, (args, kwargs))
    found = func(*plain[0], **plain[1])
    return tree_map(lambda one: Away(one) if on_device and isinstance(one, Tensor) else one, found)


class _Operations(TorchDispatchMode):
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return carried_out(func, args, kwargs or {})


class _Makers(TorchFunctionMode):
    """`torch.tensor`, `new_tensor` and `tolist` go by the CPU, of themselves or here."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func is torch.tensor:
            device = kwargs.pop("device", "cpu")
            return func(*args, **kwargs).to(device)
        if func is Tensor.new_tensor:
            return torch.tensor(args[1], dtype=kwargs.get("dtype", args[0].dtype)).to(args[0].device)
        if func is Tensor.tolist:
            return func(args[0].cpu())
        return func(*args, **kwargs)


@contextmanager
def elsewhere() -> Iterator[None]:
    """While it lasts, `ELSEWHERE` is such a device."""
    with _Makers(), _Operations():  # type: ignore[no-untyped-call]
        yield
