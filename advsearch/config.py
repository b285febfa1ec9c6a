"""The typed description of a run: what YAML files, flags and Python calls all become.

Each setting states its flag, unit, range and default once, here; the command line's help and the docs are made from
that (`settings`). Names of objects, controls, policies and the rest are checked by whoever looks them up, not here, so
that this module stays light.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import field_validator, model_validator

from advsearch.errors import InputError
from advsearch.settings import PLACE, Config, all_finite, number_or_text, parse_assignment, setting, split_names

SEARCH_SPP = {"oidn": 8, "none": 16}
"""Samples a pixel of a search that asks for none. `benchmarks/formation.py` shows the noise that is left at each."""

AUTO_SHARE = 2
"""With `--spp auto` a search begins with the default's samples divided by this."""

TRIALS, TRIALS_OVER = 20, 200
"""Fresh renders that check an answer, and one that holds for many conditions."""

QUANTITIES = ("image", "gradient", "objective")
SAMPLERS = ("independent", "stratified", "multijitter", "orthogonal", "ldsampler")
"""What `precision` measures, and the samplers that it knows."""


class SceneConfig(Config):
    """What every command over a scene and a model needs to know.

    A file is looked for relative to the current directory. None means "choose for me", and the description says how.
    """

    object: str = setting(
        ...,
        "scene",
        "what the model should recognise",
        "the name of an object or a .obj, .ply, .glb, .gltf or .stl file",
    )
    environment: str = setting("studio", "scene", "what lights it", "the name of an environment or a .hdr or .exr file")
    up: Literal["y", "z"] | None = setting(
        None, "scene", "axis of an imported object that points up", "y or z", otherwise="found from the file"
    )
    set_: dict[str, float | str | tuple[float, ...]] = setting(
        dict,
        "scene",
        "fix a parameter of the scene, such as camera.azimuth=130",
        "PARAMETER=VALUE with a finite number, a name or a list of numbers",
        alias="set",
    )
    exposure: float = setting(
        0.0, "scene", "brightness of the picture", "a number from -10 to 10", unit="stops", ge=-10.0, le=10.0
    )
    resolution: tuple[int, int] | None = setting(
        None,
        "scene",
        "size of the rendered picture",
        "SIDE or HEIGHTxWIDTH, each from 8 to 4096",
        otherwise="what the model takes",
        unit="pixels",
    )

    model: str = setting(
        "reference",
        "model",
        "the network under test",
        "reference, a .pt2 (torch.export), .pt or .ts (TorchScript) file, package.module:callable, or torchvision:NAME",
    )
    labels: str | None = setting(
        None, "model", "names of the model's classes", "a JSON or text file", otherwise="the model's own"
    )
    label: str | None = setting(
        None,
        "model",
        "the right answers, separated by commas",
        'names of classes or their numbers, such as "coffee mug,cup" or #504',
        otherwise="the object's own",
    )

    controls: dict[str, dict[str, Any]] = setting(
        lambda: {"texture": {}},
        "search",
        "what may change, separated by commas",
        "names of controls, or NAME={PARAMETER: VALUE or [LOW, HIGH]}",
        min_length=1,
    )
    texture_resolution: int | None = setting(
        None,
        "search",
        "side of the searched texture",
        "a whole number from 2 to 4096",
        unit="texels",
        otherwise="chosen from the object's own",
        ge=2,
        le=4096,
    )
    spp: int | Literal["auto"] | None = setting(
        None,
        "search",
        "samples per pixel of a render of the search; auto begins with few and spends more where it is close",
        "a whole number from 1 to 65536, or auto",
        otherwise="8 with the denoiser, 16 without",
        unit="samples",
    )
    denoise: Literal["oidn", "none"] = setting(
        "oidn", "search", "denoiser of every render, in search and verification", "oidn or none"
    )

    seed: int = setting(
        0, "run", "root of every random stream", "a whole number from 0 to 2**63 - 1", ge=0, le=2**63 - 1
    )
    threads: int | None = setting(
        None, "run", "processor threads", "a whole number from 1 to 1024", otherwise="all", ge=1, le=1024
    )
    deterministic: bool = setting(False, "run", "the same numbers bit for bit, at some cost in time", "true or false")
    run: str | None = setting(
        None,
        "run",
        "where the run is kept",
        "a name (kept in runs/) or the path of a folder",
        otherwise="runs/OBJECT-CONTROL-NNN",
        min_length=1,
    )
    overwrite: bool = setting(False, "run", "replace a run that is there already", "true or false")

    @property
    def search_spp(self) -> int:
        """Samples a pixel of the search: what was asked for, or the default for the denoiser."""
        if self.spp == "auto":
            return SEARCH_SPP[self.denoise] // AUTO_SHARE
        return self.spp if isinstance(self.spp, int) else SEARCH_SPP[self.denoise]

    @property
    def objects(self) -> tuple[str, ...]:
        """The objects by name."""
        return split_names(self.object)

    @field_validator(
        "object",
        "environment",
        "model",
        "labels",
        "label",
        "run",
        "objective",
        "target",
        mode="before",
        check_fields=False,
    )
    @classmethod
    def _as_text(cls, value: Any) -> Any:
        """Accept a path for a file, a number or a list of names for labels; refuse what can't be a name."""
        text = str(value) if isinstance(value, (Path, int)) and not isinstance(value, bool) else value
        if isinstance(text, (list, tuple)) and all(isinstance(part, str) for part in text):
            text = ",".join(text)
        if isinstance(text, str) and (not text.strip() or "\0" in text):
            raise ValueError("an empty name")
        return text

    @field_validator("spp")
    @classmethod
    def _spp_in_range(cls, value: Any) -> Any:
        if isinstance(value, int) and not 1 <= value <= 65536:
            raise ValueError("out of range")
        return value

    @field_validator("controls", "over", mode="before", check_fields=False)
    @classmethod
    def _controls_from_names(cls, value: Any) -> Any:
        """Accept ``"texture"`` and ``["texture", "pose"]`` for controls with nothing set, and an empty YAML value."""
        names = [part.strip() for part in value.split(",") if part.strip()] if isinstance(value, str) else value
        if isinstance(names, (list, tuple)):
            return {name: {} for name in names}
        if isinstance(names, Mapping):
            return {name: {} if given is None else given for name, given in names.items()}
        return value

    @field_validator("estimators", mode="before", check_fields=False)
    @classmethod
    def _estimators_from_name(cls, value: Any) -> Any:
        """Accept ``differences`` for all controls."""
        return {"*": value} if isinstance(value, str) else value

    @field_validator("resolution", mode="before")
    @classmethod
    def _resolution_from_text(cls, value: Any) -> Any:
        """Accept 224, ``"224"`` and ``"224x320"`` (height by width)."""
        parts = value.lower().split("x") if isinstance(value, str) else value
        if isinstance(parts, int):
            parts = [parts]
        return parts * 2 if isinstance(parts, list) and len(parts) == 1 else parts

    @field_validator("resolution")
    @classmethod
    def _resolution_in_range(cls, value: tuple[int, int] | None) -> tuple[int, int] | None:
        if value is not None and not all(8 <= side <= 4096 for side in value):
            raise ValueError("out of range")
        return value

    @field_validator("set_", mode="before")
    @classmethod
    def _numbers_from_text(cls, value: Any) -> Any:
        """Read ``1e-3`` as a number: YAML takes it for text."""
        return {name: number_or_text(given) for name, given in value.items()} if isinstance(value, Mapping) else value

    @field_validator("set_", "controls")
    @classmethod
    def _finite_inside(cls, value: Any) -> Any:
        if not all_finite(value):
            raise ValueError("not finite")
        return value


