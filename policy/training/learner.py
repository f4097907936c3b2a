"""Double DQN on dense Q maps, learned from the surroundings of single attempts."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch
from scipy.stats import rankdata
from torch.nn import functional

from policy.learned.selection import best_cells, smoothed
from policy.network.encoding import GRASP, PUSH, RESOLUTION_M, encode
from policy.network.inference import MARGIN_M
from policy.network.precision import autocast
from policy.network.rotation import Copies
from policy.training.augment import CROP_CELLS, crop
from policy.training.shard import unpack_height
from robotcell.motion.rotations import GRASP_ROTATIONS

if TYPE_CHECKING:
    from collections.abc import Callable

    from torch import Tensor, nn

    from policy.training.config import LearningSettings
    from policy.training.replay import Replay, View

_VALIDATION_BATCH = 64


@dataclass(frozen=True)
class Losses:
    """Of one update: Huber losses of the two modules, and the mean |TD error| over all attempts.

    A module that had no attempt in the batch has NaN.
    """

    grasp: float
    push: float
    error: float


class Learner:
    """The online and the target network, and Adam.

    Args:
        network: the online network, in whatever state it is to start from.
        settings: of the learning.
        stage: 1 or 2, which seeds the draws.
        planned_updates: of the stage; learning rate and beta follow them.
        seed: makes what is drawn and how it is varied a function of the number of the update.
        crop_cells: rows and columns of the surroundings that the network learns from.
    """

    def __init__(
        self,
        network: nn.Module,
        settings: LearningSettings,
        stage: int,
        planned_updates: int,
        seed: int,
        crop_cells: int = CROP_CELLS,
    ) -> None:
        self._crop_cells = crop_cells
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.online = network.to(device=self.device)
        self.online.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # missing in torch's stubs
        self.target = copy.deepcopy(self.online).eval().requires_grad_(requires_grad=False)
        self.optimizer = torch.optim.Adam(self.online.parameters(), lr=settings.learning_rate)
        self.updates = 0
        self._settings = settings
        self._stage = stage
        self._planned = planned_updates
        self._seed = seed

    @property
    def progress(self) -> float:
        """The part of the planned updates that is done, 0 to 1."""
        return min(1.0, self.updates / self._planned)

    @property
    def learning_rate(self) -> float:
        """Of the next update: half a cosine over the stage."""
        first, last = self._settings.learning_rate, self._settings.final_learning_rate
        return last + (first - last) * (1 + math.cos(math.pi * self.progress)) / 2

    def update(self, replay: Replay) -> Losses:
        """Draw attempts, learn from them, and tell the replay how wrong the network was."""
        settings = self._settings
        rng = np.random.default_rng([self._seed, self._stage, self.updates])
        beta = settings.priority_beta_start + (1 - settings.priority_beta_start) * self.progress
        counts = {GRASP: settings.grasps, PUSH: settings.pushes}
        drawn = [replay.draw(kind, count, beta, rng) for kind, count in counts.items()]
        numbers = np.concatenate([rows for rows, _ in drawn])
        importance = np.concatenate([weights for _, weights in drawn])
        attempts = replay.attempts.take(numbers)
        wanted = attempts.reward + np.float32(settings.gamma) * replay.value[numbers]
        losses, errors = self.learn(self._crops(replay, numbers, rng), attempts.primitive, wanted, importance)
        replay.update(numbers, errors)
        return losses

    def learn(
        self,
        crops: npt.NDArray[np.float32],
        primitive: npt.NDArray[np.int64],
        wanted: npt.NDArray[np.float32],
        importance: npt.NDArray[np.float32],
    ) -> tuple[Losses, npt.NDArray[np.float32]]:
        """One step of Adam.

        Args:
            crops: (N, 5, S, S) surroundings of the attempts.
            primitive: (N,) of the attempts.
            wanted: (N,) Q values.
            importance: (N,) weights.

        Returns:
            The losses, and (N,) the |TD error| of each attempt.
        """
        self.online.train()
        chosen = self._at_middle(self.online, crops, primitive)
        goal, weight = (torch.from_numpy(values).to(self.device) for values in (wanted, importance))
        each = weight * functional.smooth_l1_loss(chosen, goal, reduction="none")
        grasps, pushes = (each[torch.from_numpy(primitive == kind).to(self.device)] for kind in (GRASP, PUSH))
        # A batch may lack one of them: its sum is 0 then, and its mean not a number.
        loss = grasps.sum() / max(1, len(grasps)) + self._settings.push_weight * pushes.sum() / max(1, len(pushes))
        for group in self.optimizer.param_groups:
            group["lr"] = self.learning_rate
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.online.parameters(), self._settings.gradient_norm)
        self.optimizer.step()
        self.updates += 1
        errors = (chosen.detach() - goal).abs().cpu().numpy()
        grasp_loss, push_loss = (_mean(values.detach().cpu().numpy()) for values in (grasps, pushes))
        return Losses(grasp_loss, push_loss, _mean(errors)), errors

    def look_ahead(
        self, replay: Replay, round_: int, on_progress: Callable[[int, int], None] = lambda _done, _total: None
    ) -> None:
        """Find what can be reached after the pushes that were not valued yet, and after those valued longest ago.

        The value is that of Double DQN, Q_target(s', argmax_a Q_online(s', a)) over the grasps at the object that the
        attempt was about. Pushes do not count: with the paper's rewards, pushing for ever is worth 0.5 / (1 - gamma) =
        1, as much as a grasp, and a maximum over both would not tell whether the object came free. The target network
        then becomes a copy of the online one, so the two that are asked are a round apart.

        Args:
            replay: of the attempts.
            round_: in which this happens.
            on_progress: told how many are done, of how many.
        """
        attempts = replay.attempts
        open_ = np.flatnonzero((attempts.next_state >= 0) & ~attempts.held_out)
        oldest = open_[np.argsort(replay.valued[open_], kind="stable")]
        never = int((replay.valued[open_] < 0).sum())
        chosen = oldest[: max(never, self._settings.values_per_round)]
        self.online.eval()
        found: dict[tuple[int, int, int], float] = {}
        for done, number in enumerate(chosen.tolist()):
            key = (int(attempts.shard[number]), int(attempts.next_state[number]), int(attempts.target[number]))
            if key not in found:
                found[key] = self.value(replay.view(*key[:2]), key[2])
            replay.value[number], replay.valued[number] = found[key], round_
            on_progress(done + 1, len(chosen))
        self.target.load_state_dict(self.online.state_dict())

    @torch.no_grad()
    def value(self, view: View, goal: int) -> float:
        """Q_target of the grasp at an object that Q_online likes best; 0 if it is not seen."""
        cells = view.labels == goal
        if not cells.any():
            return 0.0
        copies = Copies.around(cells, range(GRASP_ROTATIONS), round(MARGIN_M / RESOLUTION_M))
        turned = copies.turn(encode(unpack_height(view.height), view.color))
        x = torch.from_numpy(turned).to(self.device)
        with autocast(self.device):
            q = self.online(x)[:, GRASP].float().cpu().numpy()
        maps = np.zeros((GRASP_ROTATIONS, *cells.shape), np.float32)
        maps[:, copies.rows, copies.cols] = copies.values(q)
        best = best_cells(smoothed(maps, cells, RESOLUTION_M), cells, 1)
        rotation, row, col = int(best.rotation[0]), int(best.row[0]), int(best.col[0])
        chosen = crop(view, GRASP, (row, col), rotation, None, self._crop_cells)[None]
        return float(self._at_middle(self.target, chosen, np.array([GRASP]))[0])

    @torch.no_grad()
    def validate(self, replay: Replay, newest: int) -> dict[str, float]:
        """How well the Q values tell rewarded from unrewarded held-out attempts: `grasp_auc` and `push_auc`."""
        self.online.eval()
        numbers = replay.validation(newest)
        attempts = replay.attempts.take(numbers)
        parts = [numbers[i : i + _VALIDATION_BATCH] for i in range(0, len(numbers), _VALIDATION_BATCH)]
        values = [
            self._at_middle(self.online, self._crops(replay, part, None), replay.attempts.primitive[part]).cpu().numpy()
            for part in parts
        ]
        value = np.concatenate([np.empty(0, np.float32), *values])
        return {
            f"{name}_auc": auc(value[attempts.primitive == kind], attempts.reward[attempts.primitive == kind] > 0)
            for name, kind in (("grasp", GRASP), ("push", PUSH))
        }

    def state(self) -> dict[str, Any]:
        """Everything that learning changes, as tensors and numbers."""
        return {
            "online": self.online.state_dict(),
            "target": self.target.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "updates": self.updates,
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from `state`."""
        self.online.load_state_dict(state["online"])
        self.target.load_state_dict(state["target"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.updates = state["updates"]

    def _crops(
        self, replay: Replay, numbers: npt.NDArray[np.int64], rng: np.random.Generator | None
    ) -> npt.NDArray[np.float32]:
        """(N, 5, S, S) the surroundings of attempts, varied where there is an `rng`."""
        each = zip(*replay.attempts.take(numbers)[:7], strict=True)
        return np.stack(
            [
                crop(replay.view(shard, state), kind, (row, col), rotation, rng, self._crop_cells)
                for shard, state, _, kind, row, col, rotation in (map(int, attempt) for attempt in each)
            ]
        )

    def _at_middle(
        self, network: nn.Module, crops: npt.NDArray[np.float32], primitive: npt.NDArray[np.int64]
    ) -> Tensor:
        """(N,) the Q values in the middle of crops (N, 5, S, S)."""
        x = torch.from_numpy(crops).to(self.device, memory_format=torch.channels_last)
        with autocast(self.device):
            q = network(x)
        middle = crops.shape[-1] // 2
        chosen: Tensor = q.float()[torch.arange(len(x)), torch.from_numpy(primitive), middle, middle]
        return chosen


def auc(values: npt.NDArray[np.float32], positive: npt.NDArray[np.bool_]) -> float:
    """Chance that a positive has a larger value than a negative (area under the ROC); NaN if one kind is missing."""
    positives = int(positive.sum())
    negatives = len(positive) - positives
    if positives == 0 or negatives == 0:
        return math.nan
    ranks = rankdata(values)
    return float((ranks[positive].sum() - positives * (positives + 1) / 2) / (positives * negatives))


def _mean(values: npt.NDArray[np.float32]) -> float:
    return float(values.mean()) if len(values) else math.nan
