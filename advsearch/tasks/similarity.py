"""Task for similarity: which reference images are nearest, by the cosine of features?

With a gallery, a folder of images for each name, it is a classification among these
names. Without a gallery, a prediction is right if the features are similar to those of
the clean image.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from advsearch.extend import InputError, Model, models, stored_files, tasks

MAX_REFERENCES = 10_000  # maximum number of images in a gallery, before `scale_limit`
# Maximum size of a loaded image in pixels; larger ones are reduced.
MAX_IMAGE_SIZE = 1024
BATCH_SIZE = 16  # batch size for embedding
# Weight of the squared weights of a linear head, next to a mean cross-entropy in nats.
WEIGHT_PENALTY = 1e-3
# Maximum number of iterations of the fit; it usually converges after a few dozen.
MAX_ITERATIONS = 500


@dataclass(frozen=True, eq=False)
class Gallery:
    """Embedded reference images.

    Attributes:
        names: names of the folders, in order.
        name_index: (R,) int64, the index of each image's name.
        paths: path of each image, relative to the folder.
        features: (R, D), of length 1.
        embedder: the network that embedded the images, and its preprocessing.
        linear_head: linear head of the method "linear": weights (names, D) and biases
            (names,). None for other methods.
    """

    names: tuple[str, ...]
    name_index: Tensor
    paths: tuple[str, ...]
    features: Tensor
    embedder: tuple[Any, ...] = field(repr=False)
    linear_head: tuple[Tensor, Tensor] | None = field(default=None, repr=False)

    def compute_cosines(self, features: Tensor) -> Tensor:
        """Compute the cosines (N, R) between features (N, D) of length 1 and each
        image.
        """
        return features @ self.features.to(features).T

    def average_nearest(self, features: Tensor, k: int) -> Tensor:
        """Compute the mean cosine to the k nearest images of each name, (N, names).

        Args:
            features: (N, D), of length 1.
            k: number of images, if a name has as many.
        """
        cosines = self.compute_cosines(features)  # (N, R)
        name_of_image = self.name_index.to(features.device)
        name_scores = []
        for name_index in range(len(self.names)):
            name_cosines = cosines[:, name_of_image == name_index]
            n_nearest = min(k, name_cosines.shape[1])
            nearest = name_cosines.topk(n_nearest, dim=1).values
            name_scores.append(nearest.mean(dim=1))
        return torch.stack(name_scores, dim=1)


def list_name_folders(folder: str) -> list[tuple[str, Path]]:
    """List the names in a folder with their folders, in alphabetical order.

    Hidden folders are left out.

    Raises:
        InputError: it does not exist, or has fewer than two names.
    """
    root = Path(folder).expanduser()
    folders = [(entry.name, entry) for entry in _list_visible(root) if entry.is_dir()]
    if len(folders) < 2:
        got = f"only {folders[0][0]}" if folders else "no folder"
        raise InputError(
            f"references: expected two folders of pictures at least in {root}, each "
            f"called by its name, such as mug and bowl, got {got}"
        )
    return folders


def embed_gallery(folder: str, model: Model, *, linear: bool) -> Gallery:
    """Embed the reference images in a folder, which has one folder per name.

    An image is turned upright, cropped at its center to the shape of the model's input,
    and then preprocessed like a rendered one. The result is deterministic.

    Args:
        folder: folder with the folders.
        model: model that returns features.
        linear: fit a linear head on the features.

    Raises:
        InputError: the folder has fewer than two names, or a name has no image, or the
            model returns features that are not (N, D) or not finite.
        FileFormatError: a file is no image or is too large, or there are too many.
    """
    named_folders = list_name_folders(folder)
    root = Path(folder).expanduser()
    paths, name_indices = _list_references(root, named_folders)
    features = _embed_images(paths, model)
    name_index = torch.tensor(name_indices)
    return Gallery(
        names=tuple(name for name, _ in named_folders),
        name_index=name_index,
        paths=tuple(path.relative_to(root).as_posix() for path in paths),
        features=features,
        embedder=(model.module, model.preprocessing),
        linear_head=fit_linear_head(features, name_index) if linear else None,
    )


def _list_references(
    root: Path, named_folders: Sequence[tuple[str, Path]]
) -> tuple[list[Path], list[int]]:
    """List the reference images in folders, and for each the index of its folder.

    Args:
        root: folder that the folders are in, for messages.
        named_folders: name and path of each folder.

    Raises:
        InputError: a folder is empty.
        FileFormatError: there are too many images.
    """
    paths: list[Path] = []
    name_indices: list[int] = []
    for index, (name, name_folder) in enumerate(named_folders):
        image_paths = _list_visible(name_folder)
        if not image_paths:
            raise InputError(
                f"references: expected pictures of {name} in {name_folder}, got "
                "none; put some there"
            )
        paths += image_paths
        name_indices += [index] * len(image_paths)
    _check_reference_count(paths, root)
    return paths, name_indices


def _check_reference_count(paths: Sequence[Path], root: Path) -> None:
    """Raise FileFormatError if there are too many reference images in a folder."""
    limit = stored_files.scale_limit(MAX_REFERENCES)
    if len(paths) > limit:
        raise stored_files.make_size_error(
            root, f"at most {limit:,} reference pictures", f"{len(paths):,}"
        )


def _embed_images(paths: Sequence[Path], model: Model) -> Tensor:
    """Compute the features (R, D) of length 1 of the images in files, in batches.

    Raises:
        InputError: the model returns no features (N, D), or some that are not finite.
        FileFormatError: a file is no image or is too large.
    """
    # A generator: images are loaded one by one, when a batch below needs them. They have
    # the aspect ratio of the model's input, but their sizes may differ.
    images = (_load_cropped(path, model.input_size) for path in paths)
    batches: list[Tensor] = []
    with torch.no_grad():
        # All images of a batch have the same size. `groupby` keeps the order of the
        # files: it joins neighbors of the same size.
        for _, same_size in itertools.groupby(images, key=lambda image: image.shape):
            # the next images of this size, until there are none
            while batch := list(itertools.islice(same_size, BATCH_SIZE)):
                batches.append(_embed_batch(torch.stack(batch), model))
    features = torch.cat(batches)
    is_non_finite = ~features.isfinite().all(dim=1)
    if bool(is_non_finite.any()):
        first = int(is_non_finite.nonzero()[0])
        raise InputError(
            f"references: model {model.name} returns NaN or infinity for {paths[first]}"
        )
    return functional.normalize(features, dim=1)


def _load_cropped(path: Path, size: tuple[int, int]) -> Tensor:
    """Load an image (H, W, 3), cropped around its center to the aspect ratio of a size."""
    image = torch.from_numpy(models.load_upright(path, MAX_IMAGE_SIZE))
    return _crop_center(image, size)


def _embed_batch(images: Tensor, model: Model) -> Tensor:
    """Return the features (N, D) of images (N, H, W, 3); InputError for another shape."""
    features: Tensor = model(images)
    if features.dim() != 2:
        raise InputError(
            f"model {model.name}: expected features (N, D), "
            f"got {tuple(features.shape)}; use another task"
        )
    return features


def fit_linear_head(features: Tensor, name_index: Tensor) -> tuple[Tensor, Tensor]:
    """Fit a multinomial logistic regression of names on features.

    Names have equal weights, however many images they have. The loss is convex, so its
    minimum is unique; it is found by L-BFGS from zero in float64, as Radford et al.
    2021 (arXiv 2103.00020, section A.3) fit theirs.

    Args:
        features: (R, D).
        name_index: (R,) int64, the index of each row's name.

    Returns:
        Weights (names, D) and biases (names,), float32.
    """
    n_names = int(name_index.max()) + 1
    images_per_name = torch.bincount(name_index, minlength=n_names).double()
    # The weights of the images of one name add up to 1 / n_names.
    image_weights = 1.0 / (n_names * images_per_name[name_index])
    # The fit is faster with centered features. With bias b, w (x - center) + b is
    # w x + (b - w center): so the bias is shifted at the end.
    center = features.double().mean(dim=0)
    centered = features.double() - center
    weights, biases = _minimize_cross_entropy(centered, name_index, image_weights)
    shifted_biases = biases - weights @ center
    return weights.float(), shifted_biases.float()


def _minimize_cross_entropy(
    features: Tensor, name_index: Tensor, image_weights: Tensor
) -> tuple[Tensor, Tensor]:
    """Return weights (names, D) and biases (names,) of the least penalized loss, float64.

    Args:
        features: (R, D) float64.
        name_index: (R,) int64, the index of each row's name.
        image_weights: (R,) float64, weight of each row's cross-entropy.
    """
    n_names = int(name_index.max()) + 1
    weights = torch.zeros(
        n_names, features.shape[1], dtype=torch.float64, requires_grad=True
    )
    biases = torch.zeros(n_names, dtype=torch.float64, requires_grad=True)
    optimizer = _make_lbfgs_optimizer([weights, biases])

    def closure() -> Tensor:
        """Return the loss, with its gradients by weights and biases."""
        optimizer.zero_grad()
        logits = functional.linear(features, weights, biases)
        image_loss = functional.cross_entropy(logits, name_index, reduction="none")
        loss = _add_penalty((image_weights * image_loss).sum(), weights)
        torch.autograd.backward(loss, inputs=[weights, biases])
        return loss

    with torch.enable_grad():
        optimizer.step(closure)
    return weights.detach(), biases.detach()


def _make_lbfgs_optimizer(parameters: list[Tensor]) -> torch.optim.LBFGS:
    """Return the optimizer of a smooth loss; one step of it minimizes the loss."""
    return torch.optim.LBFGS(
        parameters,
        max_iter=MAX_ITERATIONS,
        tolerance_grad=1e-8,
        tolerance_change=1e-12,
        line_search_fn="strong_wolfe",
    )


def _add_penalty(loss: Tensor, weights: Tensor) -> Tensor:
    """Return a loss plus the penalty of weights (names, D): half the sum of their
    squares, times `WEIGHT_PENALTY`.
    """
    penalty = WEIGHT_PENALTY / 2.0 * weights.square().sum()
    penalized_loss: Tensor = loss + penalty
    return penalized_loss


def _list_visible(folder: Path) -> list[Path]:
    """List what is in a folder of references and not hidden, sorted by name.

    Raises:
        InputError: it is no folder, or cannot be read.
    """
    try:
        return sorted(
            path for path in folder.iterdir() if not path.name.startswith(".")
        )
    except OSError as error:
        raise InputError(
            "references: expected a folder with a folder of pictures for each name, "
            f"got {folder} ({error.strerror}); check the path"
        ) from None


def _crop_center(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Crop an image (H, W, 3) around its center to the aspect ratio of a size.

    `size` is (height, width); only their ratio counts, nothing is resized.
    """
    height, width = image.shape[:2]
    crop_height = min(height, max(1, round(width * size[0] / size[1])))
    crop_width = min(width, max(1, round(height * size[1] / size[0])))
    top = (height - crop_height) // 2
    left = (width - crop_width) // 2
    return image[top : top + crop_height, left : left + crop_width]


