"""Folders as one file: what a browser can send and keep of the formats that are folders."""

import zipfile
import zlib
from pathlib import Path

from misstep.errors import MisstepError

PACKED = ".zip"
"""Suffix of a folder that is packed into a file."""
_MOST_UNPACKED, _MOST_PACKED = 512 * 2**20, 5000  # bytes; files


def unpacked(packed: Path) -> Path:
    """Unpack a folder beside the file that it was packed into, and return where it begins.

    Names that lead out of the folder are no concern: `zipfile` leaves such parts of them out.

    Raises
    ------
    MisstepError
        If it is no zip file, damaged, or too large unpacked.
    """
    folder = packed.with_suffix("")
    try:
        with zipfile.ZipFile(packed) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
            if size > _MOST_UNPACKED or len(archive.infolist()) > _MOST_PACKED:
                raise MisstepError(
                    f"unpacked it is larger than {_MOST_UNPACKED // 2**20} MB or has more than "
                    f"{_MOST_PACKED} files: use `misstep convert` on the command line"
                )
            archive.extractall(folder)
    except (zipfile.BadZipFile, zlib.error, RuntimeError, OSError, EOFError) as error:
        raise MisstepError(f"it is no zip file that can be unpacked: {error}") from error
    inside = list(folder.iterdir()) if folder.exists() else []
    return inside[0] if len(inside) == 1 else folder
