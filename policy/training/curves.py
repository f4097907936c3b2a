"""How a training run goes, as one picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from robotcell.io.atomic_file import replaced

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

# Title, axis, and which metrics a panel shows under which name.
_PANELS: tuple[tuple[str, str, dict[str, str]], ...] = (
    ("Grasps", "rewarded", {"greedy_grasp_success": "greedy", "grasp_success": "all"}),
    ("Pushes", "rewarded", {"push_rewarded": "all"}),
    ("Held-out scenes", "area under ROC", {"grasp_auc": "grasp", "push_auc": "push"}),
    ("Loss", "Huber", {"grasp_loss": "grasp", "push_loss": "push"}),
    ("Error", "mean |TD error|", {"td_error": "all attempts"}),
    ("Learning rate and exploration", "", {"learning_rate": "learning rate", "exploration": "exploration"}),
)
# Axes that run from 0 to 1.
_PARTS = ("rewarded", "area under ROC")
_ROOM = {"left": 0.05, "right": 0.985, "bottom": 0.07, "top": 0.95, "wspace": 0.22, "hspace": 0.28}


def draw_curves(history: Sequence[dict[str, float]], path: Path) -> None:
    """Draw the metrics of all rounds as a PNG; a line marks where stage 2 begins. Replaces the file at once."""
    figure = Figure(figsize=(13, 7))
    FigureCanvasAgg(figure)
    # Room for titles and labels. A layout that measures them draws everything three times, after every round.
    panels = figure.subplots(2, 3, gridspec_kw=_ROOM)
    rounds = range(1, len(history) + 1)
    boundaries = [i + 0.5 for i in range(1, len(history)) if history[i]["stage"] != history[i - 1]["stage"]]
    for axes, (title, label, names) in zip(panels.flat, _PANELS, strict=True):
        for key, name in names.items():
            axes.plot(rounds, [line[key] for line in history], marker=".", label=name)
        for boundary in boundaries:
            axes.axvline(boundary, color="gray", linestyle="--", linewidth=1)
        axes.set(title=title, xlabel="round", ylabel=label)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.grid(alpha=0.3)
        if label in _PARTS:
            axes.set_ylim(0, 1)
        axes.legend()
    figure.axes[-1].set_yscale("log")
    with replaced(path) as part:
        figure.savefig(part, format="png", dpi=100)
