"""Render the twins of photographs, run models on all of them, and count.

Rows are stored one by one, so that a stopped run can continue.
"""

from __future__ import annotations

import gc
import io
import math
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from torch import Tensor

from advsearch.extend import (
    InputError,
    Model,
    RunContext,
    Task,
    color,
    settings,
    tasks,
    workbench,
)
from advsearch.questions.twins import counting, rendering
from advsearch.questions.twins.listing import PhotographedObject, read_photographs
from advsearch.questions.twins.result import (
    CLASSIFIER_MARGIN,
    COMPOSED,
    DETECTOR_MARGIN,
    HOLE,
    PHOTOGRAPH,
    TwinPair,
    TwinPrediction,
    TwinRow,
    TwinsConfig,
    TwinsResult,
)

LOW_OVERLAP = 0.8  # of silhouettes; with less, the pose may be wrong
IMAGE_SIZE = 160  # longer side in pixels of images on the page
# The photograph, the twin in it, and the twin in the environment are stored; the hole
# is not.
N_STORED_IMAGES = 3


@dataclass(frozen=True, eq=False)
class Selection:
    """The objects in photographs that a run compares.

    Attributes:
        objects: objects of all rows; the index of an object is the number of its row.
        window_by_row_number: windows of the selected rows, by their numbers.
        warnings: warnings about what was left out.
    """

    objects: Sequence[PhotographedObject]
    window_by_row_number: Mapping[int, rendering.PhotoWindow]
    warnings: list[str]


def run_twins(context: RunContext[TwinsConfig], *, network: Any = None) -> TwinsResult:
    """Compare photographs with their twins.

    A twin is a render of the same object, in the same pose and seen by the same camera
    as in the photograph.

    Args:
        context: context of the run.
        network: the model, if a Python caller passes one, or a mapping from names of
            frames to models. The mapping is for cross-validation: each frame is
            predicted by a model that was not trained on it.
    """
    config = context.config
    context.progress.stage("loading")
    listing = read_photographs(Path(config.photographs).expanduser())
    judges, warnings = load_judges(config, network)
    comparison = Comparison(context, judges)
    selection = comparison.select(listing.objects)
    warnings += [*_warn_of_missing(listing.n_missing), *selection.warnings]
    measurements = context.open_measurements()
    # `compare` looks up stored rows, and `collect` gathers stored and new ones.
    rows = comparison.compare(selection, measurements)
    make_result = partial(_make_result_with_remarks, comparison, judges, warnings)
    return measurements.make_result_of_rows(rows, make_result)


def _warn_of_missing(n_missing: int) -> list[str]:
    """Return a warning if photographs of some objects do not exist."""
    if not n_missing:
        return []
    return [
        f"{n_missing} objects are in photographs that are not there; they are left out."
    ]


def _make_result_with_remarks(
    comparison: Comparison,
    judges: Sequence[ModelJudge],
    warnings: Sequence[str],
    rows: list[TwinRow],
) -> TwinsResult:
    """Make the result of some rows, with the remarks of the tasks as warnings, too.

    Args:
        comparison: the comparison, which has made the rows.
        judges: judges of the models.
        warnings: warnings of the run.
        rows: rows of all objects and models.
    """
    # Tasks may have new remarks after they were calibrated in the comparison.
    remarks = [remark for judge in judges for remark in judge.task.output_remarks]
    return comparison.make_result(rows, [*warnings, *remarks])


