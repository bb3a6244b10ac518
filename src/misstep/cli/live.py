"""``misstep live``: fail by hand, and watch it learn."""

import sys
import threading
import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from misstep.cli.options import JsonFile, SystemParameters, parse_parameters
from misstep.cli.output import check_output_file, write_result
from misstep.errors import MisstepError


def live(
    system: Annotated[
        str, typer.Argument(metavar="SYSTEM", help="A system of `misstep list systems`.")
    ] = "cartpole",
    port: Annotated[
        int, typer.Option(help="Where the page is; 0: any free port.", min=0, max=65535)
    ] = 8000,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Print the address, and open nothing.")
    ] = False,
    data: Annotated[
        Path, typer.Option(metavar="FOLDER", help="Where all that is recorded goes.")
    ] = Path("live"),
    host: Annotated[
        str,
        typer.Option(
            metavar="ADDRESS",
            help="0.0.0.0: answer other machines too, such as a phone, that know the address.",
        ),
    ] = "127.0.0.1",
    set_: SystemParameters = None,
    json: JsonFile = None,
) -> int:
    """Open a page on which you fail by hand and watch it learn.

    It goes on until a Ctrl-C; what was recorded stays in the folder, for the next time and for
    every other command. The result of --json is written when the page can be opened.
    """
    try:
        from misstep.live import server
    except ImportError as error:
        standard = (error.name or "").partition(".")[0] in sys.stdlib_module_names
        way = "use a Python that has it" if standard else "pip install 'misstep[live]'"
        raise MisstepError(f"the live page needs {error.name}: {way}") from error
    import misstep

    parameters = parse_parameters("--set", set_)
    misstep.make_system(system, **parameters)  # what is wrong with it is told before a page opens
    check_output_file(json, "--json")
    token = server.stored_token(data)
    app = server.make_app(data, system, parameters, token)
    with server.open_socket(host, port) as listening:
        url = server.address(host, listening.getsockname()[1], token)

        def started() -> None:
            write_result(
                json,
                {
                    "parameters": {"system": parameters},
                    "system": system,
                    "url": url,
                    "data": str(data),
                },
            )
            print(f"fail by hand at {url}\nrecordings go to {data}; Ctrl-C stops", flush=True)
            if not no_browser:
                threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()

        try:
            server.serve(app, listening, started)
        except KeyboardInterrupt as interrupt:
            kept = f"all that was recorded is in {data}; `misstep live` goes on"
            raise type(interrupt)(kept) from interrupt
    return 0


COMMANDS = [("live", live, "misstep live")]
