"""A gallery: pictures in folders, one folder for each name, as a network sees them."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from advsearch import files
from advsearch.errors import InputError
from advsearch.models import Model
from advsearch.pictures import upright

MOST = 10_000
"""Pictures of a gallery, before `advsearch.files.scaled`."""

SIDE = 1024
"""Longest side in pixels of a picture as it is kept; larger ones are averaged down."""

AT_ONCE = 16
"""Pictures that a network is shown at once."""

PENALTY = 1e-3
"""Of the squared weights of a linear head, beside a mean cross-entropy in nats."""

ROUNDS = 500
"""Most iterations of the fit of a linear head; it usually stands still after a few dozen."""


@dataclass(frozen=True, eq=False)
class Gallery:
    """Reference pictures, embedded.

    Attributes:
        names: of the folders, in order.
        owners: (R,) whole numbers, the number of each picture's name.
        paths: of each picture, within the folder.
        features: (R, D), of length 1.
        seen_by: the network and its preprocessing.
        head: weights (names, D) and biases (names,) of a linear head; None where none was fitted.
    """

    names: tuple[str, ...]
    owners: Tensor
    paths: tuple[str, ...]
    features: Tensor
    seen_by: tuple[Any, ...] = field(repr=False)
    head: tuple[Tensor, Tensor] | None = field(default=None, repr=False)

    def cosines(self, features: Tensor) -> Tensor:
        """Return the cosine (N, R) of features (N, D) of length 1 and each picture."""
        return features @ self.features.to(features).T

    def nearest(self, features: Tensor, k: int) -> Tensor:
        """Return the mean cosine (N, names) of the k nearest pictures of each name, or of all where it has fewer."""
        cosines = self.cosines(features)
        each = (cosines[:, (self.owners == name).to(cosines.device)] for name in range(len(self.names)))
        return torch.stack([own.topk(min(k, own.shape[1]), dim=1).values.mean(dim=1) for own in each], dim=1)

    def linear(self, features: Tensor) -> Tensor:
        """Return the logits (N, names) of the head."""
        assert self.head is not None
        weights, biases = self.head
        return functional.linear(features, weights.to(features), biases.to(features))


def folders_of(folder: str) -> list[tuple[str, Path]]:
    """Return the names in a folder, and the folder of each, in alphabetical order; hidden ones are left out.

    Raises:
        InputError: it is not there, or does not have two names.
    """
    root = Path(folder).expanduser()
    found = [(one.name, one) for one in _listed(root) if one.is_dir()]
    if len(found) < 2:
        got = f"only {found[0][0]}" if found else "no folder"
        raise InputError(
            f"references: expected two folders of pictures at least in {root}, each called by its name, such as mug "
            f"and bowl, got {got}"
        )
    return found


def embedded(folder: str, model: Model, *, linear: bool) -> Gallery:
    """Return the pictures in a folder as a model sees them; everything is done anew, and the same each time.

    A picture is turned upright, its middle is cut to the shape of the model's input, and then it goes the way of a
    rendered one.

    Args:
        folder: with a folder of pictures for each name.
        model: that answers with features (N, D).
        linear: whether a head is fitted.

    Raises:
        InputError: as for `folders_of`; a name without a picture; too many pictures; features that are not (N, D).
        FileFormatError: a file that is no picture, or a huge one.
    """
    names = folders_of(folder)
    root = Path(folder).expanduser()
    paths = [(number, one) for number, (_, where) in enumerate(names) for one in _pictures(where)]
    if len(paths) > files.scaled(MOST):
        raise files.too_large(root, f"at most {files.scaled(MOST):,} reference pictures", f"{len(paths):,}")
    with torch.no_grad():
        shown = (_cut(torch.from_numpy(upright(one, SIDE)), model.input_size) for _, one in paths)
        parts = [_features(model, batch, root) for batch in _batches(shown)]
    features = torch.cat(parts)
    broken = ~features.isfinite().all(dim=1)
    if bool(broken.any()):
        raise InputError(f"references: model {model.name} answers {paths[int(broken.nonzero()[0])][1]} with NaN")
    features = functional.normalize(features, dim=1)
    owners = torch.tensor([number for number, _ in paths])
    return Gallery(
        tuple(name for name, _ in names),
        owners,
        tuple(one.relative_to(root).as_posix() for _, one in paths),
        features,
        seen_by(model),
        fitted(features, owners) if linear else None,
    )


def seen_by(model: Model) -> tuple[Any, ...]:
    """Return what decides how a model sees a picture."""
    return model.module, model.preprocessing


def fitted(features: Tensor, owners: Tensor) -> tuple[Tensor, Tensor]:
    """Return weights (names, D) and biases (names,) of a multinomial logistic regression.

    Names count alike, however many pictures they have. The loss is convex, so its minimum is the only one; it is
    sought by L-BFGS from zero in double precision, as Radford et al. 2021 (arXiv 2103.00020, section A.3) fit theirs.

    Args:
        features: (R, D).
        owners: (R,) whole numbers, the name of each.
    """
    count = int(owners.max()) + 1
    shares = 1.0 / (count * torch.bincount(owners, minlength=count).double()[owners])
    middle = features.double().mean(dim=0)
    given = features.double() - middle
    weights = torch.zeros(count, features.shape[1], dtype=torch.float64, requires_grad=True)
    biases = torch.zeros(count, dtype=torch.float64, requires_grad=True)
    search = torch.optim.LBFGS(
        [weights, biases], max_iter=ROUNDS, tolerance_grad=1e-8, tolerance_change=1e-12, line_search_fn="strong_wolfe"
    )

    def loss() -> Tensor:
        search.zero_grad()
        each = functional.cross_entropy(functional.linear(given, weights, biases), owners, reduction="none")
        value: Tensor = (shares * each).sum() + PENALTY / 2.0 * weights.square().sum()
        torch.autograd.backward(value, inputs=[weights, biases])
        return value

    with torch.enable_grad():
        search.step(loss)
    weights = weights.detach()
    return weights.float(), (biases.detach() - weights @ middle).float()


# ---- files ----------------------------------------------------------------------------------------------------------


def _listed(folder: Path) -> list[Path]:
    try:
        return sorted(one for one in folder.iterdir() if not one.name.startswith("."))
    except OSError as error:
        raise InputError(
            f"references: expected a folder with a folder of pictures for each name, got {folder} "
            f"({error.strerror}); check the path"
        ) from None


def _pictures(folder: Path) -> Sequence[Path]:
    found = _listed(folder)
    if not found:
        raise InputError(f"references: expected pictures of {folder.name} in {folder}, got none; put some there")
    return found


def _cut(picture: Tensor, size: tuple[int, int]) -> Tensor:
    """Return the largest middle part of a picture (H, W, 3) that has the shape of the input."""
    height, width = picture.shape[:2]
    high = min(height, max(1, round(width * size[0] / size[1])))
    wide = min(width, max(1, round(height * size[1] / size[0])))
    top, left = (height - high) // 2, (width - wide) // 2
    return picture[top : top + high, left : left + wide]


def _batches(pictures: Iterator[Tensor]) -> Iterator[Tensor]:
    """Yield pictures of one size that follow each other as (N, H, W, 3), at most `AT_ONCE`."""
    for _, alike in itertools.groupby(pictures, key=lambda one: one.shape):
        while batch := list(itertools.islice(alike, AT_ONCE)):
            yield torch.stack(batch)


def _features(model: Model, pictures: Tensor, root: Path) -> Tensor:
    features: Tensor = model(pictures)
    if features.dim() != 2:
        raise InputError(f"model {model.name}: expected features (N, D), got {tuple(features.shape)}; use another task")
    return features