class ModelJudge:
    """Evaluates the predictions of a model about photographs and twins.

    Args:
        task: task that evaluates the predictions.
        model: model that predicts.
        model_of_frame: for some frames, another model that predicts instead.

    Attributes:
        task: the task for this model; calibrated after the first prediction if the task
            needs that.
        model: the model.
    """

    def __init__(
        self, task: Task, model: Model, model_of_frame: Mapping[str, Model]
    ) -> None:
        self.task = task.on(model)
        self.model = model
        self._model_of_frame = model_of_frame
        self._is_calibrated = False

    def predict(
        self, frame: str, twin: rendering.Twin, facts: tasks.Facts
    ) -> Iterator[TwinPrediction]:
        """Yield the predictions about the photograph and its twins.

        Args:
            frame: name of the frame, which may have its own model.
            twin: the images of the object.
            facts: facts of the scene, from which the task finds the ground truth.
        """
        truth = self.task.truth(facts)
        self._calibrate_once(twin, truth)
        model = self._model_of_frame.get(frame, self.model)
        for name, image in twin.images.items():
            rounded = color.round_to_8_bit(image.clamp(0.0, 1.0))
            output = model(rounded)
            (judgement,) = workbench.judge_images(
                self.task, output, rounded[None], [truth]
            )
            yield _make_twin_prediction(name, judgement)

    def _calibrate_once(self, twin: rendering.Twin, truth: Any) -> None:
        """Calibrate a task that needs it, with the first photograph.

        A task is calibrated if its model's outputs can be read in several ways, such as
        two formats of boxes: the known truth shows which one is right.

        Raises:
            InputError: several ways remain; the user has to state one.
        """
        if self._is_calibrated:
            return
        self._is_calibrated = True
        if self.task.calibrates:
            photograph = twin.images[PHOTOGRAPH].clamp(0.0, 1.0)
            output = self.model(color.round_to_8_bit(photograph))
            self.task = self.task.after_calibration(output, truth)
        # A task without calibration may be ambiguous, too.
        if self.task.ambiguity_message:
            raise InputError(f"task {self.task.name}: {self.task.ambiguity_message}")


def _make_twin_prediction(
    surroundings: str, judgement: tasks.Judgement
) -> TwinPrediction:
    """Make the stored prediction about an image with some surroundings."""
    return TwinPrediction(
        surroundings=surroundings,
        label=judgement.prediction.label,
        probability=judgement.prediction.probability,
        right=judgement.right,
        margin=judgement.margin,
        payload=judgement.payload,
    )


def load_judges(
    config: TwinsConfig, network: Any
) -> tuple[list[ModelJudge], list[str]]:
    """Load the models, and return a judge for each model, and warnings.

    A judge predicts and evaluates images. If each frame has its own model, there is a
    single judge, which selects the model by the frame.

    Args:
        config: settings of the run.
        network: the model, or a mapping from names of frames to models; None loads the
            models that the settings name.

    Raises:
        InputError: the models take images of different sizes.
    """
    task = workbench.make_task(config.task)
    network_of_frame = network if isinstance(network, Mapping) else {}
    networks = _list_networks(config, network)
    # The function's type is for `SceneConfig`, which has the same settings of models.
    scene_config: Any = config
    models, warnings = workbench.load_models(networks, task, scene_config)
    _check_input_sizes(models)
    if not network_of_frame:
        return [ModelJudge(task, model, {}) for model in models], warnings
    # `models` are in the order of `networks`.
    model_of_frame = {
        frame: models[networks.index(frame_network)]
        for frame, frame_network in network_of_frame.items()
    }
    # The first model predicts frames that the mapping does not have.
    return [ModelJudge(task, models[0], model_of_frame)], warnings


def _list_networks(config: TwinsConfig, network: Any) -> list[Any]:
    """Return the models to load; arguments as for `load_judges`."""
    if network is None:
        return list(settings.split_names(config.model))
    if isinstance(network, Mapping) and network:
        # Each model is loaded once, though it predicts many frames.
        return list(dict.fromkeys(network.values()))
    return [network]


def _check_input_sizes(models: Sequence[Model]) -> None:
    """Raise an error if models take images of different sizes."""
    if len({model.input_size for model in models}) > 1:
        sizes = ", ".join(
            f"{model.name} {model.input_size[1]} x {model.input_size[0]}"
            for model in models
        )
        raise InputError(
            f"model: expected models that take pictures of one size, got {sizes}; "
            "compare them one by one"
        )


