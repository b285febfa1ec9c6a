"""Render the adversarial scene of a run under other conditions.

A condition changes the samples, the renderer, the tone curve, the file format, the
camera or the model. The clean scene is rendered under each condition, too: if the model
is wrong there, a wrong prediction for the adversarial scene is no success.
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
    SceneDescription,
    directory,
    images,
    seeds,
    settings,
    workbench,
)
from advsearch.questions.replay.cycles import BlenderError, Cycles
from advsearch.questions.replay.result import (
    NOT_DONE,
    PHOTOGRAPH,
    SEARCHED_PHOTOGRAPH,
    ReplayConfig,
    ReplayResult,
    ReplayRow,
    count_transfer,
)

AttackResult = workbench.AttackResult
ProgressOption = workbench.ProgressOption

AS_VERIFIED = "as verified"
"""Name of the condition that changes nothing."""
RUN_RENDERS = "own"
"""Key of the radiance and of the images that the renderer of the run renders."""
RUN_MODEL = "the run's own"
"""Name of the run's model in the check that no model is named twice."""
DEFAULT_SPP = 64  # samples per pixel for an attack that was not verified
JPEG_QUALITIES = (90, 75, 50)
MIN_SIZE = 8
MAX_SIZE = 4096
PATH_LENGTHS = (2, 16)
"""Longest light paths, in segments: direct light only, and many more than a run
uses.
"""

SENSORS: dict[str, dict[str, float]] = {
    "a good camera": {"shot": 0.02, "read": 0.005, "mosaic": 1.0},
    "a phone in a dim room": {
        "shot": 0.08,
        "read": 0.02,
        "mosaic": 1.0,
        "aberration": 0.002,
        "red": 0.1,
        "blue": -0.1,
        "compression": 25.0,
    },
}
"""Values of the control `sensor` that imitate a camera; all other values are 0."""
CURVES = {
    "gamma": "a power of 1/2.2 in place of sRGB",
    "reinhard": "highlights rolled off, x / (1 + x)",
}
"""Other tone curves, by `ImageFormation.transfer`."""

ImageChange = Callable[[Tensor, int], Tensor]
"""Changes an image (H, W, 3), sRGB in [0, 1]; the integer is the seed of the trial."""


@dataclass(frozen=True, eq=False)
class ReplayCondition:
    """One condition of a replay.

    Attributes:
        name: what is changed, as in the setting `ways`: "jpeg".
        description: what it is changed to: "quality 75".
        make_problem: creates the problem under this condition, which may load another
            scene.
        spp: samples per pixel.
        radiance_key: key of the linear radiance. Conditions with the same key and the
            same samples share renders; None for a condition that shares none.
        image_key: key of the image that is made of the radiance (by tone curve and
            rounding). Conditions with the same key share it; None for a condition that
            shares none.
        change_image: function that is applied to the image before the model gets it;
            None if there is none.
        unavailable_reason: why the condition cannot be rendered here; empty if it can.
    """

    name: str
    description: str
    make_problem: Callable[[], Problem]
    spp: int
    radiance_key: Hashable = None
    image_key: Hashable = None
    change_image: ImageChange | None = None
    unavailable_reason: str = ""

    def to_retrial(self) -> workbench.RetrialCondition:
        """Create the problem, and the condition for the code that makes the trials."""
        title = self.description
        if self.name != AS_VERIFIED:
            title = f"{self.name}: {self.description}"
        return workbench.RetrialCondition(
            name=title,
            problem=self.make_problem(),
            spp=self.spp,
            # The title is unique, so that no other condition shares the image.
            image_key=self.image_key or title,
            change_image=self.change_image,
            radiance_key=self.radiance_key,
        )


# ---- the conditions
# ----------------------------------------------------------------------------------


