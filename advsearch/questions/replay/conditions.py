"""`replay`: the adversarial scene of a run under other conditions than it was searched
and verified under, in other pictures.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from advsearch.extend import (
    InputError,
    Problem,
    Progress,
    RunContext,
    RunDirectory,
    directory,
    images,
    seeds,
    settings,
    workbench,
)
from advsearch.questions.replay.cycles import BlenderError, Cycles
from advsearch.questions.replay.result import (
    NOT_DONE,
    ReplayConfig,
    ReplayResult,
    ReplayRow,
)

AttackResult = workbench.AttackResult
Watched = workbench.Watched

OWN = "as verified"  # The way in which nothing is changed
# What conditions share whose pictures come of the radiance that the run itself would
# render
OWN_LIGHT = "own"
QUALITIES = (90, 75, 50)

SENSORS: dict[str, dict[str, float]] = {
    "a good camera": {"shot": 0.02, "read": 0.005, "mosaic": 1.0},
    "a phone in a dim room": {
        "shot": 0.08, "read": 0.02, "mosaic": 1.0, "aberration": 0.002, "red": 0.1, "blue": -0.1, "compression": 25.0,
    },
}  # fmt: skip
"""Values of the control `sensor`, by what they stand for; those that are not named are
0.
"""
CURVES = {
    "gamma": "a power of 1/2.2 in place of sRGB",
    "reinhard": "highlights rolled off, x / (1 + x)",
}
"""Other tone curves, by `ImageFormation.transfer`."""
OWN_MODEL = "the run's own"  # What no other model is called
# Longest light paths in segments: direct light alone, and far more than a run renders
SHORT = 2
LONG = 16


@dataclass(frozen=True, eq=False)
class Way:
    """One condition of a replay: what is changed and to what; the problem under it,
    made anew, as it may hold a scene of its own; and why it cannot be had, empty where
    it can. The others are as those of `RetrialCondition`, by default with pictures of
    its own.
    """

    name: str
    text: str
    problem: Callable[[], Problem]
    spp: int
    light: Hashable = None
    source: Hashable = None
    change: Callable[[Tensor, int], Tensor] | None = None
    missing: str = ""

    def condition(self) -> workbench.RetrialCondition:
        title = self.text if self.name == OWN else f"{self.name}: {self.text}"
        source = self.source or title
        return workbench.RetrialCondition(
            title, self.problem(), self.spp, source, self.change, self.light
        )


def ways_of(
    problem: Problem, spp: int, sized: Callable[[tuple[int, int]], Problem]
) -> Iterator[Way]:
    """Yield every condition of a problem's configuration but other models; the first
    changes nothing. `spp` is that of the run's verification, and `sized` makes the same
    problem at another (height, width) in pixels.
    """
    renderer = problem.renderer
    scene = renderer.scene
    formation = renderer.formation

    def same(
        name: str,
        text: str,
        count: int = spp,
        change: Callable[[Tensor, int], Tensor] | None = None,
    ) -> Way:
        return Way(name, text, lambda: problem, count, OWN_LIGHT, OWN_LIGHT, change)

    def traced(name: str, text: str, **made: Any) -> Way:
        sampler = {"sampler": made["sampler"]} if "sampler" in made else {}
        return Way(
            name,
            text,
            lambda: replace(
                problem, renderer=renderer.like(scene.like(**made), **sampler)
            ),
            spp,
        )

    def formed(name: str, text: str, light: str | None = None, **fields: Any) -> Way:
        return Way(
            name,
            text,
            lambda: replace(problem, renderer=renderer.like(**fields)),
            spp,
            light,
        )

    yield same(OWN, OWN)
    for count in (max(1, spp // 4), min(workbench.MAX_SPP, 4 * spp)):
        if count != spp:
            yield same("samples", f"{count} a pixel", count)
    height, width = formation.resolution
    for size in (
        (max(8, height // 2), max(8, width // 2)),
        (min(4096, 2 * height), min(4096, 2 * width)),
    ):
        if size != (height, width):
            yield Way(
                "resolution", f"{size[0]} x {size[1]} pixels", partial(sized, size), spp
            )
    for depth in (SHORT, LONG):
        if depth != scene.max_depth:
            yield traced("depth", f"light paths of {depth} segments", max_depth=depth)
    if not scene.volumetric:
        yield traced("integrator", "Mitsuba's path in place of prb", integrator="path")
    sampler = "independent" if formation.sampler != "independent" else "multijitter"
    yield traced("sampler", sampler, sampler=sampler)
    denoiser = "none" if formation.denoiser != "none" else "oidn"
    yield formed("denoiser", denoiser, denoiser=denoiser)
    for curve, text in CURVES.items():
        yield formed("curve", f"{curve}, {text}", OWN_LIGHT, transfer=curve)
    for quality in QUALITIES:
        yield same("jpeg", f"quality {quality}", change=partial(_file, quality))
    for name, values in SENSORS.items():
        yield same("sensor", name, change=partial(_sensed, values))

    def by_blender() -> Problem:
        return replace(problem, renderer=renderer.like(source=cycles.radiance))

    denoise = formation.denoiser != "none"
    missing = ""
    try:
        cycles = Cycles(
            scene.made[0],
            formation.resolution,
            max_depth=scene.max_depth,
            denoise=denoise,
        )
    except BlenderError as error:
        missing = str(error)
    yield Way("blender", "Cycles, Blender's renderer", by_blender, spp, missing=missing)


def _file(quality: int, picture: Tensor, _seed: int) -> Tensor:
    return images.coded(picture, quality).clamp(0.0, 1.0)


def _sensed(values: Mapping[str, float], picture: Tensor, seed: int) -> Tensor:
    control = workbench.CONTROLS["sensor"]()
    control.chosen["seed"] = seed
    of_control = {
        parameter.name: values.get(parameter.name, 0.0)
        for parameter in control.parameters
    }
    changed: Tensor = control.on_picture(
        {name: torch.tensor(value) for name, value in of_control.items()}, picture
    )
    return changed


@workbench.asks(ReplayConfig)
def replay(
    attack: str | Path | AttackResult, *, progress: Watched = None, **options: Any
) -> ReplayResult:
    """Render the adversarial scene of a run under other conditions, each beside the
    clean scene (docs/questions.md).

    Args:
        attack: one that was kept and has ended: its result, or name or folder of its
            run.
    """
    parts = None
    only_now = list[settings.PythonOnly]()
    run = attack
    if isinstance(attack, AttackResult):
        if attack.run is None:
            raise InputError(
                "attack: expected an attack that was kept, got one that "
                "was not; give it a `run`"
            )
        run = attack.run
        only_now = [
            part
            for part in directory.read_python_only(Path(run))
            if part.role not in workbench.ROLES_IN_SEARCH
        ]
        parts = None if attack.parts is None else attack.parts()
    config = workbench.configured(ReplayConfig, attack=run, **options)
    config = config.with_only_here(only_now) if only_now else config
    made: ReplayResult = workbench.get_experiment("replay").run(
        config, progress=workbench.watcher(progress), parts=parts
    )
    return made


def rendered_again(
    asked: RunContext[ReplayConfig], parts: workbench.AttackParts | None = None
) -> ReplayResult:
    """Render an adversarial scene again as a configuration describes; every trial is
    stored at once, and a run goes on with the next. `parts` is what the attack was
    asked with; None loads what its run names. Raises InputError where the run has no
    adversarial configuration, or its scene is another one now, and FileFormatError
    where it did not end, or is of another command.
    """
    config = asked.config
    asked.progress.stage(workbench.LOADING)
    folder = directory.find_run(config.attack)
    summary = workbench.attack_of(folder)
    if summary.adversarial is None:
        raise InputError(
            f"{folder}: ended with {summary.ending!r}, so that there is no adversarial "
            "configuration to render again"
        )
    settings.check_once((OWN_MODEL, *config.models), "model")
    parts = parts or workbench.parts_in(folder)
    threads = {} if config.threads is None else {"threads": config.threads}
    again = partial(workbench.problem_of_parts, parts, **threads)
    problem, warnings = again()
    warnings += _changed(folder, parts)
    u = workbench.kept_configuration(folder, problem)
    spp = (
        summary.sample_count.spp
        if summary.sample_count
        else summary.verified.spp
        if summary.verified
        else 64
    )
    own, *others = ways_of(problem, spp, lambda size: again(resolution=size)[0])
    ways = [own, *(way for way in others if way.name in config.chosen)]
    # those that are shown pictures as the run's own model is take its renders
    for name in config.models:
        other = again(model=name, ensemble=None)[0]
        light = (
            OWN_LIGHT
            if other.renderer.formation == problem.renderer.formation
            else name
        )
        other = (
            replace(other, renderer=problem.renderer) if light == OWN_LIGHT else other
        )
        ways.append(Way("model", name, partial(replace, other), spp, light, light))
    table = _Table(
        u,
        config.trials,
        seeds.stream(parts.config.seed, "replay"),
        asked.run,
        asked.progress,
    )
    together = [way for way in ways if way.light == OWN_LIGHT and way.spp == spp]
    with asked.until_interrupted():
        for batch in (together, *([way] for way in ways if way not in together)):
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
    """The rows so far, by their condition, for a configuration (d,), and the pictures
    rendered.
    """

    u: torch.Tensor
    trials: int
    seed: int
    run: RunDirectory
    progress: Progress
    rows: dict[Way, ReplayRow] = field(default_factory=dict)
    renders: int = 0

    def fill(self, ways: Sequence[Way]) -> None:
        """Add the rows of some conditions that share their renders: the clean scene
        under all of them, then the adversarial one. A condition that cannot be had, or
        that Blender fails at, gets a row that says why.
        """
        renderers = list[Any]()
        before = 0
        try:
            if missing := next((way.missing for way in ways if way.missing), ""):
                raise BlenderError(missing)
            text = ", ".join(dict.fromkeys(way.name for way in ways)) + (
                f": {ways[0].text}" if len(ways) == 1 else ""
            )
            total = 2 * self.trials * len(ways)
            self.progress.stage(
                f"replaying, {text}", total, hint="`trials` or `ways` shorten it"
            )
            conditions = {way: way.condition() for way in ways}
            renderers += {
                id(one.problem.renderer): one.problem.renderer
                for one in conditions.values()
            }.values()
            before = sum(renderer.renders for renderer in renderers)
            retrials = workbench.Retrials(
                [*conditions.values()],
                self.run,
                self.progress,
                trials=self.trials,
                seed=self.seed,
            )
            clean = {
                way: workbench.control_group(retrials.clean(one), one.spp)
                for way, one in conditions.items()
            }
            for way, condition in conditions.items():
                checked = retrials.adversarial("answer", self.u, condition)
                ending = checked.ending.value
                rate = workbench.verified_rate(checked)
                self.rows[way] = ReplayRow(
                    way=way.name,
                    condition=way.text,
                    ending=ending,
                    clean=clean[way],
                    verified=rate,
                )
        except BlenderError as error:
            for way in ways:
                self.rows[way] = ReplayRow(
                    way=way.name, condition=way.text, ending=NOT_DONE, reason=str(error)
                )
        finally:
            self.renders += sum(renderer.renders for renderer in renderers) - before


def _changed(folder: Path, parts: workbench.AttackParts) -> list[str]:
    """A caution where a file was another one when the run was made."""
    name = RunDirectory.find_file_changed_since(folder, parts.config)
    return (
        [
            f"{name} is not what it was when the run was made: what does not hold may "
            "come from that."
        ]
        if name
        else []
    )
