"""A client on Cyclone DDS itself, with the names and the layouts of rmw_cyclonedds_cpp; a process of its own, since no two
DDS libraries should share one. It prints a line of JSON.

    python cyclone.py calls COUNT    calls ~/sample COUNT times: {"answers": [...], "seconds": [...]}
    python cyclone.py goals COUNT    publishes the source cup, and then COUNT goals, each when the trajectory of the one
                                     before has come: {"trajectories": [[joints, points, seconds]], "model": ~/model_info}
"""

import json
import os
import random
import sys
import time
from dataclasses import dataclass

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int32, int64, sequence, uint8, uint32, uint64
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

QOS = Qos(Policy.Reliability.Reliable(duration(seconds=1)), Policy.History.KeepLast(10), Policy.Durability.Volatile)


@dataclass
class Request(IdlStruct, typename="std_srvs::srv::dds_::Trigger_Request_"):
    """The header of rmw_cyclonedds_cpp, and the byte that stands for no fields."""

    client: uint64
    number: int64
    structure_needs_at_least_one_member: uint8


@dataclass
class Response(IdlStruct, typename="std_srvs::srv::dds_::Trigger_Response_"):
    client: uint64
    number: int64
    success: bool
    message: str


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Point(IdlStruct, typename="geometry_msgs::msg::dds_::Point_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Pose(IdlStruct, typename="geometry_msgs::msg::dds_::Pose_"):
    position: Point
    orientation: Quaternion


@dataclass
class PoseStamped(IdlStruct, typename="geometry_msgs::msg::dds_::PoseStamped_"):
    header: Header
    pose: Pose


@dataclass
class PointStamped(IdlStruct, typename="geometry_msgs::msg::dds_::PointStamped_"):
    header: Header
    point: Point


@dataclass
class TrajectoryPoint(IdlStruct, typename="trajectory_msgs::msg::dds_::JointTrajectoryPoint_"):
    positions: sequence[float64]
    velocities: sequence[float64]
    accelerations: sequence[float64]
    effort: sequence[float64]
    time_from_start: Time


@dataclass
class JointTrajectory(IdlStruct, typename="trajectory_msgs::msg::dds_::JointTrajectory_"):
    header: Header
    joint_names: sequence[str]
    points: sequence[TrajectoryPoint]


@dataclass
class String(IdlStruct, typename="std_msgs::msg::dds_::String_"):
    data: str


def until(condition, what):
    end = time.monotonic() + 20.0
    while not (found := condition()):
        assert time.monotonic() < end, what
        time.sleep(0.002)
    return found


def goals(participant, count):
    def topic(name, kind, qos=QOS):
        return Topic(participant, f"rt/tcvae/{name}", kind, qos=qos)

    latched = Qos(*(p for p in QOS.policies if p != Policy.Durability.Volatile), Policy.Durability.TransientLocal)
    cup = DataWriter(participant, topic("source_cup", PointStamped), qos=QOS)
    goal = DataWriter(participant, topic("goal_pose", PoseStamped), qos=QOS)
    heard = DataReader(participant, topic("joint_trajectory", JointTrajectory), qos=QOS)
    model = DataReader(participant, topic("model_info", String, latched), qos=latched)
    until(lambda: cup.get_matched_subscriptions() and goal.get_matched_subscriptions()
          and heard.get_matched_publications(), "the topics were not found")
    told = {"model": json.loads(until(lambda: model.take(1), "no model_info")[0].data), "trajectories": []}
    header = Header(Time(0, 0), "base")
    cup.write(PointStamped(header, Point(0.60, 0.10, 0.0)))
    time.sleep(0.2)
    for number in range(count):
        began = time.monotonic()
        goal.write(PoseStamped(header, Pose(Point(0.60 + 0.01 * (number % 10), 0.37, 0.0), Quaternion(0.0, 0.0, 0.0, 1.0))))
        trajectory = until(lambda: heard.take(10), f"no trajectory for goal {number}")[-1]
        points = [list(point.positions) for point in trajectory.points]
        told["trajectories"].append([list(trajectory.joint_names), points, time.monotonic() - began])
    return told


def calls(participant, count):
    writer = DataWriter(participant, Topic(participant, "rq/tcvae/sampleRequest", Request, qos=QOS), qos=QOS)
    reader = DataReader(participant, Topic(participant, "rr/tcvae/sampleReply", Response, qos=QOS), qos=QOS)
    until(lambda: writer.get_matched_subscriptions() and reader.get_matched_publications(), "the service was not found")
    client, told = random.getrandbits(64), {"answers": [], "seconds": []}
    for number in range(1, count + 1):
        began = time.monotonic()
        writer.write(Request(client, number, 0))
        while time.monotonic() < began + 5.0:
            mine = [r for r in reader.take(10) if r.client == client and r.number == number]
            if mine:
                told["answers"].append([mine[0].success, mine[0].message])
                told["seconds"].append(time.monotonic() - began)
                break
            time.sleep(0.002)
    return told


def main():
    participant = DomainParticipant(int(os.environ["ROS_DOMAIN_ID"]))
    what, count = {"calls": calls, "goals": goals}[sys.argv[1]], int(sys.argv[2])
    print(json.dumps(what(participant, count)), flush=True)


if __name__ == "__main__":
    main()
