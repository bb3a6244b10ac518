"""The one kind of error that a user of misstep is meant to read."""


class MisstepError(ValueError):
    """Bad input, told in one line: what is wrong, where, and what would be right.

    Raised at the borders (files, command line, public functions). The command line prints its
    message alone, without a traceback, and exits with a non-zero code.
    """
