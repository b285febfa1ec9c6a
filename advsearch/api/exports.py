"""What exporters of runs write: the adversarial scene of a run, its rows with images,
stored images, printed sheets.
"""

from __future__ import annotations

from advsearch.api.chart import chart_page as chart_page
from advsearch.api.export import AdversarialRun as AdversarialRun
from advsearch.api.export import printable as printable
from advsearch.api.export import real_size as real_size
from advsearch.api.rendered_rows import render_rows as render_rows
from advsearch.options import rounded as rounded
from advsearch.report.sheets import MOST_SHEETS as MOST_SHEETS
from advsearch.report.sheets import write_sheets as write_sheets
from advsearch.viewer import thumbnails as thumbnails
