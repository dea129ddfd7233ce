"""A bag with a camera in it, of which only the joint states are asked for: our reader beside Python's, and
beside only reading and decompressing the chunks that hold joint states.

The bags have images of 640 x 480 at 30 Hz with some noise, uncompressed, and Baxter's joint states at
100 Hz: as MCAP in plain chunks and in zstd's, and in SQLite. All run in turns on files that the system
has in memory, and are timed without their start; Python once without decoding what it reads. The memory
is that of all of `tcvae inspect`.

    python3 -m venv .venv-peers
    .venv-peers/bin/pip install numpy rosbags==0.11.9 mcap==1.6.0
    cargo build --release --bin tcvae --example peer_bags
    .venv-peers/bin/python benches/peers/bags.py [--megabytes 1000] [--rounds 5] [--target target/release]
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags import rosbag2
from rosbags.typesys import Stores, get_typestore

ROOT = Path(__file__).resolve().parents[2]
START = 1_700_000_000_000_000_000
WIDTH, HEIGHT, IMAGE_HZ, JOINT_HZ = 640, 480, 30, 100
NAMES = [f"{side}_{joint}" for side in ("left", "right") for joint in "s0 s1 e0 e1 w0 w1 w2".split()]
NAMES += ["l_gripper_l_finger_joint", "r_gripper_l_finger_joint", "head_pan"]
JOINTS, IMAGES = "/robot/joint_states", "/camera/image_raw"
TYPES = {JOINTS: "sensor_msgs/msg/JointState", IMAGES: "sensor_msgs/msg/Image"}

store = get_typestore(Stores.ROS2_JAZZY)


def messages(megabytes):
    """(topic, log time, bytes), in the order of logging."""
    types = store.types
    rng = np.random.default_rng(1)
    # Four bits of noise on a ramp, as a camera's: zstd gets it to about two thirds.
    ramp = np.linspace(0, 20, WIDTH * 3)[None, :] + np.linspace(0, 10, HEIGHT)[:, None]
    frames = [(ramp + rng.integers(0, 16, ramp.shape)).astype(np.uint8).ravel() for _ in range(8)]
    images = round(megabytes * 1e6 / frames[0].size)
    times = [(START + round(i * 1e9 / IMAGE_HZ) + 1, IMAGES, i) for i in range(images)]
    states = round(images / IMAGE_HZ * JOINT_HZ)
    times += [(START + round(i * 1e9 / JOINT_HZ), JOINTS, i) for i in range(states)]
    empty = np.array([])
    for log, topic, i in sorted(times):
        stamp = types["builtin_interfaces/msg/Time"](sec=log // 10**9, nanosec=log % 10**9)
        header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="base")
        if topic == IMAGES:
            message = types[TYPES[topic]](
                header=header, height=HEIGHT, width=WIDTH, encoding="rgb8", is_bigendian=0,
                step=3 * WIDTH, data=frames[i % len(frames)],
            )
        else:
            position = 0.3 * np.sin(0.01 * i + np.arange(len(NAMES)))
            position[14:16] = 0.0208
            message = types[TYPES[topic]](
                header=header, name=NAMES, position=position, velocity=empty, effort=empty
            )
        yield topic, log, bytes(store.serialize_cdr(message, TYPES[topic]))


def write_mcap(path, compression, megabytes):
    with path.open("wb") as file:
        writer = Writer(file, compression=compression, chunk_size=768 * 1024)
        writer.start(profile="ros2", library="bags.py")
        channels = {}
        for topic, kind in TYPES.items():
            text, _ = store.generate_msgdef(kind, ros_version=2)
            schema = writer.register_schema(kind, "ros2msg", text.encode())
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        for i, (topic, log, data) in enumerate(messages(megabytes)):
            writer.add_message(channels[topic], log, data, log, i)
        writer.finish()


def write_sqlite(path, megabytes):
    with rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin.SQLITE3) as writer:
        connections = {t: writer.add_connection(t, kind, typestore=store) for t, kind in TYPES.items()}
        for topic, log, data in messages(megabytes):
            writer.write(connections[topic], log, data)


def run(command):
    """Seconds, peak memory (MB) and output of a program."""
    start = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.PIPE)
    output = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    secs = time.perf_counter() - start
    # 3: read, and no demonstration in it.
    if os.waitstatus_to_exitcode(status) not in (0, 3):
        sys.exit(f"{command[0]} failed")
    return secs, usage.ru_maxrss / 1024, output


def python(path, decodes):
    """Seconds for the messages of the one topic, and how many they are."""
    start, count = time.perf_counter(), 0

    def take(data):
        nonlocal count
        count += 1
        if decodes:
            store.deserialize_cdr(data, TYPES[JOINTS])

    if path.suffix == ".mcap":
        with path.open("rb") as file:
            for _, _, message in make_reader(file).iter_messages(topics=[JOINTS]):
                take(message.data)
    else:
        with rosbag2.Reader(path) as reader:
            wanted = [c for c in reader.connections if c.topic == JOINTS]
            for _, _, data in reader.messages(connections=wanted):
                take(data)
    return time.perf_counter() - start, count


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--megabytes", type=float, default=1000)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--target", type=Path, default=ROOT / "target" / "release")
    parser.add_argument("--folder", type=Path, help="where the bags are, or are written")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.folder or Path(temporary)
        folder.mkdir(exist_ok=True)
        makers = {
            "plain.mcap": lambda path: write_mcap(path, CompressionType.NONE, args.megabytes),
            "zstd.mcap": lambda path: write_mcap(path, CompressionType.ZSTD, args.megabytes),
            "sqlite": lambda path: write_sqlite(path, args.megabytes),
        }
        titles = "bag, MB, ours s, chunks s, ratio, Python s, times, decoded s, times, inspect s, inspect MB"
        print(" | ".join(titles.split(", ")))
        for name, make in makers.items():
            path = folder / name
            if not path.exists():
                make(path)
            files = [path] if path.is_file() else list(path.iterdir())
            size = sum(file.stat().st_size for file in files) / 1e6
            rounds = []
            for _ in range(args.rounds):
                as_bytes, count = python(path, False)
                decoded, _ = python(path, True)
                ours = json.loads(run([args.target / "examples" / "peer_bags", path, JOINTS])[2])
                assert ours["frames"] == count, (ours, count)
                secs, memory, _ = run([args.target / "tcvae", "inspect", path, "--json"])
                rounds.append((ours["secs"], ours["chunk_secs"], as_bytes, decoded, secs, memory))
            ours, chunks, as_bytes, decoded, secs, memory = map(statistics.median, zip(*rounds))
            cells = [name, f"{size:.0f}", f"{ours:.3f}"]
            cells += [f"{chunks:.3f}", f"{ours / chunks:.2f}"] if path.is_file() else ["", ""]
            cells += [f"{as_bytes:.3f}", f"{as_bytes / ours:.1f}", f"{decoded:.3f}", f"{decoded / ours:.1f}"]
            print(" | ".join([*cells, f"{secs:.3f}", f"{memory:.0f}"]), flush=True)


if __name__ == "__main__":
    main()
