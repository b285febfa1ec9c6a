"""Store and read counterexamples: adversarial scenes of runs that a suite tests again.

Each is a small file and a thumbnail in a directory next to the suite.
"""

from __future__ import annotations

import base64
import hashlib
import io
import json
import lzma
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isqrt
from pathlib import Path
from typing import Any, TypeAlias, TypeGuard

import numpy as np
import torch
from PIL import Image
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from torch import Tensor

from advsearch.extend import (
    AttackConfig,
    InputError,
    Problem,
    RunDirectory,
    SceneConfig,
    SceneDescription,
    directory,
    errors,
    seeds,
    settings,
    statistics,
    stored_files,
    tasks,
    workbench,
    writing,
)
from advsearch.questions.test.result import FAILED, HELD, UNDECIDED, VERDICTS
from advsearch.questions.test.settings import Suite

Floats: TypeAlias = np.ndarray[Any, np.dtype[np.float32]]

MAX_FINE_VALUES = 4096
FINE_STEP = 1.0 / 32767.0
COARSE_STEP = 1.0 / 255.0
"""Limits of quantization.

A block of up to `MAX_FINE_VALUES` values is stored in steps of `FINE_STEP`. A larger
block, such as the texels of a texture, is stored in one of `FORMS`; the finest of these
has steps of `COARSE_STEP`.
"""

FORMS = ((True, 4), (True, 2), (True, 1), (False, 1))
"""Forms in which the values of a large block are stored, the smallest form first.

A form is a pair. Its first element is whether only the sign of a value is stored (a
step up, down or none). The second one is the side of the squares of texels that share a
value, so that the file has fewer of them.
"""

# suffix of the picture
PICTURE_SUFFIX = ".jpg"
# longest side of the picture, pixels
THUMBNAIL_SIDE = 128
# maximum bytes of a file, and maximum values of a configuration
MAX_SIZE = 1 << 24
# maximum bytes of memory to decompress a block
MAX_MEMORY = 1 << 27
# number of fresh renders that test a scene
N_TRIALS_OF_SCENE = 6
# number of fresh renders that test a scene under varying conditions, such as light
N_TRIALS_OVER_CONDITIONS = 20


def count_trials(*, has_conditions: bool) -> int:
    """Return the number of fresh renders that test a counterexample.

    Args:
        has_conditions: whether conditions vary.
    """
    return N_TRIALS_OVER_CONDITIONS if has_conditions else N_TRIALS_OF_SCENE


MODEL_SETTINGS = ("model", "labels", "prompt", "value_range", "ask", "ensemble")
"""Settings of the network under test.

They belong together: if the suite names a model, all of them are those of the suite.
"""

SUITE_SETTINGS = (
    *settings.RUN_LOCATION,
    "threads",
    "deterministic",
    "workers",
    "cluster",
    "seconds",
    "log",
)
"""Settings of how and where a run computes."""

SEARCH_SETTINGS = (
    *(
        "policy",
        "steps",
        "metrics",
        "average",
        "baseline",
        "trials",
        "measure",
        "estimator",
        "draws",
    ),
    *("aov", "printable", "spp", "verify_spp"),
)
"""Settings of the search for the adversarial scene.

The samples of its verification are stored separately.
"""

NOT_DECIDING = frozenset({*SUITE_SETTINGS, *SEARCH_SETTINGS, "ask"})
"""Settings of a run that are not stored with its adversarial scene.

Every other setting may decide a verdict, and is stored.
"""


