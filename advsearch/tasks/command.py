"""Task for the actions of a policy, such as the commands of a robot.

An action is right if it is within an envelope around the action for the clean scene.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
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

MAX_NUMBERS = 4096  # maximum count of numbers in a state, and of elements in an action
MAX_STATE_BYTES = 1 << 20  # maximum size of a file with a state

INSIDE = "action within its envelope"
REACHED = "action within the envelope of the target"
"""Labels of actions; others are outside their envelope."""

MAX_FORMATTED_ELEMENTS = 4  # maximum number of elements in the text of an action


@dataclass(frozen=True, kw_only=True)
class Command(Task):
    """Compare the action of a policy with its action in the clean scene.

    The loop is open: each action is for a single image, and has no effect on later
    images. The output is actions (N, A), in the units of the policy. The truth is the
    clean action c (A,), for one image of the clean scene. With the envelope e the loss is
    max |a - c| / e over the elements, minus 1. With a target t, a success is max |a - t|
    / e of at most 1.

    Args:
        state: inputs of the policy other than images: numbers, or lists of numbers, by
            name, or a JSON file of such.
        envelope: maximum deviation of an element in its unit: a number, or one for each
            element.
        names: names of the elements, a list or a string with commas; "action 1" and so
            on without it.
        units: units of the elements, likewise, or one for all.

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
    # The clean action, (A,).
    clean_action: Tensor | None = field(
        default=None, compare=False, repr=False, metadata=tasks.FROM_RUN
    )

    def __post_init__(self) -> None:
        """Parse and check the options.

        They are stored in one form, so that tasks with equal options compare as equal.
        """
        set_field = object.__setattr__  # the dataclass is frozen
        set_field(self, "state", _load_state(self.state))
        set_field(self, "names", _parse_names("names", self.names))
        set_field(self, "units", _parse_names("units", self.units))
        if len(set(self.names)) < len(self.names):
            raise InputError(
                "task command: names: expected different names, got "
                f"{', '.join(self.names):.80}"
            )
        if self.envelope is not None:
            set_field(self, "envelope", _parse_envelope(self.envelope))

    def wrap_network(self, network: Callable[..., Any]) -> Callable[..., Any]:
        """Wrap a policy so that it gets the state of the robot together with images.

        Without a state, `self.state` is empty and the network is returned unchanged. A
        policy of LeRobot is an exception: it has a method `select_action`, which only
        `WithState` calls, so that it is wrapped with the empty state.
        """
        if isinstance(network, models.AllAtOnce):
            # `AllAtOnce` passes the images of all cameras to a policy. The policy inside
            # of it is wrapped.
            policy_with_state: Any = self.wrap_network(network.network)
            return models.AllAtOnce(policy_with_state, network.cameras, network.layout)
        policy = network
        if isinstance(network, models.WithState):
            # It was wrapped for another task, whose state is replaced.
            policy = network.network
        is_lerobot_policy = hasattr(policy, "select_action")
        if self.state or is_lerobot_policy:
            return models.WithState(policy, self.state)
        return network

    def read(self, returned: Any, count: int) -> Tensor:
        """Read actions (count, A) from what a policy returned.

        The actions are the tensor itself, the first item of a tuple or list, or the
        item "action" of a mapping. Actions of one element may have the shape (count,).

        Raises:
            ValueError: there are no actions, or their number of elements differs from
                that of the options.
        """
        actions = _find_actions(returned, count)
        if actions.ndim == 1:
            actions = actions[:, None]
        if actions.ndim != 2 or not 1 <= actions.shape[1] <= MAX_NUMBERS:
            raise ValueError(
                "expected one action for each picture, (N, A), with A from 1 to "
                f"{MAX_NUMBERS}"
            )
        self._check_element_count(actions.shape[1])
        return actions.float()

    def _check_element_count(self, n_elements: int) -> None:
        """Check that options with a value for each element have as many as an action.

        Raises:
            ValueError: an option has more or fewer.
        """
        for option in ("envelope", "names", "units"):
            n_values = len(getattr(self, option) or ())
            if not n_values:
                continue
            # One envelope or unit is for all elements.
            is_shared = n_values == 1 and option != "names"
            if n_values != n_elements and not is_shared:
                raise ValueError(
                    f"expected actions of {n_values} elements, as task command has {option}"
                )

    def on(
        self, model: Model, *, target: str | None = None, minimise: bool = False
    ) -> Command:
        """Return the task for one policy.

        Args:
            model: the policy, loaded for this task.
            target: an action, ``0.1,-0.3``, or some of its elements by name, ``yaw
                rate=-0.3``; None for any action outside of the envelope.
            minimise: must be False: a right action can't be sought, since the clean
                action is right already.

        Raises:
            InputError: there is no envelope, the model was loaded for another task or
                has names of classes, the target is no action, or `minimise` is set.
        """
        _check_is_policy(model)
        self._check_has_envelope()
        if minimise:
            raise InputError(
                "minimise: the clean action is already within its envelope; leave it "
                "out"
            )
        parsed_target = None if target is None else self._parse_target(target)
        return replace(self, target=parsed_target)

    def _check_has_envelope(self) -> None:
        """Raise InputError if the user has set no envelope."""
        if self.envelope is None:
            raise InputError(
                "task command: envelope: expected the allowed deviation of an action, "
                "in its unit, or a list with a number for each element, got none; write "
                "`task='command={envelope: 0.2}'`"
            )

    def _parse_target(self, text: str) -> Tensor:
        """Parse a target action to numbers, (A,).

        The text has numbers for all elements ("0.1,-0.3") or for some of them by name
        ("yaw rate=-0.3"). Elements that are not named are NaN: any value is accepted.
        """
        # ("yaw rate", "=", "-0.3"), or ("", "", "0.1") without a name
        assignments = [part.rpartition("=") for part in str(text).split(",")]
        numbers = [number.strip() for _, _, number in assignments]
        values = torch.tensor(_parse_numbers("target", numbers))
        element_names = [name.strip() for name, _, _ in assignments]
        if not any(element_names):
            return values
        self._check_known_elements(element_names)
        action = torch.full((len(self.names),), math.nan)
        action[[self.names.index(name) for name in element_names]] = values
        return action

    def _check_known_elements(self, element_names: Sequence[str]) -> None:
        """Raise InputError if `names` does not have one of the elements of a target."""
        unknown = [name for name in element_names if name not in self.names]
        if unknown:
            known = ", ".join(self.names) or "none; set `names`"
            raise InputError(
                f"target: expected elements that `names` has ({known}), "
                f"got {unknown[0]!r}"
            )

    @property
    def calibrates(self) -> bool:
        return self.clean_action is None

    def after_calibration(self, output: Tensor, truth: Tensor | None) -> Command:
        """Store the clean action, with which all other actions are compared.

        Args:
            output: action (1, A) for the clean image.
            truth: not used.

        Raises:
            InputError: the clean action is not finite, or the target has another size
                or is too near to it (`_check_target`).
        """
        if not self.calibrates:  # the clean action is stored already
            return self
        clean_action = output[0].detach().float()
        if not bool(clean_action.isfinite().all()):
            raise InputError(
                "task command: the clean action has NaN or infinity, so that no action "
                "can be compared with it"
            )
        if self.target is not None:
            self._check_target(clean_action)
        return replace(self, clean_action=clean_action)

    def _check_target(self, clean_action: Tensor) -> None:
        """Check that a target action fits the clean action (A,).

        Raises:
            InputError: they differ in size, or their envelopes overlap.
        """
        if len(self.target) != len(clean_action):
            raise InputError(
                f"target: expected an action of {len(clean_action)} elements, got "
                f"{len(self.target)}"
            )
        # The loss is the distance in envelopes, minus 1. (Elements that the target does
        # not state are at distance 0.) If the distance is at most 2, both envelopes
        # overlap, and an action in both of them would be right and a success as well.
        distance = float(self.loss(clean_action[None], self.target)) + 1.0
        if distance <= 2.0:
            raise InputError(
                "target: expected an action more than two envelopes from the clean "
                f"one, which is {self._format_action(clean_action.tolist())}"
            )

    @property
    def output_remarks(self) -> tuple[str, ...]:
        """State the clean action and its envelope, once they are known."""
        if self.clean_action is None:
            return ()
        clean_action = self.clean_action.tolist()
        envelope = _expand_to_elements(self.envelope, len(clean_action))
        return (
            f"The clean action is {self._format_action(clean_action)}, from one picture of "
            f"the clean scene; its envelope is {self._format_action(envelope, sign='± ')}. "
            "Each action is judged by itself: it moves nothing, and has no effect on "
            "later pictures.",
        )

    @property
    def success_description(self) -> str:
        if self.target is not None:
            return "a target action"
        return "an action outside the envelope of the clean one"

    def check(self, facts: tasks.Facts) -> None:
        if facts.label is not None:
            raise InputError(
                "label: task command has no classes; the clean action is the truth; "
                "leave it out"
            )

    def truth(self, facts: tasks.Facts) -> Tensor | None:
        self.check(facts)
        return self.clean_action

    def truth_names(self, truth: Tensor | None) -> tuple[str, ...]:
        return () if truth is None else (self._format_action(truth.tolist()),)

    def _compute_deviation(self, output: Tensor, center: Tensor | None) -> Tensor:
        """Compute by how much each element of actions deviates from an action, (N, A).

        The unit is the envelope of the element: 1 is the largest deviation that is
        allowed.

        Args:
            output: the actions.
            center: (A,), the clean action or the target; elements that are NaN are not
                judged, so that their deviation is 0.

        Raises:
            InputError: there is no center, since the task has not been calibrated.
        """
        if center is None:
            raise InputError(
                "task command: expected a clean picture before other pictures"
            )
        is_known = ~center.isnan().to(output.device)
        # An element that is not judged is compared with itself.
        center_of_action = center.to(output).where(is_known, output.detach())
        return (output - center_of_action) / output.new_tensor(self.envelope)

    def loss(self, output: Tensor, truth: Tensor | None) -> Tensor:
        """Compute the largest deviation of an element in envelopes, minus 1, (N,)."""
        return self._compute_deviation(output, truth).abs().amax(dim=1) - 1.0

    def predictions(
        self, output: Tensor, count: int = 1
    ) -> list[tuple[tasks.Prediction, ...]]:
        return [
            (tasks.Prediction(self._format_action(action)),)
            for action in output.tolist()
        ]

    def describe(
        self, output: Tensor, truth: Tensor | None, margins: Sequence[float]
    ) -> list[tasks.PredictionWithPayload]:
        """Return for each action whether it left its envelope, and by which element.

        The payload has the action and the clean one, also as text, and the largest
        deviation of an element ("envelopes"): 1 is the edge of the envelope.

        Args:
            output: actions (N, A).
            truth: the clean action (A,).
            margins: margin of each action: 1 minus its largest deviation in envelopes.
        """
        assert truth is not None  # the task has been calibrated
        clean_action = truth.tolist()
        clean_text = self._format_action(clean_action, with_names=False)
        labels = self._label_actions(output, truth, margins)
        results: list[tasks.PredictionWithPayload] = []
        for action, margin, label in zip(output.tolist(), margins, labels, strict=True):
            payload: tasks.JsonValue = {
                "action": action,
                "clean": clean_action,
                "envelopes": 1.0 - margin,  # the largest deviation
                "text": f"{self._format_action(action)}, clean {clean_text}",
            }
            results.append((tasks.Prediction(label), payload))
        return results

    def _label_actions(
        self, output: Tensor, clean_action: Tensor, margins: Sequence[float]
    ) -> list[str]:
        """Return the label of each action: `REACHED`, `INSIDE`, or how it is outside.

        Args:
            output: actions (N, A).
            clean_action: (A,).
            margins: margin of each action; below 0 if it is outside its envelope.
        """
        reaches_target = [False] * len(output)
        if self.target is not None:
            # a loss of at most 0: within the envelope of the target
            reaches_target = (self.loss(output, self.target) <= 0.0).tolist()
        deviations = self._compute_deviation(output, clean_action)
        rows = zip(reaches_target, margins, deviations, strict=True)
        return [
            self._choose_label(margin, deviation, is_reached=is_reached)
            for is_reached, margin, deviation in rows
        ]

    def _choose_label(
        self, margin: float, deviation: Tensor, *, is_reached: bool
    ) -> str:
        """Return the label of an action.

        Args:
            margin: below 0 if it is outside its envelope.
            deviation: deviation of each of its elements, (A,).
            is_reached: whether it is within the envelope of the target.
        """
        if is_reached:
            return REACHED
        return INSIDE if margin >= 0.0 else self._make_outside_label(deviation)

    def _make_outside_label(self, deviation: Tensor) -> str:
        """Return the label of an action outside its envelope.

        Args:
            deviation: (A,) deviation of each element from the clean action.
        """
        furthest = int(deviation.abs().argmax())
        direction = "above" if deviation[furthest] > 0.0 else "below"
        return f"action outside its envelope ({self._get_element_name(furthest)} {direction} it)"

    def _get_element_name(self, index: int) -> str:
        """Return the name of an element."""
        return self.names[index] if self.names else f"action {index + 1}"

    def _format_action(
        self, action: Sequence[float], *, sign: str = "", with_names: bool = True
    ) -> str:
        """Return the first elements of an action as text, with names and units.

        Args:
            action: numbers (A,).
            sign: a text before each number.
            with_names: begin each element with its name.
        """
        units = _expand_to_elements(self.units, len(action))
        elements = []
        for index, number in enumerate(action[:MAX_FORMATTED_ELEMENTS]):
            name = f"{self._get_element_name(index)} " if with_names else ""
            unit = units[index] if units else ""
            elements.append(f"{name}{sign}{number:.3g} {unit}".rstrip())
        text = ", ".join(elements)
        if len(action) > MAX_FORMATTED_ELEMENTS:
            text += f" and {len(action) - MAX_FORMATTED_ELEMENTS} more"
        return text


