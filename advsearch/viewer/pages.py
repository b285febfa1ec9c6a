"""`report.html` of any run: the page that runs of its command have."""

from __future__ import annotations

from pathlib import Path

from advsearch import rooms
from advsearch.runs.directory import REPORT
from advsearch.runs.files import write_text
from advsearch.runs.results.attack import AttackSummary
from advsearch.runs.results.base import Result
from advsearch.runs.results.explain import ExplainResult
from advsearch.runs.results.gap import CurveResult, GapResult
from advsearch.runs.results.harden import HardenResult
from advsearch.runs.results.matrix import MatrixResult
from advsearch.runs.results.recipe import RecipeResult
from advsearch.runs.results.replay import ReplayResult
from advsearch.runs.results.sweep import SweepSummary
from advsearch.viewer import attack_page, study_page, sweep_page
from advsearch.viewer.explain_page import explain_page
from advsearch.viewer.harden_page import harden_page
from advsearch.viewer.recipe_page import recipe_page
from advsearch.viewer.result_page import result_page


def write_page(run: Path, result: Result) -> Path:
    """Write `report.html` into the folder of a run and return its path.

    Args:
        run: the folder.
        result: that the run has.

    Raises:
        FileFormatError: other results of the run are damaged.
        StorageError: the page cannot be written.
    """
    match result:
        case AttackSummary():
            return attack_page.write_report(run)
        case SweepSummary():
            return sweep_page.write_sweep_page(run, result)
        case GapResult():
            text = study_page.gap_page(run, result)
        case CurveResult():
            text = study_page.curve_page(run, result)
        case MatrixResult():
            text = study_page.matrix_page(run, result)
        case ReplayResult():
            text = study_page.replay_page(run, result)
        case ExplainResult():
            text = explain_page(run, result)
        case HardenResult():
            text = harden_page(run, result)
        case RecipeResult():
            text = recipe_page(run, result)
        case _:
            text = (rooms.in_room(result.command, "page", "page") or result_page)(run, result)
    return write_text(run / REPORT, text, durable=False)
