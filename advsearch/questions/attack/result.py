"""The result of an attack in Python, and the images and files that its run stores.

Images are of both scenes, of trials, and of frames along a path (a drive). A file has
the object for a browser, which lets the reader turn it.
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
from advsearch.attacks import Ending, SearchResult, Verification
from advsearch.controls.base import Control
from advsearch.controls.ranges import OneOf
from advsearch.engine.judging import make_ensemble_task
from advsearch.engine.loading import Scene, load_scene
from advsearch.engine.naming import AnyModel, hold_process_lock
from advsearch.engine.problem import Problem
from advsearch.engine.record import MAX_STORED_IMAGES, RunState
from advsearch.engine.rendering import Rendering, render
from advsearch.errors import InputError
from advsearch.questions.attack.summary import AlongDrive, AttackSummary
from advsearch.report.figures import draw_marks, draw_searches, new_axes
from advsearch.report.views import get_view, join_images, make_notebook_html
from advsearch.runs import files, store
from advsearch.runs.directory import IMAGES, OBJECT_FILE, RunDirectory
from advsearch.scene.assembly import pose_mesh
from advsearch.scene.assets import Mesh, Shape, make_simplifier
from advsearch.scene.color import round_to_8_bit
from advsearch.scene.description import OBJECT
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.glb import encode_web_glb
from advsearch.scene.parts import MeshPart
from advsearch.scene.settings import SettingValues
from advsearch.settings import to_python
from advsearch.tasks import Judgement, Mark
from advsearch.trust.code import allow_code_of_call
from advsearch.trust.writing import write_bytes

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from advsearch.questions.attack.carry_out import AttackParts


class RenderKeywords(TypedDict, total=False):
    """Settings that `AttackResult.render` takes as keywords, as `render` does."""

    resolution: int | tuple[int, int] | None
    spp: int
    denoise: str
    sampler: str
    seed: int
    around: int | None
    aov: bool


def _check_render_keywords(options: Mapping[str, Any]) -> None:
    """Check that `AttackResult.render` takes all these keywords.

    Raises:
        TypeError: it does not take one of them.
    """
    unknown = sorted(options.keys() - RenderKeywords.__annotations__)
    if unknown:
        known = ["model", "scene", "camera", "settings"]
        known += RenderKeywords.__annotations__
        raise TypeError(
            "render() got an unexpected keyword argument "
            f"{unknown[0]!r}; it takes {', '.join(known)}"
        )


def _resolve_scene(scene: Scene | str | Path | None, default: Scene) -> Scene:
    """Return a scene, loaded if it is named, or the default for None."""
    if scene is None:
        return default
    return scene if isinstance(scene, Scene) else load_scene(scene)


def _split_camera(
    camera: str | Mapping[str, float] | None, settings: SettingValues | None
) -> tuple[str | None, SettingValues | None]:
    """Return the name of a camera, if it is a name, and settings with its parameters.

    Args:
        camera: name of one of the scene's cameras, or parameters of the camera, which
            become settings such as ``camera.azimuth``.
        settings: other settings of the scene.
    """
    if not isinstance(camera, Mapping):
        return camera, settings
    camera_settings = {f"camera.{name}": value for name, value in camera.items()}
    return None, {**(settings or {}), **camera_settings}


def _change_view(
    scene: Scene, camera: str | None, settings: SettingValues | None
) -> Scene:
    """Return a scene with other settings, and with the view of one of its cameras."""
    if settings:
        scene = scene.with_settings(settings)
    if camera:
        scene = replace(scene, description=scene.description.with_camera(camera))
    return scene


@dataclass(frozen=True, eq=False, repr=False)
class AttackResult:
    """The result of an attack.

    Attributes:
        summary: what `summary.json` holds.
        run: the run directory; None if the run was not stored.
        u: (d,) the configuration that was verified; the clean one if nothing was
            searched.
        clean: (H, W, 3) display-referred sRGB in [0, 1], 8-bit values: image of the
            clean configuration, rendered as in the trial `summary.clean.trial`.
            `summary.clean` has the prediction.
        adversarial: (H, W, 3) image of `u`, rendered as in the same trial.
        artifacts: images that the controls make from `u`, by name, such as the texture;
            (h, w, 3) sRGB in [0, 1].
        search: log and claim of the search; None if nothing was searched, or if the
            result was loaded from a run.
        in_memory: the rows, if there is no run directory.
        parts: function that returns the parts of the attack (scene, model, settings);
            None if the result came from another process.
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
        """The adversarial configuration by name, such as `pose.yaw`, without units.

        A texture has a few numbers that describe it. Empty if nothing was searched.
        `summary.configuration` has the units.
        """
        return {
            name: found.value
            for name, found in (self.summary.configuration or {}).items()
        }

    @property
    def images(self) -> dict[str, Tensor]:
        """The images `clean` and `adversarial`: (H, W, 3) display-referred sRGB in [0,
        1].
        """
        return {"clean": self.clean, "adversarial": self.adversarial}

    @property
    def history(self) -> list[float]:
        """The objective of each evaluation of the search, in order.

        `rows("search")` has everything else that is stored of each evaluation.
        """
        # The ranking renders the best configurations of the search again.
        rows = [row for row in self.rows("search") if row.phase != "ranking"]
        return [row.objective for row in rows if row.objective is not None]

    @allow_code_of_call
    @hold_process_lock()
    def render(
        self,
        model: AnyModel | None = None,
        *,
        scene: Scene | str | Path | None = None,
        camera: str | Mapping[str, float] | None = None,
        settings: SettingValues | None = None,
        **options: Unpack[RenderKeywords],
    ) -> Rendering:
        """Render the adversarial scene again, and return what a model predicts of it.

        What the adversarial configuration does not set is as in the original scene. In
        particular, the controls of `over` have their start values.

        Args:
            model: another model; None for the model of the attack.
            scene: another scene with the same object; None for the scene of the attack.
            camera: parameters of the camera, ``{"azimuth": 130.0}``; or the name of one
                of the scene's cameras.
            settings: parameters of the scene to fix to other values, e.g.
                ``{"camera.azimuth": 130.0}``.
            **options: `resolution`, `spp`, `denoise`, `sampler`, `seed`, `around` and
                `aov`, as for `render`; by default as in the attack.

        Raises:
            TypeError: there is no such keyword.
            InputError: the adversarial configuration itself sets one of `settings`, or
                has not as many numbers as the controls take in the other scene.
        """
        load_parts = self._get_parts_loader()
        _check_render_keywords(options)
        # parts of a stored run are loaded only when needed
        parts = load_parts()
        camera_name, settings = _split_camera(to_python(camera), to_python(settings))
        self._check_no_clashes(settings)
        task = parts.task
        if model is None:
            # the attack's own model, which may be an ensemble
            model, _ = parts.model_and_warnings
            task = make_ensemble_task(task, model)
        viewed_scene = _resolve_scene(scene, parts.scene)
        return render(
            _change_view(viewed_scene, camera_name, settings),
            model,
            task=task,
            label=parts.config.label,
            controls=parts.controls,
            at=self.u,
            **{**parts.config.image_settings, **options},
        )

    def _get_parts_loader(self) -> Callable[[], AttackParts]:
        """Return the function that returns the parts of the attack.

        Raises:
            InputError: the result came from another process, and has no such function.
        """
        if self.parts is None:
            raise InputError(
                "render: expected a result of this session, got one from another "
                "process; load_run(FOLDER) loads one that can be rendered"
            )
        return self.parts

    def _check_no_clashes(self, settings: SettingValues | None) -> None:
        """Raise an error if the configuration itself sets one of the settings."""
        clashes = set(settings or {}) & set(self.summary.configuration or {})
        if clashes:
            raise InputError(
                f"settings: the adversarial configuration sets {min(clashes)}; leave it "
                "out"
            )

    def __getstate__(self) -> dict[str, Any]:
        """Return what is pickled: all but the parts, which only this session has."""
        return {**vars(self), "parts": None}

    def rows(self, kind: str | None = None) -> Iterator[store.Row]:
        """Yield every evaluated configuration in order.

        Args:
            kind: "search", "verification", ...; None yields all.
        """
        if self.run is None:
            yield from (row for row in self.in_memory if kind in (None, row.kind))
            return
        with store.Store(self.run / store.NAME, read_only=True) as results:
            yield from results.rows(kind)

    def to_pandas(self, kind: str | None = None) -> Any:
        """Return every evaluated configuration as a row of a `pandas.DataFrame`.

        Columns are those of an export (docs/runs.md); its `attrs` have the units.

        Args:
            kind: "search", "verification", ...; None for all.
        """
        from advsearch.runs.tables import to_pandas  # pandas takes half a second

        return to_pandas(self.rows(kind))

    def plot(self, axes: Any = None) -> Any:
        """Draw the objective over evaluations, and return the matplotlib axes.

        Args:
            axes: axes to draw on; None makes new ones.
        """
        axes = new_axes() if axes is None else axes
        draw_searches({self.summary.policy: self.history}, self.summary.objective, axes)
        return axes

    def __repr__(self) -> str:
        summary = self.summary
        run = None if self.run is None else str(self.run)
        verified = f", verified {summary.outcome_summary}" if summary.verified else ""
        controls = ",".join(summary.controls)
        return (
            f"AttackResult({summary.object!r}, {controls!r}, "
            f"{summary.ending!r}{verified}, run={run!r})"
        )

    def _repr_html_(self) -> str:
        return make_notebook_html(get_view(self.summary), self.images)

    def _repr_png_(self) -> bytes:
        return join_images([*self.images.values()])


