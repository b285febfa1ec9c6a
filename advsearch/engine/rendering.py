"""Render images of a scene before anything is searched, with the model's
predictions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from advsearch import seeds
from advsearch.config import IMAGE_SUFFIXES, PICTURE_SPP
from advsearch.controls import Control, Space, compose_space
from advsearch.controls.base import describe_adjusted_defaults
from advsearch.engine.loading import (
    Controls,
    Scene,
    Texture,
    fit_camera,
    load_scene,
    make_controls,
    make_renderer,
)
from advsearch.errors import InputError, UnknownNameError
from advsearch.files import JsonObject
from advsearch.models import Model, load_model
from advsearch.options import Value
from advsearch.progress import Progress, ProgressOption, as_progress
from advsearch.report.figures import draw_marks, make_contact_sheet
from advsearch.report.wording import format_image_prediction
from advsearch.runs.files import encode_png, write_exr, write_layers, write_png
from advsearch.runs.results import Formation, MeshUp, RenderResult, ViewPredictions
from advsearch.scene.color import round_to_8_bit
from advsearch.scene.description import OBJECT, SceneDescription
from advsearch.scene.formation import SAMPLER, ImageFormation, Surfaces
from advsearch.scene.outlines import VisibleMesh, find_visible_meshes
from advsearch.scene.renderer import Renderer
from advsearch.scene.settings import ORBIT_CAMERA
from advsearch.scene.things import ALL_THINGS
from advsearch.settings import to_python
from advsearch.tasks import AnyTask, Facts, Mark, Prediction, Sight, Task, make_task
from advsearch.tasks.together import make_each_thing_task
from advsearch.trust.foreign_code import use_default_torch_state
from advsearch.trust.writing import name_setting_in_errors

MAX_PREDICTIONS = 5  # predictions of the model that a view has at most


@dataclass(frozen=True, eq=False, repr=False)
class View:
    """A scene from one direction.

    Attributes:
        azimuth: azimuth of the camera, degrees.
        picture: (H, W, 3) display-referred sRGB in [0, 1], rounded to 8 bits: the input
            of the model.
        linear: (H, W, 3) linear radiance times the gain, before controls change the
            finished image.
        predictions: predictions of the model, the most probable first.
        marks: boxes and masks of the prediction and of the truth; empty if the task
            draws nothing.
        surfaces: what each pixel shows; None if it was not requested.
        output: output of the model, for its task.
        truth: truth of the scene; None if it does not depend on what is visible, or if
            it is unknown.
        things: visible parts of the object and of each other thing, see
            `find_visible_things`.
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
        label = self.predictions[0].label if self.predictions else None
        return f"View(azimuth={self.azimuth:g}, {label!r})"