def _check_is_policy(model: Model) -> None:
    """Raise InputError if a model was loaded for another task, or has classes."""
    if model.read is None:  # its outputs are logits, as those of a classifier
        raise InputError(
            f"model {model.name}: it was loaded for its logits; load "
            'it with task="command"'
        )
    if model.labels:
        raise InputError(
            "labels: task command has no classes, and this model is a classifier; "
            "set a policy as `model`"
        )


def _expand_to_elements(values: Any, count: int) -> list[Any]:
    """Return a list of the values; a single one is repeated for all elements.

    Args:
        values: a value for each of `count` elements, one for all of them, or none.
        count: number of elements of an action.
    """
    expanded = list(values)
    return expanded * count if len(expanded) == 1 else expanded


def _find_actions(returned: Any, count: int) -> Tensor:
    """Find the actions in what a policy returned, (count,) or (count, ...).

    Raises:
        ValueError: there are none.
    """
    actions = returned.get("action") if isinstance(returned, Mapping) else returned
    # A named tuple has the type of its class, and is none of the forms.
    if type(actions) in (tuple, list) and actions:
        actions = actions[0]
    if (
        not isinstance(actions, Tensor)
        or not actions.is_floating_point()
        or actions.shape[:1] != (count,)
    ):
        raise ValueError(
            "expected an action for each picture, (N, A), or a mapping with these "
            "under action"
        )
    return actions


