"""`robotcell twin`: the options of the commands that serve a simulated cell, give it faults and record its camera."""

from __future__ import annotations

from pathlib import Path  # noqa: TC003 - typer reads it
from typing import Annotated

import typer

from cli.options import CellChoice, CellFile, Meshes, Objects, Scene, Seed, Settings, Verbose

app = typer.Typer(
    help="The simulated cell behind the devices' own protocols.", no_args_is_help=True, pretty_exceptions_enable=False
)


@app.command()
def serve(
    host: Annotated[str, typer.Option(help="Address on which everything listens.")] = "127.0.0.2",
    modbus_port: Annotated[int, typer.Option(min=0, max=65535, help="Of the Compute Box.")] = 1502,
    camera_port: Annotated[int, typer.Option(min=0, max=65535, help="Of the camera's frames.")] = 30415,
    control_port: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help="Of the control socket for faults; none unless given.", show_default=False),
    ] = None,
    cell: CellFile = None,
    settings: Settings = None,
    scene: Scene = None,
    meshes: Meshes = None,
    objects: Objects = None,
    seed: Seed = None,
    expose: Annotated[
        bool, typer.Option("--expose", help="Listen on an address that other machines can reach.")
    ] = False,
    verbose: Verbose = False,
) -> None:
    """Serve a UR5e, an RG2 and a D415 in real time, for any client that speaks their protocols, until interrupted.

    Exit codes: 0 interrupted or terminated, 2 usage or configuration, 3 a server died.
    """
    from cli.twin import Ports, run_serve

    options = {"--scene": scene, "--meshes": meshes, "--objects": objects, "--seed": seed}
    ports = Ports(modbus_port, camera_port, control_port)
    raise typer.Exit(run_serve(CellChoice(cell, settings, options), host, ports, expose=expose))


@app.command()
def fault(
    control: Annotated[str, typer.Option(help="Address of the control socket, host:port.")],
    words: Annotated[list[str] | None, typer.Argument(metavar="DEVICE CHANNEL KIND [WHAT]")] = None,
    value: Annotated[
        float | None, typer.Option(help="Seconds, share or number that the fault needs.", show_default=False)
    ] = None,
    clear: Annotated[bool, typer.Option("--clear", help="End all faults first.")] = False,
    list_: Annotated[bool, typer.Option("--list", help="Show which faults exist and which are on.")] = False,
) -> None:
    """Give a served cell a fault, such as: gripper modbus stuck.

    Exit codes: 0 done, 2 no such fault, 3 nothing is served there.
    """
    from cli.twin import run_fault

    raise typer.Exit(run_fault(words or [], value, control, clear=clear, show=list_))


@app.command()
def record(
    out: Annotated[Path, typer.Option(help="The .db3 file to write.")],
    seconds: Annotated[float, typer.Option(min=0.1, max=60, help="How long.")] = 3.0,
    cell: CellFile = None,
    settings: Settings = None,
    scene: Scene = None,
    meshes: Meshes = None,
    objects: Objects = None,
    seed: Seed = None,
    verbose: Verbose = False,
) -> None:
    """Record what the camera sees of a scene, for librealsense to play, or as camera.source of a cell.

    Exit codes: 0 recorded, 2 usage or configuration, 3 the recording failed.
    """
    from cli.twin_record import run_record

    options = {"--scene": scene, "--meshes": meshes, "--objects": objects, "--seed": seed}
    raise typer.Exit(run_record(CellChoice(cell, settings, options), out, seconds))
