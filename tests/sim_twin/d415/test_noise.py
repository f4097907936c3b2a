import numpy as np
import pytest
from pydantic import ValidationError

from robotcell.interfaces import Intrinsics
from sim_twin.d415.noise import (
    BASELINE_M,
    COLOR_TO_LEFT_M,
    DEPTH_UNIT_M,
    DISPARITY_STEP_PX,
    SUBPIXEL_RMS_PX,
    WARM_UP_FRAMES,
    degrade_color,
    degrade_depth,
    exposure,
    white_balance,
)
from sim_twin.options import NoiseOptions

D415 = Intrinsics(640, 480, 617.3, 617.3, 320.0, 240.0)
FB = D415.fx * BASELINE_M


def only(*parts):
    return NoiseOptions(**{name: name in parts for name in NoiseOptions.model_fields})


def depth_of(true, options, *, cos=1.0, seed=1, frame=7):
    true = np.asarray(true, np.float32)
    return degrade_depth(true, np.full_like(true, cos), D415, options, seed=seed, frame=frame)


def plane(z):
    return np.full((480, 640), z, np.float32)


def block_before_wall():
    image = plane(0.9)
    image[200:280, 300:360] = 0.7
    return image


def color_of(image, options, *, t=10.0, seed=1, frame=300):
    return degrade_color(image, options, seed=seed, frame=frame, t=t, frames_since_start=frame)


def test_with_every_part_off_nothing_changes():
    true = np.linspace(0.4, 3, 480 * 640, dtype=np.float32).reshape(480, 640)
    np.testing.assert_allclose(depth_of(true, only(), cos=0.01), true, rtol=1e-6)
    color = np.arange(480 * 640 * 3, dtype=np.uint8).reshape(480, 640, 3)
    np.testing.assert_array_equal(color_of(color, only()), color)


@pytest.mark.parametrize("z", [0.5, 0.87, 2.0])
def test_depth_noise_grows_with_the_square_of_the_distance(z):
    error = depth_of(plane(z), only("disparity_noise")) - z
    assert error.std() == pytest.approx(z**2 * SUBPIXEL_RMS_PX / FB, rel=0.05)


def test_a_plane_at_working_distance_is_as_noisy_as_a_real_one():
    image = depth_of(plane(0.87), NoiseOptions())
    assert 0.001 < image[image > 0].std() < 0.002


def test_neighbours_err_alike_and_far_pixels_do_not():
    error = depth_of(plane(1.0), only("disparity_noise")) - 1

    def correlation(shift):
        return np.corrcoef(error[:, :-shift].ravel(), error[:, shift:].ravel())[0, 1]

    assert correlation(1) > 0.6
    assert abs(correlation(10)) < 0.05


def test_depth_comes_in_steps_of_disparity_and_whole_millimetres():
    true = np.linspace(1.9, 2.1, 480 * 640).reshape(480, 640)
    levels = np.unique(depth_of(true, only("quantisation")))
    np.testing.assert_allclose(levels, np.rint(levels / DEPTH_UNIT_M) * DEPTH_UNIT_M, atol=1e-6)
    step = 2.0**2 / FB * DISPARITY_STEP_PX
    assert np.diff(levels).mean() == pytest.approx(step, rel=0.05)


def test_the_shadow_of_an_object_lies_on_its_left_only():
    image = depth_of(block_before_wall(), only("occlusion"))
    width = D415.fx * (BASELINE_M + COLOR_TO_LEFT_M) * (1 / 0.7 - 1 / 0.9)
    row = image[240]
    holes = np.flatnonzero(row[100:] == 0) + 100
    assert holes.max() == 299
    assert len(holes) == pytest.approx(width, abs=1)
    assert (row[300:] > 0).all()
    assert (image[100, 100:] > 0).all()


def test_the_left_border_that_only_one_imager_sees_is_lost():
    band = (depth_of(plane(0.87), only("occlusion")) == 0).sum(axis=1)
    assert np.all(abs(band - D415.fx * (BASELINE_M + COLOR_TO_LEFT_M) / 0.87) <= 1)


