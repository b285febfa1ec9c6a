"""``hf:REPOSITORY``: networks of transformers, from the Hugging Face hub or a folder.

Weights are read from safetensors only.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from torch import Tensor, nn
from torch.nn.functional import interpolate

from advsearch.extend import errors, models
from advsearch.models.zoo import language, outputs, zero_shot
from advsearch.models.zoo.library import (
    AdaptedNetwork,
    LoadedNetwork,
    RunNetwork,
    find_cached_file,
    load_processor,
    report_library_errors,
    to_pixel_corners,
)


class Family(NamedTuple):
    """Networks of transformers that are loaded and called alike.

    Attributes:
        matches: which architectures belong to the family: a regular expression that is
            found in their name ("ForImageClassification" in
            "DeiTForImageClassificationWithTeacher"); or a function of the name and of
            the network or its class.
        loader: suffix of the class that loads the network, "ForImageClassification" for
            AutoModelForImageClassification; None for the class of the architecture.
        source: makes the source of a network of the family.
    """

    matches: str | Callable[[str, Any], bool]
    loader: str | None
    source: Callable[[LoadedNetwork], models.Source]

    def includes(self, architecture: str, network: Any) -> bool:
        """Return whether an architecture belongs to the family.

        Args:
            architecture: its name.
            network: network of this architecture, or its class.
        """
        if isinstance(self.matches, str):
            return bool(re.search(self.matches, architecture))
        return self.matches(architecture, network)


HUB_TIMEOUT = 5.0
"""Timeout in seconds of the hub's first response. Without it, the hub's client would
try to fetch each file for half a minute.
"""

ADVICE = (
    "Give a folder that save_pretrained(..., safe_serialization=True) has made as "
    "'hf:FOLDER'"
)


def load(spec: str, purpose: models.Purpose) -> models.Source:
    """Load ``hf:REPOSITORY[@REVISION]`` or ``hf:FOLDER``.

    The network belongs to one of the families in `NETWORKS`. If it reads texts (modules
    `zero_shot` and `language`), its classes are the names that the user states;
    otherwise its labels are in its ``config``. Size, channel order and normalization
    are measured on its image processor (`library.measure_processor`); there is a
    ModelWarning if it has none. Code in a repository is never run, and weights are read
    from safetensors only. A repository that timm has saved is loaded by timm.

    Raises:
        ModelError: transformers is missing; the repository cannot be loaded or lacks
            weights; its network is of another kind or does not fit into the memory; or
            its processor does more than `Preprocessing` can do.
    """
    # "hf:NAME@REVISION"
    name, _, revision = spec.partition(":")[2].strip().partition("@")
    transformers = models.import_library("transformers", spec, "hf")
    name = _resolve_name(name, spec)
    if not sys.stderr.isatty():
        transformers.utils.logging.disable_progress_bar()
    with report_library_errors(spec, ADVICE):
        hub_options = _choose_hub_options(name, revision)
        saved = _load_config(transformers, name, spec, hub_options)
        # transformers reads the config of any network of timm as a "timm_wrapper". But
        # only a config that transformers has saved states "architectures".
        is_of_timm = saved.get("model_type") == "timm_wrapper"
        if is_of_timm and "architectures" not in saved:
            return outputs.load_timm_repository(spec, name, revision, purpose)
        family, network = _load_network(transformers, name, hub_options, spec)
        processor = load_processor(transformers, name, hub_options)
    loaded = LoadedNetwork(
        network=network,
        name=name.rstrip("/").rpartition("/")[2],
        spec=spec,
        processor=processor,
        load_component=partial(_load_part, transformers, spec, name, hub_options),
        purpose=purpose,
    )
    return family.source(loaded)


def _choose_hub_options(name: str, revision: str) -> dict[str, Any]:
    """Return arguments of the functions of transformers that read from the hub.

    Only files on this machine are read if the hub does not respond: its client would
    try each file for half a minute.

    Args:
        name: name of the repository or directory.
        revision: revision of the repository; "" for its default.
    """
    hub_options: dict[str, Any] = {"revision": revision} if revision else {}
    if not Path(name).is_dir() and _is_hub_unreachable(name):
        hub_options["local_files_only"] = True
    return hub_options


def _resolve_name(name: str, spec: str) -> str:
    """Return the absolute path of a directory, or the name of a repository as it is.

    Raises ModelError for a file, and for a path of a directory that does not exist.
    """
    if Path(name).is_dir():
        return str(Path(name).resolve())
    if Path(name).is_file():
        raise errors.ModelError(
            f"model {spec}: is a file; give the folder in which it "
            "is with its config.json"
        )
    # The name of a repository is OWNER/NAME, with at most one slash.
    is_path = name.startswith((".", "/", "~")) or name.count("/") > 1
    if is_path:
        raise errors.ModelError(
            f"model {spec}: no such folder{_suggest_folders(name)}; a repository is "
            "written hf:OWNER/NAME"
        )
    return name


def _load_network(
    transformers: Any, name: str, hub_options: Mapping[str, Any], spec: str
) -> tuple[Family, Any]:
    """Load the network of a repository or a directory, with its family.

    Args:
        transformers: the package.
        name: name of the repository or directory.
        hub_options: arguments of the package, such as a revision.
        spec: what the user wrote, for messages.

    Raises:
        ModelError: it belongs to no family, does not fit into the memory, or lacks
            weights.
    """
    config = transformers.AutoConfig.from_pretrained(
        name, trust_remote_code=False, **hub_options
    )
    # "none" is a name that no architecture has: `_find_family` rejects it.
    architecture = str((getattr(config, "architectures", None) or ["none"])[0])
    family = _find_family(architecture, getattr(transformers, architecture, None), spec)
    check_fits(transformers, name, hub_options, spec)
    loader = architecture if family.loader is None else f"AutoModel{family.loader}"
    network, report = getattr(transformers, loader).from_pretrained(
        name,
        use_safetensors=True,
        trust_remote_code=False,
        output_loading_info=True,
        **hub_options,
    )
    _check_weights(network, report, spec)
    return family, network


def find_transformers_source(
    network: nn.Module, purpose: models.Purpose
) -> models.Source | None:
    """Return the source of an existing network of transformers.

    None for any other network. Names of classes are in its ``config``. The
    preprocessing comes from the repository or directory from which it was loaded; there
    is a ModelWarning (by `LoadedNetwork.preprocessing`) if that has no image processor,
    or cannot be read any more.
    """
    transformers: Any = sys.modules.get("transformers")
    if transformers is None or not isinstance(network, transformers.PreTrainedModel):
        return None
    # The class of the network stands for its name in messages, too.
    spec = type(network).__name__
    family = _find_family(spec, network, spec)
    origin = str(getattr(network, "name_or_path", "") or "")
    hub_options = {"local_files_only": True}
    processor = None
    if origin:
        # The repository or directory may not exist any more.
        with suppress(errors.ModelError), report_library_errors(spec, advice=""):
            processor = load_processor(transformers, origin, hub_options)
    load_component = partial(_load_part, transformers, spec, origin, hub_options)
    loaded = LoadedNetwork(network, spec, spec, processor, load_component, purpose)
    return family.source(loaded)


def _load_part(
    transformers: Any,
    spec: str,
    name: str,
    hub_options: Mapping[str, Any],
    loader: str,
) -> Any:
    """Load a part of the repository of a network, such as its tokenizer.

    Args:
        transformers: the package.
        spec: what the user wrote, for messages.
        name: name of the repository or directory.
        hub_options: arguments of the package, such as a revision.
        loader: class of the package that loads it, such as "AutoTokenizer".
    """
    with report_library_errors(
        spec, "Give a repository, or a folder, that also has this part"
    ):
        return getattr(transformers, loader).from_pretrained(
            name, trust_remote_code=False, **hub_options
        )


def _find_family(architecture: str, network: Any, spec: str) -> Family:
    """Return the first of `NETWORKS` that an architecture belongs to.

    Args:
        architecture: name of the architecture.
        network: network of this architecture, or its class.
        spec: specification of the model, for messages.

    Raises:
        ModelError: it belongs to no family.
    """
    for family in NETWORKS:
        if family.includes(architecture, network):
            return family
    raise errors.ModelError(
        f"model {spec}: is a {architecture}; expected one whose name has "
        "ForImageClassification, ForVideoClassification, ForSemanticSegmentation, "
        "ForUniversalSegmentation, ForObjectDetection or ForDepthEstimation in it, "
        "one that compares images with texts, such as CLIPModel, one that continues "
        "a text, such as LlavaForConditionalGeneration, or one that has features, such "
        "as Dinov2Model. Wrap any other in an nn.Module whose output a task can read, "
        "and pass that from Python"
    )


def _load_config(
    transformers: Any, name: str, spec: str, hub_options: Mapping[str, Any]
) -> Mapping[str, Any]:
    """Return the config of a repository or a directory, as JSON values.

    Args:
        transformers: the package.
        name: name of the repository or directory.
        spec: what the user wrote, for messages.
        hub_options: arguments of the package, such as a revision.

    Raises:
        ModelError: it is a repository of open_clip, or cannot be found.
    """
    find_file = partial(find_cached_file, transformers, name, hub_options=hub_options)
    try:
        if not find_file("config.json") and find_file("open_clip_config.json"):
            raise _make_open_clip_error(spec)
        config: Mapping[str, Any] = transformers.PretrainedConfig.get_config_dict(
            name, **hub_options
        )[0]
        return config
    except OSError as error:
        if Path(name).is_dir():
            raise  # the error of the library says what is wrong with the directory
        raise _make_missing_error(name, spec, error) from error


def _make_open_clip_error(spec: str) -> errors.ModelError:
    """Return the error of a repository of open_clip."""
    return errors.ModelError(
        f"model {spec}: is a repository of open_clip, which transformers can't "
        "read; give the network as transformers has it, such as "
        "hf:openai/clip-vit-base-patch32 or hf:google/siglip-base-patch16-224"
    )


def _make_missing_error(name: str, spec: str, error: OSError) -> errors.ModelError:
    """Return the error for a repository that cannot be found.

    Args:
        name: name of the repository.
        spec: what the user wrote.
        error: error of the library.
    """
    cache = Path(import_module("huggingface_hub").constants.HF_HUB_CACHE)
    # names of repositories: "OWNER/NAME" is stored as "models--OWNER--NAME"
    cached = [
        folder.name.partition("--")[2].replace("--", "/")
        for folder in cache.glob("models--*")
    ]
    return errors.ModelError(
        f"model {spec}: {name} is no folder here{_suggest_folders(name)}, and no "
        "repository of that name is in the "
        f"cache{_format_suggestions(models.find_similar_names(name, cached))} or "
        f"can be downloaded ({models.get_first_line(error)}). Check the name and "
        "the connection, or give a folder"
    )


def _is_hub_unreachable(name: str) -> bool:
    """Return whether the hub gives no response to a question about a repository.

    An error such as "not found" is a response: then the hub can be reached.
    """
    hub = import_module("huggingface_hub")
    try:
        hub.get_hf_file_metadata(
            hub.hf_hub_url(name, "config.json"), timeout=HUB_TIMEOUT
        )
    except Exception as error:  # the client uses libraries with errors of many types
        # Errors of HTTP have the hub's response as an attribute.
        return getattr(error, "response", None) is None
    return False


def _suggest_folders(name: str) -> str:
    """Return a question that suggests directories with a similar name.

    It is "" if there are none.
    """
    path = Path(name).expanduser()
    siblings = []
    if path.parent.is_dir():
        siblings = [entry.name for entry in path.parent.iterdir() if entry.is_dir()]
    similar = models.find_similar_names(path.name, siblings)
    return _format_suggestions([str(path.parent / sibling) for sibling in similar])


def _format_suggestions(names: Sequence[str]) -> str:
    """Return a question that suggests directories or repositories, "" without names."""
    specs = [f"'hf:{name}'" for name in names[:3]]
    return f" (did you mean {' or '.join(specs)}?)" if specs else ""


def _check_weights(network: Any, report: Any, spec: str) -> None:
    """Check that all weights come from the files: missing ones would be random.

    Only the pooler may be missing, the layer after the first token. It is removed, so
    that the first token itself has the features.

    Args:
        network: the network.
        report: what `from_pretrained` reports: "missing_keys" and "mismatched_keys".
        spec: what the user wrote, for the message.

    Raises:
        ModelError: weights are missing.
    """
    mismatched = [key for key, *_ in report.get("mismatched_keys", ())]
    missing = sorted({*report.get("missing_keys", ()), *mismatched})
    if not missing:
        return
    is_pooler_only = all(str(key).startswith("pooler.") for key in missing)
    if getattr(network, "pooler", None) and is_pooler_only:
        network.pooler = None
        return
    examples = ", ".join(map(str, missing[:3])) + (", ..." if len(missing) > 3 else "")
    raise errors.ModelError(
        f"model {spec}: its files lack {len(missing)} of the network's weights "
        f"({examples}), which would be random. "
        "Give a repository that was trained for this task, not only pretrained"
    )


def _run_classifier(network: Any, images: Tensor) -> Tensor:
    """Return the logits of a network for images (N, 3, H, W)."""
    logits: Tensor = network(pixel_values=images).logits
    return logits


def _run_segmenter(network: Any, images: Tensor) -> Tensor:
    """Return the logits (N, classes, H, W) of a segmenter at the size of the images."""
    return interpolate(
        _run_classifier(network, images), size=images.shape[2:], mode="bilinear"
    )


def _run_detector(network: Any, images: Tensor) -> tuple[Tensor, Tensor]:
    """Return boxes and scores of a detector, without suppression of boxes.

    Returns:
        Boxes (N, queries, 4) in pixels, x0, y0, x1, y1; and scores (N, queries,
        classes) in [0, 1].
    """
    returned = network(pixel_values=images)
    boxes = to_pixel_corners(returned.pred_boxes, images)
    # In some networks the additional last class means no object. They choose one class
    # for each box (Carion et al. 2020); others score each class independently.
    if returned.logits.shape[-1] > len(network.config.id2label):
        return boxes, returned.logits.softmax(dim=-1)[..., :-1]
    return boxes, returned.logits.sigmoid()


def _make_named_source(
    run_network: RunNetwork, *, returns_pixel_boxes: bool = False
) -> Callable[[LoadedNetwork], models.Source]:
    """Return a function that makes the source of a network with class names.

    The class names are in the network's ``config``.

    Args:
        run_network: calls the network on images (N, 3, H, W).
        returns_pixel_boxes: whether the output has boxes as corners in pixels.
    """
    return lambda loaded: loaded.make_source(
        run_network,
        returns_pixel_boxes=returns_pixel_boxes,
        labels=loaded.class_names or None,
    )


class _FrameProcessor:
    """Call a processor of videos on one image, as a video of one frame."""

    def __init__(self, processor: Any) -> None:
        self.processor = processor

    def __call__(self, images: Any, **settings: Any) -> Mapping[str, Any]:
        """Process an image as the only frame of a video."""
        video = self.processor([images], **settings)["pixel_values"]
        return {"pixel_values": video[0]}

    def __getattr__(self, name: str) -> Any:
        return getattr(self.processor, name)


def _make_video_source(loaded: LoadedNetwork) -> models.Source:
    """Return the source of a classifier of videos (N, T, 3, H, W).

    The T frames of a video are rendered as the images of a rig: by a camera that moves,
    or by several cameras.
    """
    config = loaded.network.config
    if loaded.processor is not None:
        loaded = replace(loaded, processor=_FrameProcessor(loaded.processor))
    network = AdaptedNetwork(loaded.network, _run_classifier)
    # All frames of a video are passed to the network in one call.
    module = models.AllAtOnce(network, cameras=int(config.num_frames))
    return models.make_source(
        module,
        loaded.name,
        labels=loaded.class_names or None,
        **loaded.get_sized_preprocessing(config),
    )


NETWORKS = (
    Family("ForVideoClassification", "ForVideoClassification", _make_video_source),
    Family(
        "TimmWrapperForImageClassification",
        "ForImageClassification",
        outputs.make_wrapped_timm_source,
    ),
    Family(
        "ForImageClassification",
        "ForImageClassification",
        partial(outputs.make_feature_source, plain=_make_named_source(_run_classifier)),
    ),
    Family(
        "ForSemanticSegmentation",
        "ForSemanticSegmentation",
        _make_named_source(_run_segmenter),
    ),
    Family(outputs.MASKS, "ForUniversalSegmentation", outputs.make_mask_source),
    Family(
        f"^({'|'.join(zero_shot.DETECTORS)})$",
        "ForZeroShotObjectDetection",
        zero_shot.make_detector_source,
    ),
    Family(
        "ForObjectDetection",
        "ForObjectDetection",
        _make_named_source(_run_detector, returns_pixel_boxes=True),
    ),
    Family(
        language.generates_text, "ForImageTextToText", language.make_language_source
    ),
    Family("ForDepthEstimation", "ForDepthEstimation", outputs.make_depth_source),
    Family(
        lambda _, network: zero_shot.encodes_images_and_texts(network),
        "",
        partial(outputs.make_feature_source, plain=zero_shot.make_zero_shot_source),
    ),
    Family(outputs.gives_features, None, outputs.make_feature_source),
)
"""All supported families. The first one that matches counts, so that the most specific
ones come first.
"""


MEMORY_FILE = Path("/proc/meminfo")  # Linux's file of memory sizes


def check_fits(
    transformers: Any, name: str, hub_options: Mapping[str, Any], spec: str
) -> None:
    """Check that the weights of a network fit into the free memory, swap included.

    They keep the dtype in which they are stored. Nothing is checked if the system does
    not report its free memory.

    Args:
        transformers: the package.
        name: name of the repository or directory.
        hub_options: arguments of the package, such as a revision.
        spec: what the user wrote, for messages.

    Raises:
        ModelError: the weights are larger than the free memory.
    """
    free = _read_free_memory()
    if free is None:
        return
    size = _measure_weights(transformers, name, hub_options)
    if size > free:
        raise errors.ModelError(
            f"model {spec}: its weights take {size / 1e9:.3g} GB, and {free / 1e9:.3g} "
            "GB of memory are free. Give a smaller network, one whose weights are "
            "stored in bfloat16, or a machine with more memory"
        )


def _measure_weights(
    transformers: Any, name: str, hub_options: Mapping[str, Any]
) -> int:
    """Return the size in bytes of the weights of a repository; 0 if it is unknown.

    The arguments are those of `check_fits`.
    """
    find_file = partial(find_cached_file, transformers, name, hub_options=hub_options)
    index = find_file("model.safetensors.index.json")
    if index:  # the index of weights that are stored in several files
        metadata = json.loads(Path(index).read_text(encoding="utf-8"))
        return int(metadata.get("metadata", {}).get("total_size", 0))
    weights = find_file("model.safetensors")
    return Path(weights).stat().st_size if weights else 0


def _read_free_memory() -> int | None:
    """Return the free memory in bytes, swap included; None if it is unknown."""
    try:
        # lines such as "MemAvailable:   16302192 kB"
        lines = MEMORY_FILE.read_text(encoding="ascii").splitlines()
        kilobytes = {
            line.partition(":")[0]: int(line.split()[1])
            for line in lines
            if len(line.split()) > 1
        }
        return 1024 * (kilobytes["MemAvailable"] + kilobytes.get("SwapFree", 0))
    except (OSError, ValueError, KeyError):
        return None