@dataclass(frozen=True, eq=False, repr=False)
class Rendering:
    """Images of a scene. Made by `render`.

    Attributes:
        scene: the scene that was rendered.
        model: name of the model.
        task: name of its task.
        formation: how the images were formed, with size and gain.
        spp: samples per pixel.
        views: a single view, or one for each azimuth.
        warnings: sentences for the user.
    """

    scene: SceneDescription
    model: str
    task: str
    formation: ImageFormation
    spp: int
    views: tuple[View, ...]
    warnings: tuple[str, ...] = ()

    def save(self, path: str | Path) -> tuple[int, int]:
        """Write the image atomically, and return its height and width in pixels.

        Several views become one sheet with the predictions under each. A .png file
        stores the input of the model; an .exr file stores linear radiance times the
        gain. An existing file is replaced.

        Raises:
            InputError: another suffix, or an .exr of several views.
            StorageError: it could not be written.
        """
        file = check_image_path(path, len(self.views))
        # errors name the setting "out", which states the path
        with name_setting_in_errors("out"):
            if file.suffix.lower() == ".exr":
                # a single view, as was checked
                write_exr(file, self.views[0].linear)
                return self.formation.resolution  # (height, width)
            write_png(file, self._png_pixels)
        height, width = self._png_pixels.shape[:2]
        return height, width

    def save_aov(self, path: str | Path, aovs: Sequence[str]) -> Path:
        """Write ground truth of the view atomically as layers of one EXR file.

        Args:
            path: path of the image, ``NAME.png``. The file gets its name and folder.
            aovs: names of the layers, from `advsearch.scene.formation.AOVS`.

        Returns:
            The path of the file, ``NAME.aov.exr``.

        Raises:
            InputError: `render` was called without `aov`, or with several views
                (`around`).
            StorageError: it could not be written.
        """
        surfaces = self.views[0].surfaces
        if surfaces is None or len(self.views) > 1:
            raise InputError(
                "aov: ground truth is written for a single view, rendered "
                "with `aov`; leave `around` out"
            )
        with name_setting_in_errors("out"):
            return write_layers(
                Path(path).with_suffix(".aov.exr"),
                surfaces.make_layers(aovs, OBJECT),
                surfaces.describe_layers(aovs),
            )

    def sheet(self) -> Any:
        """Return all views side by side, (h, w, 3) float32 sRGB in [0, 1].

        Azimuth and predictions are written under each.
        """
        return make_contact_sheet(
            [view.picture.numpy() for view in self.views], self._captions
        )

    def save_predictions(self, path: str | Path) -> Path | None:
        """Write the image or the sheet with the predicted boxes and masks.

        Args:
            path: path of the image without them, ``NAME.png``.

        Returns:
            The path of the file, ``NAME-prediction.png``, next to that image; None if
            the task draws nothing, as in classification.

        Raises:
            StorageError: it could not be written.
        """
        if not any(view.marks for view in self.views):
            return None
        images = [draw_marks(view.picture.numpy(), view.marks) for view in self.views]
        image = images[0]
        if len(images) > 1:
            image = make_contact_sheet(images, self._captions)
        file = Path(path).with_name(f"{Path(path).stem}-prediction.png")
        with name_setting_in_errors("out"):
            write_png(file, image)
        return file

    @cached_property
    def _png_pixels(self) -> Any:
        """The image of a single view or the sheet of several, (h, w, 3) float32."""
        return self.sheet() if len(self.views) > 1 else self.views[0].picture.numpy()

    def __repr__(self) -> str:
        """Return the names, the first label of each view, and the size."""
        labels = [
            repr(view.predictions[0].label if view.predictions else None)
            for view in self.views
        ]
        height, width = self.formation.resolution
        names = (
            f"{self.scene.object_name!r}, {self.scene.environment_name!r}, "
            f"{self.model!r}"
        )
        return f"Rendering({names} says {', '.join(labels)}, {height} x {width} pixels)"

    def _repr_png_(self) -> bytes:
        return encode_png(self._png_pixels)

    @property
    def _captions(self) -> list[list[str]]:
        """Lines of text under each view."""
        captions = []
        for view in self.views:
            texts = [
                format_image_prediction(self.task, prediction)
                for prediction in view.predictions
            ]
            captions.append([f"azimuth {view.azimuth:g}", *texts])
        return captions

    def result(
        self,
        out: Path,
        size: tuple[int, int],
        warnings: Sequence[str],
        prediction_path: Path | None = None,
    ) -> RenderResult:
        """Return everything but the images, as a result that can be stored.

        Args:
            out: file that was written.
            size: height and width of the file in pixels; a sheet is larger than a view.
            warnings: all sentences for the user.
            prediction_path: file with the predictions drawn in, if there is one.
        """
        scene = self.scene
        up = scene.object.up
        return RenderResult(
            out=str(out),
            # the image with the predictions
            answered=None if prediction_path is None else str(prediction_path),
            size=size,
            object=scene.object_name,
            environment=scene.environment_name,
            model=self.model,
            task=self.task,
            spp=self.spp,
            image_formation=Formation.from_values(self.formation),
            up=None if up is None else MeshUp.from_values(up),
            views=[ViewPredictions.from_values(view) for view in self.views],
            warnings=list(warnings),
        )


@dataclass(frozen=True, eq=False)
class _ViewSettings:
    """Arguments of `render` that are the same for all views."""

    controls: tuple[Control, ...]
    size: tuple[int, int]
    spp: int
    denoise: str
    sampler: str
    seed: int
    label: str | None
    judge: str
    with_surfaces: bool
    at: Tensor | None


