"""Regions over viewpoints: pictures are predicted while the box grows, and fresh samples of it are rendered."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from advsearch.engine import acceptance
from advsearch.predictors import surface_light
from advsearch.predictors.surface_light import arrangement, texels
from advsearch.questions.region import boxes, growing, region
from advsearch.questions.region.result import RegionConfig, RegionResult
from advsearch.runs.store import NAME as STORE
from advsearch.runs.store import Store
from stand_ins import Impatient, rows

pytestmark = [
    pytest.mark.medium,
    pytest.mark.island("advsearch.questions.region", "advsearch.predictors.surface_light"),
]

SMALL: dict[str, Any] = {
    "object": "mug", "resolution": 32, "controls": "camera", "vary": "camera.azimuth,camera.elevation", "samples": 8,
    "map": 3, "verify_spp": 16, "deterministic": True,
}  # fmt: skip


@pytest.fixture(autouse=True, scope="module")
def coarse() -> Iterator[None]:
    """Few texels, rays and pictures; light that always pays and is good enough."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(texels, "GROUND_TEXELS", 32)
        for module, name, value in (
            (arrangement, "OBJECT_TEXELS", 48), (arrangement, "RAYS_PER_TEXEL", 64), (acceptance, "CHECK_SPP", 4),
            (acceptance, "MIN_ALLOWED_LEVELS", 50.0), (acceptance, "MAX_MARGIN_BIAS", 50.0), (boxes, "MAX_PROBED", 20),
            (surface_light, "find_break_even", lambda *_: 1),
        ):  # fmt: skip
            patched.setattr(module, name, value)
        yield


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RegionResult]:
    """A run that nobody disturbed, and its result."""
    run = tmp_path_factory.mktemp("region") / "run"
    return run, region.run(RegionConfig(**SMALL, run=str(run)))


def test_viewpoints_are_predicted_and_fresh_samples_are_rendered(whole: tuple[Path, RegionResult]) -> None:
    """Rows say which: a predicted one has the four rays of a pixel, and no seed."""
    run, result = whole
    assert result.transport is not None and result.transport.method == "surface light"
    with Store(run / STORE, read_only=True) as store:
        found = [(kind, one.seed is None, one.spp) for kind in ("region", "map") for one in store.rows(kind)]
    predicted, checked = found.count(("region", True, 4)), found.count(("region", False, 16))
    assert result.samples == 8 and checked % 8 == 0 and checked >= 8
    assert predicted and found.count(("map", True, 4)) == 9 and len(found) == predicted + checked + 9
    assert result.renders["products"] == predicted + 9
    compared = 3 * acceptance.N_FIRST_VIEWS
    assert result.renders["verification"] == growing.CENTER_TRIALS + checked + compared


class Stopping(Impatient):
    """Presses Ctrl-C after so many pictures of carry_out."""

    def stage(self, name: str, total: int | None = None, *, hint: str = "", at_most: bool = False) -> None:
        self._searching = name == "growing the box"


def test_a_region_that_goes_on_ends_with_the_same_rows(whole: tuple[Path, RegionResult], tmp_path: Path) -> None:
    """Light is found again; pictures that were predicted are counted as such."""
    config = RegionConfig(**SMALL, run=str(tmp_path / "run"))
    assert region.run(config, progress=Stopping(9)).ending == "interrupted"
    result = region.run(config, resumed_directory=tmp_path / "run")
    assert rows(tmp_path / "run") == rows(whole[0]) and result.renders == whole[1].renders
