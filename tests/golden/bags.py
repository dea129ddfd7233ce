"""Writes tests/golden/bags/: one stream of joint states and a gripper's topic, beside a camera and what no
program knows, in bags as other programs write them; and what Python reads in each.

    pip install rosbags==0.11.9 mcap==1.6.0 && python tests/golden/bags.py
"""

import json
import random
import shutil
import sqlite3
import struct
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer as McapWriter
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

FOLDER = Path(__file__).parent / "bags"
COUNT = 30
START = 1_700_000_000_000_000_000
LEFT = ["left_s0", "left_s1", "left_e0", "left_e1", "left_w0", "left_w1", "left_w2"]
NAMES = ["head_pan", "left_w0", "left_w1", "left_w2", "left_e0", "left_e1", "left_s0", "left_s1"]

ros2 = get_typestore(Stores.ROS2_JAZZY)
ros1 = get_typestore(Stores.ROS1_NOETIC)


def messages(store):
    """(topic, type, log time, bytes), in the order of logging."""
    rng = random.Random(1)
    types = store.types
    time, header = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/Header"]
    ros_1 = store is ros1
    write = store.serialize_ros1 if ros_1 else store.serialize_cdr
    out = []
    for i in range(COUNT):
        stamp = START + 10_000_000 * i
        stamp_msg = time(sec=stamp // 10**9, nanosec=stamp % 10**9)
        head = header(stamp=stamp_msg, frame_id="base", **({"seq": i} if ros_1 else {}))
        positions = np.array([0.01 * i + 0.1 * k for k in range(len(NAMES))])
        empty = np.array([], dtype=np.float64)
        states = types["sensor_msgs/msg/JointState"](
            header=head, name=NAMES, position=positions, velocity=empty, effort=empty
        )
        log = stamp + rng.randrange(5_000_000)
        out.append(("/joint_states", "sensor_msgs/msg/JointState", log, states))
        if i % 10 == 5:
            number = types["std_msgs/msg/Float64"](data=float(i))
            out.append(("/gripper", "std_msgs/msg/Float64", log + 1, number))
        noise = np.frombuffer(rng.randbytes(75), dtype=np.uint8)
        image = types["sensor_msgs/msg/Image"](
            header=head, height=5, width=5, encoding="rgb8", is_bigendian=0, step=15, data=noise
        )
        out.append(("/camera", "sensor_msgs/msg/Image", log + 2, image))
    out.sort(key=lambda m: m[2])
    return [(topic, kind, log, bytes(write(msg, kind))) for topic, kind, log, msg in out]


def rosbag2(name, storage, compression=None, parts=1):
    path = FOLDER / name
    everything = messages(ros2)
    share = -(-len(everything) // parts)
    for part in range(parts):
        folder = path if parts == 1 else FOLDER / f"part{part}"
        writer = Writer(folder, version=9, storage_plugin=storage)
        if compression:
            writer.set_compression(compression, CompressionFormat.ZSTD)
        with writer:
            connections = {}
            for topic, kind, log, data in everything[part * share : (part + 1) * share]:
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=ros2)
                writer.write(connections[topic], log, data)
    if parts > 1:
        # As rosbag2 splits a recording; its metadata.yaml got lost.
        path.mkdir()
        for part in range(parts):
            (file,) = [f for f in (FOLDER / f"part{part}").iterdir() if f.suffix != ".yaml"]
            file.rename(path / f"{name}_{part}{file.suffix}")
            shutil.rmtree(FOLDER / f"part{part}")
    return path


def mcap(name, store, **options):
    path = FOLDER / f"{name}.mcap"
    ros_1 = store is ros1
    with path.open("wb") as file:
        writer = McapWriter(file, **options)
        writer.start(profile="ros1" if ros_1 else "ros2", library="bags.py")
        channels = {}
        # A channel that has a type but no meaning here.
        odd = writer.register_channel("/odd", "protobuf", writer.register_schema("x/Y", "", b"\x00"))
        for number, (topic, kind, log, data) in enumerate(messages(store)):
            if topic not in channels:
                text, _ = store.generate_msgdef(kind, ros_version=1 if ros_1 else 2)
                type_name = kind.replace("/msg/", "/") if ros_1 else kind
                encoding = "ros1msg" if ros_1 else "ros2msg"
                schema = writer.register_schema(type_name, encoding, text.encode())
                channels[topic] = writer.register_channel(topic, "ros1" if ros_1 else "cdr", schema)
            writer.add_message(channels[topic], log, data, log, number)
            writer.add_message(odd, log, struct.pack("<I", number), log, number)
        writer.finish()
    return path


def bag(name, compression=None):
    path = FOLDER / f"{name}.bag"
    writer = Rosbag1Writer(path)
    writer.chunk_threshold = 4096
    if compression:
        writer.set_compression(compression)
    with writer:
        connections = {}
        for topic, kind, log, data in messages(ros1):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ros1)
            writer.write(connections[topic], log, data)
    return path


