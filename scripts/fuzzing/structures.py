"""Hostile structures: files that are whole for the library that wrote them, and lie all the same.

Damage to bytes seldom gets past a checksum or a compression. So members of HDF5 files, columns of
tables, rows of data bases and messages of bags are changed through the libraries that write them.
"""

import io
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.random import Generator

from fuzzing.damage import (
    TEXTS,
    a_few,
    damaged,
    damaged_json,
    damaged_text,
    hostile_value,
    one_of,
)

_DTYPES = ("f8", ">f8", "f4", "f2", "i8", "u8", "i1", "?", "c16", "S4", "V3", "(2,)f8")
_SHAPES = ((), (0,), (1,), (3,), (4,), (3, 1), (4, 2), (4, 0), (3, 1, 1), (2**20, 2), (2, 2**40))


# HDF5


def damage_hdf5(rng: Generator, path: Path) -> None:
    """Change members and attributes of an HDF5 file."""
    with h5py.File(path, "r+") as file:
        for _ in range(a_few(rng)):
            members = ["/"]
            try:
                file.visit(members.append)
                _change_member(rng, file, members)
            except (OSError, ValueError, TypeError, KeyError, RuntimeError, OverflowError):
                continue  # the library itself does not write that


def _change_member(rng: Generator, file: h5py.File, members: list[str]) -> None:
    name = one_of(rng, members)
    member = file[name]
    what = rng.random()
    if what < 0.35 or name == "/":
        _change_attribute(rng, member)
    elif what < 0.45:
        del file[name]
    elif what < 0.55:
        del file[name]
        file[name] = _hostile_link(rng, file, members)
    elif isinstance(member, h5py.Dataset) and what < 0.75 and member.size and member.size < 10**5:
        values = np.array(member[()]).astype("f8", copy=True)
        values.ravel()[int(rng.integers(values.size))] = one_of(rng, (np.nan, np.inf, 1e308, -7.0))
        if member.dtype.kind in "f":
            member[...] = values
    else:
        del file[name]
        _put_dataset(rng, file, name)


def _change_attribute(rng: Generator, owner: Any) -> None:
    name = one_of(rng, [*owner.attrs, "misstep_format", "x"])
    what = rng.random()
    if what < 0.1:
        owner.attrs.__delitem__(name)
        return
    value = owner.attrs.get(name)
    if isinstance(value, bytes | np.bytes_ | str) and what < 0.8:
        text = value.decode("utf-8", "replace") if isinstance(value, bytes) else value
        changed = damaged_json(rng, text)[:60000]
        raw = changed.replace("\x00", "").encode("utf-8", "replace")
        owner.attrs[name] = np.bytes_(raw or b" ") if isinstance(value, bytes) else changed
        return
    if isinstance(value, np.generic) and what < 0.8:
        number = one_of(rng, (0, 1, -1, 2, 3, 4, 2**31, 2**63 - 1, -(2**62), np.nan, np.inf, 0.1))
        owner.attrs[name] = np.array(number).astype(value.dtype)[()] if what < 0.6 else number
        return
    owner.attrs[name] = one_of(
        rng,
        (
            np.zeros(3),
            np.zeros((0,)),
            h5py.Empty("f8"),
            np.void(b"abc"),
            "a text",
            np.bytes_(b"\xff\xfe"),
            ["several", "texts"],
            1 + 2j,
            np.array((1, 2.0), dtype=[("a", "i4"), ("b", "f8")]),
            h5py.h5r.Reference(),
        ),
    )


def _hostile_link(rng: Generator, file: h5py.File, members: list[str]) -> Any:
    return one_of(
        rng,
        (
            h5py.SoftLink(one_of(rng, members)),
            h5py.SoftLink("/nowhere"),
            h5py.ExternalLink("/etc/passwd", "/"),
            h5py.ExternalLink("other.h5", "/a"),
            file[one_of(rng, members)],  # a hard link, perhaps to a group around it
            file["/"],
        ),
    )


def _put_dataset(rng: Generator, file: h5py.File, name: str) -> None:
    """Make an array of any type, shape and layout, of which little or nothing is stored."""
    shape = one_of(rng, _SHAPES)
    size = int(np.prod(shape, dtype=float)) if shape else 1
    what = rng.random()
    if what < 0.1:
        layout = h5py.VirtualLayout((4, 2), "f8")
        layout[:] = h5py.VirtualSource("/etc/passwd", "x", (4, 2))
        file.create_virtual_dataset(name, layout)
    elif what < 0.2:
        file.create_dataset(name, (100,), "f8", external=[("/etc/passwd", 0, 800)])
    elif what < 0.3:
        texts = h5py.string_dtype() if rng.random() < 0.5 else h5py.vlen_dtype("f8")
        file.create_dataset(name, (3,), texts)
    elif what < 0.6 and shape and 0 not in shape:
        chunks = tuple(min(n, int(2 ** rng.integers(0, 12))) for n in shape)
        packing = one_of(
            rng,
            (
                {},
                {"compression": "gzip"},
                {"compression": "gzip", "shuffle": True},
                {"compression": "lzf"},
                {"fletcher32": True},
                {"scaleoffset": 3},
            ),
        )
        dtype = one_of(rng, ("f8", "i4", "?"))
        made = file.create_dataset(name, shape, dtype, chunks=chunks, maxshape=shape, **packing)
        if size < 10**4:
            made[...] = 1
    else:
        small = shape if size < 10**4 else (4,)
        file.create_dataset(name, data=np.zeros(small, one_of(rng, _DTYPES)))


