"""Check the gradients of a scene, and plan a search over it: `advsearch check`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

from pydantic import TypeAdapter
from torch import Tensor

from advsearch.extend import Problem, RunContext, gradients, results, seeds, workbench
from advsearch.questions.check.leaving_out import (
    MAX_GRADIENTS,
    measure_gains,
    measure_texels,
)
from advsearch.questions.check.result import (
    CheckConfig,
    CheckedRow,
    CheckResult,
    GainRow,
    SearchPlan,
    TexelRow,
)

planning = gradients.planning
SCENES = (("mug", None), ("bowl", "kitchen"), ("bottle", "noon"))
"""Bundled scenes that `check --all` goes through; None is the default environment."""
# samples per pixel of a gradient of the linear loss, which is rendered without denoiser
RAW_SPP = 16
# maximum samples per pixel of a gradient of the model's loss
MAX_SPP = 256
REFERENCE_SPP = 64
"""Samples per pixel of a reference render."""
N_SEEDS = (6, 16)
"""Minimum and maximum number of seeds of a reference: until its noise is small."""
# the same for the model's loss, whose renders have more samples
N_MODEL_SEEDS = (3, 6)
HINT = "`resolution` or fewer controls shorten it, `seconds` ends it"
OMISSION_HINT = "`specialise=false` leaves it out"
Finding = CheckedRow | SearchPlan | results.PathLength | GainRow | TexelRow
FINDINGS: TypeAdapter[list[Finding]] = TypeAdapter(list[Finding])
FindingType = TypeVar("FindingType")


@dataclass(frozen=True)
class CheckedPart:
    """A part of a check: a scene with its controls, and a loss.

    Attributes:
        number: number from 1.
        config: config of the scene and its controls.
        loss: "linear" or "model".
    """

    number: int
    config: CheckConfig
    loss: str

    @property
    def key(self) -> str:
        """The name under which its measurements are stored."""
        return f"check {self.number}"

    @property
    def title(self) -> str:
        """The part in the messages of the progress: "mug in studio, pose"."""
        return (
            f"{self.config.object} in {self.config.environment_name}, "
            f"{' and '.join(self.config.controls)}"
        )

    def make_row(self, measured: results.Measured, **fields: Any) -> CheckedRow:
        """Return a measurement as a row, with the scene, the loss and other `fields`."""
        config = self.config
        scene_fields = {
            "object": config.object,
            "environment": config.environment_name,
            "loss": self.loss,
        }
        return CheckedRow(**{**vars(measured), **scene_fields, **fields})


def list_parts(config: CheckConfig) -> list[CheckedPart]:
    """Return all parts of a check."""
    configs = list(list_bundled(config)) if config.all else [config]
    parts = list[CheckedPart]()
    for part_config in configs:
        for loss in config.losses:
            parts.append(CheckedPart(len(parts) + 1, part_config, loss))
    return parts


def list_bundled(config: CheckConfig) -> Iterator[CheckConfig]:
    """Yield the settings of a check of each control, on each bundled scene.

    Controls that make no sense on a scene are left out.
    """
    for object_name, environment in SCENES:
        scene_fields = {
            "object": object_name,
            "environment": environment,
            "label": None,
        }
        for control in _list_bundled_controls(object_name, environment):
            control_fields = {
                "controls": {control: {}},
                **workbench.select_run_settings(config, control, {}),
            }
            yield config.model_copy(update={**scene_fields, **control_fields})


def _list_bundled_controls(object_name: str, environment: str | None) -> list[str]:
    """Return the controls that make sense on a bundled scene."""
    skipped = set()
    if object_name == "bottle":
        skipped.add("contents")  # it is closed
    if environment is not None:
        skipped.add("sky")  # it would replace the environment
    # Bundled scenes define no parameters for controls without their own.
    return [
        control
        for control, control_type in workbench.CONTROLS.items()
        if control_type.parameters and control not in skipped
    ]


class GradientCheck:
    """Makes or continues a check.

    Each measurement is stored at once. A check that was stopped continues with the next
    one, and ends with the same rows; only times differ.
    """

    def __init__(self, context: RunContext[CheckConfig]) -> None:
        self.context = context
        self.progress = context.progress
        self.progress.stage(workbench.LOADING)
        self.parts = list_parts(context.config)
        self.measurements = context.open_measurements(context.config.seconds)
        self.parts_done = 0

    def run(self) -> CheckResult:
        """Measure all parts, as far as the time allows, and return the result."""
        return self.measurements.make_result_of_rows(
            self._measure_parts(), self._make_result
        )

    def _make_result(self, findings: list[Finding]) -> CheckResult:
        """Return the result of what is measured so far."""
        plans = _select(findings, SearchPlan)
        lengths = _select(findings, results.PathLength)
        return self.context.result(
            CheckResult,
            **self._join_scene_names(),
            measured=self.parts_done,
            planned=len(self.parts),
            rows=_select(findings, CheckedRow),
            plan=plans[0] if plans else None,
            bounces=lengths[0] if lengths else None,
            gains=_select(findings, GainRow),
            texels=_select(findings, TexelRow),
        )

    def _join_scene_names(self) -> dict[str, Any]:
        """Return the fields that name the objects, environments and controls, each once."""
        configs = [part.config for part in self.parts]
        objects = dict.fromkeys(config.object for config in configs)
        environments = dict.fromkeys(config.environment_name for config in configs)
        controls = dict.fromkeys(name for config in configs for name in config.controls)
        return {
            "object": ",".join(objects),
            "environment": ",".join(environments),
            "controls": list(controls),
        }

    def _measure_parts(self) -> Iterator[Finding]:
        """Yield what is stored of each part, or else measure it."""
        for part in self.parts:
            stored = self.measurements.read_stored(part.key)
            if stored is not None:  # measured before: nothing is loaded
                yield from FINDINGS.validate_python(stored)
            else:
                yield from self._measure_part(part)
            self.parts_done += 1

    def _measure_part(self, part: CheckedPart) -> Iterator[Finding]:
        """Measure a part, and store it when it is complete."""
        title = part.title
        if len(self.parts) > 1:
            title += f" ({part.number} of {len(self.parts)})"
        self.progress.stage(f"loading {title}")
        measure = self._measure_linear if part.loss == "linear" else self._measure_model
        findings = []
        for finding in measure(part, title):
            findings.append(finding.to_dict())
            yield finding
            # Reported after the `yield`, at which the caller may end the check.
            if isinstance(finding, CheckedRow):
                self._report_row(finding)
        self.measurements.put(part.key, findings)

    def _report_row(self, row: CheckedRow) -> None:
        """Report a measurement."""
        if row.cosine is not None:
            value = f"cosine {row.cosine:.2f}"
        else:
            value = f"{row.value:.3g}"
        self.progress.message(
            f"{row.object}, {row.name} by {row.estimator}: {value}, {row.status}"
        )

    def _measure_linear(self, part: CheckedPart, title: str) -> Iterator[Finding]:
        """Measure derivatives of a smooth linear loss of the raw image.

        That loss has little noise and no model, so that errors of the renderer's
        derivatives are visible.

        Args:
            part: controls and settings that are measured.
            title: title for the progress.
        """
        config = part.config
        renderer = _make_raw_renderer(config)
        loss = gradients.make_smooth_loss(renderer.formation.resolution, config.seed)
        spp = config.spp if isinstance(config.spp, int) else RAW_SPP
        # The reference takes differences with the planned step and with a wider one.
        reference_factors = gradients.FACTORS[:2]
        rows = gradients.measure_derivatives(
            self._make_bench(part, renderer, loss, spp),
            reference_spp=REFERENCE_SPP,
            reference_repeats=N_SEEDS,
            reference_factors=reference_factors,
            list_tries=gradients.list_attempts,  # all estimators, not only the planned
            stage=partial(self._begin_stage, title),
        )
        for row in rows:
            yield part.make_row(row)

    def _measure_model(self, part: CheckedPart, title: str) -> Iterator[Finding]:
        """Plan a search by the model's own loss, and measure its derivatives as planned.

        Three kinds of results are yielded. First come the cosines between noisy
        gradients and a converged one, by which steps and samples are chosen. Then comes
        the plan of the search, except in a check of all bundled scenes (setting `all`).
        The derivatives come last. Each has the ratio of its chosen step of differences
        to the default one.

        Args:
            part: controls and settings that are measured.
            title: title for the progress.
        """
        config = part.config
        problem, _ = workbench.problem_from_config(config)
        renderer = problem.renderer
        bench = self._make_bench(
            part, renderer, problem.compute_loss, problem.search_spp
        )

        renderer.plan = self._choose_estimators(title, bench, config)
        default_steps = {group.name: group.step for group in renderer.plan.groups}

        rows = list[results.Measured]()
        for row in self._measure_cosines(problem, bench, config.seed, title):
            rows.append(row)
            yield part.make_row(row)
        renderer.plan, sufficient_spp = planning.choose_steps(renderer.plan, rows)
        spp = sufficient_spp or problem.search_spp

        if not config.all:
            yield from self._plan_search(problem, part, spp)
        planned_bench = replace(bench, spp=spp)
        yield from self._measure_planned(part, title, planned_bench, default_steps)

    def _measure_planned(
        self,
        part: CheckedPart,
        title: str,
        bench: gradients.Bench,
        default_steps: dict[str, float],
    ) -> Iterator[Finding]:
        """Measure the derivatives of the model's loss with the plan of the renderer.

        Args:
            part: controls and settings that are measured.
            title: title for the progress.
            bench: measures gradients with the samples per pixel of the search.
            default_steps: default step of each group, by its name.
        """
        step_factors = _divide_steps(bench.renderer.plan.groups, default_steps)
        derivatives = gradients.measure_derivatives(
            bench,
            reference_spp=planning.CONVERGED_SPP,
            reference_repeats=N_MODEL_SEEDS,
            stage=partial(self._begin_stage, title),
        )
        for row in derivatives:
            # A coordinate of a vector is "center.0"; its group is the full vector.
            group_name = f"{row.control}.{row.parameter.partition('.')[0]}"
            yield part.make_row(row, factor=step_factors.get(group_name, 1.0))

    def _choose_estimators(
        self, title: str, bench: gradients.Bench, config: CheckConfig
    ) -> Any:
        """Return the plan with the best estimators, by measurement."""
        n_gradients = planning.count_plan_gradients(bench.renderer.plan)
        stage_title = f"{title}: comparing ways to differentiate"
        self.progress.stage(stage_title, n_gradients, hint=HINT)
        # the seed with which an attack measures, too
        seed = seeds.derive_seed(config.seed, "measure")
        return planning.choose_estimators(replace(bench, seed=seed), count_renders=True)

    def _measure_cosines(
        self, problem: Problem, bench: gradients.Bench, seed: int, title: str
    ) -> Iterator[results.Measured]:
        """Yield the cosines of gradients with converged ones, by samples per pixel.

        Args:
            problem: problem of the search.
            bench: measures gradients, and stores them.
            seed: seed of the renders.
            title: title of the progress.
        """
        plan = problem.renderer.plan
        counts = _choose_sample_counts(problem.search_spp)
        self.progress.stage(
            f"{title}: the model's gradients",
            planning.count_cosine_samples(plan, counts=counts),
            hint=f"counted in samples a pixel; {HINT}",
            at_most=True,
        )
        cosine_bench = replace(bench, seed=seed, tick=self.progress.advance)
        yield from planning.measure_cosines(cosine_bench, counts=counts)

    def _make_bench(
        self,
        part: CheckedPart,
        renderer: gradients.Renderer,
        loss: gradients.Loss,
        spp: int,
    ) -> gradients.Bench:
        """Return a bench that measures gradients and stores each measurement.

        Args:
            part: controls and settings that are measured; its key names the stored
                measurements.
            renderer: renderer of the scene.
            loss: loss that is differentiated.
            spp: samples per pixel.
        """
        return gradients.Bench(
            renderer,
            loss,
            # a point inside all bounds, where a parameter can move to both sides
            gradients.find_interior_point(renderer),
            seeds.derive_seed(part.config.seed, "check"),
            spp,
            partial(self._get_or_measure, part.key),
            tick=lambda samples: self.progress.advance(1),
        )

    def _get_or_measure(self, key: str, name: str, measure: Callable[[], Any]) -> Any:
        """Return what is stored of a part under a name, or else measure and store it.

        Args:
            key: key of the part.
            name: name of the measurement.
            measure: makes the measurement.
        """
        return self.measurements.get_or_measure(f"{key} {name}", measure)

    def _begin_stage(self, title: str, name: str, max_steps: int) -> None:
        """Begin a stage of the progress; `title` is the title of the part."""
        self.progress.stage(f"{title}: {name}", max_steps, hint=HINT, at_most=True)

    def _plan_search(
        self, problem: Problem, part: CheckedPart, spp: int
    ) -> Iterator[Finding]:
        """Yield the plan of a search, its longest light paths, and what it saves.

        With `specialise=false` nothing is left out, and only the plan is yielded.

        Args:
            problem: problem of the scene.
            part: part of the check; its key names the stored measurements.
            spp: samples per pixel of the search.
        """
        renderer = problem.renderer
        left_out = ["nothing (`specialise=false`)"]
        if part.config.specialise:
            left_out = list_left_out(renderer)
        summary = problem.summarize_plan(renderer.plan)
        plan_fields = {**vars(summary), "spp": spp, "left_out": left_out}
        yield SearchPlan(**plan_fields)
        if part.config.specialise:
            yield from self._measure_savings(problem, part)

    def _measure_savings(
        self, problem: Problem, part: CheckedPart
    ) -> Iterator[Finding]:
        """Yield the longest light paths of a search, and what it saves.

        There is a row for each item that the rendering leaves out, such as bounces, with
        the time that this saves. A further row for each texture has its visible texels.
        Each measurement is read if it is stored, or else made and stored.

        Args:
            problem: problem of the scene.
            part: part of the check; its key names the stored measurements.
        """
        length = self.measurements.get_or_measure_row(
            f"{part.key} bounces",
            results.PathLength,
            lambda: self._measure_path_length(problem, part.config.seed),
        )
        yield length
        yield from self._measure_omissions(problem, part, length.depth)

    def _measure_omissions(
        self, problem: Problem, part: CheckedPart, depth: int
    ) -> Iterator[Finding]:
        """Yield what each omission saves, and then the visible texels of each texture.

        Args:
            problem: problem of the scene.
            part: part of the check; its key names the stored measurements.
            depth: segments of the longest light path of the search.
        """
        u = gradients.find_interior_point(problem.renderer)
        seed = seeds.derive_seed(part.config.seed, "leaving out")
        yield from self.measurements.get_or_measure_rows(
            f"{part.key} gains",
            GainRow,
            lambda: self._measure_gains(problem, u, seed, depth),
        )
        yield from self.measurements.get_or_measure_rows(
            f"{part.key} texels",
            TexelRow,
            lambda: measure_texels(problem.renderer, u, seed=seed),
        )

    def _measure_path_length(self, problem: Problem, seed: int) -> results.PathLength:
        """Measure the longest light paths that matter, at the problem's start."""
        self.progress.stage(
            "finding how many bounces of light matter",
            planning.count_bounce_images(problem),
            hint=OMISSION_HINT,
            at_most=True,
        )
        tick = self.progress.advance
        return planning.measure_problem_bounces(problem, seed, tick=tick)

    def _measure_gains(
        self, problem: Problem, u: Tensor, seed: int, depth: int
    ) -> list[GainRow]:
        """Measure what is saved by each item that is left out of the rendering.

        Args:
            problem: problem of the scene.
            u: (d,) the configuration.
            seed: seed of the renders.
            depth: segments of the longest light path of the search.
        """
        self.progress.stage(
            "measuring what leaving things out saves",
            MAX_GRADIENTS,
            hint=OMISSION_HINT,
            at_most=True,
        )
        return measure_gains(
            problem.renderer,
            problem.compute_loss,
            u,
            seed=seed,
            spp=problem.search_spp,
            depth=depth,
            tick=self.progress.advance,
        )