def read(path, store):
    """The joint states and numbers that Python's libraries read, with their log times."""
    states, numbers = [], []

    def take(topic, kind, log, data):
        if topic not in ("/joint_states", "/gripper"):
            return
        msg = (store.deserialize_ros1 if store is ros1 else store.deserialize_cdr)(data, kind)
        if topic == "/joint_states":
            stamp = msg.header.stamp.sec * 10**9 + msg.header.stamp.nanosec
            place = [msg.name.index(name) for name in LEFT]
            states.append([stamp, [float(msg.position[i]) for i in place]])
        elif topic == "/gripper":
            numbers.append([log, float(msg.data)])

    if path.suffix == ".bag" or (path / "metadata.yaml").exists():
        with AnyReader([path]) as reader:
            for connection, log, data in reader.messages():
                take(connection.topic, connection.msgtype, log, data)
    elif path.is_dir():
        for file in sorted(path.iterdir()):
            rows = sqlite3.connect(file).execute(
                "SELECT name, type, timestamp, data FROM messages JOIN topics "
                "ON topics.id = topic_id ORDER BY messages.id"
            )
            for topic, kind, log, data in rows:
                take(topic, kind, log, data)
    else:
        with path.open("rb") as file:
            for schema, channel, message in make_reader(file).iter_messages():
                kind = schema.name if "/msg/" in schema.name else schema.name.replace("/", "/msg/")
                take(channel.topic, kind, message.log_time, message.data)
    states.sort()
    return {"states": states, "numbers": numbers}


def main():
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir()
    none = IndexType.NONE
    made = [
        (rosbag2("sqlite", StoragePlugin.SQLITE3), ros2),
        (rosbag2("sqlite_split", StoragePlugin.SQLITE3, parts=3), ros2),
        (rosbag2("sqlite_file", StoragePlugin.SQLITE3, CompressionMode.FILE), ros2),
        (rosbag2("sqlite_message", StoragePlugin.SQLITE3, CompressionMode.MESSAGE), ros2),
        (rosbag2("rosbag2_mcap", StoragePlugin.MCAP), ros2),
        (mcap("zstd", ros2, compression=CompressionType.ZSTD, chunk_size=4096), ros2),
        (mcap("lz4", ros2, compression=CompressionType.LZ4, chunk_size=4096), ros2),
        (mcap("plain", ros2, compression=CompressionType.NONE, chunk_size=4096), ros2),
        (mcap("no_index", ros2, index_types=none, use_statistics=False), ros2),
        (mcap("no_chunks", ros2, use_chunking=False), ros2),
        (mcap("ros1", ros1, compression=CompressionType.ZSTD, chunk_size=4096), ros1),
        (bag("none"), ros1),
        (bag("bz2", Rosbag1Writer.CompressionFormat.BZ2), ros1),
        (bag("lz4", Rosbag1Writer.CompressionFormat.LZ4), ros1),
    ]
    expected = read(*made[0])
    assert len(expected["states"]) == COUNT and len(expected["numbers"]) == COUNT // 10
    for path, store in made:
        assert read(path, store) == expected, path
    names = [path.name for path, _ in made]
    content = {"bags": names, "joints": LEFT, **expected}
    (FOLDER / "expected.json").write_text(json.dumps(content) + "\n")


if __name__ == "__main__":
    main()
