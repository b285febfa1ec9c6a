"""What experiments load and use: scenes, models, tasks and problems that settings name, attacks, and workers.

`advsearch.extend` offers this module to added experiments. Everything here renders or imports torch, so that the
module of an experiment, which the command line reads for its help, imports it inside functions.
"""

from __future__ import annotations

from advsearch.attacks import Query as Query
from advsearch.attacks import SearchResult as SearchResult
from advsearch.attacks import make_policy as make_policy
from advsearch.attacks import search as search
from advsearch.controls import CONTROLS as CONTROLS
from advsearch.controls.support.meshes import sphere as sphere
from advsearch.engine.judging import domain_of as domain_of
from advsearch.engine.loading import Scene as Scene
from advsearch.engine.loading import load_scene as load_scene
from advsearch.engine.naming import settings_alone as settings_alone
from advsearch.questions.attack.carry_out import LOADING as LOADING
from advsearch.questions.attack.carry_out import problem_from_config as problem_from_config
from advsearch.scene.parts import PluginPart as PluginPart
