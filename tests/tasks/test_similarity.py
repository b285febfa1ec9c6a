"""Similarity: features as the library's own pipeline gives them, references in folders, ranks, distances."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image
from torch import Tensor, nn

import advsearch
from advsearch.attacks.objective_functions import NEARBY
from advsearch.attacks.objectives import get_objective
from advsearch.cli.main import main
from advsearch.errors import AdvsearchError, InputError
from advsearch.models import Model
from advsearch.runs.files import read_png, to_8bit
from advsearch.tasks import Facts
from advsearch.tasks.similarity import ITSELF, SOMETHING_ELSE, TEMPERATURE, Similarity
from small_models import SIDE, save_exported

pytestmark = pytest.mark.island("advsearch.tasks.similarity")

COLOURS = {"blue": (0.2, 0.3, 0.9), "green": (0.2, 0.8, 0.3), "red": (0.9, 0.2, 0.2)}
NAMES = tuple(COLOURS)


class Embedder(nn.Module):
    """Features (N, 12) of the mean colours of four squares; smooth."""

    def __init__(self) -> None:
        super().__init__()
        weights = torch.randn((12, 12), generator=torch.Generator().manual_seed(1))
        self.weights = nn.Parameter(weights / 3)

    def forward(self, x: Tensor) -> Tensor:
        squares = nn.functional.adaptive_avg_pool2d(x - 0.5, 2).flatten(1)
        return (squares @ self.weights).tanh()


class Banded(nn.Module):
    """Features (N, 4) of the hue in the middle, where the bundled mug has a blue band and the bowl has none."""

    def forward(self, x: Tensor) -> Tensor:
        colour = x[:, :, 15:21, 8:22].mean(dim=(2, 3))
        hue = 4.0 * (colour - colour.mean(dim=1, keepdim=True))
        return torch.cat([hue, torch.full_like(hue[:, :1], 0.3)], dim=1)


def write(path: Path, picture: Tensor, **more: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(to_8bit(picture)).save(path, **more)
    return path


def noisy(colour: tuple[float, float, float], seed: int, size: tuple[int, int] = (8, 8)) -> Tensor:
    noise = torch.rand((*size, 3), generator=torch.Generator().manual_seed(seed))
    return (torch.tensor(colour) + 0.4 * (noise - 0.5)).clamp(0.0, 1.0)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three names; red has a picture more than the others, and one file is a link."""
    for seed, (name, colour) in enumerate(COLOURS.items()):
        for number in range(4 if name == "red" else 3):
            write(tmp_path / "refs" / name / f"{number}.png", noisy(colour, 10 * seed + number))
    (tmp_path / "refs" / "blue" / "9.png").symlink_to(tmp_path / "refs" / "blue" / "0.png")
    (tmp_path / "refs" / "blue" / ".hidden").write_text("no picture")
    return tmp_path / "refs"


@pytest.fixture
def model() -> Model:
    return advsearch.load_model(Embedder(), task="similarity", input_size=8, name="embedder")


def own_pictures(folder: Path, name: str) -> Tensor:
    return torch.stack([torch.from_numpy(read_png(one)) for one in sorted((folder / name).glob("*.png"))])


def features(model: Model, pictures: Tensor) -> Tensor:
    return nn.functional.normalize(model(pictures), dim=1)


transformers = pytest.importorskip("transformers", reason="transformers is not installed: advsearch[hf]")
SIZES = {"hidden_size": 8, "num_hidden_layers": 1, "num_attention_heads": 2, "intermediate_size": 8}
EYES = {**SIZES, "image_size": 16, "patch_size": 8}


