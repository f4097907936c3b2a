from __future__ import annotations

import os
import signal
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from robotcell.errors import StorageError
from robotcell.io.lock_file import LockFile, holder

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(autouse=True)
def _own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


def test_one_at_a_time_has_it_and_the_others_learn_who() -> None:
    first, second = LockFile("arm-192.168.1.10"), LockFile("arm-192.168.1.10")
    assert holder("arm-192.168.1.10") is None
    assert first.acquire() is None
    assert first.acquire() is None, "it is ours already"
    owner = second.acquire()
    assert owner is not None
    assert (owner.token, owner.pid) == (first.token, os.getpid())
    assert str(os.getpid()) in str(owner)
    assert holder("arm-192.168.1.10") == owner
    first.release()
    first.release()
    assert holder("arm-192.168.1.10") is None
    assert second.acquire() is None
    second.release()


def test_the_lock_of_a_process_that_was_killed_is_free() -> None:
    code = "from robotcell.io.lock_file import LockFile\nLockFile('cell').acquire()\nprint('held', flush=True)\ninput()"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        owner = holder("cell")
        assert owner is not None
        assert owner.pid == process.pid
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert holder("cell") is None
    lock = LockFile("cell")
    assert lock.acquire() is None
    lock.release()


def test_whoever_asks_does_not_keep_others_out() -> None:
    lock = LockFile("cell")
    for _ in range(20):
        assert holder("cell") is None
        assert lock.acquire() is None
        lock.release()


def test_a_name_is_no_path(tmp_path: Path) -> None:
    lock = LockFile("../../arm 1/x")
    lock.acquire()
    assert [path.name for path in (tmp_path / "robotcell").iterdir()] == [".._.._arm_1_x.lock"]
    lock.release(forget=True)
    assert not list((tmp_path / "robotcell").iterdir())


def test_a_folder_that_is_a_link_is_refused(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "robotcell").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(StorageError, match="not yours"):
        LockFile("cell").acquire()