def _make_raw_renderer(config: CheckConfig) -> gradients.Renderer:
    """Create a renderer of the raw image of a scene, for small steps of differences."""
    # A denoiser would change the derivatives.
    problem, _ = workbench.problem_from_config(config, denoise="none")
    renderer = problem.renderer
    # The raw image has no tone curve.
    renderer.formation = replace(renderer.formation, transfer="linear")
    # The steps of differences move outlines by at most about a pixel, since the loss
    # is not linear over wider steps.
    renderer.plan = renderer.plan.with_pixel_steps()
    return renderer


def _choose_sample_counts(search_spp: int) -> tuple[int, ...]:
    """Return the samples per pixel at which gradients are compared.

    They are not fewer than those of the search.
    """
    larger_counts = tuple(
        count for count in (*planning.SAMPLE_COUNTS, MAX_SPP) if count >= search_spp
    )
    return larger_counts or (search_spp,)


def _divide_steps(
    groups: Sequence[Any], default_steps: dict[str, float]
) -> dict[str, float]:
    """Return the step of each group as a multiple of its default step, by name.

    A group that takes no differences has a step of 0, and is left out.
    """
    return {
        group.name: group.step / default_steps[group.name]
        for group in groups
        if default_steps[group.name] != 0.0
    }


def _select(findings: Sequence[Finding], kind: type[FindingType]) -> list[FindingType]:
    """Return the findings of a type."""
    return [finding for finding in findings if isinstance(finding, kind)]


