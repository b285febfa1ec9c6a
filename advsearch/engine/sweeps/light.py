"""Pictures of a sweep that differ in light alone: put together from basis pictures, once these pay (docs/transport.md).

Pictures that have everything else in common are a *group*: a pose and its light, say. Each group has basis pictures of
its own. What they are depends on the group alone, so that a sweep that was stopped goes on with the same ones.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from torch import Tensor

from advsearch import seeds
from advsearch.attacks.product import Product
from advsearch.engine.sweeps.axes import Axis
from advsearch.engine.sweeps.points import Points
from advsearch.engine.transport import CHECK_SPP, Deviation, deviation_under_light
from advsearch.files import scaled
from advsearch.runs.results.attack import LinearTransport, PredictionError
from advsearch.scene.renderer import Renderer
from advsearch.scene.transport.lights import BasisRenderer, Lights, lighting
from advsearch.scene.transport.renderer import MOST_BYTES, SPP

PAYS = 2.0
"""Times the samples that basis pictures and comparisons take, that a group has to take rendered, for them to pay."""
CHECKS = 3
"""Pictures of a scene that are traced to compare, spread over its groups; every group has one at least."""

MarginOf = Callable[[Tensor, Tensor], float]
"""What a model says of a picture (H, W, 3) of a configuration, as a number of logits."""


@dataclass(frozen=True)
class Groups:
    """How the pictures of a scene fall into groups.

    Attributes:
        grid: of the scene.
        samples: draws at each point of the grid.
        lit: of every axis of the grid, whether it is light.
        drawn: whether what is drawn is light alone.
    """

    grid: Product
    samples: int
    lit: tuple[bool, ...]
    drawn: bool

    @property
    def size(self) -> int:
        """Pictures of a group."""
        if not self.drawn:
            return 1
        return self.samples * math.prod(size for size, lit in zip(self.grid.sizes, self.lit, strict=True) if lit)

    @property
    def count(self) -> int:
        """How many there are."""
        return self.grid.count * self.samples // self.size

    @property
    def at_once(self) -> int:
        """How many have to be held at once, so that none is made twice."""
        first = self.lit.index(True) if True in self.lit else len(self.lit)
        return 1 if all(self.lit[first:]) else self.count

    def group(self, digits: tuple[int, ...]) -> int:
        """Return the number of the group of a point of the grid."""
        number = 0
        for digit, size, lit in zip(digits, self.grid.sizes, self.lit, strict=True):
            number = number if lit else number * size + digit
        return number

    def member(self, digits: tuple[int, ...], number: int) -> int:
        """Return the picture of a scene with this number in the group of a point of the grid."""
        place, sample = divmod(number, self.samples)
        found = list(digits)
        for axis in reversed(range(len(found))):
            if self.lit[axis]:
                place, found[axis] = divmod(place, self.grid.sizes[axis])
        return self.grid.index(found) * self.samples + sample


@dataclass(frozen=True, eq=False)
class SweptPicture:
    """One picture.

    Attributes:
        picture: (H, W, 3) sRGB in [0, 1].
        predicted: put together from basis pictures, not rendered.
        traced: pictures that were traced for it; the first of a group has all that were traced for the group.
    """

    picture: Tensor
    predicted: bool
    traced: int


@dataclass
class SweptLight:
    """Predicts pictures of one scene at one size.

    Args:
        renderer: the one that traces paths.
        points: the configurations.
        axes: of the grid.
        spp: samples a pixel of a rendered picture.
        seed: of the basis pictures.
        score: what a comparison says in logits.
        specialise: whether anything may be left out.

    Attributes:
        reason: why every picture is rendered; None if none is, and empty where no light moves.
        deviations: what comparisons found, of the groups that were made.
        seconds: spent on making basis pictures and on comparing.
        left: groups in which a prediction was too far off, so that they are rendered.
    """

    renderer: Renderer
    points: Points
    axes: tuple[Axis, ...]
    spp: int
    seed: int
    score: MarginOf
    specialise: bool
    deviations: list[Deviation] = field(default_factory=list)
    seconds: float = 0.0
    left: set[int] = field(default_factory=set)
    _made: dict[int, BasisRenderer | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        space_groups = self.renderer.space.groups
        self._moving = lighting(self.renderer)
        lit, of_grid = self._moving.groups, [axis.name for axis in self.axes]
        drawn = all(group.name in lit for group in space_groups if group.name not in of_grid)
        self._groups = Groups(self.points.grid, self.points.samples, tuple(name in lit for name in of_grid), drawn)
        self._lights = 0
        self.reason = self._reason() if any(lit.values()) else ""

    def _reason(self) -> str | None:
        if not self.specialise:
            return "nothing is left out"
        if self.renderer.formation.denoiser != "oidn":
            return "noise is part of the picture without the denoiser"
        groups, inputs = self._groups, self.renderer.scene.assembly(self.renderer.space.inputs(self.renderer.start))
        self._lights = len(Lights(self.renderer, self._moving, inputs).alone)
        samples = self._lights * SPP + self._checks * (CHECK_SPP + self.spp)
        least = math.ceil(PAYS * samples / self.spp)
        if groups.size < least:
            return f"basis pictures pay where {least} pictures or more differ in light alone; here {groups.size} do"
        height, width = self.renderer.formation.resolution
        if groups.at_once * self._lights * 8 * height * width > scaled(MOST_BYTES):
            return f"basis pictures of {groups.count} groups take too much memory; make light the last axes of the grid"
        return None

    @property
    def _checks(self) -> int:
        return -(-CHECKS // self._groups.count)

    @property
    def not_finite(self) -> int:
        """How many values of basis pictures are not finite, and were set to 0."""
        return sum(one.non_finite for one in self._made.values() if one is not None)

    def show(self, number: int, digits: tuple[int, ...], u: Tensor, noise: int, before: int) -> SweptPicture:
        """Return a picture, rendered or predicted.

        Args:
            number: of the picture in the whole sweep.
            digits: its place on every axis of the grid.
            u: (d,) its configuration.
            noise: its seed.
            before: pictures of the scenes before.
        """
        if self.reason is not None:
            return SweptPicture(self.renderer(u, seed=noise, spp=self.spp), predicted=False, traced=1)
        group = self._groups.group(digits)
        if group not in self._made:
            if len(self._made) >= self._groups.at_once:
                self._made.pop(next(iter(self._made)))
            self._made[group] = self._make(group, digits, before)
        made = self._made[group]
        first = number - before == self._groups.member(digits, 0)
        traced = (self._lights + 2 * self._checks) * first
        if made is None:
            return SweptPicture(self.renderer(u, seed=noise, spp=self.spp), predicted=False, traced=traced + 1)
        return SweptPicture(made(u), predicted=True, traced=traced)

    def _make(self, group: int, digits: tuple[int, ...], before: int) -> BasisRenderer | None:
        begun = time.perf_counter()
        seed = seeds.stream(self.seed, "light", before + group)
        made = BasisRenderer(self.renderer, self._configuration(digits, 0, before), seed, moving=self._moving)
        good = True
        for check in range(self._checks):
            place = seeds.stream(seed, "check", check) % self._groups.size
            u = self._configuration(digits, place, before)

            def loss(picture: Tensor, u: Tensor = u) -> float:
                return self.score(picture, u)

            found = deviation_under_light(self.renderer, loss, made, u, seeds.stream(seed, "traced", check), self.spp)
            self.deviations.append(found)
            good = good and found.levels <= found.most
        if not good:
            self.left.add(group)
        self.seconds += time.perf_counter() - begun
        return made if good else None

    def _configuration(self, digits: tuple[int, ...], number: int, before: int) -> Tensor:
        """u (d,) of a picture of a group."""
        member = self._groups.member(digits, number)
        return self.points.configurations(self.points.picks(member, 1, before))[0]

    def summary(self) -> LinearTransport | None:
        """What a result holds of it; None where no light moves."""
        if self.reason is not None:
            return LinearTransport(used=False, reason=self.reason) if self.reason else None
        worst = max(self.deviations, key=lambda one: one.levels) if self.deviations else None
        several = f"{len(self.left)} of {self._groups.count} groups were rendered: predicted pictures were too far off"
        return LinearTransport(
            used=True,
            reason=several if self.left else None,
            entries=0,
            bytes=max((one.bytes for one in self._made.values() if one is not None), default=0) * len(self._made),
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
        reason=next((one.reason for one in used if one.reason), None),
        entries=0,
        bytes=max(one.bytes or 0 for one in used),
        seconds=math.fsum(one.seconds or 0.0 for one in used),
        renewed=0,
        error=max(errors, key=lambda one: one.levels or 0.0) if errors else None,
    )