class _Block(BaseModel):
    """Quantized offsets of some values from the clean scene; see `FORMS`.

    Attributes:
        numbers: number of values n.
        step: size of a quantization step.
        signs: whether each value is only -1, 0 or 1 steps.
        square: side of the squares of texels that share a value.
        offsets: steps of all values or squares, compressed (LZMA), as text in base 85.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    numbers: int = Field(ge=1, le=MAX_SIZE)
    step: float = Field(gt=0.0, le=1.0)
    signs: bool
    square: int = Field(ge=1, le=4)
    offsets: str

    @classmethod
    def quantize(cls, values: Floats, signs: bool, square: int) -> _Block:
        """Quantize and compress offsets (n,) from the clean scene.

        Offsets become integer multiples of a step. For large blocks, such as textures,
        only signs or only one value for each square of texels may be stored, so that
        the file of a counterexample is small.

        Args:
            values: the offsets.
            signs: whether to store only signs; ignored for few values.
            square: side of the squares of texels that share a value; ignored unless
                the values are a texture (side, side, 3) that such squares tile.
        """
        is_small = len(values) <= MAX_FINE_VALUES
        stores_signs = signs and not is_small
        step = _choose_quantum(values, is_small=is_small, stores_signs=stores_signs)
        square_values = values
        side = isqrt(len(values) // 3)  # if it is a texture
        if is_small or not _has_squares(len(values), square):
            square = 1
        if square > 1:
            square_values = _average_squares(values, side, square)
        # little-endian 16-bit integers, the same on all machines
        steps = np.round(square_values / step).astype("<i2")
        data = _pack_signs(steps) if stores_signs else steps.tobytes()
        compressed = lzma.compress(data, lzma.FORMAT_ALONE)
        return cls(
            numbers=len(values),
            step=step,
            signs=stores_signs,
            square=square,
            offsets=base64.b85encode(compressed).decode("ascii"),
        )

    def dequantize(self) -> Floats:
        """Return the offsets, (n,) float32.

        Raises:
            ValueError, LZMAError: the stored offsets are corrupt.
        """
        steps = self._decompress_steps()
        if self.square > 1:
            # Only textures (side, side, 3) have squares. Each step is repeated for all
            # texels of its square.
            n_squares = isqrt(self.numbers // 3) // self.square  # along each side
            squares = steps.reshape(n_squares, n_squares, 3)
            texels = squares.repeat(self.square, axis=0).repeat(self.square, axis=1)
            steps = texels.ravel()
        offsets: Floats = steps.astype(np.float32) * np.float32(self.step)
        return offsets

    def _decompress_steps(self) -> np.ndarray[Any, Any]:
        """Return the stored integer multiples of the step (n / square^2,).

        Without squares of texels (`square` is 1), there is a multiple for each of the n
        values. Otherwise a square of square^2 texels has one for each color channel.

        Raises:
            ValueError, LZMAError: the stored offsets are corrupt.
        """
        n_steps = self.numbers // self.square**2
        n_bytes = 2 * n_steps  # 16-bit integers
        if self.signs:
            n_bytes = math.ceil(n_steps / 3)  # `_pack_signs` puts three in a byte
        decompressor = lzma.LZMADecompressor(memlimit=MAX_MEMORY)
        # The file is not trusted, so that memory and size are limited. This limit is
        # more than the expected size in both formats: longer data is detected by its
        # length.
        max_bytes = 2 * n_steps + 1
        data = decompressor.decompress(base64.b85decode(self.offsets), max_bytes)
        if len(data) != n_bytes:
            raise ValueError(f"expected {n_steps} numbers, got others")
        if self.signs:
            return _unpack_signs(data, n_steps)
        return np.frombuffer(data, "<i2")


def _choose_quantum(values: Floats, *, is_small: bool, stores_signs: bool) -> float:
    """Return the step of which the offsets of a block are stored as multiples.

    Args:
        values: the offsets (n,).
        is_small: whether the block has few values.
        stores_signs: whether only signs are stored.
    """
    if is_small:
        return FINE_STEP
    if stores_signs:
        # With the largest offset as the step, rounding leaves only -1, 0 and 1. If
        # all offsets are 0, the step may be any positive number.
        return float(np.abs(values).max()) or 1.0
    return COARSE_STEP


def _has_squares(n_values: int, square: int) -> bool:
    """Return whether values are a texture (side, side, 3) that squares of texels tile."""
    # A texture has side * side texels of 3 values.
    side = isqrt(n_values // 3)
    return 3 * side * side == n_values and side % square == 0


def _average_squares(values: Floats, side: int, square: int) -> Floats:
    """Return the means of squares of texels of a texture (side, side, 3), flattened.

    Args:
        values: the texels, flattened.
        side: side of the texture.
        square: side of a square of texels, which divides that of the texture.
    """
    n_squares = side // square  # along each side
    squares = values.reshape(n_squares, square, n_squares, square, 3)
    means: Floats = squares.mean(axis=(1, 3)).ravel()
    return means


def _pack_signs(steps: np.ndarray[Any, Any]) -> bytes:
    """Pack three values from -1 to 1 into each byte, as digits of base 3."""
    n_missing = -len(steps) % 3  # to a multiple of three
    threes = np.pad(steps, (0, n_missing)).reshape(-1, 3)
    # 13 = 9 + 3 + 1 adds 1 to each digit: digits are 0, 1 and 2 in place of -1, 0 and
    # 1.
    packed = threes @ (9, 3, 1) + 13
    return bytes(packed.astype(np.uint8).tobytes())


def _unpack_signs(data: bytes, n_steps: int) -> np.ndarray[Any, Any]:
    """Unpack values (n,) from -1 to 1 that `_pack_signs` has packed."""
    packed = np.frombuffer(data, np.uint8)
    digits = np.stack([packed // 9, packed // 3 % 3, packed % 3], axis=1)
    return (digits.astype(np.int16) - 1).ravel()[:n_steps]


class _File(BaseModel):
    """The content of a counterexample's file.

    Attributes:
        schema_: version of the format.
        run: name of the run.
        said: the wrong prediction.
        settings: settings of the run that decide a verdict.
        files: SHA-256 of the files in these settings, by name.
        scene: digest of the scene.
        spp: samples per pixel.
        blocks: offsets from the clean scene.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    schema_: int = Field(alias="schema", ge=1, le=1)
    run: str
    said: str
    settings: dict[str, Any]
    files: dict[str, str] = Field({}, max_length=MAX_FINE_VALUES)
    scene: str
    spp: int = Field(ge=1, le=65536)
    blocks: list[_Block] = Field(min_length=1, max_length=MAX_FINE_VALUES)


