"""A question from a function: of its types come settings and result, and of both its command and its Python function.

    @question("gap --object mug --control pose", place=("object", "model"))
    def gap(asked: Asked[GapConfig]) -> GapResult: ...

`advsearch.registry` finds it by its name. The first line of its file says what it does, as `advsearch --help` shows it.
The file imports nothing that renders but inside the function: who reads settings or a result reads it too.
"""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Generic, TypeVar, get_args, get_type_hints

from advsearch import registry
from advsearch.interrupts import interruptible
from advsearch.progress import NullProgress, Progress, watcher
from advsearch.report.shown import result_figure, shown
from advsearch.runs.directory import RunDirectory, begun
from advsearch.runs.files import write_bytes
from advsearch.runs.results import INTERRUPTED, Result
from advsearch.settings import Config
from advsearch.viewer.pages import keep_result

Settings = TypeVar("Settings", bound=Config, covariant=True)
AnyResult = TypeVar("AnyResult", bound=Result)
Made = TypeVar("Made", bound=Result)

SAID = {
    "object": "object", "objects": "objects", "environment": "lit_by", "controls": "controls", "model": "model",
    "task": "task_name", "policy": "policy_name", "seed": "seed",
}  # fmt: skip
"""Fields of a result that settings say, by the attribute of these."""

TYPES = {
    "object": "Scene | str | Path", "model": "AnyModel", "compared": "str | Path | Sequence[str | Path]",
    "sweeps": "str | Path | Sequence[str | Path]",
}  # fmt: skip
"""What Python may give for a setting in place of its text."""


class Asked(ExitStack, Generic[Settings]):
    """What a question is asked: its settings, who watches, and the folder of a run that goes on."""

    def __init__(self, config: Settings, progress: Progress | None = None, resumed: Path | None = None) -> None:
        super().__init__()
        self.config, self.progress, self.resumed = config, progress or NullProgress(), resumed
        self.ending, self._begun = "done", time.perf_counter()

    @cached_property
    def run(self) -> RunDirectory:
        """The run, made where it is first asked for: whatever may be wrong is looked for before."""
        return self.enter_context(RunDirectory.of(self.config, self.resumed))

    @contextmanager
    def until_interrupted(self) -> Iterator[None]:
        """Do what can be interrupted; the question goes on behind it, and its run ends as that."""
        try:
            with interruptible():
                yield
        except KeyboardInterrupt:
            self.ending = INTERRUPTED

    def result(self, kind: type[Made], **fields: Any) -> Made:
        """Return a result with these fields, and with those that all results have: what the settings say of object,
        model and so on, the run, how it ended and how long it took, beside the seconds of its parts."""
        common = {name: getattr(self.config, of) for name, of in SAID.items() if hasattr(self.config, of)}
        common |= {name: list(common[name]) for name in ("objects", "controls") if name in common}
        seconds = {"total": time.perf_counter() - self._begun, **fields.pop("seconds", {})}
        common |= {"run": str(self.run.path), "ending": self.ending, "seconds": seconds}
        return kind(**{**common, "command_line": self.config.command_line(), **fields})


def carried_out(function: Callable[[Asked[Settings]], AnyResult], asked: Asked[Settings]) -> AnyResult:
    """Return the result of a function, which is kept in its run with its page and its figure."""
    with asked:
        result = function(asked)
        if "run" not in vars(asked):  # else the function has kept it itself
            return result
        for suffix, data in result_figure(shown(result)).items():
            write_bytes(asked.run.path / "images" / f"{asked.config.command}.{suffix}", data)
        return keep_result(asked.run, result)


def carry_out(config: Config, *, progress: Progress | None = None, resumed: Path | None = None) -> Result:
    """Ask the question that the configuration of any command asks, and keep the run in a directory; `progress` is told
    how far it is, and `resumed` is the folder of a run to go on with, None for a new one. Raises InputError: anything
    that whoever asked can put right; nothing is written then."""
    from advsearch.api.names import check_names  # imports scipy

    check_names(config)
    keeps_run = resumed is None and getattr(config, "out", None) is None
    with begun(config) if keeps_run else nullcontext(resumed) as folder:  # before what is heavy is imported
        ask = registry.part_of(config.command, "from_config")
        ask = ask or registry.imported(f"advsearch.api.{config.command}:{config.command}_from_config")
        made = ask(config, progress=progress, **({} if folder is None else {"resumed": folder}))
    result: Result = made if isinstance(made, Result) else made.summary
    return result


