"""A client in a process of its own, which a network namespace can hold.

    python peer.py calls COUNT TIMEOUT    calls ~/sample_trajectory COUNT times, each for one motion
    python peer.py topics COUNT           publishes COUNT goals, one after the trajectory of the one before came
    python peer.py watch                  calls four times a second, and publishes a goal every second, until SIGTERM

Prints one line of JSON: {"answered", "wrong", "seconds": [...], "found": seconds until the node was found}; for watch
{"goals": [when published], "heard": [[when, which trajectory, when the node sent it]], "calls": [[when, when answered
or null]]}, by the machine's monotonic clock, but for the node's, which is in nanoseconds of its system's clock.
"""

import hashlib
import json
import random
import signal
import sys
import time

import rclpy
from geometry_msgs.msg import PointStamped, PoseStamped
from rclpy.executors import SingleThreadedExecutor
from tcvae_msgs.srv import SampleTrajectory
from trajectory_msgs.msg import JointTrajectory
from user import pose, task

SOURCE = (0.60, 0.10)


def watch(node, executor):
    ended, told, open_calls = [], {"goals": [], "heard": [], "calls": []}, []
    signal.signal(signal.SIGTERM, lambda *_: ended.append(True))

    def hear(message, about):
        points = b"".join(point.positions.tobytes() for point in message.points)
        told["heard"].append([time.monotonic(), hashlib.sha256(points).hexdigest(), about["source_timestamp"]])

    node.create_subscription(JointTrajectory, "/tcvae/joint_trajectory", hear, 10)
    goals = node.create_publisher(PoseStamped, "/tcvae/goal_pose", 10)
    client = node.create_client(SampleTrajectory, "/tcvae/sample_trajectory")

    def publish():
        # Each is another one, and so is its trajectory.
        told["goals"].append(time.monotonic())
        goals.publish(pose(random.uniform(0.60, 0.70), random.uniform(0.36, 0.38)))

    def call():
        entry = [time.monotonic(), None]
        told["calls"].append(entry)
        future = client.call_async(SampleTrajectory.Request(task=task((0.65, 0.37), SOURCE)))
        future.add_done_callback(lambda _: entry.__setitem__(1, time.monotonic()))
        open_calls.append((entry[0], future))
        # Those that the middleware gave up cost time at every turn.
        while open_calls[0][0] < entry[0] - 10.0:
            client.remove_pending_request(open_calls.pop(0)[1])

    assert client.wait_for_service(30.0), "no service"
    node.create_timer(1.0, publish)
    node.create_timer(0.25, call)
    print("watching", flush=True)
    while not ended:
        executor.spin_once(timeout_sec=0.05)
    return told


def main():
    what, count = sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 0
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

    if what == "watch":
        print(json.dumps(watch(node, executor)), flush=True)
        return
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
