"""What methods that predict images are made of.

    from advsearch.extend import prediction

    class Still(prediction.PredictionMethod):
        name = "still"
        pictures_are = "those of the start"

`advsearch.extend` offers this module to added predictors. A method is a subclass of
`PredictionMethod`; what it makes are a `PredictedSearch` for searches and a
`SweepMethod` for sweeps. Whether its images are accurate enough is measured by
`PredictedSearch.compare` and `Problem.compare_view`. `dr` and `mi` are Dr.Jit and
Mitsuba with the variant of advsearch, for rays of its own.
"""

from __future__ import annotations

from advsearch.attacks import Evaluate as Evaluate
from advsearch.attacks import Evaluation as Evaluation
from advsearch.attacks.evaluation import Query as Query
from advsearch.attacks.evaluation import WhichGradient as WhichGradient
from advsearch.controls import Space as Space
from advsearch.engine.acceptance import N_VIEWS as N_VIEWS
from advsearch.engine.acceptance import ComparedView as ComparedView
from advsearch.engine.acceptance import Deviation as Deviation
from advsearch.engine.image_groups import Groups as Groups
from advsearch.engine.image_groups import MakeGroups as MakeGroups
from advsearch.engine.prediction import MIN_SAVING_FACTOR as MIN_SAVING_FACTOR
from advsearch.engine.prediction import CleanMatrix as CleanMatrix
from advsearch.engine.prediction import PredictedSearch as PredictedSearch
from advsearch.engine.prediction import PredictionMethod as PredictionMethod
from advsearch.engine.prediction import SweepMethod as SweepMethod
from advsearch.engine.prediction import count_check_samples as count_check_samples
from advsearch.engine.prediction import sample_condition as sample_condition
from advsearch.engine.transport import find_matrix_refusal as find_matrix_refusal
from advsearch.scene.assembly import IMAGE_INPUTS as IMAGE_INPUTS
from advsearch.scene.camera_model import CameraModel as CameraModel
from advsearch.scene.description import OBJECT as OBJECT
from advsearch.scene.gradients import Group as Group
from advsearch.scene.mitsuba_backend.scene import MitsubaScene as MitsubaScene
from advsearch.scene.mitsuba_backend.variant import Recordings as Recordings
from advsearch.scene.mitsuba_backend.variant import dr as dr
from advsearch.scene.mitsuba_backend.variant import mi as mi
from advsearch.scene.mitsuba_backend.variant import mitsuba_lock as mitsuba_lock
from advsearch.scene.photographed_ground import (
    compute_open_sky_irradiance as compute_open_sky_irradiance,
)
from advsearch.scene.predictor import MAX_BYTES as MAX_BYTES
from advsearch.scene.predictor import NOISE as NOISE
from advsearch.scene.predictor import NOTHING_MOVES as NOTHING_MOVES
from advsearch.scene.predictor import LinearMap as LinearMap
from advsearch.scene.predictor import Predictor as Predictor
from advsearch.scene.predictor import Refusal as Refusal
from advsearch.scene.predictor import RefusalCause as RefusalCause
from advsearch.scene.predictor import find_changed_inputs as find_changed_inputs
from advsearch.scene.predictor import inputs_differ as inputs_differ
from advsearch.scene.raster import BORDER_TEXELS as BORDER_TEXELS
from advsearch.scene.raster import Charts as Charts
from advsearch.scene.raster import rasterize_charts as rasterize_charts
from advsearch.scene.renderer import Renderer as Renderer
from advsearch.scene.transport.matrix import LinearizedScene as LinearizedScene
from advsearch.scene.transport.matrix import LinearRenderer as LinearRenderer
from advsearch.scene.transport.matrix import ProgressCallback as ProgressCallback
from advsearch.scene.transport.matrix import (
    find_bilinear_weights as find_bilinear_weights,
)
from advsearch.scene.transport.matrix import to_torch_csr as to_torch_csr
