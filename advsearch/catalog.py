"""The catalog of built-in parts: experiments, controls, policies, tasks and so on.

Other packages may add parts of these kinds, too. The catalog has the module and a line
of help of each part. A module is imported when its part is used for the first time. A
part whose module is missing is left out.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import cache
from importlib.machinery import ModuleSpec
from typing import NamedTuple


class BuiltIn(NamedTuple):
    """A built-in part.

    Attributes:
        kind: "experiment", "control", "policy", "task", "model source", "recognizer" of
            networks from Python, "exporter", "reader" of mesh files, "converter" of
            files to glTF, "predictor" of images, or "cluster" on which workers run.
        name: its name on the command line. For a reader or converter it is the suffix
            of its files, and for a recognizer the library of its networks.
        import_path: "module:attribute" that is imported when the part is used.
        help: what it does, in a line that begins in lower case and has no full stop.
    """

    kind: str
    name: str
    import_path: str
    help: str


_EXPERIMENTS = "advsearch.questions"
_CONTROLS = "advsearch.controls"
_POLICIES = "advsearch.attacks.policies"
_TASKS = "advsearch.tasks"
_ENGINE = "advsearch.engine"
_PREDICTORS = "advsearch.predictors"
_MODELS = "advsearch.models"
_EXPORTERS = "advsearch.cli.exporters"
_READERS = "advsearch.scene.importing"
_CLUSTERS = "advsearch.cluster"

BUILT_INS = (
    BuiltIn(
        "experiment",
        "attack",
        f"{_EXPERIMENTS}.attack:attack",
        "find the configuration of a scene that the model gets wrong most badly",
    ),
    BuiltIn(
        "experiment",
        "sweep",
        f"{_EXPERIMENTS}.sweep:sweep",
        "measure how often the model is right over a grid or a random sample of "
        "configurations",
    ),
    BuiltIn(
        "experiment",
        "render",
        f"{_EXPERIMENTS}.render:render",
        "render a picture of a scene, with the prediction of the model",
    ),
    BuiltIn(
        "experiment",
        "region",
        f"{_EXPERIMENTS}.region:region",
        "find a box around a configuration in which the model stays right, or wrong",
    ),
    BuiltIn(
        "experiment",
        "explain",
        f"{_EXPERIMENTS}.explain:explain",
        "find rules about where a model is wrong, from the rows of sweeps, and confirm "
        "them by new renders",
    ),
    BuiltIn(
        "experiment",
        "compare",
        f"{_EXPERIMENTS}.compare:compare",
        "compare models, objects or adversarial scenes on the same pictures, pair by "
        "pair",
    ),
    BuiltIn(
        "experiment",
        "recipe",
        f"{_EXPERIMENTS}.recipe:recipe",
        "run the full experiment of a recipe, and write a page with figures",
    ),
    BuiltIn(
        "experiment",
        "harden",
        f"{_EXPERIMENTS}.harden:harden",
        "train a copy of a model on its worst cases, and measure it before and after "
        "on scenes that training never saw",
    ),
    BuiltIn(
        "experiment",
        "test",
        f"{_EXPERIMENTS}.test:test",
        "test claims about a model, for instance at every change of it; each holds, "
        "fails or is undecided",
    ),
    BuiltIn(
        "experiment",
        "replay",
        f"{_EXPERIMENTS}.replay:replay",
        "render the adversarial scene of a run again under other conditions, and the "
        "clean scene for comparison",
    ),
    BuiltIn(
        "experiment",
        "check",
        f"{_EXPERIMENTS}.check:check",
        "compare every gradient with finite differences; show how a search computes "
        "them and what it leaves out",
    ),
    BuiltIn(
        "experiment",
        "precision",
        f"{_EXPERIMENTS}.precision:precision",
        "measure error and run time of renders and gradients, and recommend settings",
    ),
    BuiltIn(
        "experiment",
        "stability",
        f"{_EXPERIMENTS}.stability:stability",
        "run difficult and extreme scenes, and check the result of each",
    ),
    BuiltIn(
        "experiment",
        "twins",
        f"{_EXPERIMENTS}.twins:twins",
        "measure on photographs with known poses how well renders predict whether the "
        "model is right",
    ),
    BuiltIn(
        "control",
        "pose",
        f"{_CONTROLS}.pose:PoseControl",
        "the position, the rotation and the size of the object",
    ),
    BuiltIn(
        "control",
        "camera",
        f"{_CONTROLS}.camera:CameraControl",
        "an orbit around the object, the lens, and the exposure",
    ),
    BuiltIn(
        "control",
        "path",
        f"{_CONTROLS}.path:PathControl",
        "the camera, the object or both move along a path; a frame is a time",
    ),
    BuiltIn(
        "control",
        "texture",
        f"{_CONTROLS}.texture:TextureControl",
        "the base color texture of the object or another mesh, inside a norm ball "
        "around the original",
    ),
    BuiltIn(
        "control",
        "material",
        f"{_CONTROLS}.material:MaterialControl",
        "the object's gloss, metal, coat and tint, or a named material that covers it",
    ),
    BuiltIn(
        "control",
        "light",
        f"{_CONTROLS}.light:LightControl",
        "a lamp: its position, color and power, and the size of an area light",
    ),
    BuiltIn(
        "control",
        "projector",
        f"{_CONTROLS}.projector:ProjectorControl",
        "a picture that a projector projects onto the object",
    ),
    BuiltIn(
        "control",
        "spot",
        f"{_CONTROLS}.projector:SpotControl",
        "the spot of a flashlight or a laser on the object",
    ),
    BuiltIn(
        "control",
        "shadow",
        f"{_CONTROLS}.shadow:ShadowControl",
        "a dark card that casts a shadow onto the object, invisible to the camera",
    ),
    BuiltIn(
        "control",
        "environment",
        f"{_CONTROLS}.environment:EnvironmentControl",
        "the environment that lights the scene, and its rotation, brightness and color",
    ),
    BuiltIn(
        "control",
        "sky",
        f"{_CONTROLS}.sky:SkyControl",
        "a clear sky instead of the environment: the position of the sun, and the haze",
    ),
    BuiltIn(
        "control",
        "geometry",
        f"{_CONTROLS}.geometry:GeometryControl",
        "a smooth change of the object's shape, up to a maximum distance",
    ),
    BuiltIn(
        "control",
        "things",
        f"{_CONTROLS}.things:ThingsControl",
        "the positions and rotations of the other objects in the scene, and whether "
        "they are present",
    ),
    BuiltIn(
        "control",
        "body",
        f"{_CONTROLS}.body:BodyControl",
        "the look, the pose and the walk of a person, or the joints and animations of "
        "a rigged file",
    ),
    BuiltIn(
        "control",
        "patch",
        f"{_CONTROLS}.patch:PatchControl",
        "a printed square on the object: its pixels, position, size and rotation",
    ),
    BuiltIn(
        "control",
        "occlusion",
        f"{_CONTROLS}.occlusion:OcclusionControl",
        "a second object between the camera and the object, which hides a fraction of it",
    ),
    BuiltIn(
        "control",
        "contents",
        f"{_CONTROLS}.contents:ContentsControl",
        "the liquid in a vessel (water, coffee or milk), and how full it is",
    ),
    BuiltIn(
        "control",
        "background",
        f"{_CONTROLS}.background:BackgroundControl",
        "a plain color behind the object, which the environment still lights",
    ),
    BuiltIn(
        "control",
        "backdrop",
        f"{_CONTROLS}.backdrop:BackdropControl",
        "the photograph of a folder into which the scene is rendered, with its camera",
    ),
    BuiltIn(
        "control",
        "haze",
        f"{_CONTROLS}.haze:HazeControl",
        "a uniform haze around camera and object: its density and color",
    ),
    BuiltIn(
        "control",
        "lens",
        f"{_CONTROLS}.lens:LensControl",
        "translucent, blurred dots on the camera's lens: their positions, sizes, colors "
        "and opacities",
    ),
    BuiltIn(
        "control",
        "sensor",
        f"{_CONTROLS}.sensor:SensorControl",
        "effects of a camera: noise, mosaic, white balance, chromatic aberration, "
        "vignetting, JPEG",
    ),
    BuiltIn(
        "control",
        "corruption",
        f"{_CONTROLS}.corruption:CorruptionControl",
        "a common image corruption (noise, blur, weather, digital) by name and severity",
    ),
    BuiltIn(
        "control",
        "mitsuba",
        f"{_CONTROLS}.mitsuba:MitsubaControl",
        "any other number or color in the scene, by its name in Mitsuba",
    ),
    BuiltIn(
        "policy",
        "adam",
        f"{_POLICIES}.adam:Adam",
        "Adam (Kingma and Ba 2015) as ascent, projected onto the domain after each step",
    ),
    BuiltIn(
        "policy",
        "archive",
        f"{_POLICIES}.archive:MapElites",
        "MAP-Elites (Mouret and Clune 2015) with the package ribs",
    ),
    BuiltIn(
        "policy",
        "auto",
        f"{_POLICIES}.auto:Auto",
        "chooses a policy by itself: try it first; it has no options",
    ),
    BuiltIn(
        "policy",
        "cmaes",
        f"{_POLICIES}.evolution:CMAES",
        "CMA-ES (Hansen and Ostermeier 2001; Hansen 2016) with the package pycma",
    ),
    BuiltIn(
        "policy",
        "grid",
        f"{_POLICIES}.sampling:Grid",
        "every combination of evenly spaced values, once",
    ),
    BuiltIn(
        "policy",
        "mixture",
        f"{_POLICIES}.mixture:Mixture",
        "the cross-entropy method (Rubinstein and Kroese 2004) with a mixture",
    ),
    BuiltIn(
        "policy",
        "nes",
        f"{_POLICIES}.evolution:NES",
        "the separable natural evolution strategy (SNES; Wierstra et al. 2014)",
    ),
    BuiltIn(
        "policy",
        "pgd",
        f"{_POLICIES}.pgd:PGD",
        "projected gradient ascent (Madry et al. 2018) for a noisy objective",
    ),
    BuiltIn(
        "policy",
        "portfolio",
        f"{_POLICIES}.portfolio:Portfolio",
        "runs several policies in parallel, and continues with the most successful ones",
    ),
    BuiltIn(
        "policy",
        "random",
        f"{_POLICIES}.sampling:Random",
        "independent samples within the budget, alternately at the extremes of the norm "
        "balls and in their interior",
    ),
    BuiltIn(
        "policy",
        "restarts",
        f"{_POLICIES}.restarts:Restarts",
        "runs a policy `times` times, each with an equal part of the renders; the runs "
        "alternate step by step",
    ),
    BuiltIn(
        "policy",
        "sobol",
        f"{_POLICIES}.sobol:Sobol",
        "a scrambled Sobol sequence over the full domain (Sobol 1967; scrambling of Owen "
        "1998, Matousek 1998)",
    ),
    BuiltIn(
        "task",
        "classification",
        f"{_TASKS}.classification:Classification",
        "the model's largest logit names the class of the object",
    ),
    BuiltIn(
        "task",
        "detection",
        f"{_TASKS}.detection:Detection",
        "a model detects the object: one of its boxes has a right label and a score of "
        "`confidence`, and overlaps the true box",
    ),
    BuiltIn(
        "task",
        "segmentation",
        f"{_TASKS}.segmentation:Segmentation",
        "a model gives at least a fraction `accuracy` of the object's pixels a right "
        "class; other pixels do not count",
    ),
    BuiltIn(
        "task",
        "depth",
        f"{_TASKS}.depth:Depth",
        "a model estimates the distance of the object, on average to within a factor of "
        "1 + `tolerance`",
    ),
    BuiltIn(
        "task",
        "similarity",
        f"{_TASKS}.similarity:Similarity",
        "a model's embedding of the picture is nearest to those of reference pictures "
        "of the object, or close to that of the clean picture",
    ),
    BuiltIn(
        "task",
        "answer",
        f"{_TASKS}.answers:FreeAnswer",
        "a model's answer contains one of the right words, in upper or lower case",
    ),
    BuiltIn(
        "task",
        "command",
        f"{_TASKS}.command:Command",
        "a robot policy outputs nearly the same action as in the clean scene; open loop, "
        "one action for one picture",
    ),
    BuiltIn(
        "task",
        "rig",
        f"{_TASKS}.rig:Rig",
        "several cameras take pictures of one configuration, and the model's predictions "
        "of them are combined into one",
    ),
    # from the cheapest to the most expensive: they are tried in this order
    BuiltIn(
        "predictor",
        "matrix",
        f"{_ENGINE}.transport:MatrixMethod",
        "a matrix of light transport, or a picture of each light",
    ),
    BuiltIn(
        "predictor",
        "surface_light",
        f"{_PREDICTORS}.surface_light:SurfaceLightMethod",
        "light stored on surfaces, for searches and sweeps over cameras",
    ),
    BuiltIn(
        "predictor",
        "bank",
        f"{_PREDICTORS}.bank:BankMethod",
        "matrices of some conditions, for searches whose conditions vary",
    ),
    BuiltIn(
        "model source",
        "torchvision",
        f"{_MODELS}.zoo:load_torchvision",
        "a network of torchvision with its published weights",
    ),
    BuiltIn(
        "model source",
        "timm",
        f"{_MODELS}.zoo:load_timm",
        "a network of timm with its published weights",
    ),
    BuiltIn(
        "model source",
        "hf",
        f"{_MODELS}.zoo:load_transformers",
        "a network of transformers from a repository of Hugging Face or a directory",
    ),
    BuiltIn(
        "model source",
        "http",
        f"{_MODELS}.address:load",
        "a model behind an address",
    ),
    BuiltIn(
        "model source",
        "https",
        f"{_MODELS}.address:load",
        "a model behind an address",
    ),
    BuiltIn(
        "recognizer",
        "transformers",
        f"{_MODELS}.zoo:recognize_transformers",
        "a network of transformers that was made in Python",
    ),
    BuiltIn(
        "recognizer",
        "timm",
        f"{_MODELS}.zoo:recognize_timm",
        "a network of timm that was made in Python",
    ),
    BuiltIn(
        "exporter",
        "coco",
        f"{_EXPORTERS}.dataset:Coco",
        "the pictures with boxes and masks, in the format of COCO",
    ),
    BuiltIn(
        "exporter",
        "yolo",
        f"{_EXPORTERS}.dataset:Yolo",
        "the pictures with boxes, to train a YOLO",
    ),
    BuiltIn(
        "exporter",
        "gltf",
        f"{_EXPORTERS}.scene:Gltf",
        "the adversarial object as glTF",
    ),
    BuiltIn(
        "exporter",
        "mitsuba",
        f"{_EXPORTERS}.scene:MitsubaExport",
        "the adversarial scene for Mitsuba",
    ),
    BuiltIn(
        "exporter",
        "print",
        f"{_EXPORTERS}.sheets:Sheets",
        "a patch or texture as sheets to print",
    ),
    BuiltIn(
        "exporter",
        "projector",
        f"{_EXPORTERS}.projection:Projection",
        "the picture of a projector, and marks to align it",
    ),
    BuiltIn(
        "exporter",
        "3db",
        f"{_EXPORTERS}.threedb:ThreeDB",
        "a sweep as a folder for 3DB's dashboard",
    ),
    BuiltIn("reader", "obj", f"{_READERS}.wavefront:read_obj", "Wavefront OBJ"),
    BuiltIn("reader", "ply", f"{_READERS}.ply:read_ply", "PLY"),
    BuiltIn("reader", "stl", f"{_READERS}.stl:read_stl", "STL"),
    BuiltIn("reader", "gltf", f"{_READERS}.gltf_parts:read_gltf", "glTF 2.0"),
    BuiltIn("reader", "glb", f"{_READERS}.gltf_parts:read_gltf", "binary glTF 2.0"),
    BuiltIn(
        "reader", "vrm", f"{_READERS}.gltf_parts:read_gltf", "VRM, a person as glTF"
    ),
    BuiltIn(
        "converter",
        "blend",
        f"{_READERS}.blender:convert_blend",
        "Blender, through its own glTF exporter",
    ),
    BuiltIn("converter", "usd", f"{_READERS}.usd:convert_usd", "OpenUSD, through glTF"),
    BuiltIn(
        "converter",
        "usda",
        f"{_READERS}.usd:convert_usd",
        "OpenUSD as text, through glTF",
    ),
    BuiltIn(
        "converter",
        "usdc",
        f"{_READERS}.usd:convert_usd",
        "binary OpenUSD, through glTF",
    ),
    BuiltIn(
        "converter",
        "usdz",
        f"{_READERS}.usd:convert_usd",
        "a package of OpenUSD, through glTF",
    ),
    BuiltIn(
        "cluster",
        "dask",
        f"{_CLUSTERS}.dask_executor:DaskExecutor",
        "the workers of a Dask scheduler, or of a cluster that Dask starts",
    ),
)


def is_module_installed(module: str) -> bool:
    """Return whether a module is installed, without importing it or its packages.

    Args:
        module: full name, such as "torchvision.models".
    """
    names = module.split(".")
    path: Sequence[str] | None = None  # where to look; None is Python's own path
    for depth in range(1, len(names) + 1):
        spec = _find_spec(".".join(names[:depth]), path)
        if spec is None:
            return False
        # The next name is looked for inside of this package. A plain module contains no
        # other modules.
        path = spec.submodule_search_locations or ()
    return True


def _find_spec(module: str, path: Sequence[str] | None) -> ModuleSpec | None:
    """Return where Python would import a module from; None if it is nowhere.

    Unlike with `importlib.util.find_spec`, parent packages are not imported.

    Args:
        module: full name of the module.
        path: directories of its package; None for a module at the top.
    """
    for finder in sys.meta_path:
        try:
            spec = finder.find_spec(module, path)
        except ModuleNotFoundError:
            return None
        if spec is not None:
            return spec
    return None


@cache
def list_built_ins(kind: str) -> dict[str, BuiltIn]:
    """Return the built-in parts of one kind by name, without those whose module is
    missing.
    """
    built_ins = {}
    for part in BUILT_INS:
        module, _, _ = part.import_path.partition(":")
        if part.kind == kind and is_module_installed(module):
            built_ins[part.name] = part
    return built_ins
