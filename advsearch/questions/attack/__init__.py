"""`advsearch attack`: the worst configuration of a scene."""

from __future__ import annotations

from advsearch.cli.question import QuestionCommand

HELP = "find the configuration of a scene that the model gets wrong most badly"
MORE = ", and verify it with fresh renders"
EXAMPLES = (
    "attack --object mug --control texture",
    "attack --object mug --control texture --epsilon 0.03 --set camera.azimuth=130 --seed 1",
    "attack --object mug --model reference,torchvision:resnet18 --label mug,cup",
)

COMMAND = QuestionCommand("attack")
