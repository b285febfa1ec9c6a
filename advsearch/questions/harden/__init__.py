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
        model: a classifier, a detector or a segmenter, as `load_model` takes it, but
            not an exported program.
        optimiser: function that takes the list of parameters and returns an optimizer,
            such as ``lambda p: torch.optim.SGD(p, 0.01)``. Its learning rate replaces
            the setting `rate` as the maximum.
        beside: batches of your own training examples, such as a `DataLoader`: images
            (N, H, W, 3) sRGB in [0, 1], class indices (N,). Each step also trains with
            one of these batches. For classifiers only; a detector takes `data`.
        loss: loss of a detector or a segmenter whose network returns none in training.
            It is a function of the network, its input (N, 3, H, W), and a list with a
            mapping for each picture. For a detector the mapping has "boxes" (K, 4), x0,
            y0, x1, y1 in pixels of the input, and "labels" (K,), indices of the model's
            labels. For a segmenter it has "classes" (h, w) int64, the class that each
            pixel of its output should have, and "object" (h, w) bool, the pixels of the
            object. The function returns a number; training makes it smaller.
        resume: continue the run in the directory `run`, if there is one, from where it
            was stopped. All other arguments have to be the same as before.
    """
    from advsearch.questions.harden.carry_out import run_hardening  # imports torch

    return run_hardening(context, **arguments)