class AttackConfig(SceneConfig):
    """Everything that decides what `attack` does. Frozen; unknown names are refused."""

    command: ClassVar[str] = "attack"

    object: str = setting(
        ...,
        "scene",
        "what the model should recognise; several, separated by commas, are attacked one after the other",
        "the name of an object or a .obj, .ply, .glb, .gltf or .stl file",
    )
    epsilon: float | dict[str, float] | tuple[float, ...] | None = setting(
        None,
        "search",
        "how far a control may go from where it starts, in its own unit (or CONTROL=NUMBER,...; or NUMBER,NUMBER,... "
        "for a curve)",
        "a number greater than 0",
        otherwise="the control's own",
    )
    norm: Literal["linf", "l2"] = setting("linf", "search", "how that distance is measured", "linf or l2")
    estimators: dict[str, str] = setting(
        dict,
        "search",
        "force how derivatives are obtained",
        "NAME for all controls, or CONTROL=NAME or CONTROL.PARAMETER=NAME; `advsearch plan` shows the names",
        alias="estimator",
    )
    measure: Literal["no", "quick", "full"] = setting(
        "quick",
        "search",
        "measure which valid estimator of a derivative is best on this scene; full chooses step and samples too",
        "no, quick or full",
    )
    policy: str | dict[str, Any] = setting(
        "auto", "search", "the rule that proposes configurations", "the name of a policy, or NAME={OPTION: VALUE}"
    )
    steps: int = setting(
        40,
        "search",
        "steps of the search, its budget in renders",
        "a whole number from 1 to 1000000",
        ge=1,
        le=1_000_000,
    )
    seconds: float | None = setting(
        None,
        "search",
        "time after which the search stops; the random one beside it gets as many renders",
        "a number greater than 0",
        otherwise="no limit",
        unit="seconds",
        gt=0.0,
    )
    step_size: float | None = setting(
        None,
        "search",
        "first step of the policy as a share of epsilon",
        "a number greater than 0",
        otherwise="the policy's own",
        gt=0.0,
    )
    objective: str = setting("margin", "search", "what is maximised", "the name of an objective")
    target: str | None = setting(
        None,
        "search",
        "the wrong answer that the model should give, or several",
        "names of classes or their numbers, separated by commas",
        otherwise="any wrong answer",
    )
    minimise: bool = setting(False, "search", "make the object easier to recognise, not harder", "true or false")
    smallest: bool = setting(
        False, "search", "find the smallest epsilon at which the model is wrong, up to --epsilon", "true or false"
    )
    over: dict[str, dict[str, Any]] = setting(
        dict,
        "search",
        "controls that vary by chance: one answer has to hold for all of them",
        "names of controls, or NAME={PARAMETER: VALUE or [LOW, HIGH]}",
    )
    draws: int = setting(
        4, "search", "conditions that a step of --over looks at", "a whole number from 1 to 1000", ge=1, le=1000
    )
    average: int = setting(
        0,
        "search",
        "random configurations of the same space that say how often the model is wrong on average",
        "a whole number from 0 to 1000000",
        unit="renders",
        ge=0,
        le=1_000_000,
    )
    baseline: bool = setting(True, "search", "run a random search with as many renders beside it", "true or false")

    verify_spp: int | None = setting(
        None,
        "verification",
        "samples per pixel of the verification",
        "a whole number from 1 to 65536",
        otherwise="raised until noise moves nothing",
        unit="samples",
        ge=1,
        le=65536,
    )
    trials: int | None = setting(
        None,
        "verification",
        "fresh renders that check the answer, and as many of the clean scene",
        "a whole number from 1 to 100000",
        otherwise=f"{TRIALS}, or {TRIALS_OVER} with --over",
        unit="renders",
        ge=1,
        le=100_000,
    )

    @field_validator("epsilon", mode="before")
    @classmethod
    def _epsilon_from_text(cls, value: Any) -> Any:
        """Accept ``0.05``, ``0.01,0.02`` and ``texture=0.05,geometry=0.01``; a number greater than 0 each."""
        if isinstance(value, str):
            parts = [part.strip() for part in value.split(",") if part.strip()]
            if any("=" in part for part in parts):
                value = dict(parse_assignment(part, "--epsilon") for part in parts)
            else:
                value = parts[0] if len(parts) == 1 else tuple(parts)
        if isinstance(value, list) and len(value) == 1:
            value = value[0]
        several = value.values() if isinstance(value, Mapping) else value if isinstance(value, (list, tuple)) else ()
        _positive(value) if not isinstance(value, (Mapping, list, tuple, type(None))) else [*map(_positive, several)]
        return value

    @model_validator(mode="before")
    @classmethod
    def _policy_with_steps(cls, data: Any) -> Any:
        """Accept ``policy: {name: pgd, steps: 80, momentum: 0.9}``, ``pgd={momentum: 0.9}`` and a name."""
        policy = data.get("policy")
        if isinstance(policy, str) and "=" in policy:
            name, options = parse_assignment(policy, "--policy")
            policy = {"name": name, **(options if isinstance(options, Mapping) else {"": options})}
        if not isinstance(policy, Mapping):
            return data
        options = dict(policy)
        steps = {"steps": options.pop("steps")} if "steps" in options else {}
        name = options.pop("name", "auto")
        return {**data, **steps, "policy": {"name": name, **options} if options else name}

    @model_validator(mode="after")
    def _together(self) -> AttackConfig:
        """Refuse settings that exclude each other."""
        if self.smallest and self.epsilons:
            raise InputError("--smallest: finds one epsilon by itself; give one --epsilon as the largest, or none")
        if self.smallest and self.is_study:
            raise InputError("--smallest: is about one object; name one --object, and one --epsilon as the largest")
        if self.minimise and self.is_study:
            raise InputError("--minimise: has no robust accuracy; name one --object and one --epsilon")
        if self.smallest and self.seconds is not None:
            raise InputError("--smallest: takes several searches; give --steps for each, and leave --seconds out")
        if self.smallest and self.over:
            raise InputError("--smallest: cannot be combined with --over yet; leave one of them out")
        if self.minimise and self.target:
            raise InputError("--minimise: makes the right answer easier to give; leave --target out")
        if self.minimise and self.smallest:
            raise InputError("--minimise: has no smallest change; leave --smallest out")
        twice = set(self.over) & set(self.controls)
        if twice:
            raise InputError(f"--over: {', '.join(sorted(twice))} is searched already; leave it out of one of the two")
        return self

    @property
    def policy_name(self) -> str:
        """Name of the policy."""
        return self.policy if isinstance(self.policy, str) else str(self.policy["name"])

    @property
    def policy_options(self) -> dict[str, Any]:
        """Options of the policy."""
        return {} if isinstance(self.policy, str) else {k: v for k, v in self.policy.items() if k != "name"}

    @property
    def epsilons(self) -> tuple[float, ...]:
        """The several epsilons of a curve; empty where there is one."""
        return self.epsilon if isinstance(self.epsilon, tuple) else ()

    @property
    def is_study(self) -> bool:
        """Whether it takes several attacks: over objects, or over epsilons."""
        return bool(self.epsilons) or len(self.objects) > 1

    @property
    def trial_count(self) -> int:
        """Trials of each group in the verification."""
        return self.trials if self.trials is not None else TRIALS_OVER if self.over else TRIALS

    def epsilon_of(self, control: str) -> float | None:
        """The budget asked for one control by the name of its instance; None leaves it its own."""
        if isinstance(self.epsilon, dict):
            return self.epsilon.get(control)
        return None if isinstance(self.epsilon, tuple) else self.epsilon


