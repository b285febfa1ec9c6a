"""What `render` needs to know."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

from pydantic import field_validator

from advsearch.config.scene import ControlsByName, SceneConfig
from advsearch.settings import setting, setting_as_in

PICTURE_SPP = 64
"""Samples a pixel of a picture that is made to be looked at."""
PICTURES = (".png", ".exr")
"""The pictures that can be written."""


class RenderConfig(SceneConfig):
    """Everything that decides what `render` does: pictures of a scene, and what the model says of them."""

    command: ClassVar[str] = "render"
    without: ClassVar[tuple[str, ...]] = ("run", "overwrite")

    controls: ControlsByName = setting_as_in(
        SceneConfig,
        "controls",
        default=dict,
        group="picture",
        description="what differs from the scene, separated by commas; a range stays where a search would start",
        expects="names of controls, or NAME={PARAMETER: VALUE}",
        min_length=None,
    )
    around: int | None = setting(
        None,
        "picture",
        "one sheet of so many views, from azimuths all around the object",
        otherwise="one view",
        unit="views",
        ge=2,
        le=64,
    )
    spp: int = setting(PICTURE_SPP, "picture", "samples per pixel", unit="samples", ge=1, le=65536)
    aov: str | None = setting(
        None,
        "picture",
        "write ground truth of each pixel, names separated by commas, as layers of an EXR beside the picture",
        "names among mask, depth, normal, uv, id",
        otherwise="none",
        metavar="NAMES",
    )
    out: str = setting(
        ...,
        "picture",
        "the file to write: a .png holds what the model sees, an .exr linear radiance times the gain",
        "the path of a .png or .exr file",
    )

    @field_validator("out", mode="before")
    @classmethod
    def _picture_file(cls, value: Any) -> Any:
        text = str(value) if isinstance(value, Path) else value
        if not isinstance(text, str) or "\0" in text or Path(text).suffix.lower() not in PICTURES:
            raise ValueError("not a picture")
        return text
