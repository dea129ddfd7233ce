"""A client in a process of its own, which a network namespace can hold.

    python peer.py calls COUNT TIMEOUT    calls ~/sample_trajectory COUNT times, each for one motion
    python peer.py topics COUNT           publishes COUNT goals, one after the trajectory of the one before came

Prints one line of JSON: {"answered", "wrong", "seconds": [...], "found": seconds until the node was found}.
"""

import json
import sys
import time

import rclpy
from geometry_msgs.msg import PointStamped, PoseStamped
from rclpy.executors import SingleThreadedExecutor
from tcvae_msgs.srv import SampleTrajectory
from trajectory_msgs.msg import JointTrajectory
from user import pose, task

SOURCE = (0.60, 0.10)


def main():
    what, count = sys.argv[1], int(sys.argv[2])
    timeout = float(sys.argv[3]) if len(sys.argv) > 3 else 30.0
    rclpy.init()
    node = rclpy.create_node("peer")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    began = time.monotonic()

    def until(condition, limit):
        end = time.monotonic() + limit
        while not condition() and time.monotonic() < end:
            executor.spin_once(timeout_sec=0.05)
        return condition()

    answered, wrong, seconds = 0, 0, []
    if what == "calls":
        client = node.create_client(SampleTrajectory, "/tcvae/sample_trajectory")
        assert client.wait_for_service(30.0), "no service"
        found = time.monotonic() - began
        for i in range(count):
            at = (0.60 + 0.01 * (i % 10), 0.37)
            request = SampleTrajectory.Request(task=task(at, SOURCE))
            start = time.monotonic()
            future = client.call_async(request)
            if until(future.done, timeout):
                answered += 1
                seconds.append(time.monotonic() - start)
                response = future.result()
                poured = [t.point.point for t in response.samples[0].empirical_task if t.name == "pour_location"] \
                    if response.samples else []
                wrong += not (poured and abs(poured[0].x - at[0]) < 0.02 and abs(poured[0].y - at[1]) < 0.02)
            else:
                client.remove_pending_request(future)
    else:
        heard = []
        node.create_subscription(JointTrajectory, "/tcvae/joint_trajectory", heard.append, 10)
        goals = node.create_publisher(PoseStamped, "/tcvae/goal_pose", 10)
        cups = node.create_publisher(PointStamped, "/tcvae/source_cup", 10)
        assert until(lambda: goals.get_subscription_count() and cups.get_subscription_count()
                     and node.count_publishers("/tcvae/joint_trajectory"), 30.0), "no topics"
        found = time.monotonic() - began
        until(lambda: False, 1.0)
        cup = PointStamped()
        cup.header.frame_id, cup.point.x, cup.point.y = "base", *SOURCE
        # Whoever is found by one side first misses what the other says until it is found by both.
        for _ in range(30):
            cups.publish(cup)
            until(lambda: False, 0.2)
            goals.publish(pose(0.60, 0.37))
            if until(lambda: heard, 1.0):
                break
        until(lambda: False, 3.0)
        heard.clear()
        for i in range(count):
            start, before = time.monotonic(), len(heard)
            goals.publish(pose(0.60 + 0.01 * (i % 10), 0.37))
            if until(lambda: len(heard) > before, timeout):
                answered += 1
                seconds.append(time.monotonic() - start)
        wrong = len(heard) - answered
    print(json.dumps({"answered": answered, "wrong": wrong, "seconds": seconds, "found": found}))
    sys.stdout.flush()
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
