from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from policy.network.encoding import GRASP, PUSH, encode
from policy.network.rotation import Copies
from policy.training.augment import CROP_CELLS, crop
from policy.training.replay import View
from policy.training.shard import unpack_height

SIZE = 80
MIDDLE = CROP_CELLS // 2

ROTATIONS = st.integers(0, 15)
PRIMITIVES = st.sampled_from([GRASP, PUSH])
CELLS = st.tuples(st.integers(0, SIZE - 1), st.integers(0, SIZE - 1))
SEEDS = st.integers(0, 2**32 - 1)


def noise() -> View:
    """No two cells are alike."""
    rng = np.random.default_rng(0)
    height = rng.integers(1000, 3000, (SIZE, SIZE)).astype(np.uint16)
    return View(height, rng.integers(1, 256, (SIZE, SIZE, 3), np.uint8), np.ones((SIZE, SIZE), np.uint8))


def spots(*places: tuple[float, float]) -> View:
    """A table with blocks of 5 x 5 cells and 5 cm around (row, col)."""
    labels = np.zeros((SIZE, SIZE), np.uint8)
    for label, (row, col) in enumerate(places, 1):
        r, c = round(row), round(col)
        labels[r - 2 : r + 3, c - 2 : c + 3] = label
    height = np.where(labels > 0, 1501, 1001).astype(np.uint16)
    return View(height, np.full((SIZE, SIZE, 3), 100, np.uint8), labels)


def turn(view: View, quarters: int) -> View:
    """From +x (columns) to +y (rows)."""
    return View(*(np.rot90(plane, -quarters) for plane in view))


def turned_cell(cell: tuple[int, int], quarters: int) -> tuple[int, int]:
    row, col = cell
    for _ in range(quarters % 4):
        row, col = col, SIZE - 1 - row
    return row, col


def center_of(block: np.typing.NDArray[np.bool_]) -> tuple[float, float]:
    rows, cols = np.nonzero(block)
    return float(rows.mean()), float(cols.mean())


@given(PRIMITIVES, CELLS, ROTATIONS, st.integers(1, 3))
def test_a_turned_scene_and_a_turned_action_give_the_same_crop(
    primitive: int, cell: tuple[int, int], rotation: int, quarters: int
) -> None:
    view = noise()
    one = crop(view, primitive, cell, rotation, None)
    two = crop(turn(view, quarters), primitive, turned_cell(cell, quarters), rotation + 4 * quarters, None)
    assert one.shape == (5, CROP_CELLS, CROP_CELLS)
    # A cell halfway between two may be seen as either.
    assert (one != two).any(axis=0).mean() < 0.01
    np.testing.assert_array_equal(one[:, MIDDLE, MIDDLE], two[:, MIDDLE, MIDDLE])


@given(PRIMITIVES, CELLS, ROTATIONS)
def test_the_network_learns_from_what_it_is_shown_at_work(primitive: int, cell: tuple[int, int], rotation: int) -> None:
    view = noise()
    mask = np.zeros((SIZE, SIZE), np.bool_)
    mask[cell] = True
    copies = Copies.around(mask, range(rotation, rotation + 1), MIDDLE)
    shown = copies.turn(encode(unpack_height(view.height), view.color))[0]
    np.testing.assert_array_equal(crop(view, primitive, cell, rotation, None), shown)


@given(ROTATIONS, st.integers(30, 50), st.integers(30, 50))
def test_an_attempt_runs_along_plus_x(rotation: int, row: int, col: int) -> None:
    angle = math.tau * rotation / 16
    # Rows run along base y and columns along base x.
    view = spots((row + 15 * math.sin(angle), col + 15 * math.cos(angle)))
    seen = crop(view, PUSH, (row, col), rotation, None)
    assert center_of(seen[0] > 0.5) == pytest.approx((MIDDLE, MIDDLE + 15), abs=1.0)


def test_what_was_not_seen_and_what_is_beyond_the_map_is_0() -> None:
    view = noise()
    view.height[40:44, 40:44] = 0
    view.color[40:44, 40:44] = 0
    for rng in (None, np.random.default_rng(0)):
        seen = crop(view, PUSH, (10, 40), 3, rng)
        assert set(np.unique(seen[1])) == {0.0, 1.0}
        assert not seen[:, seen[1] == 0].any()
        assert 0.2 < seen[1].mean() < 0.6


@given(SEEDS)
def test_variations_keep_the_attempt_in_place(seed: int) -> None:
    """The block ahead stays ahead, within a few degrees and cells."""
    angle = math.tau * 3 / 16
    view = spots((40 + 20 * math.sin(angle), 40 + 20 * math.cos(angle)))
    seen = crop(view, PUSH, (40, 40), 3, np.random.default_rng(seed))
    row, col = center_of(seen[0] > 0.5)
    assert abs(row - MIDDLE) < 8
    assert abs(col - MIDDLE - 20) < 5


@given(SEEDS)
def test_the_table_is_a_little_higher_or_lower_everywhere(seed: int) -> None:
    seen = crop(spots((40, 40)), PUSH, (40, 40), 3, np.random.default_rng(seed))
    # In units of 5 cm; the table is not below itself.
    assert abs(seen[0, seen[0] > 0.5] - 1).max() < 0.1
    assert seen[0].min() >= 0


def ahead(primitive: int) -> list[tuple[float, float]]:
    """Where variations put a block that lies ahead and to the right."""
    view = spots((44, 55))
    rng = np.random.default_rng(0)
    return [center_of(crop(view, primitive, (40, 40), 0, rng)[0] > 0.5) for _ in range(200)]


def test_a_grasp_is_seen_from_both_sides_and_a_push_from_one() -> None:
    assert 60 < sum(col > MIDDLE for _, col in ahead(GRASP)) < 140
    assert all(col > MIDDLE for _, col in ahead(PUSH))


def test_half_of_the_crops_are_mirror_images() -> None:
    assert 60 < sum(row > MIDDLE for row, _ in ahead(PUSH)) < 140


def test_light_and_colours_vary() -> None:
    rng = np.random.default_rng(0)
    view = spots((40, 40))
    tints = np.array([crop(view, PUSH, (40, 40), 0, rng)[2:, MIDDLE, MIDDLE] for _ in range(100)])
    # Brightness 0.7 to 1.3, and its balance 0.85 to 1.15, of 100 / 127.5 - 1.
    assert tints.min() == pytest.approx(100 * 0.7 * 0.85 / 127.5 - 1, abs=0.1)
    assert tints.max() == pytest.approx(100 * 1.3 * 1.15 / 127.5 - 1, abs=0.1)
    assert np.abs(tints[:, 0] - tints[:, 1]).mean() > 0.02


def test_variations_can_be_repeated() -> None:
    one, two = (crop(noise(), GRASP, (40, 40), 5, np.random.default_rng(7)) for _ in range(2))
    np.testing.assert_array_equal(one, two)
