"""Errors: told apart by class and code, and whole after a way through another process."""

from __future__ import annotations

import copy
import pickle

import pytest

from robotcell.errors import (
    CalibrationError,
    CellError,
    ConfigError,
    ConnectionLost,
    DeviceFault,
    GuardTripped,
    NoTarget,
    StorageError,
    UnsafeMotion,
)

CODES: dict[type[CellError], str] = {
    ConfigError: "config",
    ConnectionLost: "connection-lost",
    DeviceFault: "device-fault",
    UnsafeMotion: "unsafe-motion",
    GuardTripped: "guard-tripped",
    CalibrationError: "calibration",
    NoTarget: "no-target",
    StorageError: "storage",
}


def test_each_class_has_its_code() -> None:
    assert {kind: kind.code for kind in CellError.__subclasses__()} == CODES


@pytest.mark.parametrize("kind", CODES)
def test_message_and_device_survive_copying_and_pickling(kind: type[CellError]) -> None:
    error = kind("it is gone; plug it in", device="camera")
    for same in (error, copy.copy(error), copy.deepcopy(error), pickle.loads(pickle.dumps(error))):
        assert type(same) is kind
        assert str(same) == "it is gone; plug it in"
        assert same.device == "camera"


@pytest.mark.parametrize("kind", CODES)
def test_an_error_is_about_no_device_unless_one_is_named(kind: type[CellError]) -> None:
    assert kind("a word").device is None


@pytest.mark.parametrize(
    ("kind", "builtin"), [(ConnectionLost, ConnectionError), (StorageError, OSError), (ConfigError, ValueError)]
)
def test_the_builtin_that_fits_catches_it(kind: type[CellError], builtin: type[Exception]) -> None:
    with pytest.raises(builtin, match="a word"):
        raise kind("a word")
