"""What a D415 makes of a perfect image: the errors of its stereo depth and of its colour sensor.

Depth is disturbed where the device errs, in disparity d = f b / z, so that its error grows with the square of
the distance by itself: dz = z^2 / (f b) dd. Each part can be switched off, and draws from a stream of its own
that depends on the seed and the frame number alone: the same seed gives the same frame, and switching one part
off leaves the others as they are.

Sources:
    [1] Intel RealSense D400 series datasheet: baseline, minimum depth, invalid depth band, fill rate.
    [2] Grunnet-Jepsen et al., "Tuning depth cameras for best performance" (Intel): depth error
        z^2 subpixel / (f b), depth unit of 1 mm; holes lie left of near objects (librealsense issue 13475).
    [3] The camera's makers in librealsense issue 3904: subpixel error 0.08 px in use, 0.032 px at best.
    [4] Keselman et al. 2017, "Intel RealSense stereoscopic depth cameras": matching by windows, so that
        neighbours err alike and windows across an edge blend or choose a side.
    [5] Nguyen et al. 2012, "Modeling Kinect sensor noise": edges wander by about 0.8 px at any distance, and
        returns fail beyond about 70 degrees of incidence.
    [6] EMVA standard 1288: the variance of a pixel is read noise plus gain times signal.
Numbers that no source gives are marked as assumed.
"""

from __future__ import annotations

import functools
import math
from statistics import NormalDist
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from robotcell.interfaces import Intrinsics
    from sim_twin.options import NoiseOptions

Floats = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]

# [1] Distance between the two imagers; and how far the left one is to the right of the colour sensor, in
# whose frame depth is reported (about 15 mm in the factory extrinsics of D415 units).
BASELINE_M = 0.055
COLOR_TO_LEFT_M = 0.015
# [3]
SUBPIXEL_RMS_PX = 0.08
# [3] names 0.032 px as the best that the matcher resolves: five fractional bits.
DISPARITY_STEP_PX = 1 / 32
# [2]
DEPTH_UNIT_M = 0.001

# [4] Width of the matching window as seen in the error: neighbours within some 3 px err alike (assumed).
_DISPARITY_SIGMA_PX = 1.3
# [5]
_LATERAL_RMS_PX = 0.8
# A step that the matching window blends; smaller ones are slanted surfaces (assumed).
_EDGE_STEP_PX = 0.5
_EDGE_RADIUS_PX = 2
# Edge pixels that come out between front and back: "flying pixels" (assumed).
_FLYING_SHARE = 0.35
# [1] promises a fill rate of 99 % and more on a textured wall: 0.3 % of blobs are lost head on.
_SPECKLE_SIGMAS = 2.75
# [5] Returns thin out from here and are gone at the second angle (assumed).
_GRAZING_START = math.radians(70)
_GRAZING_END = math.radians(86)

# [6] in counts of 255: read noise, and variance per count (assumed: a well-lit cell at low gain).
_READ_NOISE = 1.0
_SHOT_GAIN = 0.02
# Blur of lens and demosaicing (assumed).
_LENS_SIGMA_PX = 0.6
# Automatic white balance and exposure wander by this much, with these periods (assumed).
_WHITE_BALANCE_RMS = 0.02
_EXPOSURE_RMS = 0.03
_DRIFT_PERIODS_S = (23.0, 71.0, 311.0)
# Automatic exposure starts dark and settles with this time constant (assumed); drivers commonly skip 30 frames.
_EXPOSURE_START = 0.25
_EXPOSURE_FRAMES = 5.0
WARM_UP_FRAMES = 30


