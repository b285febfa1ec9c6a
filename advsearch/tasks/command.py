"""Command: how far the action that a policy commands leaves an envelope about the one
in the clean scene.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from advsearch.extend import (
    InputError,
    Model,
    Task,
    errors,
    models,
    stored_files,
    tasks,
)

Numbers = tuple[float, ...]

MOST = 4096  # numbers of a state, names of one, and elements of an action
LARGEST = 1 << 20  # bytes of a file with a state

INSIDE = "action within its envelope"
REACHED = "action within the envelope of the target"
"""Labels of actions; others are outside of their envelope."""

SHOWN = 4  # elements of an action that are said in words


@dataclass(frozen=True, kw_only=True)
class Command(Task):
    """A policy commands about the action that it commands in the clean scene: open
    loop, one picture, one action.

    The output is actions (N, A), in whatever units the policy has. The truth is the
    clean action c (A,), from one picture of the clean scene. Let e be the envelope: the
    loss is max |a - c| / e over the elements, less 1. With a target t, a success is max
    |a - t| / e of at most 1.

    Args:
        state: what the policy gets beside pictures: numbers, or a list of numbers, by
            name, or a JSON file of such.
        envelope: how far an element may be off, in its own unit: a number, or one for
            each element.
        names: of the elements, a list or a text with commas; "action 1" and so on
            without.
        units: of the elements, likewise, or one for all.

    Raises:
        InputError: a value of another type, or out of range.
        FileFormatError: the file is no JSON of such numbers, or too large.
    """

    name = "command"
    labelled = False
    needs_all_images = True

    state: Any = field(default_factory=dict)
    envelope: Any = None
    names: Any = ()
    units: Any = ()
    # (A,)
    clean: Tensor | None = field(
        default=None, compare=False, repr=False, metadata=tasks.FROM_RUN
    )

    def __post_init__(self) -> None:
        # what files and lists say, in the one form that compares and is written down
        put = object.__setattr__
        put(self, "state", _state(self.state))
        for option in ("names", "units"):
            given = getattr(self, option)
            texts = (
                [part.strip() for part in given.split(",")]
                if isinstance(given, str) and given
                else [*(given or ())]
            )
            if len(texts) > MOST or not all(
                isinstance(one, str) and one and one.isprintable() for one in texts
            ):
                expected = "expected texts, or one with commas between them"
                raise InputError(
                    f"task command: {option}: {expected}, got {given!r:.80}"
                )
            put(self, option, tuple(texts))
        if len(set(self.names)) < len(self.names):
            raise InputError(
                "task command: names: expected different names, got "
                f"{', '.join(self.names):.80}"
            )
        if self.envelope is not None:
            put(self, "envelope", _numbers("envelope", self.envelope))
            if min(self.envelope) <= 0.0:
                raise InputError(
                    "task command: envelope: expected numbers over 0, "
                    f"got {min(self.envelope):g}"
                )

    def wrapped(self, network: Callable[..., Any]) -> Callable[..., Any]:
        if isinstance(network, models.AllAtOnce):
            inner: Any = self.wrapped(network.network)
            return models.AllAtOnce(inner, network.cameras, network.layout)
        alone = network.network if isinstance(network, models.WithState) else network
        return (
            models.WithState(alone, self.state)
            if self.state or hasattr(alone, "select_action")
            else network
        )

    def read(self, returned: Any, count: int) -> Tensor:
        """Return actions (count, A) of (count, A) or (count,), which may be the first
        of a tuple, or `action` of a mapping. Raises ValueError where it is none, or has
        another size than the options.
        """
        found = returned.get("action") if isinstance(returned, Mapping) else returned
        found = found[0] if type(found) in (tuple, list) and found else found
        if (
            not isinstance(found, Tensor)
            or not found.is_floating_point()
            or found.shape[:1] != (count,)
        ):
            raise ValueError(
                "expected an action for each picture, (N, A), or a "
                "mapping with these under action"
            )
        found = found[:, None] if found.ndim == 1 else found
        if found.ndim != 2 or not 1 <= found.shape[1] <= MOST:
            raise ValueError(
                f"expected one action for each picture, (N, A), with A from 1 to {MOST}"
            )
        for option in ("envelope", "names", "units"):
            if (size := len(getattr(self, option) or ())) > (
                option != "names"
            ) and size != found.shape[1]:
                raise ValueError(
                    f"expected actions of {size} elements, as task command has {option}"
                )
        return found.float()

    def on(
        self, model: Model, *, target: str | None = None, minimise: bool = False
    ) -> Command:
        """See `Task.on`: the target is an action, ``0.1,-0.3``, or some of its
        elements, ``yaw rate=-0.3``. Raises InputError: there is no envelope, the model
        was loaded for another task or with names of classes, the target is none, or the
        clean action is sought.
        """
        if model.read is None:
            raise InputError(
                f"model {model.name}: it was loaded for its logits; load "
                'it with task="command"'
            )
        if model.labels:
            raise InputError(
                "labels: task command has no classes; this is a "
                "classifier: give a policy as `model`"
            )
        if self.envelope is None:
            raise InputError(
                "task command: envelope: expected how far an action may be off, in its "
                "unit, or a list with a number "
                "for each element, got none; write `task='command={envelope: 0.2}'`"
            )
        if minimise:
            raise InputError(
                "minimise: the clean action is within its envelope "
                "already; leave it out"
            )
        return replace(self, target=None if target is None else self._target(target))

    def _target(self, text: str) -> Tensor:
        """The action in a text, (A,), with NaN for the elements that it does not
        name.
        """
        parts = [part.rpartition("=") for part in str(text).split(",")]
        wanted = torch.tensor(
            _numbers("target", [number.strip() for _, _, number in parts])
        )
        elements = [name.strip() for name, _, _ in parts]
        if not any(elements):
            return wanted
        if unknown := [name for name in elements if name not in self.names]:
            known = ", ".join(self.names) or "none; give `names`"
            raise InputError(
                f"target: expected elements that `names` has ({known}), "
                f"got {unknown[0]!r}"
            )
        action = torch.full((len(self.names),), math.nan)
        action[[self.names.index(name) for name in elements]] = wanted
        return action

    @property
    def calibrates(self) -> bool:
        return self.clean is None

    def after_calibration(self, output: Tensor, truth: Tensor | None) -> Command:
        """See `Task.after_calibration`. Raises InputError where the clean action is not
        finite, or the target has another size.
        """
        if not self.calibrates:
            return self
        clean = output[0].detach().float()
        if not bool(clean.isfinite().all()):
            raise InputError(
                "task command: the clean action has NaN or infinity, and "
                "nothing can be judged by it"
            )
        if self.target is not None:
            if len(self.target) != len(clean):
                raise InputError(
                    f"target: expected an action of {len(clean)} "
                    f"elements, got {len(self.target)}"
                )
            # an action would be right, and what is sought
            if float(self.loss(clean[None], self.target)) <= 1.0:
                raise InputError(
                    "target: expected an action more than two envelopes from the clean "
                    "one, which is "
                    f"{self._said(clean.tolist())}"
                )
        return replace(self, clean=clean)

    @property
    def remarks(self) -> tuple[str, ...]:
        if self.clean is None:
            return ()
        around = self._said(
            [*self.envelope] * (1 if len(self.envelope) > 1 else len(self.clean)),
            sign="± ",
        )
        return (
            f"The clean action is {self._said(self.clean.tolist())}, from one picture "
            "of the clean scene; its envelope "
            f"is {around}. An action is judged by itself: nothing moves, and no later "
            "picture follows from it.",
        )

    @property
    def goal(self) -> str:
        return (
            "a target action"
            if self.target is not None
            else "an action outside the envelope of the clean one"
        )

    def check(self, facts: tasks.Facts) -> None:
        if facts.label is not None:
            raise InputError(
                "label: task command has no classes, the clean action is "
                "what is right; leave it out"
            )

    def truth(self, facts: tasks.Facts) -> Tensor | None:
        self.check(facts)
        return self.clean

    def truth_names(self, truth: Tensor | None) -> tuple[str, ...]:
        return () if truth is None else (self._said(truth.tolist()),)

    def _off(self, output: Tensor, centre: Tensor | None) -> Tensor:
        """How many envelopes each element is over an action, (N, A); 0 where that is
        NaN.
        """
        if centre is None:
            raise InputError(
                "task command: expected a clean picture that it was shown first"
            )
        known = centre.to(output).where(
            ~centre.isnan().to(output.device), output.detach()
        )
        return (output - known) / output.new_tensor(self.envelope)

    def loss(self, output: Tensor, truth: Tensor | None) -> Tensor:
        return self._off(output, truth).abs().amax(dim=1) - 1.0

    def predictions(
        self, output: Tensor, count: int = 1
    ) -> list[tuple[tasks.Prediction, ...]]:
        return [(tasks.Prediction(self._said(action)),) for action in output.tolist()]

    def said(
        self, output: Tensor, truth: Tensor | None, margins: Sequence[float]
    ) -> list[tasks.Said]:
        """See `Task.said`: whether an action left its envelope, and which element is
        furthest out. Beside it stand the action and the clean one, also in words, and
        how many envelopes lie between them.
        """
        assert truth is not None
        found: list[tasks.Said] = []
        reached = (
            [False] * len(output)
            if self.target is None
            else self.loss(output, self.target) <= 0.0
        )
        for off, action, margin, hit in zip(
            self._off(output, truth), output.tolist(), margins, reached, strict=True
        ):
            furthest = int(off.abs().argmax())
            side = (
                f"{self._name(furthest)} "
                f"{'above' if off[furthest] > 0.0 else 'below'} it"
            )
            label = (
                REACHED
                if hit
                else INSIDE
                if margin >= 0.0
                else f"action outside its envelope ({side})"
            )
            text = (
                f"{self._said(action)}, clean {self._said(truth.tolist(), named=False)}"
            )
            kept = {
                "action": action,
                "clean": truth.tolist(),
                "envelopes": 1.0 - margin,
                "text": text,
            }
            found.append((tasks.Prediction(label), kept))
        return found

    def _name(self, place: int) -> str:
        return self.names[place] if self.names else f"action {place + 1}"

    def _said(
        self, action: Sequence[float], *, sign: str = "", named: bool = True
    ) -> str:
        units = self.units if len(self.units) > 1 else [*self.units] * len(action)
        parts = [
            f"{self._name(place) + ' ' if named else ''}{sign}{number:.3g} "
            f"{units[place] if units else ''}".rstrip()
            for place, number in enumerate(action[:SHOWN])
        ]
        return ", ".join(parts) + (
            f" and {len(action) - SHOWN} more" if len(action) > SHOWN else ""
        )


def _numbers(option: str, given: Any) -> Numbers:
    """The finite numbers in a number, a text with one, or a list of such."""
    listed = given.tolist() if hasattr(given, "tolist") else given
    listed = list(listed) if isinstance(listed, (list, tuple)) else [listed]
    try:
        if any(isinstance(one, bool) for one in listed):
            raise ValueError
        found = tuple(float(one) for one in listed)
    except (TypeError, ValueError, OverflowError):
        found = ()
    if not 1 <= len(found) <= MOST or not all(
        math.isfinite(one) and abs(one) < 1e30 for one in found
    ):
        got = f"{len(listed):,} of them" if len(listed) > MOST else f"{given!r:.80}"
        raise InputError(
            f"task command: {option}: expected a finite number, or a list of 1 to "
            f"{MOST} of them, got {got}"
        )
    return found


def _state(given: Any) -> dict[str, Numbers]:
    """The numbers of a state by name, from a mapping or the file that a text names."""
    if isinstance(given, (str, Path)) and str(given):
        path = Path(given).expanduser()
        try:
            given = stored_files.parse_json(
                stored_files.read_text(
                    path, "a state: numbers by name in JSON", LARGEST
                ),
                finite=True,
            )
        except OSError as error:
            raise errors.FileFormatError(
                f"task command: state: {path} cannot be read "
                f"({error.strerror or error})"
            ) from None
        except ValueError as error:
            raise errors.FileFormatError(
                f"{path}: expected a state: numbers by name in JSON ({error})"
            ) from None
    if not given:
        return {}
    if not isinstance(given, Mapping) or not all(
        isinstance(name, str) and name for name in given
    ):
        raise InputError(
            f"task command: state: expected numbers by name, such as {{speed: 1.5}}, "
            f"or a JSON file, got {given!r:.80}"
        )
    found = {
        name: _numbers(f"state {name:.40}", numbers) for name, numbers in given.items()
    }
    if sum(map(len, found.values())) > MOST:
        raise InputError(
            f"task command: state: expected at most {MOST:,} numbers in all"
        )
    return found