class Comparison:
    """Compares photographs with their twins.

    Args:
        context: context of the run.
        judges: judges of the models, at least one.
    """

    def __init__(
        self, context: RunContext[TwinsConfig], judges: Sequence[ModelJudge]
    ) -> None:
        """Prepare the comparison.

        Args:
            context: context of the run.
            judges: judges of the models, at least one; all take images of the same
                size.
        """
        self._context = context
        self._config = context.config
        self._judges = judges
        self._size = judges[0].model.input_size
        self._load_photograph = lru_cache(maxsize=4)(rendering.load_photograph)
        self.n_renders = 0

    @property
    def surroundings(self) -> tuple[str, ...]:
        """Names of the surroundings of the object in the twins."""
        return COMPOSED, self._config.environment_name, HOLE

    @property
    def margin(self) -> float:
        """How far a window reaches beyond the object's box, as a fraction of the box's
        longer side.
        """
        if self._config.margin is not None:
            return self._config.margin
        # The ground truth of a detector, a box, varies between images.
        is_detector = self._judges[0].task.varies
        return DETECTOR_MARGIN if is_detector else CLASSIFIER_MARGIN

    def select(self, objects: Sequence[PhotographedObject]) -> Selection:
        """Select the objects that are compared, and their windows of the photographs.

        Objects are left out if their frame is not selected, or if they are mostly
        hidden, out of view, or tiny.

        Args:
            objects: all objects of the list of photographs.

        Raises:
            InputError: none is left, or a model does not know a label.
        """
        is_frame = parse_frames(self._config.frames)
        candidates = {
            number: item for number, item in enumerate(objects) if is_frame(item.frame)
        }
        visible = self._select_visible(candidates)
        windows = self._choose_windows(visible)
        if not windows:
            raise InputError(
                "photographs: no object is left; check `frames` and `visible`"
            )
        warnings = self._describe_left_out(
            n_hidden=len(candidates) - len(visible),
            n_outside=len(visible) - len(windows),
        )
        return Selection(objects, windows, warnings)

    def _select_visible(
        self, candidates: Mapping[int, PhotographedObject]
    ) -> dict[int, PhotographedObject]:
        """Return the objects that are not mostly hidden, by their numbers."""
        return {
            number: item
            for number, item in candidates.items()
            if not self._is_hidden(item)
        }

    def _choose_windows(
        self, visible: Mapping[int, PhotographedObject]
    ) -> dict[int, rendering.PhotoWindow]:
        """Return the windows of visible objects by their numbers, and check their labels.

        Objects that are out of view, or tiny, have none.
        """
        assets: dict[Path, Any] = {}
        checked_labels: set[tuple[str, str]] = set()
        windows: dict[int, rendering.PhotoWindow] = {}
        for number, item in visible.items():
            # Each label is checked once, and each mesh is loaded once.
            label = (item.object, item.label)
            if label not in checked_labels:
                self._check_label(item)
                checked_labels.add(label)
            if item.mesh not in assets:
                self._context.progress.stage(f"reading {item.object}")
                assets[item.mesh] = self._load_asset(item)
            window = self._choose_window(item, assets[item.mesh])
            if window is not None:
                windows[number] = window
        return windows

    def _is_hidden(self, item: PhotographedObject) -> bool:
        """Return whether less of an object is visible than `visible` requires.

        False if the data does not state the visible fraction.
        """
        return item.visible is not None and item.visible < self._config.visible

    def _choose_window(
        self, item: PhotographedObject, asset: Any
    ) -> rendering.PhotoWindow | None:
        """Return the window around an object in its photograph; None if out of view."""
        positions = rendering.project_object(item, asset)
        photograph = self._load_photograph(item.photograph)
        return rendering.choose_window(
            positions, photograph.full_size, self._size, self.margin
        )

    def _describe_left_out(self, n_hidden: int, n_outside: int) -> list[str]:
        """Return warnings about how many objects were left out, and why."""
        warnings = []
        if n_hidden:
            warnings.append(
                f"{n_hidden} objects are hidden by more than "
                f"{1.0 - self._config.visible:.0%} and left out (`visible`)."
            )
        if n_outside:
            warnings.append(
                f"{n_outside} objects are out of view or smaller than "
                f"{rendering.MIN_SILHOUETTE:g} pixels and left out."
            )
        return warnings

    def _check_label(self, item: PhotographedObject) -> None:
        """Raise InputError if a model does not know the right label of an object."""
        for judge in self._judges:
            try:
                judge.task.check(self._make_facts(item))
            except InputError as error:
                # The message names a setting `label`, which `twins` does not have.
                reason = str(error).removeprefix("label: ")
                if item.object in self._config.names:
                    raise InputError(f"names: {item.object}: {reason}") from None
                end_of_sentence = "" if reason.endswith(("?", ".")) else "."
                raise InputError(
                    f"{item.where}: {reason}{end_of_sentence} Or name its class with "
                    f"`names`, {item.object}=CLASS"
                ) from None

    def _load_asset(self, item: PhotographedObject) -> Any:
        """Return the object in a photograph; `load_object` caches it."""
        return rendering.load_object(item.mesh, item.unit)

    def compare(self, selection: Selection, measurements: Any) -> Iterator[TwinRow]:
        """Yield the rows, object by object, so that each mesh is loaded once.

        Args:
            selection: objects that are compared, and their windows.
            measurements: stored rows of the run, by name; finished rows are added.
        """
        self._context.progress.stage("twins", len(selection.window_by_row_number))
        # Objects with the same mesh and the same shape of pixels share a renderer.
        groups: dict[tuple[Path, float], list[int]] = {}
        for number in selection.window_by_row_number:
            item = selection.objects[number]
            key = (item.mesh, round(item.camera.pixel_aspect, 3))
            groups.setdefault(key, []).append(number)
        for numbers in groups.values():
            yield from self._compare_group(numbers, selection, measurements)
            gc.collect()  # frees the renderer of the group

    def _compare_group(
        self, numbers: Sequence[int], selection: Selection, measurements: Any
    ) -> Iterator[TwinRow]:
        """Yield the rows of objects that have the same mesh, for each object and model.

        Objects of one mesh are rendered together, so that the scene is loaded once.

        Args:
            numbers: numbers of the objects.
            selection: all selected objects.
            measurements: stored rows of the run; a resumed run continues with the rest.
        """
        missing = [
            number for number in numbers if not self._is_stored(number, measurements)
        ]
        # Mitsuba cannot record renders of one scene while another one exists. So all
        # layers are rendered first, their renderer is freed, and then the renderer of
        # the environment is made.
        layers = self._render_layers(selection, missing)
        gc.collect()
        renderer = self._make_surrounded_renderer(selection, missing)
        for number in numbers:
            layer = layers.pop(number, None)  # None if the rows are stored
            make_twin = partial(self._make_twin, number, selection, layer, renderer)
            yield from self._compare_object_by_model(
                number, selection, make_twin, measurements
            )
            self._context.progress.advance(1)

    def _compare_object_by_model(
        self,
        number: int,
        selection: Selection,
        make_twin: Callable[[], rendering.Twin],
        measurements: Any,
    ) -> Iterator[TwinRow]:
        """Yield the rows of one object, for each model.

        Args:
            number: number of the object.
            selection: all selected objects.
            make_twin: function that renders the images of the object.
            measurements: stored rows of the run.
        """
        # The twin is rendered once for all models, and not at all if all rows are
        # stored.
        make_shared_twin = cache(make_twin)
        for index, judge in enumerate(self._judges):
            measure = partial(
                self._compare_object, number, selection, make_shared_twin, judge
            )
            row_name = make_row_name(number, index)
            yield measurements.get_or_measure_row(row_name, TwinRow, measure)

    def _is_stored(self, number: int, measurements: Any) -> bool:
        """Return whether the rows of an object are stored for all models."""
        return all(
            measurements.read_stored(make_row_name(number, index)) is not None
            for index in range(len(self._judges))
        )

    def _render_layers(
        self, selection: Selection, numbers: Sequence[int]
    ) -> dict[int, rendering.Layer]:
        """Render objects that have the same mesh into their photographs.

        Args:
            selection: all selected objects and their windows.
            numbers: numbers of the objects that are rendered.
        """
        if not numbers:
            return {}
        renderer = self._make_renderer(
            partial(rendering.LayerRenderer, is_matched=self._config.match),
            self._config.light,
            selection,
            numbers,
        )
        return {
            number: self._render_layer(renderer, selection, number)
            for number in numbers
        }

    def _render_layer(
        self, renderer: Any, selection: Selection, number: int
    ) -> rendering.Layer:
        """Render the object with some number into its photograph, and count the render.

        Args:
            renderer: `LayerRenderer` of the object's mesh.
            selection: all selected objects and their windows.
            number: number of the object.
        """
        item = selection.objects[number]
        window = selection.window_by_row_number[number]
        photograph = self._load_photograph(item.photograph)
        layer: rendering.Layer = renderer.render(
            item, photograph, window, self._size, number
        )
        self.n_renders += 1
        return layer

    def _make_surrounded_renderer(
        self, selection: Selection, numbers: Sequence[int]
    ) -> Any:
        """Make the renderer of one mesh in the environment; None without objects."""
        if not numbers:  # all rows are stored
            return None
        return self._make_renderer(
            rendering.SurroundedRenderer,
            self._config.environment_name,
            selection,
            numbers,
        )

    def _make_renderer(
        self,
        renderer_type: Any,
        environment: str,
        selection: Selection,
        numbers: Sequence[int],
    ) -> Any:
        """Make a renderer for objects that have one mesh.

        Args:
            renderer_type: class `SurroundedRenderer` or `LayerRenderer`, or a function
                that makes an instance.
            environment: environment that lights the objects.
            selection: all selected objects.
            numbers: numbers of the objects to render.
        """
        item = selection.objects[numbers[0]]
        film = rendering.choose_film(
            [selection.window_by_row_number[number] for number in numbers],
            item.camera.pixel_aspect,
        )
        return renderer_type(
            self._load_asset(item),
            item.unit,
            environment,
            film,
            spp=self._config.spp,
            seed=self._config.seed,
        )

    def _make_twin(
        self, number: int, selection: Selection, layer: Any, renderer: Any
    ) -> rendering.Twin:
        """Render an object in the environment, and return all images of it.

        Args:
            number: number of the object.
            selection: all selected objects and their windows.
            layer: the object rendered into the photograph.
            renderer: renderer of the object in the environment.
        """
        item = selection.objects[number]
        window = selection.window_by_row_number[number]
        render = renderer.render(item, window, number)
        self.n_renders += 1
        twin = rendering.make_twin(
            item,
            self._load_photograph(item.photograph),
            window,
            layer,
            {self._config.environment_name: render},
            self._size,
        )
        self._save_images(number, twin)
        return twin

    def _compare_object(
        self,
        number: int,
        selection: Selection,
        make_twin: Callable[[], rendering.Twin],
        judge: ModelJudge,
    ) -> TwinRow:
        """Return a model's predictions about an object's photograph and its twins.

        Args:
            number: number of the object, which is that of the row.
            selection: all selected objects.
            make_twin: function that renders the images of the object, which a `Twin`
                has; it is cached, since all models share them.
            judge: judge of the model.
        """
        item = selection.objects[number]
        window = selection.window_by_row_number[number]
        twin = make_twin()
        facts = self._make_facts(item, twin)
        pose_overlap = rendering.measure_pose(item, twin, window)
        return TwinRow(
            number=number,
            model=judge.model.name,
            photograph=item.photograph.name,
            frame=item.frame,
            object=item.object,
            label=self._find_label(item),
            condition=item.condition,
            window=window,
            size=twin.silhouette_size_pixels,
            brightness=twin.brightness,
            contrast=twin.contrast,
            texture=twin.texture_correlation,
            visible=item.visible,
            overlap=pose_overlap,
            predictions=list(judge.predict(item.frame, twin, facts)),
        )

    def _make_facts(
        self, item: PhotographedObject, twin: rendering.Twin | None = None
    ) -> Any:
        """Return the facts from which a task finds the ground truth.

        Without a twin, before the object is rendered, they do not include what is
        visible of the object.
        """
        return tasks.Facts(
            item.object,
            self._find_label(item),
            compute_sight=None if twin is None else lambda: twin.visible_surface,
        )

    def _find_label(self, item: PhotographedObject) -> str:
        """Return the right label: from `names`, from the list, or the object's name."""
        return self._config.names.get(item.object) or item.label or item.object

    def _save_images(self, number: int, twin: rendering.Twin) -> None:
        """Store small images of the photograph and its twins."""
        for index, name in enumerate(list(twin.images)[:N_STORED_IMAGES]):
            file = make_image_name(number, index)
            self._context.run.write_file(file, encode_jpeg(twin.images[name]))

    def make_result(
        self, rows: Sequence[TwinRow], warnings: Sequence[str]
    ) -> TwinsResult:
        """Return the result: counts over all rows, and the pairs that disagree most.

        Args:
            rows: rows of all objects and models.
            warnings: warnings of the run.
        """
        task_title = self._judges[0].task.title
        table = []
        factors = []
        if rows:
            table = counting.make_table(rows, self.surroundings, task_title)
            factors = counting.explain_disagreement(rows, COMPOSED)
        overlaps = [row.overlap for row in rows if row.overlap is not None]
        worst = sorted(rows, key=rank_disagreement)[: self._config.pictures]
        pairs = [TwinPair(row=row, pictures=list_images(row.number)) for row in worst]
        return self._context.result(
            TwinsResult,
            photographs=self._config.photographs,
            model=",".join(judge.model.name for judge in self._judges),
            task=task_title,
            table=table,
            overlap=float(np.median(overlaps)) if overlaps else None,
            low_overlaps=sum(overlap < LOW_OVERLAP for overlap in overlaps),
            factors=factors,
            pairs=pairs,
            renders=self.n_renders,
            warnings=list(dict.fromkeys(warnings)),
        )


