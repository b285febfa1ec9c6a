"""Hardening: the split, what is trained, the training, and the data set; without renders but for one scene."""

import gc
import json
import shutil
import tarfile
import weakref
from importlib import resources
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from advsearch.attacks import Block, Domain
from advsearch.engine.loading import load_scene
from advsearch.errors import InputError
from advsearch.models import load_model
from advsearch.questions.attack.carry_out import make_problem_on
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.harden.carry_out import make_share
from advsearch.questions.harden.lessons import (
    IMAGE_DIRECTORY,
    Lesson,
    RenderedLesson,
    TextureLesson,
    make_lessons,
    negative_log_likelihood,
    save_lesson_images,
    search_worse_images,
)
from advsearch.questions.harden.networks import Trainable, make_trainable, open_single_threaded_pool
from advsearch.questions.harden.result import HardenConfig, TrainingRound
from advsearch.questions.harden.rounds import Rounds, Score
from advsearch.questions.harden.scenes import (
    HELD_OUT,
    TRAINING,
    SceneJobs,
    SceneSplit,
    check_disjoint,
    check_not_held_out,
    compute_fingerprint,
)
from advsearch.questions.harden.training import ClassifierTrainer, GradientComputer
from advsearch.runs.directory import RunDirectory
from advsearch.scene.color import round_to_8_bit, to_uint8
from advsearch.statistics.intervals import clopper_pearson
from small_models import Colours

pytestmark = pytest.mark.island("advsearch.questions.harden")

LABELS = [f"class {number}" for number in range(14)]


def student(layers: str = "all") -> Trainable:
    return make_trainable(load_model(Colours(), labels=LABELS, input_size=16), layers)


def course_of(made: Trainable, *given: Any, **settings: Any) -> ClassifierTrainer:
    return ClassifierTrainer(SceneJobs(HardenConfig(**settings), student().model, {}), made, *given)


def coloured(right: int, level: float, seed: int) -> Tensor:
    """A noisy picture whose red is the class's own."""
    picture = 0.3 + 0.1 * torch.rand((16, 16, 3), generator=torch.Generator().manual_seed(seed))
    picture[..., right] += level
    return picture


def pupils() -> list[Lesson]:
    """Three classes by their brightest channel, of which the worst pictures show little."""
    worst = [coloured(n % 3, 0.2, 99 + n) for n in range(24)]
    return [RenderedLesson.create((n % 3,), coloured(n % 3, 0.4, n), one[None]) for n, one in enumerate(worst)]


@pytest.mark.medium
def test_scenes_repeat_and_splits_share_nothing(tmp_path: Path) -> None:
    bundled = Path(str(resources.files("advsearch.bundled")))
    training = SceneSplit(TRAINING, ("ball", "book"), ("noon", "studio"), 1)
    held = SceneSplit(HELD_OUT, ("ball", "book"), ("gallery",), 2)
    name, scene = training.load_scene(1)
    assert (name, scene.description.object.label) == ("book", "book")
    assert repr(training.load_scene(1)[1]) == repr(scene)
    assert training.load_scene(1, {"camera.fov": 30.0})[1].description.get_number("camera.fov") == 30.0
    file = shutil.copy(bundled / "data" / "objects" / "ball" / "mesh.ply", tmp_path / "tennis-ball.ply")
    mine = SceneSplit(TRAINING, (str(file),), ("noon",), 1).load_scene(0)[1]
    assert mine.description.object.label == "tennis ball"
    check_disjoint(held, [training])
    again = SceneSplit(TRAINING, held.objects, ("noon",), 2)
    own, other = (one.load_scene(0)[1].description.object for one in (held, again))
    assert (
        compute_fingerprint(next(again.generate_objects(1)))
        == compute_fingerprint(other)
        != compute_fingerprint(own)
        == compute_fingerprint(next(held.generate_objects(1)))
    )
    check_not_held_out(other, {compute_fingerprint(own)})  # seeds of splits differ by name
    with pytest.raises(InputError, match="held_out"):
        check_not_held_out(own, {compute_fingerprint(own)})
    files = [SceneSplit(name, (str(file),), (lit,), 1) for name, lit in ((HELD_OUT, "gallery"), (TRAINING, "noon"))]
    assert len(list(files[0].generate_objects(5))) == 1
    with pytest.raises(InputError, match="held_out_environment"):
        check_disjoint(SceneSplit(HELD_OUT, ("ball",), ("noon",), 2), [training])


