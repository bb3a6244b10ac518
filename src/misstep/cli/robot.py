"""``misstep drive`` and ``misstep offer``: a simulation in the place of a robot, on either side."""

import os
import secrets
import time
from contextlib import closing
from typing import Annotated

import typer

from misstep.cli.options import JsonFile, SystemName, SystemParameters, parse_parameters
from misstep.cli.output import check_output_file, write_result
from misstep.robot.addresses import TOKEN


def drive(
    system: SystemName,
    address: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Of `misstep serve`.")
    ] = "127.0.0.1:7106",
    set_: SystemParameters = None,
    json: JsonFile = None,
) -> int:
    """Let a simulation be the robot of a `misstep serve`, until its run is finished.

    The token is taken from MISSTEP_TOKEN.
    """
    import misstep
    from misstep.robot.client import RobotClient
    from misstep.robot.client import drive as drive_

    check_output_file(json, "--json")
    simulation = misstep.make_system(system, **parse_parameters("--set", set_))
    with RobotClient(address, name=system) as client:
        drive_(client, simulation)
        status = client.status()
    write_result(json, {"service": status})
    print(f"{status['trials']} trials, {'a' if status['succeeded'] else 'no'} success")
    return 0 if status["succeeded"] else 1


def offer(
    system: SystemName,
    socket: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Listen here: HOST:PORT or unix:PATH.")
    ] = "127.0.0.1:7107",
    set_: SystemParameters = None,
    watchdog_ms: Annotated[
        float, typer.Option(help="Without an action for so long: to the safe action.")
    ] = 500.0,
) -> None:
    """Offer a simulation as the robot `remote` of `misstep learn`, until Ctrl-C.

    On the other side: misstep learn remote --set address=127.0.0.1:7107 --from D.h5
    """
    import misstep
    from misstep.robot.socket_server import SocketServer
    from misstep.robot.system_server import SystemHub

    simulation = misstep.make_system(system, **parse_parameters("--set", set_))
    token = os.environ.get(TOKEN) or secrets.token_urlsafe(16)
    with (
        closing(SystemHub(simulation, token, watchdog=watchdog_ms / 1e3)) as hub,
        closing(SocketServer(hub, socket)) as server,
    ):
        if not os.environ.get(TOKEN):
            print(f"token {token}")
        print(f"listening at {server.address}", flush=True)
        while True:
            time.sleep(1.0)


COMMANDS = [
    ("drive", drive, "MISSTEP_TOKEN=… misstep drive cartpole --address 127.0.0.1:7106"),
    ("offer", offer, "misstep offer cartpole --socket 127.0.0.1:7107"),
]
