"""A FollowJointTrajectory server as controllers have them, and as they should not be; a process of its own, so that
it can die.

    python controller.py BEHAVIOUR [SPEED]

It publishes /joint_states at 50 Hz, and follows trajectories SPEED times as fast as they say, to be quick.
BEHAVIOUR: follow; reject (every goal); abort (after half a second); stall (never ends, but can be canceled); deaf
(never ends, and hears no cancel); slow (takes 3 s to accept, then follows).

Each line of its output is JSON: {"event": "ready" | "goal" | "cancel" | "end", …}.
"""

import json
import sys
import threading
import time

import numpy as np
import rclpy
from control_msgs.action import FollowJointTrajectory
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import JointState

ACTION = "/joint_trajectory_controller/follow_joint_trajectory"
START = {"left_s0": 0.0, "left_s1": -0.55, "left_e0": 0.0, "left_e1": 0.75,
         "left_w0": 0.0, "left_w1": 1.26, "left_w2": 0.0}


def tell(event, **fields):
    print(json.dumps({"event": event, **fields}), flush=True)


class Controller(Node):
    def __init__(self, behaviour, speed):
        super().__init__("joint_trajectory_controller")
        self.behaviour, self.speed = behaviour, speed
        self.positions, self.lock = dict(START), threading.Lock()
        group = ReentrantCallbackGroup()
        self.states = self.create_publisher(JointState, "/joint_states", 10)
        self.create_timer(0.02, self.publish, callback_group=group)
        self.server = ActionServer(
            self, FollowJointTrajectory, ACTION, execute_callback=self.execute, callback_group=group,
            goal_callback=self.goal, cancel_callback=self.cancel)

    def publish(self):
        with self.lock:
            message = JointState(name=list(self.positions), position=list(self.positions.values()))
        message.header.stamp = self.get_clock().now().to_msg()
        self.states.publish(message)

    def goal(self, goal):
        times = [p.time_from_start.sec + p.time_from_start.nanosec * 1e-9 for p in goal.trajectory.points]
        tell("goal", joints=list(goal.trajectory.joint_names), times=times, stamp=goal.trajectory.header.stamp.sec,
             positions=[list(p.positions) for p in goal.trajectory.points])
        if self.behaviour == "slow":
            time.sleep(3.0)
        return GoalResponse.REJECT if self.behaviour == "reject" else GoalResponse.ACCEPT

    def cancel(self, _):
        tell("cancel")
        return CancelResponse.REJECT if self.behaviour == "deaf" else CancelResponse.ACCEPT

    def execute(self, handle):
        points, names = handle.request.trajectory.points, handle.request.trajectory.joint_names
        times = np.array([p.time_from_start.sec + p.time_from_start.nanosec * 1e-9 for p in points])
        positions = np.array([p.positions for p in points])
        result, began = FollowJointTrajectory.Result(), time.monotonic()
        while rclpy.ok():
            now = (time.monotonic() - began) * self.speed
            if handle.is_cancel_requested:
                handle.canceled()
                tell("end", how="canceled", at=now)
                return result
            if self.behaviour == "abort" and now > 0.5 * self.speed:
                handle.abort()
                result.error_code, result.error_string = result.PATH_TOLERANCE_VIOLATED, "left_s0 is 0.3 rad off"
                tell("end", how="aborted", at=now)
                return result
            if self.behaviour in ("follow", "slow") and now > times[-1]:
                with self.lock:
                    self.positions.update(zip(names, map(float, positions[-1])))
                handle.succeed()
                tell("end", how="succeeded", at=now)
                return result
            desired = [float(np.interp(now, times, positions[:, i])) for i in range(len(names))]
            with self.lock:
                self.positions.update(zip(names, desired))
            feedback = FollowJointTrajectory.Feedback(joint_names=names)
            feedback.desired.positions = desired
            feedback.actual.positions = [d - 0.01 for d in desired]
            feedback.error.positions = [0.01] * len(names)
            handle.publish_feedback(feedback)
            time.sleep(0.02)
        return result


def main():
    behaviour, speed = sys.argv[1], float(sys.argv[2]) if len(sys.argv) > 2 else 1.0
    rclpy.init()
    node = Controller(behaviour, speed)
    executor = MultiThreadedExecutor(4)
    executor.add_node(node)
    tell("ready")
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
