"""What `region` needs to know."""

from __future__ import annotations

from typing import ClassVar

from advsearch.config.attack import AttackConfig, DerivativeConfig
from advsearch.config.scene import SceneConfig
from advsearch.settings import setting, setting_as_in

FEWEST_SAMPLES = 8
"""With fewer, not even a box without exceptions has one verdict in more than half of it, at the confidence of
`questions.region.carry_out.GrownBox.interval`."""


class RegionConfig(SceneConfig):
    """Everything that decides what `region` does: the box around a configuration in which the verdict stays."""

    command: ClassVar[str] = "region"
    without: ClassVar[tuple[str, ...]] = ("spp",)

    around: str | None = setting(
        None,
        "region",
        "a run whose answer is the centre; it brings scene, model and controls with it",
        "the name or the folder of a run",
        otherwise="the scene as it is",
    )
    vary: str | None = setting(
        None,
        "region",
        "the parameters in which the box grows, separated by commas",
        "names such as pose.yaw,camera.elevation",
        otherwise="all that the controls search, up to eight",
    )
    samples: int = setting(
        200, "region", "fresh samples that check the box", unit="renders", ge=FEWEST_SAMPLES, le=1_000_000
    )
    map: int = setting(
        0,
        "region",
        "side of the map of the margin, where there are two parameters; 0 for none",
        unit="points",
        ge=0,
        le=512,
    )
    specialise: bool = setting_as_in(
        DerivativeConfig,
        "specialise",
        group="region",
        description="predict pictures from new viewpoints while the box grows, and those of the map",
        switched="render every picture",
    )
    verify_spp: int | None = setting_as_in(AttackConfig, "verify_spp", group="region", description="samples per pixel")


CONFIG = RegionConfig
