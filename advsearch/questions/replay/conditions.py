"""`replay`: the adversarial scene of a run under other conditions than it was searched and verified under, in other
pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.api.keywords import asks, configured
from advsearch.controls.corruption import coded
from advsearch.controls.sensor import SensorControl, through_sensor
from advsearch.engine.naming import different
from advsearch.engine.problem import Problem
from advsearch.engine.record import control_group, verified_rate
from advsearch.engine.verifier import RetrialCondition, Retrials, kept_configuration
from advsearch.errors import InputError
from advsearch.progress import Progress, Watched, watcher
from advsearch.question import Asked, carried_out
from advsearch.questions.attack.carry_out import LOADING, SEARCHED_WITH, AttackParts, parts_in, problem_of_parts
from advsearch.questions.attack.result import AttackResult
from advsearch.questions.attack.summary import attack_of
from advsearch.questions.replay.result import NOT_DONE, ReplayConfig, ReplayResult, ReplayRow
from advsearch.runs.directory import RunDirectory, find_run, only_here
from advsearch.runs.store import NAME, Store
from advsearch.runs.summary import MADE_WITH, changed_file
from advsearch.scene.cycles import BlenderError, Cycles
from advsearch.scene.renderer import MAX_SPP

OWN = "as verified"  # The way in which nothing is changed
OWN_LIGHT = "own"  # What conditions share whose pictures come of the radiance that the run itself would render

QUALITIES = (90, 75, 50)

SENSORS: dict[str, dict[str, float]] = {
    "a good camera": {"shot": 0.02, "read": 0.005, "mosaic": 1.0},
    "a phone in a dim room": {
        "shot": 0.08, "read": 0.02, "mosaic": 1.0, "aberration": 0.002, "red": 0.1, "blue": -0.1, "compression": 25.0,
    },
}  # fmt: skip
"""Values of the control `sensor`, by what they stand for; those that are not named are 0."""

CURVES = {"gamma": "a power of 1/2.2 in place of sRGB", "reinhard": "highlights rolled off, x / (1 + x)"}
"""Other tone curves, by `ImageFormation.transfer`."""
SHORT, LONG = 2, 16  # Longest light paths in segments: direct light alone, and far more than a run renders


@dataclass(frozen=True)
class Way:
    """One condition of a replay.

    Attributes:
        name: what is changed.
        text: to what.
        make: makes the condition anew, under its title; it holds a scene of its own where it has to.
        shares: whether it takes the radiance of the first condition, so that it costs no renders beside that.
        missing: why it cannot be had; empty where it can.
    """

    name: str
    text: str
    make: Callable[[str], RetrialCondition]
    shares: bool = False
    missing: str = ""

    def condition(self) -> RetrialCondition:
        """Return the condition."""
        return self.make(self.text if self.name == OWN else f"{self.name}: {self.text}")


def ways_of(problem: Problem, spp: int, sized: Callable[[tuple[int, int]], Problem]) -> Iterator[Way]:
    """Yield every condition of a problem's configuration but other models; the first changes nothing.

    `spp` is that of the run's verification, and `sized` makes the same problem at another (height, width) in pixels.
    """
    renderer = problem.renderer
    scene, formation = renderer.scene, renderer.formation

    def same(count: int = spp, **changed: Any) -> Callable[..., RetrialCondition]:
        return lambda name: RetrialCondition(name, problem, count, OWN_LIGHT, light=OWN_LIGHT, **changed)

    def other(**made: Any) -> Callable[..., RetrialCondition]:
        sampler = {"sampler": made["sampler"]} if "sampler" in made else {}
        return lambda name: RetrialCondition(
            name, replace(problem, renderer=renderer.like(scene.like(**made), **sampler)), spp, name
        )

    def formed(light: str | None = None, **fields: Any) -> Callable[..., RetrialCondition]:
        changed = replace(problem, renderer=renderer.like(**fields))
        return lambda name: RetrialCondition(name, changed, spp, name, light=light)

    def at(size: tuple[int, int]) -> Callable[..., RetrialCondition]:
        return lambda name: RetrialCondition(name, sized(size), spp, name)

    yield Way(OWN, OWN, same(), shares=True)
    for count in (max(1, spp // 4), min(MAX_SPP, 4 * spp)):
        if count != spp:
            yield Way("samples", f"{count} a pixel", same(count))
    height, width = formation.resolution
    for size in ((max(8, height // 2), max(8, width // 2)), (min(4096, 2 * height), min(4096, 2 * width))):
        if size != (height, width):
            yield Way("resolution", f"{size[0]} x {size[1]} pixels", at(size))
    for depth in (SHORT, LONG):
        if depth != scene.max_depth:
            yield Way("depth", f"light paths of {depth} segments", other(max_depth=depth))
    if not scene.volumetric:
        yield Way("integrator", "Mitsuba's path in place of prb", other(integrator="path"))
    sampler = "independent" if formation.sampler != "independent" else "multijitter"
    yield Way("sampler", sampler, other(sampler=sampler))
    denoiser = "none" if formation.denoiser != "none" else "oidn"
    yield Way("denoiser", denoiser, formed(denoiser=denoiser))
    for curve, text in CURVES.items():
        yield Way("curve", f"{curve}, {text}", formed(OWN_LIGHT, transfer=curve), shares=True)
    for quality in QUALITIES:
        yield Way("jpeg", f"quality {quality}", same(change=_file(quality)), shares=True)
    for name, values in SENSORS.items():
        yield Way("sensor", name, same(change=_sensor(values)), shares=True)

    def by_blender(name: str) -> RetrialCondition:
        return RetrialCondition(name, replace(problem, renderer=renderer.like(source=made.radiance)), spp, "blender")

    denoise, missing = formation.denoiser != "none", ""
    try:
        made = Cycles(scene.made[0], formation.resolution, max_depth=scene.max_depth, denoise=denoise)
    except BlenderError as error:
        missing = str(error)
    yield Way("blender", "Cycles, Blender's renderer", by_blender, missing=missing)


def _file(quality: int) -> Callable[[Tensor, int], Tensor]:
    return lambda picture, seed: coded(picture, quality).clamp(0.0, 1.0)


def _sensor(values: dict[str, float]) -> Callable[[Tensor, int], Tensor]:
    full = {one.name: torch.tensor(values.get(one.name, 0.0)) for one in SensorControl.parameters}
    return lambda picture, seed: through_sensor(picture, full, seed)


@asks(ReplayConfig)
def replay(attack: str | Path | AttackResult, *, progress: Watched = None, **settings: Any) -> ReplayResult:
    """Render the adversarial scene of a run under other conditions, each beside the clean scene (docs/questions.md).

    Args:
        attack: one that was kept and has ended: its result, or name or folder of its run.
    """
    parts, only_now = None, list[str]()
    if isinstance(attack, AttackResult):
        if attack.run is None:
            raise InputError("attack: expected an attack that was kept, got one that was not; give it a `run`")
        only_now = [one for one in only_here(attack.run) if not one.startswith(SEARCHED_WITH)]
        parts = None if attack.parts is None else attack.parts()
    config = configured(ReplayConfig, attack=attack.run if isinstance(attack, AttackResult) else attack, **settings)
    asked = Asked(config.with_only_here(only_now) if only_now else config, watcher(progress))
    return carried_out(partial(rendered_again, parts=parts), asked)


def rendered_again(asked: Asked[ReplayConfig], parts: AttackParts | None = None) -> ReplayResult:
    """Render an adversarial scene again as a configuration describes; every trial is stored at once, and a run goes on
    with the next. `parts` is what the attack was asked with; None loads what its run names.

    Raises InputError where the run has no adversarial configuration, or its scene is another one now, and
    FileFormatError where it did not end, or is of another command.
    """
    config = asked.config
    asked.progress.stage(LOADING)
    folder = find_run(config.attack)
    summary = attack_of(folder)
    if summary.adversarial is None:
        raise InputError(
            f"{folder}: ended with {summary.ending!r}, so that there is no adversarial configuration to render again"
        )
    different((OWN_MODEL, *config.models), "model")
    parts = parts or parts_in(folder)
    threads = {} if config.threads is None else {"threads": config.threads}
    again = partial(problem_of_parts, parts, **threads)
    problem, warnings = again()
    warnings += _changed(folder, parts)
    u = kept_configuration(folder, problem)
    spp = summary.sample_count.spp if summary.sample_count else summary.verified.spp if summary.verified else 64
    own, *others = ways_of(problem, spp, lambda size: again(resolution=size)[0])
    ways = [own, *(way for way in others if way.name in config.chosen), *_models(config, again, problem, spp)]
    table = _Table(u, config.trials, seeds.stream(parts.config.seed, "replay"), asked.run, asked.progress)
    with asked.until_interrupted():
        for batch in ([way for way in ways if way.shares], *([way] for way in ways if not way.shares)):
            table.fill(batch)
    return asked.result(
        ReplayResult,
        answer=str(folder),
        answered=summary.ending,
        object=summary.object,
        model=summary.model,
        task=summary.task,
        environment=summary.environment,
        controls=summary.controls,
        table=[table.rows[way] for way in ways if way in table.rows],
        renders=table.renders,
        warnings=warnings,
        seed=parts.config.seed,
    )


@dataclass
class _Table:
    """The rows so far, by their condition, for a configuration (d,), and the pictures rendered."""

    u: torch.Tensor
    trials: int
    seed: int
    run: RunDirectory
    progress: Progress
    rows: dict[Way, ReplayRow] = field(default_factory=dict)
    renders: int = 0

    def fill(self, ways: Sequence[Way]) -> None:
        """Add the rows of some conditions that share their renders: the clean scene under all of them, then the
        adversarial one. A condition that cannot be had, or that Blender fails at, gets a row that says why."""
        missing = next((way.missing for way in ways if way.missing), "")
        try:
            if not missing:
                self._try(ways)
        except BlenderError as error:
            missing = str(error)
        for way in ways if missing else ():
            self.rows[way] = ReplayRow(way=way.name, condition=way.text, ending=NOT_DONE, reason=missing)

    def _try(self, ways: Sequence[Way]) -> None:
        text = ", ".join(dict.fromkeys(way.name for way in ways)) + (f": {ways[0].text}" if len(ways) == 1 else "")
        total = 2 * self.trials * len(ways)
        self.progress.stage(f"replaying, {text}", total, hint="`trials` or `ways` shorten it")
        conditions = {way: way.condition() for way in ways}
        renderers = {id(one.problem.renderer): one.problem.renderer for one in conditions.values()}.values()
        before = sum(renderer.renders for renderer in renderers)
        retrials = Retrials([*conditions.values()], self.run, self.progress, trials=self.trials, seed=self.seed)
        try:
            clean = {way: control_group(retrials.clean(one), one.spp) for way, one in conditions.items()}
            for way, condition in conditions.items():
                checked = retrials.adversarial("answer", self.u, condition)
                ending, rate = checked.ending.value, verified_rate(checked)
                self.rows[way] = ReplayRow(
                    way=way.name, condition=way.text, ending=ending, clean=clean[way], verified=rate
                )
        finally:
            self.renders += sum(renderer.renders for renderer in renderers) - before


def _changed(folder: Path, parts: AttackParts) -> list[str]:
    """A caution where a file was another one when the run was made."""
    with Store(folder / NAME, read_only=True) as results:
        noted = results.noted(MADE_WITH)
    before = [one for one in noted if isinstance(one, dict)] if isinstance(noted, list) else []
    name = changed_file(before, parts.config.plain())
    return [f"{name} is not what it was when the run was made: what does not hold may come from that."] if name else []


Again = Callable[..., tuple[Problem, list[str]]]
"""The problem of the run with some settings changed, and warnings; see `problem_of_parts`."""
OWN_MODEL = "the run's own"  # What no other model is called


def _models(config: ReplayConfig, again: Again, problem: Problem, spp: int) -> Iterator[Way]:
    """Other models; those that are shown pictures as the run's own model is take its renders."""
    for name in config.models:
        other = again(model=name, ensemble=None)[0]
        shares = other.renderer.formation == problem.renderer.formation
        if shares:
            other = replace(other, renderer=problem.renderer)
        source = OWN_LIGHT if shares else name

        def condition(title: str, other: Problem = other, source: str = source) -> RetrialCondition:
            return RetrialCondition(title, other, spp, source, light=source)

        yield Way("model", name, condition, shares)
