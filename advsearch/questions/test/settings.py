"""What `test` needs to know beside its suite, and what one picture of a claim needs."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

from pydantic import field_validator

from advsearch.config.attack import AttackConfig
from advsearch.config.scene import SceneConfig
from advsearch.settings import Clash, Config, as_text, check_once, setting, setting_as_in, split_names


class SuiteConfig(Config):
    """Everything that decides what `test` does: which suite, which of its claims, and on what model."""

    command: ClassVar[str] = "test"
    free: ClassVar[tuple[str, ...]] = (
        *(*Config.free, "seconds", "workers", "cluster", "junit", "sarif", "markdown", "update"),
    )
    clashes: ClassVar[tuple[Clash, ...]] = (
        *SceneConfig.clashes,
        Clash("fresh", lambda one: one.seed is not None, "draws a seed, and `seed` says one; leave one of the two out"),
        Clash(
            "update", lambda one: one.add is not None, "renews what claims are expected to say; first `add`, then it"
        ),
        Clash(
            "only",
            lambda one: one.add is not None,
            "names claims, and `add` tries the new counterexample alone; leave one of the two out",
        ),
    )

    suite: str = setting(..., "test", "the claims", "a YAML file")
    only: str | None = setting(
        None,
        "test",
        "claims or counterexamples that are tried, separated by commas; counterexamples: all of these",
        "names in the suite",
        otherwise="all",
    )
    add: str | None = setting(
        None,
        "test",
        "keep the answer of this run as a counterexample beside the suite, and try it",
        "the name or the folder of a run of attack",
        otherwise="nothing is added",
    )
    update: bool = setting(False, "test", "expect from now on what the claims say today, and show what changes")
    all: bool = setting(False, "test", "go on with the other claims where a counterexample fails")
    fresh: bool = setting(False, "test", "draw a new seed, which is told, in place of the suite's")
    seconds: float | None = setting(
        None,
        "test",
        "begin nothing more after this time; what is left is undecided",
        otherwise="what the suite says, or no limit",
        unit="seconds",
        gt=0.0,
        le=1e9,
    )
    model: str | None = setting_as_in(SceneConfig, "model", default=None, otherwise="what the suite says, or reference")
    junit: str | None = setting(
        None, "files", "write JUnit XML, a test case for each claim", "a file", otherwise="none"
    )
    sarif: str | None = setting(
        None, "files", "write SARIF 2.1.0, a result for each claim that is not held", "a file", otherwise="none"
    )
    markdown: str | None = setting(
        None, "files", "write a Markdown table, for the summary of a job", "a file", otherwise="none"
    )
    seed: int | None = setting_as_in(SceneConfig, "seed", default=None, otherwise="what the suite says, or 0")
    threads: int | None = setting_as_in(SceneConfig, "threads")
    deterministic: bool = setting_as_in(SceneConfig, "deterministic")
    workers: int | None = setting_as_in(
        AttackConfig, "workers", description="worker processes that share the pictures of each claim"
    )
    cluster: str | None = setting_as_in(AttackConfig, "cluster")
    run: str | None = setting_as_in(SceneConfig, "run", otherwise="runs/SUITE-test-NNN")
    overwrite: bool = setting_as_in(SceneConfig, "overwrite")

    @field_validator("suite", "only", "add", "model", "junit", "sarif", "markdown", "run", mode="before")
    @classmethod
    def _as_text(cls, value: Any, info: Any) -> Any:
        return as_text(value, several=info.field_name == "only")

    @field_validator("only")
    @classmethod
    def _once(cls, value: str | None) -> str | None:
        check_once(() if value is None else split_names(value), "only")
        return value

    @property
    def chosen(self) -> tuple[str, ...]:
        """The names of what is tried; empty for all."""
        return () if self.only is None else split_names(self.only)

    @property
    def title(self) -> tuple[str, ...]:
        """The suite's name, and what is done with it."""
        return Path(self.suite).stem, self.command


class DrawnConfig(SceneConfig):
    """Pictures that are drawn from what controls span, with so many samples a pixel."""

    command: ClassVar[str] = "test"
    without: ClassVar[tuple[str, ...]] = ("spp",)

    verify_spp: int = setting_as_in(
        AttackConfig, "verify_spp", default=16, description="samples per pixel of each picture", otherwise=""
    )


CONFIG = SuiteConfig
