"""Checks gradients of a scene as it is, and plans a search over it: what `advsearch
check` does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from pydantic import TypeAdapter

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
# samples a pixel of a working gradient of the linear loss, which is taken without
# denoiser
RAW_SPP = 16
# samples a pixel of the dearest gradient of the model's loss that is tried
MAX_SPP = 256
REFERENCE_SPP = 64
SEEDS = (6, 16)
"""Samples a pixel of a reference render, and how many seeds it gets: until its noise is
small.
"""
# seeds of a reference of the model's loss, whose renders have more samples
FEW_SEEDS = (3, 6)
HINT = "`resolution` or fewer controls shorten it, `seconds` ends it"
Finding = CheckedRow | SearchPlan | results.PathLength | GainRow | TexelRow
FINDINGS: TypeAdapter[list[Finding]] = TypeAdapter(list[Finding])


@dataclass(frozen=True)
class CheckedPart:
    """One scene with its controls and one loss ("linear" or "model"): what is checked
    in one go; numbered from 1.
    """

    number: int
    config: CheckConfig
    loss: str

    @property
    def key(self) -> str:
        return f"check {self.number}"

    @property
    def title(self) -> str:
        return (
            f"{self.config.object} in {self.config.lit_by}, "
            f"{' and '.join(self.config.controls)}"
        )

    def make_row(self, measured: results.Measured, **fields: Any) -> CheckedRow:
        config = self.config
        scene_fields = {
            "object": config.object,
            "environment": config.lit_by,
            "loss": self.loss,
        }
        return CheckedRow(**{**vars(measured), **scene_fields, **fields})


def list_parts(config: CheckConfig) -> list[CheckedPart]:
    configs = list(list_bundled(config)) if config.all else [config]
    pairs = [(part_config, loss) for part_config in configs for loss in config.losses]
    return [
        CheckedPart(number, part_config, loss)
        for number, (part_config, loss) in enumerate(pairs, start=1)
    ]


def list_bundled(config: CheckConfig) -> Iterator[CheckConfig]:
    """Yield the settings of a check of each control by itself, on each bundled
    scene.
    """
    for object, environment in SCENES:
        skipped = set()
        if object == "bottle":
            skipped.add("contents")  # it is closed
        if environment is not None:
            skipped.add("sky")  # it would take the environment's place
        for control, control_type in workbench.CONTROLS.items():
            # of one without, the scene names them
            if control_type.parameters and control not in skipped:
                scene_fields = {
                    "object": object,
                    "environment": environment,
                    "label": None,
                }
                control_fields = {
                    "controls": {control: {}},
                    **workbench.settings_alone(config, control, {}),
                }
                yield config.model_copy(update={**scene_fields, **control_fields})


class GradientCheck:
    """One sitting of a check.

    What is measured is stored at once, so that a check that was stopped goes on where
    it was and ends with the same rows; only times differ.
    """

    def __init__(self, context: RunContext[CheckConfig]) -> None:
        self.context = context
        self.progress = context.progress
        self.progress.stage(workbench.LOADING)
        self.parts = list_parts(context.config)
        self.measurements = context.open_measurements(context.config.seconds)
        self.parts_done = 0

    def run(self) -> CheckResult:
        return self.measurements.collect(self._measure_parts(), self._make_result)

    def _make_result(self, findings: list[Finding]) -> CheckResult:
        def select(kind: type[Any]) -> list[Any]:
            return [finding for finding in findings if isinstance(finding, kind)]

        configs = [part.config for part in self.parts]
        return self.context.result(
            CheckResult,
            object=",".join(dict.fromkeys(config.object for config in configs)),
            environment=",".join(dict.fromkeys(config.lit_by for config in configs)),
            controls=list(dict.fromkeys(name for config in configs for name in config.controls)),
            measured=self.parts_done, planned=len(self.parts), rows=select(CheckedRow),
            plan=next(iter(select(SearchPlan)), None), bounces=next(iter(select(results.PathLength)), None),
            gains=select(GainRow), texels=select(TexelRow),
        )  # fmt: skip

    def _measure_parts(self) -> Iterator[Finding]:
        for part in self.parts:
            stored = self.measurements.stored(part.key)
            if stored is not None:  # measured before: nothing is loaded
                yield from FINDINGS.validate_python(stored)
            else:
                yield from self._measure_part(part)
            self.parts_done += 1

    def _measure_part(self, part: CheckedPart) -> Iterator[Finding]:
        title = part.title
        if len(self.parts) > 1:
            title += f" ({part.number} of {len(self.parts)})"
        self.progress.stage(f"loading {title}")
        measure = self._measure_linear if part.loss == "linear" else self._measure_model
        findings = []
        for finding in measure(part, title):
            findings.append(finding.to_dict())
            yield finding
            # whoever reads it can stop the check and find the row stored
            if isinstance(finding, CheckedRow):
                number = (
                    f"{finding.value:.3g}"
                    if finding.cosine is None
                    else f"cosine {finding.cosine:.2f}"
                )
                what = f"{finding.object}, {finding.name} by {finding.estimator}"
                self.progress.message(f"{what}: {number}, {finding.status}")
        self.measurements.put(part.key, findings)

    def _measure_linear(self, part: CheckedPart, title: str) -> Iterator[Finding]:
        """Measure derivatives of a smooth linear loss of the raw image, by every
        estimator.
        """
        config = part.config
        problem, _ = workbench.problem_from_config(config, denoise="none")
        renderer = problem.renderer
        renderer.formation = replace(renderer.formation, transfer="linear")
        renderer.plan = renderer.plan.at_a_pixel()
        loss = gradients.smooth_loss(renderer.formation.resolution, config.seed)
        spp = config.spp if isinstance(config.spp, int) else RAW_SPP
        bench = self._make_bench(part, renderer, loss, spp)
        for row in gradients.measure_derivatives(
            bench, reference_spp=REFERENCE_SPP, seeds_of_reference=SEEDS, reference_factors=gradients.FACTORS[:2],
            tried=gradients.list_attempts, stage=partial(self._begin_stage, title),
        ):  # fmt: skip
            yield part.make_row(row)

    def _measure_model(self, part: CheckedPart, title: str) -> Iterator[Finding]:
        """Plan a search by the model's own loss, and measure its derivatives as
        planned.
        """
        config = part.config
        problem, _ = workbench.problem_from_config(config)
        renderer = problem.renderer
        counts = tuple(
            count for count in (*planning.COUNTS, MAX_SPP) if count >= problem.spp
        ) or (problem.spp,)
        bench = self._make_bench(part, renderer, problem.loss, problem.spp)

        count = planning.plan_gradients(renderer.plan)
        self.progress.stage(
            f"{title}: comparing ways to differentiate", count, hint=HINT
        )
        measure_bench = replace(bench, seed=seeds.stream(config.seed, "measure"))
        renderer.plan = planning.measured_plan(measure_bench, counted=True)

        planned_steps = {group.name: group.step for group in renderer.plan.groups}
        max_samples = planning.cosine_samples(renderer.plan, counts=counts)
        hint = f"counted in samples a pixel; {HINT}"
        self.progress.stage(
            f"{title}: the model's gradients", max_samples, hint=hint, at_most=True
        )
        cosine_bench = replace(bench, seed=config.seed, tick=self.progress.advance)
        rows = list[results.Measured]()
        for row in planning.cosines(cosine_bench, counts=counts):
            rows.append(row)
            yield part.make_row(row)
        renderer.plan, tuned_spp = planning.tuned(renderer.plan, rows)
        spp = tuned_spp or problem.spp

        if not config.all:
            yield from self._plan_search(problem, part, spp)
        factors = {
            group.name: group.step / planned_steps[group.name]
            for group in renderer.plan.groups
            if planned_steps[group.name]
        }
        for row in gradients.measure_derivatives(
            replace(bench, spp=spp), reference_spp=planning.CONVERGED, seeds_of_reference=FEW_SEEDS,
            stage=partial(self._begin_stage, title),
        ):  # fmt: skip
            # coordinates of one group have a number behind its name
            name = f"{row.control}.{row.parameter.partition('.')[0]}"
            yield part.make_row(row, factor=factors.get(name, 1.0))

    def _make_bench(
        self,
        part: CheckedPart,
        renderer: gradients.Renderer,
        loss: gradients.Loss,
        spp: int,
    ) -> gradients.Bench:
        def store(name: str, measure: Callable[[], Any]) -> Any:
            return self.measurements.get(f"{part.key} {name}", measure)

        seed = seeds.stream(part.config.seed, "check")
        u = gradients.interior_point(renderer)
        return gradients.Bench(
            renderer,
            loss,
            u,
            seed,
            spp,
            store,
            lambda samples: self.progress.advance(1),
        )

    def _begin_stage(self, title: str, name: str, max_steps: int) -> None:
        self.progress.stage(f"{title}: {name}", max_steps, hint=HINT, at_most=True)

    def _plan_search(
        self, problem: Problem, part: CheckedPart, spp: int
    ) -> Iterator[Finding]:
        """Yield how a search gets its derivatives, how long its light paths are, and
        what leaving things out saves.
        """
        config = part.config
        renderer = problem.renderer
        summary = problem.plan_summary(renderer.plan)
        left_out = (
            list_left_out(renderer)
            if config.specialise
            else ["nothing (`specialise=false`)"]
        )
        yield SearchPlan(**{**vars(summary), "spp": spp, "left_out": left_out})
        if not config.specialise:
            return
        u = gradients.interior_point(renderer)
        seed = seeds.stream(config.seed, "leaving out")
        hint = "`specialise=false` leaves it out"
        tick = self.progress.advance

        def find_length() -> results.PathLength:
            max_images = planning.most_pictures(problem)
            self.progress.stage(
                "finding how many bounces of light matter",
                max_images,
                hint=hint,
                at_most=True,
            )
            return planning.bounces_of(problem, config.seed, tick=tick)

        def find_gains() -> list[GainRow]:
            self.progress.stage(
                "measuring what leaving things out saves",
                MAX_GRADIENTS,
                hint=hint,
                at_most=True,
            )
            depth = length.depth
            return measure_gains(
                renderer,
                problem.loss,
                u,
                seed=seed,
                spp=problem.spp,
                depth=depth,
                tick=tick,
            )

        length = self.measurements.get_row(
            f"{part.key} bounces", results.PathLength, find_length
        )
        yield length
        yield from self.measurements.get_rows(f"{part.key} gains", GainRow, find_gains)
        yield from self.measurements.get_rows(
            f"{part.key} texels",
            TexelRow,
            lambda: measure_texels(renderer, u, seed=seed),
        )


def list_left_out(renderer: gradients.Renderer) -> list[str]:
    """Return what a search with the renderer's plan does not compute at all, in
    sentences.
    """
    used = {group.estimator for group in renderer.plan.groups}
    sentences = []
    if "material" not in used:
        sentences.append(
            "boundary terms: nothing that an adjoint differentiates moves an outline"
        )
    if not used & gradients.BY_ADJOINT:
        sentences.append("adjoint renders: no coordinate needs one")
    if not used & gradients.BY_DIFFERENCES:
        sentences.append(
            "renders for differences: every derivative is an adjoint or "
            "of the picture itself"
        )
    if not renderer.scene.volumetric:
        sentences.append("the volumetric integrator: there is no medium")
    if "material" in used:
        sentences += [
            f"by the material form: {limit}" for limit in renderer.scene.material_limits
        ]
    return sentences