class _RenderedView(NamedTuple):
    """A view, with values that `render` needs for the next views and its result.

    Attributes:
        view: the view.
        task: task after it was calibrated by the view.
        space: space of the controls in the scene of the view.
        formation: formation of the image.
        truth_error: why the truth of the view is unknown; "" if it is known or not
            needed.
    """

    view: View
    task: Task
    space: Space
    formation: ImageFormation
    truth_error: str


@use_default_torch_state()
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
    progress: ProgressOption = None,
) -> Rendering:
    """Render a scene and predict with a model what it shows.

    Args:
        scene: scene from `load_scene`, or the first argument of that.
        model: model from `load_model`, or the first argument of that.
        task: task that reads the model's predictions: a name, a mapping with a `name`
            and options, an instance, or a function.
        label: the right labels, for a task that draws the truth; None for those of the
            object.
        judge: the thing whose truth is drawn: "object", the name of another thing of
            the scene, or "all".
        controls: changes of the scene: names, instances, or a mapping from names to
            settings. A parameter with a range has the value where a search would start.
        around: number of views, from azimuths all around the object; None for one view,
            from the camera of the scene.
        texture: texture that replaces that of the object, as in `load_scene`.
        resolution: side, or (height, width), in pixels; None for the input size of the
            model.
        spp: samples per pixel.
        denoise: "oidn" or "none".
        sampler: "multijitter" or "independent".
        seed: root of the noise.
        aov: whether to store what each pixel shows, for `Rendering.save_aov`.
        at: (d,) in [0, 1], configuration of `controls`, for example `result.u`; None
            for their start.
        progress: True shows a progress bar, False shows none, None shows one on a
            terminal; or an object that receives the progress.

    Raises:
        InputError: a name is unknown, a file cannot be used, a value is out of range,
            or the scene cannot take a control.
    """
    scene = _load_textured_scene(scene, texture)
    description = scene.description
    unbound_task = make_task(task)
    model = _load_model_for_scene(model, unbound_task, description)
    check_judged_thing(description, judge)
    model_task = _bind_task_to_model(unbound_task, model, judge)
    instances = make_controls(controls)
    if around is not None:
        _check_azimuth_is_free(instances)
    settings = _ViewSettings(
        controls=instances,
        size=to_python(resolution) or model.input_size,
        spp=spp,
        denoise=denoise,
        sampler=sampler,
        seed=seed,
        label=label,
        judge=judge,
        with_surfaces=aov,
        at=at,
    )
    progress = as_progress(progress)
    progress.stage("rendering", around or 1)
    scenes_of_views = _orbit_scene(description, around)
    rendered_views = _render_each_view(
        scenes_of_views, model, model_task, settings, progress
    )
    return _make_rendering(
        rendered_views, description, model.name, unbound_task.name, spp
    )


def _load_textured_scene(scene: Scene | str | Path, texture: Texture | None) -> Scene:
    """Return a scene, loaded if it is a name, with the texture if there is one."""
    scene = scene if isinstance(scene, Scene) else load_scene(scene)
    return scene if texture is None else scene.with_texture(texture)


def _load_model_for_scene(
    model: Model | nn.Module | str | Path, task: Task, description: SceneDescription
) -> Model:
    """Return the model of a task, with as many cameras as the scene has."""
    # A model predicts one image at a time, also for a task that judges several.
    loaded_model = load_model(model, task=task.single_image_task)
    # a scene without a rig has one camera
    return replace(loaded_model, cameras=max(1, len(description.rig)))


def _bind_task_to_model(unbound_task: Task, model: Model, judge: str) -> Task:
    """Return the task for a model; it judges each thing if `judge` is "all"."""
    task_on_model = unbound_task.on(model)
    if judge == ALL_THINGS:
        return make_each_thing_task(task_on_model)
    return task_on_model


def _render_each_view(
    scenes_of_views: Iterable[SceneDescription],
    model: Model,
    task: Task,
    settings: _ViewSettings,
    progress: Progress,
) -> list[_RenderedView]:
    """Render a view of each scene, and count them as progress."""
    rendered_views = list[_RenderedView]()
    for view_description in scenes_of_views:
        rendered_views.append(_render_view(view_description, model, task, settings))
        # what the task has learned of the model's predictions holds for the next view
        task = rendered_views[-1].task
        progress.advance(1)
    return rendered_views


