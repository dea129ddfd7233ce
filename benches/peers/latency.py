"""Goal pose to trajectory as an rclpy client sees it: the node, a bare echo of as many bytes on the same stack, and one
in rclpy; and a reply with 12 samples. All in turn, in one run, on loopback.

    cargo build --release --bin tcvae_node --example peer_echo
    .venv-kilted/bin/python benches/peers/latency.py [--count 300]

(`./x test ros` makes .venv-kilted.) Prints a table, and JSON with --json.
"""

import argparse
import json
import os
import random
import re
import statistics
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "interop"))
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["RMW_IMPLEMENTATION"] = "rmw_fastrtps_cpp"

from conftest import Client, Process  # noqa: E402
from geometry_msgs.msg import PoseStamped  # noqa: E402
from tcvae_msgs.srv import SampleTrajectory  # noqa: E402
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint  # noqa: E402
from user import location, pose  # noqa: E402
from geometry_msgs.msg import PointStamped  # noqa: E402


def rclpy_echo():
    """The same as echo.rs, in rclpy."""
    import rclpy
    rclpy.init()
    node = rclpy.create_node("theirs")
    answer = JointTrajectory(joint_names=[f"left_{i}" for i in range(7)])
    for i in range(100):
        point = JointTrajectoryPoint(positions=[0.5] * 7, velocities=[0.5] * 7, accelerations=[0.5] * 7)
        point.time_from_start.sec = i + 1
        answer.points.append(point)
    publisher = node.create_publisher(JointTrajectory, "~/joint_trajectory", 1)
    node.create_subscription(PoseStamped, "~/goal_pose", lambda _: publisher.publish(answer), 10)
    print("ready", flush=True)
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass


class Exchange:
    """Goals to one node, and the trajectories that come back."""

    def __init__(self, client, name):
        self.client, self.heard, self.seconds = client, [], []
        self.goals = client.node.create_publisher(PoseStamped, f"/{name}/goal_pose", 10)
        client.node.create_subscription(JointTrajectory, f"/{name}/joint_trajectory", self.heard.append, 1)
        assert client.spin_until(lambda: self.goals.get_subscription_count() > 0, 10.0) is not None
        client.spin_until(lambda: False, 0.5)

    def once(self, x, y):
        goal, before = pose(x, y), len(self.heard)
        start = time.perf_counter()
        self.goals.publish(goal)
        while len(self.heard) == before:
            self.client.executor.spin_once(timeout_sec=1.0)
            assert time.perf_counter() - start < 10.0
        self.seconds.append(time.perf_counter() - start)


def quantiles(seconds):
    ordered = sorted(seconds)
    return 1e3 * statistics.median(ordered), 1e3 * ordered[int(0.99 * (len(ordered) - 1))]


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--theirs", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.theirs:
        return rclpy_echo()
    binaries = Path(os.environ.get("TCVAE_BIN_DIR", ROOT / "target" / "release"))
    domain = random.randrange(30, 100)
    environment = os.environ | {"ROS_DOMAIN_ID": str(domain)}
    ours = {k: v for k, v in environment.items() if k != "LD_LIBRARY_PATH"}
    processes = [Process(binaries / "tcvae_node", [], ours), Process(binaries / "examples" / "peer_echo", [], ours),
                 Process(Path(sys.executable), [__file__, "--theirs"], environment)]
    try:
        for process, word in zip(processes, ("Try, in another shell", "ready", "ready")):
            process.wait_for(word, 20.0)
        client = Client(domain, "latency")
        cups = client.node.create_publisher(PointStamped, "/tcvae/source_cup", 10)
        assert client.spin_until(lambda: cups.get_subscription_count() > 0, 10.0) is not None
        client.spin_until(lambda: False, 0.5)
        cups.publish(location("source_cup", 0.60, 0.10).point)
        exchanges = {name: Exchange(client, name) for name in ("tcvae", "echo", "theirs")}
        chance = random.Random(1)
        for i in range(arguments.count + 20):
            at = (chance.uniform(0.6, 0.7), chance.uniform(0.3, 0.4))
            for exchange in exchanges.values():
                exchange.once(*at)
        for exchange in exchanges.values():
            del exchange.seconds[:20]
        service = client.service(SampleTrajectory, "/tcvae/sample_trajectory")
        dozens = []
        for i in range(max(20, arguments.count // 10)):
            request = SampleTrajectory.Request(count=12, sample_manner=True, seed=i + 1)
            response, took = client.call(service, request)
            assert response.error_code == 0, response.error_message
            dozens.append(took)
        computed = [float(m) for m in re.findall(r"published in ([0-9.]+) ms", processes[0].output)][20:]
    finally:
        for process in processes:
            process.kill()
    told = {name: quantiles(exchange.seconds) for name, exchange in exchanges.items()}
    told["compute"] = quantiles([ms / 1e3 for ms in computed])
    told["dozen"] = quantiles(dozens)
    if arguments.json:
        print(json.dumps(told))
        return
    names = {"tcvae": "the node", "echo": "a bare echo on the same stack", "theirs": "an echo in rclpy",
             "compute": "the node's own time, from receipt to publication", "dozen": "12 samples in one reply (~350 kB)"}
    print(f"{'ms, of ' + str(arguments.count):52} median     p99")
    for key, words in names.items():
        print(f"{words:52} {told[key][0]:6.2f}  {told[key][1]:6.2f}")
    median = told["tcvae"][0] / (told["echo"][0] + told["compute"][0])
    tail = told["tcvae"][1] / (told["echo"][1] + told["compute"][1])
    print(f"node / (echo + its own time): {median:.2f} (median), {tail:.2f} (p99)")


if __name__ == "__main__":
    main()
