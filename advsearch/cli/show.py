"""`advsearch show`: what a run found, what a control can vary, or the options of a policy or a task."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from advsearch.cli import output
from advsearch.errors import InputError, UnknownNameError

if TYPE_CHECKING:
    from advsearch.runs.listing import Listed

HELP = "show what a run found, the parameters of a control, or the options of a policy or a task"


def add_parser(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "show",
        usage="advsearch show [--json] RUN | control NAME | policy NAME | task NAME",
        help=HELP,
        description=HELP[0].upper() + HELP[1:] + ".",
    )
    parser.add_argument(
        "what", nargs="+", metavar="WHAT", help="a run's name or folder; or: control NAME, policy NAME, task NAME"
    )
    output.add_flags(parser)


def run(args: argparse.Namespace) -> int:
    """Print the answer of a run, a control's parameters, or the options of a policy or a task."""
    match args.what:
        case ["control", name]:
            return _show_control(name, args.json)
        case ["policy" | "task" as kind, name]:
            return _show_options(kind, name, args.json)
        case [name]:
            return show_run(name, args.json)
    kinds = "control NAME, policy NAME, task NAME"
    raise InputError(f"expected the name of a run, or one of {kinds}, got {' '.join(args.what)!r}")


def show_run(name: str, as_json: bool) -> int:
    """Print the answer of a run, or how far one has come that has none yet."""
    import importlib

    from advsearch.runs.directory import find_run
    from advsearch.runs.listing import described
    from advsearch.runs.summary import NAME, read_result

    path = find_run(name)
    if not (path / NAME).is_file():
        return _show_unfinished(described(path), as_json)
    result = read_result(path)
    answer = importlib.import_module(f"advsearch.cli.{result.command}").answer
    if as_json:
        output.print_json(result)
    else:
        print(answer(result) + output.go_on_text(result))
    return 0


def _show_unfinished(found: Listed, as_json: bool) -> int:
    """Say what a run is, how far it has come and how to go on."""
    go_on = output.go_on_command(found.path) if found.begun and found.state == "stopped" else None
    if as_json:
        output.print_json({"schema": 1, **vars(found), "run": found.path, "ending": None, "resume": go_on})
        return 0
    what = found.command
    if found.object:
        what += f" of {found.object}, {' and '.join(found.controls) or 'nothing searched'}"
    how = {"running": "A process is working on it"}.get(found.state, "It was stopped before its end")
    kept = ", ".join(f"{count} of {kind}" for kind, count in found.kinds.items())
    lines = [f"{found.name}: {what}.", f"{how}; evaluations kept so far: {kept or 'none'}."]
    if go_on is not None:
        lines += ["", f"Go on with: {go_on}"]
    elif found.state == "stopped":
        lines += [
            "",
            "It was stopped before its settings were written, so there is nothing to go on with; start again.",
        ]
    print("\n".join(lines))
    return 0


def _show_control(name: str, as_json: bool) -> int:
    from advsearch.cli.progress import at_work

    with at_work(as_json=True, quiet=False):
        from advsearch.cli.list import first_line
        from advsearch.controls import CONTROLS

    if name not in CONTROLS:
        raise UnknownNameError("control", name, CONTROLS)
    control = CONTROLS[name]
    parameters, choices = ([facts(one) for one in getattr(control, part, ())] for part in ("parameters", "choices"))
    if as_json:
        output.print_json({"schema": 1, "control": name, "parameters": parameters, "choices": choices})
        return 0
    print(f"{name}: {first_line(control)}")
    for heading, declared in (("parameters, searched or fixed", parameters), ("settings, chosen", choices)):
        if declared:
            print(f"\n{heading}:\n{_table([_short(one) for one in declared])}")
    return 0


def _show_options(kind: str, name: str, as_json: bool) -> int:
    from advsearch.cli.progress import at_work

    with at_work(as_json=True, quiet=False):
        from advsearch.attacks import POLICIES
        from advsearch.cli.list import first_line
        from advsearch.options import declared_options, default_of, type_of
        from advsearch.runs.results.base import plain
        from advsearch.tasks import TASKS

    registry: Mapping[str, type[Any]] = POLICIES if kind == "policy" else TASKS
    if name not in registry:
        raise UnknownNameError(kind, name, registry)
    entry = registry[name]
    declared = [
        {"name": option, "type": type_of(one), "default": plain(getattr(default_of(one), "name", default_of(one)))}
        for option, one in declared_options(entry).items()
    ]
    if as_json:
        output.print_json({"schema": 1, kind: name, "options": declared})
        return 0
    print(f"{name}: {first_line(entry)}\n")
    print(
        f"options, as in --{kind} '{name}={{OPTION: VALUE}}':\n{_table(declared)}" if declared else "It has no options."
    )
    return 0


def _short(declared: Mapping[str, Any]) -> dict[str, Any]:
    """What a person wants to read of a parameter, in few columns; a setting as it is."""
    if "run_setting" in declared:
        return _short_choice(declared)
    if "estimators" not in declared:
        return dict(declared)
    one = declared
    count = " x ".join("any" if side is None else str(side) for side in one["shape"])
    ways = "none" if one["options"] else ", ".join(one["estimators"])
    return {
        "name": one["name"],
        "unit": one["unit"] + (f" ({count})" if count else ""),
        "allowed": ", ".join(one["options"]) or f"{one['low']:g} to {one['high']:g}",
        "searched": "if asked" if one["search"] is None else "all" if one["options"] else _range(one),
        "default": one["default"],
        "periodic": one["periodic"],
        "moves outlines": one["moves_silhouettes"],
        "derivative": ways,
        "description": one["description"],
    }


def _short_choice(one: Mapping[str, Any]) -> dict[str, Any]:
    low, high = one["whole"] or (None, None)
    allowed = ", ".join(one["options"]) or (f"{low} to {high}" if one["whole"] else "")
    allowed = allowed or (f"over 0 to {one['most']:g}" if one["most"] else "")
    return {name: allowed if name == "allowed" else one[name] for name in ("name", "allowed", "default", "description")}


def _range(one: Mapping[str, Any]) -> str:
    low, high = one["search"]
    return f"{low:g} to {high:g}" + (", log" if one["log"] else "")


def facts(parameter: Any) -> dict[str, Any]:
    """Return what a control declares of one of its parameters as JSON values.

    Args:
        parameter: a dataclass or a mapping.
    """
    from advsearch.runs.results.base import plain

    return dict(plain(parameter))


def _table(declared: Sequence[Mapping[str, Any]]) -> str:
    """Return what was declared as a table, the description last."""
    heads = sorted(dict.fromkeys(head for one in declared for head in one), key="description".__eq__)
    rows = [[_cell(one.get(head)) for head in heads] for one in declared]
    return output.columns([[head.replace("_", " ") for head in heads], *rows])


def _cell(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return "[" + ", ".join("any" if one is None else _cell(one) for one in value) + "]"
    return "" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