def rank_disagreement(row: TwinRow) -> tuple[bool, float]:
    """Return a key that sorts the rows with the largest disagreements first.

    Rows in which only one of the photograph and its composed twin is right come first.
    Within these, and within the others, a larger difference of the margins comes first.
    """
    twin = row.twin(COMPOSED)
    difference = abs(row.photo.margin - twin.margin)
    if not math.isfinite(difference):
        difference = math.inf  # so that NaN has a place in the order: the first
    agrees = row.photo.right == twin.right
    return agrees, -difference


def parse_frames(text: str | None) -> Callable[[str], bool]:
    """Return a function that returns whether a frame is selected, by its name.

    Args:
        text: names and ranges FIRST:LAST of the numbers that names end in, both
            included, separated by commas; None for all frames.

    Raises:
        InputError: an entry has a colon but is not a range.
    """
    if text is None:
        return lambda frame: True
    names = set()
    ranges = []
    for entry in filter(None, (part.strip() for part in text.split(","))):
        first, colon, last = entry.partition(":")
        if not colon:
            names.add(entry)
        elif first.isdecimal() and last.isdecimal():
            ranges.append((int(first), int(last)))
        else:
            raise InputError(
                f"frames: expected a name or a range such as 0:600, got {entry[:40]}"
            )
    return partial(_is_frame_selected, names, ranges)