def test_returns_are_rarely_lost_head_on_and_always_at_a_grazing_angle():
    share = [
        (depth_of(plane(0.9), only("dropout"), cos=np.cos(np.radians(angle))) == 0).mean()
        for angle in (0, 60, 76, 80, 88)
    ]
    assert 0 < share[0] < 0.01
    assert share[1] == share[0]
    assert share[1] < share[2] < share[3] < share[4]
    assert share[4] > 0.99


def test_edges_bleed_within_a_few_pixels_and_leave_points_between():
    true = block_before_wall()
    image = depth_of(true, only("edge_bleeding"))
    changed = abs(image - true) > 1e-5
    distance_to_edge = np.minimum(abs(np.arange(640) - 299.5), abs(np.arange(640) - 359.5))[None]
    distance_to_edge = np.minimum(
        distance_to_edge, np.minimum(abs(np.arange(480) - 199.5), abs(np.arange(480) - 279.5))[:, None]
    )
    assert distance_to_edge[changed].max() <= 2
    assert 0.2 < changed[220:260, 298:302].mean() < 0.8
    between = (image > 0.72) & (image < 0.88)
    assert between.sum() > 100
    assert ((image > 0.699) & (image < 0.901)).all()


def test_a_slanted_surface_has_no_edges_to_bleed():
    true = np.tile(np.linspace(0.5, 2.0, 640, dtype=np.float32), (480, 1))
    inner = slice(5, -5)
    np.testing.assert_allclose(depth_of(true, only("edge_bleeding"))[:, inner], true[:, inner], rtol=1e-6)


def test_the_seed_and_the_frame_number_decide_the_frame():
    true = block_before_wall()
    first = depth_of(true, NoiseOptions())
    np.testing.assert_array_equal(first, depth_of(true, NoiseOptions()))
    assert (first != depth_of(true, NoiseOptions(), frame=8)).mean() > 0.5
    assert (first != depth_of(true, NoiseOptions(), seed=2)).mean() > 0.5
    grey = np.full((480, 640, 3), 128, np.uint8)
    np.testing.assert_array_equal(color_of(grey, NoiseOptions()), color_of(grey, NoiseOptions()))
    assert (color_of(grey, NoiseOptions()) != color_of(grey, NoiseOptions(), frame=301)).mean() > 0.5


def test_switching_one_part_off_leaves_the_others_as_they_are():
    alone = depth_of(plane(0.9), only("dropout")) == 0
    together = depth_of(plane(0.9), only("dropout", "disparity_noise", "quantisation", "edge_bleeding")) == 0
    np.testing.assert_array_equal(alone, together)


def test_no_return_stays_no_return():
    true = plane(0.9)
    true[:100] = 0
    assert (depth_of(true, NoiseOptions())[:95] == 0).all()


def test_color_noise_grows_with_the_signal_and_keeps_its_mean():
    noisy = {v: color_of(np.full((480, 640, 3), v, np.uint8), only("color_noise")) for v in (20, 200)}
    for value, image in noisy.items():
        assert image.mean() == pytest.approx(value, abs=0.02)
    assert 1.0 < noisy[20].std() < noisy[200].std() < 3.0


def test_white_balance_wanders_slowly_by_a_few_per_cent():
    gains = np.array([white_balance(1, t) for t in range(600)])
    assert 0.01 < abs(gains - 1).max() < 0.15
    assert abs(np.diff(gains, axis=0)).max() < 0.02
    assert (gains[:, 0] / gains[:, 2]).std() > 0.005
    assert not np.allclose(white_balance(1, 0), white_balance(2, 0))
    grey = np.full((4, 4, 3), 128, np.uint8)
    np.testing.assert_array_equal(color_of(grey, only("white_balance"))[0, 0], np.rint(128 * white_balance(1, 10.0)))


def test_exposure_starts_dark_and_has_settled_after_the_warm_up():
    grey = np.full((4, 4, 3), 128, np.uint8)
    dark = degrade_color(grey, only("warm_up"), seed=1, frame=0, t=0, frames_since_start=0)
    assert dark.max() < 40
    assert exposure(WARM_UP_FRAMES) == pytest.approx(1, abs=0.005)


def test_an_unknown_part_is_refused():
    with pytest.raises(ValidationError, match="blur"):
        NoiseOptions(blur=True)
