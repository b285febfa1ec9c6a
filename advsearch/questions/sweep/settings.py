"""The settings of `sweep`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import field_validator

from advsearch.config import ControlsByName, DerivativeConfig, RenderConfig, SceneConfig
from advsearch.files import MESHES, join_alternatives
from advsearch.options import MITSUBA_CONTROL
from advsearch.questions.attack.settings import MIN_TRIALS, AttackConfig
from advsearch.settings import (
    Clash,
    parse_number_or_text,
    setting,
    setting_as_in,
    split_names,
    unique_names_validator,
)

if TYPE_CHECKING:
    from advsearch.controls import Control, Parameter

BLIND = {
    "black": "the picture is black",
    "covered": "the camera is covered (one even colour, the picture's mean)",
    "away": "the object is taken away",
}
"""Changes after which nothing of the object is visible. A model that looks at the
object predicts something else then.
"""

HARMLESS = {
    "exposure": "the exposure is a third of a stop higher",
    "shift": "the picture moves by one pixel to the right",
    "jpeg": "the picture is a JPEG file of quality 95",
}
"""Changes that have no meaning, after which the prediction should be the same."""
Grid = dict[str, object]  # values of each parameter of the grid, or a range of them
# Both commands have these settings, but a sweep has its own values of them.
SETTINGS_NOT_OF_ATTACK = (
    "controls",
    "texture_resolution",
    "spp",
    "seed",
    "threads",
    "deterministic",
)


class SweepConfig(SceneConfig):
    """The settings of `sweep`: the average case over a grid, random draws, or both."""

    command: ClassVar[str] = "sweep"
    blind_changes: ClassVar[Mapping[str, str]] = BLIND
    harmless_changes: ClassVar[Mapping[str, str]] = HARMLESS
    changeable_settings: ClassVar[tuple[str, ...]] = (
        *SceneConfig.changeable_settings,
        "surface",
        "workers",
        "cluster",
        "log",
        "twins",
    )
    list_settings: ClassVar[tuple[str, ...]] = ("object", "environment", "model")
    clashes: ClassVar[tuple[Clash, ...]] = (
        *SceneConfig.clashes,
        Clash(
            "sampler",
            lambda config: not config.controls,
            "is how `controls` are drawn, and none are; add `controls`, or leave "
            "`sampler` out",
        ),
        Clash(
            "fps",
            lambda config: config.path is None,
            "is of a drive; add `path`, or leave `fps` out",
        ),
        Clash(
            "verify_spp",
            lambda config: config.trials == 0,
            "is of the trials, and `trials` is 0; leave one of the two out",
        ),
    )

    object: str = setting_as_in(
        SceneConfig,
        "object",
        description="the object that the model should "
        "recognise; several, separated by commas",
        expects=f"names of objects or {join_alternatives(MESHES)} files",
    )
    environment: str | None = setting_as_in(
        SceneConfig,
        "environment",
        description="the environment map that lights the scene; several, separated by "
        "commas",
        expects="names of environments or .hdr or .exr files",
    )
    model: str = setting_as_in(
        SceneConfig,
        "model",
        description="the network under test; several, separated by commas, are run on "
        "the same pictures",
    )
    grid: Grid = setting(
        dict,
        "sweep",
        "one axis of the grid; may be repeated",
        "PARAMETER=FIRST:LAST:COUNT, or values separated by commas",
        metavar="PARAMETER=VALUES",
    )
    controls: ControlsByName = setting_as_in(
        SceneConfig,
        "controls",
        default=dict,
        group="sweep",
        description="controls that are drawn at random at each grid point, separated "
        "by commas",
        min_length=None,
    )

    adversarial_of: str | None = setting(
        None,
        "sweep",
        "sweep the adversarial scene of this attack as well as the clean scene, with "
        "the same draws; scene and model are those of that run, and if nothing else "
        "varies, so is what its --over varied",
        "the name or the folder of a run",
        metavar="RUN",
        otherwise="none",
        min_length=1,
    )
    samples: int | None = setting(
        None,
        "sweep",
        "number of random draws at each grid point",
        otherwise="1, or 100 without a grid",
        ge=1,
        le=1_000_000_000,
    )
    sampler: Literal["sobol", "random"] = setting(
        "sobol",
        "sweep",
        "how values are sampled: evenly spread, or independently",
    )
    batch: int = setting(
        16,
        "sweep",
        "number of pictures that are classified and stored together",
        unit="pictures",
        ge=1,
        le=1024,
    )
    path: str | None = setting_as_in(
        AttackConfig,
        "path",
        group="sweep",
        description="sweep the frames of a drive, in which camera or object travel "
        "along this path",
        otherwise="no path",
    )
    shutter: float | None = setting_as_in(AttackConfig, "shutter", group="sweep")
    rolling: float | None = setting_as_in(AttackConfig, "rolling", group="sweep")
    fps: float = setting(
        2.0,
        "sweep",
        "number of frames per second of the drive",
        unit="frames a second",
        gt=0.0,
        le=1000.0,
    )
    keep_pictures: Literal["all", "wrong", "none"] = setting(
        "none", "sweep", "store small pictures of these predictions"
    )
    specialise: bool = setting_as_in(
        DerivativeConfig,
        "specialise",
        group="sweep",
        description="predict pictures that differ in light alone",
        switched="render every picture, also those that differ in light alone",
    )
    aov: str | None = setting_as_in(
        RenderConfig,
        "aov",
        group="sweep",
        description="write ground truth of each pixel, names separated by commas, as "
        "layers of an EXR, for every "
        "configuration",
    )
    must_change: str | None = setting(
        None,
        "sweep",
        "repeat each prediction with the picture black, covered (one even colour) or "
        "without the object, and count how often it changes, as it must",
        f"names among {', '.join(BLIND)}, separated by commas",
        otherwise="none",
    )
    must_not_change: str | None = setting(
        None,
        "sweep",
        "repeat each prediction with a third of a stop more exposure, a shift by one "
        "pixel or as a JPEG file, and count how often it stays the same, as it must",
        f"names among {', '.join(HARMLESS)}, separated by commas",
        otherwise="none",
    )
    surface: bool = setting(
        False,
        "sweep",
        "map which parts of the object's surface, when visible, go "
        "with wrong predictions",
    )
    spp: int | None = setting_as_in(
        SceneConfig,
        "spp",
        group="sweep",
        description="samples per pixel of each picture",
        expects="",
        ge=1,
        le=65536,
    )
    trials: int = setting(
        20,
        "verification",
        "number of fresh renders that verify the worst configuration; 0 for none",
        f"0, or a whole number from {MIN_TRIALS} to 100000",
        unit="renders",
        ge=0,
        le=100_000,
    )
    verify_spp: int | None = setting_as_in(
        AttackConfig, "verify_spp", description="samples per pixel of these trials"
    )
    run: str | None = setting_as_in(
        SceneConfig, "run", otherwise="runs/OBJECT-sweep-NNN"
    )
    metrics: dict[str, str] = setting_as_in(AttackConfig, "metrics")
    log: Literal["mlflow", "tensorboard", "wandb"] | None = setting_as_in(
        AttackConfig, "log"
    )
    twins: str | None = setting_as_in(AttackConfig, "twins")
    workers: int | None = setting_as_in(
        AttackConfig,
        "workers",
        description="worker processes that share the sweep, each with one thread "
        "unless `threads` says more",
    )
    cluster: str | None = setting_as_in(AttackConfig, "cluster")

    _changes = unique_names_validator("must_change", "must_not_change")

    @property
    def claims(self) -> tuple[tuple[str, str], ...]:
        """The claims about changed images, such as ``("must_change", "black")``."""
        changes_by_claim = {
            "must_change": self.must_change,
            "must_not_change": self.must_not_change,
        }
        claims = list[tuple[str, str]]()
        for claim, changes in changes_by_claim.items():
            if changes:
                claims += [(claim, change) for change in split_names(changes)]
        return tuple(claims)

    @field_validator("must_change", "must_not_change")
    @classmethod
    def _check_changes(cls, value: str | None, info: Any) -> str | None:
        known = BLIND if info.field_name == "must_change" else HARMLESS
        if value is not None and not set(split_names(value)) <= set(known):
            raise ValueError("no such change")
        return value

    @property
    def run_name_words(self) -> tuple[str, ...]:
        return "-".join(Path(name).stem for name in self.objects), self.command

    @property
    def environments(self) -> tuple[str, ...]:
        return split_names(self.environment_name)

    def find_control_type(self, instance: str) -> type[Control] | None:
        """Return the class of a control by its name; None if there is none.

        The kind is stated in the settings of the control, or else is its name. A name
        may be ``KIND:INSTANCE``.

        Args:
            instance: name of the control.
        """
        from advsearch.controls import CONTROLS  # imports torch

        control_settings = self.controls.get(instance, {})
        kind = str(control_settings.get("kind", instance))
        if kind not in CONTROLS:  # such as "light:key"
            kind = kind.partition(":")[0]
        return CONTROLS.get(kind)

    def declared_parameters(self, instance: str) -> dict[str, Parameter] | None:
        """Return the parameters that a control declares, by name.

        None if the scene declares them.
        """
        control_type = self.find_control_type(instance)
        if control_type is None or control_type.kind == MITSUBA_CONTROL:
            return None
        declared = control_type.declare_parameters(self.controls.get(instance, {}))
        return {parameter.name: parameter for parameter in declared}

    @classmethod
    def load_attack_defaults(
        cls, file: Path, stated_settings: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Return the settings that a sweep takes from the attack of `adversarial_of`.

        If the sweep does not state what varies, the controls are those that varied at
        random in the attack (its setting `over`).

        Args:
            file: `run.yaml` of the attack.
            stated_settings: settings that the sweep itself states, by name.
        """
        attack_config = AttackConfig.from_yaml(file)
        settings = {
            name: value
            for name, value in cls.get_shared_settings(attack_config).items()
            if name not in SETTINGS_NOT_OF_ATTACK
        }
        has_grid = bool(stated_settings.get("grid"))
        has_controls = bool(stated_settings.get("controls"))
        if not has_grid and not has_controls:
            # What the attack searched is fixed; its random conditions vary here.
            settings["controls"] = attack_config.over
        return settings

    @field_validator("adversarial_of", mode="before")
    @classmethod
    def _convert_path_to_text(cls, value: Any) -> Any:
        return str(value) if isinstance(value, Path) else value

    @field_validator("trials")
    @classmethod
    def _check_trials(cls, value: int) -> int:
        if 0 < value < MIN_TRIALS:
            raise ValueError("too few to verify anything")
        return value

    @field_validator("grid", mode="before")
    @classmethod
    def _parse_grid(cls, value: Any) -> Any:
        """Accept any sequence of values from Python (a range, an array), and ``a,b,c``.

        FIRST:LAST:COUNT stays text.
        """
        if not isinstance(value, Mapping):
            return value
        return {str(name): _parse_axis(axis) for name, axis in value.items()}


