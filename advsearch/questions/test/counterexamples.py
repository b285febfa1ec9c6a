"""Adversarial scenes of runs that became tests: each a small file and a picture in a
folder beside the suite.
"""

from __future__ import annotations

import base64
import hashlib
import io
import json
import lzma
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from math import isqrt
from pathlib import Path
from typing import Any, TypeAlias

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

FEW = 4096
FINE = 1.0 / 32767.0
COARSE = 1.0 / 255.0
"""A block of up to so many numbers is kept in steps of `FINE`; a larger one, such as
the texels of a texture, in one of `FORMS`, at best in steps of `COARSE`.
"""

FORMS = ((True, 4), (True, 2), (True, 1), (False, 1))
"""How the numbers of a large block are kept, the smallest first: whether each is only a
step up, down or none, and the side of the squares of texels that have one.
"""

PICTURE = ".jpg"  # how the name of the picture ends
THUMBNAIL_SIDE = 128  # longest side of the picture, pixels
LARGEST = 1 << 24  # most bytes of a file, and most numbers of a configuration
MEMORY = 1 << 27  # bytes that unpacking one may take
# fresh renders that try one, and one that has to hold under many conditions
TRIALS = {False: 6, True: 20}

OF_MODEL = ("model", "labels", "prompt", "value_range", "ask", "ensemble")
"""Settings that say which network is tested. They go together: all are the suite's
where it names a model.
"""

OF_SUITE = (
    *settings.PLACE,
    "threads",
    "deterministic",
    "workers",
    "cluster",
    "seconds",
    "log",
)
"""Settings that say how and where is worked."""