# Tables of Arrow: Parquet files, and the stream files of Minari


def damaged_table(rng: Generator, table: Any) -> Any:
    """Return a table some of whose columns are lost, doubled, renamed or of another type."""
    import pyarrow as pa

    names, columns = list(table.column_names), list(table.columns)
    for _ in range(a_few(rng)):
        if not columns:
            break
        at = int(rng.integers(len(columns)))
        what = rng.random()
        if what < 0.08:
            del names[at], columns[at]
        elif what < 0.16:
            names.insert(at, names[at])
            columns.insert(at, columns[at])
        elif what < 0.3:
            words = (*names, "", "episode", "t", "__class__", "a\nb", "\x1b[2J", "x" * 5000)
            names[at] = one_of(rng, words)
        elif what < 0.5:
            columns[at] = _changed_values(rng, columns[at])
        else:
            columns[at] = hostile_column(rng, table.num_rows)
    if rng.random() < 0.1:
        return pa.table(columns, names=names).slice(0, int(rng.integers(table.num_rows + 1)))
    return pa.table(columns, names=names)


def _changed_values(rng: Generator, column: Any) -> Any:
    """Return a column in which some values are others of the same type, or none."""
    import pyarrow as pa

    if pa.types.is_temporal(column.type):
        column = column.cast(pa.int64())
    values = column.to_pylist()
    for _ in range(a_few(rng)):
        at = int(rng.integers(len(values))) if values else 0
        if not values:
            break
        worthy = (None, values[0], values[-1], 0, -1, 2**62, float("nan"), float("inf"), "")
        values[at] = one_of(rng, worthy)
    try:
        return pa.array(values, column.type)
    except (pa.ArrowException, TypeError, ValueError, OverflowError):
        return pa.array([None] * len(values), column.type)


def hostile_column(rng: Generator, rows: int) -> Any:
    """Return a column of a type that is seldom expected."""
    import pyarrow as pa

    numbers = rng.normal(size=rows) * 10.0 ** rng.integers(-300, 300)
    makers: tuple[Callable[[], Any], ...] = (
        lambda: pa.array(numbers),
        lambda: pa.array(numbers.astype(np.float16)),
        lambda: pa.array(rng.integers(-(2**62), 2**62, rows)),
        lambda: pa.array([str(x) for x in numbers]),
        lambda: pa.array([one_of(rng, TEXTS) for _ in range(rows)]),
        lambda: pa.array([rng.bytes(5) for _ in range(rows)]),
        lambda: pa.nulls(rows),
        lambda: pa.array([None] * rows, pa.float64()),
        lambda: pa.array([[1.0] * int(rng.integers(4)) for _ in range(rows)]),
        lambda: pa.array([[[1.0, 2.0]] for _ in range(rows)]),
        lambda: pa.array([{"a": 1.0, "b": "x"} for _ in range(rows)]),
        lambda: pa.array([True] * rows),
        lambda: pa.array(rng.integers(0, 2**62, rows), pa.timestamp("ns")),
        lambda: pa.array(rng.integers(0, 2**40, rows), pa.duration("us")),
        lambda: pa.array(["a"] * rows).dictionary_encode(),
        lambda: pa.array(numbers.astype(int) % 7).cast(pa.decimal128(38, 2)),
        lambda: pa.array([[1.0, 2.0]] * rows, pa.list_(pa.float32(), 2)),
        lambda: pa.array([[]] * rows, pa.list_(pa.float64(), 0)),
        lambda: pa.array([[("k", 1.0)]] * rows, pa.map_(pa.string(), pa.float64())),
    )
    return one_of(rng, makers)()