def _parse_envelope(value: Any) -> Numbers:
    """Parse the numbers of an envelope, which are over 0."""
    envelope = _parse_numbers("envelope", value)
    if min(envelope) <= 0.0:
        raise InputError(
            f"task command: envelope: expected numbers over 0, got {min(envelope):g}"
        )
    return envelope


def _parse_names(option: str, value: Any) -> tuple[str, ...]:
    """Parse names from a list, or a string with commas between them.

    Raises:
        InputError: one is no text, or there are too many; it names `option`.
    """
    if isinstance(value, str) and value:
        names = [part.strip() for part in value.split(",")]
    else:
        names = [*(value or ())]
    are_names = all(
        isinstance(name, str) and name and name.isprintable() for name in names
    )
    if len(names) > MAX_NUMBERS or not are_names:
        raise InputError(
            f"task command: {option}: expected strings, or one with commas between "
            f"them, got {value!r:.80}"
        )
    return tuple(names)


def _parse_numbers(option: str, value: Any) -> Numbers:
    """Parse finite numbers from a number, a string with a number, or a list of these.

    Raises:
        InputError: there are none or too many, or one is not finite; it names `option`.
    """
    items = value.tolist() if hasattr(value, "tolist") else value
    items = list(items) if isinstance(items, (list, tuple)) else [items]
    numbers: Numbers = ()  # stays empty if an item is no number, and is rejected below
    if not any(isinstance(item, bool) for item in items):
        with suppress(TypeError, ValueError, OverflowError):
            numbers = tuple(float(item) for item in items)
    # The bound is well within the range of float32, which ends at 3e38.
    are_finite = all(math.isfinite(number) and abs(number) < 1e30 for number in numbers)
    if not 1 <= len(numbers) <= MAX_NUMBERS or not are_finite:
        got = f"{value!r:.80}"
        if len(items) > MAX_NUMBERS:
            got = f"{len(items):,} of them"
        raise InputError(
            f"task command: {option}: expected a finite number, or a list of 1 to "
            f"{MAX_NUMBERS} of them, got {got}"
        )
    return numbers


