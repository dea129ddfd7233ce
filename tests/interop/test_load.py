"""Several clients at once, each with several calls under way, beside bursts of task messages.

TCVAE_LOAD says how many calls, and how many messages (20,000 each; a soak takes 1,000,000):

    TCVAE_LOAD=1000000 ./x test ros -k load -s
"""

import json
import os
import sys
import time
from pathlib import Path

from conftest import Process, start_node
from geometry_msgs.msg import PointStamped, PoseStamped
from rclpy.qos import qos_profile_sensor_data
from trajectory_msgs.msg import JointTrajectory
from user import location, pose

HERE = Path(__file__).resolve().parent
COUNT = int(os.environ.get("TCVAE_LOAD", "20000"))
CALLERS = 3


class Usage:
    """What a process has used so far."""

    def __init__(self, pid):
        with open(f"/proc/{pid}/statm") as statm:
            self.resident = int(statm.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        with open(f"/proc/{pid}/stat") as stat:
            words = stat.read().rsplit(")", 1)[1].split()
        self.cpu = (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def phase(domain, share, number):
    """Runs the clients with a share of the load: what they told, added up."""
    environment = os.environ | {"ROS_DOMAIN_ID": str(domain)}
    plan = [("calls", share // CALLERS, number + i) for i in range(CALLERS)] + [("topics", share, number + CALLERS)]
    clients = [Process(Path(sys.executable), [HERE / "load.py", *map(str, p)], environment) for p in plan]
    total = {"answered": 0, "busy": 0, "wrong": 0, "lost": 0, "examples": []}
    try:
        for client in clients:
            assert client.wait(timeout=60 + share) == 0, client.output[-2000:]
            told = json.loads(client.lines[-1])
            total = {key: total[key] + told[key] for key in total}
    finally:
        for client in clients:
            client.kill()
    return total


def test_every_call_is_answered_and_nothing_grows(start, domain):
    node = start_node(start)
    # Memory is what it was at its peak, which is reached in the first phases; the clients of each are new.
    usage, told = [], []
    for number in range(4):
        told.append(phase(domain, COUNT // 4, 10 * number))
        # A writer's history is cleaned every second.
        time.sleep(3.0)
        usage.append(Usage(node.pid))
    print(json.dumps({"told": told, "resident": [u.resident for u in usage], "cpu": [u.cpu for u in usage]}))
    calls = CALLERS * (COUNT // 4 // CALLERS)
    for one in told:
        assert (one["wrong"], one["lost"]) == (0, 0), one
        assert one["answered"] + one["busy"] >= calls
        assert one["answered"] > 0.5 * calls, one
    # One reply is 30 kB; a machine that is busy otherwise lets some more of them wait.
    assert usage[-1].resident < 1.05 * max(u.resident for u in usage[:3]) + (4 << 20), [u.resident for u in usage]
    per_phase = [b.cpu - a.cpu for a, b in zip(usage, usage[1:])]
    assert per_phase[-1] < 1.5 * per_phase[0], per_phase


def test_what_nobody_hears_is_not_kept(start, make_client):
    """Paths and markers without a subscriber; trajectories for one that acknowledges nothing."""
    node = start_node(start)
    client = make_client()
    cups = client.node.create_publisher(PointStamped, "/tcvae/source_cup", 10)
    goals = client.node.create_publisher(PoseStamped, "/tcvae/goal_pose", 10)
    heard = []
    client.node.create_subscription(JointTrajectory, "/tcvae/joint_trajectory", heard.append, qos_profile_sensor_data)
    assert client.spin_until(lambda: goals.get_subscription_count() and cups.get_subscription_count(), 10.0) is not None
    client.spin_until(lambda: False, 0.5)
    cups.publish(location("source_cup", 0.60, 0.10).point)
    client.spin_until(lambda: False, 0.5)

    def publish(count):
        for i in range(count):
            goals.publish(pose(0.60 + 0.001 * (i % 100), 0.37))
            client.spin_until(lambda: False, 0.01)
        client.spin_until(lambda: False, 3.0)
        return Usage(node.pid).resident

    before, after = publish(300), publish(900)
    assert node.output.count("published in") > 600 and len(heard) > 600
    # 900 of them are 43 MB.
    assert after < before + (15 << 20), (before, after)