@dataclass(frozen=True)
class Counterexample:
    """The adversarial scene of a run, as a file with a picture next to it.

    Attributes:
        name: name of the file.
        path: path of the file.
        config: settings of the run that found it.
        wrong_label: the wrong prediction.
        digest_by_file: SHA-256 of the files in its settings, by name.
        scene_digest: digest of the scene.
        spp: samples per pixel of its verification.
        clean_offsets: (d,) float32 offset of each value from that of the clean scene.
    """

    name: str
    path: Path
    config: AttackConfig
    wrong_label: str
    digest_by_file: Mapping[str, str]
    scene_digest: str
    spp: int
    clean_offsets: Floats

    def make_config(self, suite: Suite, changes: Mapping[str, object]) -> AttackConfig:
        """Return the settings with which the counterexample is tested.

        They are those of the counterexample, with these exceptions:

        - Settings of how a run computes (`SUITE_SETTINGS`), such as the number of
          threads, are reset to their defaults.
        - If the suite or the command names a model, all settings of the network
          (`MODEL_SETTINGS`) are those of the suite and the command.
        - Settings of the command replace all others.

        Other settings of the suite are not used, since they describe its claims.

        Args:
            suite: the suite.
            changes: settings of the command; None for a setting that is not changed.

        Raises:
            InputError: its settings do not suit that network.
        """
        changed = {name: value for name, value in changes.items() if value is not None}
        network_settings = _select_network_settings({**suite.settings, **changed})
        # settings that are reset to their defaults
        reset_names = {*SUITE_SETTINGS}
        if network_settings:
            reset_names |= {*MODEL_SETTINGS}
        defaults = {
            setting.name: setting.default
            for setting in settings.settings(AttackConfig)
            if setting.name in reset_names
        }
        # Later mappings take precedence.
        return AttackConfig(
            **{**self.config.to_json(), **defaults, **network_settings, **changed}
        )

    def find_changed_file(self, config: AttackConfig) -> str | None:
        """Return the name of a file in its settings that has changed, or None."""
        return directory.summary.find_changed_file(
            self.digest_by_file, select_deciding_settings(config)
        )

    def make_configuration(self, start: Tensor) -> Tensor:
        """Return the configuration (d,) in [0, 1], from that of the clean scene.

        Raises:
            InputError: the scene has another number of values now.
        """
        if start.numel() != len(self.clean_offsets):
            raise InputError(
                f"{self.path}: has {len(self.clean_offsets)} numbers, and its scene "
                "has "
                f"{start.numel()} now; remove it, or "
                "add the adversarial scene of a new run"
            )
        return (start + torch.from_numpy(self.clean_offsets)).clamp(0.0, 1.0)


