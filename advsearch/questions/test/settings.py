"""Settings of `test`, and the suites that YAML files describe."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from advsearch.extend import (
    AttackConfig,
    Config,
    InputError,
    SceneConfig,
    SweepConfig,
    errors,
    setting,
    setting_as_in,
    settings,
)

powers = settings.powers


class SuiteConfig(Config):
    """Settings of `test`: the suite, the claims that are tested, and the model."""

    # fmt: off
    command: ClassVar[str] = "test"
    changeable_settings: ClassVar[tuple[str, ...]] = (
        *Config.changeable_settings,
        "seconds", "workers", "cluster", "junit", "sarif", "markdown", "update",
        "twins",
    )
    clashes: ClassVar[tuple[settings.Clash, ...]] = (
        *SceneConfig.clashes,
        settings.Clash("fresh", lambda config: config.seed is not None,
              "samples a seed, and `seed` sets one; leave one of the two out"),
        settings.Clash("update", lambda config: config.add is not None,
              "updates expected verdicts of claims; run `add` first, then `update`"),
        settings.Clash("only", lambda config: config.add is not None,
              "names claims, and `add` tests only the new counterexample; leave one "
              "of the two out"),
    )

    suite: str = setting(..., "test", "file with the claims", "a YAML file")
    only: str | None = setting(
        None, "test", "claims or counterexamples that are tested, separated by commas; "
                      "`counterexamples` stands for all of these",
        "names in the suite", otherwise="all",
    )
    add: str | None = setting(
        None, "test", "store the adversarial scene of this run as a counterexample of "
                      "the suite, and test it",
        "the name or the folder of a run of attack", otherwise="nothing is added",
        power=powers.describe_suite_change,
    )
    update: bool = setting(
        False, "test", "store the verdicts as expected from now on, and report what "
                       "changes", power=powers.describe_suite_change
    )
    all: bool = setting(False, "test", "test the claims even if a counterexample fails")
    fresh: bool = setting(False, "test", "sample a new seed, which is reported, in "
                                         "place of the suite's")
    seconds: float | None = setting(
        None, "test", "time after which no further test begins; remaining claims are "
                      "undecided",
        otherwise="that of the suite, or no limit", unit="seconds", gt=0.0, le=1e9,
    )
    model: str | None = setting_as_in(
        SceneConfig, "model", default=None, otherwise="that of the suite, or "
                                                      "reference"
    )
    junit: str | None = setting(
        None, "files", "write JUnit XML, a test case for each claim", "a file",
        otherwise="none", power=powers.describe_file,
    )
    sarif: str | None = setting(
        None, "files", "write SARIF 2.1.0, a result for each claim that is not held", "a file",
        otherwise="none", power=powers.describe_file,
    )
    markdown: str | None = setting(
        None, "files", "write a Markdown table, such as for the summary of a CI job",
        "a file",
        otherwise="none", power=powers.describe_file,
    )
    seed: int | None = setting_as_in(
        SceneConfig, "seed", default=None, otherwise="that of the suite, or 0"
    )
    threads: int | None = setting_as_in(SceneConfig, "threads")
    deterministic: bool = setting_as_in(SceneConfig, "deterministic")
    workers: int | None = setting_as_in(
        AttackConfig, "workers", description="worker processes among which the images "
                                             "of each claim are divided"
    )
    cluster: str | None = setting_as_in(AttackConfig, "cluster")
    twins: str | None = setting_as_in(AttackConfig, "twins", group="test")
    run: str | None = setting_as_in(SceneConfig, "run", otherwise="runs/SUITE-test-NNN")
    overwrite: bool = setting_as_in(SceneConfig, "overwrite")
    # fmt: on

    _named = settings.text_validator(
        "suite", "add", "model", "junit", "sarif", "markdown", "run", several=["only"]
    )
    _different = settings.unique_names_validator("only")

    @property
    def selected_claims(self) -> tuple[str, ...]:
        """The names in `only`; empty for all claims."""
        return () if self.only is None else settings.split_names(self.only)

    @property
    def run_name_words(self) -> tuple[str, ...]:
        """The names that a run's directory is named after."""
        return Path(self.suite).stem, self.command


class SampledConfig(SceneConfig):
    """Settings of pictures that are sampled from the ranges of the controls."""

    command: ClassVar[str] = "test"
    excluded_settings: ClassVar[tuple[str, ...]] = ("spp",)

    verify_spp: int = setting_as_in(
        AttackConfig,
        "verify_spp",
        default=16,
        description="samples per pixel of each picture",
        otherwise="",
    )


SUITE_ONLY_SETTINGS = (
    *settings.RUN_LOCATION,
    "seed",
    "threads",
    "deterministic",
    "workers",
    "cluster",
    "seconds",
)
"""Settings that the suite or its command sets for all claims."""

# default and maximum number of images of a claim
DEFAULT_PICTURES = 400
MAX_PICTURES = 1_000_000
# name that stands for all counterexamples; no claim may have it
ALL_COUNTEREXAMPLES = "counterexamples"
Settings = dict[str, object]