def degrade_depth(
    depth_m: Floats,
    incidence_cos: Floats,
    intrinsics: Intrinsics,
    options: NoiseOptions,
    *,
    seed: int,
    frame: int,
) -> Floats:
    """The depth that a D415 reports instead of the true one.

    Args:
        depth_m: true depth (H, W) [m] along the optical axis, 0 = nothing there.
        incidence_cos: (H, W) cosine of the angle between line of sight and surface normal.
        intrinsics: of the image; the two imagers are taken to have the same.
        options: which errors to make.
        seed: of the session.
        frame: number of the frame.

    Returns:
        (H, W) float32 [m], 0 = no return.
    """
    focal_baseline = np.float32(intrinsics.fx * BASELINE_M)
    seen = depth_m > 0
    disparity = np.divide(focal_baseline, depth_m, out=np.zeros_like(depth_m), where=seen)
    if options.occlusion:
        seen &= ~_shadow(disparity)
    if options.dropout:
        seen &= ~_dropped(incidence_cos, _stream(seed, frame, 0))
    if options.edge_bleeding:
        _bleed_edges(disparity, _stream(seed, frame, 1))
    if options.disparity_noise:
        disparity += np.float32(SUBPIXEL_RMS_PX) * _correlated_normal(
            depth_m.shape, _DISPARITY_SIGMA_PX, _stream(seed, frame, 2)
        )
    if options.quantisation:
        disparity *= np.float32(1 / DISPARITY_STEP_PX)
        np.rint(disparity, out=disparity)
        disparity *= np.float32(DISPARITY_STEP_PX)
    seen &= disparity > 0
    depth: Floats = np.divide(focal_baseline, disparity, out=np.zeros_like(depth_m), where=seen)
    if options.quantisation:
        depth *= np.float32(1 / DEPTH_UNIT_M)
        np.rint(depth, out=depth)
        depth *= np.float32(DEPTH_UNIT_M)
    return depth


def degrade_color(
    color: Bytes, options: NoiseOptions, *, seed: int, frame: int, t: float, frames_since_start: int
) -> Bytes:
    """The colour image that a D415 delivers instead of the true one.

    Args:
        color: (H, W, 3) uint8 RGB.
        options: which errors to make.
        seed: of the session.
        frame: number of the frame.
        t: time of capture [s], which the drift follows.
        frames_since_start: frames since the stream was started, which automatic exposure follows.
    """
    gains = np.ones(3)
    if options.white_balance:
        gains *= white_balance(seed, t)
    if options.warm_up:
        gains *= exposure(frames_since_start)
    if not np.all(gains == 1):
        counts = np.arange(256)[:, None] * gains
        color = np.asarray(cv2.LUT(color, np.clip(np.rint(counts), 0, 255).astype(np.uint8)[None]), dtype=np.uint8)
    if options.color_noise:
        color = _sensor_noise(color, _stream(seed, frame, 3))
    return color


def white_balance(seed: int, t: float) -> npt.NDArray[np.float64]:
    """Gains (3,) of R, G and B at a time [s]: the slow wandering of automatic exposure and white balance."""
    phases = np.random.default_rng([seed, 4]).uniform(0, 2 * np.pi, (4, len(_DRIFT_PERIODS_S)))
    waves = np.sin(2 * np.pi * t / np.array(_DRIFT_PERIODS_S) + phases).sum(axis=1)
    waves *= math.sqrt(2 / len(_DRIFT_PERIODS_S))
    return np.asarray((1 + _EXPOSURE_RMS * waves[3]) * (1 + _WHITE_BALANCE_RMS * waves[:3]))


def exposure(frames_since_start: int) -> float:
    """The share of the right exposure that automatic exposure has reached."""
    return 1 - (1 - _EXPOSURE_START) * math.exp(-frames_since_start / _EXPOSURE_FRAMES)


def _stream(seed: int, frame: int, part: int) -> np.random.Generator:
    return np.random.Generator(np.random.SFC64([seed, frame, part]))


def _correlated_normal(shape: tuple[int, ...], sigma_px: float, rng: np.random.Generator) -> Floats:
    """A field of unit variance whose values agree over a few pixels: white noise under a Gaussian window."""
    size = 2 * math.ceil(2 * sigma_px) + 1
    kernel = np.asarray(cv2.getGaussianKernel(size, sigma_px), dtype=np.float64)
    # A window whose squares sum to one keeps the variance.
    kernel /= np.linalg.norm(kernel)
    white = rng.standard_normal(shape, dtype=np.float32)
    return np.asarray(cv2.sepFilter2D(white, cv2.CV_32F, kernel, kernel), dtype=np.float32)


