"""Define experiments: functions with declared settings and a result.

    @experiment("count --runs mug-texture-001", positional_args=("runs",))
    def count(context: RunContext[CountConfig]) -> CountResult: ...

The command, the Python function, the run directory and the HTML page are made from this
definition. `advsearch.catalog` lists the built-in experiments. A package adds its own
by an entry point of the group `advsearch.experiments`. The module of an experiment is
imported for the help of the command line, so it should import large packages inside of
functions.
"""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar, get_args, get_type_hints

from advsearch import registry, threads
from advsearch.interrupts import reraise_lost_interrupt
from advsearch.progress import NullProgress, Progress, Stages, as_progress
from advsearch.report.views import Claim, ShownResult, get_view, render_result_figure
from advsearch.runs.directory import (
    CONFIG,
    RunDirectory,
    create_before_work,
    is_run,
    locate_run,
)
from advsearch.runs.listing import is_finished
from advsearch.runs.measurements import Measurements
from advsearch.runs.results import INTERRUPTED, Result
from advsearch.runs.summary import read_result
from advsearch.settings import Config
from advsearch.trust.writing import write_bytes
from advsearch.viewer.pages import write_result

Settings = TypeVar("Settings", bound=Config, covariant=True)
AnyResult = TypeVar("AnyResult", bound=Result)
ResultType = TypeVar("ResultType", bound=Result)

SHARED_RESULT_FIELDS = {
    "object": "object",
    "objects": "objects",
    "environment": "environment_name",
    "controls": "controls",
    "model": "model",
    "task": "task_name",
    "policy": "policy_name",
    "seed": "seed",
}
"""Fields of a result that are copied from the settings, with the name of the attribute
of the settings.
"""

PYTHON_TYPES = {
    "object": "Scene | str | Path",
    "model": "AnyModel",
    "compared": "str | Path | Sequence[str | Path]",
    "sweeps": "str | Path | Sequence[str | Path]",
}
"""Types that Python callers may pass for positional settings, which are stored as text.
"""


