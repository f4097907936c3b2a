from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest
import torch

from policy.training.checkpoint import load_checkpoint, save_checkpoint
from robotcell.errors import ConfigError

if TYPE_CHECKING:
    from pathlib import Path


def test_what_is_saved_is_loaded(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pt"
    save_checkpoint(path, {"rounds": 3, "config": "{}", "online": {"weight": torch.arange(5.0)}})
    state = load_checkpoint(path)
    assert state["rounds"] == 3
    assert torch.equal(state["online"]["weight"], torch.arange(5.0))
    assert [file.name for file in tmp_path.iterdir()] == ["checkpoint.pt"]


@pytest.mark.parametrize("keep", [0, 10, 300, -20])
def test_a_truncated_file_is_refused(tmp_path: Path, keep: int) -> None:
    path = tmp_path / "checkpoint.pt"
    save_checkpoint(path, {"rounds": 3, "online": {"weight": torch.arange(500.0)}})
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(ConfigError, match=r"checkpoint\.pt: not a whole checkpoint.*delete it"):
        load_checkpoint(path)


def test_garbage_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(b"garbage" * 100)
    with pytest.raises(ConfigError, match="not a whole checkpoint"):
        load_checkpoint(path)


class Payload:
    """What a malicious file would hold."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, ("touch was-here",)


def test_code_in_a_file_is_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "checkpoint.pt"
    torch.save({"version": 1, "online": Payload()}, path)
    with pytest.raises(ConfigError, match="not a whole checkpoint"):
        load_checkpoint(path)
    assert not (tmp_path / "was-here").exists()


def test_another_version_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pt"
    torch.save({"version": 99}, path)
    with pytest.raises(ConfigError, match="another version"):
        load_checkpoint(path)
