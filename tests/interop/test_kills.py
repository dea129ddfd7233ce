"""Clients, the node and the controller killed in turn, and started again.

TCVAE_ROUNDS says how often (3; a soak takes 100):

    TCVAE_ROUNDS=100 ./x test ros -k kills
"""

import os
import random
import signal
import sys
import time
from pathlib import Path

from conftest import Process, start_node
from geometry_msgs.msg import PoseStamped
from rclpy.action import ActionClient
from tcvae_msgs.action import Execute
from tcvae_msgs.srv import SampleTrajectory
from test_execute import Controller
from trajectory_msgs.msg import JointTrajectory
from user import pose, task

HERE = Path(__file__).resolve().parent
ROUNDS = int(os.environ.get("TCVAE_ROUNDS", "3"))
SOURCE = (0.60, 0.10)
GOAL = (0.65, 0.37)


def test_what_is_killed_comes_back_and_nothing_is_sent_twice(start, make_client, domain):
    chance = random.Random(3)
    client = make_client("survivor")
    heard = []
    client.node.create_subscription(JointTrajectory, "/tcvae/joint_trajectory", heard.append, 10)
    sample = client.node.create_client(SampleTrajectory, "/tcvae/sample_trajectory")
    execute = ActionClient(client.node, Execute, "/tcvae/execute")
    goals = client.node.create_publisher(PoseStamped, "/tcvae/goal_pose", 10)
    environment = os.environ | {"ROS_DOMAIN_ID": str(domain)}
    arguments = ["--ros-args", "-p", f"task.source_cup.default:=[{SOURCE[0]},{SOURCE[1]}]", "-p", "execute.timeout_s:=1.0",
                 "-p", "execute.grace_s:=0.0"]
    node, robot, slowest = start_node(start, *arguments), Controller(domain, "stall", 20.0), 0.0

    def call(within):
        future = sample.call_async(SampleTrajectory.Request(task=task(GOAL, SOURCE)))
        took = client.spin_until(future.done, within)
        if took is None:
            sample.remove_pending_request(future)
            return None
        assert future.result().error_code == 0, future.result().error_message
        return took

    try:
        for _ in range(ROUNDS):
            # A client in the middle of its calls.
            caller = Process(Path(sys.executable), [HERE / "load.py", "calls", "100000", "1"], environment)
            client.spin_until(lambda: False, chance.uniform(0.5, 2.0))
            caller.signal(signal.SIGKILL)
            caller.wait()
            assert call(2.0) is not None

            # The controller in the middle of a motion.
            assert execute.wait_for_server(5.0)
            handle = execute.send_goal_async(Execute.Goal(start_policy="ignore"))
            assert client.spin_until(handle.done, 5.0) is not None and handle.result().accepted
            result = handle.result().get_result_async()
            client.spin_until(lambda: robot.events("goal"), 5.0)
            robot.signal(signal.SIGKILL)
            assert client.spin_until(result.done, 30.0) is not None
            assert result.result().result.error_code != 0 and len(robot.events("goal")) <= 1
            robot = Controller(domain, "stall", 20.0)

            # The node, with goals on their way.
            for i in range(5):
                goals.publish(pose(0.60 + 0.01 * i, 0.37))
            node.signal(signal.SIGKILL)
            node.wait()
            began = time.monotonic()
            node = start_node(start, *arguments)
            while call(0.25) is None:
                assert time.monotonic() - began < 10.0
            slowest = max(slowest, time.monotonic() - began)

            # A goal makes one trajectory, of what was asked for last.
            client.spin_until(lambda: goals.get_subscription_count() > 0, 5.0)
            client.spin_until(lambda: False, 0.5)
            heard.clear()
            goals.publish(pose(*GOAL))
            assert client.spin_until(lambda: heard, 5.0) is not None
            client.spin_until(lambda: False, 0.5)
            assert len(heard) == 1
    finally:
        robot.kill()
    print(f"answered at most {slowest:.2f} s after a restart of the node")
    assert slowest < 2.0
