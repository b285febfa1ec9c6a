"""Settings and result of `twins`, and the view of its result."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from pydantic import Field, JsonValue, field_validator

from advsearch.extend import (
    Config,
    SceneConfig,
    results,
    setting,
    setting_as_in,
    settings,
    views,
    wording,
)

PHOTOGRAPH = "photograph"
COMPOSED = results.IN_PHOTOGRAPH
HOLE = results.WITHOUT_OBJECT
CLASSIFIER_MARGIN = 0.25
DETECTOR_MARGIN = 1.5
"""How far a window extends beyond the object's box, as a fraction of its longer side.
"""
MAX_TEXT_PAIRS = 5  # number of pairs that a terminal lists


class TwinsConfig(Config):
    """Settings of `twins`: the photographs, the model, and how twins are made."""

    command: ClassVar[str] = "twins"
    clashes: ClassVar[tuple[settings.Clash, ...]] = tuple(
        clash for clash in SceneConfig.clashes if clash.setting == "overwrite"
    )
    camera: ClassVar[str | None] = None
    controls: ClassVar[tuple[str, ...]] = ()

    photographs: str = setting(
        ...,
        "twins",
        "photographs of the objects, with their poses and meshes",
        "a folder in BOP's form, or a .csv, .json or .yaml list",
    )
    names: dict[str, str] = setting(
        dict,
        "twins",
        "the right label of an object, such as obj_000005=can; may be repeated",
        "OBJECT=LABEL",
        flag="--name",
        metavar="OBJECT=LABEL",
    )
    environment: str | None = setting_as_in(
        SceneConfig,
        "environment",
        group="twins",
        description="the environment that surrounds the object in the other twin",
        otherwise="room",
    )
    light: str = setting(
        "studio",
        "twins",
        "the environment that lights the twin in the photograph",
        "the name of an environment, or a .hdr or .exr file",
    )
    margin: float | None = setting(
        None,
        "twins",
        "how far the window reaches beyond the object's box, as a fraction of its "
        "longer side",
        otherwise=f"{CLASSIFIER_MARGIN}, or {DETECTOR_MARGIN} for tasks that look for "
        "the object",
        ge=0.0,
        le=100.0,
    )
    visible: float = setting(
        0.1,
        "twins",
        "fraction of an object that must be visible, where the data states it",
        ge=0.0,
        le=1.0,
    )
    match: bool = setting(
        True,
        "twins",
        "give twins the noise and the blur of their photographs, where they can be "
        "measured",
        flag="--no-match",
        switched="leave twins without the noise and the blur of their photographs",
    )
    frames: str | None = setting(
        None,
        "twins",
        "which frames are used, separated by commas; FIRST:LAST is a range of numbers",
        "names of frames, or ranges of their numbers such as 0:600",
        otherwise="all",
    )
    pictures: int = setting(
        12,
        "twins",
        "number of pairs that are displayed, the worst disagreements first",
        unit="pairs",
        ge=0,
        le=1000,
    )
    spp: int = setting(
        32,
        "twins",
        "samples per pixel of a twin",
        unit="samples",
        ge=1,
        le=65536,
    )
    model: str = setting_as_in(
        SceneConfig,
        "model",
        description="the model, or several that take pictures of one size, separated "
        "by commas",
    )
    labels: str | None = setting_as_in(SceneConfig, "labels")
    prompt: str | None = setting_as_in(SceneConfig, "prompt")
    value_range: tuple[float, float] | None = setting_as_in(SceneConfig, "value_range")
    ask: dict[str, float] = setting_as_in(SceneConfig, "ask")
    task: str | dict[str, JsonValue] = setting_as_in(SceneConfig, "task")
    seed: int = setting_as_in(SceneConfig, "seed")
    threads: int | None = setting_as_in(SceneConfig, "threads")
    run: str | None = setting_as_in(SceneConfig, "run", otherwise="runs/NAME-twins-NNN")
    overwrite: bool = setting_as_in(SceneConfig, "overwrite")

    _named = settings.text_validator(
        "photographs", "model", "environment", "light", "run", "frames"
    )

    @field_validator("labels", mode="before")
    @classmethod
    def _labels_as_text(cls, value: Any) -> Any:
        """Turn a list of labels or a path into the text that a command line has."""
        return settings.to_text(value, several=True)

    @field_validator("names", mode="before")
    @classmethod
    def _names_as_texts(cls, value: Any) -> Any:
        """Turn names and labels that YAML reads as numbers into texts."""
        if isinstance(value, Mapping):
            return {str(name): str(label) for name, label in value.items()}
        return value

    @property
    def environment_name(self) -> str:
        """The environment that surrounds the object in the other twin."""
        return self.environment or "room"

    @property
    def task_name(self) -> str:
        """The name of the task."""
        return self.task if isinstance(self.task, str) else str(self.task["name"])

    @property
    def n_used_threads(self) -> int | None:
        return self.threads

    @property
    def run_name_words(self) -> tuple[str, ...]:
        return Path(self.photographs).stem, self.command


class TwinPrediction(results.Fields):
    """The prediction of a model about an image."""

    surroundings: str = Field(
        description="name of the image: the photograph, or a twin"
    )
    label: str
    probability: float | None
    right: bool
    margin: results.JsonFloat = Field(
        description="score of the right prediction minus that of the best wrong one; "
        "negative if wrong"
    )
    payload: results.Payload = Field(
        default=None, description="further output, such as boxes; absent without any"
    )


class TwinRow(results.Fields):
    """An object in a photograph, and its twins."""

    number: int
    model: str
    photograph: str
    frame: str = Field(description="independent unit that the photograph belongs to")
    object: str
    label: str = Field(description="the right label")
    condition: str
    window: tuple[int, int, int, int] = Field(
        description="x, y, width and height in pixels of what the model is run on"
    )
    size: float = Field(description="square root of the silhouette's area in pixels")
    brightness: float = Field(
        description="mean of the twin minus that of the photograph, where the object "
        "is; in sRGB, from -1 to 1"
    )
    contrast: float = Field(
        description="standard deviation of the photograph around the object, in sRGB"
    )
    texture: float | None = Field(
        description="correlation of the luminance of twin and photograph where the "
        "object is, from -1 to 1; null if one of them is uniform"
    )
    visible: float | None = Field(description="visible fraction; null if unknown")
    overlap: float | None = Field(
        description="intersection over union of the twin's silhouette and the data's "
        "mask, or of their boxes; null if the data has neither"
    )
    predictions: list[TwinPrediction]

    @property
    def photo(self) -> TwinPrediction:
        """The prediction about the photograph."""
        return self.twin(PHOTOGRAPH)

    def twin(self, surroundings: str) -> TwinPrediction:
        """Return the prediction about the image with these surroundings."""
        for prediction in self.predictions:
            if prediction.surroundings == surroundings:
                return prediction
        raise KeyError(surroundings)


class FactorPart(results.Fields):
    """How often photograph and twin disagree in a part of the values of a factor."""

    factor: str
    unit: str
    lower: float
    upper: float
    pairs: int
    disagreeing: int
    rate: results.Estimate


class TwinPair(results.Fields):
    """A pair that is displayed, with its images."""

    row: TwinRow
    pictures: list[str] = Field(description="files: the photograph, then its twins")


class TwinsResult(views.InNotebook, results.RunResult):
    """How far predictions about renders hold for photographs of the same objects."""

    command: ClassVar[str] = "twins"

    photographs: str = Field(description="the folder or list of photographs")
    model: str
    task: str = Field(description="the task that evaluates the predictions")
    table: list[results.TwinAgreement]
    overlap: float | None = Field(
        description="median overlap of silhouettes; null if the data has none"
    )
    low_overlaps: int = Field(description="number of pairs with an overlap below 0.8")
    factors: list[FactorPart] = Field(
        description="how often twins in the photograph disagree, by properties that "
        "may explain it"
    )
    pairs: list[TwinPair]
    renders: int
    warnings: list[str] = Field(description="remarks that limit what the result shows")

    @property
    def outcome_summary(self) -> str:
        row = find_row(self.table, COMPOSED)
        return "" if row is None else f"agree {wording.percent(row.agreement.value)}"


TABLE_NOTE = (
    "Intervals are 95 %, over frames and not over pairs. Kappa (Cohen's) is "
    "of right and wrong, 0 for agreement by chance; of margins it is Spearman's rank "
    "correlation with those of the photographs. Where a photograph or a twin is wrong "
    "in fewer than five frames, no number is stated, only the counts."
)


def find_row(
    table: Sequence[results.TwinAgreement], surroundings: str
) -> results.TwinAgreement | None:
    """Return the row of all objects and conditions; None if there is none."""
    for row in table:
        if row.surroundings == surroundings and not row.object and not row.condition:
            return row
    return None


def format_conditional(row: results.TwinAgreement) -> str:
    """Return how often the photograph is wrong where the twin is."""
    counts = f"{row.both_wrong} of {row.wrong_twins}"
    if row.wrong_where_twin_wrong is None:
        return f"too few wrong: {counts}"
    return f"{wording.format_estimate(row.wrong_where_twin_wrong)}, {counts}"


# heads of the tables; `_make_agreement_cells` and `_make_photograph_cells` have their
# order
HEADS = (
    "model sees",
    "pairs",
    "right",
    "agrees",
    "kappa",
    "margins",
    "photograph wrong where this is",
)


def _make_agreement_cells(row: results.TwinAgreement, name: str) -> list[str]:
    """Return the cells of a row under `HEADS`, about the twins of one surroundings.

    The rows about photographs are made by `_make_photograph_cells`.
    """
    agreement = wording.format_estimate(row.agreement)
    if row.boxes is not None:
        agreement += f"; boxes {wording.format_estimate(row.boxes)}"
    return [
        name,
        str(row.pairs),
        wording.format_estimate(row.twin_right),
        agreement,
        wording.format_estimate(row.kappa, "too few wrong"),
        wording.format_estimate(row.margins),  # rank correlation of the margins
        format_conditional(row),
    ]


def _make_photograph_cells(row: results.TwinAgreement, name: str) -> list[str]:
    """Return the cells about photographs; those that compare twins are empty."""
    no_agreement = ["", "", ""]
    return [
        name,
        str(row.pairs),
        wording.format_estimate(row.photo_right),
        *no_agreement,
        f"wrong at all: {wording.format_estimate(row.photo_wrong)}",
    ]


def make_agreement_part(table: Sequence[results.TwinAgreement]) -> views.ResultPart:
    """Return the table over all objects and conditions.

    For each model there is a row about the photographs, and then one for each of the
    surroundings of twins.
    """
    totals = _list_totals(table)
    models = {row.model for row in totals}
    rows = []
    models_above = set()
    for total in totals:
        prefix = f"{total.model}: " if len(models) > 1 else ""
        if total.model not in models_above:
            models_above.add(total.model)
            rows.append(_make_photograph_cells(total, f"{prefix}{PHOTOGRAPH}"))
        name = f"{prefix}{_name_surroundings(total)}"
        rows.append(_make_agreement_cells(total, name))
    return views.ResultPart(
        "How far twins hold", column_heads=HEADS, rows=rows, note=TABLE_NOTE
    )


def _list_totals(
    table: Sequence[results.TwinAgreement],
) -> list[results.TwinAgreement]:
    """Return the rows over all objects and conditions."""
    return [row for row in table if not row.object and not row.condition]


def _name_surroundings(row: results.TwinAgreement) -> str:
    """Name the twin of a row in a sentence."""
    if row.surroundings in (COMPOSED, HOLE):
        return row.surroundings
    return f"twin in the environment {row.surroundings}"


def _make_group_parts(
    table: Sequence[results.TwinAgreement],
) -> Iterator[views.ResultPart]:
    """Yield the tables by object and by condition."""
    surroundings = list(dict.fromkeys(row.surroundings for row in table))
    for kind in ("object", "condition"):
        for name in surroundings:
            title = f"By {kind}: {name}"
            heads = (kind, *HEADS[1:])
            rows = _list_group_cells(table, kind, name)
            yield views.ResultPart(
                title, column_heads=heads, rows=rows, folded=True, only_medium="page"
            )


def _list_group_cells(
    table: Sequence[results.TwinAgreement], kind: str, surroundings: str
) -> list[list[str]]:
    """Return the rows of the table by object or by condition, for some surroundings.

    Args:
        table: counts of all groups.
        kind: "object" or "condition".
        surroundings: name of the twins' surroundings.
    """
    several = len({row.model for row in table}) > 1
    rows = []
    for row in table:
        group = getattr(row, kind)
        if group and row.surroundings == surroundings:
            group = f"{row.model}: {group}" if several else group
            rows.append(_make_agreement_cells(row, group))
    return rows


def _make_factor_part(result: TwinsResult) -> views.ResultPart:
    """Return the table of how often twins disagree, by parts of each factor."""
    return views.ResultPart(
        "What goes with disagreement",
        column_heads=("", "from", "disagree", "rate"),
        rows=[_make_factor_cells(part) for part in result.factors],
        note="Of twins in the photograph. Each factor is cut into parts with as many "
        "pairs; a part that stands out is a hint, and no cause.",
    )


def _make_factor_cells(part: FactorPart) -> list[str]:
    """Return the cells of a part of a factor: its range, and how many disagree."""
    bounds = f"{_format_factor(part.lower)} to {_format_factor(part.upper)}"
    return [
        part.factor,
        f"{bounds} {part.unit}".strip(),
        f"{part.disagreeing} of {part.pairs}",
        wording.format_estimate(part.rate),
    ]


def _format_factor(value: float) -> str:
    """Format a value of a factor, such as a size in pixels or a fraction."""
    return f"{value:.0f}" if abs(value) >= 10.0 else f"{value:.2f}"


def make_twins_view(result: TwinsResult) -> views.ShownResult:
    """Return the table, what explains disagreement, and the pairs."""
    facts = {
        "photographs": result.photographs,
        "silhouettes": _describe_overlap(result),
    }
    about = [result.photographs, result.model]
    if not result.table:
        return views.ShownResult(
            "Interrupted before anything was compared.",
            facts=facts,
            about=about,
            says_interrupted=True,
        )
    sections = [make_agreement_part(result.table), *_make_group_parts(result.table)]
    sections += [_make_factor_part(result), *_make_pair_parts(result)]
    return views.ShownResult(summarize_twins(result.table), sections, facts, about)


def _describe_overlap(result: TwinsResult) -> str:
    """Describe how well silhouettes overlap; empty if the data has none."""
    if result.overlap is None:
        return ""
    text = f"median overlap {result.overlap:.2f}"
    if result.low_overlaps:  # see `carry_out.LOW_OVERLAP`
        text += f"; under .8 in {result.low_overlaps}"
    return text


def summarize_twins(table: Sequence[results.TwinAgreement]) -> str:
    """Summarise how far twins hold in sentences, model by model."""
    composed_rows = [row for row in _list_totals(table) if row.surroundings == COMPOSED]
    if len(composed_rows) == 1:
        return summarize_composed(composed_rows[0])
    texts = [f"{row.model}: {summarize_composed(row)}" for row in composed_rows]
    return " ".join(texts) or "Nothing was compared."


def summarize_composed(composed: results.TwinAgreement) -> str:
    """Summarize how often twins in photographs and the photographs agree.

    Args:
        composed: counts of one model for objects rendered into the photographs.
    """
    agreement = wording.format_estimate(composed.agreement)
    counts = _format_counts(composed)
    return (
        f"Twins in the photograph agree with it in {agreement} of {counts}. "
        f"{_describe_wrong_twins(composed)}"
    )


def _format_counts(row: results.TwinAgreement) -> str:
    """Format how many pairs and frames a row counts: ``40 pairs of 12 frames``."""
    return (
        f"{wording.format_count(row.pairs, 'pair')} of "
        f"{wording.format_count(row.frames, 'frame')}"
    )


def _describe_wrong_twins(composed: results.TwinAgreement) -> str:
    """Describe how often photographs are wrong where their twins are."""
    if composed.wrong_where_twin_wrong is not None:
        return (
            f"Where a twin is wrong, the photograph is wrong in "
            f"{wording.format_estimate(composed.wrong_where_twin_wrong)}; at all, in "
            f"{wording.format_estimate(composed.photo_wrong)}."
        )
    return (
        f"{composed.wrong_twins} of them are wrong, too few to state what a failing "
        "twin says of its photograph."
    )


def _make_pair_parts(result: TwinsResult) -> Iterator[views.ResultPart]:
    """Yield the displayed pairs, for a terminal and for a page."""
    title = "Worst disagreements first"
    has_several_models = "," in result.model
    lines = []
    groups = []
    for pair in result.pairs:
        row = pair.row
        name = f"{row.object} in {row.frame}"
        if has_several_models:
            name = f"{row.model}, {name}"
        texts = [
            f"{image.surroundings}: {_describe_prediction(image)}"
            for image in row.predictions
        ]
        lines.append(f"{name}: {'; '.join(texts)}")
        groups.append(_list_pair_pictures(pair, name, texts))
    yield views.ResultPart(title, lines[:MAX_TEXT_PAIRS], only_medium="text")
    yield views.ResultPart(title, pictures=groups, only_medium="page")


def _list_pair_pictures(
    pair: TwinPair, name: str, texts: Sequence[str]
) -> list[views.Picture]:
    """Return the stored images of a pair with their captions.

    Args:
        pair: the pair.
        name: name of the pair, with which the first caption begins.
        texts: what is predicted about each image.
    """
    # The images of the last surroundings may not be stored.
    captions = list(texts[: len(pair.pictures)])
    if captions:
        captions[0] = f"{name}, {pair.row.size:.0f} pixels. {captions[0]}"
    return list(map(views.Picture, pair.pictures, captions))


def _describe_prediction(image: TwinPrediction) -> str:
    """Describe the prediction about an image: its label, verdict and margin."""
    verdict = "right" if image.right else "wrong"
    return f"{image.label or 'nothing'}, {verdict}, margin {image.margin:+.1f}"


def make_twins_claims(result: TwinsResult) -> Iterator[views.Claim]:
    """Yield a claim for each model and each of the surroundings."""
    for row in _list_totals(result.table):
        # The agreement is a mean over frames, so this count of pairs is approximate.
        n_agreeing = round(row.agreement.value * row.pairs)
        extent = results.Extent.from_count(
            "pairs of photograph and twin that agree",
            n_agreeing,
            row.pairs,
            row.agreement.interval,
            row.agreement.value,
        )
        statement = (
            f"{row.model}, {_name_surroundings(row)}: agrees with the photograph in "
            f"{wording.format_estimate(row.agreement)} of {_format_counts(row)}; "
            f"photographs wrong where it is wrong: {format_conditional(row)}."
        )
        yield views.Claim(kind="measured", statement=statement, extent=extent)