class GapConfig(AttackConfig):
    """Everything that decides what `gap` does: the worst case beside the average, for each object and each control."""

    command: ClassVar[str] = "gap"

    average: int = setting(
        200,
        "search",
        "random configurations of the same space that say how often the model is wrong on average",
        "a whole number from 1 to 1000000",
        unit="renders",
        ge=1,
        le=1_000_000,
    )


class RegionConfig(SceneConfig):
    """Everything that decides what `region` does: the box around a configuration in which the verdict stays."""

    command: ClassVar[str] = "region"

    around: str | None = setting(
        None,
        "region",
        "a run whose answer is the centre; it brings scene, model and controls with it",
        "the name or the folder of a run",
        otherwise="the scene as it is",
    )
    vary: str | None = setting(
        None,
        "region",
        "the parameters in which the box grows, separated by commas",
        "names such as pose.yaw,camera.elevation",
        otherwise="all that the controls search, up to eight",
    )
    samples: int = setting(
        200,
        "region",
        "fresh samples that check the box",
        "a whole number from 1 to 1000000",
        unit="renders",
        ge=1,
        le=1_000_000,
    )
    map: int = setting(
        0,
        "region",
        "side of the map of the margin, where there are two parameters; 0 for none",
        "a whole number from 0 to 512",
        unit="points",
        ge=0,
        le=512,
    )
    verify_spp: int | None = setting(
        None,
        "region",
        "samples per pixel",
        "a whole number from 1 to 65536",
        otherwise="raised until noise moves nothing",
        unit="samples",
        ge=1,
        le=65536,
    )