# faces in the file for a browser; meshes with more are simplified
MAX_FACES = 30_000
# A mesh is near the object, and written into the file, too, if their centers are at
# most this far apart, in units of the object's extent.
MAX_NEAR_DISTANCE = 2.0
# samples per pixel of the stored images of both scenes if there were no trials
UNTRIED_SPP = 16


@dataclass(frozen=True, eq=False)
class StoredImage:
    """A stored image of a configuration, as the model gets it.

    Attributes:
        full_configuration: the configuration, with the coordinates of the conditions.
        radiance: (H, W, 3) linear.
        image: (H, W, 3) sRGB, 8-bit values in [0, 1].
        judgement: judgement of the image.
        trial: number of the trial with the same seed; None if there were no trials.
    """

    full_configuration: Tensor
    radiance: Tensor
    image: Tensor
    judgement: Judgement
    trial: int | None

    @classmethod
    def render(
        cls, problem: Problem, findings: RunState, u: Tensor, trial: int | None
    ) -> StoredImage:
        """Render a configuration as in a trial.

        Args:
            problem: problem of the attack.
            findings: findings of the attack.
            u: (d,) coordinates of the searched controls.
            trial: number of the trial; None renders the scene with the start values of
                the conditions.
        """
        if trial is None:
            seed = seeds.derive_seed(problem.seed, "pictures")
            configuration = problem.make_full_configuration(u, None)
        else:
            # as in the trial, which has the same seed
            seed = seeds.derive_seed(problem.seed, "verification", trial)
            configuration = problem.make_full_configuration(u, seed)
        spp = UNTRIED_SPP if trial is None else findings.spp
        radiance, image = _render_stored(problem, configuration, seed, spp)
        return cls(
            full_configuration=configuration,
            radiance=radiance,
            image=image,
            judgement=problem.judge(image, configuration),
            trial=trial,
        )