def published(folder: Path, architecture: str) -> str:
    """A tiny network with random weights and its processor, as `save_pretrained` writes them."""
    kind = getattr(transformers, architecture)
    given: dict[str, Any] = dict(EYES)
    if architecture == "CLIPModel":
        given = {"vision_config": EYES, "text_config": {**SIZES, "vocab_size": 9}, "projection_dim": 6}
    torch.manual_seed(0)
    network = kind(kind.config_class(**given))
    for parameter in network.parameters():
        if parameter.dim() > 1:
            nn.init.normal_(parameter, std=0.3)
    network.save_pretrained(folder)
    size = {"height": 16, "width": 16}
    transformers.ViTImageProcessor(size=size, image_mean=[0.4] * 3, image_std=[0.3] * 3).save_pretrained(folder)
    return f"hf:{folder}"


OWN = {
    "Dinov2Model": lambda network, given: network(given).pooler_output,
    "CLIPModel": lambda network, given: network.get_image_features(given).pooler_output,
    "CLIPVisionModelWithProjection": lambda network, given: network(given).image_embeds,
    "ViTForImageClassification": lambda network, given: network.vit(given).last_hidden_state[:, 0],
}
"""How the library itself says what the features of a picture are."""


@pytest.mark.island("advsearch.models.zoo")
@pytest.mark.parametrize("architecture", OWN)
def test_features_are_those_of_the_librarys_own_pipeline(architecture: str, tmp_path: Path) -> None:
    spec = published(tmp_path / "net", architecture)
    picture = torch.rand((16, 16, 3), generator=torch.Generator().manual_seed(3))
    file = write(tmp_path / "picture.png", picture)
    loaded = advsearch.load_model(spec, task="similarity")
    processor = transformers.AutoImageProcessor.from_pretrained(tmp_path / "net")
    network = getattr(transformers, architecture).from_pretrained(tmp_path / "net").eval()
    with torch.no_grad(), Image.open(file) as image:
        theirs = OWN[architecture](network, processor(images=image, return_tensors="pt")["pixel_values"])
        ours = loaded(torch.from_numpy(read_png(file)))
    assert loaded.labels == () and float(theirs.std()) > 0.05
    torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=0.0)
    again = advsearch.load_model(network, task="similarity")  # from Python, as it is
    torch.testing.assert_close(again(torch.from_numpy(read_png(file))), theirs, atol=1e-4, rtol=0.0)


@pytest.mark.parametrize("k", [1, 2, 50])
def test_logits_are_the_mean_cosine_of_the_nearest_of_each_name(folder: Path, model: Model, k: int) -> None:
    task = Similarity(references=str(folder), k=k).on(model)
    asked = torch.stack([noisy(colour, 99) for colour in COLOURS.values()])
    expected = []
    for name in NAMES:
        cosines = features(model, asked) @ features(model, own_pictures(folder, name)).T
        expected.append(cosines.sort(dim=1, descending=True).values[:, :k].mean(dim=1))
    logits = task.compute_logits(model(asked))
    torch.testing.assert_close(logits, torch.stack(expected, dim=1) / TEMPERATURE)
    assert task.labels == NAMES and logits.argmax(dim=1).tolist() == [0, 1, 2]
    assert [first.label for first, *_ in task.predictions(model(asked), 2)] == list(NAMES)


def test_a_linear_head_is_the_minimum_of_its_loss_and_the_same_each_time(folder: Path, model: Model) -> None:
    task = Similarity(references=str(folder), method="linear").on(model)
    again = Similarity(references=str(folder), method="linear").on(model)
    assert task.gallery and task.gallery.linear_head and again.gallery and again.gallery.linear_head
    assert all(torch.equal(*both) for both in zip(task.gallery.linear_head, again.gallery.linear_head, strict=True))
    weights, biases = (one.double().requires_grad_() for one in task.gallery.linear_head)
    given, owners = task.gallery.features.double(), task.gallery.name_index
    shares = torch.stack([1.0 / (3 * (owners == one).sum()) for one in owners])
    each = nn.functional.cross_entropy(given @ weights.T + biases, owners, reduction="none")
    loss = (shares * each).sum() + 5e-4 * weights.square().sum()
    slopes = torch.autograd.grad(loss, (weights, biases))
    assert max(float(one.abs().max()) for one in slopes) < 1e-5
    asked = torch.stack([noisy(colour, 98) for colour in COLOURS.values()])
    assert task.compute_logits(model(asked)).argmax(dim=1).tolist() == [0, 1, 2]


