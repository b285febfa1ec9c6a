"""The denoiser: its bytes do not depend on the number of threads, and its brightness is what it would find itself."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import torch
from torch import Tensor

from advsearch import threads
from advsearch.scene.mitsuba_backend.denoise import _compute_gain, _get_buffers, denoise
from advsearch.scene.mitsuba_backend.variant import import_mitsuba

SIZE = (72, 88)


def noisy(seed: int) -> Tensor:
    """Radiance over three orders of magnitude, with noise."""
    generator = torch.Generator().manual_seed(seed)
    slope = torch.logspace(-2.0, 1.0, SIZE[1]).expand(SIZE)[..., None]
    return slope * -torch.log(torch.rand(*SIZE, 3, generator=generator).clamp_min(1e-6))


@contextmanager
def on(count: int) -> Iterator[None]:
    """A number of threads within the block."""
    threads.configure(count)
    try:
        yield
    finally:
        threads.configure()


@pytest.mark.medium
def test_the_same_bytes_at_any_number_of_threads() -> None:
    import_mitsuba()
    flat = torch.full((*SIZE, 3), 0.5)
    pictures = [noisy(seed) for seed in range(4)]
    found = []
    for count in (1, 2, 3):
        with on(count):
            found.append(torch.stack([denoise(one, flat, flat) for one in pictures]))
    assert torch.equal(found[0], found[1]) and torch.equal(found[0], found[2])


def test_the_brightness_is_what_the_denoiser_finds_itself() -> None:
    import_mitsuba()
    import mitsuba_oidn

    picture, flat = noisy(5), torch.full((*SIZE, 3), 0.5)
    own = mitsuba_oidn.denoise(picture, flat, flat, hdr=True)
    assert torch.allclose(denoise(picture, flat, flat), own, rtol=1e-4, atol=1e-5)
    apart = mitsuba_oidn.denoise(picture, flat, flat, hdr=True, input_scale=1.1 * _compute_gain(picture))
    assert not torch.allclose(apart, own, rtol=1e-4, atol=1e-5), "else the brightness decides nothing here"


def test_pictures_of_a_size_are_denoised_in_the_same_memory_and_spoil_nothing() -> None:
    import_mitsuba()
    flat = torch.full((*SIZE, 3), 0.5)
    first = denoise(noisy(1), flat, flat)
    kept, second = first.clone(), denoise(noisy(2), flat, flat)
    assert torch.equal(first, kept) and not torch.equal(first, second)
    own, other = _get_buffers(SIZE, 1), _get_buffers(SIZE, 2)
    assert own is _get_buffers(SIZE, 1) and own[0].data_ptr() != other[0].data_ptr()
