"""`advsearch region`: how far one can go from a configuration before the model's verdict changes."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from advsearch.cli import output
from advsearch.cli.question import QuestionCommand
from advsearch.errors import InputError

if TYPE_CHECKING:
    from advsearch.runs.results.region import RegionResult
    from advsearch.settings import Config

HELP = "grow a box around a configuration in which the model's verdict stays the same"
EXAMPLES = (
    "region --object mug --control pose.yaw,camera.elevation --map 24",
    "region --around mug-pose-001 --vary pose.yaw,pose.pitch",
)


class _Region(QuestionCommand):
    """The command, which may take scene and controls from the run that it goes around."""

    def config(self, args: argparse.Namespace) -> Config:
        """Return what the flags describe over the scene and the controls of the run."""
        file = self.file(args)
        if file is None:
            if "object" not in args:
                raise InputError(
                    "advsearch region: expected --object NAME, or --around RUN; see advsearch region --help"
                )
            return super().config(args)
        from advsearch.cli.flags import config_from
        from advsearch.config import AttackConfig, RegionConfig

        return config_from(args, RegionConfig, **RegionConfig.shared(AttackConfig.from_yaml(file)))


def answer(result: RegionResult) -> str:
    """Return the box and what is known of it."""
    from advsearch.report import wording
    from advsearch.report.phrases import percent

    cost = [
        ["renders", str(result.renders["verification"])],
        ["time", wording.seconds_text(result.seconds["total"])],
        ["run", str(result.run)],
    ]
    if result.box is None or result.interval is None:
        return "Stopped before the box was known.\n\n" + output.aligned(cost)
    verdict = (
        f"The model is {result.verdict} in {result.same} of {result.samples} fresh samples of this box: "
        f"with 95 % confidence in at least {percent(result.interval[0])} of it."
    )
    rows = [["parameter", "from", "to", "centre", "unit"]]
    rows += [[one.name, f"{one.low:.4g}", f"{one.high:.4g}", f"{one.centre:.4g}", one.unit] for one in result.box]
    facts = [["share of the space", percent(result.volume)], *cost]
    return "\n\n".join([verdict, output.aligned(rows), output.aligned(facts)])


COMMAND = _Region("region", answer, about="around")