EXPECTED_VALUES = {
    "claim": "right, not_broken, no_worse, must_change or must_not_change",
    "claims": "a mapping of names to claims, such as `right-around: {claim: right, "
    "at_least: 0.9}`",
    "at_least": "a fraction over 0 and under 1, such as 0.95",
    "points": "percentage points over 0 and under 100, such as 2",
    "pictures": f"a whole number from 1 to {MAX_PICTURES}",
    "when": (
        f"{', '.join(SweepConfig.blind_changes)} of must_change, and "
        f"{', '.join(SweepConfig.harmless_changes)} of "
        "must_not_change"
    ),
    "than": "another model, by its name or its file",
    "confidence": "a number from 0.5 to 0.9999, such as 0.95",
    "seconds": "a number of seconds over 0",
    "seed": "a whole number from 0 to 2**63 - 1",
    "settings": "settings with their values, such as `object: mug`",
    "title": "a text of 1 to 200 letters",
}

CLAIM_EXAMPLE = "a claim such as {claim: right, at_least: 0.9}"
NUMBER_FIELDS = ("at_least", "points", "pictures", "confidence", "seconds", "seed")


class _YamlModel(BaseModel):
    """A part of a suite's file, in which every name has to be known."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=False)

    @field_validator(*NUMBER_FIELDS, mode="before", check_fields=False)
    @classmethod
    def _no_number_from_bool(cls, value: Any, info: Any) -> Any:
        """Reject a boolean for a number, such as `pictures: yes` in YAML."""
        if isinstance(value, bool):
            raise ValueError(
                f"expected {EXPECTED_VALUES[info.field_name]}, got {value}"
            )
        return value


class _Claim(_YamlModel):
    """A claim, with settings that override those of the suite."""

    config_type: ClassVar[type[SceneConfig]]
    settings: Settings = Field(default_factory=dict)


class _PicturesClaim(_Claim):
    """A claim that is decided by at most `pictures` sampled images."""

    config_type: ClassVar[type[SceneConfig]] = SampledConfig
    pictures: Annotated[int, Field(ge=1, le=MAX_PICTURES)] = DEFAULT_PICTURES


class ShareClaim(_PicturesClaim):
    """A claim that something holds in at least a fraction of the pictures."""

    at_least: Annotated[float, Field(gt=0.0, lt=1.0)]

    @field_validator("at_least", mode="before")
    @classmethod
    def _per_cent(cls, value: Any) -> Any:
        """Convert a text such as ``95 %`` to a fraction."""
        if not isinstance(value, str):
            return value
        percentage = re.fullmatch(r"\s*(\d+(?:\.\d+)?) ?%\s*", value)
        return value if percentage is None else float(percentage[1]) / 100.0


class RightClaim(ShareClaim):
    """The model is right."""

    claim: Literal["right"]


class MustChangeClaim(ShareClaim):
    """The prediction changes if the object is not visible any more.

    A model whose prediction does not change ignores the object. `when` is the change of
    the image, one of `SweepConfig.blind_changes`.
    """

    claim: Literal["must_change"]
    when: Literal["black", "covered", "away"]


class MustNotChangeClaim(ShareClaim):
    """The prediction stays the same under a change that does not alter the object.

    `when` is the change of the image, one of `SweepConfig.harmless_changes`.
    """

    claim: Literal["must_not_change"]
    when: Literal["exposure", "shift", "jpeg"]


class NotBrokenClaim(_Claim):
    """No search within a budget finds a configuration that the model gets wrong.

    Its settings are those of `attack`.
    """

    config_type: ClassVar[type[SceneConfig]] = AttackConfig
    claim: Literal["not_broken"]


class NoWorseClaim(_PicturesClaim):
    """The model is right less often than another by at most `points` percentage points.

    Both predict the same pictures.
    """

    claim: Literal["no_worse"]
    than: Annotated[str, Field(min_length=1)]
    points: Annotated[float, Field(gt=0.0, lt=100.0)]


ChangeClaim = MustChangeClaim | MustNotChangeClaim
AnyClaim = RightClaim | NotBrokenClaim | NoWorseClaim | ChangeClaim
"""The kinds of claims; `ClaimTester` tests them."""

CLAIM_KINDS = ("right", "not_broken", "no_worse", "must_change", "must_not_change")


class Suite(_YamlModel):
    """The content of a suite's file.

    Attributes:
        title: title of the suite.
        settings: settings of all claims, as for `attack`; those of a claim override
            them.
        seed: root of all random numbers.
        confidence: confidence of each claim that sampled images decide.
        seconds: time after which no further test begins; None for no limit.
        claims: claims by name.
    """

    title: Annotated[str, Field(min_length=1, max_length=200)] = "Claims about a model"
    settings: Settings = Field(default_factory=dict)
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    confidence: Annotated[float, Field(ge=0.5, le=0.9999)] = 0.95
    seconds: Annotated[float, Field(gt=0.0, le=1e9)] | None = None
    claims: Annotated[
        dict[str, Annotated[AnyClaim, Field(discriminator="claim")]],
        Field(min_length=1, max_length=1000),
    ]

    @field_validator("claims")
    @classmethod
    def _names(cls, value: dict[str, AnyClaim]) -> dict[str, AnyClaim]:
        """Check the names of claims."""
        for name in value:
            is_valid = re.fullmatch(r"[a-z0-9][a-z0-9-]{0,59}", name)
            if not is_valid or name == ALL_COUNTEREXAMPLES:
                raise ValueError(
                    "expected names of small letters, digits and "
                    f"hyphens, got {settings.format_value(name)}"
                )
        return value

    def make_config(self, name: str, **changes: object) -> SceneConfig:
        """Return the settings that a claim is tested with.

        Settings of the claim override those of the suite, and `changes` override both.

        Args:
            name: name of the claim.
            **changes: settings of the command, which override those of the claim; None
                for a setting that is not changed.

        Raises:
            InputError: a setting is unknown, invalid, or belongs to the suite.
        """
        claim = self.claims[name]
        _check_no_suite_setting("settings", self.settings)
        _check_no_suite_setting(f"claims.{name}.settings", claim.settings)
        changed = {key: value for key, value in changes.items() if value is not None}
        merged = {**self.settings, **claim.settings, "seed": self.seed, **changed}
        try:
            return claim.config_type(**merged)
        except InputError as error:
            raise InputError(f"claims.{name}: {error}") from None


def _check_no_suite_setting(where: str, claim_settings: Mapping[str, object]) -> None:
    """Raise an error if settings of claims have one that belongs to the suite.

    For example the seed: all claims of a suite have the same.
    """
    for known in claim_settings:
        if known in SUITE_ONLY_SETTINGS:
            raise InputError(
                f"{where}: {known} is a setting of the full suite; leave it out there"
            )


def read_suite(path: str | Path) -> Suite:
    """Read the suite of a YAML file.

    Raises:
        FileFormatError: the file does not describe a suite.
    """
    return parse_suite(settings.read_yaml(path), str(path))


def parse_suite(data: Mapping[str, object], where: str) -> Suite:
    """Parse the content of a suite's file; `where` names the file in messages.

    Raises:
        FileFormatError: something is missing, unknown, or of another type.
    """
    values = {
        name: value for name, value in data.items() if name not in ("schema", "command")
    }
    try:
        return Suite(**values)
    except ValidationError as error:
        problems = error.errors(include_url=False)
        # An unknown name is reported first: a misspelling often causes other problems.
        unknown_names = [
            problem for problem in problems if problem["type"] == "extra_forbidden"
        ]
        first = (unknown_names or problems)[0]
        raise errors.FileFormatError(f"{where}: {_describe_error(first)}") from None


def _describe_error(error: Any) -> str:
    """Describe an error of pydantic as "where: expected ..., got ...".

    Args:
        error: an entry of `ValidationError.errors()`, with "type", "loc", "input" and
            "ctx".
    """
    kind = error["type"]
    # The location is a path of names, such as ["claims", "right-around", "at_least"].
    # pydantic adds the kind of the claim to it, which is left out.
    location = [str(part) for part in error["loc"] if part not in CLAIM_KINDS]
    # pydantic's location of a wrong key of a mapping ends with "[key]". Keys are names
    # of claims: YAML has read a name such as 12 as a number.
    is_wrong_key = location[-1] == "[key]"
    if is_wrong_key:
        return (
            f"{location[0]}: expected names of small letters, digits and hyphens, got "
            f"{settings.format_value(error['input'])}; put it in quotes"
        )
    # The field `claim`, which states the kind of a claim, is missing or wrong.
    if kind.startswith("union_tag"):
        location.append("claim")
    where = ".".join(location)
    name = location[-1]
    if kind == "extra_forbidden":
        # A path of more than two names leads into a claim, such as claims.NAME.SETTING.
        return f"{where}: {_describe_unknown_name(name, in_claim=len(location) > 2)}"
    if kind == "value_error":
        return f"{where}: {str(error['msg']).removeprefix('Value error, ')}"
    # If the name is not that of a setting, it is the name of a claim.
    expected = EXPECTED_VALUES.get(name, CLAIM_EXAMPLE)
    return f"{where}: expected {expected}, got {_describe_input(error)}"


def _describe_input(error: Any) -> str:
    """Describe the value that an error of pydantic is about, or that there is none."""
    kind = error["type"]
    if kind in ("missing", "union_tag_not_found"):
        return "nothing"
    if kind == "too_short":  # an empty mapping of claims
        return "none"
    if kind.startswith("union_tag"):
        return settings.format_value(error["ctx"]["tag"])
    return settings.format_value(error["input"])


def _describe_unknown_name(name: str, *, in_claim: bool) -> str:
    """Describe a name that a suite or a claim does not have."""
    if name in EXPECTED_VALUES:
        owner = "a claim of this kind" if in_claim else "a suite"
        return f"{owner} has no {name}; leave it out"
    similar = difflib.get_close_matches(name, sorted(EXPECTED_VALUES), 1)
    guess = "docs/testing.md has the names"
    if similar:
        guess = f"did you mean {similar[0]}?"
    return f"there is no such name in a suite, or in a claim of this kind; {guess}"
