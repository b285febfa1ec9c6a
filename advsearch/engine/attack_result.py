"""The answer of an attack as Python has it: its summary, its pictures and its rows."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

from torch import Tensor

from advsearch.attacks import Ending, SearchResult
from advsearch.engine.attack_parts import AttackParts
from advsearch.engine.loading import Scene, load_scene
from advsearch.engine.naming import AnyModel
from advsearch.engine.objective import task_for
from advsearch.engine.rendering import Rendering, pictures_of, render
from advsearch.engine.turn import in_turn
from advsearch.errors import InputError
from advsearch.report.figures import new_axes, search_axes
from advsearch.report.markup import answer_html, side_by_side
from advsearch.report.shown import shown
from advsearch.runs import store
from advsearch.runs.export import to_pandas
from advsearch.runs.results.attack import (
    AttackSummary,
)
from advsearch.scene.settings import Given
from advsearch.settings import as_python

if TYPE_CHECKING:
    from typing_extensions import Unpack


class RenderKeywords(TypedDict, total=False):
    """What may be said of a picture, see `render`."""

    resolution: int | tuple[int, int] | None
    spp: int
    denoise: str
    sampler: str
    seed: int
    around: int | None
    aov: bool


@dataclass(frozen=True, eq=False, repr=False)
class AttackResult:
    """The answer of an attack.

    Attributes:
        summary: what `summary.json` holds.
        run: the run directory, or None if it was not kept.
        u: (d,) the configuration that was verified; the start where nothing was searched.
        clean: (H, W, 3) display-referred sRGB in [0, 1], 8-bit values: the clean configuration, as in the trial that
            the summary names; its `clean` has what the model says of it.
        adversarial: the same of `u`.
        artifacts: what the controls hand over of `u`, by name: the texture, say; (h, w, 3) sRGB in [0, 1].
        search: the search's own log and claim; None where nothing was searched, and of a run that was loaded.
        in_memory: the rows, where there is no run directory.
        parts: returns what the attack was asked with; None of a result that came from another process.
    """

    summary: AttackSummary
    run: Path | None
    u: Tensor
    clean: Tensor
    adversarial: Tensor
    artifacts: dict[str, Tensor]
    search: SearchResult | None
    in_memory: tuple[store.Row, ...] = ()
    parts: Callable[[], AttackParts] | None = None

    @property
    def found(self) -> bool:
        """Whether a verified configuration was found."""
        return self.summary.ending == Ending.FOUND.value

    @in_turn()
    def render(
        self,
        model: AnyModel | None = None,
        *,
        scene: Scene | str | Path | None = None,
        camera: str | Mapping[str, float] | None = None,
        settings: Given | None = None,
        **options: Unpack[RenderKeywords],
    ) -> Rendering:
        """Render the answer again, and ask a model what it sees.

        What the answer does not say is as the scene comes: conditions of `over` have their start.

        Args:
            model: None for the attack's own.
            scene: another one with the same object; None for the attack's own.
            camera: where it is seen from, ``{"azimuth": 130.0}``; or the name of one of the scene's cameras.
            settings: parameters of the scene to fix to other values, e.g. ``{"camera.azimuth": 130.0}``.
            **options: `resolution`, `spp`, `denoise`, `sampler`, `seed`, `around` and `aov`, as for `render`; by
                default as in the attack.

        Raises:
            TypeError: there is no such keyword.
            InputError: the answer sets one of `settings` itself, or has other numbers than the scene takes.
        """
        if self.parts is None:
            raise InputError(
                "render: expected a result of this session, got one from another process; load_run(FOLDER) has it "
                "with all that it needs"
            )
        if unknown := sorted(options.keys() - RenderKeywords.__annotations__):
            known = ", ".join(["model", "scene", "camera", "settings", *RenderKeywords.__annotations__])
            raise TypeError(f"render() got an unexpected keyword argument {unknown[0]!r}; it takes {known}")
        parts = self.parts()
        config = parts.config
        camera, settings = as_python(camera), as_python(settings)
        seen = parts.scene if scene is None else scene if isinstance(scene, Scene) else load_scene(scene)
        if isinstance(camera, Mapping):
            settings, camera = {**(settings or {}), **{f"camera.{name}": one for name, one in camera.items()}}, None
        if twice := sorted({*(settings or {})} & {*(self.summary.configuration or {})}):
            raise InputError(f"settings: the answer says what {twice[0]} is; leave it out")
        seen = seen.with_settings(settings) if settings else seen
        seen = replace(seen, description=seen.description.seen_by(camera)) if camera else seen
        own = pictures_of(config)
        return render(
            seen,
            parts.loaded[0] if model is None else model,
            task=parts.task if model is not None else task_for(parts.task, parts.loaded[0]),
            label=config.label,
            controls=parts.controls,
            at=self.u,
            **{**own, **options},
        )

    def __getstate__(self) -> dict[str, Any]:
        """What is pickled: not what only this session has."""
        return {**vars(self), "parts": None}

    def rows(self, kind: str | None = None) -> Iterator[store.Row]:
        """Yield every evaluated configuration, or those of one kind ("search", "verification", ...), in order."""
        if self.run is None:
            yield from (row for row in self.in_memory if kind in (None, row.kind))
            return
        with store.Store(self.run / store.NAME, read_only=True) as results:
            yield from results.rows(kind)

    def to_pandas(self, kind: str | None = None) -> Any:
        """Return these rows as a `pandas.DataFrame`: columns as in an export (docs/runs.md), units in its `attrs`.

        Raises:
            InputError: pandas is not installed.
        """
        return to_pandas(self.rows(kind))

    def plot(self, axes: Any = None) -> Any:
        """Draw the objective over the search's evaluations, and return the matplotlib axes.

        Args:
            axes: to draw on; None makes new ones.
        """
        axes = new_axes() if axes is None else axes
        searched = [row.objective for row in self.rows("search") if row.phase != "ranking"]
        search_axes({self.summary.policy: searched}, self.summary.objective, axes)
        return axes

    def __repr__(self) -> str:
        summary, run = self.summary, None if self.run is None else str(self.run)
        verified = f", verified {summary.brief}" if summary.verified else ""
        controls = ",".join(summary.controls)
        return f"AttackResult({summary.object!r}, {controls!r}, {summary.ending!r}{verified}, run={run!r})"

    def _repr_html_(self) -> str:
        pictures = {"clean": self.clean.numpy(), "adversarial": self.adversarial.numpy()}
        return answer_html(shown(self.summary), pictures)

    def _repr_png_(self) -> bytes:
        return side_by_side([self.clean.numpy(), self.adversarial.numpy()])