METHODS = ("nearest", "linear")  # methods that compute logits from features

TEMPERATURE = 0.07
"""Divisor that turns cosines into logits (Wu et al. 2018, arXiv 1805.01978, section 4.1;
Caron et al. 2021, arXiv 2104.14294, section 4.1).
"""

ITSELF = "itself"
SOMETHING_ELSE = "something else"
"""The predictions of a task with a threshold."""


@dataclass(frozen=True, kw_only=True)
class Similarity(tasks.Classification):
    """Judge whether an image is most similar to the right reference images.

    With a threshold, it is compared with the clean image.

    The output is features (N, D) of any length. With `references` the truth is the
    indices of the right names, and logits (N, names) are computed from the features by
    `method`:

    - `nearest`: the mean cosine of the `k` nearest images of each name, over
      `TEMPERATURE`. Each name is scored by its own images. So names with many images
      have no advantage, and the logit of every name has a gradient. With k = 1, the
      default, a prediction is right if and only if the nearest image of all has a right
      name. With a larger k, no single image decides.
    - `linear`: the outputs of a logistic regression on the reference features, of
      length 1 (`fit_linear_head`).

    With `threshold` there are two logits: the cosine to the clean image's features, and
    the threshold, both over `TEMPERATURE`.

    Args:
        references: folder with a folder of images for each name; "" for none.
        method: one of `METHODS`.
        k: number of nearest images of each name that count.
        threshold: minimum cosine of an image that counts as similar to the clean one;
            None if there are references.

    Raises:
        InputError: an option is out of range, or options exclude each other.
    """

    name = "similarity"
    reads_logits = False
    names_source = "its folders"

    references: str = ""
    method: str = METHODS[0]
    k: int = 1
    threshold: float | None = None
    gallery: Gallery | None = field(
        default=None, compare=False, repr=False, metadata=tasks.FROM_RUN
    )
    # (D,), of length 1
    clean_features: Tensor | None = field(
        default=None, compare=False, repr=False, metadata=tasks.FROM_RUN
    )

    def __post_init__(self) -> None:
        """Check that all options are within their limits and fit each other."""
        super().__post_init__()
        if self.method not in METHODS:
            raise InputError(
                f"task similarity: method: expected one of {', '.join(METHODS)}, got "
                f"{self.method!r}"
            )
        self._check_k()
        if self.threshold is not None:
            self._check_cosine_threshold()

    def _check_cosine_threshold(self) -> None:
        """Raise InputError if the threshold is no cosine, or there are references."""
        self.check_numbers(
            lambda bar: -1.0 < bar < 1.0, "a cosine between -1 and 1", "threshold"
        )
        if self.references:
            raise InputError(
                "task similarity: threshold: compares with the clean "
                "picture; leave `references` out"
            )

    def _check_k(self) -> None:
        """Raise InputError if `k` is no number from 1 on, or does not fit the method."""
        if isinstance(self.k, bool) or not isinstance(self.k, int) or self.k < 1:
            raise InputError(
                "task similarity: k: expected a whole number of at least "
                f"1, got {self.k!r}"
            )
        if self.method == "linear" and self.k != 1:
            raise InputError(
                "task similarity: k: is an option of `method: nearest`; leave "
                "one of the two out"
            )

    def on(
        self, model: Model, *, target: str | None = None, minimise: bool = False
    ) -> Similarity:
        """Return the task for a model, with the features of its reference images.

        If the task has a gallery already, which the same network with the same
        preprocessing has embedded, references are not embedded again.

        Args:
            model: model that returns features.
            target: name that the attack seeks; None for any wrong one.
            minimise: whether a right prediction is sought.

        Raises:
            InputError: there are neither references nor a threshold, a target has no
                references, or the folder of references does not fit.
            FileFormatError: a reference is no image or is too large.
        """
        self._check_comparison(target)
        task = super().on(model, target=target, minimise=minimise)
        embedder = (model.module, model.preprocessing)
        is_embedded = self.gallery is not None and self.gallery.embedder == embedder
        if is_embedded or not self.references:
            return task
        gallery = embed_gallery(self.references, model, linear=self.method == "linear")
        return replace(task, gallery=gallery)

    def _check_comparison(self, target: str | None) -> None:
        """Raise InputError if there is nothing to compare with, or a target has no
        references.
        """
        if not self.references and self.threshold is None:
            raise InputError(
                "task similarity: references: expected a folder with a folder of "
                "pictures for each name, or a `threshold` of the cosine to the clean "
                "picture, got neither; write `task='similarity={references: FOLDER}'` "
                "or `task='similarity={threshold: 0.8}'`"
            )
        if target is not None and not self.references:
            raise InputError(
                "target: with a `threshold` there are no names; set `references` "
                "of task similarity"
            )

    def _get_model_labels(self, model: Model) -> tuple[tuple[str, ...], bool]:
        if not self.references:
            return (ITSELF, SOMETHING_ELSE), True
        return tuple(name for name, _ in list_name_folders(self.references)), True

    def find_right_classes(self, facts: tasks.Facts) -> tasks.Labels:
        """Return the indices of the right names for an object in the scene.

        With references they come from the object's label. With a threshold there are
        two classes, `ITSELF` (the object in the clean image) and `SOMETHING_ELSE`, of
        which the first, with the index 0, is right.

        Args:
            facts: ground truth of the object, such as its label.
        """
        if self.references:
            return super().find_right_classes(facts)
        is_label_set_by_user = facts.label is not None
        if is_label_set_by_user:
            raise InputError(
                "label: with a `threshold` there are no names, and the clean picture "
                "is the truth; leave it out"
            )
        return (0,)

    @property
    def calibrates(self) -> bool:
        return not self.references and self.clean_features is None

    def after_calibration(
        self, output: Tensor, truth: tasks.Labels | None
    ) -> Similarity:
        """Store the features of the clean image, with which others are compared."""
        # With references no features are compared; and they are stored only once.
        if not self.calibrates:
            return self
        features = functional.normalize(output.detach().float(), dim=1)
        return replace(self, clean_features=features[0])  # of the only image

    def read(self, returned: Any, count: int) -> Tensor:
        """Read features (count, D) from what a network returned.

        They are the tensor itself, the first of a tuple, or a component with one of the
        names in `PARTS`. Of `last_hidden_state` (N, tokens, D) the first token (CLS) is
        taken; a feature map is averaged over its positions.

        Args:
            returned: what the network returned.
            count: number of images.

        Raises:
            ValueError: there are no features of this shape.
        """
        # A named tuple has another type; its components are found by their names.
        is_plain_sequence = type(returned) in (tuple, list) and len(returned) > 0
        if is_plain_sequence:
            returned = returned[0]
        # None if there are no features; `token` selects the first token
        features = models.pooled(returned, token=True)
        if features is None or features.dim() != 2 or features.shape[0] != count:
            raise ValueError(
                f"expected features ({count}, D), or an output with one of "
                f"{', '.join(models.PARTS)}"
            )
        return features.float()

    def compute_logits(self, output: Tensor) -> Tensor:
        """Compute logits (N, names) of features (N, D); differentiable.

        With a linear head they are its outputs. By the method "nearest", the score of a
        name is the mean cosine to its k nearest reference images; divided by the
        temperature it is a logit.
        """
        features = functional.normalize(output, dim=1)
        if self.gallery is None:
            return self._compute_threshold_logits(features)
        if self.method == "linear":
            assert self.gallery.linear_head is not None
            weights, biases = self.gallery.linear_head
            return functional.linear(
                features, weights.to(features), biases.to(features)
            )
        scores = self.gallery.average_nearest(features, self.k)
        return scores / TEMPERATURE

    def _compute_threshold_logits(self, features: Tensor) -> Tensor:
        """Compute the logits (N, 2) of `ITSELF` and `SOMETHING_ELSE`.

        They are the cosine to the clean image and the threshold, both divided by the
        temperature. So the first class wins where the cosine exceeds the threshold.

        Args:
            features: (N, D), of length 1.

        Raises:
            InputError: there is no clean image, or no threshold.
        """
        if self.clean_features is None or self.threshold is None:
            raise InputError(
                "task similarity: expected references, or a clean picture before "
                "other pictures"
            )
        cosine = features @ self.clean_features.to(features)
        threshold = torch.full_like(cosine, self.threshold)
        return torch.stack([cosine, threshold], dim=1) / TEMPERATURE

    def as_logits(self, output: Tensor, truth: tasks.Labels) -> Tensor:
        return super().as_logits(self.compute_logits(output), truth)

    def judge(self, output: Tensor, truth: tasks.Labels) -> list[tasks.Judgement]:
        """Judge the features of each image.

        The payload has the ranks of the right references (`_rank_references`); without
        references, the cosine to the clean image.
        """
        with torch.no_grad():
            judgements = super().judge(output, truth)
            payloads = self._make_payloads(output, truth)
        return [
            replace(
                judgement,
                # an output of NaN has neither cosine nor ranks
                payload=payload if math.isfinite(judgement.margin) else None,
            )
            for judgement, payload in zip(judgements, payloads, strict=True)
        ]

    def _make_payloads(
        self, output: Tensor, truth: tasks.Labels
    ) -> list[dict[str, tasks.JsonValue]]:
        """Return the payload of each image: ranks, or the cosine to the clean image.

        Args:
            output: features (N, D).
            truth: indices of the right names.
        """
        features = functional.normalize(output, dim=1)
        if self.gallery is not None:
            logits = self.as_logits(output, truth)
            return _rank_references(self.gallery, features, logits, truth)
        assert self.clean_features is not None
        cosines = (features @ self.clean_features.to(features)).tolist()
        return [{"cosine": round(cosine, 4)} for cosine in cosines]


