"""Claims about a model as assertions, for pytest (docs/testing.md).

    from advsearch.testing import assert_right

    def test_the_mug_is_seen_from_all_sides(): assert_right("mug", "model.pt2",
        at_least=0.9, controls={"camera": {"azimuth": [0, 360]}})

A failure shows the picture's path and what repeats it. Every call keeps a run, in `run`
or under runs/.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from advsearch.extend import workbench

if TYPE_CHECKING:
    from advsearch.extend import workbench
    from advsearch.questions.test.result import ClaimResult, SuiteResult

__all__ = ["assert_no_worse", "assert_not_broken", "assert_right", "assert_suite"]


def assert_right(
    object: str | Path | workbench.Scene,
    model: workbench.AnyModel = "reference",
    *,
    at_least: float = 0.95,
    pictures: int = 400,
    confidence: float = 0.95,
    seed: int = 0,
    run: str | Path | None = None,
    **settings: Any,
) -> SuiteResult:
    """Assert that a model is right in at least a share of the pictures that the
    controls span.

    Pictures are drawn until that is shown or refuted at the stated confidence.

    Args:
        object: from `load_scene`, or the name of an object, or a file of one.
        model: from `load_model`, or what that takes.
        at_least: the share, over 0 and under 1.
        pictures: that are drawn, at most.
        confidence: that an assertion that passes, or fails, is right to do so.
        seed: root of all random numbers.
        run: where the run is kept.
        **settings: of a scene and its pictures, as `sweep` takes them, and `controls`.

    Raises:
        AssertionError: the share is shown to be smaller, or so many pictures do not
            decide it.
        InputError: anything that the caller can put right.
    """
    __tracebackhide__ = True
    claim = {"claim": "right", "at_least": at_least, "pictures": pictures}
    return _asserted(claim, object, {"model": model}, settings, confidence, seed, run)


def assert_not_broken(
    object: str | Path | workbench.Scene,
    model: workbench.AnyModel = "reference",
    *,
    seed: int = 0,
    run: str | Path | None = None,
    **settings: Any,
) -> SuiteResult:
    """Assert that a search finds no configuration that a model gets wrong. That it
    finds none is no proof.

    Args:
        object, model, seed, run: as for `assert_right`.
        **settings: as for `attack`: `controls`, `epsilon`, `steps`, `policy`, ...

    Raises:
        AssertionError: the search found one that was verified, or the model is wrong on
            the clean scene already.
        InputError: anything that the caller can put right.
    """
    __tracebackhide__ = True
    return _asserted(
        {"claim": "not_broken"}, object, {"model": model}, settings, 0.95, seed, run
    )


def assert_no_worse(
    object: str | Path | workbench.Scene,
    model: workbench.AnyModel,
    than: workbench.AnyModel,
    *,
    points: float = 2.0,
    pictures: int = 1000,
    confidence: float = 0.95,
    seed: int = 0,
    run: str | Path | None = None,
    **settings: Any,
) -> SuiteResult:
    """Assert that a model is right at most so many percentage points less often than
    another, on the same pictures.

    Args:
        object, model, pictures, confidence, seed, run, **settings: as for
            `assert_right`.
        than: the other model.
        points: percentage points, over 0 and under 100.

    Raises:
        AssertionError: it is shown to be worse, or so many pictures do not decide it.
        InputError: anything that the caller can put right.
    """
    __tracebackhide__ = True
    claim = {"claim": "no_worse", "points": points, "pictures": pictures}
    return _asserted(
        claim, object, {"model": model, "than": than}, settings, confidence, seed, run
    )


def assert_suite(suite: str | Path, **settings: Any) -> SuiteResult:
    """Assert that all claims of a suite are held, or are what was expected when it was
    last updated.

    Args:
        suite: a YAML file.
        **settings: of `advsearch test`: `model`, `only`, `seed`, `fresh`, `seconds`, `run`, ...

    Raises:
        AssertionError: one failed, or is undecided.
        InputError: anything that the caller can put right.
    """
    __tracebackhide__ = True
    # late: torch takes long to import
    from advsearch.extend import workbench

    experiment = workbench.get_experiment("test")
    workbench.allow_named(settings)
    with workbench.in_turn():
        result: SuiteResult = experiment.run(
            experiment.settings(**{"suite": str(suite), **settings})
        )
    if bad := [claim for claim in result.claims if not claim.accepted]:
        raise AssertionError(
            "\n\n".join(_report(result, claim, claim.repeat) for claim in bad)
        )
    return result


def _asserted(
    claim: Mapping[str, object],
    object: str | Path | workbench.Scene,
    models: Mapping[str, workbench.AnyModel],
    settings: Mapping[str, Any],
    confidence: float,
    seed: int,
    run: str | Path | None,
) -> SuiteResult:
    __tracebackhide__ = True
    # late: torch takes long to import
    from advsearch.extend import workbench

    loading = workbench.loading
    experiment = workbench.get_experiment("test")
    name = str(claim["claim"]).replace("_", "-")
    objects: dict[tuple[str, str], Any] = {}
    with workbench.in_turn():
        for named in (settings, *({"model": one} for one in models.values())):
            workbench.allow_named(named)
        given = dict(settings)
        said = dict(claim)
        if isinstance(object, loading.Scene):
            given |= {
                key: value
                for key, value in loading.scene_as_settings(object).items()
                if value is not None
            }
            objects["scene", given["object"]] = object
        else:
            given["object"] = str(object)
        for key, model in models.items():
            (given if key == "model" else said)[key] = workbench.model_name(model)
            if not isinstance(model, (str, Path)):
                objects["model", workbench.model_name(model)] = model
        if instances := loading.instances_in(given.get("controls", ())):
            objects |= {("control", control.name): control for control in instances}
            given["controls"] = loading.settings_of(given["controls"])
        title = f"assert_{claim['claim']}"
        values = {
            "title": title,
            "settings": given,
            "seed": seed,
            "confidence": confidence,
            "claims": {name: said},
        }
        only_here = [workbench.PythonOnly("call", f"of {title}")]
        only_here += [
            workbench.PythonOnly("model", workbench.model_name(model))
            for model in models.values()
            if workbench.exists_here(model)
        ]
        config = experiment.settings(
            suite=title, run=None if run is None else str(run)
        ).with_only_here(only_here)
        result: SuiteResult = experiment.run(
            config.with_python_objects(objects), suite=values
        )
    (claimed,) = result.claims
    if claimed.answer != "held":
        test = os.environ.get("PYTEST_CURRENT_TEST", "").rpartition(" ")[0]
        again = (
            f"pytest {shlex.quote(test)}"
            if test
            else ("call the same function with the same arguments")
        )
        raise AssertionError(_report(result, claimed, again))
    return result


def _report(result: SuiteResult, claim: ClaimResult, again: str) -> str:
    run = Path(result.run or "")
    lines = [
        f"{claim.name}: {claim.answer}: {claim.reason}",
        f"  claimed: {claim.statement}",
    ]
    lines += [f"  picture: {(run / claim.picture).resolve()}"] if claim.picture else []
    return "\n".join([*lines, f"  run: {run}", f"  again: {again}"])
