"""The settings of `attack`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from pydantic import JsonValue, model_validator

from advsearch.config import (
    ControlsByName,
    DerivativeConfig,
    RenderConfig,
    SceneConfig,
    get_name_without_options,
    parse_name_with_options,
)
from advsearch.files import JsonObject
from advsearch.settings import Clash, setting, setting_as_in, split_names
from advsearch.trust import powers

TRIALS = 20  # fresh renders that verify a configuration
TRIALS_OVER = 200  # the same if conditions vary by chance (`over`)
STEPS = 40  # steps of a search without conditions

# If conditions vary by chance: steps of a search, and conditions that each step
# evaluates.
SIZE_OVER_PREDICTED = (300, 8)
"""If a bank of matrices of light transport predicts the images."""
SIZE_OVER_SINGLE_PARAMETER = (100, 4)
"""If it predicts them, and only one number varies, such as a time (docs/drives.md)."""
SIZE_OVER_RENDERED = (150, 4)
"""If every image is rendered."""
SIZE_OVER_NUMBERS = (STEPS, 4)
"""If every image is rendered, and only a few numbers are searched, such as a pose."""
MIN_TRIALS = 6
"""With fewer trials nothing can be called found. A test compares it with the rules of
verification, which `advsearch.attacks.verification` has.
"""


class AttackConfig(DerivativeConfig):
    """The settings of `attack`. Frozen; unknown names are rejected."""

    command: ClassVar[str] = "attack"
    list_settings: ClassVar[tuple[str, ...]] = ("object", "epsilon", "model")

    changeable_settings: ClassVar[tuple[str, ...]] = (
        *DerivativeConfig.changeable_settings,
        "log",
        "workers",
        "cluster",
        "twins",
    )
    clashes: ClassVar[tuple[Clash, ...]] = (
        *DerivativeConfig.clashes,
        Clash(
            "smallest",
            lambda config: config.epsilons,
            "finds one epsilon by itself; give one `epsilon` as the largest, or none",
        ),
        Clash(
            "smallest",
            lambda config: config.is_study,
            "is about one object and one model; name one `object`, one `model`, and "
            "one `epsilon` as the largest",
        ),
        Clash(
            "model",
            lambda config: config.is_matrix and config.is_curve,
            "several models make a matrix, for one object and one epsilon; name one "
            "`object` and one `epsilon`, or one `model`",
        ),
        Clash(
            "ensemble",
            lambda config: len(split_names(config.model)) < 2,
            "needs several models; name them in `model`, separated by commas, or "
            "leave `ensemble` out",
        ),
        Clash(
            "smallest",
            lambda config: config.seconds is not None,
            "takes several searches; give `steps` for each, and leave `seconds` out",
        ),
        Clash(
            "smallest",
            lambda config: config.over,
            "cannot be combined with `over` yet; leave one of them out",
        ),
        Clash(
            "smallest",
            lambda config: config.printable,
            "cannot be combined with `printable`; leave one of them out",
        ),
        Clash(
            "minimise",
            lambda config: config.is_curve,
            "has no robust accuracy; name one `object` and one `epsilon`",
        ),
        Clash(
            "minimise",
            lambda config: config.target,
            "makes the right answer easier to give; leave `target` out",
        ),
        Clash(
            "minimise",
            lambda config: config.smallest,
            "has no smallest change; leave `smallest` out",
        ),
        Clash(
            "over",
            lambda config: (
                {*map(parse_instance, config.over)}
                & {*map(parse_instance, config.controls)}
            ),
            "names a control that is searched already; leave it out of one of the two",
        ),
        Clash(
            "draws",
            lambda config: not config.over,
            "is the number of conditions of `over` that a step evaluates, and there are "
            "none; add `over`, or leave `draws` out",
        ),
        Clash(
            "estimators",
            lambda config: (
                {name.partition(".")[0] for name in config.estimators}
                & {
                    part
                    for name in map(parse_instance, config.over)
                    for part in (name, name.rpartition(":")[2])
                }
            ),
            "names a control that varies by chance, whose derivative is not needed; "
            "leave it out",
        ),
        Clash(
            "average",
            lambda config: config.epsilons,
            "is the average within one epsilon; name one `epsilon`, or leave "
            "`average` out",
        ),
    )

    object: str = setting_as_in(
        SceneConfig,
        "object",
        description="the object that the model should recognise; several, separated by "
        "commas, are attacked in turn",
    )
    model: str = setting_as_in(
        SceneConfig,
        "model",
        description="the network under test; if there are several, separated by commas, "
        "each is attacked, and its adversarial scene is tried on all of them",
    )
    ensemble: Literal["mean", "worst"] | None = setting(
        None,
        "model",
        "find one scene against several models together: maximise the mean of their "
        "objectives, or the lowest one",
        otherwise="each by itself",
    )
    measure: Literal["no", "quick", "full"] = setting(
        "quick",
        "search",
        "measure which gradient estimator is best on this scene; full also measures "
        "step and samples",
    )
    policy: str | dict[str, JsonValue] = setting(
        "auto",
        "search",
        "the search policy, which proposes configurations",
        "the name of a policy, or NAME={OPTION: VALUE}",
    )
    steps: int | None = setting(
        None,
        "search",
        "number of search steps, each of which evaluates one configuration",
        otherwise=f"{STEPS}; for textures and the like with --over "
        f"{SIZE_OVER_PREDICTED[0]} if pictures are predicted, "
        f"{SIZE_OVER_SINGLE_PARAMETER[0]} if one number varies, as along a path, and "
        f"{SIZE_OVER_RENDERED[0]} if they are rendered",
        ge=1,
        le=1_000_000,
    )
    seconds: float | None = setting(
        None,
        "search",
        "stop the search after this time; the random search for comparison "
        "gets as many renders",
        otherwise="no limit",
        unit="seconds",
        gt=0.0,
        le=1e9,
    )
    target: str | None = setting(
        None,
        "search",
        "the wrong prediction to aim for, or several",
        "names of classes or their numbers, separated by commas",
        otherwise="any wrong prediction",
    )
    minimise: bool = setting(
        False, "search", "make the object easier to recognise, not harder"
    )
    smallest: bool = setting(
        False,
        "search",
        "find the smallest epsilon at which the model is wrong; "
        "--epsilon is the largest to try",
    )
    printable: bool = setting(
        False,
        "search",
        "prefer a smooth texture or patch in printable colours; a second search "
        "without this measures what it costs in margin",
    )
    aov: str | None = setting_as_in(
        RenderConfig,
        "aov",
        description="write ground truth for each pixel as layers of an EXR file, for "
        "the clean scene and the adversarial one; names are separated by commas",
    )
    metrics: dict[str, str] = setting(
        dict,
        "run",
        "your own numbers for every picture, each a column of the rows; "
        "may be repeated",
        "NAME=package.module:function of image, output and truth",
        flag="--metric",
        metavar="NAME=FUNCTION",
    )
    log: Literal["mlflow", "tensorboard", "wandb"] | None = setting(
        None,
        "run",
        "experiment tracker to which every evaluation is sent; its "
        "package has to be installed",
        otherwise="none",
        power=powers.describe_tracker,
    )
    over: ControlsByName = setting_as_in(
        SceneConfig,
        "controls",
        default=dict,
        description="controls that are drawn at random; one configuration has to hold "
        "across the draws",
        flag="",
        min_length=None,
    )
    path: str | None = setting(
        None,
        "search",
        "the path along which camera or object travel, with --over path; pictures of "
        "the adversarial scene along the path are stored",
        "approach, pass, orbit, a .csv file or a trajectory (TUM, EuRoC, KITTI), or "
        "two of them, the camera's and the object's, as in approach+orbit; if there are "
        "several, separated by commas, one is drawn each time",
        otherwise="approach",
        min_length=1,
    )
    shutter: float | None = setting(
        None,
        "search",
        "how long each row of a picture is exposed along a path (motion blur)",
        otherwise="no blur",
        unit="seconds",
        gt=0.0,
        le=60.0,
    )
    rolling: float | None = setting(
        None,
        "search",
        "how long the rows of a picture are read one after the other along a path "
        "(rolling shutter), from the top; "
        "below 0 from the bottom",
        otherwise="all at once",
        unit="seconds",
        ge=-60.0,
        le=60.0,
    )
    draws: int | None = setting(
        None,
        "search",
        "number of random conditions that each step evaluates, with --over",
        otherwise=f"{SIZE_OVER_PREDICTED[1]} if pictures are predicted and more "
        f"than one number varies, otherwise {SIZE_OVER_RENDERED[1]}",
        ge=1,
        le=1000,
    )
    average: int = setting(
        0,
        "search",
        "also evaluate this many random configurations, to measure how often "
        "the model is wrong on average",
        unit="renders",
        ge=0,
        le=1_000_000,
    )
    baseline: bool = setting(
        True,
        "search",
        "run a random search with as many renders, for comparison",
        flag="--no-baseline",
        switched="skip the random search that is a baseline for the search",
    )

    verify_spp: int | None = setting(
        None,
        "verification",
        "samples per pixel of the verification",
        otherwise="raised until more would not change the sign of the margin",
        unit="samples",
        ge=1,
        le=65536,
    )
    trials: int | None = setting(
        None,
        "verification",
        "fresh renders that verify the adversarial scene, and as "
        "many of the clean scene",
        f"a whole number from {MIN_TRIALS} to 100000 (with fewer, nothing can be "
        "called found)",
        otherwise=f"14, or 23 if one fails; with --over 30, or up to {TRIALS_OVER} "
        f"if some fail; {TRIALS} with --smallest",
        unit="renders",
        ge=MIN_TRIALS,
        le=100_000,
    )

    twins: str | None = setting(
        None,
        "verification",
        "a run of twins, which states how far the verdict holds for photographs",
        "the name or the folder of a run of twins",
        metavar="RUN",
        otherwise="nothing is stated",
        min_length=1,
    )
    workers: int | None = setting(
        None,
        "run",
        "number of worker processes; they share the attacks on several objects or "
        "models, or the independent renders of one attack",
        otherwise="only this process",
        unit="processes",
        ge=1,
        le=100_000,
        power=powers.describe_processes,
    )
    cluster: str | None = setting(
        None,
        "run",
        "where the workers are",
        "the address of a Dask scheduler, local, a .yaml file, or what an added "
        "cluster reads",
        metavar="PLACE",
        otherwise="this machine, if there are `workers`",
        min_length=1,
        power=powers.describe_connection,
    )

    @model_validator(mode="before")
    @classmethod
    def _read_policy(cls, data: Any) -> Any:
        """Accept a policy by its name, or with options, as a mapping or as text.

        The text is ``pgd={momentum: 0.9}``. Options may have the steps of the search
        among them: ``{name: pgd, steps: 80, momentum: 0.9}`` sets `steps`, too.
        """
        policy = _read_policy_setting(data.get("policy"))
        if policy is None:  # the setting is missing
            return data
        if not isinstance(policy, Mapping):  # a name without options
            return {**data, "policy": policy}
        steps = {"steps": policy["steps"]} if "steps" in policy else {}
        options = {
            option: value for option, value in policy.items() if option != "steps"
        }
        # Read again: without `steps`, the mapping may have only the name, which then
        # becomes a text.
        return {**data, **steps, "policy": _read_policy_setting(options)}

    @property
    def policy_name(self) -> str:
        """Name of the policy."""
        return get_name_without_options(self.policy)

    @property
    def policy_options(self) -> JsonObject:
        """Options of the policy."""
        if isinstance(self.policy, str):
            return {}
        return {
            option: value for option, value in self.policy.items() if option != "name"
        }

    @property
    def is_curve(self) -> bool:
        """Whether there are several attacks, on several objects or epsilons."""
        return bool(self.epsilons) or len(self.objects) > 1

    @property
    def is_matrix(self) -> bool:
        """Whether there are several models."""
        return len(self.models) > 1

    @property
    def is_study(self) -> bool:
        """Whether there are several attacks: a curve or a matrix."""
        return self.is_curve or self.is_matrix

    @property
    def trial_count(self) -> int:
        """Number of trials of each configuration in the verification."""
        if self.trials is not None:
            return self.trials
        return TRIALS_OVER if self.over else TRIALS


def parse_instance(parameter_name: str) -> str:
    """Return the instance of a control in the name of a parameter.

    "light:key" for "light:key.power", "camera" for "camera.azimuth".
    """
    kind, colon, name = parameter_name.partition(":")
    return kind.partition(".")[0] + colon + name.partition(".")[0]


def _read_policy_setting(value: Any) -> Any:
    """Return a policy by name, or as a mapping with its name and its options."""
    # Options without a name are those of "auto".
    return parse_name_with_options(value, setting="policy", default_name="auto")
