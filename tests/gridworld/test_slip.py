"""The model of slips: its draws, and its expected values beside many of them."""

import numpy as np
import pytest

from skills.errors import BadSettings
from skills.gridworld.slip import STEADY, SlipModel, slip_model, slip_of_elsewhere


def test_the_same_seed_gives_the_same_slips_and_more_slip_adds_to_them():
    few, many = (slip_model(slip).draw(runs=50, moves=20, seed=7) for slip in (0.1, 0.4))
    assert few.tobytes() == slip_model(0.1).draw(runs=50, moves=20, seed=7).tobytes()
    assert few.tobytes() != slip_model(0.1).draw(runs=50, moves=20, seed=8).tobytes()
    slipped = few != STEADY
    assert (few[slipped] == many[slipped]).all()
    assert 0 < slipped.sum() < (many != STEADY).sum()


def test_no_slip_is_always_steady_and_full_slip_draws_27_moves_uniformly():
    assert (slip_model(0.0).draw(runs=10, moves=10, seed=0) == STEADY).all()
    drawn = np.bincount(slip_model(1.0).draw(runs=270, moves=1000, seed=0).ravel(), minlength=27)
    assert drawn.sum() == 270_000
    assert np.abs(drawn - 10_000).max() < 500  # five standard deviations


@pytest.mark.parametrize("slip", [-0.1, 1.1, float("nan")])
def test_a_slip_that_is_no_probability_is_refused(slip):
    with pytest.raises(BadSettings, match="probability"):
        slip_model(slip)


@pytest.mark.parametrize("drawn", [np.full(27, 0.1), np.append(np.full(26, 1 / 13), -1.0)])
def test_moves_that_are_drawn_with_no_probabilities_are_refused(drawn):
    with pytest.raises(BadSettings, match="sum 1"):
        SlipModel(0.1, drawn)


@pytest.mark.parametrize(("runs", "moves", "seed"), [(0, 1, 0), (1, 0, 0), (1, 1, -1)])
def test_slips_of_nothing_are_refused(runs, moves, seed):
    with pytest.raises(BadSettings, match="at least one run"):
        slip_model(0.1).draw(runs=runs, moves=moves, seed=seed)


def unlike(probability):
    """Return a model in which some moves are likelier than others if a move slips."""
    return SlipModel(probability, np.arange(1, 28) / 378)


@pytest.mark.parametrize("model", [slip_model(0.3), unlike(0.3)], ids=["uniform", "unlike"])
def test_expected_values_and_their_logarithms_are_those_of_many_draws(model):
    worth, intended = np.linspace(0.1, 2.0, 27), 4
    drawn = model.draw(runs=1000, moves=1000, seed=1)
    mean = worth[np.where(drawn == STEADY, intended, drawn)].mean()
    expected = model.expected(worth[[intended]], worth[:, None])[0]
    assert expected == pytest.approx(mean, abs=0.005)
    assert np.exp(model.log_expected(np.log(worth[[intended]]), np.log(worth)[:, None])) == pytest.approx(expected)


def test_the_share_of_moves_that_end_elsewhere_gives_the_slip():
    drawn = slip_model(0.4).draw(runs=1000, moves=1000, seed=2)
    assert slip_of_elsewhere(float(((drawn != STEADY) & (drawn != 13)).mean())) == pytest.approx(0.4, abs=0.005)
