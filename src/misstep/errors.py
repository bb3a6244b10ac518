"""The one kind of error that a user of misstep is meant to read."""

_LONGEST = 2000  # characters


class MisstepError(ValueError):
    """Bad input, told in one line: what is wrong, where, and what would be right.

    Raised at the borders (files, command line, public functions). The command line prints its
    message alone, without a traceback, and exits with a non-zero code.

    Messages quote input that may come from anybody, and go to terminals and pages. So whatever is
    not printable is shown as an escape, and of a very long line the middle is left out.
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(_one_line(str(message)))


def reason_of(error: BaseException) -> str:
    """Return what an error of somebody else's says, in one line; its type where it says nothing."""
    return " ".join(str(error).split()) or type(error).__name__


def _one_line(text: str) -> str:
    if len(text) > _LONGEST:
        half = _LONGEST // 2
        text = f"{text[:half]} ... {text[-half:]}"
    if text.isprintable():
        return text
    return "".join(sign if sign.isprintable() else _escaped(sign) for sign in text)


def _escaped(sign: str) -> str:
    return " " if sign.isspace() else sign.encode("unicode_escape").decode("ascii")
