"""Pictures of a scene before anything is searched, and what the model says of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from advsearch import seeds
from advsearch.config import PICTURE_SPP, PICTURES
from advsearch.controls import compose
from advsearch.controls.base import sentences
from advsearch.engine.loading import (
    Controls,
    Scene,
    Texture,
    as_controls,
    framed,
    load_scene,
    make_renderer,
)
from advsearch.errors import InputError, UnknownNameError
from advsearch.files import JsonObject
from advsearch.models import Model, load_model
from advsearch.options import Value
from advsearch.progress import Watched, watcher
from advsearch.report.figures import contact_sheet, marked
from advsearch.report.wording import seen_text
from advsearch.runs.files import png_bytes, write_exr, write_layers, write_png
from advsearch.runs.results import Formation, MeshUp, RenderResult, ViewPredictions
from advsearch.scene.color import to_8_bit
from advsearch.scene.description import OBJECT, SceneDescription
from advsearch.scene.formation import SAMPLER, ImageFormation, Surfaces
from advsearch.scene.outlines import seen_things
from advsearch.scene.renderer import Renderer
from advsearch.scene.settings import ORBIT_CAMERA
from advsearch.scene.things import ALL
from advsearch.settings import as_python
from advsearch.tasks import AnyTask, Facts, Mark, Prediction, Sight, make_task
from advsearch.tasks.together import each_thing
from advsearch.trust.foreign_code import plainly
from advsearch.trust.writing import placed_by

MOST_PREDICTIONS = 5  # predictions of the model that are kept of a picture


@dataclass(frozen=True, eq=False, repr=False)
class View:
    """A scene from one direction.

    Attributes:
        azimuth: of the camera, degrees.
        picture: (H, W, 3) display-referred sRGB in [0, 1], rounded to 8 bits: what the
            model sees.
        linear: (H, W, 3) linear radiance times the gain, before what controls do to the
            finished picture.
        predictions: what the model says, the likeliest first.
        marks: what shows its prediction, and what is true, in the picture; empty where
            words say it all.
        surfaces: what is seen in each pixel; None where nobody asked.
        output: of the model, for its task.
        truth: of the scene; None where the task does not depend on what is seen, or
            nobody says it.
        things: what is seen of the object and each thing beside it, see `things_seen`.
    """

    azimuth: float
    picture: Tensor
    linear: Tensor
    predictions: tuple[Prediction, ...]
    marks: tuple[Mark, ...] = ()
    surfaces: Surfaces | None = None
    output: Any = None
    truth: Any = None
    things: JsonObject | None = None

    def __repr__(self) -> str:
        said = self.predictions[0].label if self.predictions else None
        return f"View(azimuth={self.azimuth:g}, {said!r})"


@dataclass(frozen=True, eq=False, repr=False)
class Rendering:
    """Pictures of a scene. Made by `render`.

    Attributes:
        scene: what was rendered.
        model: name of the model that was asked.
        task: name of the task that it was asked to do.
        formation: how the pictures were formed, with size and gain.
        spp: samples a pixel.
        views: one, or one for each azimuth.
        warnings: what was said on the way.
    """

    scene: SceneDescription
    model: str
    task: str
    formation: ImageFormation
    spp: int
    views: tuple[View, ...]
    warnings: tuple[str, ...] = ()

    def save(self, path: str | Path) -> tuple[int, int]:
        """Write the picture, whole or not at all; several views become one sheet with
        the predictions under each. Return height and width of what was written, in
        pixels.

        A .png holds what the model sees, an .exr linear radiance times the gain; an
        older file is replaced. Raises InputError (another ending, or an .exr of several
        views), or StorageError where it could not be written.
        """
        file = writable(path, len(self.views))
        with placed_by("out"):
            if file.suffix.lower() == ".exr":
                write_exr(file, self.views[0].linear)
                return self.formation.resolution
            write_png(file, self._shown)
        return self._shown.shape[0], self._shown.shape[1]

    def save_aov(self, path: str | Path, aovs: Sequence[str]) -> Path:
        """Write ground truth of the view as layers of one EXR, whole or not at all,
        beside the picture of this path, as ``NAME.aov.exr``, and return its path;
        `aovs` are names of `advsearch.scene.formation.AOVS`. Raises InputError where
        `render` was not asked for it, or StorageError.
        """
        surfaces = self.views[0].surfaces
        if surfaces is None or len(self.views) > 1:
            raise InputError(
                "aov: ground truth is written for a single view, rendered "
                "with `aov`; leave `around` out"
            )
        with placed_by("out"):
            return write_layers(
                Path(path).with_suffix(".aov.exr"),
                surfaces.layers(aovs, OBJECT),
                surfaces.notes(aovs),
            )

    def sheet(self) -> Any:
        """Return all views side by side, (h, w, 3) float32 sRGB in [0, 1], with azimuth
        and predictions under each.
        """
        return contact_sheet(
            [view.picture.numpy() for view in self.views], self._captions
        )

    def save_predictions(self, path: str | Path) -> Path | None:
        """Write the picture, or the sheet, with boxes and masks drawn in beside that of
        `save`, as NAME-prediction.png, and return its path; None where the task draws
        nothing. Raises StorageError.
        """
        if not any(view.marks for view in self.views):
            return None
        drawn = [marked(view.picture.numpy(), view.marks) for view in self.views]
        file = Path(path).with_name(f"{Path(path).stem}-prediction.png")
        with placed_by("out"):
            write_png(
                file,
                contact_sheet(drawn, self._captions) if len(drawn) > 1 else drawn[0],
            )
        return file

    @cached_property
    def _shown(self) -> Any:
        return self.sheet() if len(self.views) > 1 else self.views[0].picture.numpy()

    def __repr__(self) -> str:
        said = [
            view.predictions[0].label if view.predictions else None
            for view in self.views
        ]
        height, width = self.formation.resolution
        of = (
            f"{self.scene.object_name!r}, {self.scene.environment_name!r}, "
            f"{self.model!r}"
        )
        return (
            f"Rendering({of} says {', '.join(map(repr, said))}, {height} x {width} "
            "pixels)"
        )

    def _repr_png_(self) -> bytes:
        return png_bytes(self._shown)

    @property
    def _captions(self) -> list[list[str]]:
        return [
            [
                f"azimuth {view.azimuth:g}",
                *(seen_text(self.task, p) for p in view.predictions),
            ]
            for view in self.views
        ]

    def result(
        self,
        out: Path,
        size: tuple[int, int],
        warnings: Sequence[str],
        answered: Path | None = None,
    ) -> RenderResult:
        """Return everything but the pictures: with the file that was written, its
        height and width in pixels, all that was said, and the file with the predictions
        drawn in.
        """
        scene = self.scene
        up = self.scene.object.up
        return RenderResult(
            out=str(out),
            answered=None if answered is None else str(answered),
            size=size,
            object=scene.object_name,
            environment=scene.environment_name,
            model=self.model,
            task=self.task,
            spp=self.spp,
            image_formation=Formation.of(self.formation),
            up=None if up is None else MeshUp.of(up),
            views=[ViewPredictions.of(view) for view in self.views],
            warnings=list(warnings),
        )


@plainly()
def render(
    scene: Scene | str | Path,
    model: Model | nn.Module | str | Path = "reference",
    *,
    task: AnyTask = "classification",
    label: str | None = None,
    judge: str = OBJECT,
    controls: Controls = (),
    around: int | None = None,
    texture: Texture | None = None,
    resolution: int | tuple[int, int] | None = None,
    spp: int = PICTURE_SPP,
    denoise: str = "oidn",
    sampler: str = SAMPLER,
    seed: int = 0,
    aov: bool = False,
    at: Tensor | None = None,
    progress: Watched = None,
) -> Rendering:
    """Render a scene and ask the model what it sees.

    Args:
        scene: from `load_scene`, or what that takes.
        model: from `load_model`, or what that takes.
        task: what says the model's predictions: a name, a mapping with a `name` and
            options, an instance, or a function.
        label: the right labels, for a task that draws what is true; None for the
            object's own.
        judge: the thing of which that is drawn: "object", the name of one beside it, or
            "all".
        controls: what differs from the scene: names, instances, or a mapping from names
            to settings. A parameter with a range stays where a search would start.
        around: number of views, from azimuths all around the object; None for one, from
            the scene's own camera.
        texture: of the object in place of its own, as `load_scene` takes it.
        resolution: side, or (height, width), in pixels; None for what the model takes.
        spp: samples a pixel.
        denoise: "oidn" or "none".
        sampler: "multijitter" or "independent".
        seed: root of the noise.
        aov: keep what is seen in each pixel, for `Rendering.save_aov`.
        at: (d,) in [0, 1], the configuration of `controls` in place of their start:
            `result.u`, say.
        progress: True shows a bar, False none, None one on a terminal; or told how far
            it is.

    Raises:
        InputError: a name is unknown, a file cannot be used, a value is out of range,
            or the scene cannot take a control.
    """
    scene = scene if isinstance(scene, Scene) else load_scene(scene)
    scene = scene if texture is None else scene.with_texture(texture)
    made = make_task(task)
    model = load_model(model, task=made.of_one_image)
    model = replace(model, cameras=max(1, len(scene.description.rig)))
    check_judged(scene.description, judge)
    asked = made.on(model) if judge != ALL else each_thing(made.on(model))
    instances = as_controls(controls)
    if around is not None and any(
        control.kind == "camera" and "azimuth" in control.settings()
        for control in instances
    ):
        raise InputError(
            "around: sets camera.azimuth itself, and `controls` fixes it; "
            "leave one of them out"
        )
    size = as_python(resolution) or model.input_size
    progress = watcher(progress)
    progress.stage("rendering", around or 1)
    formation = None
    views = list[View]()
    untold = list[str]()
    remarks = tuple[str, ...]()
    for description in _turned(scene.description, around):
        description = framed(description, size)
        space = compose(instances, description)
        renderer = make_renderer(
            description, space, size, denoise, seed, sampler=sampler
        )
        formation = renderer.formation  # the same for all, exposure included
        u = space.start if at is None else torch.as_tensor(at, dtype=torch.float32)
        if u.shape != space.start.shape:
            raise InputError(
                f"at: expected ({len(space.start)},) numbers, as `controls` have in "
                f"this scene, got {tuple(u.shape)}"
            )
        with torch.no_grad():
            radiance = renderer.radiance(u, seeds.stream(seed, "pictures"), spp)
            picture = to_8_bit(space.picture(u, formation.display(radiance)))
            output = model(picture)
            truth = None
            if asked.varies:
                name = description.object_name
                told = partial(space.describe, u)
                looks = looks_at(renderer, u, len(description.rig))
                facts = [
                    facts_about(description, name, label, told, look, judge)
                    for look in looks
                ]
                try:
                    truth = asked.truth(replace(facts[0], views=tuple(facts[1:])))
                except InputError as error:
                    untold = [f"Nothing is drawn into the picture: {error}"]
            asked = asked.after_calibration(output, truth)
            predictions = asked.predictions(output, MOST_PREDICTIONS)[0]
            marks = () if truth is None else tuple(asked.marks(output, truth)[0])
        remarks = remarks or asked.remarks
        azimuth = description.number("camera.azimuth")
        linear = radiance * formation.gain
        surfaces = renderer.surfaces(u) if aov else None
        things = things_seen(renderer, u)
        views.append(
            View(
                azimuth,
                picture,
                linear,
                predictions,
                marks,
                surfaces,
                output,
                truth,
                things,
            )
        )
        progress.advance(1)
    assert formation is not None
    own = scene.description
    warnings = (*space.notes(own), *sentences(space.moved), *untold, *remarks)
    shown = replace(own, environment_spec=space.environment or own.environment_spec)
    return Rendering(
        shown, model.name, made.name, formation, spp, tuple(views), warnings
    )


def check_judged(description: SceneDescription, judge: str) -> None:
    """Refuse what no thing of a scene is called. Raises UnknownNameError, or InputError
    for all of nothing.
    """
    if judge not in (OBJECT, ALL, *description.things):
        raise UnknownNameError(
            "thing to judge:",
            judge,
            (OBJECT, ALL, *description.things),
            "It stands in `judge`.",
        )
    if judge == ALL and not description.things:
        raise InputError(
            "judge: expected things beside the object for 'all', got none; add "
            "`things`, or leave `judge` out"
        )


def looks_at(
    renderer: Renderer, u: Tensor, cameras: int
) -> list[Callable[[], Surfaces]]:
    """Return what looks at a configuration (d,): from the camera, and behind that from
    each of a rig of so many.
    """
    return [
        partial(renderer.surfaces, u),
        *(partial(renderer.surfaces, u, camera=number) for number in range(cameras)),
    ]


def facts_about(
    description: SceneDescription,
    name: str,
    label: str | None,
    values: Callable[[], Mapping[str, Value]],
    look: Callable[[], Surfaces] | None = None,
    judge: str = OBJECT,
) -> Facts:
    """Return what a scene, whose object is called `name`, gives a task to judge by.

    Args:
        label: what is right, of the thing that is judged, or of the object where all
            are.
        values: says the configuration; of the rest is said what the scene was given.
        look: sees it.
        judge: the thing that is judged: `OBJECT`, the name of one beside it, or `ALL`;
            another is an UnknownNameError.
    """

    def numbers() -> dict[str, float]:
        said = {
            **description.values,
            **{key: value["value"] for key, value in values().items()},
        }
        return {
            key: float(number)
            for key, number in said.items()
            if isinstance(number, (int, float))
        }

    check_judged(description, judge)
    things = description.things
    looked = None if look is None else cache(look)

    def of(mesh: str, label: str | None) -> Facts:
        sight = (
            None
            if looked is None
            else lambda: sight_of(looked(), mesh, description.object.metres)
        )
        if mesh == OBJECT:
            return Facts(name, label, description.object.label, numbers, sight)
        return Facts(mesh, label, things[mesh].label, numbers, sight)

    labelled = OBJECT if judge == ALL else judge
    each = {
        mesh: of(mesh, label if mesh == labelled else None)
        for mesh in (OBJECT, *things)
    }
    each = {
        mesh: replace(
            judged, others=tuple(other for name, other in each.items() if name != mesh)
        )
        for mesh, judged in each.items()
    }
    return replace(each[OBJECT], each=each) if judge == ALL else each[judge]


def sight_of(
    surfaces: Surfaces, mesh: str = OBJECT, metres: float | None = None
) -> Sight:
    """Return what a task judges by, of what the camera sees: of the object, or of
    another mesh; `metres` are those of the object, where they are known.
    """
    return Sight(surfaces.seen(mesh), surfaces.depth, surfaces.z_depth, metres)


def things_seen(renderer: Renderer, u: Tensor) -> JsonObject | None:
    """Return what the picture of a configuration (d,) shows of the object and each
    thing beside it, by name; None where nothing stands beside it. See
    `runs.results.ThingSeen`.
    """
    description = renderer.scene.made[0]
    if not description.things:
        return None
    names = (OBJECT, *description.things)
    unseen: JsonObject = {
        "box": None,
        "pixels": 0,
        "share": 0.0,
        "truncated": None,
        "distance": None,
    }
    shown: JsonObject = {
        name: {"label": description.meshes[name].label, **unseen} for name in names
    }
    for seen in seen_things(renderer, u, names):
        shown[seen.name] = {
            "label": description.meshes[seen.name].label,
            "box": [*seen.box],
            "pixels": int(seen.mask.sum()),
            "share": None if seen.share is None else round(seen.share, 4),
            "truncated": seen.truncated,
            "distance": round(seen.distance, 3),
        }
    return shown


def writable(path: str | Path, views: int) -> Path:
    """Return the path of a picture that can be written, as far as its name says."""
    file = Path(path)
    suffix = file.suffix.lower()
    if suffix not in PICTURES:
        raise InputError(
            f"out: expected the path of a .png or .exr file, got {str(path)!r}"
        )
    if suffix == ".exr" and views > 1:
        raise InputError(
            "out: a sheet of several views has text in it and is a .png; "
            "leave `around` out for an .exr"
        )
    if file.is_dir():
        raise InputError(f"out: expected the name of a file, got the folder {file}")
    return file


def _turned(
    description: SceneDescription, around: int | None
) -> Iterator[SceneDescription]:
    if around is None:
        yield description
        return
    if description.camera != ORBIT_CAMERA:
        raise InputError(
            "around: turns the camera that circles the object, and `camera` "
            f"{description.camera} is fixed; leave one "
            "of the two out"
        )
    first = description.number("camera.azimuth")
    for number in range(around):
        yield description.with_values(
            camera__azimuth=(first + 360.0 * number / around) % 360.0
        )
