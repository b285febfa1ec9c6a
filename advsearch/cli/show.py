"""The commands `advsearch show`, `advsearch list` and `advsearch labels`.

`show` prints the result of a run, the parameters of a control, the options of a policy
or a task, or a recipe.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from advsearch.catalog import is_module_installed
from advsearch.cli import output
from advsearch.cli.flags import add_settings
from advsearch.cli.main import argument, command
from advsearch.cli.output import get_raw_stream, open_answer_progress
from advsearch.errors import InputError, UnknownNameError
from advsearch.files import JsonValue
from advsearch.options import get_option_default, get_option_type, list_declared_options
from advsearch.registry import (
    EXPERIMENTS,
    Registry,
    get_experiment,
    get_first_doc_line,
    load_attribute,
)
from advsearch.report.wording import format_count, format_interval
from advsearch.runs.directory import IMAGES, PHOTOGRAPHS, find_run
from advsearch.runs.listing import ListedRun, read_listed_run
from advsearch.runs.results import Result, to_json_value
from advsearch.runs.summary import NAME, read_result
from advsearch.trust.code import allow_code_in_settings

if TYPE_CHECKING:
    from advsearch.controls import Choice, Parameter


def _set_usage(parser: argparse.ArgumentParser) -> None:
    parser.usage = (
        "advsearch show [--json] RUN [--picture] | control NAME | policy "
        "NAME | task NAME | recipe NAME"
    )


@command(
    _set_usage,
    argument(
        "what",
        nargs="+",
        metavar="WHAT",
        help="a run's name or folder; or: control NAME, policy NAME, task NAME, recipe "
        "NAME",
    ),
    argument(
        "--picture",
        action="store_true",
        help="draw the pictures of the run in the terminal, if it supports images",
    ),
    output.add_json_flag,
)
def show(args: argparse.Namespace) -> int:
    """Print a run, or a control, policy, task or recipe, which is given by its kind and
    name.

    Returns:
        The exit status.

    Raises:
        InputError: the words name none of these.
    """
    _check_picture_flag(args)
    match args.what:
        case ["control" | "policy" | "task" as kind, name]:
            return _show_declared(kind, name, args.json)
        # An experiment with a list of named choices, such as "recipe NAME".
        case [command, name] if _find_choice_description(command) is not None:
            return _show_choice(command, name, args.json)
        case [name]:
            return _show_named_run(name, args)
    kinds = "control NAME, policy NAME, task NAME, recipe NAME"
    raise InputError(
        f"expected the name of a run, or one of {kinds}, got {' '.join(args.what)!r}"
    )


def _check_picture_flag(args: argparse.Namespace) -> None:
    """Check that `--picture` is given for the text of one run only.

    Raises:
        InputError: it is given with `--json`, or for something else.
    """
    if args.picture and (args.json or len(args.what) > 1):
        raise InputError(
            "--picture: draws the pictures of one run, after its text; "
            "give one run, and leave --json out"
        )


def _show_choice(command: str, name: str, as_json: bool) -> int:
    """Print the description of a choice of an experiment, such as a recipe.

    Args:
        command: command of the experiment.
        name: name of the choice.
        as_json: print it as JSON.
    """
    describe_choice = load_attribute(_find_choice_description(command))
    text, facts = describe_choice(name)
    return output.print_answer(as_json, {command: name, **facts}, text)


def _show_named_run(name: str, args: argparse.Namespace) -> int:
    """Print a run as the flags say.

    Raises:
        InputError: there is no such run.
    """
    try:
        return show_run(name, args.json, picture=args.picture)
    except UnknownNameError as error:
        raise InputError(
            f"{error} For anything but a run, put its kind before the name, as "
            "in: advsearch show control pose"
        ) from None


def _find_choice_description(command: str) -> Any:
    """Return where the function is that describes a choice of an experiment.

    The choices of `recipe` are recipes. None if there is no such experiment, or its
    choices have no description.
    """
    if command not in EXPERIMENTS:
        return None
    return get_experiment(command).choice_description or None


def show_run(name: str, as_json: bool, *, picture: bool = False) -> int:
    """Print the result of a run, or how far it has come if it has none yet.

    Args:
        name: name of the run, or its path.
        as_json: print it as JSON.
        picture: draw its pictures in the terminal, too.

    Returns:
        The exit status.
    """
    path = find_run(name)
    has_result = (path / NAME).is_file()
    if not has_result:
        return _show_unfinished(read_listed_run(path), as_json)
    result = read_result(path)
    photos = find_photographs(path)
    if as_json:
        _print_result_as_json(result, photos)
    else:
        print(output.format_result(result) + output.explain_resume(result))
        if photos and photos.interval is not None:
            _print_agreement(photos)
    if picture:
        show_pictures(find_best_images(path))
    return 0


def _print_result_as_json(result: Result, photos: Any) -> None:
    """Print a result as JSON, with its photographs' agreement if it has any."""
    if photos:
        output.print_json({**result.to_dict(), "photos": photos.to_dict()})
    else:
        output.print_json(result)


