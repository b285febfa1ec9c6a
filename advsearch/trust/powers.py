"""Describe the power of settings: effects on more than their run.

Such settings connect to other machines, start many processes, or write or delete other
files. The threat: a run, a suite or a recipe may be somebody else's, and such a setting
in it would have its effect when the file is opened. So each such setting is declared
with a description of its effect (`setting(..., power=...)`). The effect happens only if
the user has set it on the command line or in Python, and never because a file has it.

Used by `settings/configuration.py`, which ignores such settings in a file, and by the
modules that declare them (`config.py`, `questions/`).
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable
from typing import Any, NamedTuple

from advsearch.threads import count_cores

Power = Callable[[Any], str]
"""Describes the effect of a setting's value outside of the run, in words that follow
its name. "" if the value has no such effect.
"""


def no_power(value: Any) -> str:
    """Return "": the setting has no effect outside of its run."""
    return ""


def describe_processes(count: int | None) -> str:
    """Describe the effect of starting processes, on more than the run itself.

    The result is "" for up to one process per processor, since a run uses all
    processors anyway.

    Args:
        count: number of processes; None if it is not set.
    """
    n_processors = count_cores()
    if count is None or count <= n_processors:
        return ""
    return f"starts {count} processes on {n_processors} processors"


def describe_connection(address: str | None) -> str:
    """Describe the effect of connecting to workers; "" if they are on this machine."""
    if address in (None, "local"):
        return ""
    return f"connects to {address}, and what answers there can run code here"


def describe_tracker(name: str | None) -> str:
    """Describe the effect of an experiment tracker.

    "" for TensorBoard, whose files are in the run.
    """
    return "" if name in (None, "tensorboard") else f"sends every evaluation to {name}"


def describe_location(run: str | None) -> str:
    """Describe the effect of the location of a run.

    "" for a plain name, which stands for a folder in runs/.
    """
    is_name = run is None or (os.sep not in run and run not in (".", ".."))
    return "" if is_name else f"writes into {run}, outside of runs/"


def describe_overwrite(wanted: bool) -> str:
    """Describe the effect of a setting that replaces a run."""
    return "deletes the run that is there" if wanted else ""


def describe_file(path: str | None) -> str:
    """Describe the effect of a setting that writes a file or a folder."""
    return "" if path is None else f"writes {path}"


def describe_suite_change(wanted: str | bool | None) -> str:
    """Describe the effect of a setting that changes files next to a suite."""
    return "changes what is kept beside the suite" if wanted else ""


def _format_typed(value: Any) -> Any:
    """Return a value as users type it: true and false in lower case."""
    return str(value).lower() if isinstance(value, bool) else value


class OmittedSetting(NamedTuple):
    """A setting in a file that is ignored, because it affects more than its run.

    Attributes:
        name: name of the setting.
        field: its field in the class of settings.
        value: value in the file.
        effect: description of the effect.
        default: default of the setting, which is used instead.
    """

    name: str
    field: str
    value: Any
    effect: str
    default: Any

    @property
    def advice(self) -> str:
        """How the user sets the value of the file, and how to use the default instead.

        An example is "overwrite=true if you want that, or overwrite=false to do
        without". Both assignments can be typed on the command line, after the name of a
        file or a run.
        """
        # The value is from a file, and may be anything: it is quoted for the shell.
        assignment = shlex.quote(f"{self.name}={_format_typed(self.value)}")
        default = "null" if self.default is None else _format_typed(self.default)
        return f"{assignment} if you want that, or {self.name}={default} to do without"
