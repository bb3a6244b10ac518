"""All commands under one name, and what becomes of errors.

==== ==============================================================================
code meaning
==== ==============================================================================
0    the command did what it claims
1    it ran, and did not: no trial succeeded
2    bad input, or out of memory or disk: one line on stderr says what, where, and what
     would be right
130  interrupted with Ctrl-C
143  terminated with SIGTERM
==== ==============================================================================
"""

import errno
import os
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from misstep.cli import (
    bench,
    catalogue,
    convert,
    evaluate,
    inspect,
    learn,
    live,
    mark,
    record,
    reproduce,
    robot,
    ros,
    serve,
    study,
)
from misstep.cli.interruption import Terminated, interruptible
from misstep.cli.memory import OUT_OF_MEMORY, has_room
from misstep.cli.streams import forgiving_output
from misstep.errors import MisstepError
from misstep.version import __version__


class _Commands(TyperGroup):
    """A group of commands that names them all when asked for one that it does not have."""

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        command = super().get_command(ctx, cmd_name)
        if command is None:
            raise MisstepError(
                f"no command named {cmd_name!r}; there are: {', '.join(self.list_commands(ctx))}"
            )
        return command


# The backspace keeps the help from breaking the line.
_EXAMPLE = "\b\nExample:\n  {}"

# Plain help instead of boxes: it is there at once, and an example in it can be copied.
app = typer.Typer(cls=_Commands, add_completion=False, rich_markup_mode=None)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"misstep {__version__}")
        raise typer.Exit


@app.callback(epilog=_EXAMPLE.format("misstep demonstrate cartpole --by weak -n 4 --out D.h5"))
def misstep(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Learn a working controller from demonstrations that all failed."""


for _module in (
    record,
    learn,
    live,
    serve,
    robot,
    evaluate,
    inspect,
    mark,
    convert,
    reproduce,
    study,
    bench,
    catalogue,
):
    for _name, _command, _example in _module.COMMANDS:
        app.command(_name, epilog=_EXAMPLE.format(_example))(_command)

for _group, _help, _members in ros.GROUPS:
    _commands = typer.Typer(cls=_Commands, add_completion=False, rich_markup_mode=None, help=_help)
    for _name, _command, _example in _members:
        _commands.command(_name, epilog=_EXAMPLE.format(_example))(_command)
    app.add_typer(_commands, name=_group)


def run(words: Sequence[str]) -> int:
    """Run a command, and return its exit code."""
    with interruptible(), forgiving_output():
        return _run(list(words))


def _run(words: list[str]) -> int:
    try:
        command = typer.main.get_command(app)
        # Not `app(...)`, which has its own ideas of interrupts and tracebacks.
        with command.make_context("misstep", words) as context:
            code = command.invoke(context)
        sys.stdout.flush()
    except typer.Exit as exit_:
        return exit_.exit_code
    except (Exception, KeyboardInterrupt) as error:
        told = _explain(error)
        if told is None:
            raise
        return _tell(*told)
    return int(code or 0)


def _explain(error: BaseException) -> tuple[str, int] | None:
    """Return why a command ends and its exit code; None for what is a fault of ours."""
    interrupt: BaseException | None = error
    # A library that is interrupted in mid-import makes an ImportError of it.
    while interrupt is not None and not isinstance(interrupt, KeyboardInterrupt):
        interrupt = interrupt.__cause__
    if interrupt is not None:
        told = ("terminated", 143) if isinstance(interrupt, Terminated) else ("interrupted", 130)
        return "; ".join([told[0], *map(str, interrupt.args)]), told[1]
    if isinstance(error, typer.TyperException):
        return f"error: {_usage(error)}", 2
    if isinstance(error, MisstepError):
        return f"error: {'' if has_room() else 'out of memory: '}{error}", 2
    if isinstance(error, UnicodeEncodeError):  # of a library that takes no bytes for a name
        return "error: a name is no text in UTF-8, as this format needs it: rename what it names", 2
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"error: cannot write: {error.strerror}; free some room", 2
    # Libraries that are refused memory raise anything: ImportError, OSError, SystemError ...
    if isinstance(error, MemoryError) or not has_room():
        return OUT_OF_MEMORY, 2
    return None


def _drop_output() -> None:
    """Let nothing more go to stdout: Python flushes it once more at its end, and would complain."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _tell(message: str, code: int) -> int:
    try:
        sys.stdout.flush()
    except OSError:  # the message matters more than what cannot be printed
        _drop_output()
    print("misstep:", " ".join(message.split()), file=sys.stderr)
    return code


def _usage(error: typer.TyperException) -> str:
    """Say what is wrong with the words of the command line, and what would be right."""
    context = getattr(error, "ctx", None)
    if context is not None and hasattr(error, "possibilities"):  # an unknown option
        options = [o for p in context.command.get_params(context) for o in p.opts if o[0] == "-"]
        return (
            f"`{context.command_path}` has no option {error.option_name}; "  # type: ignore[attr-defined]
            f"there are: {', '.join(options)}"
        )
    message = error.format_message().rstrip(".")
    message = message[:1].lower() + message[1:]
    if context is None:
        return message
    return f"{message}; see `{context.command_path} --help`"