def _is_frame_selected(
    names: Container[str], ranges: Sequence[tuple[int, int]], frame: str
) -> bool:
    """Return whether a frame is selected by its name or its number.

    Args:
        names: selected names and numbers.
        ranges: first and last of each selected range of numbers.
        frame: name of the frame.
    """
    # "scene/000012" and "000012.png" both have the number "000012".
    number = frame.rpartition("/")[2].partition(".")[0]
    if frame in names or number in names:
        return True
    return number.isdecimal() and any(
        first <= int(number) <= last for first, last in ranges
    )


def make_row_name(number: int, model_index: int) -> str:
    """Return the key of a stored row, which is about one object and one model."""
    return f"twin {number} {model_index}"


def make_image_name(number: int, index: int) -> str:
    """Return the file name of an image of a row, relative to the run directory."""
    return f"images/twin-{number:06d}-{index}.jpg"


def list_images(number: int) -> list[str]:
    """Return the file names of all stored images of a row, the photograph first."""
    return [make_image_name(number, index) for index in range(N_STORED_IMAGES)]


def encode_jpeg(image: Tensor) -> bytes:
    """Return an image (H, W, 3) sRGB as a JPEG, `IMAGE_SIZE` pixels at its longer
    side.
    """
    levels = color.to_uint8(image.clamp(0.0, 1.0)).numpy()
    picture = Image.fromarray(levels)
    scale = IMAGE_SIZE / max(picture.size)
    size = (round(picture.width * scale), round(picture.height * scale))
    buffer = io.BytesIO()
    picture.resize(size, Image.Resampling.LANCZOS).save(buffer, "JPEG", quality=88)
    return buffer.getvalue()
