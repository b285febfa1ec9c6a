"""What one coordinate of a search is, said once: a named, bounded number with a unit.

Settings of a scene (`advsearch.scene.settings`) and parameters of controls are both this, so that what `--set` fixes
today a control can search tomorrow under the same name.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Parameter:
    """One named, bounded number, tensor or choice.

    Attributes:
        name: short name; `control.name` addresses it everywhere.
        shape: of its value; () for a number, None in a place that depends on the scene or a choice.
        unit: "degrees", "object sizes", "sRGB", "stops", "name", ..., or "1".
        low: smallest allowed value (0 for a choice among names).
        high: largest allowed value (number of names - 1 for a choice among names).
        default: the value that leaves the scene as it is, in words if it depends on the scene.
        description: one sentence.
        periodic: the value and the value plus 360 degrees (`high - low` of a full turn) are the same.
        moves_silhouettes: changing it can move an outline in the picture, so interior adjoints miss a term.
        search: the range that is searched when nothing is said about the parameter; None: it stays at its default.
        log: the unit interval runs over the logarithm of the value (scales, powers, distances).
        options: the names of a discrete choice, which has no derivative; empty for numbers.
        estimators: the valid ways to differentiate it, preferred first (keys of `gradients.plan.ESTIMATORS`).
    """

    name: str
    shape: tuple[int | None, ...]
    unit: str
    low: float
    high: float
    default: float | str
    description: str
    periodic: bool = False
    moves_silhouettes: bool = False
    search: tuple[float, float] | None = None
    log: bool = False
    options: tuple[str, ...] = ()
    estimators: tuple[str, ...] = ("differences",)