def _shadow(disparity: Floats) -> npt.NDArray[np.bool_]:
    """What the colour sensor sees and the right imager does not: left of near objects, and the left border.

    The right imager sees column u at u - d. A point is hidden where something that is to its right appears to
    its left there. Points that are seen past a thin object count as hidden too, since matching along a row
    keeps the order of columns.
    """
    scale = np.float32((BASELINE_M + COLOR_TO_LEFT_M) / BASELINE_M)
    columns = np.arange(disparity.shape[1], dtype=np.float32) - scale * disparity
    leftmost = np.minimum.accumulate(columns[:, ::-1], axis=1)[:, ::-1]
    return np.asarray((columns > leftmost) | (columns < 0))


def _dropped(incidence_cos: Floats, rng: np.random.Generator) -> npt.NDArray[np.bool_]:
    """Blobs without a return: rare head on, everywhere at grazing angles."""
    height, width = incidence_cos.shape
    coarse = _correlated_normal(((height + 1) // 2, (width + 1) // 2), 0.7, rng)
    blobs = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_NEAREST)
    start, end = math.cos(_GRAZING_START), math.cos(_GRAZING_END)
    slope = 2 * _SPECKLE_SIGMAS / (start - end)
    limit = np.minimum((incidence_cos - np.float32(end)) * np.float32(slope) - _SPECKLE_SIGMAS, _SPECKLE_SIGMAS)
    return np.asarray(blobs > limit)


def _bleed_edges(disparity: Floats, rng: np.random.Generator) -> None:
    """Let edges wander by about a pixel, and let some pixels hang between front and back. In place."""
    height, width = disparity.shape
    window = np.ones((2 * _EDGE_RADIUS_PX + 1,) * 2, np.uint8)
    front = np.asarray(cv2.dilate(disparity, window))
    back = np.asarray(cv2.erode(disparity, window))
    # On a slanted plane the middle pixel is half-way between the two, at a step it is one of them.
    rows, columns = np.nonzero(np.abs(2 * disparity - front - back) > _EDGE_STEP_PX)
    # One draw for each patch of 4 x 4 pixels: an edge wanders in waves, not pixel by pixel.
    patches = (2, (height + 3) // 4, (width + 3) // 4)
    shift = np.rint(_LATERAL_RMS_PX * rng.standard_normal(patches, dtype=np.float32)).astype(np.intp)
    row_shift, column_shift = shift[:, rows // 4, columns // 4]
    wandered = disparity[np.clip(rows + row_shift, 0, height - 1), np.clip(columns + column_shift, 0, width - 1)]
    share = rng.random(len(rows), dtype=np.float32)
    between = share * front[rows, columns] + (1 - share) * back[rows, columns]
    hangs = (rng.random(len(rows)) < _FLYING_SHARE) & (back[rows, columns] > 0)
    disparity[rows, columns] = np.where(hangs, between, wandered)


def _sensor_noise(color: Bytes, rng: np.random.Generator) -> Bytes:
    """Blur of the lens, then noise whose variance grows with the signal."""
    # Pairs of bytes, drawn and seen, that read as an index into the table.
    pairs = np.empty((*color.shape, 2), dtype=np.uint8)
    pairs[..., 0] = np.frombuffer(rng.bytes(color.size), dtype=np.uint8).reshape(color.shape)
    pairs[..., 1] = cv2.GaussianBlur(color, (3, 3), _LENS_SIGMA_PX)
    return np.take(_noisy_counts(), pairs.view("<u2")[..., 0])


@functools.cache
def _noisy_counts() -> Bytes:
    """(65536,) noisy count for each true count (high byte) and each of 256 equal chances (low byte)."""
    signal = np.arange(256.0)[:, None]
    normal = np.array([NormalDist().inv_cdf((draw + 0.5) / 256) for draw in range(256)])
    noisy = signal + np.sqrt(_READ_NOISE**2 + _SHOT_GAIN * signal) * normal
    counts: Bytes = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    return counts.ravel()