def test_the_worst_of_what_was_rendered_is_that_of_the_model_as_it_is() -> None:
    model = student().model
    pictures = round_to_8_bit(torch.stack([coloured(0, level, 7) for level in (0.0, 0.3, 0.6)]))
    lesson = RenderedLesson.create((1,), pictures[0], pictures)
    other = RenderedLesson.create((2,), pictures[0], pictures[:2])
    search_worse_images([other, lesson], model)
    for one, right in ((lesson, (1,)), (other, (2,))):
        loss = negative_log_likelihood(model(one.images_uint8 / 255.0), [right] * len(one.images_uint8))
        assert torch.equal(one.worst_image, pictures[int(loss.argmax())]) and one.images_uint8.dtype == torch.uint8
    both = negative_log_likelihood(torch.tensor([[1.0, 1.0, 1.0, 1.0]]), [(0, 2)])
    assert both.item() == pytest.approx(0.6931, abs=1e-3)


def test_a_round_teaches_plain_and_worst_pictures() -> None:
    made, lessons = student(), pupils()
    ticks: list[int] = []
    course = course_of(made, rate=0.04, epochs=12)
    before = course.evaluate_student(lessons)
    course.train_round(1, lessons, tick=lambda: ticks.append(1))
    after = course.evaluate_student(lessons)
    assert len(ticks) == course.count_steps(lessons) == 12
    more = [Lesson((5,), to_uint8(coloured(0, 0.4, 1)))] * 24  # nothing makes them harder
    assert course.evaluate_student([*lessons, *more]) == Score(after.clean / 2, after.robust)
    assert before.robust < 0.6 and after.clean >= 0.9 and after.robust >= 0.9


@pytest.mark.parametrize(("clean_loss", "best"), [(0.0, 0), (0.02, 2), (0.1, 1)])
def test_the_weights_that_are_kept_lose_no_more_plain_pictures_than_they_may(clean_loss: float, best: int) -> None:
    scores = ((0.9, 0.1), (0.82, 0.9), (0.89, 0.5))
    done = [
        TrainingRound(lessons=1, part=1.0, clean=clean, robust=robust, is_selected=False) for clean, robust in scores
    ]
    noted = json.dumps([one.model_dump() for one in done])
    run: Any = SimpleNamespace(store=SimpleNamespace(read_note=lambda key: noted), path=Path())
    assert Rounds(run, course_of(student(), clean_loss=clean_loss)).best_round_number == best


class Tinted(TextureLesson):
    """A picture whose texture is its tint."""

    def compute_image(self, u: Tensor) -> Tensor:
        return (self.plain_image + 0.2 * (u - 0.5)).clamp(0.0, 1.0)


def tinted(number: int) -> TextureLesson:
    nothing: Any = None
    domain, levels = Domain(torch.full((3,), 0.5), (Block(3),)), to_uint8(coloured(number % 3, 0.3, number))
    return Tinted((number % 3,), levels, nothing, domain, nothing, nothing, torch.full((3,), 0.5))