OF_SEARCH = (
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
"""Settings that say how the adversarial scene was searched for. The samples of its
verification are kept apart.
"""

NOT_DECIDING = frozenset({*OF_SUITE, *OF_SEARCH, "ask"})
"""The only settings of a run that are not kept with its adversarial scene. Every other
one may decide a verdict, so that a new setting is kept until somebody lists it here.
"""


class _Block(BaseModel):
    """How far some numbers are from the clean scene's, in steps; see `FORMS`."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    numbers: int = Field(ge=1, le=LARGEST)
    step: float = Field(gt=0.0, le=1.0)
    signs: bool
    square: int = Field(ge=1, le=4)
    offsets: str

    @classmethod
    def of(cls, moved: Floats, signs: bool, square: int) -> _Block:
        """Keep numbers (n,); squares are those of a texture (side, side, 3), and of
        nothing else.
        """
        few = len(moved) <= FEW
        side = isqrt(len(moved) // 3)
        step = FINE if few else float(np.abs(moved).max()) if signs else COARSE
        square = (
            square
            if not few and 3 * side * side == len(moved) and side % square == 0
            else 1
        )
        if square > 1:
            squares = moved.reshape(side // square, square, side // square, square, 3)
            moved = squares.mean(axis=(1, 3)).ravel()
        steps = np.round(moved / (step or 1.0)).astype("<i2")
        data = steps.tobytes()
        if signs and not few:  # three numbers from -1 to 1 in each byte
            threes = np.pad(steps, (0, -len(steps) % 3)).reshape(-1, 3) @ (9, 3, 1) + 13
            data = threes.astype(np.uint8).tobytes()
        packed = base64.b85encode(lzma.compress(data, lzma.FORMAT_ALONE)).decode(
            "ascii"
        )
        numbers = len(moved) * square**2
        return cls(
            numbers=numbers,
            step=step or 1.0,
            signs=not few and signs,
            square=square,
            offsets=packed,
        )

    def moved(self) -> Floats:
        """Return the numbers, (n,) float32; a ValueError or an LZMAError where they are
        damaged.
        """
        size = self.numbers // self.square**2
        side = isqrt(self.numbers // 3)
        unpack = lzma.LZMADecompressor(memlimit=MEMORY)
        data = unpack.decompress(base64.b85decode(self.offsets), 2 * size + 1)
        if len(data) != (-(-size // 3) if self.signs else 2 * size):
            raise ValueError(f"expected {size} numbers, got others")
        steps = np.frombuffer(data, np.uint8 if self.signs else "<i2")
        if self.signs:
            threes = np.stack([steps // 9, steps // 3 % 3, steps % 3], axis=1).astype(
                np.int16
            )
            steps = (threes - 1).ravel()[:size]
        if self.square > 1:
            squares = steps.reshape(side // self.square, side // self.square, 3)
            steps = (
                squares.repeat(self.square, axis=0).repeat(self.square, axis=1).ravel()
            )
        moved: Floats = steps.astype(np.float32) * np.float32(self.step)
        return moved


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    schema_: int = Field(alias="schema", ge=1, le=1)
    run: str
    said: str
    settings: dict[str, Any]
    files: dict[str, str] = Field({}, max_length=FEW)
    scene: str
    spp: int = Field(ge=1, le=65536)
    blocks: list[_Block] = Field(min_length=1, max_length=FEW)


@dataclass(frozen=True)
class Counterexample:
    """The adversarial scene of a run: its file, beside which its picture is; what it
    was found with; what the model `said` of it; SHA-256 of the files that its settings
    name, by name; digest of the scene; samples a pixel that it was verified with; and
    how far each number (d,) float32 is `moved` from the clean scene's.
    """

    name: str
    path: Path
    config: AttackConfig
    said: str
    files: Mapping[str, str]
    scene: str
    spp: int
    moved: Floats

    def config_for(self, suite: Suite, changes: Mapping[str, object]) -> AttackConfig:
        """Return what tries it: its own settings, but for the network under test and
        how the suite works. Raises InputError where its settings do not fit to that
        network.
        """
        changed = {name: value for name, value in changes.items() if value is not None}
        network = {
            name: value
            for name, value in {**suite.settings, **changed}.items()
            if name in OF_MODEL
        }
        if "model" not in network:
            network = {}
        replaced = (*OF_SUITE, *OF_MODEL) if network else OF_SUITE
        declared = settings.settings(AttackConfig)
        defaults = {
            setting.name: setting.default
            for setting in declared
            if setting.name in replaced
        }
        return AttackConfig(**{**self.config.plain(), **defaults, **network, **changed})

    def changed_file(self, config: AttackConfig) -> str | None:
        """Return the name of a file that its settings name and that is another one now;
        None where all are the same.
        """
        return directory.summary.changed_file(self.files, deciding_settings(config))

    def configuration(self, start: Tensor) -> Tensor:
        if start.numel() != len(self.moved):
            raise InputError(
                f"{self.path}: has {len(self.moved)} numbers, and its scene has "
                f"{start.numel()} now; remove it, or "
                "add the adversarial scene of a new run"
            )
        return (start + torch.from_numpy(self.moved)).clamp(0.0, 1.0)


def folder_of(suite: str) -> Path:
    return Path(suite).with_suffix(".counterexamples")


def scene_digest(described: SceneDescription) -> str:
    digest = hashlib.sha256()
    mesh = described.object.mesh
    light = described.environment
    for array in (
        mesh.vertices,
        mesh.faces,
        mesh.uvs,
        described.object.base_color,
        light.radiance if light else None,
    ):
        digest.update(b"" if array is None else np.ascontiguousarray(array).tobytes())
    digest.update(json.dumps(sorted(described.given_values.items())).encode())
    return digest.hexdigest()


def deciding_settings(config: AttackConfig) -> dict[str, Any]:
    """Return the settings that decide a verdict, but for the network, as JSON
    values.
    """
    left_out = NOT_DECIDING | {*OF_MODEL}
    return {
        name: value for name, value in config.plain().items() if name not in left_out
    }


def relative_to_here(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings with the files below the current folder relative to it, so that a
    suite can be moved.
    """
    here = os.getcwd()
    relative = dict(values)
    for name in settings.FILES:
        path = relative.get(name)
        if (
            isinstance(path, str)
            and os.path.isabs(path)
            and Path(path).is_relative_to(here)
        ):
            relative[name] = os.path.relpath(path, here)
    return relative


def outcome_of(
    trial: tasks.Judgement, clean: tasks.Judgement | None = None
) -> bool | None:
    """Return whether the model is right in a trial, or None where the trial does not
    count: nothing of the object is in the picture, or the model is wrong on the clean
    scene under the same conditions.
    """
    if trial.prediction.is_out_of_view or (clean is not None and not clean.right):
        return None
    return trial.right


def decide_trials(right: int, wrong: int, *, over: bool) -> str:
    """Return the verdict of the trials that count.

    One scene is held if all are right, and failed if all are wrong. Over conditions a
    run is found by 90 % of them, so it is held if the model is right in so many, and
    failed if it is wrong in more than half with 95 % confidence.
    """
    total = right + wrong
    if not over:
        if total < TRIALS[over] or (right and wrong):
            return UNDECIDED
        return HELD if right else FAILED
    if (
        total
        and statistics.intervals.clopper_pearson(wrong, total)[0]
        >= workbench.LEAST_RATE
    ):
        return FAILED
    enough = total >= workbench.OVER_CONDITIONS.fewest
    return (
        HELD
        if enough and right >= workbench.OVER_CONDITIONS.share(total)
        else UNDECIDED
    )


def _is_wrong_on(
    example: Counterexample, problem: Problem, trials: int, *, over: bool
) -> bool:
    """Whether the run's own model fails on what is kept, by trials with fresh seeds."""
    start = problem.domain.start
    u = problem.domain.project(example.configuration(start))
    outcomes = list[bool | None]()
    for number in range(trials):
        seed = seeds.stream(problem.seed, "kept", number)
        judged = [
            problem.judge(
                problem.picture(at, seed, example.spp), problem.whole(at, seed)
            )
            for at in ([u, start] if over else [u])
        ]
        outcomes.append(outcome_of(*judged))
        if outcomes[-1] and not over:
            return False
    return (
        decide_trials(outcomes.count(True), outcomes.count(False), over=over) == FAILED
    )


def add(suite: str, run: str) -> Counterexample:
    """Keep the adversarial scene of a run as a counterexample of a suite; an InputError
    where the run found nothing, or its scene is none.
    """
    path = directory.find_run(run)
    summary = workbench.attack_of(path)
    if summary.ending != "found" or summary.verified is None:
        raise InputError(
            f"add: expected a run that ended as 'found', got {path}, "
            f"which ended with {summary.ending!r}"
        )
    if summary.minimises:
        raise InputError(
            f"add: expected a run that makes the model wrong, got {path}, "
            "which makes the object easier"
        )
    parts = workbench.parts_in(path)
    problem, _ = workbench.problem_of_parts(parts)
    moved = (workbench.kept_configuration(path, problem) - problem.domain.start).numpy()
    folder = folder_of(suite)
    study = path.parent.parent
    is_part = path == RunDirectory.locate_part(study, path.name)
    name = _make_name(study.name, path.name) if is_part else _make_name(path.name)
    config = parts.config.to_repeat()
    kept = {
        name: value
        for name, value in config.plain().items()
        if name not in NOT_DECIDING
    }
    values: dict[str, Any] = {
        "schema": 1,
        "run": path.name,
        "said": next(iter(summary.verified.labels), ""),
    }
    values["settings"] = relative_to_here(kept)
    values["files"] = directory.summary.file_digests(
        relative_to_here(deciding_settings(config))
    )
    values |= {
        "scene": scene_digest(parts.scene.description),
        "spp": summary.verified.spp,
    }
    folder.mkdir(parents=True, exist_ok=True)
    writing.write_bytes(
        folder / f"{name}{PICTURE}",
        _make_thumbnail(path / "images" / "adversarial.png"),
    )
    blocks = [block.size for block in problem.domain.blocks]
    forms = FORMS if max(blocks) > FEW else FORMS[-1:]
    over = is_over(config)
    # of one scene twice as many as will try it
    trials = TRIALS[over] if over else 2 * TRIALS[over]
    for form in forms:
        parted = [
            _Block.of(part, *form) for part in np.split(moved, np.cumsum(blocks)[:-1])
        ]
        text = json.dumps(
            {**values, "blocks": [block.model_dump() for block in parted]}, indent=1
        )
        example = _read(writing.write_text(folder / f"{name}.json", text + "\n"))
        if form == forms[-1] or _is_wrong_on(example, problem, trials, over=over):
            break
    return example


def _make_name(*names: str) -> str:
    """Return a name for a file: ``mug-texture-001`` of the run ``mug-texture-001``."""
    words = [Path(names[0]).stem, *names[1:]]
    return (
        re.sub(r"[^a-z0-9]+", "-", "-".join(words).lower()).strip("-")[:80] or "attack"
    )


def _make_thumbnail(path: Path) -> bytes:
    """Return a small JPEG of a PNG picture. Raises FileFormatError: it is damaged."""
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


def remove(example: Counterexample) -> None:
    example.path.unlink(missing_ok=True)
    example.path.with_suffix(PICTURE).unlink(missing_ok=True)


def counterexamples(suite: str) -> list[Counterexample]:
    folder = folder_of(suite)
    return [
        _read(path) for path in sorted(folder.glob("*.json")) if path.name != EXPECTED
    ]


def _read(path: Path) -> Counterexample:
    try:
        kept = _File.model_validate(
            stored_files.parse_json(
                stored_files.read_text(path, "a counterexample", LARGEST)
            )
        )
        moved = np.concatenate([block.moved() for block in kept.blocks])
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        got = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"[:120]
        raise errors.FileFormatError(
            f"{path}: expected a counterexample, got one with {got}; remove it"
        ) from None
    except (OSError, ValueError, lzma.LZMAError) as error:
        raise errors.FileFormatError(
            f"{path}: expected a counterexample, got {str(error)[:80]}; remove it"
        ) from None
    try:
        config = AttackConfig(**kept.settings)
    except InputError as error:
        raise errors.FileFormatError(f"{path}: settings: {error}") from None
    return Counterexample(
        path.stem, path, config, kept.said, kept.files, kept.scene, kept.spp, moved
    )


# what claims said when that was accepted, where they were not held
EXPECTED = "expected.json"


def read_expected(suite: str) -> dict[str, str]:
    """Return what is expected of claims that are not to be held; a FileFormatError
    where the file is damaged.
    """
    path = folder_of(suite) / EXPECTED
    if not path.is_file():
        return {}
    try:
        values = stored_files.parse_json(
            stored_files.read_text(path, "what is expected of a suite", LARGEST)
        )
    except (OSError, ValueError) as error:
        raise errors.FileFormatError(
            f"{path}: expected verdicts by claim, got {str(error)[:80]}; remove it"
        ) from None
    verdicts = values.get("expected") if isinstance(values, dict) else None
    if not isinstance(verdicts, dict) or not set(map(str, verdicts.values())) <= set(
        VERDICTS
    ):
        raise errors.FileFormatError(
            f"{path}: expected verdicts by claim, got something else; remove it"
        )
    return {str(name): str(verdict) for name, verdict in verdicts.items()}


def write_expected(suite: str, verdicts: Mapping[str, str]) -> list[str]:
    """Expect these verdicts from now on, and return what changes, in words."""
    before = read_expected(suite)
    folder = folder_of(suite)
    kept = {
        name: verdict
        for name, verdict in sorted({**before, **verdicts}.items())
        if verdict != HELD
    }
    folder.mkdir(parents=True, exist_ok=True)
    writing.write_text(
        folder / EXPECTED, json.dumps({"schema": 1, "expected": kept}, indent=1) + "\n"
    )
    changed = {
        name: (before.get(name, HELD), verdict) for name, verdict in verdicts.items()
    }
    return [
        f"{name}: {was} -> {now}" for name, (was, now) in changed.items() if was != now
    ]


def is_over(config: SceneConfig) -> bool:
    return bool(getattr(config, "over", {}))
