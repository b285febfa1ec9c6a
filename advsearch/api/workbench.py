"""What experiments load and use: scenes, models, tasks and problems that settings name, attacks, and workers.

`advsearch.extend` offers this module to added experiments. Everything here renders or imports torch, so that the
module of an experiment, which the command line reads for its help, imports it inside functions.
"""

from __future__ import annotations

from advsearch.questions.sweep.stored import StoredSweep as StoredSweep
