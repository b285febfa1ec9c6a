"""Assertions about a model, for pytest (docs/testing.md).

    from advsearch.testing import assert_right

    def test_the_mug_is_seen_from_all_sides():
        views = {"camera": {"azimuth": [0, 360]}}
        assert_right("mug", "model.pt2", at_least=0.9, controls=views)

The message of a failure contains the path of the picture, and the command that repeats
the test. Every call stores a run, in `run` or in a new folder under runs/.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
    """Assert that a model is right in at least a fraction of images.

    The images are sampled from all that the controls can produce, until the claim is
    shown or refuted at the stated confidence.

    Args:
        object: scene from `load_scene`, or the name or the file of an object.
        model: model from `load_model`, or its name.
        at_least: the fraction, over 0 and under 1.
        pictures: maximum number of images.
        confidence: probability that an assertion that passes or fails is correct.
        seed: root of all random numbers.
        run: name or folder of the run; None for a new name.
        **settings: settings of a scene and its images, as `sweep` takes them, and
            `controls`.

    Raises:
        AssertionError: the fraction is shown to be smaller, or `pictures` images do not
            decide it.
        InputError: a setting is wrong.
    """
    __tracebackhide__ = True  # pytest leaves this function out of tracebacks
    claim = {"claim": "right", "at_least": at_least, "pictures": pictures}
    return _assert_claim(
        claim,
        object,
        models={"model": model},
        settings=settings,
        confidence=confidence,
        seed=seed,
        run=run,
    )


def assert_not_broken(
    object: str | Path | workbench.Scene,
    model: workbench.AnyModel = "reference",
    *,
    seed: int = 0,
    run: str | Path | None = None,
    **settings: Any,
) -> SuiteResult:
    """Assert that a search finds no configuration that a model gets wrong.

    If it finds none, that is no proof that there is none.

    Args:
        object: scene from `load_scene`, or the name or the file of an object.
        model: model from `load_model`, or its name.
        seed: root of all random numbers.
        run: name or folder of the run; None for a new name.
        **settings: settings as `attack` takes them: `controls`, `epsilon`, `steps`,
            `policy`, ...

    Raises:
        AssertionError: the search found a configuration that was verified, or the model
            is wrong on the clean scene already.
        InputError: a setting is wrong.
    """
    __tracebackhide__ = True
    return _assert_claim(
        {"claim": "not_broken"},
        object,
        models={"model": model},
        settings=settings,
        confidence=0.95,  # the default of a suite; this claim does not use it
        seed=seed,
        run=run,
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
    """Assert that a model is not much worse than another on the same images.

    It may be right at most `points` percentage points less often.

    Args:
        object: scene from `load_scene`, or the name or the file of an object.
        model: model from `load_model`, or its name.
        than: the other model.
        points: percentage points, over 0 and under 100.
        pictures: maximum number of images.
        confidence: probability with which the result of the test is correct.
        seed: root of all random numbers.
        run: name or folder of the run; None for a new name.
        **settings: settings of a scene and its images, as `sweep` takes them, and
            `controls`.

    Raises:
        AssertionError: the model is shown to be worse, or `pictures` images do not
            decide it.
        InputError: a setting is wrong.
    """
    __tracebackhide__ = True
    claim = {"claim": "no_worse", "points": points, "pictures": pictures}
    return _assert_claim(
        claim,
        object,
        models={"model": model, "than": than},
        settings=settings,
        confidence=confidence,
        seed=seed,
        run=run,
    )


def assert_suite(suite: str | Path, **settings: Any) -> SuiteResult:
    """Assert that all claims of a suite hold, or have the results that it expects.

    Args:
        suite: path of a YAML file with the claims.
        **settings: settings of `advsearch test`: `model`, `only`, `seed`, `fresh`,
            `seconds`, `run`, ...

    Raises:
        AssertionError: a claim failed or is undecided.
        InputError: a setting is wrong.
    """
    __tracebackhide__ = True
    # late: torch takes long to import
    from advsearch.extend import workbench

    experiment = workbench.get_experiment("test")
    workbench.allow_code_in_settings(settings)
    # no other thread of this process may render at the same time
    with workbench.hold_process_lock():
        result: SuiteResult = experiment.run(
            experiment.settings(**{"suite": str(suite), **settings})
        )
    # `accepted`: the claim held, or has the result that the suite expects. `repeat` is
    # the command that tests the claim again.
    reports = [
        _format_report(result, claim, claim.repeat)
        for claim in result.claims
        if not claim.accepted
    ]
    if reports:
        raise AssertionError("\n\n".join(reports))
    return result


def _assert_claim(
    claim: Mapping[str, object],
    object: str | Path | workbench.Scene,
    models: Mapping[str, workbench.AnyModel],
    settings: Mapping[str, Any],
    confidence: float,
    seed: int,
    run: str | Path | None,
) -> SuiteResult:
    """Run a suite with one claim, and assert that it holds.

    A suite refers to scenes, models and controls by name. So the objects of the caller
    get names in the suite, and are passed to it separately.

    Args:
        claim: the claim in the form of a suite's file, without models; "claim" is its
            kind, such as "not_broken".
        object: the scene, or the name or the file of its object.
        models: models by setting: "model" of the suite, and perhaps "than" of the
            claim.
        settings: settings of the suite.
        confidence: confidence of the test.
        seed: root of all random numbers.
        run: name or folder of the run; None for a new name.

    Raises:
        AssertionError: the claim is shown to be wrong, or undecided.
    """
    __tracebackhide__ = True
    # late: torch takes long to import
    from advsearch.extend import workbench

    experiment = workbench.get_experiment("test")
    title = f"assert_{claim['claim']}"
    with workbench.hold_process_lock():
        _allow_code_of_models(settings, models)
        # the settings with names in place of objects, and the objects by these names
        suite_settings, objects = _name_objects(object, settings)
        claim_settings: dict[str, Any] = dict(claim)
        _name_models(models, suite_settings, claim_settings, objects)
        claim_name = str(claim["claim"]).replace("_", "-")
        suite = {
            "title": title,
            "settings": suite_settings,
            "seed": seed,
            "confidence": confidence,
            "claims": {claim_name: claim_settings},
        }
        config = (
            experiment.settings(suite=title, run=None if run is None else str(run))
            .with_python_only_parts(_list_python_only(title, models))
            .with_python_objects(objects)
        )
        result: SuiteResult = experiment.run(config, suite=suite)
    _check_held(result)
    return result


def _allow_code_of_models(
    settings: Mapping[str, Any], models: Mapping[str, workbench.AnyModel]
) -> None:
    """Allow the code that settings and the names of models refer to.

    Args:
        settings: settings of a suite.
        models: models by setting.
    """
    # late: torch takes long to import
    from advsearch.extend import workbench

    workbench.allow_code_in_settings(settings)
    for model in models.values():
        workbench.allow_code_in_settings({"model": model})


def _check_held(result: SuiteResult) -> None:
    """Check that the single claim of a suite holds.

    Raises:
        AssertionError: it is shown to be wrong, or undecided.
    """
    __tracebackhide__ = True  # pytest leaves this function out of tracebacks
    (claim_result,) = result.claims
    if claim_result.verdict != "held":
        raise AssertionError(_format_report(result, claim_result, _describe_repeat()))


def _name_models(
    models: Mapping[str, workbench.AnyModel],
    suite_settings: dict[str, Any],
    claim_settings: dict[str, Any],
    objects: dict[tuple[str, str], Any],
) -> None:
    """Add the names of models to the settings, and the models to the objects.

    Args:
        models: models by setting.
        suite_settings: settings of the suite, which gets the name of "model".
        claim_settings: settings of the claim, which gets that of "than".
        objects: objects by (role, name); names and files are none.
    """
    # late: torch takes long to import
    from advsearch.extend import workbench

    for key, model in models.items():
        model_name = workbench.get_model_name(model)
        if key == "model":
            suite_settings[key] = model_name
        else:
            claim_settings[key] = model_name
        if not isinstance(model, (str, Path)):
            objects["model", model_name] = model


def _list_python_only(
    title: str, models: Mapping[str, workbench.AnyModel]
) -> list[workbench.PythonOnly]:
    """Return everything of a call that the file of its run cannot name.

    The run cannot be repeated from the file: the call itself, and models of this
    session only.

    Args:
        title: name of the called function.
        models: its models by setting.
    """
    # late: torch takes long to import
    from advsearch.extend import workbench

    return [
        workbench.PythonOnly("call", f"of {title}"),
        *(
            workbench.PythonOnly("model", workbench.get_model_name(model))
            for model in models.values()
            if workbench.is_session_only(model)
        ),
    ]


def _describe_repeat() -> str:
    """Return what runs the present assertion again: the pytest command of the test that
    is running, or else a sentence.
    """
    # pytest sets the variable: "test_mug.py::test_name (call)"
    test = os.environ.get("PYTEST_CURRENT_TEST", "").rpartition(" ")[0]
    if test:
        return f"pytest {shlex.quote(test)}"
    return "call the same function with the same arguments"


def _name_objects(
    object: str | Path | workbench.Scene, settings: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[tuple[str, str], Any]]:
    """Replace the scene and the controls among settings by names, as files have them.

    Args:
        object: the scene, or the name or the file of its object.
        settings: settings, in which controls may be instances.

    Returns:
        The settings with names; and the objects (scene and controls) by (role, name),
        as `Config.with_python_objects` takes them.
    """
    # late: it imports torch, and pytest imports this module before it collects tests
    from advsearch.extend import workbench

    loading = workbench.loading
    named = {**settings, **_name_scene(object)}
    objects: dict[tuple[str, str], Any] = {}
    if isinstance(object, loading.Scene):
        objects["scene", named["object"]] = object
    controls = loading.list_control_instances(named.get("controls", ()))
    if controls:
        objects |= {("control", control.name): control for control in controls}
        named["controls"] = loading.controls_to_settings(named["controls"])
    return named, objects


def _name_scene(object: str | Path | workbench.Scene) -> dict[str, Any]:
    """Return the settings that name a scene, or the name or the file of its object."""
    # late: torch takes long to import
    from advsearch.extend import workbench

    if not isinstance(object, workbench.loading.Scene):
        return {"object": str(object)}
    settings = workbench.loading.scene_to_settings(object)
    return {name: value for name, value in settings.items() if value is not None}


def _format_report(result: SuiteResult, claim: ClaimResult, repeat: str) -> str:
    """Return the message of a failed claim; the command `repeat` runs it again."""
    run = Path(result.run or "")
    lines = [
        f"{claim.name}: {claim.verdict}: {claim.reason}",
        f"  claimed: {claim.statement}",
    ]
    if claim.picture:
        lines.append(f"  picture: {(run / claim.picture).resolve()}")
    lines += [f"  run: {run}", f"  again: {repeat}"]
    return "\n".join(lines)
