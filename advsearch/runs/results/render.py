"""The result of `render`."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from advsearch.runs.results.base import Fields, Formation, Result


class ClassAnswer(Fields):
    """One answer to a picture."""

    label: str = Field(description="in words")
    index: int | None = Field(description="its number among the model's classes; null where there are none")
    probability: float | None = Field(description="null where the model gives none")


class ViewAnswers(Fields):
    """What the model says of one view."""

    azimuth: float = Field(description="of the camera, degrees")
    answers: list[ClassAnswer] = Field(description="the likeliest first")


class MeshUp(Fields):
    """The axis of a mesh file that was taken for up, and why."""

    axis: str
    reason: str


class RenderResult(Result):
    """A picture of a scene, and what the model says of it."""

    command: ClassVar[str] = "render"

    out: str = Field(description="the file that was written")
    answered: str | None = Field(
        default=None, description="that with boxes and masks drawn in; absent where the task draws none"
    )
    size: tuple[int, int] = Field(description="of the file, [height, width] in pixels")
    object: str
    environment: str
    model: str
    task: str = Field(description="what judges the answers")
    spp: int = Field(description="samples a pixel")
    image_formation: Formation
    up: MeshUp | None = Field(description="null for an object without a mesh file")
    views: list[ViewAnswers]
    warnings: list[str] = Field(description="sentences that a reader has to know")