def _parse_axis(axis: Any) -> str | list[Any]:
    """Return the values of an axis as a list, or FIRST:LAST:COUNT as text.

    Values are a list, text such as "1, 2" or "[1, 2]", an array, a single value, or a
    mapping {"choices": ...} of these, as controls take it. Arrays and their elements
    become Python's numbers.

    Raises:
        ValueError: there are no values, or some are lists, mappings, booleans or None.
    """
    if isinstance(axis, Mapping) and set(axis) == {"choices"}:
        axis = axis["choices"]
    if isinstance(axis, str):
        text = axis.strip().removeprefix("[").removesuffix("]")
        is_range = ":" in text and "," not in text
        if is_range:
            return text
        axis = [part.strip() for part in text.split(",") if part.strip()]
    values = _to_python_values(axis)
    are_invalid = any(
        value is None or isinstance(value, (bool, list, Mapping)) for value in values
    )
    if not values or are_invalid:
        raise ValueError("not values")
    return [parse_number_or_text(value) for value in values]


def _to_python_values(axis: Any) -> list[Any]:
    """Return an array, a sequence or a single value as a list of Python's values."""
    if hasattr(axis, "tolist"):  # an array of NumPy or PyTorch
        axis = axis.tolist()
    if not isinstance(axis, (range, tuple, list)):
        axis = [axis]
    return [value.item() if hasattr(value, "item") else value for value in axis]