class RunContext(ExitStack, Generic[Settings]):
    """The settings, the progress and the run directory of a running experiment.

    The function of an experiment gets it as its argument.

    Attributes:
        config: settings of the experiment.
        progress: object that displays the progress.
        resumed_directory: folder of the run that is continued; None for a new run.
        ending: status with which the run will end, "done" or "interrupted".
    """

    def __init__(
        self,
        config: Settings,
        progress: Progress | None = None,
        resumed_directory: Path | None = None,
    ) -> None:
        """Start to measure the time of an experiment.

        The run directory is created later, at the first access to `run`.

        Args:
            config: settings of the experiment.
            progress: object that displays the progress; None for no display.
            resumed_directory: folder of the run to continue; None for a new run.
        """
        super().__init__()
        self.config = config
        self.progress = progress or NullProgress()
        self.resumed_directory = resumed_directory
        self.ending = "done"
        self._start_time = time.perf_counter()

    @cached_property
    def run(self) -> RunDirectory:
        """The run directory.

        The first access creates it. Check all settings before, so that a wrong one
        leaves no run behind.
        """
        return self.enter_context(
            RunDirectory.open(self.config, self.resumed_directory)
        )

    @cached_property
    def stages(self) -> Stages:
        """The stages of the experiment; their seconds count from the first access."""
        return Stages(self.progress)

    @property
    def has_run(self) -> bool:
        """Whether the run directory has been created through this context."""
        return "run" in vars(self)

    @contextmanager
    def until_interrupted(self) -> Iterator[None]:
        """Let Ctrl-C end the block, but not the experiment.

        The experiment continues after the block, with `ending` set to `INTERRUPTED`.
        """
        try:
            with reraise_lost_interrupt():
                yield
        except KeyboardInterrupt:
            self.ending = INTERRUPTED

    def run_part(self, name: str, config: Config) -> Result:
        """Run an experiment in its own directory within this run, or read its result if
        it has ended.
        """
        return run_part(
            RunDirectory.locate_part(self.run.path, name), config, self.progress
        )

    def open_measurements(self, seconds: float | None = None) -> Measurements:
        """Return the stored measurements of the run, with methods to measure the rest.

        Args:
            seconds: time after which no measurement is started any more; None for no
                limit.
        """
        return Measurements(self, seconds)

    @property
    def machine(self) -> dict[str, Any]:
        """The hardware on which measured times depend: the name of the processor, and
        the number of cores that this process may use.
        """
        return {"cpu": threads.read_processor_name(), "cores": threads.count_cores()}

    def result(self, result_type: type[ResultType], **fields: Any) -> ResultType:
        """Return a result with the passed fields and those that every result has.

        Every result has values of the settings (`SHARED_RESULT_FIELDS`), the path of
        the run, its status, its command line, and its seconds.

        Args:
            result_type: class of the result.
            fields: other fields by name. `seconds` may have the times of stages; the
                total is added if it is not among them.
        """
        shared = self._collect_shared_fields()
        # a total in `fields` replaces this one
        seconds = {
            "total": time.perf_counter() - self._start_time,
            **fields.pop("seconds", {}),
        }
        shared |= {
            "run": str(self.run.path),
            "ending": self.ending,
            "seconds": seconds,
            "command_line": self.config.command_line(self.run.path),
            "python_only": self.config.python_only,
        }
        return result_type(**{**shared, **fields})

    def _collect_shared_fields(self) -> dict[str, Any]:
        """Return those fields of a result that are values of the settings."""
        shared = {
            name: getattr(self.config, attribute)
            for name, attribute in SHARED_RESULT_FIELDS.items()
            if hasattr(self.config, attribute)
        }
        # Results have lists of names; in the settings, objects are a tuple and controls
        # a mapping by name.
        for name in ("objects", "controls"):
            if name in shared:
                shared[name] = list(shared[name])
        return shared


def run_and_save(
    function: Callable[[RunContext[Settings]], AnyResult], context: RunContext[Settings]
) -> AnyResult:
    """Call the function of an experiment, and save its result.

    The result, its page and its figure are written to the directory of the run. If the
    function has not created a run through the context, it has saved the result itself,
    for instance as a file `out`; then nothing is saved here.

    Args:
        function: function of the experiment.
        context: its argument, with the settings.
    """
    with context:
        result = function(context)
        if not context.has_run:
            return result
        images = context.run.path / "images"
        figure_files = render_result_figure(get_view(result))
        for suffix, data in figure_files.items():
            write_bytes(images / f"{context.config.command}.{suffix}", data)
        return write_result(context.run, result)


def run_experiment(
    config: Config,
    *,
    progress: Progress | None = None,
    resumed_directory: Path | None = None,
) -> Result:
    """Run the experiment to which settings belong, and return its result.

    Args:
        config: settings of any experiment; `config.command` names it.
        progress: object that displays the progress; None for no display.
        resumed_directory: folder of the run to continue; None for a new run.

    Raises:
        InputError: a setting is wrong; nothing is written then.
    """
    from advsearch.api.names import check_names  # imports scipy

    # If the caller passed Python objects, settings have names that need not exist.
    if not config.python_only_parts:
        check_names(dict(config))
    with _open_run_folder(config, resumed_directory) as folder:
        experiment: Experiment[Result] = registry.get_experiment(config.command)
        return experiment.run(config, progress=progress, resumed_directory=folder)


def _open_run_folder(
    config: Config, resumed_directory: Path | None
) -> AbstractContextManager[Path | None]:
    """Return a context with the folder in which an experiment continues.

    The folder of a new run is created before slow imports, so that a run that is
    stopped early can be listed. Then the experiment continues in it as in a resumed
    run.

    Args:
        config: settings of the experiment.
        resumed_directory: folder of the run to continue; None for a new run.
    """
    # An experiment with `out` writes a file or folder of its own, and no run.
    creates_run = resumed_directory is None and getattr(config, "out", None) is None
    return create_before_work(config) if creates_run else nullcontext(resumed_directory)