def _render_stored(
    problem: Problem, configuration: Tensor, seed: int, spp: int
) -> tuple[Tensor, Tensor]:
    """Render a configuration, and return its radiance and the image that the model gets.

    Args:
        problem: problem of the attack.
        configuration: (d,) with the coordinates of the conditions.
        seed: seed of the render.
        spp: samples per pixel.

    Returns:
        (H, W, 3) linear, and (H, W, 3) sRGB with 8-bit values in [0, 1].
    """
    renderer = problem.renderer
    with torch.no_grad(), renderer.share_paths(problem.shared_paths):
        radiance = renderer.radiance(configuration, seed, spp)
        display = renderer.formation.map_to_display(radiance)
        image = round_to_8_bit(problem.space.apply_to_image(configuration, display))
    return radiance, image


def choose_stored_trial(findings: RunState) -> int | None:
    """Return the number of the trial whose images of both scenes are stored.

    A trial renders both scenes under the same conditions. In the chosen trial, the
    adversarial scene has its most frequent prediction among the successes, or among all
    trials that count if none is a success. If possible, the clean scene has its most
    frequent prediction, too. The first such trial is chosen. None if there were no
    trials.
    """
    verification = findings.verification
    if verification is None:
        clean_labels = _list_labels(findings.clean_trials)
        return clean_labels.index(mode(clean_labels)) if clean_labels else None
    criteria = _list_trial_criteria(verification)
    # Tuples are compared element by element, and True is larger than False.
    first_best = criteria.index(max(criteria))
    return verification.first_index + first_best