def list_conditions(
    problem: Problem, spp: int, resize: Callable[[tuple[int, int]], Problem]
) -> Iterator[ReplayCondition]:
    """Yield every condition of a problem, except for other models and photographs.

    The first one is the unchanged condition, as the run verified it.

    Args:
        problem: the problem of the run.
        spp: samples per pixel of the run's verification.
        resize: creates the same problem at another resolution, (height, width) in
            pixels.
    """
    yield make_image_condition(
        problem, name=AS_VERIFIED, description=AS_VERIFIED, spp=spp
    )
    yield from sampling_conditions(problem, spp)
    yield from resolution_conditions(problem, spp, resize)
    yield from scene_conditions(problem, spp)
    yield from image_formation_conditions(problem, spp)
    for quality in JPEG_QUALITIES:
        compress = partial(compress_as_jpeg, quality)
        yield make_image_condition(problem, "jpeg", f"quality {quality}", spp, compress)
    for camera, sensor_values in SENSORS.items():
        apply = partial(apply_sensor, sensor_values)
        yield make_image_condition(problem, "sensor", camera, spp, apply)
    yield blender_condition(problem, spp)


def make_image_condition(
    problem: Problem,
    name: str,
    description: str,
    spp: int,
    change: ImageChange | None = None,
) -> ReplayCondition:
    """Return a condition that uses the run's images as they are, or changes them.

    All such conditions share the radiance and the images of the run (before they are
    changed): with the same samples per pixel, each image is rendered only once for all
    of them.

    Args:
        problem: problem of the run.
        name: name of the condition, as in the setting `ways`.
        description: what is changed to what.
        spp: samples per pixel.
        change: function that is applied to the image; None for no change.
    """
    return ReplayCondition(
        name,
        description,
        make_problem=lambda: problem,
        spp=spp,
        radiance_key=RUN_RENDERS,
        image_key=RUN_RENDERS,
        change_image=change,
    )


