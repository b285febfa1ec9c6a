"""Format numbers, results and predictions as text for sentences and tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

from advsearch.options import NOT_A_NUMBER, Outcome, get_outcome
from advsearch.runs.results import IN_PHOTOGRAPH, TwinMatch
from advsearch.settings import split_names

if TYPE_CHECKING:
    from advsearch.runs.results import (
        ConditionRow,
        ControlGroup,
        Estimate,
        Extent,
        Formation,
        Interval,
        SharedWork,
        TwinAgreement,
        TwinEvidence,
        VerifiedRate,
    )


CLASSIFICATION = "classification"
DETECTION = "detection"
SEGMENTATION = "segmentation"
DEPTH = "depth"
SIMILARITY = "similarity"
COMMAND = "command"
"""Tasks for whose predictions there are special phrases. Those of other tasks are
quoted.
"""

PLAIN_UNITS = ("", "1")
"""Units that are not written after a value."""

_MARGINS = {
    CLASSIFICATION: "how far the right prediction leads the wrong one, in logits",
    DETECTION: "how far the best right box is over the score that counts, in log-odds; "
    "below 0 where none is found",
    SEGMENTATION: "the lead of right classes at the pixel that decides, in logits; "
    "below 0 where too few are right",
    DEPTH: "the logarithm of the tolerance, less that of the factor by which the "
    "object's distance is off",
    SIMILARITY: "how far the right name leads the nearest wrong one, in logits",
    COMMAND: "1 less how many envelopes the action is from the clean one; below 0 "
    "outside of it",
}
_MARKS = {
    DETECTION: "Blue is the true box, orange what the model finds with a score that "
    "counts.",
    SEGMENTATION: "Blue is the true outline, orange the pixels to which the model "
    "gives a right class.",
    DEPTH: "Blue is the true outline, orange the object's pixels whose distance is "
    "right. Beside it is the inverse of "
    "the true distance, and of the model's: light is near.",
}
_GOALS = {
    "mislabel": "makes the model take {} for something else",
    "displace": "makes the model see {} elsewhere or in a loose box",
    "create": "makes the model see beside {} what is not there",
    "nearer": "makes the model judge {} nearer than it is",
    "farther": "makes the model judge {} farther than it is",
    "gone": "makes the model judge {} to be as far as what is behind it",
}
SUCCESS_ABOVE_ZERO = ("margin", "score", "vanish", *_GOALS)
"""Objectives that are positive exactly if the prediction is a success of the search."""

_UNITS = {
    "logits": ("margin", "log_odds", "pixel_margin"),
    "logarithm of a factor": ("nearer", "farther", "gone"),
    "log-odds": ("vanish", "mislabel", "displace", "create"),
    "nats": ("cross_entropy",),
    "lengths of the clean features": ("feature_distance",),
    "1 - cosine": ("distance",),
    "those of the tasks": ("each",),
}

MAX_DECIMALS = 4  # maximum number of decimals of a percentage
# Maximum number of decimals of a probability that a model outputs, as a percentage.
PROBABILITY_DECIMALS = 1
# Labels of the tasks that get no article in a sentence.
LABELS_WITHOUT_ARTICLE = ("background", "itself", "something else")
_OUTCOME_NAMES = {
    Outcome.MISSED: "missed",
    Outcome.LOOSE: "loose",
    Outcome.WRONG_CLASS: "of another class",
    Outcome.PHANTOM: "elsewhere",
}
"""Names of wrong outcomes after a count, as in "3 missed", the usual ones first."""

# Names of the outcome `LOOSE` by task.
_LOOSE_NAMES = {DETECTION: "in a loose box", SEGMENTATION: "in part"}

# Participles of all verbs with which `format_mistake` begins.
_PARTICIPLES = {
    "calls": "calling",
    "finds": "finding",
    "sees": "seeing",
    "takes": "taking",
    "judges": "judging",
    "predicts": "predicting",
    "commands": "commanding",
}
# A prediction of a model: `advsearch.tasks.Prediction`, or its fields in a result.
AnyPrediction = Any


def percent(fraction: float | None, max_decimals: int = MAX_DECIMALS) -> str:
    """Return ``83 %`` for 0.83. Only exactly 1 and 0 become 100 and 0."""
    return (
        "unknown"
        if fraction is None
        else f"{format_percent_number(float(fraction), max_decimals)} %"
    )


def format_percent_number(fraction: float, max_decimals: int = MAX_DECIMALS) -> str:
    """Return a fraction as a percentage without its sign.

    It is ``83`` for 0.83, ``4.6`` for 0.0459, ``0.02`` for 0.000211, and ``99.98`` for
    0.99979. Numbers are rounded to whole percents, except within five percent of 0 or
    100. There the text has as many decimals as are necessary to differ from 0 or 100,
    but at most `max_decimals`. A number that would still be rounded to 0 or 100 becomes
    ``under 0.0001`` or ``over 99.9999`` with four decimals.

    Args:
        fraction: the fraction, in [0, 1].
        max_decimals: number of decimals, at most.
    """
    # in percent, as all below
    value = 100.0 * fraction
    distance = min(value, 100.0 - value)  # from 0 or 100
    if distance >= 5.0 or distance <= 0.0:
        return f"{value:.0f}"
    # the position of the first decimal of the distance that is not 0
    # (0 or less if the distance is 1 or more)
    first_nonzero_decimal = -math.floor(math.log10(distance))
    decimals = min(max(1, first_nonzero_decimal), max_decimals)
    text = f"{value:.{decimals}f}".rstrip("0").rstrip(".")
    if text not in ("0", "100"):
        return text
    # Even with `max_decimals` it was rounded to 0 or 100.
    return _format_unreached_limit(text, decimals)


def _format_unreached_limit(limit: str, decimals: int) -> str:
    """Return a percentage that is too close to a limit to be told from it.

    Args:
        limit: the limit, "0" or "100".
        decimals: number of decimals with which the percentage is rounded to it.
    """
    last_digit = 10.0**-decimals  # such as 0.0001 for four decimals
    if limit == "0":
        return f"under {last_digit:.{decimals}f}"
    return f"over {100.0 - last_digit:.{decimals}f}"


def format_fraction_of(
    count: int, total: int, interval: tuple[float, float], share: float | None = None
) -> str:
    """Return a fraction with its interval and its total: ``12 % (9 to 16) of 340``.

    Args:
        count: number of cases that are counted.
        total: number of all cases.
        interval: lower and upper bound of the fraction.
        share: the fraction, if it is not count / total, such as a weighted one.
    """
    if not total:
        return "none of 0"
    low, high = map(format_percent_number, interval)
    fraction = count / total if share is None else share
    return f"{percent(fraction)} ({low} to {high}) of {total:,}"


def explain_repeats(name: str, repeats: int, units: int) -> str:
    """Return sentences for a sweep in which nothing is sampled at random.

    Then the repeats of a unit (such as a drive) differ in the noise of rendering alone,
    and are no independent predictions.

    Args:
        name: name of a unit, such as "drive".
        repeats: repeats of each unit.
        units: number of units.
    """
    if units == 1:
        return (
            f"Nothing is drawn: all {repeats} repeats are of one {name} and differ in "
            "noise alone. The shares are of "
            f"this one {name}; nothing is shown of others, so that there is no "
            f"interval over {name}s."
        )
    return (
        f"Nothing is drawn: the {repeats} repeats of each {name} differ in noise alone "
        "and count as one. Intervals "
        f"are over {units} {name}s."
    )


def add_article(name: str) -> str:
    """Return ``a mug``, ``an iron``."""
    return f"{'an' if name[:1].lower() in 'aeiou' else 'a'} {name}"


def format_paired_rates(run: str, pair: Any) -> str:
    """Return sentences about how often a model is right in the clean scene and in an
    adversarial scene.

    Args:
        run: name of the run that found the adversarial scene.
        pair: `PairedRates` of the clean scene and the adversarial one (`answer`). Its
            difference is adversarial minus clean, as a fraction.
    """
    clean = _format_accuracy(pair.clean)
    adversarial = _format_accuracy(pair.adversarial)
    return (
        f"{pair.model} is right in {clean} of the clean scene, and in {adversarial} "
        f"with the adversarial scene of {run}: "
        f"{_format_rate_difference(pair)}. "
        f"Right in the clean one alone are {pair.clean_only} pairs, "
        f"with the adversarial one alone {pair.adversarial_only}."
    )


def _format_rate_difference(pair: Any) -> str:
    """Return the difference of paired rates in points, with its interval.

    Args:
        pair: `PairedRates`, whose difference is a fraction.
    """
    lower, upper = (100.0 * bound for bound in pair.interval)
    interval = f"{lower:.0f} to {upper:.0f}"
    direction = "more"
    if pair.difference < 0:
        # The word "fewer" states the sign. The bounds are negated, and so swap places.
        interval = f"{-upper:.0f} to {-lower:.0f}"
        direction = "fewer"
    contains_zero = not (lower > 0.0 or upper < 0.0)
    doubt = "; that there is a difference is not shown" if contains_zero else ""
    return (
        f"{abs(100.0 * pair.difference):.0f} points {direction} "
        f"(95 % interval of pairs {interval}){doubt}"
    )


def _format_accuracy(predictions: Any) -> str:
    """Return ``12 of 20 (60 %, 95 % interval 36-81 %)`` for `CountedPredictions`."""
    return (
        f"{predictions.correct} of {predictions.configurations} "
        f"({percent(predictions.accuracy)}, 95 % interval "
        f"{format_interval(predictions.interval)})"
    )


def get_margin_meaning(task: str) -> str:
    return _MARGINS.get(task, "below 0 where the prediction is wrong")


def format_objective(objective: str) -> str:
    """Return an objective with its unit, for an axis: ``margin loss [logits]``."""
    name = get_objective_name(objective)
    for unit, objectives in _UNITS.items():
        if objective in objectives:
            return f"{name} [{unit}]"
    return name


def get_objective_name(objective: str) -> str:
    """Return the name of an objective for a reader.

    Objectives are maximized, and "margin" and "pixel_margin" are negatives of margins.
    So they are called "margin loss" and "margin loss of the pixels".
    """
    return {"margin": "margin loss", "pixel_margin": "margin loss of the pixels"}.get(
        objective, objective
    )


def get_marks_legend(task: str) -> str:
    return _MARKS.get(
        task, "Blue is true of the scene, orange is the model's prediction."
    )


def format_goal(objective: str, thing: str) -> str:
    """Return the goal of a search with an objective, as a clause: "makes the model
    miss this mug".
    """
    return _GOALS.get(objective, "makes the model miss {}").format(thing)


def format_prediction_cells(task: str, prediction: AnyPrediction) -> list[str]:
    """Return the two cells of a prediction in a table: the label, and a number.

    For instance ``["vase", "84 %"]`` and ``["no cup found", "best score of cup
    0.12"]``. The second cell is empty if there is no number.

    Args:
        task: name of the task, on which the name of the number depends.
        prediction: has the label, the probability and perhaps a payload.
    """
    label = prediction.label
    probability = prediction.probability
    payload = getattr(prediction, "payload", None)
    if task == COMMAND:
        return [label, (payload or {}).get("text", "")]
    if probability is None:
        return [label, ""]
    if task == SIMILARITY:
        return [label, _similarity_text(probability, payload)]
    if task == DETECTION:
        return _detection_cells(label, probability, payload)
    if task == SEGMENTATION:
        return [label, f"accuracy {percent(probability)}"]
    return [label, percent(probability, PROBABILITY_DECIMALS)]


def _similarity_text(probability: float, payload: Any) -> str:
    """Return how similar the image is to the best reference, and the rank of the right
    one.

    With reference images it is the probability of the best name. The rank is left out
    if the right name is the best. Without them, the image is compared with the clean
    one, and only the cosine is known.

    Args:
        probability: probability of the best reference.
        payload: data that the task stores: "cosine", and with reference images "rank",
            the rank of the right name among a number of "references".
    """
    text = percent(probability, PROBABILITY_DECIMALS)
    if not isinstance(payload, dict) or "cosine" not in payload:
        return text
    if "rank" not in payload:
        return f"cosine {payload['cosine']:.2f}"
    if payload["rank"] > 1:
        rank = f"{payload['rank']} of {payload['references']}"
        return f"{text}, right one at rank {rank}"
    return text


def _detection_cells(label: str, score: float, payload: Any) -> list[str]:
    """Return the cells of a detector's prediction: the label, and score and overlap.

    Args:
        label: the predicted label; "no cup" if the detector missed a cup.
        score: score of the box; if the object was missed, the best score of its class.
        payload: data that the task stores of the prediction, such as the overlap "iou".
    """
    outcome = get_outcome(payload)
    details = payload if isinstance(payload, dict) else {}
    if outcome is Outcome.MISSED:
        class_name = details.get("class", "it")
        # "no cup found"
        return [f"{label} found", f"best score of {class_name} {score:.2f}"]
    overlap = details.get("iou")
    if outcome is Outcome.LOOSE and isinstance(overlap, float):
        return [label, f"score {score:.2f}, overlap {overlap:.2f}"]
    return [label, f"score {score:.2f}"]


def format_prediction(task: str, prediction: AnyPrediction) -> str:
    """Return a prediction on one line.

    Examples are ``vase, 91 %`` for classification, ``no cup found (best score of cup
    0.12)`` for detection, and for segmentation ``accuracy over the object's pixels
    83 %, most often vase``, where "vase" is the most frequent label of these pixels.

    Args:
        task: name of the task.
        prediction: has the label, the probability and perhaps a payload.
    """
    label, number = format_prediction_cells(task, prediction)
    if not number:  # the model outputs a label only
        return label
    if task == DETECTION:
        return f"{label} ({number})"
    if task != SEGMENTATION:
        return f"{label}, {number}"
    return _format_segmentation(label, prediction)


def _format_segmentation(label: str, prediction: AnyPrediction) -> str:
    """Return a prediction of segmentation on one line.

    Args:
        label: the label that the prediction has in a table.
        prediction: has the accuracy as its probability, and perhaps a payload.
    """
    accuracy = f"accuracy over the object's pixels {percent(prediction.probability)}"
    outcome = get_outcome(getattr(prediction, "payload", None))
    if outcome is Outcome.MISSED:
        return f"{label} found, {accuracy}"
    if outcome is Outcome.LOOSE:
        return f"{label}, {accuracy}"
    return f"{accuracy}, most often {label}"


# Heads of the columns of `format_thing_rows`, after that of the name.
VISIBLE_HEADS = ("seen", "box", "distance")


def format_thing_rows(things: Mapping[str, Any]) -> list[list[str]]:
    """Return the rows of a table of visible objects: name, visible fraction, box and
    distance.

    Args:
        things: the fields of a `runs.results.VisibleThing` by the name of the object.
    """
    rows = []
    for name, thing in things.items():
        if thing["box"] is None:
            visible = "nothing"
        elif thing["share"] is None:
            visible = "in part"
        else:
            visible = percent(thing["share"])
        box = "" if thing["box"] is None else ", ".join(map(str, thing["box"]))
        distance = "" if thing["distance"] is None else f"{thing['distance']:.1f} m"
        rows.append([name, visible, box, distance])
    return rows


def format_image_prediction_cells(task: str, prediction: AnyPrediction) -> list[str]:
    """Return the cells of a prediction for a picture: its label, and a number.

    Examples are ``["cup", "score 0.77"]`` for detection, and ``["mug", "91 %"]``. The
    second cell is empty if there is no number.
    """
    if prediction.probability is None:
        return [prediction.label, ""]
    if task == DETECTION:
        return [prediction.label, f"score {prediction.probability:.2f}"]
    share = percent(prediction.probability, PROBABILITY_DECIMALS)
    return [
        prediction.label,
        f"{share} of the picture" if task == SEGMENTATION else share,
    ]


def format_image_prediction(task: str, prediction: AnyPrediction) -> str:
    """Return a prediction for a picture on one line: ``cup (score 0.77)`` for
    detection, ``mug 91 %`` for other tasks.
    """
    label, number = format_image_prediction_cells(task, prediction)
    if task == DETECTION and number:
        return f"{label} ({number})"
    return f"{label} {number}".rstrip()


def format_mistake(
    task: str, thing: str, label: str, outcome: Outcome | None = None
) -> str:
    """Return a mistake of a model as a clause: ``calls this mug a vase``, ``finds no
    cup``.

    Args:
        task: task of the model.
        thing: phrase for the object in the clause, such as "this mug".
        label: label that the model predicts; "no cup" if the object was missed.
        outcome: outcome of the prediction; None if the task has no outcomes.
    """
    if label == NOT_A_NUMBER:
        return f"predicts nothing for {thing}, for its output is not a number"
    if outcome is Outcome.MISSED:
        return f"finds {label}"
    if outcome is Outcome.LOOSE and task == SEGMENTATION:
        return f"sees {thing}, but only in part"
    if outcome is Outcome.LOOSE:
        return f"sees {thing}, but in a loose box"
    if outcome is Outcome.PHANTOM:
        # the label is "mug elsewhere": "sees a mug elsewhere, and none where this mug
        # is"
        return f"sees {add_article(label)}, and none where {thing} is"
    return _format_wrong_label(task, thing, label)


def _format_wrong_label(task: str, thing: str, label: str) -> str:
    """Return the prediction of a wrong label as a clause.

    Args:
        task: task of the model.
        thing: phrase for the object in the clause.
        label: label that the model predicts.
    """
    if task == CLASSIFICATION:
        return f"calls {thing} {add_article(label)}"
    if task == COMMAND:
        return f"commands {add_article(label)}"
    if task == DEPTH:
        return f"judges {thing} {label}"
    if task in (DETECTION, SEGMENTATION, SIMILARITY):
        if label in LABELS_WITHOUT_ARTICLE and task != DETECTION:
            return f"takes {thing} for {label}"
        return f"takes {thing} for {add_article(label)}"
    return f'predicts "{label}" for {thing}'


def format_mistake_participle(
    task: str, label: str, outcome: Outcome | None = None
) -> str:
    """Return a mistake of a model with a participle: ``calling it a vase``.

    The sentence has named the object already, so that it is "it" here.

    Args:
        task: task of the model.
        label: label that the model predicts.
        outcome: outcome of the prediction, such as missed; None if the task has none.
    """
    verb, _, rest = format_mistake(task, "it", label, outcome).partition(" ")
    # 'predicts "vase" for it' becomes 'predicting "vase"'
    return f"{_PARTICIPLES[verb]} {rest.removesuffix(' for it')}"


def format_outcomes(outcomes: Mapping[str, int] | None, task: str = "") -> str:
    """Return how often each wrong outcome occurred: ``12 missed, 6 in a loose box``.

    Args:
        outcomes: counts by the name of the outcome; None if they are not known, for
            which the text is empty.
        task: task of the model, on which the name of a loose match depends.
    """
    names = dict(_OUTCOME_NAMES)
    if task in _LOOSE_NAMES:
        names[Outcome.LOOSE] = _LOOSE_NAMES[task]
    count_by_value = outcomes or {}
    texts = []
    for outcome, name in names.items():
        count = count_by_value.get(outcome.value, 0)
        if count:
            texts.append(f"{count} {name}")
    return ", ".join(texts)


def get_only_outcome(outcomes: Mapping[str, int] | None) -> Outcome | None:
    """Return the outcome of predictions that all have the same one.

    Args:
        outcomes: number of predictions by outcome; None if it is not known.

    Returns:
        The outcome; None if there are several, or none is known.
    """
    if outcomes is None or len(outcomes) != 1:
        return None
    (outcome,) = outcomes
    return get_outcome({"outcome": outcome})


NO_INTERVAL = "no interval"


def shorten_name(value: Any) -> str:
    """Return the last part of a path, and a name as it is."""
    return PurePath(str(value)).name or str(value)


def format_parameter_value(value: Any) -> str:
    """Return a value of a parameter, or the ends of a part of its range."""
    if isinstance(value, (list, tuple)):
        return " to ".join(map(format_parameter_value, value))
    return f"{value:.4g}" if isinstance(value, float) else shorten_name(value)


def format_figure_value(value: float | str) -> str:
    """Return a value as figures write it: a path becomes the name of the file without
    its suffix.
    """
    if isinstance(value, str):
        return PurePath(value).stem if "/" in value else value
    return f"{value:.4g}"


def shorten_names(text: str) -> str:
    """Return the names in a text with commas, without the folders of paths: ``a.hdr,
    studio`` for ``maps/a.hdr,studio``.
    """
    return ", ".join(map(shorten_name, split_names(text)))


def format_interval(interval: Interval | None) -> str:
    """Return ``83-100 %`` for the interval of a rate."""
    return (
        f"{format_percent_number(interval[0])}-{format_percent_number(interval[1])} %"
        if interval
        else NO_INTERVAL
    )


def format_rate(rated: VerifiedRate) -> str:
    """Return ``20 of 20 fresh renders (95 % interval 83-100 %)``.

    If the model's output was not a number in some trials, their count follows.
    """
    nan_text = (
        f"in {rated.not_a_number} its output is not a number"
        if rated.not_a_number
        else ""
    )
    if nan_text and not rated.successes:
        return f"none of {rated.trials} fresh renders: {nan_text}"
    rate = (
        f"{rated.successes} of {rated.trials} fresh renders (95 % interval "
        f"{format_interval(rated.interval)})"
    )
    return f"{rate}, and {nan_text}" if nan_text else rate


def format_rate_cells(rated: VerifiedRate | ControlGroup) -> list[str]:
    """Return a rate and its interval, as cells of a table: ``["20/20", "83-100 %"]``.

    Outputs that are not numbers are counted after the rate. The trials of an
    adversarial scene count successes, those of the clean scene right predictions.
    """
    # a `VerifiedRate` has successes, a `ControlGroup` right predictions
    count = rated.successes if hasattr(rated, "successes") else rated.correct
    nan_text = f", {rated.not_a_number} not a number" if rated.not_a_number else ""
    return [f"{count}/{rated.trials}{nan_text}", format_interval(rated.interval)]


def format_tally(event: str, number: int, trials: int, not_a_number: int = 0) -> str:
    """Return how often an event happened: ``wrong in 20 of 20``.

    If outputs of trials were not numbers, their count follows or stands alone, as in
    ``wrong in 12, not a number in 8 of 20``.
    """
    nan_text = f"not a number in {not_a_number} of {trials}"
    if not not_a_number:
        return f"{event} in {number} of {trials}"
    return f"{event} in {number}, {nan_text}" if number else nan_text


def format_seconds(seconds: Any) -> str:
    """Return ``14.6 s``, ``3 min 5 s`` or ``2 h 10 min``.

    Up to 100 seconds, and up to 100 minutes, the smaller unit is used alone, as in
    ``99.0 s`` and ``90 min 0 s``.
    """
    if seconds is None:
        return "unknown"
    total = round(float(seconds))
    if total < 100:
        return f"{float(seconds):.1f} s"
    minutes, rest = divmod(total, 60)
    if minutes < 100:
        return f"{minutes} min {rest} s"
    return f"{minutes // 60} h {minutes % 60} min"


def format_count(number: Any, noun: str) -> str:
    """Return ``1 step``, ``40 steps``."""
    return f"{number or 0} {noun}{'' if number == 1 else 's'}"


def format_workers(shared: SharedWork | None) -> str:
    """Return the number of workers and how they spent their time.

    The text is empty without workers. Times are summed over all workers, so they may
    exceed the time of the run.
    """
    if shared is None:
        return ""
    texts = [f"{shared.max_running} at most"]
    if shared.utilisation is not None:
        alive = format_seconds(shared.alive)
        texts.append(f"busy {percent(shared.utilisation)} of {alive}")
    texts.append(f"loading took {format_seconds(shared.loading)}")
    texts += _list_worker_events(shared)
    return ", ".join(texts)


def _list_worker_events(shared: SharedWork) -> list[str]:
    """Return the events that happened to workers, with their counts."""
    counts = {
        "lost": shared.lost,
        "refused": shared.refused,
        "given out again": shared.retried,
    }
    return [f"{count} {event}" for event, count in counts.items() if count]


def format_formation(
    formation: Formation, gains: Mapping[str, float] | None = None
) -> str:
    """Return how images were computed: ``128 x 128 pixels, box filter, denoised (oidn),
    exposure 0 stops, sampler multijitter, gain 1.35``.

    Args:
        formation: settings of the computation.
        gains: gains by scene, if each scene has its own. A scene is named by its object
            and environment, as in "mug, studio".
    """
    description = _describe_formation_without_gain(formation)
    if formation.gain is not None:
        return f"{description}, gain {format_number(formation.gain)}"
    description += ", a gain for each scene"
    gain_text = _format_gains(gains or {})
    return f"{description}: {gain_text}" if gain_text else description


def _format_gains(gains: Mapping[str, float]) -> str:
    """Return gains by scene as text: ``mug, studio 1.35; bowl, studio 1.2``."""
    gain_texts = []
    for scene, gain in gains.items():
        scene_name = ", ".join(map(shorten_name, scene.split(", ")))
        gain_texts.append(f"{scene_name} {format_number(gain)}")
    return "; ".join(gain_texts)


def format_number(value: Any) -> str:
    """Return a value as text; a float with four significant digits."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def format_conditions(conditions: Sequence[ConditionRow]) -> str:
    return " and ".join(condition.text for condition in conditions) or (
        "everything that was looked at"
    )


def format_extent(extent: Extent) -> str:
    """Return ``12 of 20 (60 %, 95 % interval 36-81 %)``."""
    if not extent.total:
        percentage = "none"
    elif extent.share is None:
        percentage = percent(extent.count / extent.total)
    else:  # a weighted share, for example
        percentage = percent(extent.share)
    return (
        f"{extent.count} of {extent.total} ({percentage}, 95 % interval "
        f"{format_interval(extent.interval)})"
    )


def format_estimate(estimate: Estimate | None, otherwise: str = "") -> str:
    """Return a number with its interval: ``.96 (.94 to .98)``."""
    if estimate is None:
        return otherwise
    text = _two_decimals(estimate.value)
    if estimate.interval is None:
        return text
    lower, upper = map(_two_decimals, estimate.interval)
    return f"{text} ({lower} to {upper})"


def _two_decimals(value: float) -> str:
    """Return ``.96`` for 0.96 and ``1.00`` for 1, without a 0 before the point."""
    text = f"{value:.2f}"
    rounds_to_1 = abs(value) >= 0.995
    return text if rounds_to_1 else text.replace("0.", ".", 1)


NO_TWINS = (
    "How far this holds for photographs was not measured. advsearch twins does; name its "
    "run in `twins`."
)


def _describe_formation_without_gain(formation: Formation) -> str:
    """Return how images were computed, without the gain of their brightness."""
    height, width = formation.resolution
    denoised = "not denoised"
    if formation.denoiser != "none":
        denoised = f"denoised ({formation.denoiser})"
    return (
        f"{height} x {width} pixels, {formation.filter} filter, {denoised}, "
        f"exposure {format_number(formation.exposure)} stops, "
        f"sampler {formation.sampler}"
    )


def format_twin_evidence(evidence: TwinEvidence) -> str:
    """Return, in one or two sentences, how far results on renders hold for photographs.

    A twin is a render of the scene in a photograph. So "wrong twins" in the row are
    renders for which the model is wrong.

    Args:
        evidence: the row of a run of twins that is most similar to the run of the
            result, and whether its object and surroundings are the same.
    """
    name = PurePath(evidence.run).name
    row = evidence.row
    if row is None:
        return (
            f"How far this holds for photographs was not measured: "
            f"{_TWIN_MISMATCHES[evidence.match].format(run=name)}."
        )
    return (
        f"Photographs ({name}; {_describe_twins(row, evidence)}): this model was "
        f"right or wrong on both in {format_estimate(row.agreement)} of "
        f"{format_count(row.pairs, 'pair')} of {format_count(row.frames, 'frame')}. "
        f"{_format_failing_twins(row)}"
    )


def _format_failing_twins(row: TwinAgreement) -> str:
    """Return, in a sentence, how often a failing render was a failing photograph."""
    failing = f"{row.both_wrong} of {row.wrong_twins}"  # of the wrong renders
    if row.wrong_where_twin_wrong is None:
        return (
            "Too few renders failed to state how often a failing render "
            f"is a failing photograph ({failing})."
        )
    return (
        "A failing render was a failing photograph in "
        f"{format_estimate(row.wrong_where_twin_wrong)} ({failing}); photographs failed "
        f"in {format_estimate(row.photo_wrong)} at all."
    )


def _describe_twins(row: TwinAgreement, evidence: TwinEvidence) -> str:
    """Return the objects and the surroundings of twins as text.

    Args:
        row: the row of the run of twins.
        evidence: whether its object and surroundings are those of the result.
    """
    objects = row.object or "all objects together"
    if not evidence.same_object:
        objects += ", not of this object"
    surroundings = f"in the environment {row.surroundings}"
    if row.surroundings == IN_PHOTOGRAPH:
        surroundings = "composed over their photographs"
    if not evidence.same_surroundings:
        surroundings += ", not in these surroundings"
    return f"{objects}; renders {surroundings}"


_TWIN_MISMATCHES = {
    TwinMatch.NOTHING: "{run} compared nothing",
    TwinMatch.OTHER_MODEL: "{run} is of another model",
    TwinMatch.OTHER_TASK: "{run} is of another task",
}