def _list_trial_criteria(verification: Verification) -> list[tuple[bool, bool, bool]]:
    """Return which criteria each trial meets, the most important first.

    These are: the adversarial scene has its most frequent label with the typical
    outcome; it has this label; the clean scene has its most frequent label.
    """
    clean_labels = _list_labels(verification.clean_trials)
    # A trial is a success (True), a failure (False), or does not count (None).
    has_successes = bool(verification.successful_trials)
    typical_trials = verification.successful_trials or verification.valid_trials
    frequent_label = mode(_list_labels(typical_trials))
    frequent_clean_label = mode(clean_labels)
    criteria = list[tuple[bool, bool, bool]]()
    labels = _list_labels(verification.adversarial_trials)
    # `strict=False`: trials of one scene may have ended earlier.
    for label, is_success, clean_label in zip(
        labels, verification.trial_successes, clean_labels, strict=False
    ):
        has_label = label == frequent_label
        is_typical = has_label and is_success is has_successes
        has_clean_label = clean_label == frequent_clean_label
        criteria.append((is_typical, has_label, has_clean_label))
    return criteria


def _list_labels(trials: Sequence[Judgement]) -> list[str]:
    """Return the predicted label of each trial."""
    return [trial.prediction.label for trial in trials]


def save_images(
    run: RunDirectory,
    problem: Problem,
    findings: RunState,
    scene_images: Mapping[str, StoredImage],
) -> None:
    """Save the images of an attack: of both scenes, of trials, and of the search.

    These are both scenes and their difference, the first `MAX_STORED_IMAGES` trials of
    the adversarial scene, and an animation of the search that ends with this scene.

    Args:
        run: run directory into which they are saved.
        problem: problem of the attack.
        findings: findings of the attack.
        scene_images: images of both scenes, by `clean` and `adversarial`.
    """
    for name, image in scene_images.items():
        _save_scene_image(run, problem, name, image)
    adversarial = scene_images["adversarial"].image
    difference = files.amplify_difference(scene_images["clean"].image, adversarial)
    run.save_image("difference", difference)
    _save_trials(run, problem, findings)
    if findings.search_frames:
        last_frame = _make_last_frame(problem, findings, adversarial)
        run.save_animation("search", [*findings.search_frames, last_frame.numpy()])


def _save_trials(run: RunDirectory, problem: Problem, findings: RunState) -> None:
    """Save the images of the first trials of the adversarial scene."""
    verification = findings.verification
    if verification is None:
        return
    # Images of trials are cached by the kind of the verification. If the random search
    # found a worse configuration, the adversarial one was verified as the baseline.
    kind = "verification"
    if findings.outdone_verification is not None:
        kind = "baseline verification"
    end = verification.first_index + len(verification.adversarial_trials)
    for number in range(verification.first_index, end)[:MAX_STORED_IMAGES]:
        name = f"verification-{number:02d}"
        save_trial(run, problem, findings, (kind, number), name, verification.u)


