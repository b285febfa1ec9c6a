"""How large is the region around a configuration in which the model's answer stays as it is?

A box is grown face by face, and what comes out is checked by fresh samples of the whole box: the guarantee is
statistical: a Clopper-Pearson interval of the share of the box with the centre's answer, whose confidence is raised for
the number of boxes that were tried (Bonferroni), so that choosing among them costs nothing of the 95 %.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from advsearch.attacks.trials import clopper_pearson
from advsearch.errors import InputError
from advsearch.seeds import stream

Same = Callable[[Tensor, int], bool]
"""(u, number) -> whether the answer at u is that of the centre; number numbers its seed."""


@dataclass(frozen=True, eq=False)
class GrownBox:
    """A box in the unit box in which the answer stays the same: the centre (d,) and its corners (d,), how many of the
    final samples had the centre's answer, and pictures in all."""

    centre: Tensor
    low: Tensor
    high: Tensor
    same: int
    samples: int
    renders: int

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the share of the box with the centre's answer; see the module."""
        return clopper_pearson(self.same, self.samples, 1.0 - 0.05 / ATTEMPTS)

    @property
    def volume(self) -> float:
        """Share of the unit box that it takes up."""
        return float((self.high - self.low).prod())


LEVELS, ATTEMPTS = 6, 4
"""How often the step of the faces is halved, and final checks at most."""
PROBES = 8
"""Random points at which what a face would win is probed."""
USUAL, MOST_PROBED = 100, 400
"""Pictures of growing for each parameter, usually and at most: that is more than twice what boxes, balls, planes and
noise have taken."""


def grow(
    same: Same, centre: Tensor, *, seed: int, samples: int = 200, on_check: Callable[[], None] = lambda: None
) -> GrownBox:
    """Grow a box around the centre, then check it with samples that nothing was fitted to.

    Each face in turn tries to move out by a share of what is left to the bound (1/2 at first, halved at every level at
    which no face can move any more). The slab that it would win is probed at random points; if all have the centre's
    answer, it moves. Growing ends after `MOST_PROBED` pictures for each parameter at the latest. Then the box is
    sampled; on an exception, the face that cuts off the least of the box moves in to it and the box is sampled anew,
    with other seeds, `ATTEMPTS` times at most; the last check counts whatever it shows.

    Args:
        same: judges a configuration.
        centre: (d,) in [0, 1].
        seed: root of the random points.
        samples: of the final check, at least 1.
        on_check: told the beginning of each final check.

    Raises:
        InputError: the centre is not in the unit box, or samples is under 1.
    """
    if samples < 1:
        raise InputError(f"samples: expected at least 1, got {samples}")
    if not bool(((centre >= 0.0) & (centre <= 1.0)).all()):
        raise InputError("the centre of a region has to lie inside the ranges of its parameters")
    judge = _Judge(same, seed)
    low, high = centre.clone(), centre.clone()
    share, faces = 0.5, range(2 * centre.numel())
    last = MOST_PROBED * centre.numel() - len(faces) * PROBES
    for _ in range(LEVELS):
        while judge.count <= last and any([_push(judge, low, high, face, share) for face in faces]):
            pass
        share /= 2.0
    for attempt in range(ATTEMPTS):
        on_check()
        points = judge.points(low, high, samples)
        wrong = points[[not judge(point) for point in points]]
        if len(wrong) == 0 or attempt == ATTEMPTS - 1:
            break
        for point in wrong:
            _cut(low, high, centre, point)
    return GrownBox(centre, low, high, samples - len(wrong), samples, judge.count)


class _Judge:
    """Counts what it judges; every call has a seed of its own."""

    def __init__(self, same: Same, seed: int) -> None:
        self._same, self._seed = same, seed
        self.count = self._drawn = 0

    def __call__(self, u: Tensor) -> bool:
        self.count += 1
        return self._same(u, self.count - 1)

    def points(self, low: Tensor, high: Tensor, number: int) -> Tensor:
        """(number, d) uniform in a box, other ones at every call."""
        generator = torch.Generator().manual_seed(stream(self._seed, "region", self._drawn))
        self._drawn += 1
        return torch.lerp(low, high, torch.rand(number, low.numel(), generator=generator))


SHORTEST = 1e-3
"""A face does not move by less."""


def _push(judge: _Judge, low: Tensor, high: Tensor, face: int, share: float) -> bool:
    """Move one face out if the slab that it wins has the centre's answer; whether it moved."""
    axis, up = divmod(face, 2)
    room = float(1.0 - high[axis] if up else low[axis])
    step = room if room < 4.0 * SHORTEST else share * room
    if step < SHORTEST and room > 0.0 and step != room:
        return False
    if room <= 0.0:
        return False
    bottom, top = low.clone(), high.clone()
    if up:
        bottom[axis], top[axis] = high[axis], high[axis] + step
    else:
        bottom[axis], top[axis] = low[axis] - step, low[axis]
    points = judge.points(bottom, top, PROBES)
    points[0, axis] = top[axis] if up else bottom[axis]
    if not all(judge(point) for point in points):
        return False
    if up:
        high[axis] = top[axis].clamp(max=1.0)
    else:
        low[axis] = bottom[axis].clamp(min=0.0)
    return True


def _cut(low: Tensor, high: Tensor, centre: Tensor, point: Tensor) -> None:
    """Move in the face that takes the least of the box away so that the point lies outside; the centre stays inside."""
    if bool(((point < low) | (point > high)).any()):
        return
    width = (high - low).clamp_min(1e-12)
    loss = torch.where(point > centre, (high - point) / width, (point - low) / width)
    loss = torch.where(point == centre, torch.inf, loss)
    axis = int(loss.argmin())
    if point[axis] > centre[axis]:
        high[axis] = torch.lerp(centre[axis], point[axis], 0.98)
    else:
        low[axis] = torch.lerp(centre[axis], point[axis], 0.98)