def find_photographs(run: Path) -> Any:
    """Return how photographs agree with the run's renderings
    (`advsearch.photo_agreement`); None where it has none.
    """
    if not (run / PHOTOGRAPHS).is_dir():
        return None
    from advsearch import photo_agreement  # takes seconds

    return photo_agreement(run)


def _print_agreement(photos: Any) -> None:
    """Print how often renderings and photographs agree: a sentence and a table.

    Args:
        photos: counts of pairs of a rendering and a photograph: `right_wrong` is the
            number of those whose rendering is predicted right and whose photograph is
            predicted wrong, and so on.
    """
    agreeing = photos.right_right + photos.wrong_wrong
    total = format_count(photos.photos, "photograph")
    interval_text = f"95 % interval {format_interval(photos.interval)}"
    table = [
        ["", "photograph right", "photograph wrong"],
        ["rendering right", str(photos.right_right), str(photos.right_wrong)],
        ["rendering wrong", str(photos.wrong_right), str(photos.wrong_wrong)],
    ]
    print(
        f"\nRenderings and reality agree in {agreeing} of {total}, "
        f"{interval_text}:\n{output.align_columns(table)}"
    )


def _show_unfinished(run: ListedRun, as_json: bool) -> int:
    """Show a run without a result: how far it is, and how it can be resumed.

    Args:
        run: its entry in the list of runs.
        as_json: print JSON instead of text.

    Returns:
        The exit status.
    """
    is_stopped = run.state == "stopped"
    resume_command = None
    if run.started and is_stopped:
        resume_command = output.make_resume_command(run.path)
    lines = _describe_progress(run)
    if resume_command is not None:
        lines += ["", f"Go on with: {resume_command}"]
    elif is_stopped:
        lines += ["", "It has no run.yaml, so it can't be resumed; start again."]
    facts = {**vars(run), "run": run.path, "ending": None, "resume": resume_command}
    return output.print_answer(as_json, facts, "\n".join(lines))


def _describe_progress(run: ListedRun) -> list[str]:
    """Return lines with the subject of an unfinished run and its evaluations so far."""
    subject = run.command
    if run.object:
        searched = " and ".join(run.controls) or "nothing searched"
        subject += f" of {run.object}, {searched}"
    state_text = "It was stopped before its end"
    if run.state == "running":
        state_text = "A process is working on it"
    row_counts = ", ".join(f"{number} of {kind}" for kind, number in run.kinds.items())
    return [
        f"{run.name}: {subject}.",
        f"{state_text}; evaluations kept so far: {row_counts or 'none'}.",
    ]


PLURALS = {"control": "controls", "policy": "policies", "task": "tasks"}


def _show_declared(kind: str, name: str, as_json: bool) -> int:
    """Show the parameters and options of a control, policy or task.

    Args:
        kind: "control", "policy" or "task".
        name: its name.
        as_json: print JSON instead of text.

    Returns:
        The exit status.
    """
    entry = _find_declared(kind, name)
    if kind == "control":
        facts, paragraphs = _describe_control(name, entry)
    else:
        facts, paragraphs = _describe_options(kind, name, entry)
    text = "\n\n".join([f"{name}: {get_first_doc_line(entry)}", *paragraphs])
    return output.print_answer(as_json, {kind: name, **facts}, text)