def test_a_judgement_says_where_the_right_one_stands(folder: Path, model: Model) -> None:
    task = Similarity(references=str(folder)).on(model)
    blue, green = (noisy(COLOURS[name], 97) for name in ("blue", "green"))
    truth = task.truth(Facts("mug", label="blue"))
    right, wrong = task.judge(model(torch.stack([blue, green])), truth)
    assert task.gallery is not None
    cosines = task.gallery.compute_cosines(features(model, green[None]))[0]
    own = cosines[task.gallery.name_index == 0].max()
    assert right.right and right.payload["rank"] == right.payload["name_rank"] == 1  # type: ignore[index, call-overload]
    assert not wrong.right and wrong.prediction.label == "green"
    assert wrong.payload == {
        "rank": 1 + int((cosines > own).sum()),
        "references": 11,
        "cosine": round(float(own), 4),
        "name_rank": 2 if float(own) > float(cosines[task.gallery.name_index == 2].max()) else 3,
        "nearest": task.gallery.paths[int(cosines.argmax())],
        "nearest_cosine": round(float(cosines.max()), 4),
    }
    assert 1 < wrong.payload["rank"] <= 8  # type: ignore[operator]
    (broken,) = task.judge(torch.full((1, 12), torch.nan), truth)
    assert broken.is_non_finite and broken.payload is None


@pytest.mark.parametrize(
    ("objective", "options"),
    [("margin", {}), ("margin", {"k": 3}), ("margin", {"method": "linear"}), ("log_odds", {}), ("dlr", {"k": 3})],
)
def test_objectives_of_logits_have_a_true_gradient(
    folder: Path, model: Model, objective: str, options: dict[str, Any]
) -> None:
    task = Similarity(references=str(folder), **options).on(model)
    found, picture = get_objective(objective, task), noisy((0.5, 0.5, 0.6), 96).requires_grad_()
    (gradient,) = torch.autograd.grad(found(model(picture), picture[None], (0,)).sum(), picture)
    step = 2e-3 * gradient / gradient.norm()
    with torch.no_grad():
        ends = [float(found(model(one), one[None], (0,))) for one in (picture + step, picture - step)]
        value = float(found(model(picture), picture[None], (0,)))
    assert ends[0] - ends[1] == pytest.approx(2.0 * 2e-3 * float(gradient.norm()), rel=0.02)
    if objective == "margin":
        assert value == pytest.approx(-task.judge(model(picture.detach()), (0,))[0].margin)


def test_a_threshold_compares_with_the_clean_picture(model: Model) -> None:
    task = Similarity(threshold=0.8).on(model)
    clean, other = noisy(COLOURS["red"], 1), noisy(COLOURS["blue"], 1)
    assert task.calibrates and task.truth(Facts("mug", object_label="mug")) == (0,)
    with pytest.raises(InputError, match="a clean picture before other pictures"):
        task.judge(model(clean), (0,))
    task = task.after_calibration(model(clean), (0,))
    assert not task.calibrates and task.after_calibration(model(other), (0,)) is task
    same, different = task.judge(model(torch.stack([clean, other])), (0,))
    assert same.right and same.prediction.label == ITSELF and same.payload == {"cosine": 1.0}
    assert same.margin == pytest.approx((1.0 - 0.8) / TEMPERATURE, rel=1e-3)
    assert not different.right and different.prediction.label == SOMETHING_ELSE


