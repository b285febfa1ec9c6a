"""What experiments load and use: scenes, models, tasks and problems that settings name, attacks, and workers.

`advsearch.extend` offers this module to added experiments. Everything here renders or imports torch, so that the
module of an experiment, which the command line reads for its help, imports it inside functions.
"""

from __future__ import annotations

from advsearch.attacks.verification import WORST_CASE as WORST_CASE
from advsearch.cluster import InProcess as InProcess
from advsearch.controls import CONTROLS as CONTROLS
from advsearch.engine.journal import check_made_of as check_made_of
from advsearch.engine.loading import Scene as Scene
from advsearch.engine.loading import load_scene as load_scene
from advsearch.engine.naming import check_run_settings as check_run_settings
from advsearch.engine.naming import load_models as load_models
from advsearch.engine.naming import scene_settings as scene_settings
from advsearch.engine.naming import settings_alone as settings_alone
from advsearch.pictures import upright as upright
from advsearch.progress import NullProgress as NullProgress
from advsearch.questions.attack.carry_out import LOADING as LOADING
from advsearch.questions.attack.carry_out import attack_on as attack_on
from advsearch.questions.attack.carry_out import check_from_config as check_from_config
from advsearch.questions.attack.carry_out import executor_for as executor_for
from advsearch.questions.attack.carry_out import problem_of as problem_of
from advsearch.questions.photographs.carry_out import Photographs as Photographs
from advsearch.questions.photographs.carry_out import photographs_in as photographs_in
from advsearch.questions.photographs.result import LOOSE_PHOTO as LOOSE_PHOTO
from advsearch.questions.photographs.result import PHOTO as PHOTO
from advsearch.questions.sweep.carry_out import row_parameters as row_parameters
from advsearch.questions.sweep.display import surface_sentences as surface_sentences
from advsearch.runs.tables import units_of as units_of
from advsearch.tasks import make_task as make_task
from advsearch.threads import all_for_torch as all_for_torch
from advsearch.threads import cores as cores