class SweepConfig(SceneConfig):
    """Everything that decides what `sweep` does: the average case over a grid, over random draws, or both."""

    command: ClassVar[str] = "sweep"

    object: str = setting(
        ...,
        "scene",
        "what the model should recognise; several separated by commas",
        "names of objects or .obj, .ply, .glb, .gltf or .stl files",
    )
    environment: str = setting(
        "studio",
        "scene",
        "what lights it; several separated by commas",
        "names of environments or .hdr or .exr files",
    )
    model: str = setting(
        "reference",
        "model",
        "the network under test; several separated by commas are shown the same pictures",
        "reference, a .pt2 (torch.export), .pt or .ts (TorchScript) file, package.module:callable, or torchvision:NAME",
    )
    grid: dict[str, Any] = setting(
        dict,
        "sweep",
        "an axis of the grid; may be repeated",
        "PARAMETER=FIRST:LAST:COUNT, or values separated by commas",
    )
    controls: dict[str, dict[str, Any]] = setting(
        dict,
        "sweep",
        "what is drawn by chance beside the grid, separated by commas",
        "names of controls, or NAME={PARAMETER: VALUE or [LOW, HIGH]}",
    )
    samples: int | None = setting(
        None,
        "sweep",
        "draws of the controls at each point of the grid",
        "a whole number from 1 to 1000000000",
        otherwise="1, or 100 without a grid",
        ge=1,
        le=1_000_000_000,
    )
    sampler: Literal["sobol", "random"] = setting("sobol", "sweep", "how the draws are made", "sobol or random")
    batch: int = setting(
        16,
        "sweep",
        "pictures that the model sees at once, and that are stored at once",
        "a whole number from 1 to 1024",
        unit="pictures",
        ge=1,
        le=1024,
    )
    spp: int | None = setting(
        None,
        "sweep",
        "samples per pixel of a picture",
        "a whole number from 1 to 65536",
        otherwise="8 with the denoiser, 16 without",
        unit="samples",
        ge=1,
        le=65536,
    )
    trials: int = setting(
        20,
        "verification",
        "fresh renders that check the worst configuration",
        "a whole number from 0 to 100000",
        unit="renders",
        ge=0,
        le=100_000,
    )
    verify_spp: int | None = setting(
        None,
        "verification",
        "samples per pixel of these",
        "a whole number from 1 to 65536",
        otherwise="raised until noise moves nothing",
        unit="samples",
        ge=1,
        le=65536,
    )
    run: str | None = setting(
        None,
        "run",
        "where the run is kept",
        "a name (kept in runs/) or the path of a folder",
        otherwise="runs/OBJECT-sweep-NNN",
        min_length=1,
    )

    @property
    def environments(self) -> tuple[str, ...]:
        """The environments by name."""
        return split_names(self.environment)

    @property
    def models(self) -> tuple[str, ...]:
        """The models by name."""
        return split_names(self.model)

    @field_validator("grid", mode="before")
    @classmethod
    def _grid_of_values(cls, value: Any) -> Any:
        """Accept any sequence of values from Python (a range, an array), and ``a,b,c``; FIRST:LAST:COUNT stays text."""
        if not isinstance(value, Mapping):
            return value
        return {str(name): _grid_values(given) for name, given in value.items()}


