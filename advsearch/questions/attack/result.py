"""The result of an attack as Python has it, and its pictures: of trials, of the object
to turn, along a drive.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mode
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np
import numpy.typing as npt
import torch
from PIL import Image
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Ending, SearchResult
from advsearch.controls.base import Control
from advsearch.controls.ranges import OneOf
from advsearch.engine.judging import task_for
from advsearch.engine.loading import Scene, load_scene
from advsearch.engine.naming import AnyModel, in_turn
from advsearch.engine.problem import Problem
from advsearch.engine.record import KEPT, Findings
from advsearch.engine.rendering import Rendering, render
from advsearch.errors import InputError
from advsearch.questions.attack.summary import AlongDrive, AttackSummary
from advsearch.report.figures import marked, new_axes, search_axes
from advsearch.report.views import result_html, shown, side_by_side
from advsearch.runs import files, store
from advsearch.runs.directory import IMAGES, OBJECT_FILE, RunDirectory
from advsearch.scene.assembly import posed
from advsearch.scene.assets import Shape, simpler
from advsearch.scene.color import to_8_bit
from advsearch.scene.description import OBJECT
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.glb import web_glb
from advsearch.scene.settings import Given
from advsearch.settings import as_python
from advsearch.tasks import Judgement, Mark
from advsearch.trust.code import names_code
from advsearch.trust.writing import write_bytes

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from advsearch.questions.attack.carry_out import AttackParts


class RenderKeywords(TypedDict, total=False):
    """What may be said of a picture, see `render`."""

    resolution: int | tuple[int, int] | None
    spp: int
    denoise: str
    sampler: str
    seed: int
    around: int | None
    aov: bool


@dataclass(frozen=True, eq=False, repr=False)
class AttackResult:
    """The result of an attack.

    Attributes:
        summary: what `summary.json` holds.
        run: the run directory, or None if it was not kept.
        u: (d,) the configuration that was verified; the start where nothing was
            searched.
        clean: (H, W, 3) display-referred sRGB in [0, 1], 8-bit values: the clean
            configuration, as in the trial that the summary names; its `clean` has what
            the model says of it.
        adversarial: the same of `u`.
        artifacts: what the controls hand over of `u`, by name: the texture, say; (h, w,
            3) sRGB in [0, 1].
        search: the search's own log and claim; None where nothing was searched, and of
            a run that was loaded.
        in_memory: the rows, where there is no run directory.
        parts: returns what the attack was asked with; None of a result that came from
            another process.
    """

    summary: AttackSummary
    run: Path | None
    u: Tensor
    clean: Tensor
    adversarial: Tensor
    artifacts: dict[str, Tensor]
    search: SearchResult | None
    in_memory: tuple[store.Row, ...] = ()
    parts: Callable[[], AttackParts] | None = None

    @property
    def found(self) -> bool:
        """Whether a verified configuration was found."""
        return bool(self.summary.ending == Ending.FOUND.value)

    @property
    def success(self) -> bool:
        """The same as `found`."""
        return self.found

    @property
    def path(self) -> Path | None:
        """The same as `run`."""
        return self.run

    @property
    def values(self) -> dict[str, Any]:
        """The adversarial configuration by name, such as `pose.yaw`, without units; of
        a texture, numbers that describe it. Empty where nothing was searched;
        `summary.configuration` has the units.
        """
        return {
            name: found.value
            for name, found in (self.summary.configuration or {}).items()
        }

    @property
    def images(self) -> dict[str, Tensor]:
        """The two pictures by name, `clean` and `adversarial`: (H, W, 3)
        display-referred sRGB in [0, 1].
        """
        return {"clean": self.clean, "adversarial": self.adversarial}

    @property
    def history(self) -> list[float]:
        """The objective of each evaluation of the search, in order; `rows("search")`
        has all that is known of them.
        """
        rows = [row for row in self.rows("search") if row.phase != "ranking"]
        return [row.objective for row in rows if row.objective is not None]

    @names_code
    @in_turn()
    def render(
        self,
        model: AnyModel | None = None,
        *,
        scene: Scene | str | Path | None = None,
        camera: str | Mapping[str, float] | None = None,
        settings: Given | None = None,
        **options: Unpack[RenderKeywords],
    ) -> Rendering:
        """Render the adversarial scene again, and ask a model what it sees.

        What the adversarial configuration does not say is as the scene comes:
        conditions of `over` have their start.

        Args:
            model: None for the attack's own.
            scene: another one with the same object; None for the attack's own.
            camera: where it is seen from, ``{"azimuth": 130.0}``; or the name of one of
                the scene's cameras.
            settings: parameters of the scene to fix to other values, e.g.
                ``{"camera.azimuth": 130.0}``.
            **options: `resolution`, `spp`, `denoise`, `sampler`, `seed`, `around` and `aov`, as for `render`; by
                default as in the attack.

        Raises:
            TypeError: there is no such keyword.
            InputError: the adversarial configuration sets one of `settings` itself, or
                has other numbers than the scene takes.
        """
        if self.parts is None:
            raise InputError(
                "render: expected a result of this session, got one from another "
                "process; load_run(FOLDER) has it "
                "with all that it needs"
            )
        if unknown := sorted(options.keys() - RenderKeywords.__annotations__):
            known = ", ".join(
                [
                    "model",
                    "scene",
                    "camera",
                    "settings",
                    *RenderKeywords.__annotations__,
                ]
            )
            raise TypeError(
                "render() got an unexpected keyword argument "
                f"{unknown[0]!r}; it takes {known}"
            )
        parts = self.parts()
        camera = as_python(camera)
        settings = as_python(settings)
        seen = (
            parts.scene
            if scene is None
            else scene
            if isinstance(scene, Scene)
            else load_scene(scene)
        )
        if isinstance(camera, Mapping):
            settings = {
                **(settings or {}),
                **{f"camera.{name}": one for name, one in camera.items()},
            }
            camera = None
        if twice := sorted({*(settings or {})} & {*(self.summary.configuration or {})}):
            raise InputError(
                "settings: the adversarial configuration says what "
                f"{twice[0]} is; leave it out"
            )
        seen = seen.with_settings(settings) if settings else seen
        seen = (
            replace(seen, description=seen.description.seen_by(camera))
            if camera
            else seen
        )
        task = (
            parts.task if model is not None else task_for(parts.task, parts.loaded[0])
        )
        return render(
            seen, parts.loaded[0] if model is None else model, task=task, label=parts.config.label,
            controls=parts.controls, at=self.u, **{**parts.config.image_settings, **options},
        )  # fmt: skip

    def __getstate__(self) -> dict[str, Any]:
        """What is pickled: not what only this session has."""
        return {**vars(self), "parts": None}

    def rows(self, kind: str | None = None) -> Iterator[store.Row]:
        """Yield every evaluated configuration, or those of one kind ("search",
        "verification", ...), in order.
        """
        if self.run is None:
            yield from (row for row in self.in_memory if kind in (None, row.kind))
            return
        with store.Store(self.run / store.NAME, read_only=True) as results:
            yield from results.rows(kind)

    def to_pandas(self, kind: str | None = None) -> Any:
        """Return these rows as a `pandas.DataFrame`: columns as in an export
        (docs/runs.md), units in its `attrs`.
        """
        from advsearch.runs.tables import to_pandas  # pandas takes half a second

        return to_pandas(self.rows(kind))

    def plot(self, axes: Any = None) -> Any:
        """Draw the objective over the search's evaluations, and return the matplotlib
        axes.

        Args:
            axes: to draw on; None makes new ones.
        """
        axes = new_axes() if axes is None else axes
        search_axes({self.summary.policy: self.history}, self.summary.objective, axes)
        return axes

    def __repr__(self) -> str:
        summary = self.summary
        run = None if self.run is None else str(self.run)
        verified = f", verified {summary.brief}" if summary.verified else ""
        controls = ",".join(summary.controls)
        return (
            f"AttackResult({summary.object!r}, {controls!r}, "
            f"{summary.ending!r}{verified}, run={run!r})"
        )

    def _repr_html_(self) -> str:
        return result_html(shown(self.summary), self.images)

    def _repr_png_(self) -> bytes:
        return side_by_side([*self.images.values()])


# Faces of the meshes that are kept to turn; of more, as many are shown
MOST_FACES = 30_000
# How far from the object's middle another mesh may be to be shown with it, in the
# object's extent
NEAR = 2.0
# Samples a pixel of the pictures that are kept where nothing was tried
PICTURE_SPP = 16


@dataclass(frozen=True, eq=False)
class KeptPicture:
    """The picture of a configuration of the whole space that is kept, as the model sees
    it: (H, W, 3) sRGB, 8-bit values in [0, 1], and its linear radiance; what is said of
    it, and the number of its trial, None where nothing was tried.
    """

    whole: Tensor
    radiance: Tensor
    picture: Tensor
    judgement: Judgement
    trial: int | None

    @classmethod
    def of(
        cls, problem: Problem, findings: Findings, u: Tensor, trial: int | None
    ) -> KeptPicture:
        """Render the searched controls at `u` as they are in a trial; as the scene
        comes, where that is None.
        """
        seed = seeds.stream(
            problem.seed, *(("pictures",) if trial is None else ("verification", trial))
        )
        whole = problem.whole(u, None if trial is None else seed)
        spp = PICTURE_SPP if trial is None else findings.spp
        with torch.no_grad():
            radiance = problem.renderer.radiance(whole, seed, spp)
            picture = to_8_bit(
                problem.space.picture(
                    whole, problem.renderer.formation.display(radiance)
                )
            )
        return cls(whole, radiance, picture, problem.judge(picture, whole), trial)


def trial_to_show(findings: Findings) -> int | None:
    """Return the trial whose pictures are kept, of the clean scene and of the
    adversarial scene, which see the same conditions.

    It is the first with the most frequent prediction among the successes (else among
    the trials that count), if there is one beside which the clean scene has its own
    most frequent prediction. None where nothing was tried.
    """

    def labels(trials: Sequence[Judgement]) -> list[str]:
        return [trial.prediction.label for trial in trials]

    checked = findings.verification
    if checked is None:
        clean = labels(findings.clean)
        return clean.index(mode(clean)) if clean else None
    clean = labels(checked.clean_trials)
    usual = mode(labels(checked.successes or checked.counting))
    usual_clean = mode(clean)
    ranks = [
        (
            label == usual and outcome is bool(checked.successes),
            label == usual,
            beside == usual_clean,
        )
        for label, outcome, beside in zip(
            labels(checked.adversarial_trials), checked.outcomes, clean, strict=False
        )
    ]
    return checked.begin + ranks.index(max(ranks))


def write_pictures(
    run: RunDirectory,
    problem: Problem,
    findings: Findings,
    shown: Mapping[str, KeptPicture],
) -> None:
    for name, kept in shown.items():
        run.save_image(name, kept.picture)
        run.save_exr(name, kept.radiance * problem.renderer.formation.gain)
        save_marked(run, name, kept.picture, problem.marks(kept.picture, kept.whole))
        if problem.aovs:
            surfaces = problem.renderer.surfaces(kept.whole)
            file = run.path / IMAGES / f"{name}.aov.exr"
            files.write_layers(
                file,
                surfaces.layers(problem.aovs, OBJECT),
                surfaces.notes(problem.aovs),
            )
    run.save_image(
        "difference",
        files.difference(shown["clean"].picture, shown["adversarial"].picture),
    )
    checked = findings.verification
    kind = "verification" if findings.beaten is None else "baseline verification"
    if checked is not None:
        for number in range(
            checked.begin, checked.begin + len(checked.adversarial_trials)
        )[:KEPT]:
            save_trial(
                run,
                problem,
                findings,
                (kind, number),
                f"verification-{number:02d}",
                checked.u,
            )
    if findings.frames:
        last = shown["adversarial"].picture
        # the frames see the scene as it comes
        if problem.conditions is not None and findings.search is not None:
            last = KeptPicture.of(
                problem, findings, problem.domain.project(findings.search.best_u), None
            ).picture
        run.save_animation("search", [*findings.frames, last.numpy()])


def save_trial(
    run: RunDirectory,
    problem: Problem,
    findings: Findings,
    trial: tuple[str, int],
    name: str,
    u: Tensor,
) -> None:
    seed = seeds.stream(problem.seed, "verification", trial[1])
    picture = findings.pictures.get(trial)
    picture = problem.picture(u, seed, findings.spp) if picture is None else picture
    run.save_image(name, picture)
    save_marked(run, name, picture, problem.marks(picture, problem.whole(u, seed)))


def save_marked(
    run: RunDirectory, name: str, picture: Tensor, marks: list[Mark]
) -> None:
    if marks:
        run.save_image(f"{name}-prediction", marked(picture.numpy(), marks))


def write_object(run: RunDirectory, problem: Problem, u: Tensor) -> None:
    """Keep the object, and the meshes beside it that controls move or paint, to turn in
    a browser.
    """
    scene = problem.space.scene
    assembly = problem.renderer.scene.assembly
    if scene is None:
        return
    with torch.no_grad():
        after, before = (
            assembly(problem.space.inputs(problem.whole(at)))
            for at in (u, problem.domain.start)
        )
    moved = {OBJECT, *(key.partition(".")[0] for key in after)}
    parts = [part for name, part in scene.meshes.items() if name in moved]
    fewer = {part.name: simpler(part.mesh, MOST_FACES // len(parts)) for part in parts}

    def shown(inputs: Mapping[str, Tensor]) -> list[Shape]:
        shapes = {part.name: posed(part, inputs) for part in parts}
        vertices = shapes[OBJECT].mesh.vertices
        middle = vertices.mean(axis=0)
        reach = NEAR * float(np.ptp(vertices, axis=0).max())
        near = [
            one
            for one in shapes.values()
            if np.abs(one.mesh.vertices.mean(axis=0) - middle).max() < reach
        ]
        return [
            replace(one, mesh=left(one.mesh)) if (left := fewer[one.name]) else one
            for one in near
        ]

    camera = after.get("camera.to_world")
    pose = camera_to_world(scene) if camera is None else camera.double().numpy()
    cut = [
        f"{len(part.mesh.faces):,} of {part.name}" for part in parts if fewer[part.name]
    ]
    note = (
        f"It is shown with fewer faces than it has ({', '.join(cut)})." if cut else ""
    )
    write_bytes(
        run.path / OBJECT_FILE, web_glb(shown(after), shown(before), pose, note)
    )


FRAMES = 24
STRIP = 8  # Pictures of a strip at most, and the height of each in pixels
SIDE = 160
FASTEST = 40  # Milliseconds that a frame of an animation is shown at least


def along_drive(
    problem: Problem, u: Tensor | None, spp: int, run: RunDirectory | None
) -> AlongDrive | None:
    """Look at an adversarial scene, and at the clean scene, at evenly spaced times of
    each path that varies by chance; None where none does. What varies beside it is as
    the scene comes.
    """
    place = len(problem.domain.start)
    path = None
    for control in problem.space.controls[len(problem.searched_space.controls) :]:
        if control.travels and any(
            slot.parameter.name == "time" and slot.width for slot in control.slots
        ):
            path = control
            break
        place += len(control.start)
    if path is None:
        return None
    start = problem.whole(problem.domain.start)
    specs = [slot.spec for slot in path.slots if slot.parameter.name == Control.WAY]
    drawn = next((spec.values for spec in specs if isinstance(spec, OneOf)), ())
    # which one is drawn is the coordinate behind the time
    ways = list(dict.fromkeys(drawn))
    each = start.repeat(max(1, len(ways)), FRAMES, 1)
    each[..., place] = torch.linspace(0.0, 1.0, FRAMES)
    for number, way in enumerate(ways):
        each[number, :, place + 1] = (drawn.index(way) + 0.5) / len(drawn)
    times = each.flatten(0, 1)
    first, last = (
        problem.space.describe(times[end], [path])[f"{path.name}.time"]["value"]
        for end in (0, -1)
    )
    seconds = float(str(last)) - float(str(first))
    counts: dict[str, int] = {}
    for name, at in (("drive-clean", start[: len(problem.domain.start)]), ("drive", u)):
        if at is None:
            continue
        pictures, counts[name] = list[npt.NDArray[np.float32]](), 0
        for number, whole in enumerate(times):
            whole[: len(at)] = at
            with torch.no_grad():
                picture = to_8_bit(
                    problem.renderer(
                        whole, seed=seeds.stream(problem.seed, "drive", number), spp=spp
                    )
                )
            right, marks = problem.seen(picture, whole)
            counts[name] += right
            pictures.append(
                np.asarray(marked(picture.numpy(), marks), dtype=np.float32)
            )
        if run is not None:
            write_drive(run, name, pictures, seconds * max(1, len(ways)))
    return AlongDrive(
        frames=len(times), seconds=seconds, paths=[str(way) for way in ways], clean=counts["drive-clean"],
        answer=counts.get("drive"), spp=spp,
    )  # fmt: skip


def write_drive(
    run: RunDirectory,
    name: str,
    pictures: Sequence[npt.NDArray[np.float32]],
    seconds: float,
) -> None:
    """Write frames (h, w, 3) in sRGB as an animation, NAME.webp, and some side by side,
    NAME.png, into a run.
    """
    frames = [Image.fromarray(files.to_8bit(picture)) for picture in pictures]
    file = io.BytesIO()
    pause = max(FASTEST, round(1000.0 * seconds / len(frames)))
    frames[0].save(
        file,
        "WEBP",
        save_all=True,
        append_images=frames[1:],
        duration=pause,
        loop=0,
        quality=80,
    )
    write_bytes(run.path / IMAGES / f"{name}.webp", file.getvalue())
    size = max(1, round(frames[0].width * SIDE / frames[0].height)), SIDE
    small = [
        frames[number].resize(size, Image.Resampling.LANCZOS)
        for number in evenly(len(frames), STRIP)
    ]
    run.save_image(
        name,
        np.concatenate(
            [np.asarray(frame, dtype=np.float32) / 255.0 for frame in small], axis=1
        ),
    )


def evenly(count: int, most: int) -> npt.NDArray[np.int64]:
    """Return the numbers of some of so many frames, evenly spaced, the first and the
    last among them.
    """
    return np.unique(
        np.linspace(0, count - 1, min(count, most)).round().astype(np.int64)
    )
