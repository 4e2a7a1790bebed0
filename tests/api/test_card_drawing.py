"""The drawing on a policy's card: every start of every layer in its category."""

import re

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from skills.api.pages import drawings
from skills.gridworld.grid import GridPath, GridWorld
from skills.learning.certificate import Coverage
from tests.by_day import examples


def path_in(shape: tuple[int, int, int]) -> GridPath:
    return GridPath(GridWorld((0.0, 0.0, 0.0), 5.0, shape), np.array([0, 1]))


def drawn(coverage: Coverage, path: GridPath) -> dict[str, float]:
    """Measure, in tiles, how much area of the layers each kind of start takes."""
    area = dict.fromkeys(drawings.KINDS, 0.0)
    for _, svg in drawings.layers(coverage, path):
        for kind, width in re.findall(r'<rect class="(?!edge)(\w+)" x="\d+" y="\d+" width="(\d+)" height="10"', svg):
            area[kind] += int(width) / drawings.TILE
    return area


@examples(50)
@given(st.tuples(*[st.integers(1, 5)] * 2, st.integers(2, 5)), st.randoms(use_true_random=False))
def test_every_start_is_drawn_as_what_it_is(shape: tuple[int, int, int], random):
    n = int(np.prod(shape))
    reaches = np.array([random.random() < 0.7 for _ in range(n)])
    joins = reaches & np.array([random.random() < 0.5 for _ in range(n)])
    share = np.array([random.choice((0.0, 0.25, 0.5, 1.0)) for _ in range(n)])
    path = path_in(shape)
    assert drawings.block_of(path) == 1
    assert drawn(Coverage(reaches, joins, share), path) == {
        "most": (joins & (share >= 0.5)).sum(),
        "part": (joins & (share == 0.25)).sum(),
        "alone": (joins & (share == 0)).sum(),
        "otherwise": (reaches & ~joins).sum(),
        "fails": (~reaches).sum(),
    }


def test_a_large_grid_is_drawn_in_blocks_that_hide_no_failure():
    shape = (80, 50, 30)
    reaches = np.ones(shape, bool)
    reaches[79, 49, 29] = reaches[40, 10, 0] = False
    path = path_in(shape)
    assert drawings.block_of(path) == 3
    share = np.ones(shape)
    share[0, 0, 0] = 0.0
    coverage = Coverage(reaches.ravel(), reaches.ravel(), share.ravel())
    assert drawn(coverage, path) == {"fails": 2, "otherwise": 0, "alone": 1, "part": 0, "most": 27 * 17 * 10 - 3}
    assert [name for name, _ in drawings.layers(coverage, path)][-1] == "z 135 to 145 mm"


def test_a_layer_stands_as_its_cells_stand():
    """x points right and y up: the one failing start has the least x and the greatest y, so it is drawn top left."""
    reaches = np.ones((3, 2, 2), bool)
    reaches[0, 1, 0] = False
    (_, lowest), (_, upper) = drawings.layers(
        Coverage(reaches.ravel(), reaches.ravel(), np.ones(reaches.size)), path_in((3, 2, 2))
    )
    assert '<rect class="fails" x="0" y="0" width="10" height="10"/>' in lowest
    assert "fails" not in upper
