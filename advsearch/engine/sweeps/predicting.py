"""What predicts pictures of a sweep, for each *group* of pictures that have the rest in common, and by the group alone,
so that a sweep that was stopped goes on with the same. Some are traced beside; where predicted ones are too far off,
the group is rendered. Where the camera alone differs, that is light on surfaces (docs/surface-light.md)."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks.draws import Product
from advsearch.engine.acceptance import CHECK_SPP, VIEWS, ComparedView, Deviation, MarginOf, compared, view_of
from advsearch.engine.sweeps.axes import Axis
from advsearch.engine.sweeps.points import Points
from advsearch.files import scaled
from advsearch.runs.results.attack import LinearTransport, PredictionError
from advsearch.scene.assembly import ON_PICTURE
from advsearch.scene.mitsuba_backend.surface import RAYS
from advsearch.scene.renderer import Renderer
from advsearch.scene.surface.arrangement import CAMERAS, COLOR, FREE, MAP, Light
from advsearch.scene.surface.renderer import SurfaceRenderer, varied, why_not_kept
from advsearch.scene.transport.matrix import MOST_BYTES

PAYS = 2.0
"""Times the samples that a prediction takes, comparisons included, that a group has to take rendered, for it to pay."""


@dataclass(frozen=True)
class Groups:
    """How the pictures of a scene fall into groups: whether they may differ along each axis of the grid (`within`), and
    in what is `drawn`. The frames of a drive, on the axis `frames`, have one draw."""

    grid: Product
    samples: int
    within: tuple[bool, ...]
    drawn: bool
    frames: int | None = None

    @property
    def _free(self) -> tuple[bool, ...]:
        """Of every axis, whether a group goes along it."""
        if self.drawn:
            return self.within
        return tuple(within and axis == self.frames for axis, within in enumerate(self.within))

    @property
    def _draws(self) -> int:
        """Draws at a point of the grid that are in different groups."""
        return 1 if self.drawn else self.samples

    @property
    def size(self) -> int:
        free = math.prod(size for size, free in zip(self.grid.sizes, self._free, strict=True) if free)
        return free * self.samples // self._draws

    @property
    def count(self) -> int:
        return self.grid.count * self.samples // self.size

    @property
    def at_once(self) -> int:
        """How many have to be held at once, so that none is made twice."""
        if True not in self._free:
            return 1
        first = self._free.index(True)
        later = zip(self.grid.sizes[first:], self._free[first:], strict=True)
        return self._draws * math.prod(size for size, free in later if not free)

    def group(self, number: int) -> int:
        """Return the number of the group of a picture of the scene."""
        place, sample = divmod(number, self.samples)
        found = 0
        for digit, size, free in zip(self.grid.digits(place), self.grid.sizes, self._free, strict=True):
            found = found if free else found * size + digit
        return found if self.drawn else found * self.samples + sample

    def member(self, number: int, place: int) -> int:
        point, sample = divmod(number, self.samples)
        if self.drawn:
            place, sample = divmod(place, self.samples)
        found = list(self.grid.digits(point))
        for axis in reversed(range(len(found))):
            if self._free[axis]:
                place, found[axis] = divmod(place, self.grid.sizes[axis])
        return self.grid.index(found) * self.samples + sample


@dataclass(frozen=True, eq=False)
class WantedPicture:
    """A picture that is wanted: its number in the scene, its configuration (d,), and the seed of its noise, if it is
    rendered."""

    number: int
    u: Tensor
    seed: int


@dataclass(frozen=True, eq=False)
class SweptPicture:
    """A picture (H, W, 3), sRGB in [0, 1]; the samples a pixel of what predicted it, 0 if it was rendered; and how many
    were traced for it, of the first of a group all that were traced for the group."""

    picture: Tensor
    predicted: int
    traced: int


@dataclass
class SweptPredictor(ABC):
    """Predicts pictures of one scene at one size; `before` it the other scenes have so many. Every picture is rendered
    for a `reason`, if there is one, which is empty where nothing moves that it follows, and in groups that are `left`
    since predictions were too far off. `score` is the margin of a picture."""

    way: ClassVar[str]
    samples: ClassVar[int]
    """Samples a pixel of what predicts."""

    renderer: Renderer
    points: Points
    axes: tuple[Axis, ...]
    spp: int
    seed: int
    score: MarginOf
    specialise: bool
    before: int = 0
    deviations: list[Deviation] = field(default_factory=list)
    seconds: float = 0.0
    left: set[int] = field(default_factory=set)
    _checked: dict[int, int] = field(default_factory=dict)
    _held: dict[int, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._groups = self._fall(self._follows())
        self.reason = self._reason()

    # ---- what a way of predicting says ------------------------------------------------------------------------------

    @abstractmethod
    def _follows(self) -> frozenset[str]:
        """The groups of coordinates (`control.parameter`) in which the pictures of a group may differ."""

    @abstractmethod
    def _reason(self) -> str | None:
        """See `reason`."""

    @abstractmethod
    def _made(self, u: Tensor, seed: int) -> Any:
        """Return what predicts the pictures that have everything else in common with a configuration."""

    @abstractmethod
    def _predicted(self, made: Any, us: Sequence[Tensor]) -> Sequence[Tensor]:
        """Return the pictures (H, W, 3) of configurations of a group."""

    @property
    def _traced(self) -> int:
        """Pictures that are traced for a group beside comparisons."""
        return 0

    @property
    def _bytes(self) -> int:
        return 0

    @property
    def not_finite(self) -> int:
        """How many values were not finite, and were set to 0."""
        return 0

    # ---- pictures ---------------------------------------------------------------------------------------------------

    def pictures(self, asked: Sequence[WantedPicture]) -> list[SweptPicture]:
        """Return pictures, each rendered or predicted."""
        if self.reason is not None:
            return [self._rendered(one, 0) for one in asked]
        found: dict[int, SweptPicture] = {}
        waiting: dict[int, list[WantedPicture]] = {}
        made: dict[int, Any] = {}
        for one in asked:
            group = self._groups.group(one.number)
            made[group] = self._of(group, one.number)
            if made[group] is None:
                found[one.number] = self._rendered(one, self._spent(one))
            else:
                waiting.setdefault(group, []).append(one)
        for group, some in waiting.items():
            pictures = self._predicted(made[group], [one.u for one in some])
            for one, picture in zip(some, pictures, strict=True):
                found[one.number] = SweptPicture(picture, self.samples, self._spent(one))
        return [found[one.number] for one in asked]

    def _rendered(self, one: WantedPicture, spent: int) -> SweptPicture:
        return SweptPicture(self.renderer(one.u, seed=one.seed, spp=self.spp), predicted=0, traced=spent + 1)

    def _spent(self, one: WantedPicture) -> int:
        """Pictures that were traced for a group, said of its first picture alone."""
        first = one.number == self._groups.member(one.number, 0)
        return (self._traced + self._checked[self._groups.group(one.number)]) * first

    def _fall(self, follows: frozenset[str]) -> Groups:
        """How pictures fall into groups that may differ in some groups of coordinates."""
        of_grid = [axis.name for axis in self.axes]
        drawn = all(group.name in follows for group in self.renderer.space.groups if group.name not in of_grid)
        frames = next((place for place, axis in enumerate(self.axes) if axis.is_time), None)
        within = tuple(name in follows for name in of_grid)
        return Groups(self.points.grid, self.points.samples, within, drawn, frames)

    def _of(self, group: int, number: int) -> Any:
        """What predicts the pictures of a group, of which this is one; None where they are rendered."""
        if group not in self._held:
            if len(self._held) >= self._groups.at_once:
                self._held.pop(next(iter(self._held)))
            self._held[group] = self._make(group, number)
        return self._held[group]

    def _make(self, group: int, number: int) -> Any:
        begun = time.perf_counter()
        seed = seeds.stream(self.seed, "light", self.before + group)
        made = self._made(self._configuration(number, 0), seed)

        def view(check: int) -> ComparedView:
            u = self._configuration(number, seeds.stream(seed, "check", check) % self._groups.size)
            (predicted,) = self._predicted(made, [u])
            return view_of(self.renderer, predicted, u, seeds.stream(seed, "traced", check), self.spp, self.score)

        with torch.no_grad():
            found = compared(view)
        self.deviations.append(found)
        self._checked[group] = found.pictures
        if not found.good:
            self.left.add(group)
        self.seconds += time.perf_counter() - begun
        return made if found.good else None

    def _configuration(self, number: int, place: int) -> Tensor:
        member = self._groups.member(number, place)
        return self.points.configurations(self.points.picks(member, 1, self.before))[0]

    # ---- what is said of it -----------------------------------------------------------------------------------------

    def summary(self) -> LinearTransport | None:
        """What a result holds of it; None where nothing moves that it follows."""
        if self.reason is not None:
            return LinearTransport(used=False, reason=self.reason) if self.reason else None
        worst = max(self.deviations, key=lambda one: one.levels) if self.deviations else None
        several = f"{len(self.left)} of {self._groups.count} groups were rendered: predicted pictures were too far off"
        return LinearTransport(
            used=True,
            way=self.way,
            reason=several if self.left else None,
            entries=0,
            bytes=self._bytes,
            seconds=self.seconds,
            renewed=0,
            error=None if worst is None else PredictionError.of(worst),
        )


def combined(found: Sequence[LinearTransport | None]) -> LinearTransport | None:
    """Return what a result holds of several scenes: the worst error, the largest memory, all seconds."""
    told = [one for one in found if one is not None]
    used = [one for one in told if one.used]
    if not used:
        return told[-1] if told else None
    errors = [one.error for one in used if one.error is not None]
    return LinearTransport(
        used=True,
        way=next((one.way for one in used if one.way), None),
        reason=next((one.reason for one in used if one.reason), None),
        entries=0,
        bytes=max(one.bytes or 0 for one in used),
        seconds=math.fsum(one.seconds or 0.0 for one in used),
        renewed=0,
        error=max(errors, key=lambda one: one.levels or 0.0) if errors else None,
    )


ARRANGED, LIT = 2_200_000, 80_000
"""Samples that take as long as finding what texels see, and the light of an environment: 0.8 and 0.03 s where a picture
of 128 x 128 pixels with 8 samples a pixel takes 46 ms."""
SHOWN = 0.8
"""Samples a pixel that take as long as a predicted picture."""
ARRANGED_BYTES = 50_000_000
"""Memory of an arrangement, about."""
LIT_BYTES = 4_000_000
"""Memory of the light of an environment beside its map, about."""


def pays_from(renderer: Renderer, spp: int, arrangements: float = 1.0) -> int:
    """Return how many pictures under one light have to be wanted for it to pay, where what texels see is found
    `arrangements` times for each light."""
    height, width = renderer.formation.resolution
    samples = (ARRANGED * arrangements + LIT) / (height * width) + VIEWS * (2 * CHECK_SPP + spp)
    return math.ceil(PAYS * samples / (spp - SHOWN))


@dataclass(frozen=True, eq=False)
class LitGroup:
    """A group: object and surroundings as they stand, and their light."""

    renderer: SurfaceRenderer
    light: Light


@dataclass
class SweptSurfaceLight(SweptPredictor):
    """Predicts pictures of one scene at one size by light on surfaces."""

    way: ClassVar[str] = "surface light"
    samples: ClassVar[int] = RAYS
    _arranged: list[SurfaceRenderer] = field(default_factory=list)

    def _follows(self) -> frozenset[str]:
        names = [group.name for group in self.renderer.space.groups]
        self._changes = {name: varied(self.renderer, [name]) for name in names}
        return self._changing(CAMERAS)

    def _changing(self, inputs: frozenset[str]) -> frozenset[str]:
        """The groups of coordinates that change nothing but these inputs, and the finished picture."""
        return frozenset(name for name, found in self._changes.items() if found <= inputs | ON_PICTURE)

    def _reason(self) -> str | None:
        if not any(self._changes[name] & CAMERAS for name in self._changing(CAMERAS)):
            return ""
        if not self.specialise:
            return "nothing is left out"
        groups, arranged = self._groups, self._arrangements
        least = pays_from(self.renderer, self.spp, arranged.count / groups.count)
        if groups.size < least:
            return f"light on surfaces pays where {least} pictures differ in the camera alone; here {groups.size} do"
        reason = why_not_kept(self.renderer)
        if reason is not None:
            return reason
        lit = LIT_BYTES + 4 * self.renderer.scene.base(MAP).numel()
        if arranged.at_once * ARRANGED_BYTES + groups.at_once * lit > scaled(MOST_BYTES):
            return f"light of {groups.count} groups takes too much memory; make the camera the last axes of the grid"
        return None

    @property
    def _arrangements(self) -> Groups:
        """How pictures fall into groups in which object and surroundings stand the same."""
        return self._fall(self._changing(FREE - {COLOR}))

    @property
    def _bytes(self) -> int:
        held: list[LitGroup] = [one for one in self._held.values() if one is not None]
        return sum(one.light.bytes for one in held) + sum(one.bytes for one in self._arranged)

    def _made(self, u: Tensor, seed: int) -> LitGroup:
        with torch.no_grad():
            inputs = self.renderer.scene.assembly(self.renderer.space.inputs(u))
            arranged = next((one for one in self._arranged if one.stands(inputs)), None)
            if arranged is None:
                if len(self._arranged) >= self._arrangements.at_once:
                    self._arranged.pop(0)
                # the same rays wherever things stand, so that it does not matter which group of an arrangement is first
                arranged = SurfaceRenderer(self.renderer, u, seeds.stream(self.seed, "surface light"))
                self._arranged.append(arranged)
            return LitGroup(arranged, arranged.light(inputs))

    def _predicted(self, made: LitGroup, us: Sequence[Tensor]) -> list[Tensor]:
        of, found = made.renderer, list[Tensor]()
        with torch.no_grad():
            inputs = [of.scene.assembly(of.space.inputs(u)) for u in us]
            for begin in range(0, len(us), of.at_once):
                some = slice(begin, begin + of.at_once)
                found += of.shown(of.looks(inputs[some], made.light), inputs[some], of.there, us[some])
        return found