def _make_rendering(
    rendered_views: Sequence[_RenderedView],
    description: SceneDescription,
    model_name: str,
    task_name: str,
    spp: int,
) -> Rendering:
    """Return the rendering of a scene from its views, with all their warnings."""
    # formation and space are the same for all views, exposure included
    space = rendered_views[-1].space
    environment_spec = space.environment_name or description.environment_spec
    return Rendering(
        scene=replace(description, environment_spec=environment_spec),
        model=model_name,
        task=task_name,
        formation=rendered_views[-1].formation,
        spp=spp,
        views=tuple(rendered.view for rendered in rendered_views),
        warnings=(
            *space.list_notes(description),
            *describe_adjusted_defaults(space.adjusted_defaults),
            *_list_view_warnings(rendered_views),
        ),
    )


def _list_view_warnings(rendered_views: Sequence[_RenderedView]) -> list[str]:
    """Return the task's warnings about the views, as sentences.

    One states why the truth could not be drawn into a view, if that happened; of
    several views, the last one. The others are the task's remarks on the first view
    that has any, since those on further views say the same.
    """
    sentences = list[str]()
    truth_errors = [
        rendered.truth_error for rendered in rendered_views if rendered.truth_error
    ]
    if truth_errors:
        sentences.append(f"Nothing is drawn into the picture: {truth_errors[-1]}")
    for rendered in rendered_views:
        if rendered.task.output_remarks:
            sentences += rendered.task.output_remarks
            break
    return sentences


def _check_azimuth_is_free(controls: Sequence[Control]) -> None:
    """Raise InputError if a control sets the azimuth that `around` sets."""
    if any(
        control.kind == "camera" and "azimuth" in control.to_settings()
        for control in controls
    ):
        raise InputError(
            "around: sets camera.azimuth itself, and `controls` fixes it; "
            "leave one of them out"
        )


def _render_view(
    description: SceneDescription, model: Model, task: Task, settings: _ViewSettings
) -> _RenderedView:
    """Render one view, and predict with the model what it shows.

    What is true, such as the box of the object, is found only if the task's truth
    depends on the configuration (`Task.varies`). Finding it takes further rays.

    Args:
        description: the scene, with the camera of this view.
        model: model that predicts.
        task: task that reads the predictions, as calibrated by the views before.
        settings: the arguments of `render` that are the same for all views.
    """
    description = fit_camera(description, settings.size)
    space = compose_space(settings.controls, description)
    renderer = _make_view_renderer(description, space, settings)
    u = _choose_configuration(space, settings.at)
    make_facts_of_view = partial(
        _make_view_facts, description, space, renderer, u, settings
    )
    with torch.no_grad():
        radiance, image = _render_image(renderer, u, settings)
        output = model(image)
        # None and a message if the truth cannot be found
        truth, truth_error = _find_truth(task, make_facts_of_view)
        # From here on the predictions are read as the calibrated task does.
        task = task.after_calibration(output, truth)
        view = View(
            azimuth=description.get_number("camera.azimuth"),
            picture=image,
            linear=radiance * renderer.formation.gain,
            # [0]: the batch has one image
            predictions=task.predictions(output, MAX_PREDICTIONS)[0],
            marks=() if truth is None else tuple(task.marks(output, truth)[0]),
            output=output,
            truth=truth,
        )
    surfaces = renderer.find_surfaces(u) if settings.with_surfaces else None
    things = find_visible_things(renderer, u)
    view = replace(view, surfaces=surfaces, things=things)
    return _RenderedView(view, task, space, renderer.formation, truth_error)


def _make_view_renderer(
    description: SceneDescription, space: Space, settings: _ViewSettings
) -> Renderer:
    """Return the renderer of a view, with the denoiser, sampler and seed of all."""
    return make_renderer(
        description,
        space,
        settings.size,
        settings.denoise,
        settings.seed,
        sampler=settings.sampler,
    )


def _render_image(
    renderer: Renderer, u: Tensor, settings: _ViewSettings
) -> tuple[Tensor, Tensor]:
    """Return the radiance of a configuration u (d,), and its image of 8-bit values."""
    noise_seed = seeds.derive_seed(settings.seed, "pictures")
    radiance = renderer.radiance(u, noise_seed, settings.spp)
    displayed = renderer.formation.map_to_display(radiance)
    # with what controls change in the finished image, such as a blur
    image = renderer.space.apply_to_image(u, displayed)
    return radiance, round_to_8_bit(image)


