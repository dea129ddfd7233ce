"""One of several clients that ask much; a process of its own.

    python load.py calls COUNT NUMBER     COUNT calls, six at a time; NUMBER seeds what they ask for
    python load.py topics COUNT NUMBER    COUNT locations in bursts, and after each burst which one counts

Prints one line of JSON: {"answered", "busy", "wrong", "lost", "examples"}.
"""

import json
import random
import sys
import time

import rclpy
from geometry_msgs.msg import PointStamped
from rcl_interfaces.srv import GetParameters
from rclpy.executors import SingleThreadedExecutor
from tcvae_msgs.msg import ErrorCode
from tcvae_msgs.srv import SampleTrajectory
from user import location, task

AT_ONCE = 6
BURST = 200
SOURCE = (0.60, 0.10)
PATIENCE = 60.0


class Load:
    def __init__(self, number):
        rclpy.init()
        self.node = rclpy.create_node(f"load_{number}")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.chance = random.Random(number)
        self.told = {"answered": 0, "busy": 0, "wrong": 0, "lost": 0, "examples": []}
        self.sample = self.node.create_client(SampleTrajectory, "/tcvae/sample_trajectory")
        self.parameters = self.node.create_client(GetParameters, "/tcvae/get_parameters")
        assert self.sample.wait_for_service(30.0) and self.parameters.wait_for_service(30.0)

    def until(self, condition, seconds):
        end = time.monotonic() + seconds
        while not condition() and time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.05)
        return condition()

    def wrong(self, what):
        self.told["wrong"] += 1
        self.told["examples"] = [*self.told["examples"], what][:5]

    def check(self, future, at):
        response = future.result()
        if isinstance(response, GetParameters.Response):
            self.told["answered"] += 1
            if len(response.values) != 1 or response.values[0].double_value != 0.02:
                self.wrong(f"parameter {response.values}")
        elif response.error_code == ErrorCode.BUSY:
            self.told["busy"] += 1
        else:
            self.told["answered"] += 1
            points = {t.name: t.point.point for s in response.samples for t in s.empirical_task}
            point = points.get("pour_location")
            if response.error_code or point is None or abs(point.x - at[0]) > 0.02 or abs(point.y - at[1]) > 0.02:
                self.wrong(f"{at}: {response.error_message or point}")

    def calls(self, count):
        """Nine of ten for a motion, one for a parameter."""
        open_calls, asked = [], 0
        while asked < count or open_calls:
            while asked < count and len(open_calls) < AT_ONCE:
                asked += 1
                at = (self.chance.uniform(0.6, 0.7), self.chance.uniform(0.3, 0.4))
                if self.chance.random() < 0.1:
                    future = self.parameters.call_async(GetParameters.Request(names=["task.tolerance_m"]))
                else:
                    future = self.sample.call_async(SampleTrajectory.Request(task=task(at, SOURCE)))
                open_calls.append((future, at, time.monotonic()))
            self.executor.spin_once(timeout_sec=0.05)
            still = []
            for future, at, since in open_calls:
                if future.done():
                    self.check(future, at)
                elif time.monotonic() - since > PATIENCE:
                    self.told["lost"] += 1
                else:
                    still.append((future, at, since))
            open_calls = still

    def topics(self, count):
        """The last of a burst is where the cup is."""
        publisher = self.node.create_publisher(PointStamped, "/tcvae/source_cup", 10)
        assert self.until(lambda: publisher.get_subscription_count() > 0, 30.0)
        self.until(lambda: False, 0.5)
        goal = location("pour_location", 0.65, 0.37)
        for _ in range(max(1, count // BURST)):
            for _ in range(BURST):
                at = (self.chance.uniform(0.55, 0.65), self.chance.uniform(0.05, 0.15))
                publisher.publish(location("source_cup", *at).point)
            self.until(lambda: False, 0.1)
            request = SampleTrajectory.Request(task=[goal])
            answered = False
            while not answered:
                future = self.sample.call_async(request)
                if not self.until(future.done, PATIENCE):
                    self.told["lost"] += 1
                    break
                response = future.result()
                if response.error_code == ErrorCode.BUSY:
                    self.told["busy"] += 1
                    self.until(lambda: False, 0.02)
                    continue
                answered = True
                self.told["answered"] += 1
                cups = [t.point.point for s in response.samples for t in s.empirical_task if t.name == "source_cup"]
                if not cups or abs(cups[0].x - at[0]) > 0.002 or abs(cups[0].y - at[1]) > 0.002:
                    self.wrong(f"cup {at}: {response.error_message or cups}")


def main():
    what, count, number = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    load = Load(number)
    getattr(load, what)(count)
    print(json.dumps(load.told), flush=True)
    load.node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
