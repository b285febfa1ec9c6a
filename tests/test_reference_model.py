"""What makes the reference model: its training, its augmentation and the figures that are kept of it."""

from typing import Any

import pytest
import reference_calibration as calibration
import reference_training as training
import torch
from torch import Tensor

from advsearch.models import reference
from advsearch.questions.harden.networks import Augmentation

pytestmark = pytest.mark.island("advsearch.questions.harden")


def images(count: int = 2, height: int = 8, width: int = 8, seed: int = 0) -> Tensor:
    return torch.rand((count, height, width, 3), generator=torch.Generator().manual_seed(seed))


def _coloured(count: int, size: int = 32) -> tuple[Tensor, Tensor]:
    """Images whose class is the channel that is brightest, with noise: learnt in a few steps."""
    generator = torch.Generator().manual_seed(0)
    labels = torch.randint(0, 3, (count,), generator=generator)
    values = 60 + 60 * torch.rand((count, size, size, 3), generator=generator)
    values[torch.arange(count), :, :, labels] += 90
    return values.to(torch.uint8), labels


@pytest.mark.medium
def test_training_learns_and_repeats_bit_for_bit() -> None:
    data, labels = _coloured(64)
    plain = Augmentation(max_channel_change=0.02, brightness=0.05, contrast=0.1, cutout_probability=0.1)
    told: list[training.TrainingState] = []
    state = torch.random.get_rng_state()

    def run(array: Any) -> dict[str, Tensor]:
        return training.train(
            array, labels, classes=3, epochs=4, batch_size=16, lr=4e-3, seed=5, augmentation=plain, average_decay=0.8,
            bfloat16=False, progress=told.append,
        )  # fmt: skip

    first, second = run(data), run(data.numpy())
    assert torch.equal(state, torch.random.get_rng_state())
    assert all(torch.equal(value, second[key]) for key, value in first.items())
    net = reference.build(3).eval()
    net.load_state_dict(first)
    assert calibration.evaluate(lambda x: net(x.permute(0, 3, 1, 2)), data, labels).accuracy > 0.95
    assert told[15].loss < told[0].loss
    assert len(told) == 32 and told[15].step == told[15].steps == 16 and told[15].seconds_left == 0.0


def test_augmentation_is_seeded_bounded_and_leaves_its_input_alone() -> None:
    batch = images(32, 24, 24).permute(0, 3, 1, 2)
    before = batch.clone()
    generator = torch.Generator()
    first = Augmentation()(batch, generator.manual_seed(1))
    assert torch.equal(batch, before) and first.shape == batch.shape
    assert float(first.min()) >= 0.0 and float(first.max()) <= 1.0
    assert torch.equal(first, Augmentation()(batch, generator.manual_seed(1)))
    assert not torch.equal(first, Augmentation()(batch, generator.manual_seed(2)))
    still = Augmentation(0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    torch.testing.assert_close(still(batch, generator), batch, rtol=0, atol=1e-5)
    mirrored = Augmentation(1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)(batch, generator)
    torch.testing.assert_close(mirrored, batch.flip(3), rtol=0, atol=1e-5)


@pytest.mark.parametrize("temperature", [0.5, 1.0, 3.0])
def test_temperature_is_recovered(temperature: float) -> None:
    generator = torch.Generator().manual_seed(0)
    logits = 2 * torch.randn((20_000, 4), generator=generator)
    labels = torch.multinomial(logits.softmax(1), 1, generator=generator)[:, 0]
    # 20,000 samples leave about 1.5 % of sampling error
    assert calibration.fit_temperature(logits * temperature, labels) == pytest.approx(temperature, rel=0.06)
