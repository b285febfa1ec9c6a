"""Similarity: which reference pictures a network finds nearest, by the cosine of its
features.

With a gallery, one folder of pictures for each name, it is a classification among these
names. Without, a prediction is right where the picture is still the same thing as the
clean one to the network.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from advsearch.extend import InputError, Model, models, stored_files, tasks

MOST = 10_000  # pictures of a gallery, before `scaled`
# longest side in pixels of a picture as it is kept; larger ones are averaged down
SIDE = 1024
AT_ONCE = 16  # pictures that a network is shown at once
# of the squared weights of a linear head, beside a mean cross-entropy in nats
PENALTY = 1e-3
# most iterations of the fit of a linear head; it usually stands still after a few dozen
ROUNDS = 500


@dataclass(frozen=True, eq=False)
class Gallery:
    """Reference pictures, embedded."""

    names: tuple[str, ...]  # of the folders, in order
    owners: Tensor  # (R,) whole numbers, the number of each picture's name
    paths: tuple[str, ...]  # of each picture, within the folder
    features: Tensor  # (R, D), of length 1
    seen_by: tuple[Any, ...] = field(repr=False)  # the network and its preprocessing
    # weights (names, D) and biases (names,)
    head: tuple[Tensor, Tensor] | None = field(default=None, repr=False)

    def cosines(self, features: Tensor) -> Tensor:
        """Return the cosine (N, R) of features (N, D) of length 1 and each picture."""
        return features @ self.features.to(features).T


def folders_of(folder: str) -> list[tuple[str, Path]]:
    """Return the names in a folder, and the folder of each, in alphabetical order;
    hidden ones are left out. Raises InputError where it is not there, or does not have
    two names.
    """
    root = Path(folder).expanduser()
    folders = [(entry.name, entry) for entry in _listed(root) if entry.is_dir()]
    if len(folders) < 2:
        got = f"only {folders[0][0]}" if folders else "no folder"
        raise InputError(
            f"references: expected two folders of pictures at least in {root}, each "
            "called by its name, such as mug "
            f"and bowl, got {got}"
        )
    return folders


def embedded(folder: str, model: Model, *, linear: bool) -> Gallery:
    """Return the pictures in a folder, which has one for each name, as a model that
    returns features sees them; everything is done anew, and the same each time. A head
    is fitted where it is `linear`.

    A picture is turned upright, its middle is cut to the shape of the model's input,
    and then it goes the way of a rendered one.

    Raises:
        InputError: as for `folders_of`; a name without a picture; too many pictures;
            features that are not (N, D).
        FileFormatError: a file that is no picture, or a huge one.
    """
    folders = folders_of(folder)
    root = Path(folder).expanduser()
    paths: list[tuple[int, Path]] = []
    for number, (name, where) in enumerate(folders):
        pictures = _listed(where)
        if not pictures:
            raise InputError(
                f"references: expected pictures of {name} in {where}, got "
                "none; put some there"
            )
        paths += [(number, picture) for picture in pictures]
    if len(paths) > stored_files.scaled(MOST):
        raise stored_files.too_large(
            root,
            f"at most {stored_files.scaled(MOST):,} reference pictures",
            f"{len(paths):,}",
        )
    parts: list[Tensor] = []
    shown = (
        _cut(torch.from_numpy(models.upright(path, SIDE)), model.input_size)
        for _, path in paths
    )
    with torch.no_grad():
        for _, of_one_size in itertools.groupby(
            shown, key=lambda picture: picture.shape
        ):
            while batch := list(itertools.islice(of_one_size, AT_ONCE)):
                parts.append(model(torch.stack(batch)))
                if parts[-1].dim() != 2:
                    got = tuple(parts[-1].shape)
                    raise InputError(
                        f"model {model.name}: expected features (N, D), "
                        f"got {got}; use another task"
                    )
    features = torch.cat(parts)
    broken = ~features.isfinite().all(dim=1)
    if bool(broken.any()):
        raise InputError(
            f"references: model {model.name} returns for "
            f"{paths[int(broken.nonzero()[0])][1]} NaN"
        )
    features = functional.normalize(features, dim=1)
    owners = torch.tensor([number for number, _ in paths])
    return Gallery(
        tuple(name for name, _ in folders),
        owners,
        tuple(path.relative_to(root).as_posix() for _, path in paths),
        features,
        (model.module, model.preprocessing),
        fitted(features, owners) if linear else None,
    )


def fitted(features: Tensor, owners: Tensor) -> tuple[Tensor, Tensor]:
    """Return weights (names, D) and biases (names,) of a multinomial logistic
    regression on features (R, D) and the numbers of their names (R,).

    Names count alike, however many pictures they have. The loss is convex, so its
    minimum is the only one; it is sought by L-BFGS from zero in double precision, as
    Radford et al. 2021 (arXiv 2103.00020, section A.3) fit theirs.
    """
    count = int(owners.max()) + 1
    shares = 1.0 / (count * torch.bincount(owners, minlength=count).double()[owners])
    middle = features.double().mean(dim=0)
    given = features.double() - middle
    weights = torch.zeros(
        count, features.shape[1], dtype=torch.float64, requires_grad=True
    )
    biases = torch.zeros(count, dtype=torch.float64, requires_grad=True)
    search = torch.optim.LBFGS(
        [weights, biases],
        max_iter=ROUNDS,
        tolerance_grad=1e-8,
        tolerance_change=1e-12,
        line_search_fn="strong_wolfe",
    )

    def loss() -> Tensor:
        search.zero_grad()
        each = functional.cross_entropy(
            functional.linear(given, weights, biases), owners, reduction="none"
        )
        value: Tensor = (shares * each).sum() + PENALTY / 2.0 * weights.square().sum()
        torch.autograd.backward(value, inputs=[weights, biases])
        return value

    with torch.enable_grad():
        search.step(loss)
    weights = weights.detach()
    return weights.float(), (biases.detach() - weights @ middle).float()


def _listed(folder: Path) -> list[Path]:
    try:
        return sorted(one for one in folder.iterdir() if not one.name.startswith("."))
    except OSError as error:
        raise InputError(
            "references: expected a folder with a folder of pictures for each name, "
            f"got {folder} "
            f"({error.strerror}); check the path"
        ) from None


def _cut(picture: Tensor, size: tuple[int, int]) -> Tensor:
    """Return the largest middle part of a picture (H, W, 3) that has the shape of the
    input.
    """
    height, width = picture.shape[:2]
    high = min(height, max(1, round(width * size[0] / size[1])))
    wide = min(width, max(1, round(height * size[1] / size[0])))
    top = (height - high) // 2
    left = (width - wide) // 2
    return picture[top : top + high, left : left + wide]


METHODS = ("nearest", "linear")  # how features become logits

TEMPERATURE = 0.07
"""What cosines are divided by to be logits (Wu et al. 2018, arXiv 1805.01978, section 4.1; Caron et al. 2021, arXiv
2104.14294, section 4.1)."""

ITSELF = "itself"
ELSE = "something else"
"""The predictions where there is a threshold."""


@dataclass(frozen=True, kw_only=True)
class Similarity(tasks.Classification):
    """The object is what the nearest reference pictures show, or what the clean picture
    shows.

    The output is features (N, D), whatever their length. With `references` the truth is
    the indices of the right names, and logits (N, names) of them are

    - `nearest`: the mean cosine of the `k` nearest pictures of each name, over
      `TEMPERATURE`. Each name is judged by pictures of its own, so that one with many
      has no more votes than one with few, and every name has a gradient. The mean, so
      that one odd picture decides nothing where `k` is over 1. With 1, the default, a
      prediction is right exactly where the nearest picture of all is.
    - `linear`: those of a logistic regression on the reference features, of length 1
    (`fitted`).

    With `threshold` they are the cosine to the clean picture's features and the
    threshold, over `TEMPERATURE`.

    Args:
        references: a folder with a folder of pictures for each name; "" for none.
        method: one of `METHODS`.
        k: how many of the nearest.
        threshold: cosine from which on a picture is the same as the clean one; None
            where there are references.

    Raises:
        InputError: a value out of range, or options that exclude each other.
    """

    name = "similarity"
    reads_logits = False
    names_from = "its folders"

    references: str = ""
    method: str = METHODS[0]
    k: int = 1
    threshold: float | None = None
    gallery: Gallery | None = field(
        default=None, compare=False, repr=False, metadata=tasks.FROM_RUN
    )
    # (D,), of length 1
    clean: Tensor | None = field(
        default=None, compare=False, repr=False, metadata=tasks.FROM_RUN
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.method not in METHODS:
            raise InputError(
                "task similarity: method: expected one of "
                f"{', '.join(METHODS)}, got {self.method!r}"
            )
        if isinstance(self.k, bool) or not isinstance(self.k, int) or self.k < 1:
            raise InputError(
                "task similarity: k: expected a whole number of at least "
                f"1, got {self.k!r}"
            )
        if self.method == "linear" and self.k != 1:
            raise InputError(
                "task similarity: k: belongs to `method: nearest`; leave "
                "one of the two out"
            )
        if self.threshold is not None:
            self.check_numbers(
                lambda bar: -1.0 < bar < 1.0, "a cosine between -1 and 1", "threshold"
            )
            if self.references:
                raise InputError(
                    "task similarity: threshold: compares with the clean "
                    "picture; leave `references` out"
                )

    def on(
        self, model: Model, *, target: str | None = None, minimise: bool = False
    ) -> Similarity:
        """See `Task.on`; references are read and shown to the model, once. Raises
        InputError, FileFormatError: as for `embedded`; neither references nor a
        threshold.
        """
        if not self.references and self.threshold is None:
            raise InputError(
                "task similarity: references: expected a folder with a folder of "
                "pictures for each name, or a "
                "`threshold` of the cosine to the clean picture, got neither; write "
                "`task='similarity={references: FOLDER}'` or "
                "`task='similarity={threshold: 0.8}'`"
            )
        if target is not None and not self.references:
            raise InputError(
                "target: a `threshold` knows no names; give `references` "
                "to task similarity"
            )
        found = super().on(model, target=target, minimise=minimise)
        seen = self.gallery is not None and self.gallery.seen_by == (
            model.module,
            model.preprocessing,
        )
        if seen or not self.references:
            return found
        return replace(
            found,
            gallery=embedded(self.references, model, linear=self.method == "linear"),
        )

    def _names(self, model: Model) -> tuple[tuple[str, ...], bool]:
        return tuple(
            name for name, _ in folders_of(self.references)
        ) if self.references else (ITSELF, ELSE), True

    def right_classes(self, facts: tasks.Facts) -> tasks.Labels:
        """See `ClassTask.right_classes`; with a threshold the clean picture says what
        is right.
        """
        if self.references:
            return super().right_classes(facts)
        if facts.label is not None:
            raise InputError(
                "label: a `threshold` knows no names, the clean picture "
                "is what is right; leave it out"
            )
        return (0,)

    @property
    def calibrates(self) -> bool:
        return not self.references and self.clean is None

    def after_calibration(
        self, output: Tensor, truth: tasks.Labels | None
    ) -> Similarity:
        return (
            replace(self, clean=functional.normalize(output.detach().float(), dim=1)[0])
            if self.calibrates
            else self
        )

    def read(self, returned: Any, count: int) -> Tensor:
        """Return features (count, D): a tensor, the first of a tuple, or the first of
        `PARTS` that is there. Of `last_hidden_state` that is the first token (CLS); a
        map is averaged over its positions.
        """
        found = models.pooled(
            returned[0] if type(returned) in (tuple, list) and returned else returned,
            token=True,
        )
        if found is None or found.dim() != 2 or found.shape[0] != count:
            raise ValueError(
                f"expected features ({count}, D), or what has one of "
                f"{', '.join(models.PARTS)}"
            )
        return found.float()

    def logits(self, output: Tensor) -> Tensor:
        """Return logits (N, names) of features (N, D); differentiable."""
        features = functional.normalize(output, dim=1)
        if self.gallery is None:
            if self.clean is None or self.threshold is None:
                raise InputError(
                    "task similarity: expected references, or a clean "
                    "picture that it was shown first"
                )
            cosine = features @ self.clean.to(features)
            scores = torch.stack(
                [cosine, torch.full_like(cosine, self.threshold)], dim=1
            )
        elif self.method == "linear":
            assert self.gallery.head is not None
            return functional.linear(
                features, *(part.to(features) for part in self.gallery.head)
            )
        else:
            cosines = self.gallery.cosines(features)
            owners = self.gallery.owners.to(features.device)
            each = [
                cosines[:, owners == name] for name in range(len(self.gallery.names))
            ]
            nearest = [
                of_name.topk(min(self.k, of_name.shape[1]), dim=1).values
                for of_name in each
            ]
            scores = torch.stack([of_name.mean(dim=1) for of_name in nearest], dim=1)
        return scores / TEMPERATURE

    def as_logits(self, output: Tensor, truth: tasks.Labels) -> Tensor:
        return super().as_logits(self.logits(output), truth)

    def judge(self, output: Tensor, truth: tasks.Labels) -> list[tasks.Judgement]:
        """See `Task.judge`; the payload has the cosine to the clean picture, or what
        `_ranked` says.
        """
        with torch.no_grad():
            judged = super().judge(output, truth)
            features = functional.normalize(output, dim=1)
            if self.gallery is not None:
                kept = self._ranked(
                    self.gallery, features, self.as_logits(output, truth), truth
                )
            else:
                assert self.clean is not None
                kept = [
                    {"cosine": round(one, 4)}
                    for one in (features @ self.clean.to(features)).tolist()
                ]
        return [
            replace(one, payload=payload if math.isfinite(one.margin) else None)
            for one, payload in zip(judged, kept, strict=True)
        ]

    def _ranked(
        self, gallery: Gallery, features: Tensor, logits: Tensor, truth: tasks.Labels
    ) -> list[dict[str, tasks.JsonValue]]:
        """Say of each of N pictures where the right one stands. Each has the `rank` of
        the nearest right reference among all (1 where it is the nearest of all) and its
        `cosine`; `name_rank`, that of the right name by its logit; and the `nearest`
        reference of all and its cosine.
        """
        cosines = gallery.cosines(features)
        inside = torch.isin(gallery.owners, torch.tensor(truth)).to(cosines.device)
        best = cosines[:, inside].amax(dim=1)
        ranks = 1 + (cosines[:, ~inside] > best[:, None]).sum(dim=1)
        right = torch.isin(torch.arange(logits.shape[1]), torch.tensor(truth)).to(
            logits.device
        )
        names = 1 + (
            logits[:, ~right] > logits[:, right].amax(dim=1, keepdim=True)
        ).sum(dim=1)
        top, places = cosines.max(dim=1)
        rows = zip(
            *(one.tolist() for one in (ranks, best, names, places, top)), strict=True
        )
        return [
            {
                "rank": rank,
                "references": len(gallery.paths),
                "cosine": round(cosine, 4),
                "name_rank": name_rank,
                "nearest": gallery.paths[place],
                "nearest_cosine": round(nearest, 4),
            }
            for rank, cosine, name_rank, place, nearest in rows
        ]