def _select_network_settings(values: Mapping[str, object]) -> dict[str, object]:
    """Return the settings of the network under test, if they name a model; else none.

    Settings of one network do not suit another.
    """
    if "model" not in values:
        return {}
    return {name: value for name, value in values.items() if name in MODEL_SETTINGS}


def counterexample_directory(suite: str) -> Path:
    """Return the directory of a suite's counterexamples."""
    return Path(suite).with_suffix(".counterexamples")


def compute_scene_digest(description: SceneDescription) -> str:
    """Return the SHA-256 of a scene's geometry, texture, light and values."""
    digest = hashlib.sha256()
    mesh = description.object.mesh
    light = description.environment
    radiance = light.radiance if light else None
    base_color = description.object.base_color
    for array in (mesh.vertices, mesh.faces, mesh.uvs, base_color, radiance):
        if array is not None:
            digest.update(np.ascontiguousarray(array).tobytes())
    digest.update(json.dumps(sorted(description.requested_values.items())).encode())
    return digest.hexdigest()


def select_deciding_settings(config: AttackConfig) -> dict[str, Any]:
    """Return the settings that decide a verdict, without those of the network.

    They are JSON values.
    """
    left_out = NOT_DECIDING | {*MODEL_SETTINGS}
    return {
        name: value for name, value in config.to_json().items() if name not in left_out
    }