def _make_last_frame(
    problem: Problem, findings: RunState, adversarial: Tensor
) -> Tensor:
    """Return the last frame of the search's animation: the adversarial scene (H, W, 3).

    Args:
        problem: problem of the attack.
        findings: findings of the attack.
        adversarial: (H, W, 3) the stored image of that scene.
    """
    if problem.conditions is None or findings.search_result is None:
        return adversarial
    # The image of the adversarial scene may have the conditions of a trial. All frames
    # have the start values of the conditions, and so must the last one.
    u = problem.domain.project(findings.search_result.best_u)
    return StoredImage.render(problem, findings, u, trial=None).image


def _save_scene_image(
    run: RunDirectory, problem: Problem, name: str, image: StoredImage
) -> None:
    """Save the image of a scene, its radiance, the same with marks, and its layers.

    Marks are what a task draws on an image, such as the boxes of a detector. Layers are
    ground truth for each pixel, such as depth, if the settings request any.

    Args:
        run: run directory into which they are saved.
        problem: problem of the attack.
        name: name of the files, "clean" or "adversarial".
        image: the rendered image.
    """
    run.save_image(name, image.image)
    run.save_exr(name, image.radiance * problem.renderer.formation.gain)
    marks = problem.find_marks(image.image, image.full_configuration)
    save_with_marks(run, name, image.image, marks)
    if problem.aovs:
        surfaces = problem.renderer.find_surfaces(image.full_configuration)
        layers = surfaces.make_layers(problem.aovs, OBJECT)
        notes = surfaces.describe_layers(problem.aovs)
        files.write_layers(run.path / IMAGES / f"{name}.aov.exr", layers, notes)


def save_trial(
    run: RunDirectory,
    problem: Problem,
    findings: RunState,
    trial: tuple[str, int],
    name: str,
    u: Tensor,
) -> None:
    """Save the image of a trial, and the same with marks.

    Args:
        run: run directory into which it is saved.
        problem: problem of the attack.
        findings: findings of the attack, with images of some trials; the image of
            another trial is rendered again.
        trial: kind and number of the trial, such as ("verification", 3).
        name: name of the file without its suffix.
        u: (d,) the configuration.
    """
    _, number = trial
    # Trials of the same number have the same seed in verifications of every kind.
    seed = seeds.derive_seed(problem.seed, "verification", number)
    image = findings.trial_images.get(trial)
    if image is None:
        image = problem.picture(u, seed, findings.spp)
    run.save_image(name, image)
    marks = problem.find_marks(image, problem.make_full_configuration(u, seed))
    save_with_marks(run, name, image, marks)


def save_with_marks(
    run: RunDirectory, name: str, picture: Tensor, marks: list[Mark]
) -> None:
    """Save an image with the marks of a task, if there are any."""
    if marks:
        run.save_image(f"{name}-prediction", draw_marks(picture.numpy(), marks))


def write_object(run: RunDirectory, problem: Problem, u: Tensor) -> None:
    """Write the clean and the adversarial object as a 3-D file for a browser.

    Other meshes that controls move or paint are written, too, if they are near. Meshes
    with many faces are simplified, so that all together have at most about `MAX_FACES`.
    A note in the file names the simplified ones.

    Args:
        run: run directory into which it is written.
        problem: problem of the attack.
        u: (d,) the adversarial configuration.
    """
    scene = problem.space.scene
    if scene is None:
        return
    # the inputs of both scenes
    adversarial = _assemble(problem, u)
    clean = _assemble(problem, problem.domain.start)
    objects = _SimplifiedObjects.from_meshes(_select_changed(scene, adversarial))
    to_world = _find_camera_pose(adversarial, scene)
    glb = encode_web_glb(
        objects.make_shapes(adversarial),
        objects.make_shapes(clean),
        to_world,
        objects.describe_simplified(),
    )
    write_bytes(run.path / OBJECT_FILE, glb)


