"""What experiments load and use: scenes, models, tasks and problems that settings name,
attacks, and workers.

    from advsearch.extend import workbench

    # Load what the settings of an attack name.
    parts = workbench.parts_of(config)
    # Renders and judges a configuration.
    problem = workbench.problem_on(parts, differentiated=False)
    # Stores each evaluation, and reads it back.
    journal = workbench.Journal(run, workbench.Shared(problem))
    query = workbench.Query(u, seed, "trial", 0, spp=16)
    (evaluation,) = journal.evaluate_all([query])

`advsearch.extend` offers this module to added experiments. Everything here renders or
imports torch, so that the module of an experiment, which the command line reads for its
help, imports it inside functions.
"""

from __future__ import annotations

from typing import Any

from advsearch.api.keywords import asks as asks
from advsearch.api.keywords import configured as configured
from advsearch.attacks import Query as Query
from advsearch.attacks import SearchResult as SearchResult
from advsearch.attacks import make_policy as make_policy
from advsearch.attacks import search as search
from advsearch.attacks.verification import LEAST_RATE as LEAST_RATE
from advsearch.attacks.verification import OVER_CONDITIONS as OVER_CONDITIONS
from advsearch.attacks.verification import WORST_CASE as WORST_CASE
from advsearch.calls import helped as helped
from advsearch.cluster import InProcess as InProcess
from advsearch.config import DEFAULT_ENVIRONMENT as DEFAULT_ENVIRONMENT
from advsearch.controls import CONTROLS as CONTROLS
from advsearch.engine import loading as loading
from advsearch.engine.image_changes import AWAY as AWAY
from advsearch.engine.image_changes import as_claimed as as_claimed
from advsearch.engine.image_changes import changed as changed
from advsearch.engine.journal import Journal as Journal
from advsearch.engine.journal import Shared as Shared
from advsearch.engine.journal import check_made_of as check_made_of
from advsearch.engine.journal import worker_call as worker_call
from advsearch.engine.judging import domain_of as domain_of
from advsearch.engine.judging import judgements as judgements
from advsearch.engine.loading import Scene as Scene
from advsearch.engine.loading import load_scene as load_scene
from advsearch.engine.naming import AnyModel as AnyModel
from advsearch.engine.naming import check_run_settings as check_run_settings
from advsearch.engine.naming import exists_here as exists_here
from advsearch.engine.naming import in_turn as in_turn
from advsearch.engine.naming import load_models as load_models
from advsearch.engine.naming import model_name as model_name
from advsearch.engine.naming import scene_settings as scene_settings
from advsearch.engine.naming import settings_alone as settings_alone
from advsearch.engine.record import control_group as control_group
from advsearch.engine.record import judged as judged
from advsearch.engine.record import verified_rate as verified_rate
from advsearch.engine.verifier import RetrialCondition as RetrialCondition
from advsearch.engine.verifier import Retrials as Retrials
from advsearch.engine.verifier import Verifier as Verifier
from advsearch.engine.verifier import kept_configuration as kept_configuration
from advsearch.engine.verifier import ladder_of as ladder_of
from advsearch.options import FROM_RUN as FROM_RUN
from advsearch.options import Value as Value
from advsearch.options import count_outcomes as count_outcomes
from advsearch.pictures import upright as upright
from advsearch.progress import NullProgress as NullProgress
from advsearch.progress import Watched as Watched
from advsearch.progress import watcher as watcher
from advsearch.questions.attack.carry_out import LOADING as LOADING
from advsearch.questions.attack.carry_out import ROLES_IN_SEARCH as ROLES_IN_SEARCH
from advsearch.questions.attack.carry_out import AttackParts as AttackParts
from advsearch.questions.attack.carry_out import check_from_config as check_from_config
from advsearch.questions.attack.carry_out import executor_for as executor_for
from advsearch.questions.attack.carry_out import judged_alone as judged_alone
from advsearch.questions.attack.carry_out import parts_in as parts_in
from advsearch.questions.attack.carry_out import parts_of as parts_of
from advsearch.questions.attack.carry_out import (
    problem_from_config as problem_from_config,
)
from advsearch.questions.attack.carry_out import problem_of as problem_of
from advsearch.questions.attack.carry_out import problem_of_parts as problem_of_parts
from advsearch.questions.attack.carry_out import problem_on as problem_on
from advsearch.questions.attack.result import AttackResult as AttackResult
from advsearch.questions.attack.run import attack_on as attack_on
from advsearch.questions.attack.summary import AttackSummary as AttackSummary
from advsearch.questions.attack.summary import attack_of as attack_of
from advsearch.questions.sweep.carry_out import row_parameters as row_parameters
from advsearch.questions.sweep.carry_out import scenes_of as scenes_of
from advsearch.questions.sweep.display import surface_sentences as surface_sentences
from advsearch.questions.sweep.predicting import (
    prepare_surface_light as prepare_surface_light,
)
from advsearch.questions.sweep.stored import StoredSweep as StoredSweep
from advsearch.questions.sweep.summary import SweepSummary as SweepSummary
from advsearch.registry import get_experiment as get_experiment
from advsearch.registry import imported
from advsearch.runs.results import AxisValue as AxisValue
from advsearch.runs.store import Row as Row
from advsearch.runs.summary import read_configuration as read_configuration
from advsearch.runs.tables import units_of as units_of
from advsearch.scene import library as library
from advsearch.scene.assembly import posed as posed
from advsearch.scene.glb import glb as glb
from advsearch.scene.grounds import paved as paved
from advsearch.scene.importing.files import last_line as last_line
from advsearch.scene.parts import PluginPart as PluginPart
from advsearch.scene.parts import sphere as sphere
from advsearch.scene.renderer import MAX_SPP as MAX_SPP
from advsearch.settings import PythonOnly as PythonOnly
from advsearch.tasks import AnyTask as AnyTask
from advsearch.tasks import make_task as make_task
from advsearch.tasks.base import Truth as Truth
from advsearch.tasks.together import Together as Together
from advsearch.threads import all_for_torch as all_for_torch
from advsearch.threads import cores as cores
from advsearch.trust.code import allow_named as allow_named
from advsearch.trust.programs import find_blender as find_blender
from advsearch.trust.programs import surroundings as surroundings


def load_photographs() -> Any:
    """Return what takes photographs of the real thing in for runs, and counts how they
    agree with the renderings.

    It has `list_files(folder, task)`, `add_files(run, files)` and `agreement(run)`
    (`advsearch.photo_agreement`).
    """
    return imported("advsearch.questions.photographs.carry_out:Photographs")()