def _find_truth(task: Task, make_facts_of_view: Callable[[], Facts]) -> tuple[Any, str]:
    """Return the truth by the facts, or None and why the task can't derive it.

    A truth that does not depend on the configuration is None, without a reason.
    """
    if not task.varies:
        return None, ""
    facts = make_facts_of_view()
    try:
        return task.truth(facts), ""
    except InputError as error:
        return None, str(error)


def _choose_configuration(space: Space, at: Tensor | None) -> Tensor:
    """Return the configuration (d,) to render: `at`, or the start of the controls."""
    u = space.start if at is None else torch.as_tensor(at, dtype=torch.float32)
    if u.shape != space.start.shape:
        raise InputError(
            f"at: expected ({len(space.start)},) numbers, as `controls` have in "
            f"this scene, got {tuple(u.shape)}"
        )
    return u


def _make_view_facts(
    description: SceneDescription,
    space: Space,
    renderer: Renderer,
    u: Tensor,
    settings: _ViewSettings,
) -> Facts:
    """Return the facts of a configuration by which a task judges the view.

    If the scene has a rig of several cameras, `facts_of_views` has the facts of each.

    Args:
        description: the scene.
        space: space of the controls.
        renderer: renders what each camera sees.
        u: (d,) the configuration.
        settings: arguments of `render`, of which the label and the name of the judged
            thing are used.
    """
    # functions that render what each camera sees: the main camera, then those of a rig
    render_functions = list_camera_renders(
        renderer, u, n_rig_cameras=len(description.rig)
    )
    facts, *camera_facts = [
        _make_camera_facts(description, space, u, settings, render_surfaces)
        for render_surfaces in render_functions
    ]
    return replace(facts, facts_of_views=tuple(camera_facts))


def _make_camera_facts(
    description: SceneDescription,
    space: Space,
    u: Tensor,
    settings: _ViewSettings,
    render_surfaces: Callable[[], Surfaces],
) -> Facts:
    """Return the facts of a configuration u (d,) as a single camera sees them."""
    return make_facts(
        description,
        name=description.object_name,
        label=settings.label,
        describe=partial(space.describe, u),
        render_surfaces=render_surfaces,
        judge=settings.judge,
    )


def check_judged_thing(description: SceneDescription, judge: str) -> None:
    """Check that a scene has the thing that is to be judged.

    Args:
        description: the scene.
        judge: "object", the name of another thing, or "all".

    Raises:
        UnknownNameError: nothing in the scene has that name.
        InputError: all things are to be judged, and there is only the object.
    """
    if judge not in (OBJECT, ALL_THINGS, *description.things):
        raise UnknownNameError(
            "thing to judge:",
            judge,
            (OBJECT, ALL_THINGS, *description.things),
            "It stands in `judge`.",
        )
    if judge == ALL_THINGS and not description.things:
        raise InputError(
            "judge: expected things beside the object for 'all', got none; add "
            "`things`, or leave `judge` out"
        )


def list_camera_renders(
    renderer: Renderer, u: Tensor, n_rig_cameras: int
) -> list[Callable[[], Surfaces]]:
    """Return functions that render which surfaces each camera sees.

    Nothing is rendered until they are called.

    Args:
        renderer: renders the surfaces.
        u: (d,) the configuration.
        n_rig_cameras: number of cameras of the scene's rig; 0 without a rig.

    Returns:
        A function for the main camera, followed by one for each camera of the rig.
    """
    return [
        partial(renderer.find_surfaces, u),
        *(
            partial(renderer.find_surfaces, u, camera=index)
            for index in range(n_rig_cameras)
        ),
    ]