def _select_changed(scene: Any, inputs: Mapping[str, Tensor]) -> list[MeshPart]:
    """Return the meshes of a scene that controls move or paint, and the object.

    Args:
        scene: the scene.
        inputs: inputs of the scene that controls set, by name.
    """
    # An input of the scene is named as "mug.bsdf.reflectance": the mesh comes first.
    changed_names = {OBJECT, *(name.partition(".")[0] for name in inputs)}
    return [mesh for name, mesh in scene.meshes.items() if name in changed_names]


@dataclass(frozen=True, eq=False)
class _SimplifiedObjects:
    """The meshes of a file for a browser, with the functions that simplify them.

    Attributes:
        meshes: meshes of the scene.
        simplifiers: function that simplifies each mesh, by name; None if the mesh has
            few faces already.
    """

    meshes: Sequence[MeshPart]
    simplifiers: Mapping[str, Callable[[Mesh], Mesh] | None]

    @classmethod
    def from_meshes(cls, meshes: Sequence[MeshPart]) -> _SimplifiedObjects:
        """Return meshes with functions that simplify them to about `MAX_FACES` in all."""
        max_faces = MAX_FACES // len(meshes)
        simplifiers = {
            mesh.name: make_simplifier(mesh.mesh, max_faces) for mesh in meshes
        }
        return cls(meshes, simplifiers)

    def make_shapes(self, inputs: Mapping[str, Tensor]) -> list[Shape]:
        """Return the shapes near the object, with fewer faces.

        Args:
            inputs: inputs of the scene, such as poses, by name.
        """
        shapes = {mesh.name: pose_mesh(mesh, inputs) for mesh in self.meshes}
        near_shapes = []
        for shape in _select_near(shapes):
            simplify = self.simplifiers[shape.name]
            if simplify is not None:
                shape = replace(shape, mesh=simplify(shape.mesh))
            near_shapes.append(shape)
        return near_shapes

    def describe_simplified(self) -> str:
        """Return the note on meshes that have fewer faces in the file; empty if none."""
        full_counts = [
            f"{len(mesh.mesh.faces):,} of {mesh.name}"
            for mesh in self.meshes
            if self.simplifiers[mesh.name] is not None
        ]
        if not full_counts:
            return ""
        return f"It is shown with fewer faces than it has ({', '.join(full_counts)})."


def _find_camera_pose(
    adversarial: Mapping[str, Tensor], scene: Any
) -> npt.NDArray[np.float64]:
    """Return the camera's pose (4, 4): that which a control has set, or the scene's."""
    camera_pose = adversarial.get("camera.to_world")
    if camera_pose is None:
        return camera_to_world(scene)
    return camera_pose.double().numpy()


def _assemble(problem: Problem, u: Tensor) -> Mapping[str, Tensor]:
    """Return the inputs of the scene for a configuration (d,): tensors by name."""
    with torch.no_grad():
        inputs = problem.space.inputs(problem.make_full_configuration(u))
        return problem.renderer.scene.input_assembler(inputs)


def _select_near(shapes: Mapping[str, Shape]) -> list[Shape]:
    """Select the shapes that are near the object.

    Their centers are at most `MAX_NEAR_DISTANCE` times its largest extent from its own
    center, along every axis.
    """
    vertices = shapes[OBJECT].mesh.vertices
    center = vertices.mean(axis=0)
    max_distance = MAX_NEAR_DISTANCE * float(np.ptp(vertices, axis=0).max())
    return [
        shape
        for shape in shapes.values()
        if np.abs(shape.mesh.vertices.mean(axis=0) - center).max() < max_distance
    ]


FRAMES = 24  # frames of each path
MAX_STRIP_FRAMES = 8  # frames in the image that has some of them side by side
STRIP_HEIGHT = 160  # height of that image in pixels
MIN_FRAME_MILLISECONDS = 40  # shortest time of a frame in the animation


