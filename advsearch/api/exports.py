"""What exporters of runs write: the adversarial scene of a run, its rows with images,
stored images, printed sheets.
"""

from __future__ import annotations

from advsearch.api.chart import draw_chart_page as draw_chart_page
from advsearch.api.export import AdversarialRun as AdversarialRun
from advsearch.api.export import get_real_size as get_real_size
from advsearch.api.export import make_printable_pieces as make_printable_pieces
from advsearch.api.rendered_rows import render_rows as render_rows
from advsearch.options import format_rounded as format_rounded
from advsearch.report.sheets import DEFAULT_MAX_SHEETS as DEFAULT_MAX_SHEETS
from advsearch.report.sheets import write_sheets as write_sheets
from advsearch.viewer import thumbnails as thumbnails
