from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotcell.config import Workspace
from robotcell.errors import ConfigError, NoTarget
from robotcell.perception.colors import PALETTE
from robotcell.perception.goals import check_goal_word, find_goal
from robotcell.perception.segmentation import object_mask, segment
from tests.robotcell.maps import heightmap

GREY_TABLE = (90, 88, 84)


def place(heights, colors, rows, cols, height_m, color):
    heights[rows, cols] = height_m
    colors[rows, cols] = PALETTE.get(color, color)


def bare_table():
    heights = np.zeros(Workspace().shape, np.float32)
    return heights, np.full((*heights.shape, 3), GREY_TABLE, np.float64)


def degraded(heights, colors, seed, gains=(1.0, 1.0, 1.0), color_noise=4.0, depth_noise_m=0.0015):
    """A heightmap with noise of depth and colour, a channel gain of drifting white balance, and drop-out."""
    rng = np.random.default_rng(seed)
    heights = heights + rng.normal(0, depth_noise_m, heights.shape).astype(np.float32)
    heights[rng.random(heights.shape) < 0.05] = np.nan
    colors = np.clip(colors * gains + rng.normal(0, color_noise, colors.shape), 0, 255).astype(np.uint8)
    colors[np.isnan(heights)] = 0
    return replace(heightmap(heights), color=colors)


DRIFT = st.tuples(*[st.floats(0.94, 1.06)] * 3)


@settings(max_examples=40)
@given(gains=DRIFT, shade=st.floats(0.7, 1.0), seed=st.integers(0, 2**16))
def test_colours_are_named_right_under_drift_and_shade(gains, shade, seed):
    heights, colors = bare_table()
    spots = {}
    for i, name in enumerate(PALETTE):
        row, col = 20 + 90 * (i // 5), 10 + 42 * (i % 5)
        # The side that faces the camera is darker than the top.
        place(heights, colors, slice(row, row + 25), slice(col, col + 25), 0.05, name)
        colors[row : row + 25, col : col + 6] *= 0.65
        spots[name] = row + 12, col + 12
    colors *= shade
    segmentation = segment(degraded(heights, colors, seed, gains))
    assert len(segmentation.instances) == len(PALETTE)
    for name, spot in spots.items():
        assert segmentation.labels[spot] == find_goal(segmentation, name).label


@settings(max_examples=30)
@given(
    names=st.lists(st.sampled_from(sorted(PALETTE)), min_size=2, max_size=2, unique=True),
    gains=DRIFT,
    seed=st.integers(0, 2**16),
)
def test_touching_objects_of_different_colours_separate(names, gains, seed):
    heights, colors = bare_table()
    place(heights, colors, slice(60, 85), slice(60, 85), 0.05, names[0])
    place(heights, colors, slice(66, 91), slice(85, 110), 0.05, names[1])
    segmentation = segment(degraded(heights, colors, seed, gains))
    assert sorted(i.color_name for i in segmentation.instances) == sorted(names)
    first = find_goal(segmentation, names[0])
    truth = np.zeros(heights.shape, bool)
    truth[60:85, 60:85] = True
    mask = segmentation.mask(first)
    assert (mask & truth).sum() / (mask | truth).sum() > 0.85
    assert first.centroid == pytest.approx(Workspace().position(72, 72), abs=0.005)
    assert first.height_m == pytest.approx(0.05, abs=0.004)


def test_equal_colours_separate_at_a_step():
    heights, colors = bare_table()
    place(heights, colors, slice(60, 85), slice(60, 85), 0.05, "red")
    place(heights, colors, slice(60, 85), slice(85, 110), 0.025, "red")
    segmentation = segment(degraded(heights, colors, 1))
    assert [i.color_name for i in segmentation.instances] == ["red", "red"]
    assert segmentation.labels[72, 72] != segmentation.labels[72, 97]


def test_equal_colours_separate_at_a_neck():
    heights, colors = bare_table()
    place(heights, colors, slice(60, 85), slice(60, 85), 0.05, "blue")
    place(heights, colors, slice(80, 105), slice(85, 110), 0.05, "blue")
    segmentation = segment(degraded(heights, colors, 1))
    assert len(segmentation.instances) == 2
    assert segmentation.labels[65, 65] != segmentation.labels[100, 105]


@pytest.mark.parametrize("size", [(25, 25), (12, 50), (50, 50)])
def test_one_object_stays_one(size):
    heights, colors = bare_table()
    place(heights, colors, slice(60, 60 + size[0]), slice(60, 60 + size[1]), 0.05, "green")
    assert len(segment(degraded(heights, colors, 3)).instances) == 1


def test_specks_and_low_noise_are_no_objects():
    heights, colors = bare_table()
    heights[100, 100:104] = 0.08  # flying pixels
    heights[30:60, 30:60] = 0.005
    heights[150:180, 150:180] = np.nan
    heights[165, 165] = 0.05  # a return in the middle of a shadow
    noisy = replace(heightmap(heights), color=colors.astype(np.uint8))
    assert not object_mask(noisy).any()
    segmentation = segment(noisy)
    assert segmentation.instances == ()
    assert not segmentation.objects.any()


def test_a_goal_that_is_not_there_says_what_is():
    heights, colors = bare_table()
    place(heights, colors, slice(20, 45), slice(20, 45), 0.05, "blue")
    place(heights, colors, slice(20, 45), slice(80, 105), 0.05, "blue")
    place(heights, colors, slice(100, 125), slice(80, 105), 0.05, "gray")
    segmentation = segment(degraded(heights, colors, 1))
    with pytest.raises(NoTarget, match=r"no red object is seen .* there is: blue \(2\), gray$"):
        find_goal(segmentation, "red")
    with pytest.raises(NoTarget, match="there is: nothing"):
        find_goal(segment(degraded(*bare_table(), 1)), "red")


def test_the_goal_is_the_most_visible_of_its_colour():
    heights, colors = bare_table()
    place(heights, colors, slice(20, 40), slice(20, 40), 0.05, "blue")
    place(heights, colors, slice(20, 60), slice(80, 105), 0.05, "blue")
    segmentation = segment(degraded(heights, colors, 1))
    assert segmentation.labels[40, 90] == find_goal(segmentation, "blue").label


def test_an_unknown_goal_word_lists_the_palette():
    assert check_goal_word("cyan") == "cyan"
    with pytest.raises(ConfigError, match="'mauve' is not a colour that is known; known are: blue, green, brown"):
        check_goal_word("mauve")