def evaluate_drive(
    problem: Problem, u: Tensor | None, spp: int, run: RunDirectory | None
) -> AlongDrive | None:
    """Evaluate both scenes at evenly spaced times of each path that varies by chance.

    The images are saved as an animation. Other conditions have their start values.

    Args:
        problem: problem of the attack.
        u: (d,) the adversarial configuration; None evaluates the clean scene only.
        spp: samples per pixel.
        run: run directory for the images; None saves none.

    Returns:
        In how many frames of each scene the model is right. `frames` counts those of
        all paths, and `seconds` are those of a single path. None if no path varies.
    """
    path, time_column = _find_path(problem)
    if path is None:
        return None
    path_names, frames = _make_frames(problem, path, time_column)
    seconds = _measure_path_seconds(problem, path, frames)
    # The animation has the paths one after another.
    n_paths = max(1, len(path_names))  # a single path has no name
    right_counts: dict[str, int] = {}
    for name, configuration in _name_drive_configurations(problem, u).items():
        # The searched coordinates come first, then those that conditions vary.
        frames[:, : len(configuration)] = configuration
        images, right_counts[name] = _render_frames(problem, frames, spp)
        if run is not None:
            save_drive(run, name, images, seconds * n_paths)
    return AlongDrive(
        frames=len(frames),
        seconds=seconds,
        paths=[str(name) for name in path_names],
        clean=right_counts["drive-clean"],
        adversarial=right_counts.get("drive"),
        spp=spp,
    )


def _name_drive_configurations(problem: Problem, u: Tensor | None) -> dict[str, Tensor]:
    """Return the configurations (d,) of both scenes by the names of their files.

    Args:
        problem: problem of the attack.
        u: (d,) the adversarial configuration; None leaves it out.
    """
    configurations = {"drive-clean": problem.domain.start}
    if u is not None:
        configurations["drive"] = u
    return configurations


def _measure_path_seconds(problem: Problem, path: Any, frames: Tensor) -> float:
    """Return the seconds from the first frame of a path to the last.

    All paths have the same range of times: the last frame is the end of any path.

    Args:
        problem: problem of the attack.
        path: the control that moves things along a path.
        frames: (n, d) configurations of the frames.
    """
    first_time = _read_time(problem, path, frames[0])
    last_time = _read_time(problem, path, frames[-1])
    return last_time - first_time


def _find_path(problem: Problem) -> tuple[Any, int]:
    """Find the control that moves things along a path, at a random time of it.

    Returns:
        The control, and the column of its time in a full configuration, which is the
        control's first coordinate. If there is no such control, it is None, and the
        column has no meaning.
    """
    n_searched = len(problem.searched_space.controls)
    # Random controls come after the searched ones, in the order of the space.
    column = len(problem.domain.start)
    for control in problem.space.controls[n_searched:]:
        # A time that a setting fixes has no coordinate.
        has_random_time = any(
            slot.parameter.name == "time" and slot.n_coordinates > 0
            for slot in control.parameter_slots
        )
        if control.travels and has_random_time:
            return control, column
        column += len(control.start)
    return None, column


def _make_frames(
    problem: Problem, path: Any, time_column: int
) -> tuple[list[Any], Tensor]:
    """Return the names of several paths, and the configurations of all frames.

    Args:
        problem: problem of the attack.
        path: the control that moves things along a path.
        time_column: index of its time among the coordinates.

    Returns:
        The names, empty if there is a single path; and (paths * FRAMES, d), the frames
        of one path after those of the other.
    """
    start = problem.make_full_configuration(problem.domain.start)
    # A path with a weight is repeated among the choices.
    choices = _list_path_choices(path)
    names = list(dict.fromkeys(choices))
    n_paths = max(1, len(names))  # a single path has no name
    frames = start.repeat(n_paths, FRAMES, 1)  # (paths, FRAMES, d)
    frames[..., time_column] = torch.linspace(0.0, 1.0, FRAMES)
    path_column = time_column + 1  # the choice of path is the next coordinate
    for index, name in enumerate(names):
        frames[index, :, path_column] = _find_path_coordinate(choices, name)
    return names, frames.flatten(0, 1)


