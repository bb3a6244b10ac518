"""Whether what went wrong went wrong for want of memory."""

OUT_OF_MEMORY = "error: out of memory: free some, or give it less to do at a time"

_ROOM = 2**26
"""Bytes. What goes wrong where so many cannot be had goes wrong for want of memory."""


def has_room() -> bool:
    """Say whether the system still gives memory to this process."""
    try:
        return len(bytearray(_ROOM)) == _ROOM
    except MemoryError:
        return False
