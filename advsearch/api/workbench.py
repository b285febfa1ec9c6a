"""What experiments load and use: scenes, models, tasks and problems that settings name, attacks, and workers.

`advsearch.extend` offers this module to added experiments. Everything here renders or imports torch, so that the
module of an experiment, which the command line reads for its help, imports it inside functions.
"""

from __future__ import annotations

from advsearch.engine.verifier import Verifier as Verifier
from advsearch.questions.attack.carry_out import LOADING as LOADING
from advsearch.questions.attack.carry_out import problem_from_config as problem_from_config
from advsearch.questions.sweep.predicting import prepare_surface_light as prepare_surface_light
from advsearch.questions.sweep.stored import StoredSweep as StoredSweep
from advsearch.runs.summary import read_configuration as read_configuration