def test_the_distance_is_one_minus_the_cosine_and_leads_away_from_the_start(model: Model) -> None:
    clean, other = noisy(COLOURS["red"], 1), noisy(COLOURS["blue"], 1)
    objective = get_objective("distance", Similarity(), features=model, clean=clean)
    cosine = float(features(model, clean[None])[0] @ features(model, other[None])[0])
    value = float(objective(model(other), other[None], (0,)))
    assert value == pytest.approx(1.0 - cosine, abs=2 * NEARBY)
    start = clean.clone().requires_grad_()
    (slope,) = torch.autograd.grad(objective(model(start), start[None], (0,)).sum(), start)
    with torch.no_grad():
        moved = clean + 0.01 * slope / slope.norm()
        assert float(objective(model(moved), moved[None], (0,))) > float(objective(model(clean), clean[None], (0,)))


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """References of the bundled mug and bowl, and a network as a file."""
    place = tmp_path_factory.mktemp("rendered")
    network = advsearch.load_model(Embedder(), task="similarity", input_size=SIDE)
    for name in ("mug", "bowl"):
        for view in advsearch.render(
            name, network, around=2, spp=2, denoise="none", task=Similarity(threshold=0)
        ).views:
            write(place / "refs" / name / f"{view.azimuth:.0f}.png", view.picture)
    save_exported(Banded(), place / "net.pt2")
    return place


SMALL = ["--spp", "2", "--verify-spp", "4", "--trials", "6", "--measure", "no", "--no-baseline"]


def typed(capsys: pytest.CaptureFixture[str], *command: str) -> dict[str, Any]:
    assert main([*command, "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


@pytest.mark.medium
@pytest.mark.parametrize("objective", ["margin", "distance"])
def test_an_attack_is_verified(
    rendered: Path, objective: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(rendered)
    flags = ["--task", "similarity={references: refs}", "--model", "net.pt2", "--objective", objective, *SMALL]
    run = tmp_path / "run"
    command = ["attack", "--object", "mug", *flags, "--epsilon", "0.5", "--run", str(run)]
    command += ["--steps", "16" if objective == "margin" else "6"]
    found = typed(capsys, *command)
    assert found["clean"]["correct"] and found["clean"]["payload"]["rank"] == 1
    assert found["ending"] == "found" and set(found["verified"]["labels"]) == {"bowl"}
    kept = found["adversarial"]["payload"]
    assert kept["rank"] > 1 and kept["references"] == 4 and kept["nearest"].startswith("bowl/")
    if objective == "margin":
        assert found["transport"]["used"]
        return
    write(rendered / "refs" / "bowl" / "more.png", torch.zeros(8, 8, 3))
    (run / "summary.json").unlink()
    try:
        assert main(["resume", str(run)]) == 2
    finally:
        (rendered / "refs" / "bowl" / "more.png").unlink()
    assert "cannot resume with something else than the run began with: refs;" in capsys.readouterr().err
    monkeypatch.chdir(tmp_path)
    assert typed(capsys, "resume", str(run))["verified"] == found["verified"]


@pytest.mark.medium
def test_a_sweep_counts_what_is_not_itself_any_more(
    rendered: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    flags = ["--task", "similarity={threshold: 0.9}", "--model", str(rendered / "net.pt2"), "--trials", "0"]
    flags += ["--grid", "camera.azimuth=40,220", "--spp", "2", "--denoise", "none"]
    found = typed(capsys, "sweep", "--object", "mug", *flags, "--run", str(tmp_path / "run"))
    assert (found["configurations"], found["correct"]) == (2, 1)
    assert found["worst"]["claimed"]["label"] == SOMETHING_ELSE and found["worst"]["claimed"]["payload"]["cosine"] < 0.9


def test_huge_and_many_references_are_refused(folder: Path, model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ADVSEARCH_LIMITS", "1e-6")  # 67 pixels
    write(folder / "red" / "0.png", torch.zeros(100, 100, 3))
    with pytest.raises(AdvsearchError, match="if you trust it"):
        Similarity(references=str(folder)).on(model)