def _load_state(value: Any) -> dict[str, Numbers]:
    """Return the numbers of a state by name, from a mapping or a JSON file's path.

    Raises:
        InputError: it is not numbers by name, or too many.
        FileFormatError: the file cannot be read as such.
    """
    if isinstance(value, (str, Path)) and str(value):
        value = _read_state_file(Path(value).expanduser())
    if not value:
        return {}
    _check_state_names(value)
    state = {
        name: _parse_numbers(f"state {name:.40}", numbers)
        for name, numbers in value.items()
    }
    if sum(map(len, state.values())) > MAX_NUMBERS:
        raise InputError(
            f"task command: state: expected at most {MAX_NUMBERS:,} numbers in total"
        )
    return state


def _check_state_names(value: Any) -> None:
    """Raise InputError if a state is no mapping from names."""
    has_names = isinstance(value, Mapping) and all(
        isinstance(name, str) and name for name in value
    )
    if not has_names:
        raise InputError(
            f"task command: state: expected numbers by name, such as {{speed: 1.5}}, "
            f"or a JSON file, got {value!r:.80}"
        )


def _read_state_file(path: Path) -> Any:
    """Read a JSON file. Raises FileFormatError if it cannot be read, or is no JSON."""
    expected = "a state: numbers by name in JSON"
    try:
        text = stored_files.read_text(path, expected, MAX_STATE_BYTES)
        return stored_files.parse_json(text, finite=True)
    except OSError as error:
        raise errors.FileFormatError(
            f"task command: state: {path} cannot be read ({error.strerror or error})"
        ) from None
    except ValueError as error:
        raise errors.FileFormatError(f"{path}: expected {expected} ({error})") from None