def test_worst_textures_are_trained_on_as_their_search_saw_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """An adversarial texture is adversarial for the crop, turn and colours that it was searched under."""
    seen = list[tuple[list[int], int, bool]]()
    textured, rendered = [tinted(number) for number in range(9)], pupils()[:15]
    batch = [one for pair in zip(rendered, [*textured, *rendered[9:]], strict=False) for one in pair][:24]

    def changed(images: Tensor, seed: int) -> Tensor:
        owners = [
            number
            for image in images.detach()
            for number, one in enumerate(textured)
            if torch.equal(image, one.compute_image(one.texture).detach() if images.requires_grad else one.worst_image)
        ]
        if len(owners) == len(images):
            seen.append((owners, seed, images.requires_grad))
        return images

    monkeypatch.setattr("advsearch.questions.harden.training._augment", changed)
    made = student()
    with open_single_threaded_pool() as pool:
        GradientComputer(made, student().model, pool).compute(batch, None, 7)
    searched = sorted(one[:2] for one in seen if one[2])
    trained = sorted(one[:2] for one in seen if not one[2])
    assert sum(len(owners) for owners, _ in searched) == 9 and searched == trained


def test_lessons_that_judge_are_left_as_they_are() -> None:
    """Worse textures and pictures are searched in copies of them."""
    textured = [tinted(number) for number in range(3)]
    pictures = torch.stack([coloured(0, level, 7) for level in (0.0, 0.3)])
    rendered = RenderedLesson.create((1,), pictures[0], pictures)
    course_of(student()).evaluate_student([*textured, rendered])
    assert all(torch.equal(one.texture, torch.full((3,), 0.5)) for one in textured)
    assert rendered.losses.isinf().all()


def test_pictures_are_a_folder_for_each_class_and_a_webdataset(tmp_path: Path) -> None:
    with RunDirectory.create(tmp_path / "run") as run:
        save_lesson_images(run, 1, pupils()[:2], ["wine glass", "mug"])
    pictures = tmp_path / "run" / IMAGE_DIRECTORY
    assert sorted(one.relative_to(pictures).as_posix() for one in pictures.glob("*/*")) == [
        "0000-wine-glass/001-00000-plain.png",
        "0000-wine-glass/001-00000-worst.png",
        "0001-mug/001-00001-plain.png",
        "0001-mug/001-00001-worst.png",
    ]
    with tarfile.open(pictures.with_suffix(".tar")) as tar:
        names = tar.getnames()
        assert [name.rpartition(".")[2] for name in names] == ["png", "cls", "json"] * 4
        assert len({name.partition(".")[0] for name in names}) == 4
        last = tar.extractfile(names[-1])
        assert last is not None and json.loads(last.read()) == {"class": 1, "kind": "worst"}


def test_the_interval_of_plain_pictures_is_over_scenes_whose_views_are_alike() -> None:
    rng, covered, runs = np.random.default_rng(0), 0, 300
    for _ in range(runs):
        share = make_share(np.repeat(rng.random(56) < 0.85, 2).tolist(), views=2)
        assert share is not None and share.count == 112
        covered += share.interval[0] <= 0.85 <= share.interval[1]
    assert covered >= 0.94 * runs
    alone = make_share([True] * 9 + [False])
    assert alone is not None and alone.interval == clopper_pearson(9, 10)


def test_lessons_of_textures_let_go_of_their_scene() -> None:
    """There are hundreds of them; what is left says the pictures, and takes no renderer."""
    settings = {"resolution": (16, 16), "controls": {"texture": {"resolution": 4}}}
    config = AttackConfig(object="mug", **settings, over={"camera": {}, "environment": {}}, measure="no")
    model = load_model("reference")
    problem = make_problem_on(config, load_scene("mug"), model)
    (lesson,), plain = make_lessons(problem, 1, 0), [Lesson((0,), torch.zeros((16, 16, 3), dtype=torch.uint8))]
    scene = weakref.ref(problem.renderer.scene)
    del problem
    gc.collect()
    assert scene() is None and isinstance(lesson, TextureLesson)
    search_worse_images([lesson], model, 2)
    assert lesson.worst_image.shape == (16, 16, 3) and not torch.equal(lesson.worst_image, lesson.plain_image)
    for views, steps in ((6, 2), (2, 2), (1, 4)):  # of 24 pictures, in two epochs: 20 plain ones, and 6 / views of this
        assert course_of(student(), epochs=2, views=views).count_steps([lesson, *plain * 20]) == steps