def find_stopped_run(config: Config) -> Path | None:
    """Return the folder of the run that the setting `run` names, to resume it.

    The result is None if the setting is not set, or names no run yet: then a new run is
    started. Whether the run has ended already is checked when it is resumed.
    """
    run, _overwrite = config.run_location
    if run is None or not is_run(locate_run(run)):
        return None
    return locate_run(run)


def run_part(
    folder: Path,
    config: Config,
    progress: Progress,
    run: Callable[..., Result] | None = None,
) -> Result:
    """Return the result of a run that is a part of another run.

    The part is started, or continued if it was stopped; if it has ended, its result is
    read. So a resumed run does not repeat its finished parts.

    Args:
        folder: folder of the part.
        config: settings for a new part. A part that was started has its own settings in
            the folder.
        progress: object that displays the progress.
        run: function that runs an experiment with settings; None for `run_experiment`.
    """
    run = run or run_experiment
    # A folder without stored settings was left by a start that failed.
    is_started = is_run(folder) and (folder / CONFIG).is_file()
    if not is_started:
        config_of_part = config.model_copy(
            update={"run": str(folder), "overwrite": True}
        )
        return run(config_of_part, progress=progress)
    if is_finished(folder):
        return read_result(folder)
    stored_config = type(config).from_yaml(folder / CONFIG, config.session_settings)
    return run(stored_config, progress=progress, resumed_directory=folder)


class PositionalArgument(NamedTuple):
    """A setting that may be written on the command line without its flag."""

    metavar: str  # its placeholder in the help
    expected: str  # completes the error "expected ..." if it is missing
    help_suffix: str = ""  # text that is appended to its help
    is_repeatable: bool = False  # whether several values may be written


def always_succeed(result: Any) -> int:
    return 0