def _find_declared(kind: str, name: str) -> Any:
    """Return the class of a control, policy or task.

    Raises:
        UnknownNameError: there is none of this name.
    """
    with open_answer_progress():
        registry = _registry(PLURALS[kind])  # takes seconds
    # A control may be named as "module:name". This code may run, since a person typed it.
    if kind == "control":
        allow_code_in_settings({"controls": name})
    if name not in registry:
        raise UnknownNameError(kind, name, registry)
    return registry[name]


def _describe_control(name: str, control: Any) -> tuple[dict[str, Any], list[str]]:
    """Return the parameters and choices of a kind of control.

    Args:
        name: name of the kind.
        control: its class.

    Returns:
        The same facts twice: for JSON, and as paragraphs of text.
    """
    facts = {
        "parameters": to_json_value(control.parameters),
        "choices": to_json_value(control.choices),
    }
    paragraphs = [_describe_parameters(name, control.parameters)]
    if control.choices:
        choice_table = _format_table(list(map(_make_choice_row, control.choices)))
        paragraphs.append(f"settings, chosen:\n{choice_table}")
    return facts, paragraphs


def _describe_parameters(name: str, parameters: Sequence[Parameter]) -> str:
    """Return a table of the parameters of a kind of control, as a paragraph.

    A kind without parameters has those that the scene names.
    """
    if not parameters:
        return f"The scene names its parameters: --control {name}:KEY=[low, high]"
    table = _format_table(list(map(_make_parameter_row, parameters)))
    return f"parameters, searched or fixed:\n{table}"


def _describe_options(
    kind: str, name: str, entry: Any
) -> tuple[dict[str, Any], list[str]]:
    """Return the options of a policy or task, for JSON and as a paragraph.

    Args:
        kind: "policy" or "task".
        name: its name.
        entry: its class.
    """
    options = _list_options_of_class(entry)
    if not options:
        return {"options": options}, ["It has no options."]
    rows = [
        {**option, "default": _format_cell(option["default"])} for option in options
    ]
    heading = f"options, as in --{kind} '{name}={{OPTION: VALUE}}':"
    return {"options": options}, [f"{heading}\n{_format_table(rows)}"]


def _list_options_of_class(entry: Any) -> list[dict[str, Any]]:
    """Return name, type and default of each option of a policy's or task's class."""
    options = list[dict[str, Any]]()
    for option, field in list_declared_options(entry).items():
        default = get_option_default(field)
        # an object, such as another task, is represented by its name
        default = to_json_value(getattr(default, "name", default))
        options.append(
            {"name": option, "type": get_option_type(field), "default": default}
        )
    return options


def _make_parameter_row(parameter: Parameter) -> dict[str, str]:
    """Return the row of a parameter in the table of its control, by column."""
    return {
        "name": parameter.name,
        "unit": _format_unit(parameter),
        "allowed": _format_allowed(parameter),
        "searched": _format_searched(parameter),
        "default": _format_cell(parameter.default),
        "periodic": _format_cell(parameter.periodic),
        "moves outlines": _format_cell(parameter.moves_silhouettes),
        "derivative": "none" if parameter.options else ", ".join(parameter.estimators),
        "description": parameter.description,
    }


def _format_unit(parameter: Parameter) -> str:
    """Return the unit of a parameter, and its shape if it is no single number."""
    if not parameter.shape:
        return parameter.unit
    # such as "(any x 3)"
    sides = ["any" if side is None else str(side) for side in parameter.shape]
    return f"{parameter.unit} ({' x '.join(sides)})"


def _format_allowed(parameter: Parameter) -> str:
    """Return the values that a parameter may have: its options, or else its range."""
    options = ", ".join(parameter.options)
    return options or f"{parameter.low:g} to {parameter.high:g}"


def _format_searched(parameter: Parameter) -> str:
    """Return the range of a parameter that a search covers."""
    if parameter.search is None:
        return "if asked"
    if parameter.options:
        return "all"
    low, high = parameter.search
    return f"{low:g} to {high:g}" + (", log" if parameter.log else "")


def _make_choice_row(choice: Choice) -> dict[str, str]:
    """Return the row of a table for a setting of a control, with its allowed values."""
    return {
        "name": choice.name,
        "allowed": _format_allowed_choices(choice),
        "default": _format_cell(choice.default),
        "description": choice.description,
    }


