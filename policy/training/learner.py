"""Double DQN on dense Q maps."""

from __future__ import annotations

import copy
import math
from contextlib import nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch
from scipy.stats import rankdata
from torch.nn import functional

from policy.encoding import encode
from policy.selection import push_mask
from policy.training.augment import augment
from policy.training.shard import GRASP, PUSH, unpack_height

if TYPE_CHECKING:
    from collections.abc import Sequence
    from contextlib import AbstractContextManager

    from torch import Tensor, nn

    from policy.training.config import LearningSettings
    from policy.training.replay import Replay, Sample, View

_VALIDATION_BATCH = 8


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
        stage: 1 or 2; in stage 2 the best next action is sought at the target object only.
        planned_updates: of the stage; learning rate and beta follow them.
        seed: makes what is drawn and how it is augmented a function of the number of the update.
    """

    def __init__(
        self, network: nn.Module, settings: LearningSettings, stage: int, planned_updates: int, seed: int
    ) -> None:
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
        """Draw a batch, learn from it, and tell the replay how wrong the network was."""
        settings = self._settings
        rng = np.random.default_rng([self._seed, self._stage, self.updates])
        beta = settings.priority_beta_start + (1 - settings.priority_beta_start) * self.progress
        indices, weights = replay.draw(settings.batch, beta, rng)
        samples = [
            augment(replay.sample(int(index), settings.next_states, rng), settings.crop_cells, rng) for index in indices
        ]
        losses, errors = self.learn(samples, weights)
        known = ~np.isnan(errors)
        replay.update(indices[known], errors[known])
        return losses

    def learn(
        self, samples: Sequence[Sample], weights: npt.NDArray[np.float32]
    ) -> tuple[Losses, npt.NDArray[np.float32]]:
        """One step of Adam.

        Args:
            samples: B states with their attempts.
            weights: (B,) importance of each.

        Returns:
            The losses, and (B,) the mean |TD error| of each sample; NaN for one that has no attempts left.
        """
        targets = self.targets(samples)
        owner = np.repeat(np.arange(len(samples)), [len(sample.reward) for sample in samples])
        primitive = np.concatenate([sample.primitive for sample in samples])
        self.online.train()
        with _autocast(self.device):
            grasp, push = self.online(self._encode([sample.view for sample in samples]))
        chosen = _at_attempts(grasp.float(), push.float(), samples)
        wanted = targets.to(self.device)
        importance = torch.from_numpy(weights[owner]).to(self.device)
        each = importance * functional.smooth_l1_loss(chosen, wanted, reduction="none")
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
        if self.updates % self._settings.target_sync == 0:
            self.target.load_state_dict(self.online.state_dict())
        errors = (chosen.detach() - wanted).abs().cpu().numpy()
        sums = np.bincount(owner, weights=errors, minlength=len(samples))
        count = np.bincount(owner, minlength=len(samples))
        mean = np.divide(sums, count, out=np.full(len(samples), np.nan), where=count > 0)
        grasp_loss, push_loss = (_mean(values.detach().cpu().numpy()) for values in (grasps, pushes))
        losses = Losses(grasp_loss, push_loss, _mean(errors))
        return losses, mean.astype(np.float32)

    @torch.no_grad()
    def targets(self, samples: Sequence[Sample]) -> Tensor:
        """(N,) float32 of all attempts in their order: y = r + gamma Q_target(s', argmax_a Q_online(s', a)).

        The maximum runs over grasps at the object (stage 1: at all objects) and pushes of what is within 30 mm of it.
        y = r where the attempt ended its episode or nothing is left to act on.
        """
        targets = torch.from_numpy(np.concatenate([sample.reward for sample in samples])).float()
        views = [view for sample in samples for view in sample.views_after]
        if not views:
            return targets
        self.online.eval()
        encoded = self._encode(views)
        with _autocast(self.device):
            online, target = (network(encoded) for network in (self.online, self.target))
        # Which object's future a state is worth depends on the attempt, so each pair of both is looked up once.
        values: dict[tuple[int, int], float] = {}
        first_attempt = first_view = 0
        for sample in samples:
            for i in np.flatnonzero(sample.following >= 0):
                view = first_view + int(sample.following[i])
                goal = int(sample.target[i]) if self._stage == 2 else 0
                if (view, goal) not in values:
                    values[view, goal] = _double_q(
                        tuple(maps[view].float() for maps in online),
                        tuple(maps[view].float() for maps in target),
                        views[view].labels,
                        goal,
                    )
                targets[first_attempt + i] += self._settings.gamma * values[view, goal]
            first_attempt += len(sample.reward)
            first_view += len(sample.views_after)
        return targets

    @torch.no_grad()
    def validate(self, samples: Sequence[Sample]) -> dict[str, float]:
        """How well the Q values tell rewarded from unrewarded attempts: `grasp_auc` and `push_auc`."""
        self.online.eval()
        values = []
        for start in range(0, len(samples), _VALIDATION_BATCH):
            batch = samples[start : start + _VALIDATION_BATCH]
            with _autocast(self.device):
                grasp, push = self.online(self._encode([sample.view for sample in batch]))
            values.append(_at_attempts(grasp.float(), push.float(), batch).cpu().numpy())
        if not values:
            return {"grasp_auc": math.nan, "push_auc": math.nan}
        value = np.concatenate(values)
        rewarded = np.concatenate([sample.reward for sample in samples]) > 0
        primitive = np.concatenate([sample.primitive for sample in samples])
        return {
            f"{name}_auc": auc(value[primitive == kind], rewarded[primitive == kind])
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

    def _encode(self, views: Sequence[View]) -> Tensor:
        encoded = np.stack([encode(unpack_height(view.height), view.color) for view in views])
        return torch.from_numpy(encoded).to(self.device, memory_format=torch.channels_last)


def auc(values: npt.NDArray[np.float32], positive: npt.NDArray[np.bool_]) -> float:
    """Chance that a positive has a larger value than a negative (area under the ROC); NaN if one kind is missing."""
    positives = int(positive.sum())
    negatives = len(positive) - positives
    if positives == 0 or negatives == 0:
        return math.nan
    ranks = rankdata(values)
    return float((ranks[positive].sum() - positives * (positives + 1) / 2) / (positives * negatives))


def _at_attempts(grasp: Tensor, push: Tensor, samples: Sequence[Sample]) -> Tensor:
    """(N,) the Q values of all attempts, in their order."""
    owner = np.repeat(np.arange(len(samples)), [len(sample.reward) for sample in samples])
    kind, plane, row, col = (
        np.concatenate([getattr(sample, name) for sample in samples]).astype(np.int64)
        for name in ("primitive", "rotation", "row", "col")
    )
    maps = torch.cat([grasp, push], dim=1)
    plane = plane + np.where(kind == PUSH, grasp.shape[1], 0)
    places = (torch.from_numpy(index).to(maps.device) for index in (owner, plane, row, col))
    return maps[tuple(places)]


def _mean(values: npt.NDArray[np.float32]) -> float:
    return float(values.mean()) if len(values) else math.nan


def _double_q(
    online: tuple[Tensor, ...], target: tuple[Tensor, ...], labels: npt.NDArray[np.uint8], goal: int
) -> float:
    """Q_target of the action that Q_online likes best among those that concern the goal; 0 if it is not seen.

    Args:
        online: Q maps of grasps and pushes of one state, (planes, H, W) each.
        target: the same of the target network.
        labels: (H, W) of the objects.
        goal: label of the goal; 0 for any object.
    """
    objects = labels > 0
    mask = labels == goal if goal else objects
    if not mask.any():
        return 0.0
    device = online[0].device
    best, value = -math.inf, 0.0
    for online_maps, target_maps, cells in zip(online, target, (mask, push_mask(mask, objects)), strict=True):
        flat = torch.from_numpy(np.flatnonzero(cells)).to(device)
        candidates = online_maps.flatten(1)[:, flat].flatten()
        choice = int(candidates.argmax())
        if float(candidates[choice]) > best:
            best = float(candidates[choice])
            value = float(target_maps.flatten(1)[:, flat].flatten()[choice])
    return value


def _autocast(device: torch.device) -> AbstractContextManager[None]:
    """bfloat16 where the processor has instructions for it; losses stay float32."""
    if device.type == "cuda" or _cpu_has_bfloat16():
        return torch.autocast(device.type, torch.bfloat16)
    return nullcontext()


def _cpu_has_bfloat16() -> bool:
    abilities = torch.cpu.get_capabilities()
    return bool(abilities.get("avx512_bf16") or abilities.get("amx_bf16") or abilities.get("bf16"))