def damage_parquet(rng: Generator, path: Path) -> None:
    """Change the columns of a Parquet file, and how it is stored."""
    import pyarrow as pa
    from pyarrow import parquet

    table = damaged_table(rng, parquet.ParquetFile(path).read(use_threads=False))
    packing = one_of(rng, ("none", "snappy", "gzip", "zstd", "lz4", "brotli"))
    buffer = io.BytesIO()
    try:
        parquet.write_table(
            table,
            buffer,
            compression=packing,
            use_dictionary=bool(rng.random() < 0.5),
            row_group_size=int(2 ** rng.integers(8)),
            data_page_version=one_of(rng, ("1.0", "2.0")),
        )
    except (pa.ArrowException, ValueError, TypeError):
        return  # not every type can be stored
    path.write_bytes(_perhaps_damaged(rng, buffer.getvalue()))


def damage_arrow(rng: Generator, path: Path) -> None:
    """Change the columns of a file of Arrow's IPC format."""
    import pyarrow as pa

    with pa.OSFile(str(path)) as file:
        table = pa.ipc.open_file(file).read_all()
    table = damaged_table(rng, table)
    with pa.OSFile(str(path), "wb") as file, pa.ipc.new_file(file, table.schema) as writer:
        writer.write_table(table)
    path.write_bytes(_perhaps_damaged(rng, path.read_bytes()))


def _perhaps_damaged(rng: Generator, data: bytes) -> bytes:
    return damaged(rng, data) if rng.random() < 0.2 else data


# JSON and other texts


def damage_json(rng: Generator, path: Path) -> None:
    """Change values of a file of JSON."""
    path.write_text(damaged_json(rng, path.read_text()), encoding="utf-8", errors="replace")


_YAML = (
    "&a",
    "*a",
    "<<: *a",
    "!!python/object/apply:os.system [id]",
    "!!binary",
    "{a: &b [*b, *b]}",
    "- ",
    ": ",
    "? ",
    "|",
    ">",
    "mcap",
    "sqlite3",
    "zstd",
    "file",
    "message",
    "MESSAGE",
)


def damage_yaml(rng: Generator, path: Path) -> None:
    """Change words of a file of YAML."""
    text = damaged_text(rng, path.read_text(), _YAML)
    path.write_text(text, encoding="utf-8", errors="replace")


# SQLite

_SCHEMAS = (
    "DROP TABLE messages",
    "DROP TABLE topics",
    "DROP TABLE schema",
    "DROP TABLE message_definitions",
    "ALTER TABLE messages RENAME TO m; CREATE VIEW messages AS SELECT * FROM m",
    "ALTER TABLE messages RENAME TO m; CREATE VIEW messages AS WITH RECURSIVE c(x) AS "
    "(SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT x AS id, 1 AS topic_id, x AS timestamp, "
    "zeroblob(1000) AS data FROM c",
    "ALTER TABLE topics RENAME TO t; CREATE VIEW topics AS SELECT 1 AS id, 'x' AS name, "
    "'std_msgs/msg/Float64' AS type, 'cdr' AS serialization_format, '' AS offered_qos_profiles, "
    "hex(zeroblob(1000000)) AS type_description_hash",
    "ALTER TABLE messages RENAME TO m; CREATE TABLE messages(id INTEGER, topic_id INTEGER "
    "DEFAULT 1, timestamp INTEGER, data BLOB GENERATED ALWAYS AS (zeroblob(900000000)) VIRTUAL); "
    "INSERT INTO messages(id, topic_id, timestamp) SELECT id, topic_id, timestamp FROM m",
    "INSERT INTO messages SELECT id + 1000, topic_id, timestamp, data FROM messages",
    "UPDATE topics SET id = id + 1",
    "CREATE TABLE more(x)",
    "DELETE FROM messages",
)


def damage_sqlite(rng: Generator, path: Path) -> None:
    """Change rows or the schema of an SQLite data base."""
    with sqlite3.connect(path) as base:
        for _ in range(a_few(rng)):
            try:
                _change_base(rng, base)
            except (sqlite3.Error, OverflowError):
                continue  # the other change has made that impossible
    base.close()


def _change_base(rng: Generator, base: sqlite3.Connection) -> None:
    if rng.random() < 0.2:
        base.executescript(one_of(rng, _SCHEMAS))
        return
    query = "SELECT name FROM sqlite_master WHERE type = 'table'"
    table = one_of(rng, [name for (name,) in base.execute(query)])
    column = one_of(rng, [row[1] for row in base.execute(f"PRAGMA table_info('{table}')")])
    rows = base.execute(f"SELECT rowid, \"{column}\" FROM '{table}'").fetchall()  # noqa: S608
    if not rows:
        return
    number, value = one_of(rng, rows)
    what = rng.random()
    if isinstance(value, bytes) and what < 0.8:
        changed: Any = damaged(rng, value)
    elif isinstance(value, str) and what < 0.8:
        changed = damaged_text(rng, value, MESSAGE_WORDS)
    else:
        changed = one_of(rng, (None, 0, -1, 2**62, 1.5, "x", b"\x00\x01", hostile_value(rng, 3)))
    base.execute(f"UPDATE '{table}' SET \"{column}\" = ? WHERE rowid = ?", (changed, number))  # noqa: S608


