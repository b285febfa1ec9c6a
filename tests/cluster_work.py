"""Work for workers that takes no time to load; they import it by its name."""

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

from advsearch.files import JsonObject


def squares(settings: JsonObject) -> Callable[[range], list[int]]:
    """Return what squares numbers.

    Args:
        settings: `deadly`: numbers at which the worker is killed; `seconds` that a number takes; `file` to read;
            whether it `prints`.
    """
    deadly, seconds = settings.get("deadly", []), settings.get("seconds", 0.0)
    added = int(Path(str(settings["file"])).read_text()) if "file" in settings else 0

    def call(numbers: range) -> list[int]:
        assert isinstance(deadly, list) and isinstance(seconds, float)
        if any(number in deadly for number in numbers):
            os.kill(os.getpid(), signal.SIGKILL)
        if settings.get("prints"):
            print("printed", flush=True)
        time.sleep(seconds * len(numbers))
        return [number * number + added for number in numbers]

    return call