@dataclass(frozen=True)
class Question(Generic[AnyResult]):
    """A question: its function, the classes of its settings and its result, and what else is said of it."""

    function: Callable[..., AnyResult]
    config: type[Config]
    result: type[AnyResult]
    examples: tuple[str, ...]  # lines of a shell, for its help
    place: tuple[str, ...]  # settings that Python takes by position
    about: str  # the setting that names a run or a file which it is about
    # where that is given without its flag, what stands for it in the help, and what an error says it is; perhaps what
    # the help adds, and whether there may be several
    expected: tuple[Any, ...] | None
    # returns settings that the `run.yaml` of that run brings, by what was typed
    brought: Callable[[Path, Mapping[str, Any]], dict[str, Any]] | None
    called: str  # ``module:function`` that Python calls, where more can be given there than settings
    more: str  # what its help says after what it does
    # whether a result falls short of what was checked, which ends the command with status 3
    short: Callable[[Any], bool]
    listed: str  # ``module:function`` that returns what that setting may be, each with a line: `list` prints it

    def from_config(
        self, config: Any, *, progress: Progress | None = None, resumed: Path | None = None, **more: Any
    ) -> AnyResult:
        """Do what a configuration describes, and keep it in its run; `more` is for the function alone."""
        return carried_out(partial(self.function, **more), Asked(config, progress, resumed))

    def __call__(self, *args: Any, **settings: Any) -> AnyResult:
        made: AnyResult = self.python(*args, **settings)
        return made

    @cached_property
    def python(self) -> Callable[..., Any]:
        """What Python calls, with every setting as a keyword."""
        if self.called:
            made: Callable[..., Any] = registry.imported(self.called)
            return made
        from advsearch.api.keywords import asks, configured  # imports torch

        def function(*args: Any, progress: Any = None, **settings: Any) -> AnyResult:
            given = dict(zip(self.place, args, strict=False))
            return self.from_config(configured(self.config, **given, **settings), progress=watcher(progress))

        Parameter, parameters = inspect.Parameter, []
        for name in self.place:
            field, kind = self.config.model_fields[name], TYPES.get(name, "str | Path")
            default = Parameter.empty if field.is_required() else field.default
            parameters.append(Parameter(name, Parameter.POSITIONAL_OR_KEYWORD, default=default, annotation=kind))
        parameters.append(Parameter("progress", Parameter.KEYWORD_ONLY, default=None, annotation="Watched"))
        parameters.append(Parameter("settings", Parameter.VAR_KEYWORD))
        signature = inspect.Signature(parameters, return_annotation=self.result.__name__)
        function.__signature__ = signature  # type: ignore[attr-defined]
        function.__name__, function.__doc__ = self.config.command, self.function.__doc__
        function.__qualname__, function.__module__ = function.__name__, self.function.__module__
        return asks(self.config)(function)


def question(
    *examples: str,
    place: tuple[str, ...] = (),
    about: str = "",
    expected: tuple[Any, ...] | None = None,
    brought: Callable[[Path, Mapping[str, Any]], dict[str, Any]] | None = None,
    called: str = "",
    more: str = "",
    short: Callable[[Any], bool] = lambda result: False,
    listed: str = "",
) -> Callable[[Callable[..., AnyResult]], Question[AnyResult]]:
    """Make a `Question` of a function ``(asked: Asked[NameConfig]) -> NameResult`` that is called as its command, with
    examples for its help; the others are fields of `Question`."""

    def decorate(function: Callable[..., AnyResult]) -> Question[AnyResult]:
        hints = get_type_hints(function)
        first, result = next(iter(inspect.signature(function).parameters)), hints["return"]
        (config,) = get_args(hints[first])
        result = (*get_args(result), result)[0]  # the first of several kinds
        return Question(
            function, config, result, examples, place, about, expected, brought, called, more, short, listed
        )

    return decorate
