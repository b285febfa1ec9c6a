"""`advsearch sweep`: how often the model is right over a grid or draws, where it is not, and what it cost."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from advsearch.cli.question import QuestionCommand

if TYPE_CHECKING:
    from advsearch.settings import Config

HELP = "measure how often the model is right over a grid or a random sample of configurations"
EXAMPLES = (
    "sweep --object mug --grid pose.yaw=0:360:24 --grid camera.elevation=5:60:8",
    "sweep --object mug,bowl --environment studio,noon --grid camera.azimuth=0,90,180,270",
    "sweep --object mug --control pose,camera --samples 1000",
    "sweep --object mug --control pose --samples 200 --surface",
    "sweep --answer-of mug-texture-001 --control camera,environment --samples 200",
)


class _Sweep(QuestionCommand):
    """The command, which may take scene and model from the run whose answer it sweeps."""

    def config(self, args: argparse.Namespace, **over: Any) -> Config:
        """Return what the flags describe, over what the run of an answer brings."""
        # late, so that --help answers at once
        from advsearch.config import AttackConfig, SweepConfig

        file = self.file(args)
        if file is None:
            return super().config(args, **over)

        varies = "grid" in args or "controls" in args
        return super().config(args, **over, **SweepConfig.of_answer(AttackConfig.from_yaml(file), varies=varies))


COMMAND = _Sweep("sweep", about="answer_of")
