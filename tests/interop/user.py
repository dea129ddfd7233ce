"""What a user of the node does from rclpy: publish goals, call services, set parameters, listen."""

import time

from geometry_msgs.msg import PointStamped, PoseStamped
from nav_msgs.msg import Path
from rcl_interfaces.msg import Log, Parameter, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.qos import DurabilityPolicy, QoSProfile
from tcvae_msgs.msg import TaskLocation
from trajectory_msgs.msg import JointTrajectory, MultiDOFJointTrajectory

LATCHED = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def location(name, x, y, frame="base"):
    """A location of the task, as requests hold it."""
    message = TaskLocation(name=name)
    message.point.header.frame_id = frame
    message.point.point.x, message.point.point.y = float(x), float(y)
    return message


def task(pour, source):
    """A whole task."""
    return [location("pour_location", *pour), location("source_cup", *source)]


def pose(x, y, frame="base"):
    """A goal pose."""
    message = PoseStamped()
    message.header.frame_id = frame
    message.pose.position.x, message.pose.position.y = float(x), float(y)
    return message


def value(plain):
    """A parameter's value from a plain one."""
    if isinstance(plain, bool):
        return ParameterValue(type=1, bool_value=plain)
    if isinstance(plain, int):
        return ParameterValue(type=2, integer_value=plain)
    if isinstance(plain, float):
        return ParameterValue(type=3, double_value=plain)
    if isinstance(plain, str):
        return ParameterValue(type=4, string_value=plain)
    return ParameterValue(type=8, double_array_value=plain)


def plain(value):
    """A plain value from a parameter's."""
    fields = [None, "bool", "integer", "double", "string", "byte_array", "bool_array",
              "integer_array", "double_array", "string_array"]
    return getattr(value, f"{fields[value.type]}_value") if value.type else None


class User:
    """An rclpy client of one node, with everything that the node publishes."""

    def __init__(self, client, name="/tcvae", goal=None, joints=None):
        self.client, self.name, self.services, self.looked_at = client, name, {}, 0
        joints = joints or f"{name}/joint_trajectory"
        self.joints = self.listen(JointTrajectory, joints)
        self.poses = self.listen(MultiDOFJointTrajectory, f"{name}/end_effector_trajectory")
        self.paths = self.listen(Path, f"{name}/end_effector_path")
        self.log = self.listen(Log, "/rosout", LATCHED)
        self.goal_pose = client.node.create_publisher(PoseStamped, goal or f"{name}/goal_pose", 10)
        self.locations = {}
        self.matched(self.goal_pose)
        counts = client.node.count_publishers
        topics = [joints, f"{name}/end_effector_trajectory", f"{name}/end_effector_path"]
        assert self.until(lambda: all(map(counts, topics)), 10.0)
        # The node, too, must have found these subscriptions before it publishes.
        self.until(lambda: False, 0.3)

    def listen(self, kind, topic, qos=10):
        """A list that the topic's messages are added to."""
        messages = []
        self.client.node.create_subscription(kind, topic, messages.append, qos)
        return messages

    def matched(self, publisher):
        """Waits until a publisher has its subscriber, and the subscriber has it."""
        assert self.until(lambda: publisher.get_subscription_count() > 0, 10.0), publisher.topic_name
        self.until(lambda: False, 0.2)
        return publisher

    def until(self, condition, timeout=5.0):
        """Whether a condition came true in time."""
        return self.client.spin_until(condition, timeout) is not None

    def publish_location(self, name, x, y, frame="base"):
        if name not in self.locations:
            topic = f"{self.name}/{name}"
            publisher = self.client.node.create_publisher(PointStamped, topic, 10)
            self.locations[name] = self.matched(publisher)
        self.locations[name].publish(location(name, x, y, frame).point)
        # A goal goes another way and may overtake it; a service call's answer shows nothing either.
        self.until(lambda: False, 0.1)

    def trajectory(self, timeout=5.0):
        """The next joint trajectory that nobody has looked at, or None."""
        self.until(lambda: len(self.joints) > self.looked_at, timeout)
        if len(self.joints) == self.looked_at:
            return None
        self.looked_at += 1
        return self.joints[self.looked_at - 1]

    def ask(self, x, y, frame="base"):
        """Publishes a goal pose: the joint trajectory, the tip's trajectory and the path."""
        seen = len(self.joints), len(self.poses), len(self.paths)
        self.goal_pose.publish(pose(x, y, frame))
        kinds = (self.joints, self.poses, self.paths)
        came = self.until(lambda: all(len(k) > n for k, n in zip(kinds, seen)))
        assert came, f"no trajectory; the node said: {[m.msg for m in self.log][-3:]}"
        self.looked_at = len(self.joints)
        return self.joints[-1], self.poses[-1], self.paths[-1]

    def call(self, kind, service, timeout=20.0, **fields):
        """Calls one of the node's services."""
        if service not in self.services:
            self.services[service] = self.client.service(kind, f"{self.name}/{service}")
        return self.client.call(self.services[service], kind.Request(**fields), timeout)[0]

    def parameter(self, name):
        """The plain value of a parameter."""
        return plain(self.call(GetParameters, "get_parameters", names=[name]).values[0])

    def try_parameter(self, name, new):
        """Sets a parameter: None, or the reason why not."""
        parameters = [Parameter(name=name, value=value(new))]
        (result,) = self.call(SetParameters, "set_parameters", parameters=parameters).results
        return None if result.successful else result.reason

    def set_parameter(self, name, new):
        reason = self.try_parameter(name, new)
        assert reason is None, reason

    def said(self, text):
        """Whether a message on /rosout has this text."""
        return any(text in message.msg for message in self.log)

    def hears(self, text, timeout=5.0):
        """Waits for a message on /rosout."""
        assert self.until(lambda: self.said(text), timeout), [m.msg for m in self.log]

    def wait(self, seconds):
        """Lets messages come for a while."""
        end = time.monotonic() + seconds
        self.until(lambda: time.monotonic() > end, seconds + 1.0)
