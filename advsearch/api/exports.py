"""What exporters of runs write from: the adversarial scene of a run, its rows with their images, stored images."""

from __future__ import annotations

from advsearch.api.export import AdversarialRun as AdversarialRun
from advsearch.api.rendered_rows import render_rows as render_rows
from advsearch.viewer import thumbnails as thumbnails