def sampling_conditions(problem: Problem, spp: int) -> Iterator[ReplayCondition]:
    """Yield conditions with a quarter and with four times the samples."""
    for other_spp in (max(1, spp // 4), min(workbench.MAX_SPP, 4 * spp)):
        if other_spp != spp:
            yield make_image_condition(
                problem, "samples", f"{other_spp} a pixel", other_spp
            )


def resolution_conditions(
    problem: Problem, spp: int, resize: Callable[[tuple[int, int]], Problem]
) -> Iterator[ReplayCondition]:
    """Yield conditions with half and with twice the resolution."""
    height, width = problem.renderer.formation.resolution
    half = (max(MIN_SIZE, height // 2), max(MIN_SIZE, width // 2))
    double = (min(MAX_SIZE, 2 * height), min(MAX_SIZE, 2 * width))
    for size in (half, double):
        if size != (height, width):
            description = f"{size[0]} x {size[1]} pixels"
            yield ReplayCondition("resolution", description, partial(resize, size), spp)


def scene_conditions(problem: Problem, spp: int) -> Iterator[ReplayCondition]:
    """Yield conditions with other light paths, another integrator or sampler."""
    scene = problem.renderer.scene
    yield from _depth_conditions(problem, spp)
    # Mitsuba's integrator "path" renders no volumes, so that a scene with volumes has
    # no other integrator.
    if not scene.is_volumetric:
        integrator = "prb" if scene.integrator_name == "path" else "path"
        make_problem = partial(replace_scene_options, problem, integrator=integrator)
        description = f"Mitsuba's {integrator} in place of {scene.integrator_name}"
        yield ReplayCondition("integrator", description, make_problem, spp)

    # another sampler than that of the run
    sampler = "independent"
    if problem.renderer.formation.sampler == "independent":
        sampler = "multijitter"
    make_problem = partial(replace_scene_options, problem, sampler=sampler)
    yield ReplayCondition("sampler", sampler, make_problem, spp)


def _depth_conditions(problem: Problem, spp: int) -> Iterator[ReplayCondition]:
    """Yield conditions with light paths of other lengths than those of the run."""
    for max_depth in PATH_LENGTHS:
        if max_depth != problem.renderer.scene.max_depth:
            make_problem = partial(replace_scene_options, problem, max_depth=max_depth)
            description = f"light paths of {max_depth} segments"
            yield ReplayCondition("depth", description, make_problem, spp)


def replace_scene_options(problem: Problem, **changes: Any) -> Problem:
    """Return the problem with a new scene in which some of its options are changed."""
    scene = problem.renderer.scene.copy_with(**changes)
    renderer_changes = {}
    # The renderer states the sampler, too.
    if "sampler" in changes:
        renderer_changes["sampler"] = changes["sampler"]
    return replace(
        problem, renderer=problem.renderer.copy_with(scene, **renderer_changes)
    )


def image_formation_conditions(problem: Problem, spp: int) -> Iterator[ReplayCondition]:
    """Yield conditions with another denoiser or tone curve.

    A tone curve needs no other renders: it is applied to the run's radiance.
    """
    denoiser = "none"
    if problem.renderer.formation.denoiser == "none":
        denoiser = "oidn"
    make_problem = partial(replace_renderer_options, problem, denoiser=denoiser)
    yield ReplayCondition("denoiser", denoiser, make_problem, spp)
    for curve, text in CURVES.items():
        make_problem = partial(replace_renderer_options, problem, transfer=curve)
        description = f"{curve}, {text}"
        # It shares the radiance of the run, but not the image.
        yield ReplayCondition(
            "curve", description, make_problem, spp, radiance_key=RUN_RENDERS
        )


def replace_renderer_options(problem: Problem, **changes: Any) -> Problem:
    """Return the problem with a renderer in which some of its options are changed."""
    return replace(problem, renderer=problem.renderer.copy_with(**changes))


def compress_as_jpeg(quality: int, image: Tensor, _seed: int) -> Tensor:
    """Return an image (H, W, 3) after JPEG compression."""
    return images.compress_jpeg(image, quality).clamp(0.0, 1.0)


def apply_sensor(
    sensor_values: Mapping[str, float], image: Tensor, seed: int
) -> Tensor:
    """Return an image (H, W, 3) as a camera's sensor records it.

    Args:
        sensor_values: values of the parameters of the control `sensor`, by name;
            parameters that are missing are 0.
        image: sRGB in [0, 1].
        seed: seed of the sensor's noise.
    """
    control = workbench.CONTROLS["sensor"]()
    # `seed` is a setting of the control, which decides its noise.
    control.choice_values["seed"] = seed
    parameters = {
        parameter.name: torch.tensor(sensor_values.get(parameter.name, 0.0))
        for parameter in control.parameters
    }
    sensor_image: Tensor = control.on_picture(parameters, image)
    return sensor_image


def blender_condition(problem: Problem, spp: int) -> ReplayCondition:
    """Return the condition that renders with Cycles.

    If Blender is not installed, or the scene cannot be exported, the condition states
    the reason, which the result reports.
    """
    # The problem is replaced below, if Cycles can render it.
    condition = ReplayCondition(
        "blender", "Cycles, Blender's renderer", lambda: problem, spp
    )
    description, _reconstruction_filter = problem.renderer.scene.description_and_filter
    try:
        cycles = _make_cycles(problem, description)
    except BlenderError as error:
        return replace(condition, unavailable_reason=str(error))
    # `source` is the function that renders the radiance.
    make_problem = partial(replace_renderer_options, problem, source=cycles.radiance)
    return replace(condition, make_problem=make_problem)


def _make_cycles(problem: Problem, description: SceneDescription) -> Cycles:
    """Make the renderer with Cycles of a problem's images.

    Args:
        problem: the problem.
        description: the scene of the problem.
    """
    renderer = problem.renderer
    return Cycles(
        description,
        renderer.formation.resolution,
        max_depth=renderer.scene.max_depth,
        denoise=renderer.formation.denoiser != "none",
    )


def model_condition(
    problem: Problem, other_problem: Problem, name: str, spp: int
) -> ReplayCondition:
    """Return the condition under which another model predicts the scene.

    If the other model takes images of the same formation (size, tone curve, denoiser
    and the like) as the run's own model, it predicts the run's images, which saves
    time. Otherwise the scene is rendered for it.

    Args:
        problem: problem of the run.
        other_problem: the same problem with the other model.
        name: name of the other model.
        spp: samples per pixel.
    """
    # Conditions with the same key share radiance and image. With the name of the model
    # as the key, no other condition shares them.
    shared_key: Hashable = name
    takes_same_images = other_problem.renderer.formation == problem.renderer.formation
    if takes_same_images:
        shared_key = RUN_RENDERS
        other_problem = replace(other_problem, renderer=problem.renderer)
    return ReplayCondition(
        "model",
        name,
        # a copy of the problem, since each condition needs its own one
        make_problem=partial(replace, other_problem),
        spp=spp,
        radiance_key=shared_key,
        image_key=shared_key,
    )


def photograph_conditions(
    parts: workbench.AttackParts, folder: str, spp: int, threads: Mapping[str, int]
) -> Iterator[ReplayCondition]:
    """Yield a condition for each photograph of a folder.

    If the attack used a single photograph, it is left out: the unchanged condition
    renders it already.

    Args:
        parts: parts of the attack.
        folder: directory of photographs, or a name as for the setting `backdrop`.
        spp: samples per pixel.
        threads: {"threads": number of threads} for the problems; empty for the number
            of the run.
    """
    # by name, the parts of the attack in each photograph: those that the search did not
    # use, and those that it used
    other_photographs, used_photographs = workbench.move_to_photographs(parts, folder)
    if len(used_photographs) == 1:
        used_photographs = {}
    for method, parts_by_name in (
        (PHOTOGRAPH, other_photographs),
        (SEARCHED_PHOTOGRAPH, used_photographs),
    ):
        for name, moved_parts in parts_by_name.items():
            yield ReplayCondition(
                method,
                name,
                make_problem=partial(_make_photograph_problem, moved_parts, threads),
                spp=spp,
            )


def _make_photograph_problem(
    parts: workbench.AttackParts, threads: Mapping[str, int]
) -> Problem:
    """Make the problem of an attack in a photograph, without derivatives.

    Args:
        parts: parts of the attack.
        threads: setting of the number of threads; empty for that of the run.
    """
    config = parts.config.model_copy(update=dict(threads))
    return workbench.make_problem(replace(parts, config=config), differentiated=False)


# ---- the experiment
# ----------------------------------------------------------------------------------


@workbench.with_settings_signature(ReplayConfig)
def replay(
    attack: str | Path | AttackResult,
    *,
    progress: ProgressOption = None,
    **options: Any,
) -> ReplayResult:
    """Render the adversarial scene of a run under other conditions (docs/questions.md).

    The clean scene is rendered under each condition, too: the model has to be right
    there. All other options are the settings of `advsearch replay`.

    Args:
        attack: an attack that has ended and whose run is stored: its result, or the
            name or directory of its run.
        progress: where progress is reported; None for the default.
    """
    run: str | Path | AttackResult = attack
    parts = None
    python_only = list[settings.PythonOnly]()
    if isinstance(attack, AttackResult):
        run = _get_stored_run(attack)
        # Parts that exist only in Python, such as a model object, cannot be loaded from
        # the run. `attack.parts` is a function that returns them.
        python_only = _read_python_only_parts(run)
        if attack.parts is not None:
            parts = attack.parts()
    config = workbench.make_config(ReplayConfig, attack=run, **options)
    if python_only:
        config = config.with_python_only_parts(python_only)
    result: ReplayResult = workbench.get_experiment("replay").run(
        config, progress=workbench.as_progress(progress), parts=parts
    )
    return result


def _get_stored_run(attack: AttackResult) -> Path:
    """Return the directory of an attack's run.

    Raises:
        InputError: the run is not stored.
    """
    if attack.run is None:
        raise InputError(
            "attack: expected an attack whose run is stored, got one that "
            "is not; set its `run`"
        )
    return Path(attack.run)


def _read_python_only_parts(run: Path) -> list[settings.PythonOnly]:
    """Return the arguments of an attack that exist only in Python, such as a model.

    With such an argument, no command of the shell can repeat the replay. Arguments that
    only the search used, such as a policy, do not matter here and are left out.

    Args:
        run: directory of the attack.
    """
    return [
        part
        for part in directory.read_python_only(run)
        if part.role not in workbench.ROLES_IN_SEARCH
    ]


def run_replay(
    context: RunContext[ReplayConfig], parts: workbench.AttackParts | None = None
) -> ReplayResult:
    """Render an adversarial scene again under the conditions that settings select.

    Every trial is stored at once, so that a resumed run continues with the next one.

    Args:
        context: the settings and the run.
        parts: loaded parts of the attack, such as its model object; None to load what
            the run of the attack names.

    Raises:
        InputError: the attack has no adversarial configuration, or its scene has
            changed.
        FileFormatError: the run did not end, or is not an attack.
    """
    config = context.config
    context.progress.stage(workbench.LOADING)
    attack = _load_replayed_attack(config, parts)
    problem, warnings = attack.load_problem()
    warnings += describe_changed_file(attack.directory, attack.parts)
    spp = verification_spp(attack.summary)
    conditions = select_conditions(config, problem, spp, attack.load_problem)
    if config.backdrop is not None:
        conditions += photograph_conditions(
            attack.parts, config.backdrop, spp, attack.threads
        )
    u = workbench.read_stored_configuration(attack.directory, problem)
    # Conditions that share renders are in the same batch, so that each image is
    # rendered once.
    batches = batch_by_renders(conditions, spp)
    table = _fill_table(context, u, attack.parts.config.seed, batches)
    rows = table.list_rows(conditions)
    return context.result(
        ReplayResult,
        adversarial_run=str(attack.directory),
        **_list_attack_facts(attack.summary),
        table=rows,
        transfer=count_transfer(rows, PHOTOGRAPH),
        searched=count_transfer(rows, SEARCHED_PHOTOGRAPH),
        renders=table.renders,
        warnings=warnings,
        seed=attack.parts.config.seed,
    )


@dataclass(frozen=True, eq=False)
class _ReplayedAttack:
    """An attack whose adversarial scene is rendered again.

    Attributes:
        directory: directory of its run.
        summary: its summary.
        parts: its loaded parts.
        threads: a change of the setting `threads`; empty to use as many as the run.
    """

    directory: Path
    summary: workbench.AttackSummary
    parts: workbench.AttackParts
    threads: dict[str, Any]

    def load_problem(self, **changes: Any) -> tuple[Problem, list[str]]:
        """Load its problem, with changes to its settings, and warnings about it."""
        return workbench.make_problem_with_warnings(
            self.parts, **{**self.threads, **changes}
        )


def _load_replayed_attack(
    config: ReplayConfig, parts: workbench.AttackParts | None
) -> _ReplayedAttack:
    """Load the attack that the settings name, and check that it can be replayed.

    Args:
        config: the settings.
        parts: its loaded parts; None to load what its run names.
    """
    attack_directory = directory.find_run(config.attack)
    summary = _load_attack(attack_directory)
    # `RUN_MODEL` stands for the run's own model, which is always used.
    settings.check_no_duplicates((RUN_MODEL, *config.models), "model")
    return _ReplayedAttack(
        directory=attack_directory,
        summary=summary,
        parts=parts or workbench.load_parts_of_run(attack_directory),
        threads={} if config.threads is None else {"threads": config.threads},
    )


def _fill_table(
    context: RunContext[ReplayConfig],
    u: Tensor,
    attack_seed: int,
    batches: Sequence[Sequence[ReplayCondition]],
) -> _Table:
    """Render batches of conditions until an interrupt, and return their rows.

    Args:
        context: the settings and the run.
        u: the adversarial configuration (d,).
        attack_seed: seed of the attack.
        batches: conditions that share their renders.
    """
    table = _Table(
        u=u,
        trials=context.config.trials,
        # another stream of seeds, so that no noise of the attack is repeated
        seed=seeds.derive_seed(attack_seed, "replay"),
        run=context.run,
        progress=context.progress,
    )
    with context.until_interrupted():
        for batch in batches:
            table.add_rows(batch)
    return table


def _list_attack_facts(attack: workbench.AttackSummary) -> dict[str, Any]:
    """Return what a replay's result states about its attack, by field."""
    return {
        "run_ending": attack.ending,
        "object": attack.object,
        "model": attack.model,
        "task": attack.task,
        "environment": attack.environment,
        "controls": attack.controls,
    }


def _load_attack(attack_directory: Path) -> workbench.AttackSummary:
    """Load the summary of an attack that has an adversarial configuration.

    Raises:
        InputError: the attack has no adversarial configuration.
        FileFormatError: the run did not end, or is not an attack.
    """
    attack = workbench.load_attack_summary(attack_directory)
    if attack.adversarial is None:
        raise InputError(
            f"{attack_directory}: ended with {attack.ending!r}, so that there is no "
            "adversarial configuration to render again"
        )
    return attack


def verification_spp(attack: workbench.AttackSummary) -> int:
    """Return the samples per pixel that an attack was verified with."""
    if attack.sample_count:
        return attack.sample_count.spp
    if attack.verified:
        return attack.verified.spp
    return DEFAULT_SPP  # it was not verified


def select_conditions(
    config: ReplayConfig,
    problem: Problem,
    spp: int,
    load_problem: Callable[..., tuple[Problem, list[str]]],
) -> list[ReplayCondition]:
    """Return the conditions that the settings select, the unchanged one first.

    The unchanged condition is always included, as a reference for the others.

    Args:
        config: the settings.
        problem: the problem of the run.
        spp: samples per pixel of the run's verification.
        load_problem: loads the problem again, with changes to its settings.
    """
    resize = partial(_load_resized, load_problem)
    unchanged, *other_conditions = list_conditions(problem, spp, resize)
    conditions = [unchanged]
    conditions += [
        condition
        for condition in other_conditions
        if condition.name in config.selected_names
    ]
    for model_name in config.models:
        # Without `ensemble`, the other model replaces all models of the run.
        other_problem, _ = load_problem(model=model_name, ensemble=None)
        conditions.append(model_condition(problem, other_problem, model_name, spp))
    return conditions


def _load_resized(
    load_problem: Callable[..., tuple[Problem, list[str]]], size: tuple[int, int]
) -> Problem:
    """Load the problem at another resolution, without its warnings.

    Args:
        load_problem: loads the problem again, with changes to its settings.
        size: (height, width) in pixels.
    """
    resized_problem, _ = load_problem(resolution=size)
    return resized_problem


def batch_by_renders(
    conditions: Sequence[ReplayCondition], spp: int
) -> list[list[ReplayCondition]]:
    """Divide conditions into batches that share their renders.

    The first batch has all conditions that share the renders of the run: those with its
    radiance and its samples per pixel. It is empty if there are none. Every other
    condition is a separate batch.

    Args:
        conditions: the conditions.
        spp: samples per pixel of the run's verification.
    """
    shared = []
    single = []
    for condition in conditions:
        uses_run_renders = (
            condition.radiance_key == RUN_RENDERS and condition.spp == spp
        )
        if uses_run_renders:
            shared.append(condition)
        else:
            single.append([condition])
    return [shared, *single]


@dataclass
class _Table:
    """The rows of a replay so far.

    Attributes:
        u: the adversarial configuration (d,).
        trials: number of trials of each scene, clean and adversarial, under a
            condition.
        seed: root of the seeds of the trials.
        run: the run that stores the trials.
        progress: the progress bar.
        rows: the results by condition.
        renders: number of images rendered so far.
    """

    u: torch.Tensor
    trials: int
    seed: int
    run: RunDirectory
    progress: Progress
    rows: dict[ReplayCondition, ReplayRow] = field(default_factory=dict)
    renders: int = 0

    def add_rows(self, conditions: Sequence[ReplayCondition]) -> None:
        """Add the rows of conditions that share their renders.

        A condition that is not available, or in which Blender fails, gets a row with
        the reason.

        Args:
            conditions: conditions that share their renders.
        """
        reasons = [
            condition.unavailable_reason
            for condition in conditions
            if condition.unavailable_reason
        ]
        if reasons:
            # Then it is the only condition: those that share renders are available.
            self._add_not_done(conditions, reasons[0])
            return
        try:
            self._render(conditions)
        except BlenderError as error:
            self._add_not_done(conditions, str(error))

    def list_rows(self, conditions: Sequence[ReplayCondition]) -> list[ReplayRow]:
        """Return the rows so far in the order of conditions."""
        return [
            self.rows[condition] for condition in conditions if condition in self.rows
        ]

    def _add_not_done(self, conditions: Sequence[ReplayCondition], reason: str) -> None:
        """Add rows of conditions that were not rendered, with the reason."""
        for condition in conditions:
            self.rows[condition] = ReplayRow(
                change=condition.name,
                condition=condition.description,
                ending=NOT_DONE,
                reason=reason,
            )

    def _render(self, conditions: Sequence[ReplayCondition]) -> None:
        """Render the trials of conditions, and count the renders.

        They are counted even after an interrupt. There are as many trials of the clean
        scene as of the adversarial scene.

        Args:
            conditions: conditions that share their renders.
        """
        self._begin_replaying(conditions)
        retrial_of_condition = {
            condition: condition.to_retrial() for condition in conditions
        }
        # Conditions may share a renderer, which is counted once.
        renderer_by_id = {
            id(retrial.problem.renderer): retrial.problem.renderer
            for retrial in retrial_of_condition.values()
        }
        renderers = list(renderer_by_id.values())
        renders_before = sum(renderer.n_renders for renderer in renderers)
        try:
            self._add_trials(retrial_of_condition)
        finally:
            renders_after = sum(renderer.n_renders for renderer in renderers)
            self.renders += renders_after - renders_before

    def _begin_replaying(self, conditions: Sequence[ReplayCondition]) -> None:
        """Begin the stage of conditions that share their renders."""
        names = ", ".join(dict.fromkeys(condition.name for condition in conditions))
        if len(conditions) == 1:
            names = f"{names}: {conditions[0].description}"
        self.progress.stage(
            f"replaying, {names}",
            2 * self.trials * len(conditions),
            hint="`trials` or `ways` shorten it",
        )

    def _add_trials(
        self, retrial_of_condition: Mapping[ReplayCondition, workbench.RetrialCondition]
    ) -> None:
        """Try the clean scene under all conditions, then the adversarial scene.

        Rows are added when both are known.

        Args:
            retrial_of_condition: each condition in the form that `Retrials` takes.
        """
        retrials = self._make_retrials(list(retrial_of_condition.values()))
        clean_results = {
            condition: workbench.make_control_group(
                retrials.run_clean_trials(retrial), retrial.spp
            )
            for condition, retrial in retrial_of_condition.items()
        }
        for condition, retrial in retrial_of_condition.items():
            # The trials are stored as rows of the kind "answer".
            verification = retrials.try_adversarial("answer", self.u, retrial)
            self.rows[condition] = ReplayRow(
                change=condition.name,
                condition=condition.description,
                ending=verification.ending.value,
                clean=clean_results[condition],
                verified=workbench.make_verified_rate(verification),
            )

    def _make_retrials(
        self, conditions: list[workbench.RetrialCondition]
    ) -> workbench.Retrials:
        """Make what tries scenes again under some conditions."""
        return workbench.Retrials(
            conditions, self.run, self.progress, trials=self.trials, seed=self.seed
        )


def describe_changed_file(path: Path, parts: workbench.AttackParts) -> list[str]:
    """Return a warning if a file has changed since the run was made."""
    name = RunDirectory.find_file_changed_since(path, parts.config)
    if not name:
        return []
    return [
        f"{name} is not what it was when the run was made, which may be the reason "
        "if the adversarial scene does not hold."
    ]
