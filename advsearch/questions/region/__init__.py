"""`advsearch region`: how far one can go from a configuration before the model's verdict changes."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from advsearch.cli.question import QuestionCommand
from advsearch.errors import InputError

if TYPE_CHECKING:
    from advsearch.settings import Config

HELP = "grow a box around a configuration in which the model's verdict stays the same"
EXAMPLES = (
    "region --object mug --control pose.yaw,camera.elevation --map 24",
    "region --around mug-pose-001 --vary pose.yaw,pose.pitch",
)


class _Region(QuestionCommand):
    """The command, which may take scene and controls from the run that it goes around."""

    def config(self, args: argparse.Namespace, **over: Any) -> Config:
        """Return what the flags describe over the scene and the controls of the run."""
        file = self.file(args)
        if file is None:
            if "object" not in args:
                raise InputError(
                    "advsearch region: expected --object NAME, or --around RUN; see advsearch region --help"
                )
            return super().config(args, **over)
        from advsearch.config import AttackConfig  # settings take a third of a second, and help needs none
        from advsearch.questions.region.settings import RegionConfig

        return super().config(args, **over, **RegionConfig.shared(AttackConfig.from_yaml(file)))


COMMAND = _Region("region", about="around")
