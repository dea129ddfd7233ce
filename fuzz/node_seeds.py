"""Writes fuzz/seeds/node/: for each end of the node a sound message, as rclpy serialises it.

    .venv-kilted/bin/python fuzz/node_seeds.py        (./x test ros makes that environment)

A file is an input of the target `node`: which end (a place in its list), how long (two bytes), and the message. Bytes
between fields are what rclpy leaves there, so that they differ from run to run.
tests/interop/garbler.rs reads them too.
"""

import re
from pathlib import Path

from action_msgs.srv import CancelGoal
from builtin_interfaces.msg import Time
from control_msgs.action import FollowJointTrajectory
from geometry_msgs.msg import PointStamped, PoseStamped, TransformStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetAvailableStates, GetAvailableTransitions, GetState
from rcl_interfaces.msg import LoggerLevel, Parameter, ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetLoggerLevels,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetLoggerLevels,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.serialization import serialize_message
from rmw_dds_common.msg import NodeEntitiesInfo, ParticipantEntitiesInfo
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from tcvae_msgs.action import Execute
from tcvae_msgs.msg import TaskLocation
from tcvae_msgs.srv import DescribePrimitive, LoadModel, SampleTrajectory, SetManner
from tf2_msgs.msg import TFMessage
from trajectory_msgs.msg import JointTrajectoryPoint
from type_description_interfaces.srv import GetTypeDescription

HERE = Path(__file__).parent
ARM = [f"left_{joint}" for joint in ("s0", "s1", "e0", "e1", "w0", "w1", "w2")]


def point(x, y, frame="base"):
    message = PointStamped()
    message.header.frame_id = frame
    message.point.x, message.point.y = x, y
    return message


def goal(frame="base"):
    message = PoseStamped()
    message.header.frame_id = frame
    message.pose.position.x, message.pose.position.y, message.pose.orientation.w = 0.65, 0.37, 1.0
    return message


def task():
    return [TaskLocation(name="pour_location", point=point(0.65, 0.37)),
            TaskLocation(name="source_cup", point=point(0.60, 0.10))]


def transforms():
    message = TransformStamped(child_frame_id="camera")
    message.header.frame_id = "base"
    message.header.stamp.sec = 5
    message.transform.translation.x, message.transform.rotation.w = 0.1, 1.0
    other = TransformStamped(child_frame_id="cup")
    other.header.frame_id = "camera"
    other.transform.rotation.z, other.transform.rotation.w = 0.6, 0.8
    return TFMessage(transforms=[message, other])


def parameters():
    value = ParameterValue(type=3, double_value=0.5)
    words = ParameterValue(type=4, string_value="prior")
    return [Parameter(name="manner.lift", value=value), Parameter(name="manner.mode", value=words)]


def feedback():
    message = FollowJointTrajectory.Impl.FeedbackMessage()
    message.feedback.joint_names = ARM
    for part in (message.feedback.desired, message.feedback.actual, message.feedback.error):
        part.positions = [0.1] * len(ARM)
    message.feedback.desired = JointTrajectoryPoint(positions=[0.2] * len(ARM))
    return message


def messages():
    """The ends, as the target names them, and messages for them."""
    impl, drive = Execute.Impl, FollowJointTrajectory.Impl
    sample = SampleTrajectory.Request(task=task(), count=1, manner_names=["lift"], manner_values=[0.5], seed=3,
                                      rank_by="margin")
    sample.start.name, sample.start.position = ARM, [0.1] * len(ARM)
    names = ["manner.lift", "task.tolerance_m"]
    framed = point(0.1, 0.1, "cup")
    yield "~/goal_pose", goal()
    yield "~/pour_location", point(0.65, 0.37)
    yield "~/source_cup", point(0.60, 0.10)
    yield "/joint_states", JointState(name=ARM, position=[0.1] * len(ARM))
    yield "/tf", transforms()
    yield "/tf_static", transforms()
    yield "/clock", Clock(clock=Time(sec=7, nanosec=9))
    yield "ros_discovery_info", ParticipantEntitiesInfo(
        node_entities_info_seq=[NodeEntitiesInfo(node_namespace="/", node_name="other")])
    yield "~/sample", Trigger.Request()
    yield "~/sample_trajectory", sample
    yield "~/set_manner", SetManner.Request(names=["lift", "heading"], values=[0.5, -0.5])
    yield "~/describe_primitive", DescribePrimitive.Request()
    yield "~/load_model", LoadModel.Request(path="models/none.safetensors")
    yield "~/change_state", ChangeState.Request(transition=Transition(id=4, label="deactivate"))
    yield "~/get_state", GetState.Request()
    yield "~/get_available_states", GetAvailableStates.Request()
    yield "~/get_available_transitions", GetAvailableTransitions.Request()
    yield "~/get_transition_graph", GetAvailableTransitions.Request()
    yield "~/get_type_description", GetTypeDescription.Request(type_name="tcvae_msgs/msg/Sample")
    yield "~/get_logger_levels", GetLoggerLevels.Request(names=["tcvae"])
    yield "~/set_logger_levels", SetLoggerLevels.Request(levels=[LoggerLevel(name="some.logger", level=20)])
    yield "~/describe_parameters", DescribeParameters.Request(names=names)
    yield "~/get_parameter_types", GetParameterTypes.Request(names=names)
    yield "~/get_parameters", GetParameters.Request(names=names)
    yield "~/list_parameters", ListParameters.Request(prefixes=["manner", "task.source_cup"], depth=2)
    yield "~/set_parameters", SetParameters.Request(parameters=parameters())
    yield "~/set_parameters_atomically", SetParametersAtomically.Request(parameters=parameters())
    yield "~/execute/_action/send_goal", impl.SendGoalService.Request(goal=Execute.Goal(task=task(), seed=2))
    yield "~/execute/_action/cancel_goal", CancelGoal.Request()
    yield "~/execute/_action/get_result", impl.GetResultService.Request()
    yield "send_goal", drive.SendGoalService.Response(accepted=True)
    yield "cancel_goal", CancelGoal.Response(return_code=2)
    yield "get_result", drive.GetResultService.Response(status=6)
    yield "feedback", feedback()
    # Two at a time.
    yield "/tf ~/goal_pose", [transforms(), goal("cup")]
    yield "/tf_static ~/source_cup", [transforms(), framed]
    yield "~/execute/_action/send_goal ~/execute/_action/cancel_goal", [
        impl.SendGoalService.Request(), CancelGoal.Request()]


def main():
    ends = re.findall(r'^    \("([^"]+)", \|', (HERE / "fuzz_targets" / "node.rs").read_text(), re.M)
    folder = HERE / "seeds" / "node"
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.iterdir():
        old.unlink()
    for names, told in messages():
        told = told if isinstance(told, list) else [told]
        data = b""
        for name, message in zip(names.split(), told, strict=True):
            cdr = serialize_message(message)
            data += bytes([ends.index(name)]) + len(cdr).to_bytes(2, "little") + cdr
        name = names.replace("~/", "").replace("_action/", "").strip("/").replace("/", "_").replace(" ", "+")
        (folder / name).write_bytes(data)


if __name__ == "__main__":
    main()