def make_paths_relative(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings in which paths of files are relative to the working directory.

    Paths of files outside of it are not changed. So a suite can be moved with its
    files.
    """
    working_directory = os.getcwd()
    relative = dict(values)
    for name in settings.FILES:
        path = relative.get(name)
        if not isinstance(path, str) or not os.path.isabs(path):
            continue
        if Path(path).is_relative_to(working_directory):
            relative[name] = os.path.relpath(path, working_directory)
    return relative


def is_right_in_trial(
    trial: tasks.Judgement, clean: tasks.Judgement | None = None
) -> bool | None:
    """Return whether the model is right in a trial, None if the trial does not count.

    It does not count if the object is out of view, or if the model is wrong on the
    clean scene under the same conditions.

    Args:
        trial: judgement of the adversarial scene.
        clean: judgement of the clean scene under the same conditions; None if
            conditions do not vary.
    """
    if trial.prediction.is_out_of_view:
        return None
    if clean is not None and not clean.right:
        return None
    return trial.right


def decide_trials(n_right: int, n_wrong: int, *, has_conditions: bool) -> str:
    """Return the verdict of the trials that count.

    If conditions do not vary, it is held if the model is right in all trials, failed if
    it is wrong in all, and otherwise undecided, because the prediction depends on the
    noise. If conditions vary, it is held if the model is right in at least 90 % of the
    trials, the rate at which an attack counts as successful. It is failed if the lower
    bound of the rate of wrong predictions is at least 50 % (95 % interval).

    Args:
        n_right, n_wrong: trials in which the model is right, and in which it is wrong.
        has_conditions: whether conditions vary.
    """
    total = n_right + n_wrong
    if not has_conditions:
        depends_on_noise = n_right > 0 and n_wrong > 0
        if total < N_TRIALS_OF_SCENE or depends_on_noise:
            return UNDECIDED
        return HELD if n_right else FAILED
    if total:
        lower_wrong_rate, _ = statistics.intervals.clopper_pearson(n_wrong, total)
        if lower_wrong_rate >= workbench.MIN_RATE:  # 0.5
            return FAILED
    # the rule by which attacks under varying conditions are verified
    rule = workbench.OVER_CONDITIONS
    n_required = rule.count_percent(total)  # 90 % of the trials
    if total >= rule.min_trials and n_right >= n_required:
        return HELD
    return UNDECIDED


def _fails_on_example(
    example: Counterexample, problem: Problem, trials: int, *, has_conditions: bool
) -> bool:
    """Return whether the run's own model fails on the stored scene, with fresh seeds.

    Args:
        example: the counterexample as it is stored.
        problem: problem of the run.
        trials: number of trials. If conditions do not vary, the first right prediction
            ends them.
        has_conditions: whether conditions vary; then the clean scene is rendered, too,
            under the same conditions.
    """
    start = problem.domain.start
    u = problem.domain.project(example.make_configuration(start))
    configurations = [u, start] if has_conditions else [u]
    outcomes = list[bool | None]()
    for index in range(trials):
        is_right = _try_configurations(problem, configurations, index, example.spp)
        outcomes.append(is_right)
        # After one right trial, the verdict of a single scene cannot be FAILED.
        if is_right and not has_conditions:
            return False
    n_right = outcomes.count(True)
    n_wrong = outcomes.count(False)
    return decide_trials(n_right, n_wrong, has_conditions=has_conditions) == FAILED


def _try_configurations(
    problem: Problem, configurations: Sequence[Tensor], index: int, spp: int
) -> bool | None:
    """Return whether the model is right in a trial; None if the trial does not count.

    Args:
        problem: problem of the run.
        configurations: (d,) the counterexample; and the clean scene if conditions vary.
        index: index of the trial.
        spp: samples per pixel.
    """
    # a stream of seeds that only these trials use
    seed = seeds.derive_seed(problem.seed, "kept", index)
    judgements = [
        _judge_render(problem, configuration, seed, spp)
        for configuration in configurations
    ]
    return is_right_in_trial(*judgements)


def _judge_render(
    problem: Problem, configuration: Tensor, seed: int, spp: int
) -> tasks.Judgement:
    """Render a configuration (d,), and judge the prediction about it."""
    picture = problem.picture(configuration, seed, spp)
    full_configuration = problem.make_full_configuration(configuration, seed)
    return problem.judge(picture, full_configuration)


def add_counterexample(suite: str, run: str) -> Counterexample:
    """Store the adversarial scene of a run as a counterexample of a suite.

    Its offsets from the clean scene are stored in the smallest form with which the
    run's own model still fails.

    Args:
        suite: path of the suite's file.
        run: name or directory of the run of an attack.

    Raises:
        InputError: the run found nothing, or it searched for a scene in which the model
            is right.
    """
    path = directory.find_run(run)
    summary = workbench.load_attack_summary(path)
    _check_addable(path, summary)
    parts = workbench.load_parts_of_run(path)
    problem, _warnings = workbench.make_problem_with_warnings(parts)
    configuration = workbench.read_stored_configuration(path, problem)
    offsets = (configuration - problem.domain.start).numpy()
    config = parts.config.make_repeatable()
    values = _make_values(config, path, summary, parts)
    base = counterexample_directory(suite) / _name_counterexample(path)
    base.parent.mkdir(parents=True, exist_ok=True)
    thumbnail = _make_thumbnail(path / "images" / "adversarial.png")
    writing.write_bytes(base.with_name(f"{base.name}{PICTURE_SUFFIX}"), thumbnail)
    return _write_smallest(
        base, values, offsets, problem, has_conditions=varies_conditions(config)
    )


def _check_addable(path: Path, summary: workbench.AttackSummary) -> None:
    """Raise an error unless an attack has found a scene that the model gets wrong."""
    if summary.ending != "found" or summary.verified is None:
        raise InputError(
            f"add: expected a run that ended as 'found', got {path}, "
            f"which ended with {summary.ending!r}"
        )
    if summary.minimises:  # the objective: the search made the object easier
        raise InputError(
            f"add: expected a run that makes the model wrong, got {path}, "
            "which makes the object easier"
        )


def _make_values(
    config: AttackConfig,
    path: Path,
    summary: workbench.AttackSummary,
    parts: workbench.AttackParts,
) -> dict[str, Any]:
    """Return what the file of a counterexample holds, except for its blocks.

    Args:
        config: settings of the run.
        path: directory of the run.
        summary: summary of the run.
        parts: loaded parts of the run.
    """
    verified = summary.verified
    assert verified is not None
    # Settings whose files must not change. Those of the network are not among them,
    # since the suite may replace the network.
    settings_with_files = make_paths_relative(select_deciding_settings(config))
    return {
        "schema": 1,  # version of the form of this file
        "run": path.name,
        # the most frequent wrong prediction
        "said": next(iter(verified.labels), ""),
        "settings": make_paths_relative(_select_stored_settings(config)),
        "files": directory.summary.compute_file_digests(settings_with_files),
        "scene": compute_scene_digest(parts.scene.description),
        "spp": verified.spp,
    }


def _select_stored_settings(config: AttackConfig) -> dict[str, Any]:
    """Return the settings that a counterexample stores, by name."""
    return {
        name: value
        for name, value in config.to_json().items()
        if name not in NOT_DECIDING
    }


def _write_smallest(
    base: Path,
    values: Mapping[str, Any],
    offsets: Floats,
    problem: Problem,
    *,
    has_conditions: bool,
) -> Counterexample:
    """Write the smallest form of a counterexample on which the model fails.

    Forms store the offsets with different precision. They are tried from the smallest,
    which is the coarsest: each is written, read back and rendered. The last and finest
    form is stored whatever the model predicts, since the suite tests it afterwards.

    Args:
        base: path of the file without suffix.
        values: content of the file except for the blocks.
        offsets: offsets (d,) from the clean scene.
        problem: the problem of the run.
        has_conditions: whether conditions vary.
    """
    block_sizes = [block.size for block in problem.domain.blocks]
    blocks = np.split(offsets, np.cumsum(block_sizes)[:-1])
    trials = _count_confirming_trials(has_conditions=has_conditions)
    *coarse_forms, finest_form = _list_forms(max(block_sizes))
    for stores_signs, square in coarse_forms:
        # This replaces the file of the form before.
        example = _write_form(base, values, blocks, stores_signs, square)
        if _fails_on_example(example, problem, trials, has_conditions=has_conditions):
            return example
    stores_signs, square = finest_form
    return _write_form(base, values, blocks, stores_signs, square)


def _list_forms(max_block_size: int) -> Sequence[tuple[bool, int]]:
    """Return the forms of a counterexample that differ, from the coarsest to the finest.

    A form is whether only signs are stored, and the side of the squares of texels that
    share a value.
    """
    # All forms store a block of up to `MAX_FINE_VALUES` in the same way.
    has_large_block = max_block_size > MAX_FINE_VALUES
    return FORMS if has_large_block else FORMS[-1:]


def _count_confirming_trials(*, has_conditions: bool) -> int:
    """Return the number of trials by the run's own model before an example is stored."""
    trials = count_trials(has_conditions=has_conditions)
    # If conditions do not vary, the model has to be wrong in all trials. Twice as many
    # trials as the suite makes, so that the model will most likely fail there, too.
    return trials if has_conditions else 2 * trials


def _write_form(
    base: Path,
    values: Mapping[str, Any],
    blocks: Sequence[Floats],
    signs: bool,
    square: int,
) -> Counterexample:
    """Write a counterexample in a form, and return it as it is read back.

    Reading it back applies the quantization.

    Args:
        base: path of the file without suffix.
        values: content of the file except for the blocks.
        blocks: offsets of each block from the clean scene.
        signs: whether only signs of large blocks are stored.
        square: side of the squares of texels that share a value.
    """
    stored = [_Block.quantize(block, signs, square).model_dump() for block in blocks]
    text = json.dumps({**values, "blocks": stored}, indent=1)
    path = writing.write_text(base.with_name(f"{base.name}.json"), text + "\n")
    return _read(path)


def _name_counterexample(run: Path) -> str:
    """Return the name of the counterexample of a run.

    If the run is a part of another run, the name begins with that of the other run.
    """
    parent = run.parent.parent  # parts of a run are in a folder inside of it
    is_part = run == RunDirectory.locate_part(parent, run.name)
    if is_part:
        return _make_name(parent.name, run.name)
    return _make_name(run.name)


def _make_name(*names: str) -> str:
    """Return a name for a file from names of runs.

    It has small letters, digits and hyphens: ``mug-texture-001``.
    """
    words = [Path(names[0]).stem, *names[1:]]
    name = re.sub(r"[^a-z0-9]+", "-", "-".join(words).lower()).strip("-")
    return name[:80] or "attack"


def _make_thumbnail(path: Path) -> bytes:
    """Return a small JPEG of a PNG picture.

    Raises:
        FileFormatError: the image is corrupt.
    """
    buffer = io.BytesIO()
    try:
        with Image.open(path, formats=("PNG",)) as image:
            small = image.convert("RGB")
            small.thumbnail((THUMBNAIL_SIDE, THUMBNAIL_SIDE))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise errors.FileFormatError(
            f"{path}: expected a PNG picture, got {error}"
        ) from None
    small.save(buffer, "JPEG", quality=85)
    return buffer.getvalue()


def delete_counterexample(example: Counterexample) -> None:
    """Delete the files of a counterexample."""
    example.path.unlink(missing_ok=True)
    example.path.with_suffix(PICTURE_SUFFIX).unlink(missing_ok=True)


def read_counterexamples(suite: str) -> list[Counterexample]:
    """Read the counterexamples of a suite, sorted by name.

    The file with the expected verdicts (`EXPECTED_FILE`) is in the same directory.
    """
    folder = counterexample_directory(suite)
    return [
        _read(path)
        for path in sorted(folder.glob("*.json"))
        if path.name != EXPECTED_FILE
    ]


def _read(path: Path) -> Counterexample:
    """Read a counterexample.

    Raises:
        FileFormatError: the file is missing or corrupt.
    """
    content, offsets = _read_content(path)
    try:
        config = AttackConfig(**content.settings)
    except InputError as error:
        raise errors.FileFormatError(f"{path}: settings: {error}") from None
    return Counterexample(
        name=path.stem,
        path=path,
        config=config,
        wrong_label=content.said,
        digest_by_file=content.files,
        scene_digest=content.scene,
        spp=content.spp,
        clean_offsets=offsets,
    )


def _read_content(path: Path) -> tuple[_File, Floats]:
    """Read the content of a counterexample's file, and its offsets (d,).

    Raises:
        FileFormatError: the file is missing or corrupt.
    """
    try:
        text = stored_files.read_text(path, "a counterexample", MAX_SIZE)
        content = _File.model_validate(stored_files.parse_json(text))
        offsets = np.concatenate([block.dequantize() for block in content.blocks])
        return content, offsets
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        location = ".".join(map(str, first["loc"]))
        got = f"{location}: {first['msg']}"[:120]
        raise errors.FileFormatError(
            f"{path}: expected a counterexample, got one with {got}; remove it"
        ) from None
    except (OSError, ValueError, lzma.LZMAError) as error:
        raise errors.FileFormatError(
            f"{path}: expected a counterexample, got {str(error)[:80]}; remove it"
        ) from None


# file with the expected verdicts of claims that are not expected to be held
EXPECTED_FILE = "expected.json"


def read_expected(suite: str) -> dict[str, str]:
    """Read the expected verdicts of the claims that are not expected to be held.

    The file is optional: without it all claims are expected to be held.

    Raises:
        FileFormatError: the file is corrupt.
    """
    path = counterexample_directory(suite) / EXPECTED_FILE
    if not path.is_file():
        return {}
    values = _read_expected_json(path)
    verdicts = values.get("expected") if isinstance(values, dict) else None
    if not _are_verdicts(verdicts):
        raise errors.FileFormatError(
            f"{path}: expected verdicts by claim, got something else; remove it"
        )
    return {str(name): str(verdict) for name, verdict in verdicts.items()}


def _read_expected_json(path: Path) -> Any:
    """Read the content of the file with expected verdicts, unchecked.

    Raises:
        FileFormatError: the file is no JSON.
    """
    try:
        text = stored_files.read_text(path, "what is expected of a suite", MAX_SIZE)
        return stored_files.parse_json(text)
    except (OSError, ValueError) as error:
        raise errors.FileFormatError(
            f"{path}: expected verdicts by claim, got {str(error)[:80]}; remove it"
        ) from None


def _are_verdicts(values: Any) -> TypeGuard[dict[Any, Any]]:
    """Return whether a value that was read from a file has verdicts by claim."""
    return isinstance(values, dict) and all(
        str(verdict) in VERDICTS for verdict in values.values()
    )


def write_expected(suite: str, verdicts: Mapping[str, str]) -> list[str]:
    """Store verdicts as expected, and return a sentence for each change."""
    before = read_expected(suite)
    merged = sorted({**before, **verdicts}.items())
    stored = {name: verdict for name, verdict in merged if verdict != HELD}
    path = counterexample_directory(suite) / EXPECTED_FILE
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"schema": 1, "expected": stored}, indent=1)
    writing.write_text(path, text + "\n")
    changes = []
    for name, verdict in verdicts.items():
        previous = before.get(name, HELD)
        if previous != verdict:
            changes.append(f"{name}: {previous} -> {verdict}")
    return changes


def varies_conditions(config: SceneConfig) -> bool:
    """Return whether settings vary conditions, such as the light, in each trial."""
    return bool(getattr(config, "over", {}))
