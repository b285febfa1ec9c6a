"""The built-in parts that somebody could also add from a package: where each is, and a
line of help.

Nothing is imported before it is needed. A part whose module is missing is left out.
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
            networks from Python, "exporter", "reader" of mesh files, or "converter" of
            files to glTF.
        name: the word for it on the command line; of a reader or converter the suffix
            of its files, of a recognizer the library of its networks.
        target: "module:attribute" that is imported when the part is used.
        help: what it does, in a line that begins in lower case and has no full stop.
    """

    kind: str
    name: str
    target: str
    help: str


_EXPERIMENTS = "advsearch.questions"
_CONTROLS = "advsearch.controls"
_POLICIES = "advsearch.attacks.policies"
_TASKS = "advsearch.tasks"
_MODELS = "advsearch.models"
_EXPORTERS = "advsearch.cli.exporters"
_READERS = "advsearch.scene.importing"

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
        "render a picture of a scene, and say what the model sees in it",
    ),
    BuiltIn(
        "experiment",
        "region",
        f"{_EXPERIMENTS}.region:region",
        "grow a box around a configuration in which the model's verdict stays the same",
    ),
    BuiltIn(
        "experiment",
        "explain",
        f"{_EXPERIMENTS}.explain:explain",
        "say in words where a model is wrong, from the rows of sweeps, and confirm it "
        "by fresh renders",
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
        "run a whole experiment that a recipe describes, and write a page of figures",
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
        "test claims about a model, each found held, failed or undecided: a gate at "
        "every change",
    ),
    BuiltIn(
        "experiment",
        "replay",
        f"{_EXPERIMENTS}.replay:replay",
        "render the adversarial scene of a run again under other conditions, beside "
        "the clean scene",
    ),
    BuiltIn(
        "experiment",
        "check",
        f"{_EXPERIMENTS}.check:check",
        "check every gradient against differences; show how a search gets them and "
        "what it leaves out",
    ),
    BuiltIn(
        "experiment",
        "precision",
        f"{_EXPERIMENTS}.precision:precision",
        "measure error against run time, draw it, and recommend settings",
    ),
    BuiltIn(
        "experiment",
        "stability",
        f"{_EXPERIMENTS}.stability:stability",
        "run stiff and extreme cases, and check that each of them holds",
    ),
    BuiltIn(
        "experiment",
        "twins",
        f"{_EXPERIMENTS}.twins:twins",
        "measure on photographs with known poses how far verdicts on renders hold",
    ),
    BuiltIn(
        "control",
        "pose",
        f"{_CONTROLS}.pose:PoseControl",
        "where the object stands, how it is turned, and how large it is",
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
        "the camera, the object or both travel along a path; a frame is a time",
    ),
    BuiltIn(
        "control",
        "texture",
        f"{_CONTROLS}.texture:TextureControl",
        "the base-colour map of the object or another mesh, inside a ball around the "
        "original",
    ),
    BuiltIn(
        "control",
        "material",
        f"{_CONTROLS}.material:MaterialControl",
        "the object's gloss, metal, coat and tint, and which named material covers it",
    ),
    BuiltIn(
        "control",
        "light",
        f"{_CONTROLS}.light:LightControl",
        "a lamp: where it stands, its colour, its power, and the size of an area light",
    ),
    BuiltIn(
        "control",
        "projector",
        f"{_CONTROLS}.projector:ProjectorControl",
        "a picture that a projector throws onto the object",
    ),
    BuiltIn(
        "control",
        "spot",
        f"{_CONTROLS}.projector:SpotControl",
        "the spot of a torch or a laser on the object",
    ),
    BuiltIn(
        "control",
        "shadow",
        f"{_CONTROLS}.shadow:ShadowControl",
        "a dark card that throws a shadow onto the object, out of the camera's sight",
    ),
    BuiltIn(
        "control",
        "environment",
        f"{_CONTROLS}.environment:EnvironmentControl",
        "which environment lights the scene, how it is turned, how bright it is, and "
        "its colour",
    ),
    BuiltIn(
        "control",
        "sky",
        f"{_CONTROLS}.sky:SkyControl",
        "a clear sky instead of the environment: where the sun stands, and how hazy "
        "the air is",
    ),
    BuiltIn(
        "control",
        "geometry",
        f"{_CONTROLS}.geometry:GeometryControl",
        "a smooth change of the object's shape, at most so far",
    ),
    BuiltIn(
        "control",
        "things",
        f"{_CONTROLS}.things:ThingsControl",
        "where the things beside the object stand, how they are turned, and whether "
        "they are there",
    ),
    BuiltIn(
        "control",
        "body",
        f"{_CONTROLS}.body:BodyControl",
        "what a person is like, how they stand or walk, and how a rigged file of your "
        "own moves",
    ),
    BuiltIn(
        "control",
        "patch",
        f"{_CONTROLS}.patch:PatchControl",
        "a printed square stuck onto the object: its pixels, place, size and turn",
    ),
    BuiltIn(
        "control",
        "occlusion",
        f"{_CONTROLS}.occlusion:OcclusionControl",
        "a second object between the camera and the object, hiding a wanted share of it",
    ),
    BuiltIn(
        "control",
        "contents",
        f"{_CONTROLS}.contents:ContentsControl",
        "what a vessel is filled with, and how high: water, coffee and milk",
    ),
    BuiltIn(
        "control",
        "background",
        f"{_CONTROLS}.background:BackgroundControl",
        "a plain colour behind the object; the environment keeps lighting it",
    ),
    BuiltIn(
        "control",
        "backdrop",
        f"{_CONTROLS}.backdrop:BackdropControl",
        "which photograph of a folder the scene is rendered into, seen by its camera",
    ),
    BuiltIn(
        "control",
        "haze",
        f"{_CONTROLS}.haze:HazeControl",
        "a uniform haze around camera and object: how dense it is, and its colour",
    ),
    BuiltIn(
        "control",
        "lens",
        f"{_CONTROLS}.lens:LensControl",
        "translucent, blurred dots on the camera's lens: their places, sizes, colours, "
        "opacities",
    ),
    BuiltIn(
        "control",
        "sensor",
        f"{_CONTROLS}.sensor:SensorControl",
        "what a camera adds: noise, mosaic, white balance, chromatic aberration, "
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
        "anything else in the scene: numbers and colours by Mitsuba's own names",
    ),
    BuiltIn(
        "policy",
        "adam",
        f"{_POLICIES}.pgd:Adam",
        "Adam (Kingma and Ba 2015) uphill, projected onto the domain after every step",
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
        "what to use first; it has no options",
    ),
    BuiltIn(
        "policy",
        "cmaes",
        f"{_POLICIES}.evolution:CMAES",
        "CMA-ES (Hansen and Ostermeier 2001; Hansen 2016) as pycma has it",
    ),
    BuiltIn(
        "policy",
        "grid",
        f"{_POLICIES}.sampling:Grid",
        "every combination of evenly spaced values, then nothing more",
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
        f"{_POLICIES}.auto:Portfolio",
        "lets several policies search side by side and goes on with those that reached "
        "more",
    ),
    BuiltIn(
        "policy",
        "random",
        f"{_POLICIES}.sampling:Random",
        "independent samples within the budget, by turns at the extremes of the norm "
        "balls and in their interior",
    ),
    BuiltIn(
        "policy",
        "restarts",
        f"{_POLICIES}.auto:Restarts",
        "lets a policy search `times` times, each with an equal share of the renders; "
        "they take turns, step by step",
    ),
    BuiltIn(
        "policy",
        "sobol",
        f"{_POLICIES}.sampling:Sobol",
        "a scrambled Sobol sequence over the whole domain (Sobol 1967; scrambled as by "
        "Owen 1998, Matousek 1998)",
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
        "a model finds the object: one of its boxes has a right name, a score of "
        "`confidence`, overlaps the true box",
    ),
    BuiltIn(
        "task",
        "segmentation",
        f"{_TASKS}.segmentation:Segmentation",
        "a model gives at least `accuracy` of the object's pixels a right class; "
        "pixels beside it don't count",
    ),
    BuiltIn(
        "task",
        "depth",
        f"{_TASKS}.depth:Depth",
        "a model judges how far the object is: off by less than a factor of 1 + "
        "`tolerance`, on average",
    ),
    BuiltIn(
        "task",
        "similarity",
        f"{_TASKS}.similarity:Similarity",
        "the object is what the nearest reference pictures show, or what the clean "
        "picture shows",
    ),
    BuiltIn(
        "task",
        "answer",
        f"{_TASKS}.answers:FreeAnswer",
        "a model's answer has one of the right words in it, as a whole word, in any "
        "case",
    ),
    BuiltIn(
        "task",
        "command",
        f"{_TASKS}.command:Command",
        "a policy commands about the action that it commands in the clean scene: open "
        "loop, one picture, one action",
    ),
    BuiltIn(
        "task",
        "rig",
        f"{_TASKS}.rig:Rig",
        "several cameras take pictures of one configuration, and one prediction is "
        "made of what a model says of each",
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
        "the pictures with boxes and masks, as COCO has them",
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
        "a projector's picture, and marks to line it up",
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
)


def is_present(module: str) -> bool:
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
        # the next name is looked for inside of this package; a module has nothing inside
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
        module, _, _ = part.target.partition(":")
        if part.kind == kind and is_present(module):
            built_ins[part.name] = part
    return built_ins