def _find_path_coordinate(choices: Sequence[Any], name: Any) -> float:
    """Return the coordinate in [0, 1] with which a path is chosen.

    Each choice has an equal interval of [0, 1]. The coordinate is the center of the
    first interval that belongs to the path.

    Args:
        choices: paths, some perhaps repeated.
        name: the path that is chosen.
    """
    return (choices.index(name) + 0.5) / len(choices)


def _list_path_choices(path: Any) -> Sequence[Any]:
    """Return the paths among which a control chooses; none if it has a single one."""
    for slot in path.parameter_slots:
        is_path = slot.parameter.name == Control.PATH_PARAMETER
        if is_path and isinstance(slot.parameter_spec, OneOf):
            return slot.parameter_spec.values
    return ()


def _read_time(problem: Problem, path: Any, u: Tensor) -> float:
    """Return the time of a frame in seconds."""
    value = problem.space.describe(u, [path])[f"{path.name}.time"]["value"]
    return float(str(value))


def _render_frames(
    problem: Problem, frames: Tensor, spp: int
) -> tuple[list[npt.NDArray[np.float32]], int]:
    """Render frames, and evaluate the model on them.

    Args:
        problem: problem of the attack.
        frames: (n, d) configurations of the frames.
        spp: samples per pixel.

    Returns:
        The images (H, W, 3) with the marks of the task, and in how many the model is
        right.
    """
    images = list[npt.NDArray[np.float32]]()
    n_right = 0
    for number, configuration in enumerate(frames):
        seed = seeds.derive_seed(problem.seed, "drive", number)
        with torch.no_grad():
            display = problem.renderer(configuration, seed=seed, spp=spp)
            image = round_to_8_bit(display)
        is_right, marks = problem.predict_with_marks(image, configuration)
        if is_right:
            n_right += 1
        images.append(np.asarray(draw_marks(image.numpy(), marks), dtype=np.float32))
    return images, n_right


def save_drive(
    run: RunDirectory,
    name: str,
    images: Sequence[npt.NDArray[np.float32]],
    seconds: float,
) -> None:
    """Save frames as an animation, NAME.webp, and some of them side by side, NAME.png.

    Args:
        run: run directory into which they are saved.
        name: name of the files.
        images: (h, w, 3) of each frame, sRGB in [0, 1].
        seconds: seconds from the first frame to the last; the animation lasts as long,
            but a frame at least `MIN_FRAME_MILLISECONDS`.
    """
    frames = [Image.fromarray(files.to_8bit(picture)) for picture in images]
    milliseconds = max(MIN_FRAME_MILLISECONDS, round(1000.0 * seconds / len(frames)))
    animation = _encode_webp(frames, milliseconds)
    write_bytes(run.path / IMAGES / f"{name}.webp", animation)
    run.save_image(name, _make_strip(frames))


def _encode_webp(frames: Sequence[Image.Image], milliseconds: int) -> bytes:
    """Encode images as an animation, each of which lasts some milliseconds."""
    stream = io.BytesIO()
    frames[0].save(
        stream,
        "WEBP",
        save_all=True,
        append_images=frames[1:],
        duration=milliseconds,
        loop=0,
        quality=80,
    )
    return stream.getvalue()


def _make_strip(frames: Sequence[Image.Image]) -> npt.NDArray[np.floating[Any]]:
    """Return some of the frames side by side (h, w, 3), sRGB in [0, 1]."""
    width = max(1, round(frames[0].width * STRIP_HEIGHT / frames[0].height))
    strip = []
    for number in select_evenly(len(frames), MAX_STRIP_FRAMES):
        small = frames[number].resize((width, STRIP_HEIGHT), Image.Resampling.LANCZOS)
        strip.append(np.asarray(small, dtype=np.float32) / 255.0)
    return np.concatenate(strip, axis=1)


def select_evenly(count: int, max_count: int) -> npt.NDArray[np.int64]:
    """Return indices of evenly spaced frames, the first and the last among them.

    Args:
        count: count of all frames.
        max_count: maximum number of indices.
    """
    indices = np.linspace(0, count - 1, min(count, max_count)).round()
    return np.unique(indices.astype(np.int64))
