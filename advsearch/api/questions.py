"""The questions that name everything they are about, as calls with every setting: `gap` and `region`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from advsearch.api.gap import gap_from_config
from advsearch.api.region import region_from_config
from advsearch.config import GapConfig, RegionConfig
from advsearch.engine.naming import options_of
from advsearch.progress import Progress
from advsearch.runs.results.gap import GapResult
from advsearch.runs.results.region import RegionResult

Named = str | Sequence[str] | Mapping[str, Mapping[str, Any] | None]
"""Controls by name; a mapping gives each name its settings."""


def gap(
    object: str | Path,
    model: str | Path = "reference",
    *,
    environment: str | Path | None = None,
    up: Literal["y", "z"] | None = None,
    set: Mapping[str, float | str | Sequence[float]] | None = None,
    exposure: float = 0.0,
    resolution: int | str | tuple[int, int] | None = None,
    labels: str | Path | None = None,
    label: str | int | Sequence[str] | None = None,
    task: str = "classification",
    controls: Named = "texture",
    texture_resolution: int | None = None,
    spp: int | Literal["auto"] | None = None,
    denoise: Literal["oidn", "none"] = "oidn",
    pixel_sampler: Literal["independent", "multijitter"] = "multijitter",
    seed: int = 0,
    threads: int | None = None,
    deterministic: bool = False,
    run: str | Path | None = None,
    overwrite: bool = False,
    epsilon: float | Mapping[str, float] | None = None,
    norm: Literal["linf", "l2"] | None = None,
    estimators: str | Mapping[str, str] | None = None,
    measure: Literal["no", "quick", "full"] = "quick",
    policy: str | Mapping[str, Any] = "auto",
    steps: int = 40,
    seconds: float | None = None,
    step_size: float | None = None,
    objective: str | None = None,
    target: str | int | Sequence[str] | None = None,
    minimise: bool = False,
    smallest: bool = False,
    over: Named = (),
    draws: int = 4,
    average: int = 200,
    specialise: bool = True,
    baseline: bool = True,
    verify_spp: int | None = None,
    trials: int | None = None,
    progress: Progress | None = None,
) -> GapResult:
    """Compare the worst configuration with the average, for each object and each control (docs/questions.md).

    The arguments are the settings of `advsearch gap` by the same names. The run is kept, in `run` or under runs/.

    Raises:
        InputError: anything that the caller can put right.
    """
    return gap_from_config(GapConfig(**options_of(locals(), GapConfig, ())), progress=progress)


def region(
    object: str | Path,
    model: str | Path = "reference",
    *,
    environment: str | Path | None = None,
    up: Literal["y", "z"] | None = None,
    set: Mapping[str, float | str | Sequence[float]] | None = None,
    exposure: float = 0.0,
    resolution: int | str | tuple[int, int] | None = None,
    labels: str | Path | None = None,
    label: str | int | Sequence[str] | None = None,
    task: str = "classification",
    controls: Named = "texture",
    texture_resolution: int | None = None,
    spp: int | Literal["auto"] | None = None,
    denoise: Literal["oidn", "none"] = "oidn",
    pixel_sampler: Literal["independent", "multijitter"] = "multijitter",
    seed: int = 0,
    threads: int | None = None,
    deterministic: bool = False,
    run: str | Path | None = None,
    overwrite: bool = False,
    around: str | None = None,
    vary: str | None = None,
    samples: int = 200,
    map: int = 0,
    verify_spp: int | None = None,
    progress: Progress | None = None,
) -> RegionResult:
    """Grow the box around a configuration in which the verdict stays what it is (docs/questions.md).

    The arguments are the settings of `advsearch region` by the same names. The run is kept, in `run` or under runs/.

    Raises:
        InputError: anything that the caller can put right.
    """
    return region_from_config(RegionConfig(**options_of(locals(), RegionConfig, ())), progress=progress)