def _rank_references(
    gallery: Gallery, features: Tensor, logits: Tensor, truth: tasks.Labels
) -> list[dict[str, tasks.JsonValue]]:
    """Rank the right reference images and the right names for each of N images.

    Args:
        gallery: gallery of R references.
        features: (N, D), of length 1.
        logits: (N, names).
        truth: indices of the right names.

    Returns:
        Payloads with the `rank` of the nearest right reference among all `references`
        (1 if it is the nearest) and its `cosine`; the `name_rank` of the best right name
        among all names, by its logit; and the path of the `nearest` reference with its
        cosine.
    """
    right_names = torch.tensor(truth)
    cosines = gallery.compute_cosines(features)
    is_right_image = torch.isin(gallery.name_index, right_names).to(cosines.device)
    right_cosine = cosines[:, is_right_image].amax(dim=1)
    is_nearer = cosines[:, ~is_right_image] > right_cosine[:, None]
    image_rank = 1 + is_nearer.sum(dim=1)
    name_rank = _rank_right_name(logits, right_names)
    nearest_cosine, nearest_image = cosines.max(dim=1)
    return [
        {
            "rank": int(image_rank[row]),
            "references": len(gallery.paths),  # their number
            "cosine": round(float(right_cosine[row]), 4),
            "name_rank": int(name_rank[row]),
            "nearest": gallery.paths[int(nearest_image[row])],
            "nearest_cosine": round(float(nearest_cosine[row]), 4),
        }
        for row in range(len(features))
    ]


def _rank_right_name(logits: Tensor, right_names: Tensor) -> Tensor:
    """Return the rank (N,) of the best right name among all names, by logits (N, names)."""
    is_right_name = torch.isin(torch.arange(logits.shape[1]), right_names)
    is_right_name = is_right_name.to(logits.device)
    right_logit = logits[:, is_right_name].amax(dim=1, keepdim=True)
    return 1 + (logits[:, ~is_right_name] > right_logit).sum(dim=1)
