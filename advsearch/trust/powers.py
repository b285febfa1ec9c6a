"""Settings with power over more than their run: they connect, start many processes, or
write and delete elsewhere.

The threat: run, suite and recipe may be somebody else's, and a setting in one would do
such a thing when it is opened. So each setting is declared with what it does there
(`setting(..., power=...)`), and that is done because a person has typed it, or given it
in Python, never because a file says so.

Used by `settings/configuration.py`, which leaves such settings out of what a file says,
and by what declares them (`config.py`, `questions/`).
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable
from typing import Any, NamedTuple

from advsearch.threads import count_cores

Power = Callable[[Any], str]
"""What a value of a setting does beyond the run, in words that follow its name; empty
where it does nothing there.
"""


def no_power(value: Any) -> str:
    """Return no power: the setting decides only what happens in its run."""
    return ""


def describe_processes(count: int | None) -> str:
    """Return the power of a setting that starts processes, "" for none.

    Up to one process for each processor is none, since a run uses all of them anyway.
    """
    n_processors = count_cores()
    if count is None or count <= n_processors:
        return ""
    return f"starts {count} processes on {n_processors} processors"


def describe_connection(address: str | None) -> str:
    """Return the power of a setting that says where workers are, "" for none."""
    if address in (None, "local"):
        return ""
    return f"connects to {address}, and what answers there can run code here"


def describe_tracker(name: str | None) -> str:
    """Return the power of an experiment tracker, "" for none.

    TensorBoard has none: its files lie in the run.
    """
    return "" if name in (None, "tensorboard") else f"sends every evaluation to {name}"


def describe_location(run: str | None) -> str:
    """Return the power of a setting that says where a run is stored, "" for none.

    A plain name has none: it stands for a folder in runs/.
    """
    is_name = run is None or (os.sep not in run and run not in (".", ".."))
    return "" if is_name else f"writes into {run}, outside of runs/"


def describe_overwrite(wanted: bool) -> str:
    """Of what replaces a run."""
    return "deletes the run that is there" if wanted else ""


def describe_file(path: str | None) -> str:
    """Of a file or folder to write."""
    return "" if path is None else f"writes {path}"


def describe_suite_change(wanted: str | bool | None) -> str:
    """Of what changes what lies beside a suite."""
    return "changes what is kept beside the suite" if wanted else ""


def _format_typed(value: Any) -> Any:
    """Return a value as a person types it: true and false in lower case."""
    return str(value).lower() if isinstance(value, bool) else value


class OmittedSetting(NamedTuple):
    """A setting of a file with power over more than its run: name, field, value, what
    that does, and the default.
    """

    name: str
    field: str
    value: Any
    effect: str
    default: Any

    @property
    def how_to_set(self) -> str:
        """How a person sets it, and how to do without it, as both are typed after the
        name of a file or a run.
        """
        assignment = shlex.quote(f"{self.name}={_format_typed(self.value)}")
        default = "null" if self.default is None else _format_typed(self.default)
        return f"{assignment} if you want that, or {self.name}={default} to do without"
