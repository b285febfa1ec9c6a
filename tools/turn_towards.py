"""A tiny policy that turns towards the bundled mug, by behaviour cloning in rendered
pictures; for task `command`.

    python tools/turn_towards.py turn.pt2 [--pictures 400] [--rounds 60] [--seed 0]

It gets a picture (N, 3, 32, 32) and a state, `speed` (N, 1) in m/s, and returns a yaw
rate (N, 1) in rad/s, over 0 to the left. The teacher is pure pursuit (Coulter 1992,
section 2) of a point 1 m ahead: 2 x speed x sin(bearing), by the bearing of the mug's
middle column. Prints how far off the policy is in pictures that it was not trained on,
which have other places, turns, lights and cameras.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from pathlib import Path

from advsearch import threads

threads.configure(1)

import torch
from torch import Tensor, nn

from advsearch import seeds
from advsearch.controls import compose_space
from advsearch.engine.loading import (
    fit_camera,
    load_scene,
    make_controls,
    make_renderer,
)
from advsearch.scene.color import round_to_8_bit

SIDE = 32
FOV = 35.0
SPP = 8
SPEEDS = 0.5, 1.5
ANYWHERE = {
    "pose": {"yaw": [0, 360], "x": [-0.5, 0.5], "y": [-0.5, 0.5]},
    "camera": {"azimuth": [0, 360], "elevation": [10, 35], "distance": [0.24, 0.36]},
    "light": {"power": [2.0, 9.0]},
}


class Turn(nn.Module):
    """Features of the picture and the speed make one number."""

    def __init__(self) -> None:
        super().__init__()
        sizes = (3, 8, 12, 16)
        convolutions = [
            layer
            for a, b in itertools.pairwise(sizes)
            for layer in (nn.Conv2d(a, b, 3, 2, 1), nn.ReLU())
        ]
        self.see = nn.Sequential(
            *convolutions, nn.Flatten(), nn.Linear(256, 16), nn.ReLU()
        )
        self.decide = nn.Sequential(nn.Linear(17, 16), nn.ReLU(), nn.Linear(16, 1))

    def forward(self, images: Tensor, state: dict[str, Tensor]) -> Tensor:
        rate: Tensor = self.decide(
            torch.cat([self.see(images - 0.5), state["speed"]], dim=1)
        )
        return rate


@torch.no_grad()
def pictures(count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Return pictures (N, 3, SIDE, SIDE) of the mug, and its bearing in each, (N, 1) in
    radians to the left.
    """
    description = fit_camera(load_scene("mug").description, SIDE)
    space = compose_space(make_controls(ANYWHERE), description)
    renderer = make_renderer(
        description, space, SIDE, "none", seed, differentiated=False
    )
    draw = torch.Generator().manual_seed(seed)
    seen: list[Tensor] = []
    bearings: list[float] = []
    while len(seen) < count:
        u = torch.rand(space.start.shape, generator=draw)
        columns = renderer.compute_object_mask(u).sum(dim=0).double()
        if columns.sum() < 8:
            continue
        middle = (
            float((columns * (torch.arange(SIDE) + 0.5)).sum() / columns.sum()) / SIDE
            - 0.5
        )
        radiance = renderer.radiance(
            u, seeds.derive_seed(seed, f"picture {len(seen)}"), SPP
        )
        seen.append(
            round_to_8_bit(
                space.apply_to_image(u, renderer.formation.map_to_display(radiance))
            )
            .permute(2, 0, 1)
            .clone()
        )
        bearings.append(-math.atan(2.0 * middle * math.tan(math.radians(FOV) / 2.0)))
    return torch.stack(seen), torch.tensor(bearings)[:, None]


def taught(bearings: Tensor, draw: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return speeds and the yaw rates that the teacher commands."""
    low, high = SPEEDS
    speeds = low + (high - low) * torch.rand(bearings.shape, generator=draw)
    return speeds, 2.0 * speeds * bearings.sin()


def train(images: Tensor, bearings: Tensor, rounds: int, seed: int) -> Turn:
    """Return a policy that imitates the teacher, each picture mirrored in half of the
    rounds.
    """
    torch.manual_seed(seed)
    policy = Turn()
    draw = torch.Generator().manual_seed(seed)
    optimiser = torch.optim.AdamW(policy.parameters(), lr=3e-3)
    steps = rounds * math.ceil(len(images) / 32)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(rounds):
        for part in torch.randperm(len(images), generator=draw).split(32):
            flip = torch.rand(len(part), generator=draw) < 0.5
            shown = torch.where(
                flip[:, None, None, None], images[part].flip(3), images[part]
            )
            speeds, rates = taught(
                torch.where(flip[:, None], -bearings[part], bearings[part]), draw
            )
            loss = nn.functional.mse_loss(policy(shown, {"speed": speeds}), rates)
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call, unused-ignore]
            optimiser.step()
            schedule.step()
    return policy.eval()


def main() -> None:
    """Train, say how good it is, and export."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("file", type=Path, help="where the policy is written, a .pt2")
    parser.add_argument("--pictures", type=int, default=400)
    parser.add_argument("--rounds", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    begun = time.process_time()
    images, bearings = pictures(given.pictures + given.pictures // 4, given.seed)
    rendered = time.process_time()
    policy = train(
        images[: given.pictures], bearings[: given.pictures], given.rounds, given.seed
    )
    held = images[given.pictures :]
    truth = bearings[given.pictures :]
    speeds, rates = taught(truth, torch.Generator().manual_seed(1))
    with torch.no_grad():
        off = policy(held, {"speed": speeds}) - rates
    seconds = rendered - begun, time.process_time() - rendered
    print(
        f"{given.pictures} pictures: {seconds[0]:.0f} s of CPU; training: "
        f"{seconds[1]:.0f} s"
    )
    print(f"yaw rate in {len(held)} other pictures: off by "
          f"{float(off.abs().mean()):.3f} rad/s on average, "
          f"{float(off.abs().max()):.3f} at most; the teacher's are up to "
          f"{float(rates.abs().max()):.2f}")  # fmt: skip
    batch = torch.export.Dim("batch", min=1, max=64)
    example = (images[:2].clone(), {"speed": speeds[:2].clone()})
    program = torch.export.export(
        policy, example, dynamic_shapes=({0: batch}, {"speed": {0: batch}})
    )
    torch.export.save(program, given.file)
    print(f"written: {given.file}, {given.file.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
