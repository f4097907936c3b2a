from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from policy.training.augment import augment, transform
from policy.training.replay import Sample, View
from policy.training.shard import GRASP, PUSH

SIZE = 64
MIDDLE = ((SIZE - 1) / 2, (SIZE - 1) / 2)
STEPS = st.integers(0, 15)


def make_view(*spots: tuple[float, float]) -> View:
    """Spots (row, col) of 5 x 5 cells, labelled from 1."""
    labels = np.zeros((SIZE, SIZE), np.uint8)
    for label, (row, col) in enumerate(spots, 1):
        r, c = round(row), round(col)
        labels[r - 2 : r + 3, c - 2 : c + 3] = label
    height = np.where(labels > 0, 1500, 1000).astype(np.uint16)
    return View(height, np.repeat(labels[:, :, None] * 40, 3, axis=2), labels)


def make_sample(
    primitive: int, cell: tuple[int, int], rotation: int, view: View, after: tuple[View, ...] = (), target: int = 1
) -> Sample:
    return Sample(
        view=view,
        primitive=np.array([primitive], np.int8),
        row=np.array([cell[0]], np.int16),
        col=np.array([cell[1]], np.int16),
        rotation=np.array([rotation], np.int8),
        target=np.array([target], np.int16),
        reward=np.array([1], np.float32),
        following=np.array([0 if after else -1]),
        views_after=after,
    )


def middle_of(labels: np.typing.NDArray[np.uint8], label: int) -> tuple[float, float]:
    rows, cols = np.nonzero(labels == label)
    return float(rows.mean()), float(cols.mean())


@given(st.sampled_from([GRASP, PUSH]), st.integers(0, 15), STEPS, st.booleans(), st.integers(24, 40))
def test_an_attempt_keeps_its_place_and_direction_in_the_picture(
    primitive: int, rotation: int, steps: int, mirrored: bool, row: int
) -> None:
    rotation %= 8 if primitive == GRASP else 16
    angle = math.tau * rotation / 16
    # Rows run along base y and columns along base x: the direction of plane k is (cos, sin) in (column, row).
    ahead = (row + 14 * math.sin(angle), 30 + 14 * math.cos(angle))
    view = make_view((row, 30), ahead)
    turned = transform(
        make_sample(primitive, (row, 30), rotation, view), steps, mirrored=mirrored, center=MIDDLE, size=SIZE
    )
    assert turned.view.labels[turned.row[0], turned.col[0]] == 1
    first, second = middle_of(turned.view.labels, 1), middle_of(turned.view.labels, 2)
    seen = math.atan2(second[0] - first[0], second[1] - first[1])
    told = math.tau * int(turned.rotation[0]) / 16
    period = math.pi if primitive == GRASP else math.tau
    difference = (seen - told + period / 2) % period - period / 2
    assert abs(difference) < math.radians(8)


@given(STEPS, st.booleans())
def test_what_follows_is_transformed_alike(steps: int, mirrored: bool) -> None:
    view = make_view((30, 20), (40, 44))
    turned = transform(
        make_sample(PUSH, (30, 20), 3, view, (view,)), steps, mirrored=mirrored, center=(25, 35), size=48
    )
    for name in ("height", "color", "labels"):
        np.testing.assert_array_equal(getattr(turned.view, name), getattr(turned.views_after[0], name))
    assert turned.view.height.shape == (48, 48)


def test_a_quarter_turn_moves_x_to_y() -> None:
    view = make_view((10, 20), (40, 44))
    turned = transform(make_sample(PUSH, (10, 20), 0, view), 4, mirrored=False, center=MIDDLE, size=SIZE)
    np.testing.assert_array_equal(turned.view.labels, np.rot90(view.labels, -1))
    assert (turned.row[0], turned.col[0], turned.rotation[0]) == (20, SIZE - 1 - 10, 4)