@dataclass(frozen=True)
class Experiment(Generic[AnyResult]):
    """An experiment: its function, its settings and result, and how it is presented.

    Attributes:
        function: ``(context: RunContext[NameConfig]) -> NameResult``.
        settings: class of its settings.
        result: class of its result.
        examples: command lines for its help, without `advsearch`.
        positional_args: settings that the Python function takes by position.
        about: name of the setting that names the subject of the experiment: a run, a
            file or a name; empty if it has no subject.
        positional: how the subject is written on the command line without a flag; None
            if it needs its flag.
        defaults_from_run: ``(run.yaml, typed arguments) -> settings``, which reads
            default settings from the run in `about`.
        python_function: "module:function" for Python callers; empty for the function
            that is made from the settings.
        python_arguments: "module:function" whose keyword-only parameters Python callers
            may pass in addition to settings. They are passed on to `function`. If a
            positional setting is among them, it may be a loaded object.
        resumes_in_python: whether Python callers may continue the run that `run` names,
            with `resume=True`.
        help_suffix: text that its help appends to the line in the catalog.
        exit_status: ``result -> int``, the exit status of the command.
        choices: "module:function" that returns the allowed names of the subject, each
            with a line of help.
        choice_description: "module:function" that returns the description of such a
            name as text and as JSON values, for `advsearch show`.
        view: ``result -> ShownResult``, the contents of terminal, page and notebook;
            None for all fields.
        claims: ``result -> claims`` that a run supports, for `advsearch report`.
        triggering: ``result -> lines``, conditions under which the model is wrong more
            often, for `advsearch report`.
        noted_settings: ``(run, result) -> {kind: {name: settings}}`` of other settings
            that a run has tried, and stored as a note, for `advsearch report`. A kind
            is missing if its note cannot be read.
        page: ``(run, result) -> HTML or None``, for an experiment with a special page.
        other_results: additional classes of results, each by the name of a field that
            no other class has.
    """

    function: Callable[..., AnyResult]
    settings: type[Config]
    result: type[AnyResult]
    examples: tuple[str, ...] = ()
    positional_args: tuple[str, ...] = ()
    about: str = ""
    positional: PositionalArgument | None = None
    defaults_from_run: Callable[[Path, Mapping[str, Any]], dict[str, Any]] | None = None
    python_function: str = ""
    python_arguments: str = ""
    resumes_in_python: bool = False
    help_suffix: str = ""
    exit_status: Callable[[Any], int] = always_succeed
    choices: str = ""
    choice_description: str = ""
    view: Callable[[Any], ShownResult] | None = None
    claims: Callable[[Any], Iterable[Claim]] | None = None
    triggering: Callable[[Any], Iterable[str]] | None = None
    noted_settings: (
        Callable[[Path, Any], Mapping[str, Mapping[str, Mapping[str, Any]]]] | None
    ) = None
    page: Callable[[Path, Any], str | None] | None = None
    other_results: Mapping[str, type[Result]] = field(default_factory=dict)

    def run(
        self,
        config: Any,
        *,
        progress: Progress | None = None,
        resumed_directory: Path | None = None,
        **arguments: Any,
    ) -> AnyResult:
        """Run the experiment with settings, and save its result.

        Args:
            config: settings of the experiment.
            progress: object that displays the progress; None for no display.
            resumed_directory: folder of the run to continue; None for a new run.
            arguments: objects that Python callers passed and that are no settings, such
                as a scene in memory, for the function of the experiment.
        """
        return run_and_save(
            partial(self.function, **arguments),
            RunContext(config, progress, resumed_directory),
        )

    def __call__(self, *args: Any, **settings: Any) -> AnyResult:
        result: AnyResult = self.python(*args, **settings)
        return result

    @cached_property
    def python(self) -> Callable[..., Any]:
        """The function for Python, with every setting as a keyword."""
        if self.python_function:
            function: Callable[..., Any] = registry.load_attribute(self.python_function)
            return function
        return self._make_python_function()

    def _make_python_function(self) -> Callable[..., Any]:
        """Make the function with which Python callers run the experiment.

        Its keywords are the settings. It has the name, the documentation and the
        signature that `help` displays for the experiment.
        """
        # only Python callers need it; imports torch
        from advsearch.api.keywords import with_settings_signature

        object_parameters = self._find_python_arguments()

        def function(
            *args: Any, progress: Any = None, resume: bool = False, **settings: Any
        ) -> AnyResult:
            positional = dict(zip(self.positional_args, args, strict=False))
            return self._run_from_python(
                {**positional, **settings}, object_parameters, progress, resume=resume
            )

        # `with_settings_signature` reads the signature, and adds the other settings.
        signature = self._make_signature(object_parameters)
        function.__signature__ = signature  # type: ignore[attr-defined]
        function.__name__ = self.settings.command
        function.__qualname__ = self.settings.command
        function.__doc__ = self.function.__doc__
        function.__module__ = self.function.__module__
        return with_settings_signature(self.settings)(function)

    def _run_from_python(
        self,
        values: Mapping[str, Any],
        object_names: Collection[str],
        progress: Any,
        *,
        resume: bool,
    ) -> AnyResult:
        """Run the experiment with the arguments of a Python caller.

        Args:
            values: settings, and objects that settings cannot hold, by name.
            object_names: names of arguments that may be such objects.
            progress: the argument `progress`.
            resume: whether to continue the run that `run` names.
        """
        # only Python callers need it; imports torch
        from advsearch.api.keywords import make_config

        config_values = self._select_config_values(values, object_names)
        config = make_config(self.settings, **config_values)
        # Objects that settings cannot hold are passed directly to the experiment's
        # function.
        arguments = {name: values[name] for name in object_names if name in values}
        resumed_directory = find_stopped_run(config) if resume else None
        return self.run(
            config,
            progress=as_progress(progress),
            resumed_directory=resumed_directory,
            **arguments,
        )

    def _select_config_values(
        self, values: Mapping[str, Any], object_names: Collection[str]
    ) -> dict[str, Any]:
        """Return the arguments that the settings hold.

        A positional setting may be an object; its name is still stored in the settings.

        Args:
            values: settings, and objects that settings cannot hold, by name.
            object_names: names of arguments that may be such objects.
        """
        return {
            name: value
            for name, value in values.items()
            if name not in object_names or name in self.positional_args
        }

    def _make_signature(
        self, object_parameters: Mapping[str, inspect.Parameter]
    ) -> inspect.Signature:
        """Return the signature of the function for Python callers.

        It has the settings that may be passed by position, the parameters for objects,
        `resume`, `progress`, and `**settings` for all other settings.

        Args:
            object_parameters: by name, parameters that take objects and are no settings
                (`_find_python_arguments`).
        """
        parameters = [
            self._make_positional_parameter(name) for name in self.positional_args
        ]
        parameters += [
            parameter
            for name, parameter in object_parameters.items()
            if name not in self.positional_args
        ]
        parameters += self._make_keyword_parameters()
        return inspect.Signature(parameters, return_annotation=self.result.__name__)

    def _make_keyword_parameters(self) -> list[inspect.Parameter]:
        """Return the parameters `resume`, if there is one, `progress` and `**settings`."""
        make = inspect.Parameter
        resume = make("resume", make.KEYWORD_ONLY, default=False, annotation="bool")
        progress = make(
            "progress", make.KEYWORD_ONLY, default=None, annotation="ProgressOption"
        )
        settings = make("settings", make.VAR_KEYWORD)
        if not self.resumes_in_python:
            return [progress, settings]
        return [resume, progress, settings]

    def _find_python_arguments(self) -> dict[str, inspect.Parameter]:
        """Return the parameters for objects that only Python callers can pass, by name.

        A setting cannot hold such objects, since it is stored in a file. They are the
        keyword-only parameters of the function that `python_arguments` names.
        """
        if not self.python_arguments:
            return {}
        function = registry.load_attribute(self.python_arguments)
        return {
            name: parameter
            for name, parameter in inspect.signature(function).parameters.items()
            if parameter.kind is parameter.KEYWORD_ONLY
        }

    def _make_positional_parameter(self, name: str) -> inspect.Parameter:
        """Return the parameter of a setting that is passed by position."""
        setting = self.settings.model_fields[name]
        default = inspect.Parameter.empty
        if not setting.is_required():
            default = setting.default
        return inspect.Parameter(
            name,
            inspect.Parameter.POSITIONAL_OR_KEYWORD,
            default=default,
            annotation=PYTHON_TYPES.get(name, "str | Path"),
        )


def experiment(
    *examples: str, **attributes: Any
) -> Callable[[Callable[..., AnyResult]], Experiment[AnyResult]]:
    """Make an `Experiment` of a function ``(context: RunContext[NameConfig]) ->
    NameResult``.

    The classes of its settings and of its result are read from the annotations. If the
    result is a union of classes, the first one is used.

    Args:
        examples: examples for the help: lines of a shell, without `advsearch`.
        attributes: other attributes of `Experiment`.
    """

    def decorate(function: Callable[..., AnyResult]) -> Experiment[AnyResult]:
        hints = get_type_hints(function)
        first_parameter = next(iter(inspect.signature(function).parameters))
        # RunContext[NameConfig] has the class of the settings in brackets
        (settings,) = get_args(hints[first_parameter])
        result = hints["return"]
        union_members = get_args(result)  # empty if it is a single class
        if union_members:
            result = union_members[0]
        return Experiment(function, settings, result, examples, **attributes)

    return decorate