def list_left_out(renderer: gradients.Renderer) -> list[str]:
    """Return what a search with the renderer's plan does not compute, in sentences."""
    estimators = {group.estimator for group in renderer.plan.groups}
    sentences = _list_unneeded_renders(estimators)
    if not renderer.scene.is_volumetric:
        sentences.append("the volumetric integrator: there is no medium")
    if "material" in estimators:
        # effects that this estimator ignores or approximates
        sentences += [
            f"by the material form: {limit}" for limit in renderer.scene.material_limits
        ]
    return sentences


def _list_unneeded_renders(estimators: set[str]) -> list[str]:
    """Return what derivatives by some estimators do not need, in sentences.

    Args:
        estimators: the estimators of all groups of coordinates.
    """
    sentences = []
    # Of all adjoints, only the estimator "material" differentiates moving outlines.
    if "material" not in estimators:
        sentences.append(
            "boundary terms: nothing that an adjoint differentiates moves an outline"
        )
    if not estimators & gradients.ADJOINT_ESTIMATORS:
        sentences.append("adjoint renders: no coordinate needs one")
    if not estimators & gradients.DIFFERENCE_ESTIMATORS:
        sentences.append(
            "renders for differences: every derivative comes from an adjoint or from "
            "the picture itself"
        )
    return sentences