class PrecisionConfig(SceneConfig):
    """Everything that decides what `precision` does: error against run time, for a scene, its controls and a model."""

    command: ClassVar[str] = "precision"

    quantities: str = setting(
        "image,gradient,objective",
        "search",
        "what is measured, separated by commas",
        "image, gradient, objective",
    )
    seconds: float = setting(
        120.0, "search", "time that all measurements may take", "a number greater than 0", unit="seconds", gt=0.0
    )
    error: float = setting(
        0.05, "search", "relative error that the recommended settings should have", "a number greater than 0", gt=0.0
    )
    rounds: int = setting(
        8, "search", "measurements of every setting, at most", "a whole number from 3 to 1000", ge=3, le=1000
    )
    samplers: str = setting(
        "independent,stratified,multijitter,orthogonal,ldsampler",
        "search",
        "samplers that are compared, separated by commas",
        "independent, stratified, multijitter, orthogonal, ldsampler",
    )
    depths: str = setting(
        "2,3,4,12",
        "search",
        "longest light paths that are compared with the run's own, separated by commas",
        "whole numbers from 2 to 64",
        unit="segments",
    )
    loss: Literal["linear", "model"] = setting(
        "linear",
        "search",
        "whose gradient is measured: a smooth linear loss of the raw picture, or the model's in its image formation",
        "linear or model",
    )
    objective: str = setting("margin", "search", "what policies maximise", "the name of an objective")
    epsilon: float | None = setting(
        None,
        "search",
        "how far a control may go from where it starts, in its own unit",
        "a number greater than 0",
        otherwise="the control's own",
        gt=0.0,
    )
    policies: str = setting(
        "auto,random", "search", "policies that are compared, separated by commas", "names of policies"
    )
    steps: int = setting(
        32, "search", "renders of each search of a policy", "a whole number from 2 to 100000", ge=2, le=100_000
    )
    repeats: int = setting(
        5, "search", "searches of each policy, with other seeds", "a whole number from 1 to 1000", ge=1, le=1000
    )
    out: str | None = setting(
        None,
        "run",
        "where the figures and the numbers go, instead of a run directory",
        "the path of a folder",
        otherwise="a run directory",
        min_length=1,
    )

    @field_validator("quantities", "samplers", "depths", "policies", mode="before")
    @classmethod
    def _names_from_list(cls, value: Any) -> Any:
        """Accept a list of names for names separated by commas."""
        return ",".join(str(part) for part in value) if isinstance(value, (list, tuple)) else value

    @field_validator("quantities", "samplers")
    @classmethod
    def _known_names(cls, value: str, info: Any) -> str:
        known = {"quantities": QUANTITIES, "samplers": SAMPLERS}[info.field_name]
        if not split_names(value) or not set(split_names(value)) <= set(known):
            raise ValueError("unknown names")
        return value

    @field_validator("depths")
    @classmethod
    def _depths_in_range(cls, value: str) -> str:
        if not all(2 <= int(part) <= 64 for part in split_names(value)):
            raise ValueError("out of range")
        return value

    def as_attack(self) -> AttackConfig:
        """Return the settings that an attack shares."""
        shared = {name: getattr(self, name) for name in SceneConfig.model_fields if name not in PLACE}
        return AttackConfig(**shared, objective=self.objective, epsilon=self.epsilon)


def _grid_values(given: Any) -> Any:
    """The values of one axis as a list, or FIRST:LAST:COUNT as text."""
    if isinstance(given, Mapping) and set(given) == {"choices"}:
        given = given["choices"]
    if isinstance(given, str):
        text = given.strip().removeprefix("[").removesuffix("]")
        if ":" in text and "," not in text:
            return text
        given = [part.strip() for part in text.split(",") if part.strip()]
    values = _plain_values(given)
    values = values if isinstance(values, list) else [values]
    if not values or any(one is None or isinstance(one, (bool, list, Mapping)) for one in values):
        raise ValueError("not values")
    return [number_or_text(one) for one in values]


def _plain_values(given: Any) -> Any:
    """A sequence, a range or an array as a list of Python numbers and names; one value stays one."""
    given = given.tolist() if hasattr(given, "tolist") else given
    sequence = isinstance(given, (range, tuple, list))
    return [one.item() if hasattr(one, "item") else one for one in given] if sequence else given


def _positive(value: Any) -> None:
    if isinstance(value, bool) or not 0.0 < float(value) < math.inf:
        raise ValueError("expected a number greater than 0")