def test_a_mirror_image_turns_rows_and_directions_over() -> None:
    view = make_view((10, 20), (40, 44))
    turned = transform(make_sample(PUSH, (10, 20), 3, view), 0, mirrored=True, center=MIDDLE, size=SIZE)
    np.testing.assert_array_equal(turned.view.labels, view.labels[::-1])
    assert (turned.row[0], turned.col[0], turned.rotation[0]) == (SIZE - 1 - 10, 20, 13)


@given(STEPS, st.booleans())
def test_nothing_changes_for_a_transformation_and_its_inverse(steps: int, mirrored: bool) -> None:
    sample = make_sample(GRASP, (30, 40), 5, make_view((30, 40)))
    there = transform(sample, steps, mirrored=mirrored, center=MIDDLE, size=SIZE)
    # A mirror image is its own inverse, rotated or not.
    back = transform(there, steps if mirrored else -steps, mirrored=mirrored, center=MIDDLE, size=SIZE)
    assert back.rotation[0] == 5
    assert abs(int(back.row[0]) - 30) <= 1
    assert abs(int(back.col[0]) - 40) <= 1


def test_cells_from_outside_are_unknown_and_attempts_outside_are_dropped() -> None:
    sample = make_sample(GRASP, (2, 2), 0, make_view((2, 2)))
    turned = transform(sample, 2, mirrored=False, center=MIDDLE, size=SIZE)
    assert turned.view.height[0, 0] == 0
    assert turned.view.color[0, 0].tolist() == [0, 0, 0]
    assert turned.view.labels[0, 0] == 0
    assert len(turned.row) == len(turned.reward) == len(turned.following) == 0


def test_a_push_whose_target_leaves_the_square_is_dropped() -> None:
    before, gone = make_view((32, 32)), make_view((32, 60))
    cut = {"steps": 0, "mirrored": False, "center": (32.0, 32.0), "size": 32}
    assert len(transform(make_sample(PUSH, (32, 32), 0, before, (gone,)), **cut).reward) == 0  # type: ignore[arg-type]
    # A target that is not there at all is a fact to learn from.
    missing = make_view()
    assert len(transform(make_sample(PUSH, (32, 32), 0, before, (missing,)), **cut).reward) == 1  # type: ignore[arg-type]


@given(st.integers(0, 2**32 - 1))
def test_light_and_height_change_alike_before_and_after(seed: int) -> None:
    view = make_view((30, 30), (36, 40))
    view.height[:5] = 0
    changed = augment(make_sample(PUSH, (30, 30), 3, view, (view,)), 48, np.random.default_rng(seed))
    after = changed.views_after[0]
    np.testing.assert_array_equal(changed.view.color, after.color)
    np.testing.assert_array_equal(changed.view.height, after.height)
    known = changed.view.height[changed.view.height > 0].astype(int)
    tops, floor = known[known > 1250], known[known <= 1250]
    assert abs(floor - 1000).max() <= 10
    assert len(set(floor)) == 1
    assert len(set(tops)) <= 1
    assert changed.view.labels[changed.row[0], changed.col[0]] == 1


def test_every_attempt_is_seen_at_times() -> None:
    """However far from the others: a corner of the map would otherwise never be learned."""
    far = make_sample(GRASP, (3, 3), 0, make_view((3, 3)))
    many = Sample(
        view=far.view,
        primitive=np.zeros(6, np.int8),
        row=np.array([3, 55, 56, 57, 58, 59], np.int16),
        col=np.array([3, 55, 56, 57, 58, 59], np.int16),
        rotation=np.zeros(6, np.int8),
        target=np.arange(6, dtype=np.int16),
        reward=np.zeros(6, np.float32),
        following=np.full(6, -1),
        views_after=(),
    )
    rng = np.random.default_rng(0)
    seen = np.bincount(np.concatenate([augment(many, 46, rng).target for _ in range(400)]), minlength=6)
    assert seen.min() > 5
