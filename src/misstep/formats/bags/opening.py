"""A bag, opened so that a few kilobytes are not unpacked into as much memory as they claim.

rosbags unpacks whatever a bag holds in one go. So the functions that it unpacks with are replaced
by ones that stop: in its table for MCAP, which opening a file goes through already, and in each
chunk of a ROS 1 bag. Bags of ROS 2 that are packed file by file are measured before; messages that
are packed one by one are unpacked here. What has no end although it is not packed, refuses
`misstep.formats.bags.endless`.
"""

import bz2
import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from misstep.errors import MisstepError
from misstep.formats.bags.endless import check_base, check_types, endless_texts_refused, replaced
from misstep.formats.libraries import library_errors

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

_LARGEST_CHUNK = 2**28  # bytes, unpacked
_LARGEST_YAML = 2**21  # bytes; about 8 s
_LONGEST_ARRAY = 2**24  # elements
_LARGEST_RATIO = 100  # of the size of a file to its packed size; recordings reach 20
_SMALL = 2**24  # bytes: whatever the ratio, no harm

_SQLITE = b"SQLite format 3\x00"
# What files begin with, by suffix: rosbags would look for an index in gigabytes of anything else.
_MAGIC = {".bag": b"#ROSBAG V2.0\n", ".mcap": b"\x89MCAP0\r\n", ".db3": _SQLITE}
# A frame, or one to be skipped.
_ZSTD = re.compile(rb"\x28\xb5\x2f\xfd|[\x50-\x5f]\x2a\x4d\x18", re.DOTALL)

Unpack = Callable[[bytes], bytes]


@contextmanager
def opened(path: Path) -> Iterator[tuple["AnyReader", Unpack]]:
    """Open a bag; yield its reader, and what unpacks the messages that it hands on.

    Raises
    ------
    MisstepError
        If it is damaged, or would take up more memory or disk than a recording can need.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.rosbag2 import storage_mcap
    from rosbags.typesys import Stores, get_typestore

    metadata = path / "metadata.yaml"
    if metadata.is_file() and metadata.stat().st_size > _LARGEST_YAML:
        raise MisstepError("metadata.yaml is too large to be one")
    with replaced(
        storage_mcap.DECOMPRESSORS,
        lz4=lambda packed, size: _unpacked(_lz4(), packed, size),
        zstd=lambda packed, size: _unpacked(_zstd(), packed, size),
    ):
        with library_errors("it"), endless_texts_refused():
            for file in sorted(path.iterdir()) if path.is_dir() else (path,):
                if file.is_file():
                    _check_file(file)
            reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            reader.open()
        try:
            with library_errors("it"):
                reader.typestore.max_sequence_length = _LONGEST_ARRAY
                check_types(reader.typestore.fielddefs)
                unpack: Unpack = bytes
                for part in reader.readers:
                    unpack = _bound(part)
            yield reader, unpack
        finally:
            with library_errors("it"):
                reader.close()


def _bound(part: Any) -> Unpack:
    """Bound what an open bag unpacks; return what unpacks its messages."""
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag1.reader import decompressors

    if isinstance(part, Reader1):
        bounded = {
            decompressors["bz2"]: lambda packed: _unpacked(bz2.BZ2Decompressor(), packed),
            decompressors["lz4"]: lambda packed: _unpacked(_lz4(), packed),
        }
        for place, chunk in part.chunks.items():
            if chunk.datasize > _LARGEST_CHUNK:
                raise MisstepError(f"a chunk of {chunk.datasize} bytes is too large")
            unpack = bounded.get(chunk.decompressor, chunk.decompressor)
            part.chunks[place] = chunk._replace(decompressor=unpack)
        return bytes
    storage = part.storage
    if storage.metadata.compression_mode == "message":
        storage.metadata = storage.metadata._replace(compression_mode=None)
        return lambda packed: _unpacked(_zstd(), packed)
    return bytes


def _lz4() -> Any:
    from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]

    return LZ4FrameDecompressor()


def _zstd_module() -> Any:
    from rosbags.rosbag2 import reader

    return reader.zstd  # part of Python from 3.14 on, and before that a library


def _zstd() -> Any:
    return _zstd_module().ZstdDecompressor()


def _unpacked(decompressor: Any, packed: bytes, size: int = _LARGEST_CHUNK) -> bytes:
    """Undo the packing of one piece, never making more than `size` bytes of it."""
    most = min(size, _LARGEST_CHUNK)
    plain: bytes = decompressor.decompress(packed, most + 1)
    if len(plain) > most:
        raise MisstepError(f"a chunk unpacks to more than {most} bytes: it is damaged or too large")
    if not decompressor.eof or decompressor.unused_data:
        raise MisstepError("a chunk is longer or shorter than it has to be")
    return plain


def _check_file(file: Path) -> None:
    """Refuse a file that would fill the disk or never end."""
    with open(file, "rb") as start:
        beginning = start.read(len(_SQLITE))
    magic = _MAGIC.get(file.suffix.lower(), b"")
    if beginning and not beginning.startswith(magic):
        raise MisstepError(f"{file.name} does not begin as a {file.suffix} file does")
    if beginning == _SQLITE:
        check_base(file)
    elif _ZSTD.match(beginning):
        with tempfile.TemporaryDirectory() as folder:
            plain = Path(folder, file.stem)
            _unpack_file(file, plain)
            with open(plain, "rb") as start:
                is_base = start.read(len(_SQLITE)) == _SQLITE
            if is_base:
                check_base(plain)


def _unpack_file(file: Path, plain: Path) -> None:
    """Unpack a file as rosbags is about to, unless it is packed more densely than recordings."""
    most = max(_SMALL, _LARGEST_RATIO * file.stat().st_size)
    size = 0
    with _zstd_module().open(file, "rb") as unpacked, open(plain, "wb") as written:
        for piece in iter(partial(unpacked.read, 2**20), b""):
            size += len(piece)
            if size > most:
                raise MisstepError(
                    f"{file.name} unpacks to more than {_LARGEST_RATIO} times its size: if it is "
                    "meant to, unpack it with zstd before"
                )
            written.write(piece)
