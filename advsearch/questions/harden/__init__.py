"""Train a copy of a model on its worst cases, and measure both on held-out scenes."""

from __future__ import annotations

from typing import Any

from advsearch.extend import RunContext, experiment
from advsearch.questions.harden.result import (
    HardenConfig,
    HardenResult,
    make_harden_claims,
    make_harden_view,
)


@experiment(
    "harden --model reference --control texture --epsilon 0.03 --quick",
    "harden --model mypackage:network@weights.safetensors --labels labels.json "
    "--control texture,pose,light",
    positional_args=("model",),
    python_arguments="advsearch.questions.harden.carry_out:run_hardening",
    resumes_in_python=True,
    view=make_harden_view,
    claims=make_harden_claims,
)
def harden(context: RunContext[HardenConfig], **arguments: Any) -> HardenResult:
    """Train a copy of a model on its worst cases (docs/harden.md).

    All other arguments are the settings of `advsearch harden`, such as `objects` or
    `steps`. The run is saved in the directory `run`, or in a new one under runs/. Only
    a copy of the model is trained: the model itself does not change.

    Args:
        model: a classifier, a detector or a segmenter: what `load_model` takes, and no
            exported program.
        optimiser: function that takes the list of parameters and returns an optimizer,
            such as ``lambda p: torch.optim.SGD(p, 0.01)``. Its learning rate replaces
            `rate` as the highest one.
        beside: batches of your own training examples, such as a `DataLoader`: images
            (N, H, W, 3) sRGB in [0, 1], class indices (N,). Each step also trains with
            one of these batches. For classifiers only; a detector takes `data`.
        loss: loss of a detector whose network returns none in training: a function of
            the network, its input (N, 3, H, W) and, for each picture, a mapping with
            "boxes" (K, 4), x0, y0, x1, y1 in pixels of that input, and "labels" (K,),
            indices of the model's labels; of a segmenter with "classes" (h, w) int64,
            the class that each pixel of its output should have, and "object" (h, w)
            bool, those of the object. It returns a number that is smaller where the
            network is better.
        resume: go on with the run of that name, if there is one, where it was stopped;
            everything else has to be as it was.
    """
    from advsearch.questions.harden.carry_out import run_hardening  # imports torch

    return run_hardening(context, **arguments)
