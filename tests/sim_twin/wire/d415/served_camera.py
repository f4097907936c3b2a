"""A served camera in its process, which looks at boxes on a table."""

from __future__ import annotations

import multiprocessing
import socket
from typing import TYPE_CHECKING

from robotcell.config import load_config
from sim_twin.options import NoiseOptions
from sim_twin.visual import Visual
from sim_twin.wire.d415.server import serve_camera
from sim_twin.wire.d415.stream import Description, Frame, Request, encode, read_message
from sim_twin.wire.faults import Fault, Kind
from sim_twin.wire.shared_state import Record, poses_dtype
from tests.sim_twin.boxes import table_with_blocks

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from multiprocessing.process import BaseProcess

    import numpy as np

WITHOUT_NOISE = {f"backend.options.noise.{name}": False for name in NoiseOptions.model_fields}
_START_S = 60.0
_CLIENT_S = 20.0
_END_S = 5.0


class ServedCamera:
    """Starts the process of a camera; a context manager that ends it.

    Args:
        host: where it listens.
        port: likewise; 0 for any.
        overrides: of the cell, by dotted key.
        scene: what it looks at, instead of boxes.
    """

    def __init__(
        self,
        host: str,
        port: int = 0,
        overrides: dict[str, object] | None = None,
        scene: tuple[tuple[Visual, ...], np.ndarray] | None = None,
    ) -> None:
        self.config = load_config(None, overrides)
        self.host = host
        self.port = port
        self.visuals, self.poses = scene or _boxes()
        self.process: BaseProcess
        self._faults: Connection

    def __enter__(self) -> ServedCamera:
        self._record = Record(poses_dtype(len(self.visuals)))
        self._record.write(t=0.0, poses=self.poses)
        answer = self.start()
        assert "camera" in answer, answer
        self.port = int(answer["camera"].rpartition(":")[2])
        return self

    def __exit__(self, *_: object) -> None:
        self.end()
        self._record.close()

    @property
    def address(self) -> str:
        return f"{self.host}:{self.port}"

    @property
    def source(self) -> str:
        """As `D415Options.source`."""
        return f"twin://{self.address}"

    def start(self) -> dict[str, str]:
        """Start the process; what it says when it is ready."""
        context = multiprocessing.get_context("spawn")
        self._faults, faults = context.Pipe()
        ready, tell_ready = context.Pipe(duplex=False)
        arguments = (self.host, self.port, self.config, self.visuals, self._record.name, faults, tell_ready)
        self.process = context.Process(target=serve_camera, args=arguments)
        self.process.start()
        faults.close()
        tell_ready.close()
        with ready:
            assert ready.poll(_START_S)
            answer: dict[str, str] = ready.recv()
        return answer

    def end(self) -> int | None:
        """End the process as a supervisor that dies does; its exit code."""
        self._faults.close()
        self.process.join(_END_S)
        code = self.process.exitcode
        self.process.kill()
        self.process.join()
        return code

    def inject(self, *faults: tuple[str, Kind, str, float | None]) -> None:
        """Give it these faults and no others."""
        self._faults.send(tuple(Fault("camera", *fault) for fault in faults))

    def move(self, index: int, by: tuple[float, float, float]) -> None:
        """Move a box."""
        self.poses = self.poses.copy()
        self.poses[index, :3, 3] += by
        self._record.write(poses=self.poses)


def _boxes() -> tuple[tuple[Visual, ...], np.ndarray]:
    world = table_with_blocks()
    return tuple(Visual(box.vertices, box.triangles, box.color, "object") for box in world.boxes), world.poses


class RawClient:
    """A client that speaks the protocol of the frames itself."""

    def __init__(self, camera: ServedCamera, resolution: str = "640x480") -> None:
        self.connection = socket.create_connection((camera.host, camera.port), _CLIENT_S)
        self.stream = self.connection.makefile("rb")
        self.connection.sendall(encode(Request(resolution=resolution)))

    def __enter__(self) -> RawClient:
        description = read_message(self.stream)
        assert isinstance(description, Description)
        self.description = description
        return self

    def __exit__(self, *_: object) -> None:
        self.stream.close()
        self.connection.close()

    def frame(self) -> Frame:
        frame = read_message(self.stream)
        assert isinstance(frame, Frame)
        return frame

    def depth_m(self) -> np.ndarray:
        return self.frame().depth.pixels * self.description.depth_unit_m
