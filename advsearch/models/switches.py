"""torch's global switches, which the code of users turns: all our own code runs with them as torch comes.

A network is called with the type and device for new tensors that its own code has chosen. Gradients are ours to switch.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn

CPU = torch.device("cpu")


@dataclass(frozen=True)
class Switches:
    """The state of torch's switches.

    Attributes:
        dtype, device: of new tensors.
        gradients: whether operations are recorded, in this thread.
        deterministic: 0, 1 where operations that are not deterministic warn, 2 where they raise.
        anomalies: whether NaN in a derivative raises.
    """

    dtype: torch.dtype = torch.float32
    device: torch.device = CPU
    gradients: bool = True
    deterministic: int = 0
    anomalies: bool = False

    @classmethod
    def now(cls) -> Switches:
        """Return them as they are."""
        return cls(
            torch.get_default_dtype(),
            torch.get_default_device(),
            torch.is_grad_enabled(),
            torch.get_deterministic_debug_mode(),
            torch.is_anomaly_enabled(),
        )

    def turn(self) -> None:
        """Turn all of them."""
        self.turn_for_new_tensors()
        torch.set_grad_enabled(self.gradients)
        torch.set_deterministic_debug_mode(self.deterministic)
        torch.autograd.set_detect_anomaly(self.anomalies)

    def turn_for_new_tensors(self) -> None:
        """Turn those for new tensors."""
        torch.set_default_dtype(self.dtype)
        if torch.get_default_device() != self.device:
            torch.set_default_device(None if self.device.type == "cpu" else self.device)


PLAIN = Switches()

_outside: list[Switches] = []
"""As `plainly` found them, the outermost first."""


@contextmanager
def plainly() -> Iterator[None]:
    """Turn torch's switches as it comes, and back at the end: also out of `torch.inference_mode`."""
    with torch.inference_mode(False) if torch.is_inference_mode_enabled() else nullcontext():
        found = Switches.now()
        _outside.append(found)
        if found != PLAIN:
            PLAIN.turn()
        try:
            yield
        finally:
            _outside.pop()
            if Switches.now() != found:
                found.turn()


def turned_by_code() -> Switches:
    """Return the switches as the code of a network has turned them just now, or had before; they are `PLAIN` then."""
    found = Switches.now()
    if found == PLAIN:
        return _outside[0] if _outside else PLAIN
    PLAIN.turn()
    return found


def called_under(module: nn.Module, switches: Switches) -> None:
    """Have a module called with switches of its own for new tensors, and those of the caller afterwards."""
    if (switches.dtype, switches.device) == (PLAIN.dtype, PLAIN.device):
        return
    before: list[Switches] = []

    def enter(*_: Any) -> None:
        before.append(Switches.now())
        switches.turn_for_new_tensors()

    def leave(*_: Any) -> None:
        before.pop().turn_for_new_tensors()

    module.register_forward_pre_hook(enter)
    module.register_forward_hook(leave, always_call=True)
