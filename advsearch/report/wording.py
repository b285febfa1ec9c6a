"""A summary (docs/answers.md) in plain words, for the final table and the report alike."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

from advsearch.report import phrases
from advsearch.settings import split_names

if TYPE_CHECKING:
    from advsearch.runs.results.base import ConditionRow, Formation, Interval, SharedWork, VerifiedRate

NO_INTERVAL = "no interval"


def short_name(value: Any) -> str:
    """Return the last part of a path, and a name as it is."""
    return PurePath(str(value)).name or str(value)


def value_text(value: Any) -> str:
    """Return a value of a parameter, or the ends of a part of its range."""
    if isinstance(value, (list, tuple)):
        return " to ".join(map(value_text, value))
    return f"{value:.4g}" if isinstance(value, float) else short_name(value)


def figure_value(value: float | str) -> str:
    """Return a value as figures write it; of a file, its name without folder and suffix."""
    if isinstance(value, str):
        return PurePath(value).stem if "/" in value else value
    return f"{value:.4g}"


def short_names(text: str) -> str:
    """Return the last parts of paths, of one or of several separated by commas: ``a.hdr, studio``."""
    return ", ".join(map(short_name, split_names(text)))


def interval_text(interval: Interval | None) -> str:
    """Return ``83-100 %`` for the interval of a rate."""
    return f"{phrases.percent_number(interval[0])}-{phrases.percent_number(interval[1])} %" if interval else NO_INTERVAL


def rate_text(rated: VerifiedRate) -> str:
    """Return ``20 of 20 fresh renders (95 % interval 83-100 %)``; and how many answers are not numbers."""
    nothing = f"in {rated.not_a_number} its answer is not a number" if rated.not_a_number else ""
    if nothing and not rated.successes:
        return f"none of {rated.trials} fresh renders: {nothing}"
    rate = f"{rated.successes} of {rated.trials} fresh renders (95 % interval {interval_text(rated.interval)})"
    return f"{rate}, and {nothing}" if nothing else rate


def no_numbers(count: int) -> str:
    """Return what a table adds to a rate where answers are not numbers."""
    return f", {count} not a number" if count else ""


def tally(what: str, number: int, trials: int, not_a_number: int = 0) -> str:
    """Return ``wrong in 20 of 20``; of answers that are not numbers, how many."""
    nothing = f"not a number in {not_a_number} of {trials}"
    if not not_a_number:
        return f"{what} in {number} of {trials}"
    return f"{what} in {number}, {nothing}" if number else nothing


def seconds_text(seconds: Any) -> str:
    """Return ``14.6 s``, ``3 min 5 s`` or ``2 h 10 min``."""
    if seconds is None:
        return "unknown"
    whole = round(float(seconds))
    if whole < 100:
        return f"{float(seconds):.1f} s"
    return f"{whole // 60} min {whole % 60} s" if whole < 6000 else f"{whole // 3600} h {whole % 3600 // 60} min"


def count(number: Any, thing: str) -> str:
    """Return ``1 step``, ``40 steps``."""
    return f"{number or 0} {thing}{'' if number == 1 else 's'}"


def workers_text(shared: SharedWork | None) -> str:
    """How many shared the work, and where their time went; empty where nothing was shared."""
    if shared is None:
        return ""
    told = [f"{shared.most} at most"]
    if shared.utilisation is not None:
        told.append(f"busy {phrases.percent(shared.utilisation)} of {seconds_text(shared.alive)}")
    told.append(f"loading took {seconds_text(shared.loading)}")
    counts = {"lost": shared.lost, "refused": shared.refused, "given out again": shared.retried}
    return ", ".join([*told, *(f"{number} {what}" for what, number in counts.items() if number)])


def formation_text(formation: Formation, gains: Mapping[str, float] | None = None) -> str:
    """Return the image formation: ``128 x 128 pixels, box filter, denoised (oidn), exposure 0 stops, gain 1.35``; gains
    of several scenes by their names."""
    height, width = formation.resolution
    denoised = "not denoised" if formation.denoiser == "none" else f"denoised ({formation.denoiser})"
    exposure = f"exposure {number_text(formation.exposure)} stops"
    made = f"{height} x {width} pixels, {formation.filter} filter, {denoised}, {exposure}"
    if formation.gain is not None:
        gain = f"gain {number_text(formation.gain)}"
    else:
        each = "; ".join(
            f"{', '.join(map(short_name, name.split(', ')))} {number_text(value)}"
            for name, value in (gains or {}).items()
        )
        gain = "a gain for each scene" + (f": {each}" if each else "")
    return f"{made}, sampler {formation.sampler}, {gain}"


def number_text(value: Any) -> str:
    """Return a value as text; a number with the digits that mean something to a reader."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def conditions_text(conditions: Sequence[ConditionRow]) -> str:
    """Return conditions in one phrase."""
    return " and ".join(one.text for one in conditions) or "everything that was looked at"
