"""Writes fuzz/seeds/: for each target the smallest sound input of each form.

    pip install rosbags==0.11.9 mcap==1.6.0 && python fuzz/seeds.py
"""

import io
import shutil
import sqlite3
import struct
import zipfile
from pathlib import Path

from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.typesys import Stores, get_typestore

SEEDS = Path(__file__).parent / "seeds"
COUNT = 4


def text(value, cdr):
    data = value.encode() + (b"\0" if cdr else b"")
    return struct.pack("<I", len(data)) + data


def joint_state(number, cdr):
    """Two joints and a finger, without velocities."""
    head = b"\0\1\0\0" if cdr else struct.pack("<I", number)
    data = struct.pack("<II", 10, number * 10_000_000)
    parts = [text("", cdr), struct.pack("<I", 3)] + [text(name, cdr) for name in "abf"]
    for part in parts:
        if cdr:
            data += bytes(-len(data) % 4)
        data += part
    if cdr:
        data += bytes(-len(data) % 4)
    data += struct.pack("<I", 3)
    if cdr:
        data += bytes(-len(data) % 8)
    return head + data + struct.pack("<dddII", 0.1 * number, -0.5, 25.0, 0, 0)


def number(value, cdr):
    return (b"\0\1\0\0" if cdr else b"") + struct.pack("<d", value)


def write(target, name, data):
    folder = SEEDS / target
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_bytes(data)


def mcap(name, cdr=True, **options):
    stream = io.BytesIO()
    writer = Writer(stream, **options)
    writer.start()
    part = "/msg" if cdr else ""
    encoding = "cdr" if cdr else "ros1"
    joints = writer.register_schema(f"sensor_msgs{part}/JointState", "", b"")
    numbers = writer.register_schema(f"std_msgs{part}/Float64", "", b"")
    topics = [writer.register_channel("/j", encoding, joints)]
    topics += [writer.register_channel("/g", encoding, numbers)]
    for i in range(COUNT):
        log = 10**10 + i * 10_000_000
        writer.add_message(topics[0], log, joint_state(i, cdr), log, i)
        writer.add_message(topics[1], log, number(10.0 * i, cdr), log, i)
    writer.finish()
    write("mcap", name, stream.getvalue())


def sqlite():
    path = SEEDS / "one.db3"
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA page_size = 512")
    connection.executescript(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);"
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);"
    )
    rows = [(1, "/j", "sensor_msgs/msg/JointState", "cdr"), (2, "/g", "std_msgs/msg/Float64", "cdr")]
    connection.executemany("INSERT INTO topics VALUES (?, ?, ?, ?)", rows)
    for i in range(COUNT):
        for topic, data in [(1, joint_state(i, True)), (2, number(10.0 * i, True))]:
            row = (topic, 10**10 + i * 10_000_000, data)
            connection.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", row)
    connection.commit()
    connection.close()
    write("sqlite", "one.db3", path.read_bytes())
    path.unlink()


def ros1(name, compression=None):
    store = get_typestore(Stores.ROS1_NOETIC)
    path = SEEDS / name
    writer = Rosbag1Writer(path)
    if compression:
        writer.set_compression(compression)
    with writer:
        joints = writer.add_connection("/j", "sensor_msgs/msg/JointState", msgdef="a", md5sum="b")
        numbers = writer.add_connection("/g", "std_msgs/msg/Float64", msgdef="a", md5sum="b")
        for i in range(COUNT):
            log = 10**10 + i * 10_000_000
            writer.write(joints, log, joint_state(i, False))
            writer.write(numbers, log, number(10.0 * i, False))
    del store
    write("ros1", name, path.read_bytes())
    path.unlink()


def archives():
    for name, method in [("stored", zipfile.ZIP_STORED), ("deflated", zipfile.ZIP_DEFLATED)]:
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w", method) as archive:
            archive.writestr("task/one/joint_angles.txt", "{'a': 1}\n" * 20)
            archive.writestr("g.txt", "0\n")
        write("zip", f"{name}.zip", stream.getvalue())


def main():
    shutil.rmtree(SEEDS, ignore_errors=True)
    SEEDS.mkdir()
    mcap("zstd", compression=CompressionType.ZSTD)
    mcap("lz4", compression=CompressionType.LZ4)
    mcap("plain", compression=CompressionType.NONE)
    mcap("ros1", cdr=False, compression=CompressionType.NONE)
    mcap("no_index", index_types=IndexType.NONE, use_statistics=False)
    mcap("no_chunks", use_chunking=False)
    sqlite()
    ros1("none")
    ros1("bz2", Rosbag1Writer.CompressionFormat.BZ2)
    ros1("lz4", Rosbag1Writer.CompressionFormat.LZ4)
    kinds = [joint_state(1, True), joint_state(1, False), number(5.0, True), b"\x05\0", b"\0\1\0\0\1"]
    for i, data in enumerate(kinds):
        write("messages", str(i), bytes([i]) + (data + b"\xfe") * 2 + data)
    lines = b"{\"a\": 0.5, \"b\": -1e-1}\n{'b': 0, u'a': 1.0}\n\n0.1\n"
    write("mime", "two", lines + b"\xff" + b"100\n0.5\n")
    write("csv", "commas", b"time,a,b,g\n0.0,1,2,100\n0.1,1.5,2,0\n")
    write("csv", "quoted", b"\xef\xbb\xbf\"time_ns\";\"b\";\"f\"\r\n1;\"-0.5\";50\r\n2;;0\r\n")
    archives()


if __name__ == "__main__":
    main()
