"""The built-in parts that somebody could also add from a package: where each is, and a line of help.

Nothing is imported before it is needed. A part whose module is missing is left out.
"""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec
from typing import NamedTuple


class BuiltIn(NamedTuple):
    """A built-in part.

    Attributes:
        kind: "experiment".
        name: the word for it on the command line.
        target: "module:attribute" that is imported when the part is used.
        help: what it does, in a line for `advsearch --help`.
    """

    kind: str
    name: str
    target: str
    help: str


_EXPERIMENTS = "advsearch.questions"

BUILT_INS = (
    BuiltIn(
        "experiment", "attack", f"{_EXPERIMENTS}.attack:attack",
        "find the configuration of a scene that the model gets wrong most badly",
    ),
    BuiltIn(
        "experiment", "sweep", f"{_EXPERIMENTS}.sweep:sweep",
        "measure how often the model is right over a grid or a random sample of configurations",
    ),
    BuiltIn(
        "experiment", "render", f"{_EXPERIMENTS}.render:render",
        "render a picture of a scene, and say what the model sees in it",
    ),
    BuiltIn(
        "experiment", "region", f"{_EXPERIMENTS}.region:region",
        "grow a box around a configuration in which the model's verdict stays the same",
    ),
    BuiltIn(
        "experiment", "explain", f"{_EXPERIMENTS}.explain:explain",
        "say in words where a model is wrong, from the rows of sweeps, and confirm it by fresh renders",
    ),
    BuiltIn(
        "experiment", "compare", f"{_EXPERIMENTS}.compare:compare",
        "compare models, objects or adversarial scenes on the same pictures, pair by pair",
    ),
    BuiltIn(
        "experiment", "recipe", f"{_EXPERIMENTS}.recipe:recipe",
        "run a whole experiment that a recipe describes, and write a page of figures",
    ),
    BuiltIn(
        "experiment", "harden", f"{_EXPERIMENTS}.harden:harden",
        "train a copy of a model on its worst cases, and measure it before and after on scenes that training never saw",
    ),
    BuiltIn(
        "experiment", "test", f"{_EXPERIMENTS}.test:test",
        "test claims about a model, each found held, failed or undecided: a gate at every change",
    ),
    BuiltIn(
        "experiment", "replay", f"{_EXPERIMENTS}.replay:replay",
        "render the adversarial scene of a run again under other conditions, beside the clean scene",
    ),
    BuiltIn(
        "experiment", "check", f"{_EXPERIMENTS}.check:check",
        "check every gradient against differences; show how a search gets them and what it leaves out",
    ),
    BuiltIn(
        "experiment", "precision", f"{_EXPERIMENTS}.precision:precision",
        "measure error against run time, draw it, and recommend settings",
    ),
    BuiltIn(
        "experiment", "stability", f"{_EXPERIMENTS}.stability:stability",
        "run stiff and extreme cases, and check that each of them holds",
    ),
)  # fmt: skip


def is_present(module: str) -> bool:
    """Return whether a module can be imported; only the packages that it is in are imported."""
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:
        return False


@cache
def list_built_ins(kind: str) -> dict[str, BuiltIn]:
    """Return the built-in parts of one kind by name, without those whose module is missing."""
    parts = (part for part in BUILT_INS if part.kind == kind)
    return {part.name: part for part in parts if is_present(part.target.partition(":")[0])}
