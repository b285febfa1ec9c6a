"""What experiments load and use: scenes, models, tasks and problems that settings name,
attacks, and workers.

    from advsearch.extend import workbench

    # Load what the settings of an attack name.
    parts = workbench.load_parts(config)
    # Renders and judges a configuration.
    problem = workbench.make_problem(parts, differentiated=False)
    # Stores each evaluation, and reads it back.
    journal = workbench.Journal(run, workbench.ParallelEvaluator(problem))
    query = workbench.Query(u, seed, "trial", 0, spp=16)
    (evaluation,) = journal.evaluate_all([query])

`advsearch.extend` offers this module to added experiments. Everything here renders or
imports torch, so that the module of an experiment, which the command line reads for its
help, imports it inside functions.
"""

from __future__ import annotations

from typing import Any

from advsearch.api.keywords import make_config as make_config
from advsearch.api.keywords import with_settings_signature as with_settings_signature
from advsearch.attacks import Query as Query
from advsearch.attacks import SearchResult as SearchResult
from advsearch.attacks import make_policy as make_policy
from advsearch.attacks import search as search
from advsearch.attacks.verification import MIN_RATE as MIN_RATE
from advsearch.attacks.verification import OVER_CONDITIONS as OVER_CONDITIONS
from advsearch.attacks.verification import WORST_CASE as WORST_CASE
from advsearch.calls import with_checked_arguments as with_checked_arguments
from advsearch.cluster import InProcess as InProcess
from advsearch.config import DEFAULT_ENVIRONMENT as DEFAULT_ENVIRONMENT
from advsearch.controls import CONTROLS as CONTROLS
from advsearch.engine import loading as loading
from advsearch.engine.image_changes import WITHOUT_OBJECT as WITHOUT_OBJECT
from advsearch.engine.image_changes import change_image as change_image
from advsearch.engine.image_changes import meets_claim as meets_claim
from advsearch.engine.journal import Journal as Journal
from advsearch.engine.journal import ParallelEvaluator as ParallelEvaluator
from advsearch.engine.journal import check_digests as check_digests
from advsearch.engine.journal import make_worker_call as make_worker_call
from advsearch.engine.judging import judge_images as judge_images
from advsearch.engine.judging import make_domain as make_domain
from advsearch.engine.loading import Scene as Scene
from advsearch.engine.loading import load_scene as load_scene
from advsearch.engine.naming import AnyModel as AnyModel
from advsearch.engine.naming import check_run_settings as check_run_settings
from advsearch.engine.naming import collect_scene_parameters as collect_scene_parameters
from advsearch.engine.naming import get_model_name as get_model_name
from advsearch.engine.naming import hold_process_lock as hold_process_lock
from advsearch.engine.naming import is_session_only as is_session_only
from advsearch.engine.naming import load_models as load_models
from advsearch.engine.naming import select_run_settings as select_run_settings
from advsearch.engine.record import add_judgement as add_judgement
from advsearch.engine.record import make_control_group as make_control_group
from advsearch.engine.record import make_verified_rate as make_verified_rate
from advsearch.engine.verifier import RetrialCondition as RetrialCondition
from advsearch.engine.verifier import Retrials as Retrials
from advsearch.engine.verifier import Verifier as Verifier
from advsearch.engine.verifier import choose_ladder as choose_ladder
from advsearch.engine.verifier import (
    read_stored_configuration as read_stored_configuration,
)
from advsearch.options import FROM_RUN as FROM_RUN
from advsearch.options import Value as Value
from advsearch.options import count_outcomes as count_outcomes
from advsearch.pictures import load_upright as load_upright
from advsearch.progress import NullProgress as NullProgress
from advsearch.progress import ProgressOption as ProgressOption
from advsearch.progress import as_progress as as_progress
from advsearch.questions.attack.carry_out import LOADING as LOADING
from advsearch.questions.attack.carry_out import ROLES_IN_SEARCH as ROLES_IN_SEARCH
from advsearch.questions.attack.carry_out import AttackParts as AttackParts
from advsearch.questions.attack.carry_out import check_from_config as check_from_config
from advsearch.questions.attack.carry_out import load_parts as load_parts
from advsearch.questions.attack.carry_out import load_parts_of_run as load_parts_of_run
from advsearch.questions.attack.carry_out import make_problem as make_problem
from advsearch.questions.attack.carry_out import make_problem_on as make_problem_on
from advsearch.questions.attack.carry_out import (
    make_problem_with_warnings as make_problem_with_warnings,
)
from advsearch.questions.attack.carry_out import (
    move_to_photographs as move_to_photographs,
)
from advsearch.questions.attack.carry_out import open_executor as open_executor
from advsearch.questions.attack.carry_out import (
    problem_from_config as problem_from_config,
)
from advsearch.questions.attack.carry_out import (
    with_evaluation_only as with_evaluation_only,
)
from advsearch.questions.attack.result import AttackResult as AttackResult
from advsearch.questions.attack.run import attack_on as attack_on
from advsearch.questions.attack.summary import AttackSummary as AttackSummary
from advsearch.questions.attack.summary import (
    load_attack_summary as load_attack_summary,
)
from advsearch.questions.sweep.carry_out import (
    load_scenes_of_sweep as load_scenes_of_sweep,
)
from advsearch.questions.sweep.carry_out import row_parameters as row_parameters
from advsearch.questions.sweep.display import surface_sentences as surface_sentences
from advsearch.questions.sweep.stored import StoredSweep as StoredSweep
from advsearch.questions.sweep.summary import SweepSummary as SweepSummary
from advsearch.registry import get_experiment as get_experiment
from advsearch.registry import load_attribute
from advsearch.runs.results import AxisValue as AxisValue
from advsearch.runs.store import Row as Row
from advsearch.runs.summary import read_configuration as read_configuration
from advsearch.runs.tables import read_units as read_units
from advsearch.runs.twins import find_twin_evidence as find_twin_evidence
from advsearch.runs.twins import read_twins as read_twins
from advsearch.scene import library as library
from advsearch.scene.assembly import pose_mesh as pose_mesh
from advsearch.scene.camera_files import read_camera as read_camera
from advsearch.scene.glb import encode_glb as encode_glb
from advsearch.scene.grounds import is_paved as is_paved
from advsearch.scene.importing.files import get_last_line as get_last_line
from advsearch.scene.parts import PluginPart as PluginPart
from advsearch.scene.parts import make_sphere as make_sphere
from advsearch.scene.renderer import MAX_SPP as MAX_SPP
from advsearch.settings import PythonOnly as PythonOnly
from advsearch.tasks import AnyTask as AnyTask
from advsearch.tasks import make_task as make_task
from advsearch.tasks.base import Truth as Truth
from advsearch.tasks.together import EnsembleTask as EnsembleTask
from advsearch.threads import all_for_torch as all_for_torch
from advsearch.threads import count_cores as count_cores
from advsearch.trust.code import allow_code_in_settings as allow_code_in_settings
from advsearch.trust.programs import find_blender as find_blender
from advsearch.trust.programs import make_environment as make_environment
from advsearch.trust.yaml_text import parse_yaml as parse_yaml


def load_photographs() -> Any:
    """Return an object that adds photographs of the real object to runs.

    It has the methods `list_files(folder, task)`, `add_files(run, files)`, and
    `agreement(run)`, which counts in how many photographs the model is right or wrong
    as in the renderings (`advsearch.photo_agreement`).
    """
    return load_attribute("advsearch.questions.photographs.carry_out:Photographs")()