# Messages of bags

MESSAGE_WORDS = (
    "float64",
    "float64[]",
    "float64[3]",
    "float64[1000000000]",
    "string[100000000]",
    "string",
    "string<=5",
    "uint8[<=3]",
    "bool",
    "time",
    "wstring",
    "std_msgs/Header",
    "sensor_msgs/JointState",
    "sensor_msgs/JointState[1000]",
    "MSG: ",
    "=" * 80,
    "int32 A=1",
    'string B="x"',
    "__init__",
    "class",
    "std_msgs/msg/Float64",
    "struct",
    "module",
    "sequence<double>",
)


_BAG_TYPES = (
    ("/joint_states", "sensor_msgs/msg/JointState"),
    ("/command", "std_msgs/msg/Float64"),
    ("/cmd_vel", "geometry_msgs/msg/Twist"),
    ("/text", "std_msgs/msg/String"),
)


def write_bag(path: Path, kind: str, rng: Generator | None = None) -> None:
    """Write a bag as a robot records it: three messages on each of some topics.

    Parameters
    ----------
    path : Path
    kind : str
        ``"ros1"``, ``"sqlite3"`` or ``"mcap"``.
    rng : Generator, optional
        Damages messages, or how they are defined, before they are packed.
    """
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    serialize = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
    in_messages = rng is not None and rng.random() < 0.6
    topics = _BAG_TYPES[:2] if rng is None else _BAG_TYPES[: int(rng.integers(1, 5))]
    with _bag_writer(path, kind, rng) as writer:
        for topic, name in topics:
            plain, digest = store.generate_msgdef(name, ros_version=1 if kind == "ros1" else 2)
            digest = digest if kind == "ros1" else store.hash_rihs01(name)
            if rng is not None and not in_messages and rng.random() < 0.7:
                plain = damaged_text(rng, plain, MESSAGE_WORDS)
                digest = _digest(plain, name, kind) or digest
            said = {"msgdef": plain, ("md5sum" if kind == "ros1" else "rihs01"): digest}
            connection = writer.add_connection(topic, name, **said)
            for step in range(3):
                data = bytes(serialize(_bag_message(store, name, step), name))
                if rng is not None and in_messages and rng.random() < 0.3:
                    data = damaged(rng, data)
                time = 10**7 * (step + 1)
                if rng is not None and rng.random() < 0.05:
                    time = one_of(rng, (0, 1, 2**31 * 10**9 - 1, 10**18))
                writer.write(connection, time, data)


def _bag_writer(path: Path, kind: str, rng: Generator | None) -> Any:
    from rosbags import rosbag1, rosbag2

    if kind == "ros1":
        first = rosbag1.Writer(path)
        packing = None if rng is None else one_of(rng, (None, "BZ2", "LZ4"))
        if packing is not None:
            first.set_compression(first.CompressionFormat[packing])
        return first
    storage = rosbag2.StoragePlugin.MCAP if kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
    second = rosbag2.Writer(path, version=8, storage_plugin=storage)
    modes = (
        ("NONE", "MESSAGE", "FILE", "STORAGE") if kind == "mcap" else ("NONE", "MESSAGE", "FILE")
    )
    mode = "NONE" if rng is None else one_of(rng, modes)
    if mode != "NONE":
        second.set_compression(rosbag2.CompressionMode[mode], rosbag2.CompressionFormat.ZSTD)
    return second


def _digest(definition: str, name: str, kind: str) -> str | None:
    """Return the digest of a damaged definition, so that it does not give the damage away."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    try:
        store.register(get_types_from_msg(definition, name))
        return store.generate_msgdef(name)[1] if kind == "ros1" else store.hash_rihs01(name)
    except Exception:  # whatever a library raises over damage
        return None


def _bag_message(store: Any, name: str, step: int) -> Any:
    types = store.types
    if name == "std_msgs/msg/String":
        return types[name](data="some text")
    if name == "std_msgs/msg/Float64":
        return types[name](data=float(step))
    if name == "geometry_msgs/msg/Twist":
        vector = types["geometry_msgs/msg/Vector3"](x=1.0, y=2.0, z=3.0)
        return types[name](linear=vector, angular=vector)
    header = types["std_msgs/msg/Header"]
    counter = {"seq": step} if hasattr(header, "seq") or "seq" in header.__annotations__ else {}
    stamp = types["builtin_interfaces/msg/Time"](sec=step, nanosec=0)
    values = np.array([step, 2.0])
    return types[name](
        header=header(stamp=stamp, frame_id="", **counter),
        name=["cart", "pole"],
        position=values,
        velocity=values,
        effort=np.empty(0),
    )