def _format_allowed_choices(choice: Choice) -> str:
    """Return the values that a setting of a control may have."""
    if choice.integer_bounds:
        lower, upper = choice.integer_bounds
        return f"{lower} to {upper}"
    if choice.max_value and choice.signed:
        return f"{-choice.max_value:g} to {choice.max_value:g}"
    if choice.max_value:
        return f"over 0 to {choice.max_value:g}"
    # a name, or anything if there are no options
    return ", ".join(choice.options)


def _format_table(rows: Sequence[Mapping[str, str]]) -> str:
    return output.align_columns([list(rows[0]), *(list(row.values()) for row in rows)])


def _format_cell(value: JsonValue) -> str:
    """Return a value as the text of a cell; None is empty."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)


HEIGHT = 16  # height of a picture in lines of the terminal
EXTRA = "pip install 'advsearch[terminal]'"

# Pictures of an attack that are drawn. Of another run, the first picture is drawn.
FIRST = ("clean", "adversarial")


def find_best_images(run: Path) -> list[Path]:
    """Return the most informative pictures of a run; empty if it has none."""
    folder = run / IMAGES
    files = [folder / f"{name}.png" for name in FIRST]
    if not all(file.is_file() for file in files):
        files = sorted(folder.glob("*.png"))[:1]
    return files


def show_pictures(files: Sequence[Path]) -> None:
    """Draw pictures in the terminal if it can, and print the path of each.

    Args:
        files: files of the pictures.
    """
    if not files:
        print("\nThis run has no pictures.")
        return
    # the function that draws, or why there is none
    draw, refusal = _find_drawing_function()
    print()
    for file in files:
        if draw is not None:
            failure = _try_to_draw(draw, file)
            if failure:
                draw = None
                refusal = failure
        print(f"  picture   {file}")
    if refusal:
        print(f"\n{refusal}")


def _try_to_draw(draw: Callable[[Path], None], file: Path) -> str:
    """Draw a picture in the terminal; return why it failed, or "" if it did not."""
    try:
        draw(file)
    # whatever a terminal answers, the paths of the pictures are printed
    except Exception as error:
        return f"The pictures could not be drawn here: {type(error).__name__}: {error}"
    return ""


def _find_drawing_function() -> tuple[Callable[[Path], None] | None, str]:
    """Find the function that draws a picture in this terminal.

    Returns:
        The function, which takes the path of a picture; None if nothing can be drawn.
        And a sentence with the reason, which may be empty.
    """
    if not sys.stdout.isatty():  # nobody expects pictures in a file
        return None, ""
    try:
        from textual_image import renderable  # asks the terminal when it is imported
    except ImportError:
        return None, f"Terminals with kitty's protocol or Sixel draw them here: {EXTRA}"
    if renderable.Image not in (renderable.SixelImage, renderable.TGPImage):
        return None, (
            "This terminal draws no pictures: it has neither kitty's "
            "protocol "
            "nor Sixel."
        )
    from rich.console import Console  # only where pictures are drawn

    console = Console(file=get_raw_stream(sys.stdout))
    return lambda file: console.print(renderable.Image(file, height=HEIGHT)), ""


# ---- names
# --------------------------------------------------------------------------------


CASES = "cases"  # names of the cases of `stability`, which "list all" leaves out

_EVERY = {
    "objects": "advsearch.scene.library:list_objects",
    "environments": "advsearch.scene.library:list_environments",
    "controls": "advsearch.controls:CONTROLS",
    "policies": "advsearch.attacks:POLICIES",
    "tasks": "advsearch.tasks:TASKS",
    "objectives": "advsearch.attacks.objectives:objective_summaries",
    "models": "advsearch.cli.show:MODELS",
    "recipes": "advsearch.questions.recipe.description:titles",
    CASES: "advsearch.questions.stability.scenes:sentences",
}
REGISTRIES = {
    kind: target
    for kind, target in _EVERY.items()
    if is_module_installed(target.partition(":")[0])
}
"""The "module:attribute" with the names of each kind: a mapping with the names as keys,
or a function that returns one.
"""

MODELS = {
    "reference": "the bundled classifier of household objects; models of your "
    "own are given as files"
}


def list_names(kind: str) -> dict[str, str]:
    """Return the names of one kind, each with a line of help, which may be empty."""
    entries = _registry(kind)
    if isinstance(entries, Registry):
        return {name: entries.get_help(name) for name in entries}
    if isinstance(entries, Mapping):
        return {str(name): get_first_doc_line(entry) for name, entry in entries.items()}
    return {str(name): "" for name in entries}


def _registry(kind: str) -> Any:
    registry = load_attribute(REGISTRIES[kind])
    return registry() if callable(registry) else registry


@command(
    argument(
        "kind",
        nargs="?",
        default="all",
        choices=[*REGISTRIES, "all"],
        help="default: all",
    ),
    output.add_json_flag,
)
def list_all(args: argparse.Namespace) -> int:
    """Print the names of one kind, such as objects, or of all kinds.

    Returns:
        The exit status.
    """
    kinds = [args.kind]
    if args.kind == "all":
        # cases are listed only by their own kind
        kinds = [kind for kind in REGISTRIES if kind != CASES]
    with open_answer_progress():
        names = {kind: list_names(kind) for kind in kinds}
    text = _format_names_of_kinds(names, with_headings=args.kind == "all")
    facts = {kind: list(entries) for kind, entries in names.items()}
    return output.print_answer(args.json, facts, text)


def _format_names_of_kinds(
    names: Mapping[str, Mapping[str, str]], *, with_headings: bool
) -> str:
    """Return a table of names for each kind as text.

    Args:
        names: names of each kind, with a description of each.
        with_headings: whether each table has its kind as a heading.
    """
    tables = {
        kind: output.align_columns([*entries.items()])
        for kind, entries in names.items()
    }
    if with_headings:
        return "\n\n".join(f"{kind}:\n{table}" for kind, table in tables.items())
    return "\n\n".join(tables.values())


@command(
    argument(
        "word",
        metavar="WORD",
        nargs="?",
        help="word that the names should resemble; without it, all names",
    ),
    partial(add_settings, only=("model", "labels")),
    output.add_json_flag,
    more=". With --labels the model itself is not loaded. What stands for no thing, "
    "such as background, is left out",
    examples=(
        "labels",
        "labels mug --labels labels.json",
        "labels mug --model model.pt2 --labels labels.json --json",
    ),
)
def labels(args: argparse.Namespace) -> int:
    """Print index and name of the classes that are like a word, the most similar first.

    Raises:
        InputError: no class is like the word, or the classes of the model have no
            names.
    """
    with open_answer_progress():
        names = _load_labels(args)
        classes = _select_labels(names, args.word)
    if not classes:
        raise InputError(
            f"none of the {len(names)} labels is like {args.word!r}; "
            "leave the word out to see all"
        )
    entries = [{"index": index, "label": name} for index, name in classes.items()]
    rows = [[f"#{index}", name] for index, name in classes.items()]
    facts = {"command": "labels", "word": args.word, "labels": entries}
    return output.print_answer(args.json, facts, output.align_columns(rows))


def _load_labels(args: argparse.Namespace) -> Sequence[str]:
    """Return the class names in the file of ``--labels``, or else those of the model.

    Raises:
        InputError: the model has no names for its classes.
    """
    # late, so that --help answers at once
    from advsearch.models import load_model, read_labels

    if "labels" in args and args.labels is not None:
        return read_labels(args.labels)
    model = getattr(args, "model", "reference")
    allow_code_in_settings({"model": model})
    loaded = load_model(model)
    if not loaded.named:
        problem = f"model {loaded.name} has {loaded.classes} classes without names"
        raise InputError(f"{problem}; give a file with `labels`")
    return loaded.labels


def _select_labels(names: Sequence[str], word: str | None) -> dict[int, str]:
    """Return the class names that are like a word by their index, the best first.

    Names of no thing, such as a background, are left out unless the word is one.

    Args:
        names: all class names.
        word: word that the names should resemble; None for all.
    """
    # late, so that --help answers at once
    from advsearch.models.labels import find_similar_labels, is_nothing_name

    indices: Iterable[int] = range(len(names))
    if word is not None:
        indices = [index for index, _ in find_similar_labels(word, names)]
    is_nothing_requested = word is not None and is_nothing_name(word)
    return {
        index: names[index]
        for index in indices
        if is_nothing_requested or not is_nothing_name(names[index])
    }
