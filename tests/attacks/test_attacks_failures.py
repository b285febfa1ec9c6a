"""Which of many failures are listed: the worst, then whatever is farthest from all that are listed."""

import torch

from advsearch.attacks.candidates import select_diverse

LINE = torch.tensor([[0.0], [0.1], [0.5], [0.9]])
NUMBER = torch.tensor([False])
YES = torch.tensor([True])


def test_the_worst_is_first_and_then_the_farthest() -> None:
    assert select_diverse(LINE, [1.0, 4.0, 2.0, 3.0], NUMBER, NUMBER) == [1, 3, 2, 0]


def test_the_ends_of_an_angle_are_neighbours() -> None:
    assert select_diverse(LINE, [4.0, 1.0, 2.0, 3.0], YES, NUMBER, limit=2) == [0, 2]


def test_options_are_equally_far_apart_and_the_worse_goes_first() -> None:
    assert select_diverse(LINE, [4.0, 1.0, 2.0, 3.0], NUMBER, YES) == [0, 3, 2, 1]


def test_there_are_no_more_than_there_are() -> None:
    assert select_diverse(torch.empty(0, 1), [], NUMBER, NUMBER) == []
