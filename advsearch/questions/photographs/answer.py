"""How renderings and photographs of the same configurations agree."""

from __future__ import annotations

from pydantic import Field

from advsearch.runs.results.base import Fields, Interval

PHOTO, LOOSE_PHOTO = "photo", "loose photo"
"""Kinds of rows in a run's store: photographs that were aligned with a rendering, and ones that were with none."""


FOLDER = "photos"
"""Where photographs are, in `images/` of the run."""


class PhotographedRendering(Fields):
    """One rendering, what one model says of it, and of the photographs that were aligned with it."""

    rendering: str = Field(description="its name: the number of a sweep's picture, or adversarial, clean, ...")
    model: str
    label: str = Field(description="what the model answers to the rendering")
    rendering_right: bool = Field(description="whether that is right")
    photos: int
    photos_right: int = Field(description="photographs in which the model is right")
    agreeing: int = Field(description="photographs that are right where the rendering is, or wrong where it is")
    interval: Interval = Field(description="95 % Clopper-Pearson interval of the share that agrees")
    labels: list[str] = Field(description="what the model answers to each photograph, in their order")
    files: list[str] = Field(description="their files in images/photos/, likewise")


class PhotoAgreement(Fields):
    """The table of agreement between renderings and reality: counts of photographs, each by each model."""

    photos: int
    right_right: int = Field(description="right in the rendering, right in the photograph")
    right_wrong: int = Field(description="right in the rendering, wrong in the photograph")
    wrong_right: int = Field(description="wrong in the rendering, right in the photograph")
    wrong_wrong: int = Field(description="wrong in the rendering, wrong in the photograph")
    agreement: float | None = Field(description="share of the photographs that agree; null where there are none")
    interval: Interval | None = Field(
        description="95 % Clopper-Pearson interval of the agreement, as if all photographs were independent"
    )
    renderings: list[PhotographedRendering]
