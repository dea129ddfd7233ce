"""Starts the node tcvae, the frames of a ghost that plays its motions, and RViz if asked for.

    ros2 launch tcvae tcvae.launch.py rviz:=true
    ros2 launch tcvae tcvae.launch.py --show-args
"""

import tomllib
import xml.etree.ElementTree as xml
from pathlib import Path

import yaml
from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

CONFIG = Path(get_package_share_directory("tcvae")) / "config"
# What config/tcvae.rviz names.
RVIZ_TOPICS = ["robot_description", "end_effector_path", "markers", "goal_pose", "source_cup"]

SWITCH = ["true", "false"]
ARGUMENTS = [
    ("namespace", "", "Namespace of the node: its topics are NAMESPACE/tcvae/...", None),
    ("params_file", str(CONFIG / "node.yaml"), "YAML file with the node's parameters", None),
    ("model", "", "Model file. Empty: the model_path of params_file, or the built-in pouring model", None),
    ("robot", "", "TOML file of the robot. Empty: the robot of params_file, or the built-in Baxter", None),
    ("autostart", "true", "Whether the node is active from the start; if not, a lifecycle manager activates it",
     SWITCH),
    ("use_sim_time", "false", "Whether the time is taken from /clock", SWITCH),
    ("robot_state_publisher", "true", "Whether the ghost's frames, ghost/..., are published", SWITCH),
    ("rviz", "false", "Whether RViz is started", SWITCH),
]


def parameters_in(file):
    """The parameters for all nodes and for a node tcvae in a file of parameters."""
    found = {}
    for name, section in (yaml.safe_load(Path(file).read_text()) or {}).items():
        if name == "/**" or name.rpartition("/")[2] == "tcvae":
            found |= section.get("ros__parameters") or {}
    return found


def described_robot(robot, params_file):
    """The URDF file that the node serves, and the frame that its paths are in."""
    parameters = parameters_in(params_file)
    urdf, base = CONFIG / "baxter.urdf", "base"
    if robot := robot or parameters.get("robot_path"):
        described = tomllib.loads(Path(robot).read_text())
        base = described.get("base_frame", base)
        urdf = Path(robot).parent / described["urdf"] if "urdf" in described else urdf
    elif parameters.get("urdf_path"):
        urdf = Path(parameters["urdf_path"])
    return urdf, parameters.get("base_frame") or base


def root_link(urdf):
    """The link that is no joint's child."""
    robot = xml.fromstring(urdf)
    children = {joint.find("child").get("link") for joint in robot.findall("joint")}
    return next(link.get("name") for link in robot.findall("link") if link.get("name") not in children)


def nodes(context):
    """What is started, once the arguments are known."""
    value = {name: LaunchConfiguration(name).perform(context) for name, *_ in ARGUMENTS}
    on = {name: text == "true" for name, text in value.items()}
    clock = {"use_sim_time": on["use_sim_time"]}
    own = clock | {"autostart": on["autostart"]}
    own |= {f"{name}_path": value[name] for name in ("model", "robot") if value[name]}
    namespace = value["namespace"].strip("/")
    prefix = f"/{namespace}/tcvae" if namespace else "/tcvae"
    started = [
        Node(package="tcvae", executable="tcvae_node", name="tcvae", namespace=namespace, output="screen",
             parameters=[value["params_file"], own]),
    ]
    urdf, base = described_robot(value["robot"], value["params_file"])
    if on["robot_state_publisher"]:
        description = urdf.read_text()
        root = root_link(description)
        started += [
            # Beside the node's preview/joint_states, which it follows.
            Node(package="robot_state_publisher", executable="robot_state_publisher", name="ghost",
                 namespace=f"{prefix}/preview",
                 parameters=[clock | {"robot_description": ParameterValue(description, value_type=str),
                                      "frame_prefix": "ghost/"}]),
            # The ghost stands where the robot stands.
            Node(package="tf2_ros", executable="static_transform_publisher", name="ghost_base",
                 namespace=f"{prefix}/preview", parameters=[clock],
                 arguments=["--frame-id", root, "--child-frame-id", f"ghost/{root}"]),
        ]
    if on["rviz"]:
        started.append(
            Node(package="rviz2", executable="rviz2", name="tcvae_rviz", namespace=namespace, parameters=[clock],
                 arguments=["-d", str(CONFIG / "tcvae.rviz"), "-f", base],
                 remappings=[(f"/tcvae/{topic}", f"{prefix}/{topic}") for topic in RVIZ_TOPICS]))
    return started


def generate_launch_description():
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=description, choices=choices)
        for name, default, description, choices in ARGUMENTS
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=nodes)])