def make_facts(
    description: SceneDescription,
    name: str,
    label: str | None,
    describe: Callable[[], Mapping[str, Value]],
    render_surfaces: Callable[[], Surfaces] | None = None,
    judge: str = OBJECT,
) -> Facts:
    """Return the facts of a scene by which a task judges predictions.

    Facts are names, labels, parameters ("camera.azimuth") and how the camera sees each
    thing. Whatever takes time is computed when a task reads it.

    Args:
        description: the scene.
        name: name of its object.
        label: right label of the judged thing, or of the object if all things are
            judged. None for the own label of that thing. Other things always have their
            own labels.
        describe: returns the values of the configuration by parameter; parameters that
            it lacks have the values of the scene.
        render_surfaces: renders what the camera sees, and is called at most once; None
            if the camera's view is not needed.
        judge: the thing that is judged: `OBJECT`, the name of another thing, or
            `ALL_THINGS`.

    Raises:
        UnknownNameError: no thing has the name `judge`.
    """
    check_judged_thing(description, judge)
    facts_maker = _FactsMaker(
        description=description,
        object_name=name,
        label=label,
        # The stated label belongs to one thing. All others have their own labels.
        labelled_mesh=OBJECT if judge == ALL_THINGS else judge,
        collect_numbers=partial(_collect_numbers, description, describe),
        # rendered at most once, even if the facts of several things need it
        cached_render=None if render_surfaces is None else cache(render_surfaces),
    )
    # each with the facts of all others
    facts_by_mesh = _add_others(
        {mesh: facts_maker.make(mesh) for mesh in (OBJECT, *description.things)}
    )
    if judge == ALL_THINGS:
        return replace(facts_by_mesh[OBJECT], facts_of_thing=facts_by_mesh)
    return facts_by_mesh[judge]


@dataclass(frozen=True, eq=False)
class _FactsMaker:
    """Makes the facts of single things of a scene.

    Attributes:
        description: the scene.
        object_name: name of the object.
        label: right label of one thing; None for its own label.
        labelled_mesh: mesh of that thing.
        collect_numbers: returns the parameters of a configuration that are numbers.
        cached_render: renders what the camera sees, once; None if it is not needed.
    """

    description: SceneDescription
    object_name: str
    label: str | None
    labelled_mesh: str
    collect_numbers: Callable[[], dict[str, float]]
    cached_render: Callable[[], Surfaces] | None

    def make(self, mesh: str) -> Facts:
        """Return the facts of a single thing by its mesh, the object or another one."""
        # without a stated label (None), the own label of the thing is right
        stated_label = self.label if mesh == self.labelled_mesh else None
        look = self._make_look(mesh)
        # The object has the name that the caller states. Another thing has the name of
        # its mesh.
        if mesh == OBJECT:
            default_label = self.description.object.label
            thing_name = self.object_name
        else:
            default_label = self.description.things[mesh].label
            thing_name = mesh
        return Facts(
            thing_name, stated_label, default_label, self.collect_numbers, look
        )

    def _make_look(self, mesh: str) -> Callable[[], Sight] | None:
        """Return a function that renders how the camera sees a thing by its mesh.

        It is a function, so that a task that does not need it does not render.
        """
        if self.cached_render is None:
            return None
        # The unit of length of the scene is the size of the object, for all things.
        metres = self.description.object.size_in_metres
        return partial(_look_at, self.cached_render, mesh, metres=metres)


def _collect_numbers(
    description: SceneDescription, describe: Callable[[], Mapping[str, Value]]
) -> dict[str, float]:
    """Return all parameters of a scene that are numbers, by name.

    Args:
        description: the scene, which has a value for every parameter.
        describe: returns the values of a configuration, such as {"camera.azimuth":
            {"value": 30.0, "unit": "degrees"}}. They replace those of the scene.
    """
    configuration = {key: value["value"] for key, value in describe().items()}
    all_values = {**description.values, **configuration}
    return {
        key: float(value)
        for key, value in all_values.items()
        if isinstance(value, (int, float))
    }


def _add_others(facts_by_mesh: Mapping[str, Facts]) -> dict[str, Facts]:
    """Return the facts of each thing with those of all others."""
    complete_facts = {}
    for mesh, facts in facts_by_mesh.items():
        others = tuple(
            other for other_mesh, other in facts_by_mesh.items() if other_mesh != mesh
        )
        complete_facts[mesh] = replace(facts, facts_of_others=others)
    return complete_facts


def _look_at(
    render_surfaces: Callable[[], Surfaces], mesh: str, *, metres: float | None
) -> Sight:
    """Render what the camera sees, and return what a task may know of one mesh."""
    return make_sight(render_surfaces(), mesh, metres)


def make_sight(
    surfaces: Surfaces, mesh: str = OBJECT, metres: float | None = None
) -> Sight:
    """Return how the camera sees one mesh, as a task may use it: its mask and depths.

    Args:
        surfaces: what each pixel shows.
        mesh: name of the mesh.
        metres: length of a unit of the scene in metres, to convert depths; None if it
            is not known. The unit is the size of the object, whatever `mesh` is.
    """
    return Sight(surfaces.visible_mask(mesh), surfaces.depth, surfaces.z_depth, metres)


def find_visible_things(renderer: Renderer, u: Tensor) -> JsonObject | None:
    """Return what the image of a configuration shows of each thing, by name.

    That is box, pixel count, visible fraction and distance; see
    `runs.results.ThingSeen`.

    Args:
        renderer: renders what the camera sees.
        u: (d,) the configuration.

    Returns:
        An entry for the object and for each other thing; None if the scene has only
        the object.
    """
    description, _filter = renderer.scene.description_and_filter
    if not description.things:
        return None
    names = (OBJECT, *description.things)
    labels = {name: description.meshes[name].label for name in names}
    # Every thing gets the entry of a thing that the image does not show. The loop below
    # replaces the entries of those that it does show.
    things: JsonObject = {name: _make_hidden_entry(labels[name]) for name in names}
    for thing in find_visible_meshes(renderer, u, names):
        things[thing.name] = _make_visible_entry(thing, labels[thing.name])
    return things


def _make_hidden_entry(label: str | None) -> JsonObject:
    """Return the entry of a thing that an image does not show."""
    return {
        "label": label,
        "box": None,
        "pixels": 0,
        "share": 0.0,
        "truncated": None,
        "distance": None,
    }


def _make_visible_entry(thing: VisibleMesh, label: str | None) -> JsonObject:
    """Return the entry of a thing that an image shows; its distance is rounded."""
    visible_fraction = thing.visible_fraction
    if visible_fraction is not None:  # it is None if it is not known
        visible_fraction = round(visible_fraction, 4)
    return {
        "label": label,
        "box": [*thing.box],
        "pixels": int(thing.mask.sum()),
        "share": visible_fraction,
        "truncated": thing.is_truncated,
        "distance": round(thing.distance, 3),
    }


def check_image_path(path: str | Path, n_views: int) -> Path:
    """Return the path of an image if its name is one that can be written.

    Args:
        path: path of a .png or .exr file.
        n_views: number of views that the image shows.

    Raises:
        InputError: another suffix, an .exr of several views, or a directory.
    """
    file = Path(path)
    _check_image_suffix(path, n_views)
    if file.is_dir():
        raise InputError(f"out: expected the name of a file, got the folder {file}")
    return file


def _check_image_suffix(path: str | Path, n_views: int) -> None:
    """Check that a path ends in .png, or in .exr for an image of a single view."""
    suffix = Path(path).suffix.lower()
    if suffix not in IMAGE_SUFFIXES:
        raise InputError(
            f"out: expected the path of a .png or .exr file, got {str(path)!r}"
        )
    if suffix == ".exr" and n_views > 1:
        raise InputError(
            "out: a sheet of several views has text in it and is a .png; "
            "leave `around` out for an .exr"
        )


def _orbit_scene(
    description: SceneDescription, around: int | None
) -> Iterator[SceneDescription]:
    """Yield the scene from azimuths all around the object.

    Args:
        description: the scene. Its own azimuth is the first.
        around: number of azimuths, evenly spaced; None to yield the scene as it is.

    Raises:
        InputError: the scene's camera does not orbit the object.
    """
    if around is None:
        yield description
        return
    _check_camera_orbits(description)
    first_azimuth = description.get_number("camera.azimuth")
    for index in range(around):
        azimuth = (first_azimuth + 360.0 * index / around) % 360.0
        yield description.with_values(camera__azimuth=azimuth)


def _check_camera_orbits(description: SceneDescription) -> None:
    """Raise InputError if the camera does not orbit the object, which `around` needs."""
    if description.camera != ORBIT_CAMERA:
        raise InputError(
            "around: turns the camera that circles the object, and `camera` "
            f"{description.camera} is fixed; leave one of the two out"
        )
